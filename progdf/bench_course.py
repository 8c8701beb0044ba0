"""Edits of the bear whose true course is known, ready for fields to be fitted, judged and timed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.checkpoint import Gdf, fingerprint
from progdf.composer import Composer
from progdf.field import BakedField, FieldJudge
from progdf.field.rendered import Render
from progdf.gaussians import Gaussians, pack
from progdf.layers import Layer
from progdf.rasterize import alpha_weights, render
from progdf.region import from_mask
from progdf.scenes import AnalyticEdit


@dataclass(frozen=True)
class KnownCourse:
    """An edit's true course.

    Args:
        strengths: of the snapshots that fields are fitted to. [T]
        offsets: [T,M,C]
        truth: the offsets at any strength. [M,C]
        judge: errors against the truth, in views that `look` does not show, over the pixels that change
        look: pixels on which fields may be chosen
        weights: visibility of the members. [M]
    """

    strengths: Tensor
    offsets: Tensor
    truth: Callable[[float], Tensor]
    judge: FieldJudge
    look: Render
    weights: Tensor


def known_course(
    scene: Gaussians, edit: AnalyticEdit, members: Tensor, cameras: Sequence[Camera], snapshots: int
) -> KnownCourse:
    """Everything of an edit that a benchmark of fields needs."""
    with_sh = bool((edit.apply(scene, members, 1.0).shN != scene.shN).any())
    start = pack(scene[members], with_sh)

    def truth(s: float) -> Tensor:
        return pack(edit.apply(scene, members, s)[members], with_sh) - start

    strengths = torch.linspace(0, 1, snapshots)
    offsets = torch.stack([truth(float(s)) for s in strengths])
    seen, unseen = cameras[::11][:3], cameras[5::10][:3]
    judge = FieldJudge(strengths, offsets, _changed_pixels(scene, members, offsets, unseen), truth)
    visible = sum(
        (
            alpha_weights(scene, camera, torch.ones(camera.height, camera.width))[members, 2].float()
            for camera in seen
        ),
        torch.zeros(len(members)),
    )
    weights = visible / visible.mean() + 1e-3
    look = _changed_pixels(scene, members, offsets, seen)
    return KnownCourse(strengths, offsets, truth, judge, look, weights)


def _changed_pixels(scene: Gaussians, members: Tensor, offsets: Tensor, cameras: Sequence[Camera]) -> Render:
    start = pack(scene[members], offsets.shape[2] > 14)

    def pictures(moved: Tensor) -> list[Tensor]:
        edited = scene.replace_rows(members, start + moved)
        return [render(edited, camera) for camera in cameras]

    ends = [pictures(offsets[t]) for t in (0, len(offsets) // 2, -1)]
    counts = [((b - a).abs() + (c - a).abs()).amax(dim=2) > 2 / 255 for a, b, c in zip(*ends, strict=True)]
    return lambda moved: torch.cat([p[c] for p, c in zip(pictures(moved), counts, strict=True)])


def step_ms(scene: Gaussians, edit: Gdf) -> float:
    """A slider step of the composer, median, ms."""
    composer = Composer(scene, [edit])
    layers = [Layer(edit, s / 20) for s in range(1, 20)]
    return statistics.median(milliseconds(partial(composer.update, [layer])) for layer in layers)


def milliseconds(work: Callable[[], object]) -> float:
    """How long something takes."""
    begin = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - begin)


def edit_of(scene: Gaussians, members: Tensor, field: BakedField) -> Gdf:
    """An edit of these rows."""
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[members] = True
    return Gdf("edit", from_mask("edit", mask), field, fingerprint(scene))
