"""Edits with a known trajectory, by formula or recorded, to fit, evaluate and time fields."""

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
from trainer.evaluate.suite.analytic_edits import AnalyticEdit


@dataclass(frozen=True)
class KnownTrajectory:
    """An edit with its true trajectory."""

    name: str  # name of the edit
    scene: Gaussians  # the original
    members: Tensor  # rows that the edit changes, ascending. [M] int64
    strengths: Tensor  # of the snapshots that fields are fitted to. [T]
    offsets: Tensor  # offsets at these strengths. [T,M,C]
    truth: Callable[[float], Tensor]  # the offsets at any strength. [M,C]
    # errors against the truth in views not used for any choice, over the pixels that change
    judge: FieldEvaluator
    # the same in other views, apart from those of `look`, for the final choice
    chooser: FieldEvaluator
    look: Render  # renders the pixels on which ranks are chosen
    weights: Tensor  # visibility of the members. [M]
    unseen: Render  # renders the pixels of `judge`


def known_edit(
    name: str,
    scene: Gaussians,
    edit: AnalyticEdit,
    members: Tensor,
    cameras: Sequence[Camera],
    snapshots: int,
) -> KnownTrajectory:
    """Prepare an analytic edit for benchmarks of fields.

    Args:
        name: name of the edit
        scene: the original
        edit: its formula
        members: rows that it changes, ascending. [M] int64
        cameras: views, split for ranks, choice and evaluation
        snapshots: number of strengths that fields are fitted to
    """
    with_sh = bool((edit.apply(scene, members, 1.0).shN != scene.shN).any())
    start = pack(scene[members], with_sh)

    def truth(s: float) -> Tensor:
        return pack(edit.apply(scene, members, s)[members], with_sh) - start

    strengths = torch.linspace(0, 1, snapshots)
    offsets = torch.stack([truth(float(s)) for s in strengths])
    seen = cameras[::11][:3]
    choosing = cameras[8::10][:2]
    unseen = cameras[5::10][:2]
    judge_pixels, chooser_pixels = (
        _changed_pixels(scene, members, offsets, views) for views in (unseen, choosing)
    )
    judge, chooser = (
        FieldEvaluator(strengths, offsets, render, truth) for render in (judge_pixels, chooser_pixels)
    )
    visible = sum(
        (
            alpha_weights(scene, camera, torch.ones(camera.height, camera.width))[members, 2].float()
            for camera in seen
        ),
        torch.zeros(len(members)),
    )
    weights = visible / visible.mean() + 1e-3
    look = _changed_pixels(scene, members, offsets, seen)
    return KnownTrajectory(
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
        unseen=judge_pixels,
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
    """Measure the duration of `work`, ms."""
    begin = clock()
    work()
    return 1e3 * (clock() - begin)


processor_milliseconds = partial(milliseconds, clock=time.process_time)
"""Processor time of a function, ms, which load on the machine does not change."""


def edit_of(scene: Gaussians, members: Tensor, field: BakedField) -> Gdf:
    """Wrap a field of these rows as an edit."""
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[members] = True
    return Gdf("edit", from_mask("edit", mask), field, fingerprint(scene))
