"""Another slider over the same edit: what was shown at one strength is shown at another, that is all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.interpolation import interpolate

from .baked import BakedField

_NEAR = 1 / 80
"""A knot so close to a node is not worth a row of coefficients."""


@dataclass(frozen=True)
class SliderRemap:
    """Where on a new slider lies what the old one showed, linear between knots.

    Args:
        old, new: strengths of the knots, ascending from 0 to 1. [K] float64

    Raises:
        ValueError: the knots do not ascend from 0 to 1, or are not as many.
    """

    old: Tensor
    new: Tensor

    def __post_init__(self) -> None:
        if self.old.shape != self.new.shape:
            raise ValueError(f"{list(self.old.shape)} old knots for {list(self.new.shape)} new ones")
        for knots in (self.old, self.new):
            if float(knots[0]) != 0.0 or float(knots[-1]) != 1.0 or bool((knots.diff() <= 0).any()):
                raise ValueError("the knots of a remap must ascend from 0 to 1")

    def __call__(self, s: Tensor) -> Tensor:
        """New strengths of old ones, 0..1; both ends exact. [n] -> [n] float64"""
        return interpolate(s.double(), self.old, self.new)

    def at(self, s: float) -> float:
        """The same of one strength."""
        return float(self(torch.tensor([s], dtype=torch.float64)))


def identity_remap() -> SliderRemap:
    """The slider remap that changes nothing."""
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    return SliderRemap(ends, ends)


def remap_slider(field: BakedField, remap: SliderRemap) -> BakedField:
    """The field under another slider: its nodes move, and where the remap bends far from any, one is added.

    No base is touched: the bytes per member are the same, and so are both ends, bit for bit.

    Args:
        field: no network, whose slider is learned
        remap: from the field's strengths to the wanted ones

    Raises:
        ValueError: the field is a network's.
    """
    if field.origin is not None:
        raise ValueError("a network's slider is its own; only separable and keyframe fields take another")
    nodes = field.knots.double()
    far = (remap.old[:, None] - nodes).abs().amin(dim=1) > _NEAR
    asked = torch.cat([nodes, remap.old[far]]).sort().values
    moved = remap(asked).float()
    kept = torch.ones(len(asked), dtype=torch.bool)
    kept[1:] = moved.diff() > 0  # single precision may close a gap
    kept[:-1] &= moved[:-1] < 1.0
    kept[-1] = True
    attributes = {
        name: replace(
            bases, coefficients=torch.stack([field.coefficients(name, float(s)) for s in asked[kept]])
        )
        for name, bases in field.attributes.items()
    }
    ticks = remap(torch.tensor(field.recorded, dtype=torch.float64)).tolist()
    return replace(field, knots=moved[kept], attributes=attributes, recorded=tuple(ticks))
