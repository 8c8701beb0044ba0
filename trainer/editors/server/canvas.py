"""Canvas of a size that a server accepts, with a picture of other proportions in its middle.

Some hosted models accept a few sizes only, and name them when they refuse another one.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import interpolate, pad

Size = tuple[int, int]
"""Width and height in pixels."""

_SIZE = re.compile(r"\b(\d{2,5})\s*[x×]\s*(\d{2,5})\b")


def named_sizes(message: str, refused: Size) -> tuple[Size, ...]:
    """Return the sizes that an error message names, without the refused one."""
    found = [(int(width), int(height)) for width, height in _SIZE.findall(message)]
    return tuple(size for size in dict.fromkeys(found) if size != refused)


@dataclass(frozen=True)
class Canvas:
    """Canvas with a scaled picture in its middle."""

    picture: Size
    size: Size

    @property
    def inner(self) -> Size:
        """Width and height of the scaled picture."""
        scale = self._scale
        width, height = (max(1, round(scale * side)) for side in self.picture)
        return min(width, self.size[0]), min(height, self.size[1])

    @property
    def unused(self) -> float:
        """Share of the canvas beside the picture."""
        width, height = self.inner
        return 1.0 - width * height / (self.size[0] * self.size[1])

    @property
    def _scale(self) -> float:
        return min(canvas / side for canvas, side in zip(self.size, self.picture, strict=True))

    def place(self, picture: Tensor) -> Tensor:
        """Return a picture of any size on the canvas, continued by the colors of its edge. [H,W,C]"""
        width, height = self.inner
        left = (self.size[0] - width) // 2
        top = (self.size[1] - height) // 2
        scaled = _resize(picture, self.inner)
        sides = (left, self.size[0] - width - left, top, self.size[1] - height - top)
        return pad(scaled.permute(2, 0, 1)[None], sides, mode="replicate")[0].permute(1, 2, 0)

    def cut(self, canvas: Tensor) -> Tensor:
        """Return the picture on a canvas, at its own size. [H,W,C] -> [h,w,C]"""
        width, height = self.inner
        left = (self.size[0] - width) // 2
        top = (self.size[1] - height) // 2
        return _resize(canvas[top : top + height, left : left + width], self.picture)


def best_canvas(picture: Size, sizes: Sequence[Size]) -> Canvas:
    """Return the canvas with the smallest unused share; of equal ones, the first."""
    return min((Canvas(picture, size) for size in sizes), key=lambda canvas: round(canvas.unused, 6))


def _resize(picture: Tensor, size: Size) -> Tensor:
    """Return a picture at a width and height. [H,W,C]"""
    planes = picture.permute(2, 0, 1)[None].float()
    if planes.shape[-2:] != (size[1], size[0]):
        planes = interpolate(planes, (size[1], size[0]), mode="bicubic", antialias=True)
    return torch.clamp(planes[0].permute(1, 2, 0), 0.0, 1.0)
