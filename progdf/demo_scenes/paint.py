"""What surfaces look like before light falls on them, and how Gaussians lie on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.color.edits import parse_color

from .noise import noise
from .surface import Part, Samples


@dataclass(frozen=True)
class Pelt:
    """How the Gaussians of a surface lie: most of them flat on it, some standing out as hairs or blades.

    Args:
        standing: share of those that stand out, 0..1
        flat: standard deviations along the flow, across it and through the surface, in sample spacings
        hair: the same of those that stand out
        length: what is added to a hair's first, world units: fur keeps some length however fine the sampling
        rise: how steeply a hair leaves the surface; 0 lies, 1 is 45 degrees
        lift: how far a hair's middle is above the surface, in its first standard deviation
        unruly: how much directions differ from neighbor to neighbor
    """

    standing: float = 0.0
    flat: tuple[float, float, float] = (0.64, 0.64, 0.14)
    hair: tuple[float, float, float] = (0.70, 0.24, 0.16)
    length: float = 0.0
    rise: float = 0.45
    lift: float = 0.35
    unruly: float = 0.35


BARE = Pelt()


@dataclass(frozen=True)
class Paint:
    """What a surface looks like before light falls on it.

    Args:
        color: sRGB 0..1. [N,3]
        relief: how far the normals lean, for light only. [N,3]
        velvet: brightening where the surface turns away from the eye, sRGB units
        gloss: mirror highlight, sRGB units
        flow: where hairs and flat Gaussians point; only its part along the surface counts. [N,3]
        pelt: how the Gaussians lie
        glows: whether `color` is what is seen, whatever light there is
    """

    color: Tensor
    relief: Tensor
    velvet: float = 0.0
    gloss: float = 0.0
    flow: Tensor | None = None
    pelt: Pelt = BARE
    glows: bool = False


Painter = Callable[[Part, Samples, Tensor], Paint]
"""The paint of a part at its samples; the tensor is the noise's table."""


def bumps(points: Tensor, table: Tensor, frequency: float, height: float) -> Tensor:
    """A relief of noise, see `Paint.relief`. [N,3] -> [N,3]"""
    offsets = torch.tensor([[0.0, 0.0, 0.0], [5.2, 1.3, 8.1], [2.7, 9.4, 4.6]])
    return height * torch.stack([noise(points + offset, table, frequency, 2) for offset in offsets], dim=1)


def swirl(points: Tensor, table: Tensor, main: tuple[float, float, float], height: float = 0.7) -> Tensor:
    """A flow along `main` that noise bends. [N,3] -> [N,3]"""
    bend = torch.stack([noise(points + 3.1 * k, table, 2.5) for k in range(3)], dim=1)
    return torch.tensor(main) + height * bend


def mix_colors(dark: str, light: str, share: Tensor) -> Tensor:
    """From one `#rrggbb` to another; what lies outside 0..1 is cut. [N] -> [N,3]"""
    return torch.lerp(parse_color(dark), parse_color(light), share.clamp(0, 1)[:, None])


def flat(color: str, points: Tensor) -> Tensor:
    """One `#rrggbb` everywhere. [N,3] -> [N,3]"""
    return parse_color(color).expand(len(points), 3)


def mix(under: Tensor, over: Tensor, share: Tensor) -> Tensor:
    """`over` where `share` is 1. [N,3], [N,3], [N] -> [N,3]"""
    return torch.lerp(under, over, share.clamp(0, 1)[:, None])


def step(value: Tensor, low: float, high: float) -> Tensor:
    """0 up to `low`, 1 from `high`, smooth between. [...] -> [...]"""
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
