"""Gaussians that edits add: rows after the scene's own, invisible at strength 0.

A scene is extended once by the rows of all its edits. Code that composes, draws or selects then treats all
rows alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from progdf.field.baked import GradeForm
from progdf.field.grade import bake_grade
from progdf.field.separable import fit_bands
from progdf.gaussians import Gaussians, concatenate, pack
from progdf.gdf.file import UNSEEN_LOGIT, Gdf, fingerprint, verify
from progdf.region import Region, whole_scene


def extend(scene: Gaussians, gdfs: Sequence[Gdf]) -> tuple[Gaussians, tuple[Gdf, ...]]:
    """Append the added rows of all edits to a scene, and convert the edits to the extended scene.

    Args:
        scene: N Gaussians
        gdfs: edits of the scene

    Returns:
        The extended scene, N + ΣB Gaussians with the added rows in the order of the edits, and the converted
        edits. A converted edit has M + B members and adds no rows. A grade of the whole scene has all N + ΣB
        members. If no edit adds a row, scene and edits are returned unchanged.

    Raises:
        ProgdfError: an edit was made for another scene.
    """
    for gdf in gdfs:
        verify(gdf, scene)
    added = tuple(gdf.added for gdf in gdfs if gdf.added is not None)
    if not added:
        return scene, tuple(gdfs)
    extended = _append_rows(scene, added)
    total = len(extended)
    scene_print = fingerprint(extended)
    first = len(scene)
    moved = []
    for gdf in gdfs:
        form = gdf.field.origin
        # a grade of the whole scene also covers rows that other edits add
        if isinstance(form, GradeForm) and gdf.members == len(scene):
            moved.append(_grade_all(gdf, form, extended))
            continue
        rows = torch.arange(first, first + gdf.members - len(gdf.region))
        first += len(rows)
        score = torch.zeros(total)
        score[: len(scene)] = gdf.region.score
        score[rows] = 1.0
        region = Region(gdf.region.name, torch.cat([gdf.region.members, rows]), score)
        moved.append(replace(gdf, region=region, scene=scene_print, added=None))
    return extended, tuple(moved)


def _grade_all(gdf: Gdf, form: GradeForm, extended: Gaussians) -> Gdf:
    """Extend a grade of the whole scene to added rows, with the mean mask and without residual there."""
    added_count = len(extended) - form.members
    mask = form.mask
    if mask is not None:
        mask = pad(mask, (0, added_count), value=round(float(mask.float().mean())))
    form = replace(form, residual=pad(form.residual, (0, 0, 0, added_count)), mask=mask)
    field = bake_grade(form, pack(extended, with_shN=extended.sh_degree > 0))
    region = replace(whole_scene(extended), name=gdf.region.name)
    field = replace(field, recorded=gdf.field.recorded)
    return replace(gdf, region=region, field=field, scene=fingerprint(extended), from_others=added_count)


@lru_cache(maxsize=1)  # returns the same object for the same edits, so that caches keyed by it stay valid
def _append_rows(scene: Gaussians, added: tuple[Gaussians, ...]) -> Gaussians:
    """Append rows, converted to the origin and SH bands of the scene."""
    parts = [scene]
    shape = scene.shN.shape[1:]
    origin = torch.tensor(scene.origin, dtype=torch.float64)
    for rows in added:
        means = rows.means if rows.origin == scene.origin else (rows.world_means - origin)
        bands = fit_bands(rows.shN.flatten(1), shape.numel()).reshape(len(rows), *shape)
        converted = replace(rows, means=means.float(), shN=bands)
        parts.append(converted.to(scene.means.device, scene.means.dtype))
    return concatenate(parts)


def rows_on(gdf: Gdf, mask: Tensor) -> Tensor:
    """Return the rows that an edit adds on some rows of the scene, such as paint on an object.

    Args:
        gdf: an edit, converted by `extend`
        mask: rows of the extended scene. [N] bool

    Returns:
        Rows of the extended scene, sorted. [A] int64
    """
    if gdf.anchors is None:
        return gdf.region.members[:0]
    members = gdf.region.members
    return members[len(members) - len(gdf.anchors) :][gdf.anchors.lie_on(mask)]


def remaining_rows(scene: Gaussians, composed: Gaussians) -> Tensor:
    """Return the rows of a composed scene to save, without removed Gaussians and invisible added ones.

    Args:
        scene: the original, N Gaussians
        composed: the scene under its edits, N + B Gaussians

    Returns:
        Sorted row indices. At strength 0 these are the N rows of the original, including faint ones. [R]
        int64
    """
    is_invisible = composed.logit_opacities < UNSEEN_LOGIT
    is_invisible[: len(scene)] &= scene.logit_opacities >= UNSEEN_LOGIT
    return (~is_invisible).nonzero()[:, 0]
