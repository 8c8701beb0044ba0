"""The bear's coat: colour, relief and shine of every part as functions of place."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.colour import parse_color, stripe_profile
from progdf.scenes.noise import noise
from progdf.scenes.surface import Part, Samples

FUR = ("body", "tail", "head", "muzzle", "ear", "arm", "leg", "foot")
WOOL = ("scarf", "knot", "end")


@dataclass(frozen=True)
class Paint:
    """What a surface looks like before light falls on it.

    Args:
        color: sRGB 0..1. [N,3]
        relief: how far the normals lean, for light only. [N,3]
        velvet: brightening where the surface turns away from the eye. [N]
        gloss: mirror highlight. [N]
    """

    color: Tensor
    relief: Tensor
    velvet: Tensor
    gloss: Tensor


def paint(part: Part, at: Samples, table: Tensor) -> Paint:
    """The paint of a part at its samples; `table` is the noise's."""
    if part.name in FUR:
        return _fur(part, at, table)
    if part.name in WOOL:
        return _wool(part, at, table)
    if part.name == "plinth":
        return _stone(at, table)
    if part.name == "grass":
        return _lawn(at, table)
    if part.name == "pad":
        color = _between("#d59a78", "#f0c4a2", 0.5 + 0.5 * noise(at.points, table, 22.0, 2))
        return Paint(color, _bumps(at.points, table, 25.0, 0.2), *_shine(at.points, 0.12, 0.03))
    if part.name == "glint":
        return Paint(_flat("#ffffff", at.points), torch.zeros_like(at.points), *_shine(at.points, 0.0, 0.0))
    if part.name == "mouth":
        return Paint(_flat("#2b1710", at.points), torch.zeros_like(at.points), *_shine(at.points, 0.0, 0.02))
    return _glass(part, at)


def _fur(part: Part, at: Samples, table: Tensor) -> Paint:
    p = at.points
    patches = noise(p, table, 3.0, 2)
    tufts = noise(p * torch.tensor([1.0, 0.45, 1.0]), table, 17.0, 2)
    brown = _between("#6b3f1f", "#b3733a", 0.5 + 0.35 * patches + 0.45 * tufts)
    cream = _between("#c99b63", "#f0d3a2", 0.5 + 0.3 * patches + 0.5 * tufts)
    ragged = 0.07 * noise(p, table, 14.0, 2)
    color = brown
    if part.name == "muzzle":
        color = _mix(brown, cream, _step(at.local[:, 2] + ragged, -0.10, 0.10))
    elif part.name == "body":
        belly = torch.hypot(p[:, 0] / 0.31, (p[:, 1] - 0.50) / 0.36)
        front = _step(at.normals[:, 2], 0.0, 0.25)
        color = _mix(brown, cream, _step(1.0 - belly + 1.3 * ragged, -0.10, 0.06) * front)
    elif part.name == "ear":
        inner = at.local[:, 0] ** 2 + (at.local[:, 1] + 0.06) ** 2
        rose = _between("#b97f5c", "#e3b08c", 0.5 + 0.5 * tufts)
        color = _mix(
            brown, rose, _step(0.46 - inner + 1.2 * ragged, -0.08, 0.08) * (at.local[:, 2] > 0).float()
        )
    elif part.name in ("head", "arm"):
        color = _mix(
            brown, _between("#55301a", "#8a5228", 0.5 + 0.5 * tufts), 0.35 * _step(patches, 0.1, 0.5)
        )
    return Paint(color, _bumps(p, table, 15.0, 0.34), *_shine(p, velvet=0.17, gloss=0.02))


