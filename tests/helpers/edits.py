"""Builders of trajectories, fields and edits shared by tests."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor

from progdf.field import BakedField, fit_separable
from progdf.field.baked import identity_map
from progdf.field.choose import Render
from progdf.field.grade import bake_grade, fit_grade
from progdf.field.separable import course_field, opacity_course, quantize_bases
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, attribute_slices, pack
from progdf.gdf.anchors import PUSHED_SHAPE
from progdf.gdf.file import ADDED_LOGIT, Gdf, anchor_added, fingerprint
from progdf.region import Region
from tests.helpers.draws import Draws
from tests.helpers.scenes import random_gaussians


def curved_trajectory(
    members: int,
    seed: int = 0,
    channels: int = BASE_CHANNELS,
    moving: Collection[str] = ATTRIBUTES,
    snapshots: int = 9,
) -> tuple[Tensor, Tensor]:
    """Return strengths [T] and offsets [T,M,C] of members whose paths bend in two ways."""
    draws = Draws(seed)
    strengths = torch.linspace(0, 1, snapshots)
    bend = torch.sin(torch.pi * strengths)
    wave = torch.sin(2 * torch.pi * strengths)
    offsets = torch.zeros(snapshots, members, channels)
    for curve, size in ((strengths, 1.0), (bend, 0.5), (wave, 0.2)):
        offsets += curve[:, None, None] * size * draws.normal(members, channels)
    for name, columns in attribute_slices(channels).items():
        if name not in moving:
            offsets[:, :, columns] = 0.0
    offsets[0] = 0.0
    return strengths, offsets


def curved_field(
    members: int,
    seed: int = 0,
    channels: int = BASE_CHANNELS,
    moving: Collection[str] = ATTRIBUTES,
    rank: int = 2,
    basis_type: torch.dtype = torch.int8,
    end_type: torch.dtype = torch.float32,
) -> BakedField:
    """Return a separable field of `curved_trajectory` with its ends stored in `end_type`."""
    strengths, offsets = curved_trajectory(members, seed, channels, moving)
    field = fit_separable(strengths, offsets, dict.fromkeys(ATTRIBUTES, rank), basis_type=basis_type)
    if end_type == torch.float32:
        return field
    attributes = {}
    for name, bases in field.attributes.items():
        levels, unit = quantize_bases(bases.end[None], end_type)
        scale = torch.cat([unit, bases.scale[1:]])
        attributes[name] = replace(bases, end_offset=levels[0], scale=scale)
    return replace(field, attributes=attributes)


def at_snapshots(field: BakedField, strengths: Tensor) -> Tensor:
    """Return the field's offsets at these strengths. [T,M,C]"""
    return torch.stack([field.offsets(float(s)) for s in strengths])


def linear_pictures(members: int, channels: int, seed: int = 0) -> Render:
    """Return a simulated renderer that shows color well, geometry little, and half of the members never."""
    draws = Draws(seed)
    shown = draws.normal(90, members, channels) / (members * channels) ** 0.5
    shown[:, ::2] = 0.0
    for name, size in (("means", 0.02), ("log_scales", 0.02), ("quats", 0.0), ("sh0", 0.2)):
        shown[:, :, attribute_slices(channels)[name]] *= size
    return lambda offsets: (shown.flatten(1) @ offsets.flatten()).reshape(30, 3)


def edit_of(scene: Gaussians, members: Tensor, field: BakedField, name: str = "shirt") -> Gdf:
    """Return an edit of these rows ([M] int64, sorted)."""
    score = torch.zeros(len(scene))
    score[members] = 1.0
    return Gdf(name, Region(name, members, score), field, fingerprint(scene), "recolor:#3060d0")


def added_rows(count: int, seed: int, bands: int = 1) -> Gaussians:
    rows = random_gaussians(count, seed, sh_degree=bands)
    return replace(rows, logit_opacities=torch.full((count,), ADDED_LOGIT))


