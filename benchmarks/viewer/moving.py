"""`python -m benchmarks moving`: what a hand feels that turns a scene, lets it rest, clicks and selects.

Whole frames of a whole window, drawn by the CPU, from the mouse's event to finished pixels; beside them the
error of the pictures in motion, which have fewer Gaussians and pixels.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import interpolate

from benchmarks.table import Table, Wall
from progdf.demo_scenes import bear
from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.camera.view_camera import first_camera
from viewer.render.cpu_renderer import CpuRenderer
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import ViewState

from .mouse import Mouse
from .scenes import copies, scenes_of
from .training import Training, begin_training

SIZE = (980, 800)
STEPS = 60
TURN_PX = 10.0
WARM_UP = 3
MILLION = 1_000_000
JUDGED = 6
TRAINED = 24_000
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_POLL_S = 0.02
_SETTLE_S = 3.0
_LONGEST_S = 20.0
_UNDER_WAY_S = 0.2  # a training that goes on has its threads at work


@dataclass(frozen=True)
class Moving:
    """One scene in the hand; times in ms."""

    count: int  # Gaussians
    turning: tuple[float, ...]  # frames while the picture turns
    beside: tuple[float, ...]  # the same while a training runs
    sharp: float  # from the last of these to the picture in full, the hand at rest on the button
    meanwhile: float  # the longest frame until then
    processor: float  # that a turning frame takes of all cores, the median
    build: float  # the pyramid of which moving pictures are drawn, s of the processor
    memory: float  # its bytes over those of the scene that is drawn
    # click, lasso: the longest frame of a click on the picture; of letting go of a lasso
    click: float
    lasso: float
    full: float  # the picture in full
    db: float  # PSNR of the pictures in motion to those in full, the worst
    luminance: float  # difference of their means, the largest, of the full one's


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure, for docs/speed-and-error.md.

    Args:
        scenes: .ply files that take the place of the bears; the largest is laid over itself up to a million

    Raises:
        ProgdfError: there is no OpenGL here, or a file is broken.
    """
    opened = scenes_of(scenes)
    if len(opened[-1]) < MILLION:
        opened.append(copies(opened[-1], round(MILLION / len(opened[-1]))))
    ctx = headless_context()
    try:
        with begin_training(bear(TRAINED).gaussians) as training:
            return [table([measure(ctx, scene, training) for scene in opened])]
    finally:
        ctx.release()