def _wool(part: Part, at: Samples, table: Tensor) -> Paint:
    p = at.points
    if part.name == "scarf":
        along = torch.atan2(at.local[:, 0], at.local[:, 2]) / (2 * math.pi)
        turns, ribs = 13 * along, 150 * along
    else:
        along = at.local[:, 1] * torch.linalg.svdvals(part.matrix)[0]
        turns, ribs = along / (0.30 if part.name == "knot" else 0.135), along / 0.0145
    red = stripe_profile(turns, width=0.52, softness=0.05)
    color = _mix(_between("#e9dfcc", "#fffaf0", 0.6 + 0.4 * noise(p, table, 25.0)), _flat("#c8102e", p), red)
    knit = (ribs * 2 * math.pi).sin() * _step(0.013 - at.spacing, 0.0, 0.006)
    fuzz = 1 + 0.07 * noise(p, table, 40.0) + 0.10 * knit
    return Paint((color * fuzz[:, None]).clamp(0, 1), _bumps(p, table, 22.0, 0.22), *_shine(p, 0.09, 0.02))


def _stone(at: Samples, table: Tensor) -> Paint:
    p = at.points
    grain = noise(p, table, 4.0, 4)
    speckle = noise(p, table, 45.0)
    color = _between("#6f6a64", "#bdb6a8", 0.52 + 0.55 * grain + 0.12 * speckle)
    vein = 1 - (noise(p, table, 2.3, 3).abs() / 0.035).clamp(0, 1)
    color = _mix(color, _flat("#4b4742", p), 0.55 * vein)
    low = _step(-p[:, 1], 0.10, 0.30) + _step(grain, 0.25, 0.5) * _step(-at.normals[:, 1], -0.8, 0.0)
    moss = _between("#4c5a2a", "#7a8a3c", 0.5 + 0.5 * noise(p, table, 20.0))
    color = _mix(color, moss, 0.55 * low.clamp(0, 1) * _step(noise(p, table, 5.0, 2), -0.25, 0.3))
    return Paint(color, _bumps(p, table, 7.0, 0.30), *_shine(p, 0.0, 0.05))


def _lawn(at: Samples, table: Tensor) -> Paint:
    p = at.points
    meadow = noise(p, table, 0.9, 3)
    detail = noise(p, table, 9.0, 2)
    color = _between("#2f5a1b", "#7fae3a", 0.45 + 0.6 * meadow + 0.35 * detail)
    return Paint(color, _bumps(p, table, 6.0, 0.35), *_shine(p, 0.06, 0.0))


def _glass(part: Part, at: Samples) -> Paint:
    """Eyes and nose: nearly black; the nose mirrors the sky a little."""
    p = at.points
    color = _flat("#17100d" if part.name == "eye" else "#1d1412", p)
    if part.name == "nose":
        shine = at.local @ torch.tensor([-0.252, 0.806, 0.554])
        color = _mix(color, _flat("#cfc9c6", p), 0.7 * _step(shine, 0.90, 0.985))
    return Paint(color, torch.zeros_like(p), *_shine(p, 0.0, 0.12))


def _shine(points: Tensor, velvet: float, gloss: float) -> tuple[Tensor, Tensor]:
    return torch.full((len(points),), velvet), torch.full((len(points),), gloss)


def _bumps(points: Tensor, table: Tensor, frequency: float, height: float) -> Tensor:
    offsets = torch.tensor([[0.0, 0.0, 0.0], [5.2, 1.3, 8.1], [2.7, 9.4, 4.6]])
    return height * torch.stack([noise(points + offset, table, frequency, 2) for offset in offsets], dim=1)


def _between(dark: str, light: str, share: Tensor) -> Tensor:
    return torch.lerp(parse_color(dark), parse_color(light), share.clamp(0, 1)[:, None])


def _flat(color: str, points: Tensor) -> Tensor:
    return parse_color(color).expand(len(points), 3)


def _mix(under: Tensor, over: Tensor, share: Tensor) -> Tensor:
    return torch.lerp(under, over, share.clamp(0, 1)[:, None])


def _step(value: Tensor, low: float, high: float) -> Tensor:
    share = ((value - low) / (high - low)).clamp(0, 1)
    return share * share * (3 - 2 * share)
