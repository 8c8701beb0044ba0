"""The pipelines of diffusers that edit pictures: how each is asked, loaded and made to fit a graphics card.

Weights are gigabytes: they are read from this machine and never fetched unasked.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from inspect import signature
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import to_picture
from trainer.options import Device
from trainer.store import pretrained
from trainer.store.pretrained import BROKEN, folder_of_model, gpu_memory, model_device, weights_here

from .mixed_steps import MixedSteps, euler_scheduler

_MULTIPLE = 32  # pixels: what every pipeline's autoencoder and patches divide
_MINIMUM = 64  # its least side
_LARGE = 2e9  # parameters from which painting on a CPU takes days
# bytes beside the weights: FLUX.1-dev takes 36.2 GB at 1024² with its 31.4, klein 20 with its 16
_WORKING = 1e9
_WORKING_PER_MEGAPIXEL = 3e9
_NF4 = 0.55  # bytes a parameter, with its scales


@dataclass(frozen=True)
class Adapter:
    """How one pipeline is asked."""

    model: str  # the id of its weights on the Hugging Face hub
    # steps, guidance (how closely the instruction is followed), image_guidance (how closely the picture is):
    # the values it was made for; None: it has no such thing
    steps: int
    guidance: float | None
    image_guidance: float | None = None
    guidance_word: str = "guidance_scale"  # its keyword
    size: int = 1024  # it was made to paint pictures of the area of such a square, pixels
    # of Stable Diffusion's family: weights in float16 (on a CPU in float32), not bfloat16; CLIP alone reads
    is_stable: bool = False
    is_fixed: bool = False  # it paints at that area whatever is asked
    encodes_alone: bool = True  # the sentence is encoded without the picture
    passes: int = 1  # calls of its network in a step
    references: int = 0  # pictures beside the view's own that one call can take
    is_gated: bool = False  # its weights want a login and their license accepted
    always: Mapping[str, object] = field(default_factory=dict)  # further arguments of a call
    loading: Mapping[str, object] = field(default_factory=dict)  # further arguments of its from_pretrained
    needs: tuple[str, ...] = ()  # packages that it needs besides the extra's

    def paint_size(self, width: float, height: float, size: int) -> tuple[int, int]:
        """Width and height at which it paints pictures of these proportions: multiples of 32 of that area.

        Those that scale what they get to an area of their own would not change it again.
        """
        ratio = width / height
        for _ in range(4):
            wide = (size * size * ratio) ** 0.5
            sides = [max(_MINIMUM, round(side / _MULTIPLE) * _MULTIPLE) for side in (wide, wide / ratio)]
            while not self.is_fixed and sides[0] * sides[1] > size * size and max(sides) > _MINIMUM:
                sides[sides.index(max(sides))] -= _MULTIPLE
            ratio = sides[0] / sides[1]
        return sides[0], sides[1]

    def arguments(
        self,
        known: Collection[str],
        prompt: str,
        pictures: Sequence[Image.Image],
        steps: int,
        guidance: float | None,
        image_guidance: float | None,
    ) -> dict[str, object]:
        """Keyword arguments of a call, all but its `generator`, of those that the pipeline knows."""
        width, height = pictures[0].size  # the view's own
        ours = {
            "num_inference_steps": steps,
            self.guidance_word: guidance,
            "image_guidance_scale": image_guidance,
            "width": width,
            "height": height,
            "max_area": width * height,
        }
        theirs = {word: value for word, value in ours.items() if word in known and value is not None}
        image = list(pictures) if self.references else pictures[0]
        return {"prompt": prompt, "image": image, **theirs, **self.always}


_PIX2PIX = Adapter(  # ProGDF's own; the result has the picture's size
    "timbrooks/instruct-pix2pix", 20, 7.5, 1.5, size=512, is_stable=True,
    loading={"safety_checker": None, "requires_safety_checker": False},
)  # fmt: skip
_KLEIN = Adapter("black-forest-labs/FLUX.2-klein-4B", 4, 1.0, references=3)
_QWEN = Adapter(
    "Qwen/Qwen-Image-Edit-2509", 40, 4.0, guidance_word="true_cfg_scale", is_fixed=True, encodes_alone=False,
    passes=2, references=2, needs=("torchvision",),
    always={"negative_prompt": " "},  # without one it has no guidance at all
)  # fmt: skip

ADAPTERS: dict[str, Adapter] = {
    "StableDiffusionInstructPix2PixPipeline": _PIX2PIX,
    "StableDiffusionXLInstructPix2PixPipeline": replace(
        _PIX2PIX, model="diffusers/sdxl-instructpix2pix-768", steps=30, guidance=3.0, size=768,
        loading={"add_watermarker": False},
    ),
    "FluxKontextPipeline": Adapter(
        "black-forest-labs/FLUX.1-Kontext-dev", 28, 2.5, is_gated=True,
        # it would scale every picture to about a megapixel; ours comes at the size that was asked for
        always={"_auto_resize": False},
    ),
    "Flux2KleinPipeline": _KLEIN,
    "Flux2KleinKVPipeline": replace(
        _KLEIN, model="black-forest-labs/FLUX.2-klein-9b-kv", guidance=None, is_gated=True
    ),
    "Flux2Pipeline": replace(
        _KLEIN, model="black-forest-labs/FLUX.2-dev", steps=28, guidance=4.0, is_gated=True
    ),
    "QwenImageEditPipeline": replace(_QWEN, model="Qwen/Qwen-Image-Edit", steps=50, references=0),
    "QwenImageEditPlusPipeline": _QWEN,
    "LongCatImageEditPipeline": replace(
        _QWEN, model="meituan-longcat/LongCat-Image-Edit", steps=50, guidance=4.5,
        guidance_word="guidance_scale", references=0, always={},
    ),
}  # fmt: skip
"""Class name in diffusers, as a saved pipeline's model_index.json has it → how it is asked."""


