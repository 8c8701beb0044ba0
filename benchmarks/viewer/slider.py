"""The benchmark `viewer`: milliseconds from a slider's event to finished pixels, by part.

Simulated input drags the slider of a whole window (panel and picture) drawn without a screen. The renderers
take turns at every step, in one process. The scenes are bears, so that the benchmark can be repeated, or
--scenes.

    python -m benchmarks viewer
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import moderngl
import numpy as np
import torch

from benchmarks.table import Table, Wall
from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.rasterize import render
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.camera.view_camera import first_camera, to_camera
from viewer.render.dynamic_resolution import FrameTimings
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import LayerState, ViewState

from .mouse import SIZE, Mouse, slider_at
from .scenes import RENDERERS, edit_for, scenes_of

WARM_UP = 2  # slider steps before the measured ones
STEPS = 24  # measured slider steps
PARTS = "compose", "upload", "sort", "draw"


@dataclass(frozen=True)
class SliderCase:
    """An edit of a scene."""

    members: int  # number of Gaussians that it changes
    moves: bool  # True if it also moves them, so that they must be sorted again

    @property
    def title(self) -> str:
        return "color and place" if self.moves else "color"


CASES = (
    SliderCase(3_000, False),
    SliderCase(3_000, True),
    SliderCase(30_000, True),
    SliderCase(125_000, True),
)


@dataclass(frozen=True)
class SliderTimes:
    """Times of one renderer, an entry per slider step, and its picture's error against the CPU engine."""

    case: SliderCase
    count: int  # Gaussians in the scene
    way: str  # a key of `RENDERERS`
    events_ms: tuple[float, ...]  # from the mouse's event to finished pixels
    processor_ms: tuple[float, ...]  # the same on all cores together
    parts: tuple[FrameTimings, ...]  # the engine's part of these times
    psnr_db: float  # against `progdf.render`, the worst of three strengths

    @property
    def rest_ms(self) -> float:
        """Median time outside the engine: panel, events and the transfer to the screen, ms."""
        pairs = zip(self.events_ms, self.parts, strict=True)
        return float(np.median([event - part.total_ms for event, part in pairs]))


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure slider events, for docs/speed-and-error.md.

    Args:
        scenes: .ply files that replace the bears

    Raises:
        ProgdfError: OpenGL is not available, or a file is broken.
    """
    opened = scenes_of(scenes)
    ctx = headless_context()
    try:
        results: list[SliderTimes] = []
        for case in CASES:
            results += rows(ctx, _fitting(opened, case.members), case)
        return [table(results, str(ctx.info["GL_RENDERER"]))]
    finally:
        ctx.release()


@one_thread()
def rows(
    ctx: moderngl.Context,
    scene: Gaussians,
    case: SliderCase,
    steps: int = STEPS,
    size: tuple[int, int] = SIZE,
) -> list[SliderTimes]:
    """Measure one edit with every renderer, in turns at each step."""
    gdf = edit_for(scene, case.members, case.moves)
    case = replace(case, members=len(gdf.region))
    layers = (LayerState(0, "edit", 0.05),)
    view = ViewState(first_camera(scene), layers, dynamic_resolution="off")
    events: dict[str, list[float]] = {way: [] for way in RENDERERS}
    processor: dict[str, list[float]] = {way: [] for way in RENDERERS}
    parts: dict[str, list[FrameTimings]] = {way: [] for way in RENDERERS}
    with ExitStack() as held:
        mice: dict[str, Mouse] = {}
        for name in RENDERERS:
            engine = ViewEngine(ctx, scene, [gdf], name)
            held.callback(engine.release)
            mice[name] = held.enter_context(Mouse(ctx, engine, scene, [gdf], view, size))
            mice[name].grip_slider()
        for step in range(1, WARM_UP + steps + 1):
            place = slider_at(mice["cpu"].pixels[0], 0, 0.05 + 0.9 * step / (WARM_UP + steps))
            for name, mouse in mice.items():
                events[name].append(mouse.move(*place))
                processor[name].append(mouse.processor_ms)
                parts[name].append(mouse.main_view.canvas.timings)
        return [
            SliderTimes(
                case,
                len(scene),
                name,
                tuple(events[name][WARM_UP:]),
                tuple(processor[name][WARM_UP:]),
                tuple(parts[name][WARM_UP:]),
                _psnr(mouse.engine, view, size),
            )
            for name, mouse in mice.items()
        ]


def table(results: Sequence[SliderTimes], renderer: str) -> Table:
    """Make the table of measurements; `renderer` names the OpenGL driver."""
    note = (
        f"OpenGL by {renderer}. Simulated input drags the slider of a window without a screen. Wall clock, "
        "after the GPU has finished; the parts are medians. Processor: of all cores. The CPU rasterizer "
        "sorts as it draws."
    )
    rows = [_cells(result) for result in results]
    return Table.of("viewer", "Slider event to finished pixels, 640×480, ms", rows, note)


def _cells(result: SliderTimes) -> dict[str, str]:
    p50, p95 = np.percentile(result.events_ms, (50, 95))
    parts = {name: np.median([getattr(part, f"{name}_ms") for part in result.parts]) for name in PARTS}
    return {
        "Gaussians": group_digits(result.count),
        "members": group_digits(result.case.members),
        "edit of": result.case.title,
        "drawn by": RENDERERS[result.way],
        **{Wall(name): f"{part:.1f}" for name, part in parts.items()},
        Wall("panel, screen"): f"{result.rest_ms:.1f}",
        Wall("in all p50 / p95"): f"**{p50:.1f}** / {p95:.1f}",
        "processor": f"{np.median(result.processor_ms):.1f}",
        "PSNR to the CPU engine, dB": "exact" if math.isinf(result.psnr_db) else f"{result.psnr_db:.0f}",
    }


def _fitting(scenes: Sequence[Gaussians], members: int) -> Gaussians:
    """Return the smallest scene with at least 90 % of `members` Gaussians, else the largest."""
    return next((scene for scene in scenes if len(scene) >= 0.9 * members), scenes[-1])


def _psnr(engine: ViewEngine, view: ViewState, size: tuple[int, int]) -> float:
    worst = math.inf
    for strength in (0.0, 0.5, 1.0):
        moved = replace(view, layers=(LayerState(0, "edit", strength),))
        image = engine.image(moved, size)
        target = render(engine.gaussians(moved), to_camera(moved.camera, *size)).image
        worst = min(worst, psnr(torch.from_numpy(image), target))
    return worst
