"""The benchmark `window`: load of the idle window, and memory leaks while a slider is dragged.

`progdf view` runs in a separate process on a virtual display, with input from xdotool. The system
provides the measurements: processor time over wall time, and resident memory after each back-and-forth drag.

    python -m benchmarks window
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.table import Table
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from viewer.ui.splash import SIZE

from . import display as bench_display
from .display import Opened
from .mouse import slider_at
from .scenes import edit_for, scenes_of

IDLE_S = 10.0  # duration of the measurement of the idle window
DRAG_S = 60.0  # duration of the drag
MEMBERS = 3_000  # Gaussians that the edit changes
SETTLED_S = 1.5  # the window is idle if it uses no processor time for this long
_MAX_WAIT_S = 60.0  # limit of waiting for the window to become idle
_SWEEP_STEPS = 40
"""Mouse steps of one sweep, one about every 1/60 s."""


@dataclass(frozen=True)
class Idle:
    """Load of an idle window."""

    state: str  # position of the mouse
    processor_s: float  # processor time of all threads, seconds
    wall_s: float  # duration of the measurement, seconds


@dataclass(frozen=True)
class Dragging:
    """Measurements of a slider dragged back and forth."""

    seconds: tuple[float, ...]  # time of each sample since the dragging began
    memory_mb: tuple[float, ...]  # resident memory, one entry per sample
    pictures: int  # number of pictures drawn
    slider_ms: tuple[float, ...]  # of the last 120 slider events to finished pixels

    @property
    def slope(self) -> float:
        """Growth of memory over the second half, MB per minute.

        Memory that fills up in the first half is not a leak. The value is the median of the slopes between
        all samples, so a single outlier does not change it.
        """
        half = len(self.seconds) // 2
        times = np.array(self.seconds[half:])
        memory = np.array(self.memory_mb[half:])
        later, sooner = np.tril_indices(len(times), -1)
        slopes = (memory[later] - memory[sooner]) / (times[later] - times[sooner])
        return 60.0 * float(np.median(slopes)) if len(slopes) else 0.0


def tables(scenes: Sequence[Path] = (), seconds: float = DRAG_S) -> list[Table]:
    """Measure the idle and the dragged window, for docs/benchmarks.md.

    Args:
        scenes: .ply files, of which the smallest replaces the bear
        seconds: duration of the dragging

    Raises:
        ProgdfError: Xvfb or xdotool is not installed, or the window does not open.
    """
    scene = scenes_of(scenes)[0]
    return [table(idle(scene), dragged(scene, seconds), len(scene))]


def idle(scene: Gaussians, wall_s: float = IDLE_S) -> list[Idle]:
    """Measure an edit at strength 0.5 with the mouse still over the picture, then over the edit's slider."""
    measured = []
    with _window(scene) as opened:
        for state, position in (
            ("the mouse over the picture", (400.0, 400.0)),
            ("the mouse over a slider", slider_at(SIZE[0], 0, 0.5)),
        ):
            opened.xdotool("mousemove", "--window", opened.name, *map(round, position))
            measured.append(_rested(opened, state, wall_s))
    return measured


def dragged(scene: Gaussians, seconds: float = DRAG_S) -> Dragging:
    """Drag the slider of an edit back and forth without a pause, with a release at every reversal."""
    moments: list[float] = []
    memory: list[float] = []
    with _window(scene) as opened:
        began = time.monotonic()
        while (now := time.monotonic() - began) < seconds:
            moments.append(now)
            memory.append(opened.memory_mb())
            opened.xdotool(*_sweep(opened, 0.5, 1.0), *_sweep(opened, 1.0, 0.0), *_sweep(opened, 0.0, 0.5))
        moments.append(time.monotonic() - began)
        memory.append(opened.memory_mb())
    figures = opened.figures
    return Dragging(tuple(moments), tuple(memory), figures["pictures"], tuple(figures["slider_ms"]))


def table(idles: Sequence[Idle], dragging: Dragging, count: int) -> Table:
    """Make the table of the idle states and the dragging."""
    p50, p95 = np.percentile(dragging.slider_ms, (50, 95)) if dragging.slider_ms else (0.0, 0.0)
    share = [f"{100 * one.processor_s / one.wall_s:.1f} % of one core" for one in idles]
    rows = [(f"idle: {one.state}", text, "-", "-") for one, text in zip(idles, share, strict=True)]
    minutes = dragging.seconds[-1] / 60
    rows.append(
        (
            f"a slider dragged for {minutes:.1f} min, {dragging.pictures} pictures",
            f"{p50:.0f} / {p95:.0f} ms from event to pixels, p50 / p95",
            f"{dragging.memory_mb[0]:.0f} → {dragging.memory_mb[-1]:.0f}",
            f"{dragging.slope:+.2f}",
        )
    )
    return Table(
        "window",
        "The window itself: idle, and dragged for long",
        ("state", "load", "memory, MB", "MB a minute, second half"),
        tuple(rows),
        f"`progdf view` of {count} Gaussians, an edit of {MEMBERS} members, {SIZE[0]}×{SIZE[1]} on a virtual "
        "display, moved by xdotool. Idle: processor time of all threads over wall time, in ten seconds.",
    )


@contextmanager
def _window(scene: Gaussians) -> Iterator[Opened]:
    """Open the real window on `scene`, with an edit of `MEMBERS` at strength 0.5 and the keyboard focus."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_ply(folder / "scene.ply", scene)
        save_gdf(folder / "edit.gdf", edit_for(scene, MEMBERS, moves=True))
        arguments = [folder / "scene.ply", folder / "edit.gdf", "--set", "edit=0.5"]
        screen_size = (SIZE[0] + 100, SIZE[1] + 100)
        with (
            bench_display.display(*screen_size) as screen,
            bench_display.window(screen, arguments, SIZE, folder) as opened,
        ):
            opened.focus()
            yield opened


def _rested(opened: Opened, state: str, wall_s: float) -> Idle:
    """Wait until the window is idle, then measure its load."""
    end = time.monotonic() + _MAX_WAIT_S
    before = -1.0
    while (now := opened.processor_s()) != before and time.monotonic() < end:
        before = now
        time.sleep(SETTLED_S)
    used = opened.processor_s()
    began = time.monotonic()
    time.sleep(wall_s)
    return Idle(state, opened.processor_s() - used, time.monotonic() - began)


def _sweep(opened: Opened, start: float, end: float) -> list[object]:
    """Return arguments of xdotool that press the handle at a strength, drag it to another and release it."""
    calls: list[object] = []
    for step in range(_SWEEP_STEPS + 1):
        x, y = slider_at(SIZE[0], 0, start + (end - start) * step / _SWEEP_STEPS)
        calls += ["mousemove", "--window", opened.name, round(x), round(y), "sleep", 1 / 60]
        calls += ["mousedown", 1] if step == 0 else []
    return [*calls, "mouseup", 1, "sleep", 1 / 60]