@dataclass(frozen=True)
class PipelineRequest:
    """One sentence for one model, nothing left open."""

    prompt: str
    model: str
    pipeline: str  # class in diffusers
    adapter: Adapter
    steps: int
    guidance: float | None
    image_guidance: float | None
    size: int  # side of a square of the area that is painted, pixels
    seed: int
    quantize: str

    def ask(self, pictures: Sequence[Tensor], seed: int) -> dict[str, object]:
        """The arguments of a call. The same noise each time: what pictures leave open is decided alike."""
        import diffusers

        known = signature(getattr(diffusers, self.pipeline).__call__).parameters
        images = [to_picture(picture) for picture in pictures]
        arguments = self.adapter.arguments(
            known, self.prompt, images, self.steps, self.guidance, self.image_guidance
        )
        return arguments | {"generator": torch.Generator().manual_seed(seed)}


SMALL_MODEL = ADAPTERS["StableDiffusionInstructPix2PixPipeline"].model


def default_model() -> str:
    """FLUX.2-klein-4B where it is on this machine and fits its card, else InstructPix2Pix."""
    with suppress(ProgdfError):
        total = (gpu_memory() or (0, 0))[1]  # of the card: what is free now may be less on the next day
        sizes = component_sizes(_KLEIN.model, _KLEIN) if total else {}
        if sizes and total >= memory_need(_KLEIN, sizes, "off", _KLEIN.size)[1]:
            return _KLEIN.model
    return SMALL_MODEL


def models_here() -> list[str]:
    """Models that are on this machine whole, by the ids of their weights."""
    models = []
    for adapter in ADAPTERS.values():
        with suppress(ProgdfError):
            component_sizes(adapter.model, adapter)
            models.append(adapter.model)
    return models


