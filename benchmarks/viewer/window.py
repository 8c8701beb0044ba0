"""`python -m benchmarks window`: what the window costs while nobody touches it, and whether dragging leaks.

`progdf view` runs in a process of its own on a virtual display; xdotool is the hand. What is measured is what
the system says of that process: its processor time over the wall's, its resident memory once a second.
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

IDLE_S = 10.0
DRAG_S = 60.0
MEMBERS = 3_000
SETTLED_S = 1.5
_LONGEST_S = 60.0
_SWEEP = 40
"""Steps of the mouse from one end of the slider to the other; one about every 1/60 s."""


@dataclass(frozen=True)
class Idle:
    """A window that nobody touches."""

    state: str  # where the mouse is
    processor_s: float  # time that the process has used, all threads, seconds
    wall_s: float  # in so many seconds


@dataclass(frozen=True)
class Dragging:
    """A slider dragged to and fro."""

    seconds: tuple[float, ...]  # when each sample was taken, since the dragging began
    memory_mb: tuple[float, ...]  # resident memory, one entry a sample
    pictures: int  # that were drawn
    slider_ms: tuple[float, ...]  # of the last 120 slider events to finished pixels

    @property
    def slope(self) -> float:
        """MB a minute over the second half, since what fills at the start is no leak: the median of the
        slopes between all samples, which one odd sample does not move."""
        half = len(self.seconds) // 2
        times = np.array(self.seconds[half:])
        memory = np.array(self.memory_mb[half:])
        later, sooner = np.tril_indices(len(times), -1)
        slopes = (memory[later] - memory[sooner]) / (times[later] - times[sooner])
        return 60.0 * float(np.median(slopes)) if len(slopes) else 0.0


def tables(scenes: Sequence[Path] = (), seconds: float = DRAG_S) -> list[Table]:
    """Measure, for docs/benchmarks.md.

    Args:
        scenes: .ply files of which the smallest takes the place of the bear
        seconds: how long the slider is dragged

    Raises:
        ProgdfError: Xvfb or xdotool is not installed, or the window does not open.
    """
    scene = scenes_of(scenes)[0]
    return [table(idle(scene), dragged(scene, seconds), len(scene))]


def idle(scene: Gaussians, wall_s: float = IDLE_S) -> list[Idle]:
    """An edit half way and the mouse at rest over the picture, then over the edit's slider in the panel."""
    measured = []
    with _window(scene) as opened:
        for state, place in (
            ("the mouse over the picture", (400.0, 400.0)),
            ("the mouse over a slider", slider_at(SIZE[0], 0, 0.5)),
        ):
            opened.xdotool("mousemove", "--window", opened.name, *map(round, place))
            measured.append(_rested(opened, state, wall_s))
    return measured


def dragged(scene: Gaussians, seconds: float = DRAG_S) -> Dragging:
    """The slider of an edit dragged to and fro without a pause, let go at every turn, for so long."""
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
    """Idle states, then the dragging."""
    middle, late = np.percentile(dragging.slider_ms, (50, 95)) if dragging.slider_ms else (0.0, 0.0)
    share = [f"{100 * one.processor_s / one.wall_s:.1f} % of one core" for one in idles]
    rows = [(f"idle: {one.state}", text, "-", "-") for one, text in zip(idles, share, strict=True)]
    minutes = dragging.seconds[-1] / 60
    rows.append(
        (
            f"a slider dragged for {minutes:.1f} min, {dragging.pictures} pictures",
            f"{middle:.0f} / {late:.0f} ms from event to pixels, p50 / p95",
            f"{dragging.memory_mb[0]:.0f} → {dragging.memory_mb[-1]:.0f}",
            f"{dragging.slope:+.2f}",
        )
    )
    return Table(
        "window",
        "The window itself: idle, and dragged for long",
        ("what", "load", "memory, MB", "MB a minute, second half"),
        tuple(rows),
        f"`progdf view` of {count} Gaussians, an edit of {MEMBERS} members, {SIZE[0]}×{SIZE[1]} on a virtual "
        "display, moved by xdotool. Idle: processor time of all threads over that of the wall, ten seconds.",
    )


@contextmanager
def _window(scene: Gaussians) -> Iterator[Opened]:
    """The real window on `scene`, with an edit of `MEMBERS` half way and the keyboard on it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_ply(folder / "scene.ply", scene)
        save_gdf(folder / "edit.gdf", edit_for(scene, MEMBERS, moves=True))
        arguments = [folder / "scene.ply", folder / "edit.gdf", "--set", "edit=0.5"]
        room = (SIZE[0] + 100, SIZE[1] + 100)
        with (
            bench_display.display(*room) as screen,
            bench_display.window(screen, arguments, SIZE, folder) as opened,
        ):
            opened.focus()
            yield opened


def _rested(opened: Opened, state: str, wall_s: float) -> Idle:
    """Wait until it has come to rest, then watch it."""
    end = time.monotonic() + _LONGEST_S
    before = -1.0
    while (now := opened.processor_s()) != before and time.monotonic() < end:
        before = now
        time.sleep(SETTLED_S)
    used = opened.processor_s()
    began = time.monotonic()
    time.sleep(wall_s)
    return Idle(state, opened.processor_s() - used, time.monotonic() - began)


def _sweep(opened: Opened, start: float, end: float) -> list[object]:
    """Arguments of xdotool: the handle taken at a strength, dragged to another and let go."""
    calls: list[object] = []
    for step in range(_SWEEP + 1):
        x, y = slider_at(SIZE[0], 0, start + (end - start) * step / _SWEEP)
        calls += ["mousemove", "--window", opened.name, round(x), round(y), "sleep", 1 / 60]
        calls += ["mousedown", 1] if step == 0 else []
    return [*calls, "mouseup", 1, "sleep", 1 / 60]
