"""The benchmark `frames`: frame time while orbiting, and time to the first picture.

A mouse orbits the picture of a whole window, and every frame is drawn in its own depth order. The two
renderers take turns at every step, in one process. The time of a picture that is coarse while it moves is
given beside its error. The first picture is that of `progdf view` on a virtual display, timed from the start
of the process.

    python -m benchmarks frames
"""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.table import Table, Wall
from progdf.formats.ply import save_ply
from progdf.metrics.image import psnr
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.camera.view_camera import first_camera
from viewer.files import document as documents
from viewer.panel.panel import WIDTH_PX
from viewer.render.dynamic_resolution import COARSE_PIXELS
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import ViewState

from . import display as bench_display
from .mouse import SIZE, Mouse
from .scenes import COPIES, RENDERERS, copies, scenes_of

WARM_UP = 2  # frames before the measured ones
STEPS = 20  # measured frames of an orbit
STARTS = 3  # measured starts of the program
KEPT = 4  # frames of an orbit whose pictures are checked
MIN_STEPS = 3  # smallest number of measured frames
TURN_S = 20.0  # limit for all frames of one orbit, but at least `MIN_STEPS` frames are measured
STARTS_S = 30.0  # limit for all measured starts

MAX_COPIED = 1_000_000
"""Largest number of Gaussians for copies of the largest scene."""

TURN_PX = 10.0
"""Mouse movement from one frame to the next, pixels; it orbits by three degrees."""


@dataclass(frozen=True)
class OrbitTimes:
    """Times of orbiting one scene with one renderer; `frames_ms`, `draws_ms`, `coarse_ms` are per frame."""

    count: int  # Gaussians in the scene
    way: str  # a key of `RENDERERS`
    frames_ms: tuple[float, ...]  # from the mouse's event to finished pixels of the whole window
    draws_ms: tuple[float, ...]  # sorting and drawing of the picture
    # checked, wrong: number of pictures that were drawn again from scratch, and of those that differ
    checked: int
    wrong: int
    opened_s: float  # from a file opened in the running window to its first picture
    coarse_ms: tuple[float, ...]  # whole frames again, coarse while they move
    # processor_ms, coarse_processor_ms: median processor time of the same frames, all cores together
    processor_ms: float
    coarse_processor_ms: float
    coarse_db: float  # worst PSNR of the coarse pictures against the full ones
    at_rest: int  # largest difference from the full picture after input stops, of 255


@dataclass(frozen=True)
class Start:
    """Start of `progdf view` in a separate process; medians."""

    first_s: float  # from the start of the process to the first picture on the screen
    imports_s: float  # part of `first_s` until the program and its libraries are imported
    memory_mb: float  # peak memory until then


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure frames and starts, for docs/speed-and-error.md.

    Args:
        scenes: .ply files that replace the bears; the largest is also copied over itself four times unless
            that makes more than `MAX_COPIED` Gaussians

    Raises:
        ProgdfError: OpenGL is not available, or a file is broken.
    """
    opened = scenes_of(scenes)
    if COPIES * len(opened[-1]) <= MAX_COPIED:
        opened.append(copies(opened[-1]))
    ctx = headless_context()
    try:
        renderer = str(ctx.info["GL_RENDERER"])
        with tempfile.TemporaryDirectory() as folder:
            turnings: list[OrbitTimes] = []
            starts: list[Start] = []
            for scene in opened:
                path = Path(folder) / "scene.ply"
                save_ply(path, scene)
                turnings += measure_turning(ctx, path)
                starts += (
                    [] if bench_display.missing_tools() else [measure_starts(path, way) for way in RENDERERS]
                )
    finally:
        ctx.release()
    return [frames_table(turnings, starts, renderer), coarse_table(turnings, renderer)]


@one_thread()
def measure_turning(
    ctx: moderngl.Context, path: Path, steps: int = STEPS, size: tuple[int, int] = SIZE
) -> list[OrbitTimes]:
    """Open a scene's file and orbit it with the mouse, with the renderers in turns; then again, coarse."""
    results = []
    with ExitStack() as held:
        nothing = documents.load(path).scene[:0]
        mice: dict[str, Mouse] = {}
        opened_s: dict[str, float] = {}
        for way in RENDERERS:
            empty = ViewEngine(ctx, nothing, (), way)
            mice[way] = held.enter_context(
                Mouse(ctx, empty, nothing, (), ViewState(dynamic_resolution="off"), size)
            )
            _open(mice[way], path, way)
            empty.release()
            first = mice[way].engine
            opened_s[way] = _open(mice[way], path, way)  # the window has drawn before
            first.release()
            held.callback(mice[way].engine.release)
        full = _turn(mice, steps)
        for mouse in mice.values():
            mouse.main_view.store.change(replace(mouse.main_view.work.view, dynamic_resolution="on"))
            mouse.grip_picture()
            mouse.learn_detail()
            mouse.release()
        coarse = _turn(mice, steps)
        for way, mouse in mice.items():
            wrong = sum(not np.array_equal(image, _draw_again(mouse, view)) for view, image in full[way].kept)
            errors = [_psnr(image, _draw_again(mouse, view)) for view, image in coarse[way].kept]
            results.append(
                OrbitTimes(
                    count=mouse.main_view.facts.count,
                    way=way,
                    frames_ms=tuple(full[way].frames_ms[WARM_UP:]),
                    draws_ms=tuple(full[way].draws_ms[WARM_UP:]),
                    checked=len(full[way].kept),
                    wrong=wrong,
                    opened_s=opened_s[way],
                    coarse_ms=tuple(coarse[way].frames_ms[WARM_UP:]),
                    processor_ms=float(np.median(full[way].processor_ms[WARM_UP:])),
                    coarse_processor_ms=float(np.median(coarse[way].processor_ms[WARM_UP:])),
                    coarse_db=min(errors),
                    at_rest=_at_rest(mouse),
                )
            )
    return results