def adapter_of(model: str) -> tuple[str, Adapter]:
    """Class of a saved pipeline, by its model_index.json, in a folder or as downloaded from the hub.

    Raises:
        ProgdfError: diffusers is not installed, the model not on this machine or no editor.
    """
    try:
        import diffusers  # noqa: F401
    except ImportError as error:
        raise ProgdfError(
            f"instruct: needs the package diffusers ({error}); pip install progdf-studio[diffusion]"
        ) from error
    try:
        index = json.loads((pipeline_folder(model) / "model_index.json").read_bytes())
        kind = str(index["_class_name"])
    except BROKEN as error:
        raise missing_pipeline(model) from error
    if kind not in ADAPTERS:
        raise ProgdfError(f"{model} is a {kind}, which cannot edit pictures here; use one of {_models()}")
    adapter = ADAPTERS[kind]
    for package in adapter.needs:
        if find_spec(package) is None:
            raise ProgdfError(
                f"{model} needs the package {package}; pip install -c constraints.txt "
                "'progdf-studio[qwen]' (by itself it would replace torch)"
            )
    if kind == "Flux2KleinPipeline" and not index.get("is_distilled", True):
        adapter = replace(adapter, steps=50, guidance=4.0, passes=2)  # a base model
    return kind, adapter


def pipeline_folder(model: str) -> Path:
    """Where a pipeline lies; one of `BROKEN` where it is not on this machine."""
    return folder_of_model(model, "model_index.json")


def memory_need(adapter: Adapter, sizes: Mapping[str, int], quantize: str, size: int) -> tuple[float, float]:
    """Bytes that painting takes on a card, estimated: with all parts there, and with one at a time.

    Args:
        adapter: of the pipeline
        sizes: parameters by component
        quantize: see `EditorOptions.quantize`
        size: side of a square of the area that is painted, pixels
    """
    packed = quantize == "nf4"
    parts = {name: n * (_NF4 if packed and name != "vae" else 2.0) for name, n in sizes.items()}
    first = [name for name in parts if adapter.encodes_alone and name.startswith("text_encoder")]
    # the encoder goes before the rest comes
    encoder = _WORKING + max((parts.pop(name) for name in first), default=0.0)
    working = _WORKING + _WORKING_PER_MEGAPIXEL * size * size / 1e6
    return max(encoder, working + sum(parts.values())), max(encoder, working + max(parts.values()))


def component_sizes(model: str, adapter: Adapter) -> dict[str, int]:
    """Parameters of each network of a pipeline on this machine, from the heads of its files.

    Raises:
        ProgdfError: a part or its weights are missing or truncated.
    """
    sizes = {}
    try:
        folder = pipeline_folder(model)
        for name, made in json.loads((folder / "model_index.json").read_bytes()).items():
            if not (isinstance(made, list) and made[0]) or name in adapter.loading:
                continue
            if not (folder / name).is_dir():
                raise OSError(f"{folder} has no {name}")
            if (folder / name / "config.json").is_file():
                sizes[name] = weights_here(folder / name)
    except BROKEN as error:
        raise missing_pipeline(model) from error
    return sizes


@dataclass(frozen=True)
class DevicePlan:
    """Where a pipeline runs, and what that takes."""

    device: str
    dtype: torch.dtype
    in_turn: bool = False  # one part at a time is on the card
    need: float = 0.0  # bytes on the card, estimated
    free: float = 0.0

    def line(self) -> str:
        """For the log and for errors."""
        dtype = str(self.dtype).removeprefix("torch.")
        if not self.need:
            return f"on the {self.device.upper()} in {dtype}"
        how = "its parts there in turn" if self.in_turn else "all of it there"
        return f"on {self.device} in {dtype}, {how}: about {_gb(self.need)} needed, {_gb(self.free)} free"


def place(request: PipelineRequest, device: Device) -> DevicePlan:
    """Where and how its pipeline will run.

    Raises:
        ProgdfError: weights or a package are not here, or it is too large for a CPU that nobody asked for.
    """
    model = request.model
    adapter = request.adapter
    sizes = component_sizes(request.model, request.adapter)
    if request.quantize == "nf4" and find_spec("bitsandbytes") is None:
        raise ProgdfError(
            "--quantize nf4 needs the package bitsandbytes; pip install progdf-studio[quantize]"
        )
    if model_device(device) == "cpu":
        count = sum(sizes.values())
        if count > _LARGE and device != "cpu":
            raise ProgdfError(
                f"{model} has {count / 1e9:.0f} billion parameters and torch has no graphics card here "
                f"(torch {torch.__version__}): a picture takes hours; install torch for your card, use "
                f"--model {SMALL_MODEL}, or add --device cpu"
            )
        if request.quantize != "off":
            raise ProgdfError("--quantize nf4 needs a graphics card; leave it out")
        return DevicePlan("cpu", torch.float32 if adapter.is_stable else torch.bfloat16)
    memory = gpu_memory()
    assert memory is not None
    whole, in_turn = memory_need(adapter, sizes, request.quantize, request.size)
    is_half = adapter.is_stable or not torch.cuda.is_bf16_supported(including_emulation=False)
    dtype = torch.float16 if is_half else torch.bfloat16
    is_tight = memory[0] < whole
    return DevicePlan("cuda", dtype, is_tight, in_turn if is_tight else whole, memory[0])