@one_thread()
def measure(
    ctx: moderngl.Context,
    scene: Gaussians,
    training: Training,
    steps: int = STEPS,
    size: tuple[int, int] = SIZE,
) -> Moving:
    """A hand at a window that shows `scene`, always with pictures in motion; at times beside a training."""
    engine = ViewEngine(ctx, scene, (), "cpu")
    view = ViewState(first_camera(scene), dynamic_resolution="on")
    with Mouse(ctx, engine, scene, (), view, size) as mouse:
        build, memory = _pyramid(mouse)
        mouse.grip_picture()
        mouse.turn(TURN_PX)
        mouse.wait_sharp()  # the hand's first rest, which tells how fine is fine enough
        turning = []
        processor = []
        beside = []
        db = math.inf
        luminance = 0.0
        for step in range(-WARM_UP, steps):
            turning.append(mouse.turn(TURN_PX))
            processor.append(mouse.processor_ms)
            if step >= 0 and step % max(steps // JUDGED, 1) == 0:
                error, apart = _compare(mouse, scene)
                db = min(db, error)
                luminance = max(luminance, apart, key=abs)
                with training.runs():
                    time.sleep(_UNDER_WAY_S)
                    mouse.turn(TURN_PX)
                    beside += [mouse.turn(TURN_PX) for _ in range(max(steps // JUDGED, 1))]
                mouse.turn(TURN_PX)
        began = time.perf_counter()
        meanwhile = _rest(mouse, began - 1e-3 * turning[-1], until_sharp=True)
        sharp = 1e3 * (time.perf_counter() - began)
        full = mouse.main_view.canvas.timings.total_ms
        mouse.release()
        mouse.frame(seconds=1.0)
        click = max(mouse.press(), mouse.release(), mouse.frame(), _rest(mouse, time.perf_counter()))
        held = mouse.main_view.work.view
        mouse.main_view.change(replace(held, select=replace(held.select, tool="lasso")))
        _rest(mouse, time.perf_counter())
        middle = (size[0] / 2, size[1] / 2)
        reach = 0.25 * min(size)
        mouse.move(middle[0], middle[1] - reach)
        mouse.press()
        for turn in np.linspace(0.0, 2.0 * np.pi, 40):
            mouse.move(middle[0] + reach * np.sin(turn), middle[1] - reach * np.cos(turn))
        lasso = max(mouse.release(), _rest(mouse, time.perf_counter()))
    engine.release()
    turned = tuple(turning[WARM_UP:])
    used = float(np.median(processor[WARM_UP:]))
    return Moving(
        count=len(scene),
        turning=turned,
        beside=tuple(beside),
        sharp=sharp,
        meanwhile=meanwhile,
        processor=used,
        build=build,
        memory=memory,
        click=click,
        lasso=lasso,
        full=full,
        db=db,
        luminance=luminance,
    )


def table(results: Sequence[Moving]) -> Table:
    """A row a scene."""
    rows = []
    for result in results:
        alone, beside = (np.percentile(frames, (50, 95)) for frames in (result.turning, result.beside))
        rows.append(
            {
                "Gaussians": group_digits(result.count),
                Wall("picture in full"): f"{result.full:.0f}",
                Wall("frame while turning p50 / p95"): f"**{alone[0]:.0f}** / {alone[1]:.0f}",
                "of the processor": f"{result.processor:.0f}",
                Wall("beside a training"): f"{beside[0]:.0f} / {beside[1]:.0f}",
                Wall("sharp after (longest frame)"): f"{result.sharp:.0f} ({result.meanwhile:.0f})",
                Wall("click"): f"{result.click:.0f}",
                Wall("lasso let go"): f"{result.lasso:.0f}",
                Wall("PSNR while turning, dB"): f"{result.db:.1f}",
                Wall("luminance while turning"): f"{100 * result.luminance:+.2f} %",
                "pyramid, s of the processor": f"{result.build:.2f}",
                "its memory, of the scene's": f"{result.memory:.2f}",
            }
        )
    return Table.of(
        "moving",
        f"A scene in the hand without a graphics card, {SIZE[0]}×{SIZE[1]}, ms",
        rows,
        "Whole frames, from the mouse's event to finished pixels of picture and panel; each step of "
        f"{STEPS} turns three degrees. The errors are the worst of {JUDGED} pictures, on white, as they are "
        "shown: stretched smoothly. The pyramid is built before.",
    )


def _compare(mouse: Mouse, scene: Gaussians) -> tuple[float, float]:
    """PSNR of the last picture to the one in full, and the relative difference of their luminance."""
    view, (width, height) = mouse.main_view.work.view, mouse.size
    drawn = torch.from_numpy(mouse.engine.renderer.pixels().clip(0.0, 1.0)).movedim(2, 0)[None]
    moving = interpolate(drawn, (height, width), mode="bilinear")[0].movedim(0, 2).numpy()
    full: NDArray[np.float32] = ViewEngine(None, scene).image(view, mouse.size).clip(0.0, 1.0)
    error = psnr(torch.from_numpy(moving), torch.from_numpy(full))
    return error, float((moving @ _LUMINANCE).mean() / (full @ _LUMINANCE).mean()) - 1.0


def _pyramid(mouse: Mouse) -> tuple[float, float]:
    """Build the pyramid once more, when the window's own stands: seconds of the processor, and its bytes over
    those of the scene that is drawn."""
    mouse.wait_pyramid()
    assert isinstance(mouse.engine.renderer, CpuRenderer)
    drawn = mouse.engine.renderer._scene.drawn
    began = time.process_time()
    nodes = Pyramid(drawn).nodes
    seconds = time.process_time() - began
    arrays = nodes.means, nodes.shapes, nodes.order
    held = sum(tensor.numel() * tensor.element_size() for tensor in drawn.tensors)
    return seconds, sum(array.nbytes for array in arrays) / held


def _rest(mouse: Mouse, last: float, until_sharp: bool = False) -> float:
    """Frames while the hand rests, as the window draws them; the longest one, ms.

    Args:
        last: when the last frame began
    """
    began = time.perf_counter()
    longest = 0.0
    while time.perf_counter() - began < (_LONGEST_S if until_sharp else _SETTLE_S):
        if until_sharp and mouse.main_view.canvas.pixels == 1:
            break
        if mouse.main_view.is_due():
            now = time.perf_counter()
            longest = max(longest, mouse.frame(seconds=now - last, event=not until_sharp))
            last = now
        wait = mouse.main_view.next_frame_delay()
        time.sleep(_POLL_S if wait is None else min(wait, _POLL_S))
    return longest
