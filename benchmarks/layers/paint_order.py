"""The benchmark `order`: time of a slider step with paint that depends on other layers.

Each row drags one slider. Its contender is the same stack in which the paint depends on nothing: without a
rim, without anchors, or with both decals apart.

    python -m benchmarks order
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from benchmarks.courses import edit_of, milliseconds
from benchmarks.table import Table
from progdf.compose.added import extend
from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.compose.overlap import find_paint
from progdf.compose.reference import compose_layers
from progdf.field.separable import course_field
from progdf.gaussians import Gaussians, pack
from progdf.gdf.anchors import PUSHED_SHAPE
from progdf.gdf.file import ADDED_LOGIT, Gdf, anchor_added

SIDE = 300
"""Gaussians along a side of the wall."""
DISCS = 90
"""Discs along a side of a decal."""
STEPS = 60
"""Steps of a slider, in turns with the contender."""
_DECAL_SIZE = 0.25  # side of a decal, in sides of the wall
_RIM_DISCS = 6  # width of a decal's rim, in discs
_BLEND = "adjust"  # the default blend rule


@dataclass(frozen=True)
class Case:
    """A slider that is dragged, in a stack with paint and in its contender."""

    name: str
    stack: tuple[Gdf, ...]  # lowest first
    alone: tuple[Gdf, ...]  # the same edits, of which no paint depends on another layer
    dragged: int  # position of the slider in the stack


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure slider steps of every case."""
    wall = _wall()
    rows = [_row(wall, case) for case in _cases(wall)]
    discs = DISCS * DISCS
    return [
        Table.of(
            "order",
            "A slider step with paint that depends on other layers",
            rows,
            f"Lower quartiles, measured in turns; processor time; {len(wall)} Gaussians, decals of {discs} "
            "discs. Alone: the paint has no rim, no anchors, or lies apart from the other decal. Difference: "
            "largest one from `compose_layers`, all attributes. When a layer is added, the overlap of both "
            f"decals is measured in {_finding_ms(wall):.0f} ms.",
        )
    ]


def _cases(wall: Gaussians) -> list[Case]:
    """Return the cases."""
    paint = _decal(wall, "paint", 0.5, 0.005)
    other = _decal(wall, "other", 0.5, 0.006)
    apart = _decal(wall, "apart", 0.8, 0.006)
    assert paint.anchors is not None
    anchors = replace(paint.anchors, rim=None)
    plain = replace(paint, anchors=anchors)
    free = replace(paint, anchors=replace(anchors, weights=torch.zeros_like(anchors.weights)))
    recolor = _change(wall, "recolor", slice(11, 14), 0.5)
    move = _change(wall, "move", slice(0, 3), 0.2)
    return [
        Case("recolor below paint with a rim", (recolor, paint), (recolor, plain), 0),
        Case("paint with a rim over a recolor", (recolor, paint), (recolor, plain), 1),
        Case("lower of two decals", (paint, other), (plain, apart), 0),
        Case("upper of two decals", (paint, other), (plain, apart), 1),
        Case("move below paint", (move, plain), (move, free), 0),
        Case("paint on a moved wall", (move, plain), (move, free), 1),
    ]


def _finding_ms(wall: Gaussians) -> float:
    """Return the time in which the overlap of two decals is measured, ms."""
    times = []
    for step in range(5):
        heights = 0.005 + 1e-5 * step, 0.006 + 1e-5 * step  # no overlap is known yet
        decals = [_decal(wall, f"decal {height}", 0.5, height) for height in heights]
        extended, edits = extend(wall, decals)
        times.append(milliseconds(partial(find_paint, extended, edits)))
    return statistics.median(times)


