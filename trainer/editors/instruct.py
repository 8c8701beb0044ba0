"""`instruct:"turn him into Batman"`: pipelines of diffusers that edit a picture as a sentence says.

InstructPix2Pix is ProGDF's editor, the others are newer and larger (see `adapters`). Weights are gigabytes:
they are read from this machine and never fetched unasked.

Why one target by default: text guidance is no strength. With little of it the picture is not the original
(it has been through the model's autoencoder), and as it rises the edit arrives at once, at another guidance
in every view. `--stages 4` asks for strengths that way all the same, at the price of a whole pass over the
views for each.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.images import to_picture
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.store.pretrained import BROKEN, check_weights_here, folder_of_model, last_model
from trainer.views.view import View

from .cache import KeptPictures, Recipe

_FLOW = {
    "steps": "num_inference_steps",
    "guidance": "guidance_scale",
    "width": "width",
    "height": "height",
}


@dataclass(frozen=True)
class Adapter:
    """How one pipeline is asked."""

    model: str  # the id of its weights on the Hugging Face hub
    # our word → its keyword, of steps, guidance (how closely the instruction is followed), image_guidance
    # (how closely the picture is), width, height, area
    words: Mapping[str, str]
    # steps, guidance, image_guidance: the values it was made for
    steps: int
    guidance: float
    size: int  # longer side in pixels at which it was made to paint
    dtype: torch.dtype  # of its weights on a CPU
    image_guidance: float | None = None
    always: Mapping[str, object] = field(default_factory=dict)  # further arguments of a call
    loading: Mapping[str, object] = field(default_factory=dict)  # further arguments of its from_pretrained
    needs: tuple[str, ...] = ()  # packages that it needs besides the extra's

    def arguments(
        self, prompt: str, picture: Image.Image, steps: int, guidance: float, image_guidance: float | None
    ) -> dict[str, object]:
        """Keyword arguments of a call, all but its `generator`."""
        ours = {
            "steps": steps,
            "guidance": guidance,
            "image_guidance": image_guidance,
            "width": picture.width,
            "height": picture.height,
            "area": picture.width * picture.height,
        }
        theirs = {word: ours[name] for name, word in self.words.items()}
        return {"prompt": prompt, "image": picture, **theirs, **self.always}


ADAPTERS: dict[str, Adapter] = {
    # ProGDF's own; the result has the picture's size
    "StableDiffusionInstructPix2PixPipeline": Adapter(
        model="timbrooks/instruct-pix2pix",
        words={
            "steps": "num_inference_steps",
            "guidance": "guidance_scale",
            "image_guidance": "image_guidance_scale",
        },
        steps=20,
        guidance=7.5,
        image_guidance=1.5,
        size=512,
        dtype=torch.float32,
        loading={"safety_checker": None, "requires_safety_checker": False},
    ),
    "FluxKontextPipeline": Adapter(
        model="black-forest-labs/FLUX.1-Kontext-dev",
        words={**_FLOW, "area": "max_area"},
        steps=28,
        guidance=2.5,
        size=1024,
        dtype=torch.bfloat16,
        # it would scale every picture to about a megapixel; ours comes at the size that was asked for
        always={"_auto_resize": False},
    ),
    "Flux2KleinPipeline": Adapter(
        model="black-forest-labs/FLUX.2-klein-4B",
        words=_FLOW,
        steps=4,
        guidance=1.0,
        size=1024,
        dtype=torch.bfloat16,
    ),
    "QwenImageEditPlusPipeline": Adapter(
        model="Qwen/Qwen-Image-Edit-2509",
        words={**_FLOW, "guidance": "true_cfg_scale"},
        steps=40,
        guidance=4.0,
        size=1024,
        dtype=torch.bfloat16,
        always={"negative_prompt": " "},  # without one it has no guidance at all
        needs=("torchvision",),
    ),
}
"""Class name in diffusers, as a saved pipeline's model_index.json has it → how it is asked."""

DEFAULT_MODEL = ADAPTERS["StableDiffusionInstructPix2PixPipeline"].model


_MULTIPLE = 32  # pixels: what every pipeline's autoencoder and patches divide


@dataclass(frozen=True)
class _Request:
    """One sentence for one model, nothing left open."""

    prompt: str
    adapter: Adapter
    steps: int
    guidance: float
    image_guidance: float | None
    size: int
    seed: int


