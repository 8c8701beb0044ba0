"""CLIP directional similarity (Gal et al. 2022, StyleGAN-NADA): does the picture change as the words do?

    cos( f(I_s) − f(I_0), f(text after) − f(text before) ),  f: CLIP features of unit length

Signed, over the slider, the mean of held-out views and never the best of several positions; undefined where
nothing changes, as at s = 0. Weights are gigabytes: they are read from this machine, never fetched unasked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate, normalize, pad

from progdf.errors import ProgdfError
from trainer.store.pretrained import BROKEN, keep_quiet, missing_weights

CLIP_MODEL = "openai/clip-vit-large-patch14"
"""The one whose figures are compared in papers."""

EXTRA = "pip install progdf-studio[clip]"

ROUNDING = 1e-5
"""Features of the same input, of unit length, differ by less: a text and itself in one batch by 3e-7, where
MKL takes another path for the second row. What one sees or reads differs by .01 and more."""

# of CLIP's input
_MEAN = (0.48145466, 0.4578275, 0.40821073)
_SPREAD = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True)
class Clip:
    """CLIP's two networks; make it with `load_clip`."""

    network: Any  # a `transformers.CLIPModel`
    tokenizer: Any  # its tokenizer
    size: int  # side of the pictures it takes, pixels
    name: str  # as report.json names it

    def pictures(self, images: Sequence[Tensor]) -> Tensor:
        """Features of pictures [H,W,3] of range 0..1, of unit length. [n,D]"""
        shift = torch.tensor(_MEAN)[:, None, None]
        scale = torch.tensor(_SPREAD)[:, None, None]
        inputs = torch.stack([(square_picture(image, self.size) - shift) / scale for image in images])
        with torch.no_grad():
            return normalize(_features(self.network.get_image_features(pixel_values=inputs)), dim=-1)

    def texts(self, sentences: Sequence[str]) -> Tensor:
        """Features of sentences, of unit length; words beyond CLIP's 77 tokens are cut. [n,D]"""
        tokens = self.tokenizer(list(sentences), padding=True, truncation=True, return_tensors="pt")
        with torch.no_grad():
            features = self.network.get_text_features(
                input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
            )
        return normalize(_features(features), dim=-1)


def load_clip(model: str = CLIP_MODEL) -> Clip:
    """Read CLIP from this machine.

    Args:
        model: id on the Hugging Face hub, downloaded before, or a folder of a saved model

    Raises:
        ProgdfError: transformers is not installed, or the model is not on this machine, or is no CLIP.
    """
    try:
        from transformers import AutoConfig, AutoTokenizer, CLIPModel
        from transformers.utils import logging as speaks
    except ImportError as error:
        raise ProgdfError(f"CLIP needs the package transformers ({error}); {EXTRA}") from error
    keep_quiet(speaks)
    try:
        config = AutoConfig.from_pretrained(model, local_files_only=True)
    except BROKEN as error:
        raise missing_weights(model, "CLIP model", "", "'") from error
    if config.model_type != "clip":
        raise ProgdfError(f"{model} is a {config.model_type} model, not CLIP")
    try:
        network = CLIPModel.from_pretrained(model, local_files_only=True, use_safetensors=True)
        tokenizer = AutoTokenizer.from_pretrained(model, local_files_only=True)
    except BROKEN as error:
        raise missing_weights(model, "CLIP model", "", "'") from error
    return Clip(network.float().eval(), tokenizer, int(config.vision_config.image_size), _name(model))


def direction(before: Tensor, after: Tensor, text_before: Tensor, text_after: Tensor) -> list[float | None]:
    """Directional similarity of each picture, −1..1; None where the picture or the text does not change.

    Args:
        before, after: features of the pictures, of unit length. [n,D]
        text_before, text_after: features of the texts, of unit length. [D]
    """
    direction = (text_after - text_before).double()
    seen = (after - before).double()
    cosines = (seen @ direction) / (seen.norm(dim=1) * direction.norm()).clamp_min(1e-30)
    changes = ~same_features(before, after) & ~same_features(text_before, text_after)
    return [float(c) if changed else None for c, changed in zip(cosines, changes.tolist(), strict=True)]


def same_features(a: Tensor, b: Tensor) -> Tensor:
    """Whether features are the same; rounding has a direction too. [...,D] twice -> [...] bool"""
    apart: Tensor = (a.double() - b.double()).norm(dim=-1)
    return apart < ROUNDING


def _features(output: Any) -> Tensor:
    """transformers 5 returns an output object, 4 the features themselves."""
    features = output if isinstance(output, Tensor) else output.pooler_output
    assert isinstance(features, Tensor)
    return features.float()


def square_picture(image: Tensor, size: int) -> Tensor:
    """The whole picture, on a white square, as large as CLIP takes it. [H,W,3] -> [3,size,size]

    CLIP's own way cuts the sides off a picture that is no square; a region near the edge would be lost.
    """
    height, width = image.shape[:2]
    side = max(height, width)
    left = (side - width) // 2
    top = (side - height) // 2
    planes = image.permute(2, 0, 1)[None]
    planes = pad(planes, (left, side - width - left, top, side - height - top), value=1.0)
    scaled = interpolate(planes, size=(size, size), mode="bicubic", align_corners=False, antialias=True)
    return scaled[0].clamp(0.0, 1.0)


def _name(model: str) -> str:
    return Path(model).name if Path(model).is_dir() else model
