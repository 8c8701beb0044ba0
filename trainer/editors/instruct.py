"""`instruct:"turn him into Batman"`: pipelines of diffusers that edit a picture as a sentence says.

InstructPix2Pix is ProGDF's editor, the others are newer and larger (see `adapters`). Weights are gigabytes:
they are read from this machine and never fetched unasked.

Why one target by default: text guidance is no strength. With little of it the picture is not the original
(it has been through the model's autoencoder), and as it rises the edit arrives at once, at another guidance
in every view. `--edit-dial guidance` asks for strengths that way all the same, at the price of a whole pass
over the views for each.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.pictures import to_picture
from progdf.region import Region
from trainer.editors.adapters import ADAPTERS, DEFAULT_MODEL, Adapter
from trainer.editors.base import EditKind, EditorSettings
from trainer.editors.kept import KeptPictures, Recipe
from trainer.views import View

_MULTIPLE = 32  # pixels: what every pipeline's autoencoder and patches divide


@dataclass(frozen=True)
class InstructEditor:
    """Edits pictures as a sentence says.

    Args:
        paint: the whole picture edited, under a guidance. [H,W,3], guidance -> [H,W,3]
        guidance: of the finished edit
        recipe: what a picture depends on besides guidance
        kept: where pictures are kept
        stages: (1,), or empty with a dial
    """

    paint: Callable[[Tensor, float], Tensor]
    guidance: float
    recipe: Recipe
    kept: KeptPictures
    stages: tuple[float, ...] = (1.0,)
    kind: EditKind = "style"
    confined: bool = False

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        return self._painted(view, view.image, strength, "" if strength == 1.0 else f"{strength:g}")

    def edit_again(self, view: View, strength: float, current: Tensor | None, step: int) -> Tensor:
        """See `Painter.edit_again`."""
        return self._painted(view, current, strength, f"step_{step:05d}")

    def _painted(self, view: View, source: Tensor | None, strength: float, place: str) -> Tensor:
        if self.stages and strength not in self.stages:
            raise ValueError(f"this editor pictures strength {list(self.stages)}, not {strength:g}")
        # guidance 1 is none, and pipelines skip it altogether below
        guidance = self.guidance if strength == 1.0 else 1.0 + strength * (self.guidance - 1.0)
        recipe = {**self.recipe, "guidance": guidance}
        return self.kept.picture(
            view.camera.name, source, recipe, lambda picture: self.paint(picture, guidance), place
        )


def instruct(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> InstructEditor:
    """`instruct:"…"`: the model and its options are checked now, its weights are loaded when first needed."""
    prompt = what.strip().strip("\"'").strip()
    if not prompt:
        raise ProgdfError('instruct: says nothing; write instruct:"turn him into Batman"')
    model = settings.model or DEFAULT_MODEL
    kind = pipeline_class(model)
    adapter = ADAPTERS[kind]
    settings = _completed(settings, adapter, model)

    @cache
    def pipeline() -> Any:
        return load_pipeline(model, kind)

    def paint(picture: Tensor, guidance: float) -> Tensor:
        return _painted(pipeline(), adapter, prompt, picture, settings, guidance)

    recipe: Recipe = {
        "instruct": prompt,
        "model": model,
        "pipeline": kind,
        "image_guidance": settings.image_guidance,
        "steps": settings.steps,
        "size": settings.size,
        "seed": settings.seed,
    }
    assert settings.guidance is not None
    dial = settings.dial == "guidance" and settings.guidance > 1.0
    stages = () if dial else (1.0,)
    return InstructEditor(paint, settings.guidance, recipe, KeptPictures(settings.kept), stages)


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
    except (OSError, ValueError, KeyError) as error:
        raise _missing(model) from error
    if kind not in ADAPTERS:
        raise ProgdfError(f"{model} is a {kind}, which edits no pictures here; use one of {_models()}")
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
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise _missing(model) from error
    pipeline.set_progress_bar_config(disable=True)
    return pipeline.to("cuda" if gpu else "cpu")


def _painted(
    pipeline: Any, adapter: Adapter, prompt: str, view: Tensor, settings: EditorSettings, guidance: float
) -> Tensor:
    """One picture through a pipeline, back at its own size. [H,W,3] -> [H,W,3]"""
    source = to_picture(view)
    assert settings.size is not None
    scale = settings.size / max(source.size)
    size = tuple(max(_MULTIPLE, round(side * scale / _MULTIPLE) * _MULTIPLE) for side in source.size)
    picture = source.resize((size[0], size[1]), Image.Resampling.LANCZOS)
    assert settings.steps is not None
    asked = adapter.arguments(prompt, picture, settings.steps, guidance, settings.image_guidance)
    # the same noise in every view: what the picture leaves open is then decided alike
    noise = torch.Generator().manual_seed(settings.seed)
    edited = pipeline(**asked, generator=noise).images[0]
    edited = edited.convert("RGB").resize(source.size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.asarray(edited, dtype=np.float32) / 255.0)


def _completed(settings: EditorSettings, adapter: Adapter, model: str) -> EditorSettings:
    """The settings with the adapter's own values where nothing was said."""
    if settings.image_guidance is not None and "image_guidance" not in adapter.words:
        raise ProgdfError(f"{model} knows no --image-guidance; leave it out, or use --model {DEFAULT_MODEL}")
    return replace(
        settings,
        guidance=adapter.guidance if settings.guidance is None else settings.guidance,
        image_guidance=adapter.image_guidance if settings.image_guidance is None else settings.image_guidance,
        steps=adapter.steps if settings.steps is None else settings.steps,
        size=adapter.size if settings.size is None else settings.size,
    )


def _missing(model: str) -> ProgdfError:
    if model.startswith((".", "/", "~")):
        return ProgdfError(
            f"{model} holds no whole diffusers pipeline with safetensors weights; "
            f"give --model such a folder, or one of {_models()}"
        )
    return ProgdfError(
        f"the weights of {model} are not on this machine, or not whole; download them with "
        f"'hf download {model}', or give --model the folder of a saved pipeline"
    )


def _models() -> str:
    return ", ".join(adapter.model for adapter in ADAPTERS.values())