def measure_starts(path: Path, way: str, times: int = STARTS, size: tuple[int, int] = SIZE) -> Start:
    """Start `progdf view --draw` on a scene's file up to `times` times, after one start that fills the
    caches.

    Raises:
        ProgdfError: Xvfb or xdotool is not installed, or the window does not open.
    """
    figures: list[dict[str, float]] = []
    window_size = (size[0] + round(WIDTH_PX), size[1])
    with bench_display.display() as screen, tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        while len(figures) < 2 or (len(figures) <= times and time.monotonic() - began < STARTS_S):
            arguments = [path, "--draw", way]
            with bench_display.window(screen, arguments, window_size, Path(folder), leave=True) as opened:
                figures.append(opened.figures)
    names = ("first_s", "imports_s", "memory_mb")
    return Start(*(statistics.median(figure[name] for figure in figures[1:]) for name in names))


def frames_table(turnings: Sequence[OrbitTimes], starts: Sequence[Start], renderer: str) -> Table:
    """Make the table of frames while orbiting and of first pictures. `starts`: one per entry, or none."""
    rows = []
    for i, result in enumerate(turnings):
        p50, p95 = np.percentile(result.frames_ms, (50, 95))
        start = starts[i] if starts else None
        rows.append(
            {
                "Gaussians": group_digits(result.count),
                "drawn by": RENDERERS[result.way],
                Wall("sort and draw, ms"): f"{np.median(result.draws_ms):.1f}",
                Wall("whole frame p50 / p95, ms"): f"**{p50:.1f}** / {p95:.1f}",
                "processor time, ms": f"{result.processor_ms:.1f}",
                "identical when redrawn": f"{result.checked - result.wrong} of {result.checked}",
                Wall("first picture of an opened file, s"): f"{result.opened_s:.2f}",
                Wall("of `progdf view`, s (imports)"): "-"
                if start is None
                else f"{start.first_s:.2f} ({start.imports_s:.2f})",
                "peak memory until then, MB": "-" if start is None else f"{start.memory_mb:.0f}",
            }
        )
    return Table.of(
        "frames",
        "Frames while orbiting, 640×480, and the first picture",
        rows,
        f"OpenGL by {renderer}. Every frame orbits three degrees and has its own exact depth order. A whole "
        "frame goes from the mouse's event to finished pixels of picture and panel. A file is opened in an "
        "existing window; `progdf view` counts from the start of its process, with kernels compiled before.",
    )


