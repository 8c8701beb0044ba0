"""CLIP directional similarity (Gal et al. 2022, StyleGAN-NADA): agreement of picture change and text change.

    cos( f(I_s) − f(I_0), f(text after) − f(text before) ),  f: CLIP features of unit length

The value is signed, measured over the slider, and is the mean of held-out views, never the best of several
slider values. It is undefined if nothing changes, as at s = 0. The weights are gigabytes: they are read from
this machine and never downloaded automatically.
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
from progdf.system.packages import install_extra
from trainer.store.pretrained import BROKEN, keep_quiet, missing_weights

CLIP_MODEL = "openai/clip-vit-large-patch14"
"""CLIP model for which papers report figures."""

ROUNDING = 1e-5
"""Largest distance between unit-length features of the same input. A text and its copy in one batch differ by
3e-7, as MKL takes another path for the second row. Visible or readable differences are 0.01 and more."""

# normalization of CLIP's input, rgb
_MEAN = (0.48145466, 0.4578275, 0.40821073)
_STD = (0.26862954, 0.26130258, 0.27577711)


@dataclass(frozen=True)
class Clip:
    """CLIP's two networks, loaded by `load_clip`."""

    network: Any  # a `transformers.CLIPModel`
    tokenizer: Any  # its tokenizer
    size: int  # side of its input pictures, pixels
    name: str  # name in report.json

    def pictures(self, images: Sequence[Tensor]) -> Tensor:
        """Compute unit-length features of pictures ([H,W,3], 0 to 1). [n,D]"""
        shift = torch.tensor(_MEAN)[:, None, None]
        scale = torch.tensor(_STD)[:, None, None]
        inputs = torch.stack([(square_picture(image, self.size) - shift) / scale for image in images])
        with torch.no_grad():
            return normalize(_features(self.network.get_image_features(pixel_values=inputs)), dim=-1)

    def texts(self, sentences: Sequence[str]) -> Tensor:
        """Compute unit-length features of sentences; words beyond CLIP's 77 tokens are cut. [n,D]"""
        tokens = self.tokenizer(list(sentences), padding=True, truncation=True, return_tensors="pt")
        with torch.no_grad():
            features = self.network.get_text_features(
                input_ids=tokens["input_ids"], attention_mask=tokens["attention_mask"]
            )
        return normalize(_features(features), dim=-1)


def load_clip(model: str = CLIP_MODEL) -> Clip:
    """Load CLIP from this machine.

    Args:
        model: id on the Hugging Face hub, downloaded before, or a folder of a saved model

    Raises:
        ProgdfError: transformers is not installed, or the model is not on this machine or is not CLIP.
    """
    try:
        from transformers import AutoConfig, AutoTokenizer, CLIPModel
        from transformers.utils import logging as speaks
    except ImportError as error:
        raise ProgdfError(
            f"CLIP needs the package transformers ({error}); {install_extra('clip')}"
        ) from error
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
    """Compute the directional similarity of each picture, −1 to 1; None if picture or text does not change.

    Args:
        before, after: features of the pictures, of unit length. [n,D]
        text_before, text_after: features of the texts, of unit length. [D]
    """
    text_change = (text_after - text_before).double()
    picture_change = (after - before).double()
    lengths = picture_change.norm(dim=1) * text_change.norm()
    cosines = (picture_change @ text_change) / lengths.clamp_min(1e-30)
    changes = ~same_features(before, after) & ~same_features(text_before, text_after)
    return [float(c) if changed else None for c, changed in zip(cosines, changes.tolist(), strict=True)]


def same_features(a: Tensor, b: Tensor) -> Tensor:
    """Return True for features that differ by rounding only. [...,D] twice -> [...] bool"""
    distance: Tensor = (a.double() - b.double()).norm(dim=-1)
    return distance < ROUNDING


def _features(output: Any) -> Tensor:
    """Return the features; transformers 5 wraps them in an output object, version 4 does not."""
    features = output if isinstance(output, Tensor) else output.pooler_output
    assert isinstance(features, Tensor)
    return features.float()


def square_picture(image: Tensor, size: int) -> Tensor:
    """Scale the whole picture on a white square to CLIP's input size. [H,W,3] -> [3,size,size]

    CLIP's own preprocessing crops a picture that is not square; a region near the edge would be lost.
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
