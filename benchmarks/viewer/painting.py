"""The benchmark `painting`: response times of the color brush.

It times whole frames of a whole window, drawn by the CPU, from the mouse's event to finished pixels.

    python -m benchmarks painting
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import moderngl
import numpy as np

from benchmarks.table import Table
from progdf.gaussians import Gaussians
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.camera.view_camera import first_camera
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import ColorBrush, ViewState

from .mouse import Mouse
from .scenes import scenes_of

SIZE = (980, 800)  # pixels
DABS = 60  # measured dabs of a stroke
TURNS = 30  # measured frames of an orbit with paint
TURN_PX = 6.0  # mouse movement from one frame to the next, pixels
WARM_UP = 3  # frames before the measured ones
RADII_PX = (20.0, 80.0)
_STROKE_PX = 140.0  # radius of the stroke, which is a spiral around the middle of the picture
_REST_S = 3.0  # duration of drawing before and after a stroke


@dataclass(frozen=True)
class PaintingTimes:
    """Response times of one scene and brush, ms."""

    count: int  # Gaussians
    radius: float  # of the brush, pixels
    press: float  # first dab, with the surface computed while the window rested
    dabs: tuple[float, ...]  # further dabs
    processor: float  # median processor time of a further dab, all cores
    release: float  # end of the stroke
    turning: tuple[float, ...]  # frames while orbiting with the paint


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure the color brush, for docs/speed-and-error.md.

    Args:
        scenes: scene files that replace the bears

    Raises:
        ProgdfError: a file is missing or broken.
    """
    context = headless_context()
    results = [measure(context, scene, radius) for scene in scenes_of(scenes) for radius in RADII_PX]
    context.release()
    rows = tuple(
        (
            group_digits(one.count),
            f"{one.radius:g}",
            f"{one.press:.0f}",
            f"**{np.median(one.dabs):.0f}** / {np.quantile(one.dabs, 0.95):.0f}",
            f"{one.processor:.0f}",
            f"{one.release:.0f}",
            f"{np.median(one.turning):.0f} / {np.quantile(one.turning, 0.95):.0f}",
        )
        for one in results
    )
    columns = (
        "Gaussians",
        "radius, pixels",
        "first dab",
        "further dabs p50 / p95",
        "processor time of a dab",
        "end of the stroke",
        "frame while turning with paint p50 / p95",
    )
    note = (
        f"Whole frames, from the mouse's event to finished pixels of picture and panel. A stroke has {DABS} "
        "dabs on a spiral, each joined to the one before. The surface is computed while the window rests "
        "before the stroke."
    )
    title = f"The color brush without a graphics card, {SIZE[0]}×{SIZE[1]}, ms"
    return [Table("painting", title, columns, rows, note)]


@one_thread()
def measure(
    context: moderngl.Context, scene: Gaussians, radius: float, size: tuple[int, int] = SIZE
) -> PaintingTimes:
    """Measure one stroke, and an orbit with its paint.

    Args:
        context: GL context of the window
        scene: the scene
        radius: radius of the brush, pixels
        size: size of the picture, pixels
    """
    engine = ViewEngine(context, scene, (), "cpu")
    view = ViewState(camera=first_camera(scene), axes=False, color_brush=ColorBrush("color", radius=radius))
    with Mouse(context, engine, scene, (), view, size) as mouse:
        mouse.rest(_REST_S)
        path = _spiral(size)
        mouse.move(*path[0])
        press = mouse.press()
        times = []
        processor = []
        for at in path[1:]:
            times.append(mouse.move(*at))
            processor.append(mouse.processor_ms)
        release = mouse.release()
        mouse.rest(_REST_S)
        work = mouse.main_view.work
        brush = replace(work.view.color_brush, tool="")
        mouse.main_view.store.change(replace(work.view, color_brush=brush))
        mouse.grip_picture()
        turning = [mouse.turn(TURN_PX) for _ in range(WARM_UP + TURNS)]
        mouse.release()
    engine.release()
    return PaintingTimes(
        count=len(scene),
        radius=radius,
        press=press,
        dabs=tuple(times[WARM_UP:]),
        processor=float(np.median(processor[WARM_UP:])),
        release=release,
        turning=tuple(turning[WARM_UP:]),
    )


def _spiral(size: tuple[int, int]) -> list[tuple[float, float]]:
    """Return the positions of a stroke around the middle of the picture, pixels."""
    reach = min(_STROKE_PX, 0.3 * min(size))
    positions = []
    for k in range(1 + WARM_UP + DABS):
        share = k / (WARM_UP + DABS)
        angle = 4.0 * math.pi * share
        x = size[0] / 2 + reach * share * math.cos(angle)
        y = size[1] / 2 + reach * share * math.sin(angle)
        positions.append((round(x, 1), round(y, 1)))
    return positions
