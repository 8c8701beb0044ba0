"""Edits whose course is known, by formula or as recorded, for fields to be fitted, judged and timed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.field import BakedField, FieldEvaluator
from progdf.field.choose import Field, Render
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.metrics.image import decibels
from progdf.rasterize import alpha_weights, render, set_threads
from progdf.region import from_mask
from progdf.threads import threads

from .analytic_edits import AnalyticEdit

AT_SNAPSHOTS = 6
"""Snapshots at which fields are judged beside the strengths between them."""


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

    @cached_property
    def _shown(self) -> list[tuple[float, Tensor]]:
        inner = range(1, len(self.strengths) - 1)
        some = inner[:: max(1, len(inner) // AT_SNAPSHOTS)][:AT_SNAPSHOTS]
        with torch.no_grad():
            return [(float(self.strengths[t]), self.unseen(self.offsets[t])) for t in some]

    def worst_at_snapshots(self, field: Field) -> float:
        """Least PSNR at some snapshots that a field was fitted to, dB, where `judge` looks between them."""
        with torch.no_grad():
            errors = [
                float((self.unseen(field.offsets(s)) - shown).double().square().mean())
                for s, shown in self._shown
            ]
        return min((decibels(error) for error in errors), default=decibels(0.0))


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
    seen, choosing, unseen = cameras[::11][:3], cameras[8::10][:2], cameras[5::10][:2]
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
    return KnownEdit(name, scene, members, strengths, offsets, truth, judge, chooser, look, weights, shown)


def _changed_pixels(scene: Gaussians, members: Tensor, offsets: Tensor, cameras: Sequence[Camera]) -> Render:
    start = pack(scene[members], offsets.shape[2] > 14)

    def pictures(moved: Tensor) -> list[Tensor]:
        edited = scene.replace_rows(members, start + moved)
        return [render(edited, camera).image for camera in cameras]

    ends = [pictures(offsets[t]) for t in (0, len(offsets) // 2, -1)]
    counts = [((b - a).abs() + (c - a).abs()).amax(dim=2) > 2 / 255 for a, b, c in zip(*ends, strict=True)]
    return lambda moved: torch.cat([p[c] for p, c in zip(pictures(moved), counts, strict=True)])


def step_ms(scene: Gaussians, edit: Gdf) -> tuple[float, float]:
    """A slider step of the composer with one thread and with two, in turns, medians, ms."""
    composer = Composer(scene, [edit])
    layers = [Layer(edit, s / 20) for s in range(1, 20)]
    before = threads()

    def step(count: int, layer: Layer) -> float:
        set_threads(count)
        return milliseconds(partial(composer.update, [layer]))

    times: tuple[list[float], list[float]] = ([], [])
    try:
        for layer in layers:
            for count in (1, 2):
                composer.update([])
                times[count - 1].append(step(count, layer))
    finally:
        set_threads(before)
    return statistics.median(times[0]), statistics.median(times[1])


def milliseconds(work: Callable[[], object]) -> float:
    """How long something takes."""
    begin = time.perf_counter()
    work()
    return 1e3 * (time.perf_counter() - begin)


def processor_milliseconds(work: Callable[[], object]) -> float:
    """How much processor time something takes, which a busy machine leaves alone."""
    begin = time.process_time()
    work()
    return 1e3 * (time.process_time() - begin)


def edit_of(scene: Gaussians, members: Tensor, field: BakedField) -> Gdf:
    """An edit of these rows."""
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[members] = True
    return Gdf("edit", from_mask("edit", mask), field, fingerprint(scene))
