"""Baked lighting: a warm key light with soft shadows, sky, ground, and ambient occlusion between parts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.color.oklab import smoothstep, srgb_from_linear
from progdf.system.equality import equal_fields

from .surface import Part

_SH_C1 = math.sqrt(3 / (4 * math.pi))


@dataclass(frozen=True)
class Daylight:
    """Amount of light in a scene."""

    # function from points [N,3] to the incoming share of the key light, 0 to 1 [N]; None: all of it
    sun: Callable[[Tensor], Tensor] | None = None
    fill: float = 1.0  # strength of the ambient light


OUTDOORS = Daylight()


@dataclass(frozen=True)
class Lamp:
    """Directional light."""

    __eq__ = equal_fields

    direction: Tensor  # unit vector towards the light. [3]
    color: Tensor  # linear RGB. [3]


def _lamp(direction: tuple[float, float, float], color: tuple[float, float, float]) -> Lamp:
    towards = torch.tensor(direction)
    return Lamp(towards / towards.norm(), torch.tensor(color))


KEY = _lamp((-0.62, 0.80, 0.62), (2.35, 2.05, 1.62))
RIM = _lamp((0.70, 0.35, -0.75), (0.42, 0.50, 0.66))
SKY = torch.tensor([0.60, 0.72, 0.95])
GROUND = torch.tensor([0.20, 0.24, 0.12])


def irradiance(
    points: Tensor, normals: Tensor, parts: Sequence[Part], receiver: Part, daylight: Daylight = OUTDOORS
) -> Tensor:
    """Return the linear light that reaches each point of the part `receiver`. [N,3], [N,3] -> [N,3]"""
    others = [part for part in parts if part is not receiver]
    open_sky = torch.ones(len(points))
    lit = torch.ones(len(points)) if daylight.sun is None else daylight.sun(points)
    for part in others:
        local = part.to_local(points)
        open_sky = open_sky * (1 - _occlusion(points, normals, local, part))
        if part.casts_shadow:
            lit = lit * _key_light_share(local, part)
    facing = _wrap_light(normals @ KEY.direction, 0.18)
    up = 0.5 + 0.5 * normals[:, 1:2]
    ambient = daylight.fill * (SKY * up + GROUND * (1 - up))
    return (
        KEY.color * (facing * lit * (0.4 + 0.6 * open_sky))[:, None]
        + RIM.color * _wrap_light(normals @ RIM.direction, 0.3)[:, None] * open_sky[:, None]
        + ambient * open_sky[:, None]
    )


def develop(linear: Tensor) -> Tensor:
    """Convert linear light to sRGB, 0 to 1. Highlights bend softly towards white. [...,3] -> [...,3]"""
    return srgb_from_linear(1 - torch.exp(-linear.clamp_min(0)))


def view_dependent_light(
    normals: Tensor, velvet: float, gloss: float, color: Tensor
) -> tuple[Tensor, Tensor]:
    """Return view-dependent light that fits in one SH band.

    With d the direction from the eye, velvet adds velvet·(1 + n·d). It brightens surfaces that turn away,
    like short hair. Gloss adds −gloss·(r·d), which is brighter towards the mirror direction r of the key
    light.

    Args:
        normals: unit vectors. [N,3]
        velvet, gloss: strengths, sRGB units
        color: color of both. [N,3]

    Returns:
        Offset of the color [N,3], and coefficients of SH band 1 [N,3,3].
    """
    mirror = 2 * (normals @ KEY.direction)[:, None] * normals - KEY.direction
    slope = velvet * normals - gloss * mirror
    band = torch.stack([-slope[:, 1], slope[:, 2], -slope[:, 0]], dim=1) / _SH_C1
    return velvet * color, band[:, :, None] * color[:, None, :]


def _wrap_light(cosine: Tensor, softness: float) -> Tensor:
    return ((cosine + softness) / (1 + softness)).clamp_min(0)


def _occlusion(points: Tensor, normals: Tensor, local: Tensor, part: Part) -> Tensor:
    """Return the share of the sky that a part hides, approximated by a sphere, 0 to 1. [N]"""
    offset = part.shape.nearest(local) @ part.matrix.T + part.center - points
    gap = offset.norm(dim=1)
    size = float(torch.linalg.svdvals(part.matrix)[1]) * part.shape.girth
    towards = torch.where(gap[:, None] > 1e-3, offset / gap[:, None].clamp_min(1e-3), normals)
    outside = part.shape.level(local) > 1
    cosine = torch.where(outside, (normals * towards).sum(1), torch.ones_like(gap))
    near = size / (size + 2.0 * torch.where(outside, gap, torch.zeros_like(gap)))
    hidden: Tensor = 0.9 * (0.25 + 0.75 * cosine).clamp(0, 1) * near * near
    return hidden


def _key_light_share(local: Tensor, part: Part) -> Tensor:
    """Return the share of the key light that passes a part, by the ray's closest approach, 0 to 1. [N]"""
    local_direction: Tensor = torch.linalg.inv(part.matrix) @ KEY.direction
    reach = float(local_direction.norm())
    local_direction = local_direction / reach
    ahead = -(local @ local_direction)
    closest = (local + ahead[:, None] * local_direction).norm(dim=1)
    world_ahead = ahead.clamp_min(0) / reach
    blur = 0.06 + 0.16 * world_ahead
    passed = smoothstep((closest - 1 + blur) / (2 * blur))
    begins = (world_ahead / 0.03).clamp(0, 1)
    light: Tensor = 1 - (1 - passed) * begins
    return light