def growing(scene: Gaussians, members: torch.Tensor, count: int, seed: int, name: str = "hat") -> Gdf:
    """Return an edit that removes every second member and adds `count` rows that move like the others."""
    draws = Draws(seed)
    added = added_rows(count, seed)
    start = torch.cat([scene.logit_opacities[members], added.logit_opacities])
    end = torch.cat([start[: len(members)], draws.normal(count) + 2.0])
    end[: len(members) : 2] = -8.0
    knots, opacity = opacity_course(start, end)
    offsets = torch.zeros(len(knots), len(start), 14)
    offsets[:, :, attribute_slices(14)["logit_opacities"]] = opacity[..., None]
    offsets[:, :, :3] = knots[:, None, None] * draws.normal(len(start), 3)
    return replace(edit_of(scene, members, curved_field(len(members)), name), **grown(offsets, knots, added))


def painted(scene: Gaussians, count: int, seed: int, name: str = "logo", pushed: int = 30) -> Gdf:
    """Return an edit that pushes and tints some rows and adds `count` rows, which are anchored like paint."""
    draws = Draws(seed)
    members = some_rows(scene, pushed, seed)
    added = added_rows(count, seed, scene.sh_degree)
    start = torch.cat([scene.logit_opacities[members], added.logit_opacities])
    end = torch.cat([start[:pushed], draws.normal(count) + 3.0])
    knots, opacity = opacity_course(start, end)
    columns = attribute_slices(14)
    offsets = torch.zeros(len(knots), len(start), 14)
    offsets[:, :, columns["logit_opacities"]] = opacity[..., None]
    moved = pushed // 2
    offsets[:, :moved, columns["means"]] = knots[:, None, None] * 0.1 * draws.normal(moved, 3)
    offsets[:, :pushed, columns["sh0"]] = knots[:, None, None] * draws.normal(pushed, 3)
    edit = replace(edit_of(scene, members, curved_field(pushed), name), **grown(offsets, knots, added))
    return anchor_added(edit, scene, PUSHED_SHAPE | {"color"})


def rimmed(gdf: Gdf, seed: int) -> Gdf:
    """Return paint with random shares of a rim."""
    anchors = gdf.anchors
    assert anchors is not None
    return replace(gdf, anchors=replace(anchors, rim=Draws(seed).uniform(len(anchors))))


def grown(offsets: torch.Tensor, knots: torch.Tensor, added: Gaussians) -> dict[str, object]:
    return {"field": course_field(knots, offsets), "added": added}


def whole_grade(scene: Gaussians) -> Gdf:
    """Return an edit that halves the light everywhere, with a residual and a mask of single rows."""
    return grade_of(scene, torch.arange(len(scene)), "dark")


def grade_of(scene: Gaussians, members: Tensor, name: str) -> Gdf:
    """Return an edit that halves the light of these rows, with a residual and a mask of single rows."""
    knots = torch.tensor([0.0, 0.5, 1.0])
    count = len(members)
    table = torch.stack([identity_map(1) * (1.0 - 0.5 * float(s)) for s in knots])
    residual = torch.zeros(3, count, 3)
    residual[1:] = 0.1 * Draws(4).uniform(2, count, 3)
    mask = torch.full((count,), 255, dtype=torch.uint8)
    mask[::3] = 230
    form = fit_grade(knots, 1, table, residual, 1, torch.ones(count), mask)
    field = bake_grade(form, pack(scene[members], with_shN=True))
    return edit_of(scene, members, field, name)


def some_rows(scene: Gaussians, count: int, seed: int = 0) -> Tensor:
    """Return `count` different rows, sorted. [M] int64"""
    return Draws(seed).order(len(scene))[:count].sort().values


def bits(gaussians: Gaussians) -> dict[str, bytes]:
    """Return the bytes of every attribute, which distinguish 0.0 from −0.0."""
    return {name: getattr(gaussians, name).contiguous().numpy().tobytes() for name in ATTRIBUTES}