@contextmanager
def explain_memory(request: PipelineRequest, placement: DevicePlan) -> Iterator[None]:
    """Say in one line that a card's memory ran out, and what to try."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        quantized = "" if request.quantize == "nf4" else "add --quantize nf4, "
        raise ProgdfError(
            f"out of memory: {request.model} {placement.line()}; {quantized}close what else uses the card, "
            f"give a smaller --edit-size, or use --model {_KLEIN.model} or {SMALL_MODEL}"
        ) from error


def load_pipeline(request: PipelineRequest, placement: DevicePlan) -> MixedSteps:
    """Its pipeline with its weights, from this machine only, where it runs.

    Raises:
        ProgdfError: weights are missing or broken, or the card's memory runs out.
    """
    import diffusers
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    pretrained.keep_quiet(diffusers_logging, transformers_logging)
    adapter = request.adapter
    loading = dict(request.adapter.loading)
    if request.quantize == "nf4":
        bits = {"load_in_4bit": True, "bnb_4bit_quant_type": "nf4", "bnb_4bit_compute_dtype": placement.dtype}
        large = [name for name in component_sizes(request.model, adapter) if name != "vae"]
        loading["quantization_config"] = diffusers.PipelineQuantizationConfig(
            quant_backend="bitsandbytes_4bit", quant_kwargs=bits, components_to_quantize=large
        )
    with explain_memory(request, placement):
        try:
            pipeline = getattr(diffusers, request.pipeline).from_pretrained(
                pipeline_folder(request.model),
                dtype=placement.dtype,
                local_files_only=True,
                use_safetensors=True,  # the other kind of weights can run code
                **loading,
            )
        except torch.OutOfMemoryError:
            raise
        except BROKEN as error:
            raise missing_pipeline(request.model) from error
        pipeline.set_progress_bar_config(disable=True)
        pipeline.scheduler = euler_scheduler(pipeline)
        mixed = MixedSteps(pipeline, adapter.encodes_alone)
        if adapter.encodes_alone:
            if placement.device != "cpu":  # the encoder is on the card for the sentence alone
                pipeline.enable_model_cpu_offload(device=placement.device)
            mixed.encode(request.ask([torch.ones(_MINIMUM, _MINIMUM, 3)], request.seed))
            pipeline.remove_all_hooks()
            for name in [name for name in pipeline.components if name.startswith("text_encoder")]:
                setattr(pipeline, name, None)
        if placement.in_turn:
            pipeline.vae.enable_tiling()
            pipeline.enable_model_cpu_offload(device=placement.device)
        else:
            pipeline.to(placement.device)
    return mixed


def missing_pipeline(model: str) -> ProgdfError:
    """What to do where a pipeline is not here, or not whole."""
    gated = any(adapter.is_gated and adapter.model == model for adapter in ADAPTERS.values())
    login = (
        f" after accepting its license at https://huggingface.co/{model} and 'hf auth login'" if gated else ""
    )
    download = (
        f' --include "*/*" --include model_index.json\'{login}, '
        "or give --model the folder of a saved pipeline"
    )
    of_folder = f"; give --model such a folder, or one of {_models()}"
    return pretrained.missing_weights(model, "diffusers pipeline", of_folder, download)


def _models() -> str:
    return ", ".join(adapter.model for adapter in ADAPTERS.values())


def _gb(count: float) -> str:
    return f"{count / 1e9:.1f} GB"