def _row(wall: Gaussians, case: Case) -> dict[str, str]:
    """Measure one case."""
    composers = Composer(wall, case.stack), Composer(wall, case.alone)
    times: tuple[list[float], list[float]] = ([], [])
    for step in range(STEPS):
        strength = 0.4 + 0.5 * step / STEPS
        for composer, stack, taken in zip(composers, (case.stack, case.alone), times, strict=True):
            composer.update(_layers(stack, case.dragged, strength), _BLEND)
            layers = _layers(stack, case.dragged, strength + 0.01)
            started = time.process_time()
            composer.update(layers, _BLEND)
            taken.append(1e3 * (time.process_time() - started))
    exact = compose_layers(wall, _layers(case.stack, case.dragged, strength + 0.01), _BLEND)
    difference = (pack(composers[0].gaussians) - pack(exact)).abs().max()
    ordered, alone = (statistics.quantiles(taken, n=4)[0] for taken in times)
    return {
        "slider": case.name,
        "ms": f"{ordered:.2f}",
        "alone, ms": f"{alone:.2f}",
        "ratio": f"{ordered / alone:.2f}",
        "difference": f"{float(difference):.0e}",
    }


def _layers(stack: Sequence[Gdf], dragged: int, strength: float) -> list[Layer]:
    """Return the layers, the dragged one at a strength and the others at 0.9."""
    return [Layer(gdf, strength if index == dragged else 0.9) for index, gdf in enumerate(stack)]


def _wall() -> Gaussians:
    """Return a flat wall of disc-shaped Gaussians at z = 0, one unit wide."""
    line = (torch.arange(SIDE) + 0.5) / SIDE
    means = torch.cartesian_prod(line, line, torch.zeros(1))
    return _discs(means, 1.0 / SIDE, 4.0)


def _discs(means: torch.Tensor, spacing: float, logit: float) -> Gaussians:
    """Return gray discs that face along z."""
    count = len(means)
    scales = spacing * torch.tensor([0.7, 0.7, 0.1])
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    bands = torch.zeros(count, 0, 3)
    logits = torch.full((count,), logit)
    return Gaussians(means, quats, scales.log().repeat(count, 1), logits, torch.zeros(count, 3), bands)


def _decal(wall: Gaussians, name: str, center: float, height: float) -> Gdf:
    """Return a square decal that lies on the wall at a height and pushes the Gaussians below it."""
    line = _DECAL_SIZE * ((torch.arange(DISCS) + 0.5) / DISCS - 0.5)
    grid = torch.cartesian_prod(line + center, line + 0.5)
    means = torch.cat([grid, torch.full((len(grid), 1), height)], dim=1)
    added = _discs(means, _DECAL_SIZE / DISCS, ADDED_LOGIT)
    inside = ((wall.means[:, :2] - torch.tensor([center, 0.5])).abs() < 0.5 * _DECAL_SIZE).all(dim=1)
    members = inside.nonzero()[:, 0]
    offsets = torch.zeros(2, len(members) + len(added), 14)
    offsets[1, : len(members), 2] = -0.01
    offsets[1, len(members) :, 10] = 4.0 - ADDED_LOGIT
    offsets[1, len(members) :, 11:14] = torch.tensor([1.0, -0.5, 0.2])
    knots = torch.tensor([0.0, 1.0])
    below = edit_of(wall, members, course_field(knots, offsets[:, : len(members)]))
    paint = replace(below, name=name, field=course_field(knots, offsets), added=added)
    paint = anchor_added(paint, wall, PUSHED_SHAPE)
    assert paint.anchors is not None
    edge = (torch.arange(DISCS) - 0.5 * (DISCS - 1)).abs() > 0.5 * DISCS - _RIM_DISCS
    rim = (edge[:, None] | edge[None, :]).flatten().float()
    return replace(paint, anchors=replace(paint.anchors, rim=rim))


def _change(wall: Gaussians, name: str, channels: slice, amount: float) -> Gdf:
    """Return an edit that changes some channels of the whole wall."""
    offsets = torch.zeros(2, len(wall), 14)
    offsets[1, :, channels] = amount
    field = course_field(torch.tensor([0.0, 1.0]), offsets)
    return replace(edit_of(wall, torch.arange(len(wall)), field), name=name)