@dataclass(frozen=True)
class InstructEditor:
    """Edits pictures as a sentence says."""

    # the whole picture edited, under a guidance, with the noise of a seed. [H,W,3] -> [H,W,3]
    ask: Callable[[Tensor, float, int | None], Tensor]
    guidance: float  # of the finished edit
    recipe: Recipe  # what a picture depends on besides guidance
    kept: KeptPictures  # where pictures are kept
    stages: tuple[float, ...] = (1.0,)  # (1,), or empty where graded
    kind: EditKind = "style"
    is_confined: bool = False
    references: int = 0

    def paint(
        self,
        picture: Tensor,
        references: Sequence[Tensor] = (),
        *,
        strength: float = 1.0,
        softness: float = 1.0,
        source: Tensor | None = None,
        seed: int | None = None,
    ) -> Tensor:
        """See `Painter.paint`; the strength is without effect."""
        return self.ask(picture, self.guidance, seed)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        if self.stages and strength not in self.stages:
            raise ValueError(f"this editor edits at strengths {list(self.stages)}, not {strength:g}")
        # guidance 1 is none, and pipelines skip it altogether below
        guidance = self.guidance if strength == 1.0 else 1.0 + strength * (self.guidance - 1.0)
        recipe = {**self.recipe, "guidance": guidance}
        place = "" if strength == 1.0 else f"{strength:g}"
        return self.kept.picture(
            view.camera.name, view.image, recipe, lambda picture: self.ask(picture, guidance, None), place
        )


def instruct(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], options: EditorOptions
) -> InstructEditor:
    """`instruct:"…"`: the model and its options are checked now, its weights are loaded when first needed."""
    model, kind, request = _resolve_request(what, options)
    prompt = request.prompt

    @cache
    def pipeline() -> Any:
        return last_model("pipeline", (model, kind), lambda: load_pipeline(model, kind))

    recipe: Recipe = {
        "instruct": prompt,
        "model": model,
        "pipeline": kind,
        "image_guidance": request.image_guidance,
        "steps": request.steps,
        "size": request.size,
        "seed": request.seed,
    }
    graded = options.graded and request.guidance > 1.0
    return InstructEditor(
        lambda picture, guidance, seed: _run_pipeline(pipeline(), request, picture, guidance, seed),
        request.guidance,
        recipe,
        KeptPictures(options.cache),
        stages=() if graded else (1.0,),
    )


def check_instruct(what: str, options: EditorOptions) -> None:
    """What `instruct` and its pipeline would raise, as far as it is to be known without loading a network.

    Raises:
        ProgdfError: nothing is said, a package or weights are missing or truncated, an option is not known.
    """
    model, kind, _ = _resolve_request(what, options)
    try:
        folder = folder_of_model(model, "model_index.json")
        parts = json.loads((folder / "model_index.json").read_bytes())
        for name, made in parts.items():
            missing = isinstance(made, list) and made[0] and name not in ADAPTERS[kind].loading
            if missing and not (folder / name).is_dir():
                raise OSError(f"{folder} has no {name}")
            if missing and (folder / name / "config.json").is_file():
                check_weights_here(folder / name)
    except BROKEN as error:
        raise _missing(model) from error


def _resolve_request(what: str, options: EditorOptions) -> tuple[str, str, _Request]:
    """The model, its pipeline's class, and what it will be asked."""
    prompt = what.strip().strip("\"'").strip()
    if not prompt:
        raise ProgdfError('instruct: needs an instruction; write instruct:"turn him into Batman"')
    model = options.model or DEFAULT_MODEL
    kind = pipeline_class(model)
    return model, kind, _make_request(prompt, model, kind, options)


def parse_guidance(text: str) -> tuple[float | None, float | None]:
    """What --guidance says of the sentence and of the picture; None where it says nothing.

    Raises:
        ProgdfError: it is neither one number nor two.
    """
    words = text.split(",") if text else []
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [math.nan]
    if len(numbers) > 2 or not all(1 <= number <= 100 for number in numbers):
        raise ProgdfError(
            f"--guidance must be one or two numbers between 1 and 100, such as 7.5,1.5; got {text}"
        )
    sentence, picture = (*numbers, None, None)[:2]
    return sentence, picture


