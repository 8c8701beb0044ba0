"""Gaussians that an edit adds: rows after the scene's own, of which nothing is drawn at strength 0.

A scene is extended once by the rows of all its edits; what composes, draws or selects then needs to know
nothing of where a row came from.
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
    """The scene with the added rows of all edits after its own, and the edits of that scene.

    Args:
        scene: N Gaussians
        gdfs: edits of it

    Returns:
        N + ΣB Gaussians, the added rows in the order of the edits; and for each edit one of M + B members
        that adds nothing any more; a grade of the whole scene is one of all N + ΣB. Both as they were given
        where no edit adds a row.

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
        # on all that is there, whoever brings it
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
    """A grade of the whole scene on what other edits add as well: no residual there, and the mean mask."""
    more = len(extended) - form.members
    mask = form.mask
    if mask is not None:
        mask = pad(mask, (0, more), value=round(float(mask.float().mean())))
    form = replace(form, residual=pad(form.residual, (0, 0, 0, more)), mask=mask)
    field = bake_grade(form, pack(extended, with_shN=extended.sh_degree > 0))
    region = replace(whole_scene(extended), name=gdf.region.name)
    field = replace(field, recorded=gdf.field.recorded)
    return replace(gdf, region=region, field=field, scene=fingerprint(extended), from_others=more)


@lru_cache(maxsize=1)  # the same object for the same edits, so that what is known of it stays known
def _append_rows(scene: Gaussians, added: tuple[Gaussians, ...]) -> Gaussians:
    """The scene and rows that have origins and bands of their own."""
    parts = [scene]
    shape = scene.shN.shape[1:]
    origin = torch.tensor(scene.origin, dtype=torch.float64)
    for rows in added:
        means = rows.means if rows.origin == scene.origin else (rows.world_means - origin)
        bands = fit_bands(rows.shN.flatten(1), shape.numel()).reshape(len(rows), *shape)
        own = replace(rows, means=means.float(), shN=bands)
        parts.append(own.to(scene.means.device, scene.means.dtype))
    return concatenate(parts)


def remaining_rows(scene: Gaussians, composed: Gaussians) -> Tensor:
    """Which rows of a composed scene a file keeps: not what an edit took away or has not added yet.

    Args:
        scene: the original. N Gaussians
        composed: it under its edits, with N + B rows

    Returns:
        Sorted row indices; at strength 0 the N rows of the original, the faint ones too. [R] int64
    """
    unseen = composed.logit_opacities < UNSEEN_LOGIT
    unseen[: len(scene)] &= scene.logit_opacities >= UNSEEN_LOGIT
    return (~unseen).nonzero()[:, 0]