def coarse_table(turnings: Sequence[OrbitTimes], renderer: str) -> Table:
    """Make the table of pictures that are coarse while they move, with their errors in motion and at rest."""
    rows = []
    for result in turnings:
        full = np.median(result.frames_ms)
        coarse = np.median(result.coarse_ms)
        rows.append(
            {
                "Gaussians": group_digits(result.count),
                "drawn by": RENDERERS[result.way],
                Wall("frame in full, ms"): f"{full:.1f}",
                Wall("coarse, ms"): f"{coarse:.1f}",
                Wall("ratio"): f"{full / coarse:.1f}×",
                "processor time, ms: full / coarse": " / ".join(
                    f"{ms:.1f}" for ms in (result.processor_ms, result.coarse_processor_ms)
                ),
                Wall("PSNR while moving, dB"): f"{result.coarse_db:.1f}",
                "difference at rest, of 255": str(result.at_rest),
            }
        )
    return Table.of(
        "coarse",
        "A picture that is coarse while it moves, 640×480",
        rows,
        f"OpenGL by {renderer}. Medians of whole frames while orbiting; one pixel drawn fills "
        f"{COARSE_PIXELS}×{COARSE_PIXELS} of the window. The error is the worst of {KEPT} frames.",
    )


@dataclass
class _Turned:
    """Frames of one orbit, and some of the view states with their pictures."""

    frames_ms: list[float] = field(default_factory=list)
    draws_ms: list[float] = field(default_factory=list)
    processor_ms: list[float] = field(default_factory=list)
    kept: list[tuple[ViewState, NDArray[np.uint8]]] = field(default_factory=list)


def _open(mouse: Mouse, path: Path, way: str) -> float:
    """Open a file as if dropped on the window; return the seconds to its first picture."""
    began = time.perf_counter()
    document = documents.load(path)
    mouse.engine = ViewEngine(mouse.main_view.context, document.scene, (), way)
    mouse.main_view.set_engine(mouse.engine, document.facts())
    mouse.main_view.restart(replace(mouse.main_view.work.view, camera=first_camera(document.scene)))
    mouse.frame()
    return time.perf_counter() - began


def _turn(mice: Mapping[str, Mouse], steps: int) -> dict[str, _Turned]:
    """Orbit every mouse's picture, one frame each in turns, for up to `steps` frames (see `TURN_S`)."""
    turns = {way: _Turned() for way in mice}
    for mouse in mice.values():
        mouse.settle()
        mouse.grip_picture()
    for step in range(-WARM_UP, steps):
        if step == 0:
            one_s = sum(turned.frames_ms[-1] for turned in turns.values()) / 1e3
            steps = affordable_steps(steps, one_s)
        elif step >= steps:
            break
        for way, mouse in mice.items():
            turns[way].frames_ms.append(mouse.turn(TURN_PX))
            turns[way].processor_ms.append(mouse.processor_ms)
            turns[way].draws_ms.append(mouse.main_view.canvas.timings.total_ms)
            if step >= 0 and (steps - 1 - step) % -(-steps // KEPT) == 0:
                turns[way].kept.append((mouse.main_view.work.view, mouse.picture()))
    for mouse in mice.values():
        mouse.release()
        mouse.settle()
    return turns


def affordable_steps(steps: int, one_s: float) -> int:
    """Return the number of `steps` that fit into `TURN_S` at `one_s` seconds each, at least `MIN_STEPS`."""
    return min(steps, max(MIN_STEPS, int(TURN_S / max(one_s, 1e-9))))


def _draw_again(mouse: Mouse, view: ViewState) -> NDArray[np.uint8]:
    """Draw `view` in full with a new engine."""
    main_view = mouse.main_view
    engine = mouse.engine
    new = ViewEngine(main_view.context, engine.scene, (), engine.draws_with)
    main_view.set_engine(new, main_view.facts)
    main_view.store.change(replace(view, dynamic_resolution="off"))
    mouse.frame()
    picture = mouse.picture()
    main_view.set_engine(engine, main_view.facts)
    new.release()
    return picture


def _at_rest(mouse: Mouse) -> int:
    """Return the largest difference from the full picture after the mouse stops with its button held."""
    mouse.main_view.store.change(replace(mouse.main_view.work.view, dynamic_resolution="on"))
    mouse.grip_picture()
    mouse.turn(TURN_PX)
    if mouse.main_view.canvas.pixels == 1:
        raise AssertionError("the picture in motion was not coarse")
    mouse.wait_sharp()
    sharp = mouse.picture()
    view = mouse.main_view.work.view
    mouse.release()
    mouse.settle()
    return int(np.abs(sharp.astype(int) - _draw_again(mouse, view)).max())


def _psnr(image: NDArray[np.uint8], target: NDArray[np.uint8]) -> float:
    drawn, expected = (torch.from_numpy(pixels).double() / 255.0 for pixels in (image, target))
    return psnr(drawn, expected)
