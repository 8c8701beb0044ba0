"""Adapters for the diffusers pipelines that edit pictures: arguments, loading and placement in GPU memory.

Weights take gigabytes. They are read from this machine and never downloaded.
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
from progdf.system.packages import install_extra, pip_install
from trainer.options import Device
from trainer.store import pretrained
from trainer.store.pretrained import BROKEN, folder_of_model, gpu_memory, model_device, weights_here

from .mixed_steps import MixedSteps, euler_scheduler

_SIDE_MULTIPLE_PX = 32  # pixels; a multiple of every pipeline's autoencoder and patch size
_MIN_SIDE_PX = 64  # pixels; smallest side of a painted picture
_MAX_CPU_PARAMETERS = 2e9  # parameters; a larger model takes hours per picture on a CPU
# Memory beside the weights, in bytes. FLUX.1-dev takes 36.2 GB at 1024² with 31.4 GB of weights, klein 20 GB
# with 16 GB.
_WORKING_BYTES = 1e9  # at any size
_WORKING_BYTES_PER_MEGAPIXEL = 3e9  # added per megapixel of the painted area
_NF4_BYTES = 0.55  # bytes per parameter, scales included


def paint_size(width: float, height: float, size: int, exceeds: bool = False) -> tuple[int, int]:
    """Return the width and height, multiples of 32, at which to paint a picture of these proportions.

    Args:
        width, height: the proportions
        size: side of a square with the painted area, pixels
        exceeds: True if the area may be a little larger than that of the square
    """
    ratio = width / height
    for _ in range(4):
        width_px = (size * size * ratio) ** 0.5
        sides = [
            max(_MIN_SIDE_PX, round(side / _SIDE_MULTIPLE_PX) * _SIDE_MULTIPLE_PX)
            for side in (width_px, width_px / ratio)
        ]
        while not exceeds and sides[0] * sides[1] > size * size and max(sides) > _MIN_SIDE_PX:
            sides[sides.index(max(sides))] -= _SIDE_MULTIPLE_PX
        ratio = sides[0] / sides[1]
    return sides[0], sides[1]


@dataclass(frozen=True)
class Adapter:
    """Call signature and defaults of one diffusers pipeline."""

    model: str  # id of the weights on the Hugging Face hub
    # Recommended values of the model: steps, guidance (how closely it follows the instruction) and
    # image_guidance (how closely it follows the picture). None: the pipeline has no such argument.
    steps: int
    guidance: float | None
    image_guidance: float | None = None
    guidance_word: str = "guidance_scale"  # keyword of the guidance argument
    size: int = 1024  # side of a square with the area of the model's training pictures, pixels
    # Stable Diffusion family: weights in float16 (float32 on a CPU) instead of bfloat16; CLIP is the only
    # text encoder.
    is_stable: bool = False
    is_fixed: bool = False  # the pipeline always paints at the area of `size`²
    encodes_alone: bool = True  # the prompt can be encoded without the picture
    passes: int = 1  # network calls per step
    references: int = 0  # number of reference pictures that one call accepts beside the view
    is_gated: bool = False  # the weights need a login and an accepted license
    always: Mapping[str, object] = field(default_factory=dict)  # further arguments of every call
    loading: Mapping[str, object] = field(default_factory=dict)  # further arguments of `from_pretrained`
    needs: tuple[str, ...] = ()  # required packages beyond the `diffusion` extra

    def paint_size(self, width: float, height: float, size: int) -> tuple[int, int]:
        """Return the width and height at which to paint a picture of these proportions.

        Both are multiples of 32, with about the area of `size`². Pipelines that rescale their input to their
        own area leave this size unchanged.
        """
        return paint_size(width, height, size, exceeds=self.is_fixed)

    def arguments(
        self,
        known: Collection[str],
        prompt: str,
        pictures: Sequence[Image.Image],
        steps: int,
        guidance: float | None,
        image_guidance: float | None,
    ) -> dict[str, object]:
        """Return the keyword arguments of a call, all except `generator`.

        Args:
            known: parameters of the pipeline; optional arguments that are not among them are left out
            prompt: the instruction
            pictures: the view's own first, then references
            steps, guidance, image_guidance: as in `Adapter`
        """
        width, height = pictures[0].size  # size of the view
        values = {
            "num_inference_steps": steps,
            self.guidance_word: guidance,
            "image_guidance_scale": image_guidance,
            "width": width,
            "height": height,
            "max_area": width * height,
        }
        accepted = {word: value for word, value in values.items() if word in known and value is not None}
        image = list(pictures) if self.references else pictures[0]
        return {"prompt": prompt, "image": image, **accepted, **self.always}


_PIX2PIX = Adapter(  # the model of the ProGDF paper; the result has the size of the picture
    "timbrooks/instruct-pix2pix", 20, 7.5, 1.5, size=512, is_stable=True,
    loading={"safety_checker": None, "requires_safety_checker": False},
)  # fmt: skip
_KLEIN = Adapter("black-forest-labs/FLUX.2-klein-4B", 4, 1.0, references=3)
_QWEN = Adapter(
    "Qwen/Qwen-Image-Edit-2509", 40, 4.0, guidance_word="true_cfg_scale", is_fixed=True, encodes_alone=False,
    passes=2, references=2, needs=("torchvision",),
    always={"negative_prompt": " "},  # guidance has no effect without a negative prompt
)  # fmt: skip

ADAPTERS: dict[str, Adapter] = {
    "StableDiffusionInstructPix2PixPipeline": _PIX2PIX,
    "StableDiffusionXLInstructPix2PixPipeline": replace(
        _PIX2PIX, model="diffusers/sdxl-instructpix2pix-768", steps=30, guidance=3.0, size=768,
        loading={"add_watermarker": False},
    ),
    "FluxKontextPipeline": Adapter(
        "black-forest-labs/FLUX.1-Kontext-dev", 28, 2.5, is_gated=True,
        # the pipeline would scale every picture to about one megapixel; ours arrives at the requested size
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
"""Adapters by diffusers class name, as in `model_index.json` of a saved pipeline."""


@dataclass(frozen=True)
class PipelineRequest:
    """One prompt for one model, with every option resolved."""

    prompt: str
    model: str
    pipeline: str  # diffusers class name
    adapter: Adapter
    steps: int
    guidance: float | None
    image_guidance: float | None
    size: int  # side of a square with the painted area, pixels
    seed: int
    quantize: str

    def ask(self, pictures: Sequence[Tensor], seed: int) -> dict[str, object]:
        """Return the arguments of a call for the view's picture and its references. [H,W,3] 0..1 each

        Calls with the same seed start from the same noise, so that details that the prompt leaves open agree
        between views.
        """
        import diffusers

        known = signature(getattr(diffusers, self.pipeline).__call__).parameters
        images = [to_picture(picture) for picture in pictures]
        arguments = self.adapter.arguments(
            known, self.prompt, images, self.steps, self.guidance, self.image_guidance
        )
        return arguments | {"generator": torch.Generator().manual_seed(seed)}


SMALL_MODEL = ADAPTERS["StableDiffusionInstructPix2PixPipeline"].model
"""Model for machines without a large GPU."""


def default_model() -> str:
    """Return FLUX.2-klein-4B if it is on this machine and fits its GPU, else InstructPix2Pix."""
    with suppress(ProgdfError):
        total = (gpu_memory() or (0, 0))[1]  # total memory: free memory varies from day to day
        sizes = component_sizes(_KLEIN.model, _KLEIN) if total else {}
        if sizes and total >= memory_need(_KLEIN, sizes, "off", _KLEIN.size)[1]:
            return _KLEIN.model
    return SMALL_MODEL


def models_here() -> list[str]:
    """Return the ids of the models that are complete on this machine."""
    models = []
    for adapter in ADAPTERS.values():
        with suppress(ProgdfError):
            component_sizes(adapter.model, adapter)
            models.append(adapter.model)
    return models


def adapter_of(model: str) -> tuple[str, Adapter]:
    """Return the diffusers class name and the adapter of a model.

    Args:
        model: folder of a saved pipeline, or id of a downloaded model on the Hugging Face hub

    Raises:
        ProgdfError: diffusers is not installed, or the model is not on this machine or not an editor.
    """
    try:
        import diffusers  # noqa: F401
    except ImportError as error:
        raise ProgdfError(
            f"instruct: needs the package diffusers ({error}); {install_extra('diffusion')}"
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
            # without constraints pip would replace torch
            remedy = pip_install("-c constraints.txt 'progdf-studio[qwen]'", '"progdf-studio[qwen]"')
            raise ProgdfError(f"{model} needs the package {package}; {remedy}")
    if kind == "Flux2KleinPipeline" and not index.get("is_distilled", True):
        adapter = replace(adapter, steps=50, guidance=4.0, passes=2)  # a base model, not distilled
    return kind, adapter


def pipeline_folder(model: str) -> Path:
    """Return the folder of a pipeline.

    Raises:
        one of `BROKEN`: the pipeline is not on this machine.
    """
    return folder_of_model(model, "model_index.json")


def memory_need(adapter: Adapter, sizes: Mapping[str, int], quantize: str, size: int) -> tuple[float, float]:
    """Estimate the GPU memory that painting takes.

    Args:
        adapter: adapter of the pipeline
        sizes: number of parameters by component
        quantize: see `EditorOptions.quantize`
        size: side of a square with the painted area, pixels

    Returns:
        bytes with all components on the GPU; bytes with one component at a time
    """
    is_quantized = quantize == "nf4"
    component_bytes = {
        name: n * (_NF4_BYTES if is_quantized and name != "vae" else 2.0) for name, n in sizes.items()
    }
    encoders = [name for name in component_bytes if adapter.encodes_alone and name.startswith("text_encoder")]
    # the encoder is unloaded before the other components are loaded
    encoder_need = _WORKING_BYTES + max((component_bytes.pop(name) for name in encoders), default=0.0)
    working = _WORKING_BYTES + _WORKING_BYTES_PER_MEGAPIXEL * size * size / 1e6
    return max(encoder_need, working + sum(component_bytes.values())), max(
        encoder_need, working + max(component_bytes.values())
    )


def component_sizes(model: str, adapter: Adapter) -> dict[str, int]:
    """Return the number of parameters of each network of a pipeline, read from the headers of its files.

    Raises:
        ProgdfError: a component or its weights are missing or truncated.
    """
    sizes = {}
    try:
        folder = pipeline_folder(model)
        for name, entry in json.loads((folder / "model_index.json").read_bytes()).items():
            if not (isinstance(entry, list) and entry[0]) or name in adapter.loading:
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
    """Device and precision of a pipeline, and the memory that it takes."""

    device: str
    dtype: torch.dtype
    in_turn: bool = False  # only one component at a time is on the GPU
    need: float = 0.0  # estimated bytes on the GPU
    free: float = 0.0  # free bytes on the GPU

    def line(self) -> str:
        """Return a description for the log and for errors."""
        dtype = str(self.dtype).removeprefix("torch.")
        if not self.need:
            return f"on the {self.device.upper()} in {dtype}"
        mode = "one component at a time" if self.in_turn else "all components at once"
        return f"on {self.device} in {dtype}, {mode}: about {_gb(self.need)} needed, {_gb(self.free)} free"


def place(request: PipelineRequest, device: Device) -> DevicePlan:
    """Return the device and precision of the request's pipeline.

    Raises:
        ProgdfError: weights or a package are missing; or there is no GPU, and the model is quantized, or too
            large for a CPU while `device` is not "cpu".
    """
    model = request.model
    adapter = request.adapter
    sizes = component_sizes(request.model, request.adapter)
    if request.quantize == "nf4" and find_spec("bitsandbytes") is None:
        raise ProgdfError(f"--quantize nf4 needs the package bitsandbytes; {install_extra('quantize')}")
    if model_device(device) == "cpu":
        count = sum(sizes.values())
        if count > _MAX_CPU_PARAMETERS and device != "cpu":
            raise ProgdfError(
                f"{model} has {count / 1e9:.0f} billion parameters and torch {torch.__version__} finds "
                "no GPU: a picture would take hours; install torch for your GPU, use "
                f"--model {SMALL_MODEL}, or add --device cpu"
            )
        if request.quantize != "off":
            raise ProgdfError("--quantize nf4 needs a GPU; leave it out")
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
    """Convert an out-of-memory error of the GPU to a `ProgdfError` that suggests remedies."""
    try:
        yield
    except torch.OutOfMemoryError as error:
        advice = "" if request.quantize == "nf4" else "add --quantize nf4, "
        raise ProgdfError(
            f"out of memory: {request.model} {placement.line()}; {advice}close other programs on the GPU, "
            f"give a smaller --edit-size, or use --model {_KLEIN.model} or {SMALL_MODEL}"
        ) from error


def load_pipeline(request: PipelineRequest, placement: DevicePlan) -> MixedSteps:
    """Load the pipeline with its weights from this machine and move it to its device.

    Raises:
        ProgdfError: weights are missing or broken, or the GPU runs out of memory.
    """
    import diffusers
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    pretrained.keep_quiet(diffusers_logging, transformers_logging)
    adapter = request.adapter
    loading = dict(request.adapter.loading)
    if request.quantize == "nf4":
        quantization = {
            "load_in_4bit": True,
            "bnb_4bit_quant_type": "nf4",
            "bnb_4bit_compute_dtype": placement.dtype,
        }
        quantized_components = [name for name in component_sizes(request.model, adapter) if name != "vae"]
        loading["quantization_config"] = diffusers.PipelineQuantizationConfig(
            quant_backend="bitsandbytes_4bit",
            quant_kwargs=quantization,
            components_to_quantize=quantized_components,
        )
    with explain_memory(request, placement):
        try:
            pipeline = getattr(diffusers, request.pipeline).from_pretrained(
                pipeline_folder(request.model),
                dtype=placement.dtype,
                local_files_only=True,
                use_safetensors=True,  # pickled weights can run code
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
            if placement.device != "cpu":  # the encoder is on the GPU only while it encodes the prompt
                pipeline.enable_model_cpu_offload(device=placement.device)
            mixed.encode(request.ask([torch.ones(_MIN_SIDE_PX, _MIN_SIDE_PX, 3)], request.seed))
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
    """Return an error that explains how to get a pipeline that is missing or incomplete."""
    is_gated = any(adapter.is_gated and adapter.model == model for adapter in ADAPTERS.values())
    login = (
        f" after accepting its license at https://huggingface.co/{model} and 'hf auth login'"
        if is_gated
        else ""
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