def pipeline_class(model: str) -> str:
    """Class of a saved pipeline, by its model_index.json, in a folder or as downloaded from the hub.

    Raises:
        ProgdfError: diffusers is not installed, the model not on this machine or no editor.
    """
    try:
        from diffusers import DiffusionPipeline
    except ImportError as error:
        raise ProgdfError(
            f"instruct: needs the package diffusers ({error}); pip install progdf-studio[diffusion]"
        ) from error
    try:
        kind = DiffusionPipeline.load_config(model, local_files_only=True)["_class_name"]
    except BROKEN as error:
        raise _missing(model) from error
    if kind not in ADAPTERS:
        raise ProgdfError(f"{model} is a {kind}, which cannot edit pictures here; use one of {_models()}")
    for package in ADAPTERS[kind].needs:
        if find_spec(package) is None:
            raise ProgdfError(f"{model} needs the package {package}; pip install {package}")
    return str(kind)


def load_pipeline(model: str, kind: str) -> Any:
    """The pipeline with its weights, from this machine only, on the GPU where torch has one.

    Raises:
        ProgdfError: weights are missing or broken.
    """
    import diffusers
    from diffusers.utils import logging as diffusers_logging
    from transformers.utils import logging as transformers_logging

    for speaks in (diffusers_logging, transformers_logging):
        speaks.set_verbosity(logging.ERROR)
        speaks.disable_progress_bar()
    adapter = ADAPTERS[kind]
    gpu = torch.cuda.is_available()
    try:
        pipeline = getattr(diffusers, kind).from_pretrained(
            model,
            dtype=torch.bfloat16 if gpu else adapter.dtype,
            local_files_only=True,
            use_safetensors=True,  # the other kind of weights can run code
            **adapter.loading,
        )
    except BROKEN as error:
        raise _missing(model) from error
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cuda" if gpu else "cpu")


def _run_pipeline(
    pipeline: Any, request: _Request, view: Tensor, guidance: float, seed: int | None
) -> Tensor:
    """One picture through a pipeline, back at its own size. [H,W,3] -> [H,W,3]"""
    source = to_picture(view)
    scale = request.size / max(source.size)
    width, height = (max(_MULTIPLE, round(side * scale / _MULTIPLE) * _MULTIPLE) for side in source.size)
    picture = source.resize((width, height), Image.Resampling.LANCZOS)
    arguments = request.adapter.arguments(
        request.prompt, picture, request.steps, guidance, request.image_guidance
    )
    # the same noise in every view: what the picture leaves open is then decided alike
    noise = torch.Generator().manual_seed(request.seed if seed is None else seed)
    edited = pipeline(**arguments, generator=noise).images[0]
    edited = edited.convert("RGB").resize(source.size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.asarray(edited, dtype=np.float32) / 255.0)


def _make_request(prompt: str, model: str, kind: str, options: EditorOptions) -> _Request:
    """The options, with the model's own values where nothing was said."""
    adapter = ADAPTERS[kind]
    guidance, image_guidance = parse_guidance(options.guidance)
    if image_guidance is not None and "image_guidance" not in adapter.words:
        raise ProgdfError(
            f"{model} does not support guidance of the picture; give --guidance one number, "
            f"or use --model {DEFAULT_MODEL}"
        )
    return _Request(
        prompt,
        adapter,
        steps=adapter.steps if options.edit_steps is None else options.edit_steps,
        guidance=adapter.guidance if guidance is None else guidance,
        image_guidance=adapter.image_guidance if image_guidance is None else image_guidance,
        size=adapter.size if options.edit_size is None else options.edit_size,
        seed=options.seed,
    )


def _missing(model: str) -> ProgdfError:
    if model.startswith((".", "/", "~")) or Path(model).is_dir():
        return ProgdfError(
            f"{model} does not hold a complete diffusers pipeline with safetensors weights; "
            f"give --model such a folder, or one of {_models()}"
        )
    return ProgdfError(
        f"the weights of {model} are not on this machine or are incomplete; download them with "
        f"'hf download {model}', or give --model the folder of a saved pipeline"
    )


def _models() -> str:
    return ", ".join(adapter.model for adapter in ADAPTERS.values())
