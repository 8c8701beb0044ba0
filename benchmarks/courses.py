"""Edits whose course is known, by formula or as recorded, for fields to be fitted, judged and timed."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.field import BakedField, FieldEvaluator
from progdf.field.choose import Render
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.rasterize import alpha_weights, render
from progdf.region import from_mask

from .analytic_edits import AnalyticEdit


@dataclass(frozen=True)
class KnownEdit:
    """An edit's true course."""

    name: str  # of the edit
    scene: Gaussians  # the original
    members: Tensor  # that the edit changes, ascending. [M] int64
    strengths: Tensor  # of the snapshots that fields are fitted to. [T]
    offsets: Tensor  # [T,M,C]
    truth: Callable[[float], Tensor]  # the offsets at any strength. [M,C]
    # errors against the truth, in views that no choice has seen, over the pixels that change
    judge: FieldEvaluator
    # the same in other views that `look` does not show, which have the last word on a choice
    chooser: FieldEvaluator
    look: Render  # pixels on which ranks are grown
    weights: Tensor  # visibility of the members. [M]
    unseen: Render  # the judge's pixels


def known_edit(
    name: str,
    scene: Gaussians,
    edit: AnalyticEdit,
    members: Tensor,
    cameras: Sequence[Camera],
    snapshots: int,
) -> KnownEdit:
    """Everything of an edit that a benchmark of fields needs."""
    with_sh = bool((edit.apply(scene, members, 1.0).shN != scene.shN).any())
    start = pack(scene[members], with_sh)

    def truth(s: float) -> Tensor:
        return pack(edit.apply(scene, members, s)[members], with_sh) - start

    strengths = torch.linspace(0, 1, snapshots)
    offsets = torch.stack([truth(float(s)) for s in strengths])
    seen = cameras[::11][:3]
    choosing = cameras[8::10][:2]
    unseen = cameras[5::10][:2]
    shown, decides = (_changed_pixels(scene, members, offsets, views) for views in (unseen, choosing))
    judge, chooser = (FieldEvaluator(strengths, offsets, render, truth) for render in (shown, decides))
    visible = sum(
        (
            alpha_weights(scene, camera, torch.ones(camera.height, camera.width))[members, 2].float()
            for camera in seen
        ),
        torch.zeros(len(members)),
    )
    weights = visible / visible.mean() + 1e-3
    look = _changed_pixels(scene, members, offsets, seen)
    return KnownEdit(
        name=name,
        scene=scene,
        members=members,
        strengths=strengths,
        offsets=offsets,
        truth=truth,
        judge=judge,
        chooser=chooser,
        look=look,
        weights=weights,
        unseen=shown,
    )


def _changed_pixels(scene: Gaussians, members: Tensor, offsets: Tensor, cameras: Sequence[Camera]) -> Render:
    start = pack(scene[members], offsets.shape[2] > 14)

    def pictures(moved: Tensor) -> list[Tensor]:
        edited = scene.replace_rows(members, start + moved)
        return [render(edited, camera).image for camera in cameras]

    ends = [pictures(offsets[t]) for t in (0, len(offsets) // 2, -1)]
    counts = [((b - a).abs() + (c - a).abs()).amax(dim=2) > 2 / 255 for a, b, c in zip(*ends, strict=True)]
    return lambda moved: torch.cat([p[c] for p, c in zip(pictures(moved), counts, strict=True)])


def milliseconds(work: Callable[[], object], clock: Callable[[], float] = time.perf_counter) -> float:
    """How long something takes."""
    begin = clock()
    work()
    return 1e3 * (clock() - begin)


processor_milliseconds = partial(milliseconds, clock=time.process_time)
"""How much processor time something takes, which a busy machine leaves alone."""


def edit_of(scene: Gaussians, members: Tensor, field: BakedField) -> Gdf:
    """An edit of these rows."""
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[members] = True
    return Gdf("edit", from_mask("edit", mask), field, fingerprint(scene))
