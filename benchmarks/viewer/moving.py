"""The benchmark `moving`: response times of orbiting, stopping, clicking and selecting.

It times whole frames of a whole window, drawn by the CPU, from the mouse's event to finished pixels. It also
measures the error of the pictures in motion, which have fewer Gaussians and pixels.

    python -m benchmarks moving
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

SIZE = (980, 800)  # pixels
STEPS = 60  # measured frames of an orbit
TURN_PX = 10.0  # mouse movement from one frame to the next, pixels
WARM_UP = 3  # frames before the measured ones
MILLION = 1_000_000
JUDGED = 6  # frames of an orbit that are compared with the full picture
TRAINED = 24_000  # Gaussians of the background training
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
_POLL_INTERVAL_S = 0.02
_SETTLE_S = 3.0  # duration of drawing after a click or a lasso
_SHARP_TIMEOUT_S = 20.0  # limit of waiting for the full picture
_TRAINING_RAMP_S = 0.2  # after this, the threads of a resumed training are busy


@dataclass(frozen=True)
class InteractionTimes:
    """Response times of one scene, ms."""

    count: int  # Gaussians
    turning: tuple[float, ...]  # frames while orbiting
    beside: tuple[float, ...]  # the same while a training runs
    sharp: float  # from the last frame in motion to the full picture, with the button held still
    meanwhile: float  # longest frame until then
    processor: float  # median processor time of a frame while orbiting, all cores
    build: float  # processor time of building the LOD pyramid of moving pictures, s
    memory: float  # bytes of the pyramid over those of the drawn scene
    click: float  # longest frame of a click on the picture
    lasso: float  # longest frame after releasing a lasso
    full: float  # the full picture
    db: float  # worst PSNR of pictures in motion against the full ones
    luminance: float  # largest relative difference of their mean luminance


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure response times in motion, for docs/speed-and-error.md.

    Args:
        scenes: .ply files that replace the bears; the largest is copied over itself up to a million Gaussians

    Raises:
        ProgdfError: OpenGL is not available, or a file is broken.
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
) -> InteractionTimes:
    """Measure a window that shows `scene`, with dynamic resolution; some frames run beside a training."""
    engine = ViewEngine(ctx, scene, (), "cpu")
    view = ViewState(first_camera(scene), dynamic_resolution="on")
    with Mouse(ctx, engine, scene, (), view, size) as mouse:
        build, memory = _pyramid(mouse)
        mouse.grip_picture()
        mouse.turn(TURN_PX)
        mouse.wait_sharp()  # the first stop calibrates the level of detail
        mouse.wait_pyramid()  # and begins the fit to full pictures
        turning = []
        processor = []
        beside = []
        db = math.inf
        luminance = 0.0
        for step in range(-WARM_UP, steps):
            turning.append(mouse.turn(TURN_PX))
            processor.append(mouse.processor_ms)
            if step >= 0 and step % max(steps // JUDGED, 1) == 0:
                error, luminance_error = _compare(mouse, scene)
                db = min(db, error)
                luminance = max(luminance, luminance_error, key=abs)
                with training.runs():
                    time.sleep(_TRAINING_RAMP_S)
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
        current = mouse.main_view.work.view
        mouse.main_view.store.change(replace(current, select=replace(current.select, tool="lasso")))
        _rest(mouse, time.perf_counter())
        middle = (size[0] / 2, size[1] / 2)
        radius = 0.25 * min(size)
        mouse.move(middle[0], middle[1] - radius)
        mouse.press()
        for angle in np.linspace(0.0, 2.0 * np.pi, 40):
            mouse.move(middle[0] + radius * np.sin(angle), middle[1] - radius * np.cos(angle))
        lasso = max(mouse.release(), _rest(mouse, time.perf_counter()))
    engine.release()
    turning_ms = tuple(turning[WARM_UP:])
    processor_ms = float(np.median(processor[WARM_UP:]))
    return InteractionTimes(
        count=len(scene),
        turning=turning_ms,
        beside=tuple(beside),
        sharp=sharp,
        meanwhile=meanwhile,
        processor=processor_ms,
        build=build,
        memory=memory,
        click=click,
        lasso=lasso,
        full=full,
        db=db,
        luminance=luminance,
    )


def table(results: Sequence[InteractionTimes]) -> Table:
    """Make a table with one row per scene."""
    rows = []
    for result in results:
        alone, beside = (np.percentile(frames, (50, 95)) for frames in (result.turning, result.beside))
        rows.append(
            {
                "Gaussians": group_digits(result.count),
                Wall("picture in full"): f"{result.full:.0f}",
                Wall("frame while turning p50 / p95"): f"**{alone[0]:.0f}** / {alone[1]:.0f}",
                "processor time": f"{result.processor:.0f}",
                Wall("beside a training"): f"{beside[0]:.0f} / {beside[1]:.0f}",
                Wall("sharp after (longest frame)"): f"{result.sharp:.0f} ({result.meanwhile:.0f})",
                Wall("click"): f"{result.click:.0f}",
                Wall("lasso released"): f"{result.lasso:.0f}",
                Wall("PSNR while turning, dB"): f"{result.db:.1f}",
                Wall("luminance while turning"): f"{100 * result.luminance:+.2f} %",
                "pyramid, processor s": f"{result.build:.2f}",
                "its memory, of the scene's": f"{result.memory:.2f}",
            }
        )
    return Table.of(
        "moving",
        f"Interaction without a graphics card, {SIZE[0]}×{SIZE[1]}, ms",
        rows,
        "Whole frames, from the mouse's event to finished pixels of picture and panel. Each of "
        f"{STEPS} steps orbits three degrees. The errors are the worst of {JUDGED} pictures on white, scaled "
        "bilinearly as on the screen. The pyramid is built before.",
    )


def _compare(mouse: Mouse, scene: Gaussians) -> tuple[float, float]:
    """Compare the last picture with the full one; return PSNR and the relative difference of luminance."""
    view, (width, height) = mouse.main_view.work.view, mouse.size
    drawn = torch.from_numpy(mouse.engine.renderer.pixels().clip(0.0, 1.0)).movedim(2, 0)[None]
    moving = interpolate(drawn, (height, width), mode="bilinear")[0].movedim(0, 2).numpy()
    full: NDArray[np.float32] = ViewEngine(None, scene).image(view, mouse.size).clip(0.0, 1.0)
    error = psnr(torch.from_numpy(moving), torch.from_numpy(full))
    return error, float((moving @ _LUMINANCE).mean() / (full @ _LUMINANCE).mean()) - 1.0


def _pyramid(mouse: Mouse) -> tuple[float, float]:
    """Build the pyramid again after the window's own is finished.

    Returns:
        Processor seconds, and the pyramid's bytes over those of the drawn scene.
    """
    mouse.wait_pyramid()
    assert isinstance(mouse.engine.renderer, CpuRenderer)
    drawn = mouse.engine.renderer._scene.drawn
    began = time.process_time()
    nodes = Pyramid(drawn).nodes
    seconds = time.process_time() - began
    arrays = nodes.means, nodes.shapes, nodes.order
    scene_bytes = sum(tensor.numel() * tensor.element_size() for tensor in drawn.tensors)
    return seconds, sum(array.nbytes for array in arrays) / scene_bytes


def _rest(mouse: Mouse, last: float, until_sharp: bool = False) -> float:
    """Draw the frames that the window draws without input; return the longest one, ms.

    Args:
        mouse: the simulated mouse
        last: start of the last frame
        until_sharp: stop at the first full picture
    """
    began = time.perf_counter()
    longest = 0.0
    while time.perf_counter() - began < (_SHARP_TIMEOUT_S if until_sharp else _SETTLE_S):
        if until_sharp and mouse.main_view.canvas.pixels == 1:
            break
        if mouse.main_view.is_due():
            now = time.perf_counter()
            longest = max(longest, mouse.frame(seconds=now - last, event=not until_sharp))
            last = now
        wait = mouse.main_view.next_frame_delay()
        time.sleep(_POLL_INTERVAL_S if wait is None else min(wait, _POLL_INTERVAL_S))
    return longest
