"""The bear's coat: color, relief and shine of every part as functions of place."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from progdf.color.edits import stripe_profile

from .noise import noise
from .paint import Paint, Pelt, bumps, flat, mix, mix_colors, step, swirl
from .surface import Part, Samples

FUR = ("body", "tail", "head", "muzzle", "ear", "arm", "leg", "foot")
WOOL = ("scarf", "knot", "end")


_COAT = Pelt(standing=0.22, flat=(0.85, 0.58, 0.16), hair=(0.70, 0.24, 0.16), length=0.0063)
_KNIT = Pelt(standing=0.05, flat=(0.80, 0.50, 0.14), hair=(0.70, 0.24, 0.16), length=0.0063, unruly=0.0)
_TURF = Pelt(
    standing=0.55, flat=(0.83, 0.83, 0.18), hair=(0.45, 0.16, 0.10), length=0.022, rise=1.6, lift=0.5
)


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
        color = mix_colors("#d59a78", "#f0c4a2", 0.5 + 0.5 * noise(at.points, table, 22.0, 2))
        return Paint(color, bumps(at.points, table, 25.0, 0.2), 0.12, 0.03)
    if part.name == "glint":
        return Paint(flat("#ffffff", at.points), torch.zeros_like(at.points), glows=True)
    if part.name == "mouth":
        return Paint(flat("#2b1710", at.points), torch.zeros_like(at.points), gloss=0.02)
    return _glass(part, at)


def _fur(part: Part, at: Samples, table: Tensor) -> Paint:
    p = at.points
    patches = noise(p, table, 3.0, 2)
    tufts = noise(p * torch.tensor([1.0, 0.45, 1.0]), table, 17.0, 2)
    brown = mix_colors("#6b3f1f", "#b3733a", 0.5 + 0.35 * patches + 0.45 * tufts)
    cream = mix_colors("#c99b63", "#f0d3a2", 0.5 + 0.3 * patches + 0.5 * tufts)
    ragged = 0.07 * noise(p, table, 14.0, 2)
    color = brown
    if part.name == "muzzle":
        color = mix(brown, cream, step(at.local[:, 2] + ragged, -0.10, 0.10))
    elif part.name == "body":
        belly = torch.hypot(p[:, 0] / 0.31, (p[:, 1] - 0.50) / 0.36)
        front = step(at.normals[:, 2], 0.0, 0.25)
        color = mix(brown, cream, step(1.0 - belly + 1.3 * ragged, -0.10, 0.06) * front)
    elif part.name == "ear":
        inner = at.local[:, 0] ** 2 + (at.local[:, 1] + 0.06) ** 2
        rose = mix_colors("#b97f5c", "#e3b08c", 0.5 + 0.5 * tufts)
        color = mix(
            brown, rose, step(0.46 - inner + 1.2 * ragged, -0.08, 0.08) * (at.local[:, 2] > 0).float()
        )
    elif part.name in ("head", "arm"):
        color = mix(
            brown, mix_colors("#55301a", "#8a5228", 0.5 + 0.5 * tufts), 0.35 * step(patches, 0.1, 0.5)
        )
    down = swirl(p, table, (0.0, -1.0, 0.0))
    return Paint(color, bumps(p, table, 15.0, 0.34), 0.17, 0.02, down, _COAT)


def _wool(part: Part, at: Samples, table: Tensor) -> Paint:
    p = at.points
    if part.name == "scarf":
        along = torch.atan2(at.local[:, 0], at.local[:, 2]) / (2 * math.pi)
        turns, ribs = 13 * along, 150 * along
    else:
        along = at.local[:, 1] * torch.linalg.svdvals(part.matrix)[0]
        turns, ribs = along / (0.30 if part.name == "knot" else 0.135), along / 0.0145
    red = stripe_profile(turns, width=0.52, softness=0.05)
    color = mix(mix_colors("#e9dfcc", "#fffaf0", 0.6 + 0.4 * noise(p, table, 25.0)), flat("#c8102e", p), red)
    knit = (ribs * 2 * math.pi).sin() * step(0.013 - at.spacing, 0.0, 0.006)
    fuzz = 1 + 0.07 * noise(p, table, 40.0) + 0.10 * knit
    color = (color * fuzz[:, None]).clamp(0, 1)
    # along the stripes, which keeps their edges crisp
    forth = torch.stack([at.local[:, 2], torch.zeros(len(p)), -at.local[:, 0]], dim=1) @ part.matrix.T
    around = torch.linalg.cross(at.normals, forth) if part.name == "scarf" else part.matrix[:, 0].expand_as(p)
    return Paint(color, bumps(p, table, 22.0, 0.22), 0.09, 0.02, around, _KNIT)


def _stone(at: Samples, table: Tensor) -> Paint:
    p = at.points
    grain = noise(p, table, 4.0, 4)
    speckle = noise(p, table, 45.0)
    color = mix_colors("#6f6a64", "#bdb6a8", 0.52 + 0.55 * grain + 0.12 * speckle)
    vein = 1 - (noise(p, table, 2.3, 3).abs() / 0.035).clamp(0, 1)
    color = mix(color, flat("#4b4742", p), 0.55 * vein)
    low = step(-p[:, 1], 0.10, 0.30) + step(grain, 0.25, 0.5) * step(-at.normals[:, 1], -0.8, 0.0)
    moss = mix_colors("#4c5a2a", "#7a8a3c", 0.5 + 0.5 * noise(p, table, 20.0))
    color = mix(color, moss, 0.55 * low.clamp(0, 1) * step(noise(p, table, 5.0, 2), -0.25, 0.3))
    return Paint(color, bumps(p, table, 7.0, 0.30), gloss=0.05)


def _lawn(at: Samples, table: Tensor) -> Paint:
    p = at.points
    meadow = noise(p, table, 0.9, 3)
    detail = noise(p, table, 9.0, 2)
    color = mix_colors("#2f5a1b", "#7fae3a", 0.45 + 0.6 * meadow + 0.35 * detail)
    up = swirl(p, table, (0.0, 1.0, 0.0))
    return Paint(color, bumps(p, table, 6.0, 0.35), 0.06, 0.0, up, _TURF)


def _glass(part: Part, at: Samples) -> Paint:
    """Eyes and nose: nearly black; the nose mirrors the sky a little."""
    p = at.points
    color = flat("#17100d" if part.name == "eye" else "#1d1412", p)
    if part.name == "nose":
        shine = at.local @ torch.tensor([-0.252, 0.806, 0.554])
        color = mix(color, flat("#cfc9c6", p), 0.7 * step(shine, 0.90, 0.985))
    return Paint(color, torch.zeros_like(p), gloss=0.12)
