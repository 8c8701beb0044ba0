"""The benchmark `grading`: response times of a grade's sliders in the form of a new edit.

It times whole frames of a whole window, drawn by the CPU, from the mouse's event to finished pixels.

    python -m benchmarks grading
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.table import Table, Wall
from benchmarks.viewer.mouse import Mouse
from benchmarks.viewer.scenes import scenes_of
from progdf.color.grade import grade_fully, parse_grade
from progdf.gaussians import Gaussians
from progdf.metrics.image import psnr
from progdf.rasterize.screen import fill_screen
from progdf.sh import C0
from progdf.terminal import group_digits
from progdf.threads import one_thread
from viewer.app.grading import GradePreview
from viewer.camera.view_camera import first_camera, to_camera
from viewer.files.document import Document, DocumentStore
from viewer.jobs.preview_process import RegionSample
from viewer.pictures.film import to_pixels
from viewer.render.dynamic_resolution import FrameTimings
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.render.live_grade import drawn_colors
from viewer.state.forms import EDITORS, LOOK_PX, NewEdit, with_settings
from viewer.state.view_state import ViewState

SIZE = (980, 800)  # pixels
STEPS = 60  # measured frames of a drag
WARM_UP = 6  # frames before the measured ones
_REST_S = 3.0  # limit of waiting for the sharp picture
GRADES = {
    "one slider": "",
    "all sections": "contrast=0.30,shadows=0.30,highlights=-0.30,temperature=0.20,vibrance=0.30,"
    "wheel_shadows=210:0.30:0.10,curve=0.30:0.20+0.70:0.80,curve_red=0.50:0.55",
}
"""Settings of the form while its exposure is dragged, by name."""

EXPOSURE = (-1.0, 2.0)
"""Lowest and highest exposure of the drag, stops."""

# the form's layout at 1×, pixels
_EXPOSURE_Y = 333.0
_SLIDER = (102.0, 277.0)  # ends of the slider from the panel's left edge


@dataclass(frozen=True)
class GradingTimes:
    """Response times of one scene and one grade, ms."""

    count: int  # Gaussians, all of them graded
    grade: str  # a key of `GRADES`
    frames: tuple[float, ...]  # from the mouse's event to finished pixels of the whole window
    processor: float  # median processor time of a frame, all cores
    drawing: float  # median share of the picture in it
    parts: tuple[FrameTimings, ...]  # of the pictures in these frames
    moving_db: float  # PSNR of the last picture in motion against the exact one
    rest_db: float  # PSNR of the picture at rest against the exact one


def tables(scenes: Sequence[Path] = ()) -> list[Table]:
    """Measure the sliders of a grade, for docs/speed-and-error.md.

    Args:
        scenes: scene files that replace the bears

    Raises:
        ProgdfError: a file is missing or broken.
    """
    context = headless_context()
    results = [measure(context, scene, grade) for scene in scenes_of(scenes) for grade in GRADES]
    context.release()
    return [table(results)]


def table(results: Sequence[GradingTimes]) -> Table:
    """Make the table of the grades."""
    rows = []
    for one in results:
        p50, p95 = np.quantile(one.frames, (0.5, 0.95))
        rows.append(
            {
                "Gaussians": group_digits(one.count),
                "settings": one.grade,
                Wall("whole frame p50 / p95"): f"**{p50:.0f}** / {p95:.0f}",
                "processor time of a frame": f"{one.processor:.0f}",
                "of which grading and drawing": f"{one.drawing:.0f}",
                "PSNR while dragging, dB": f"{one.moving_db:.1f}",
                "PSNR at rest, dB": f"{one.rest_db:.1f}",
            }
        )
    return Table.of(
        "grading",
        f"A slider of a grade without a graphics card, {SIZE[0]}×{SIZE[1]}, ms",
        rows,
        "Whole frames, from the mouse's event to finished pixels of picture, histogram and panel. The "
        f"exposure of the whole scene is dragged in {STEPS} steps. Errors are against the scene whose base "
        "colors are graded one by one.",
    )


@one_thread()
def measure(
    context: moderngl.Context,
    scene: Gaussians,
    grade: str,
    steps: int = STEPS,
    size: tuple[int, int] = SIZE,
) -> GradingTimes:
    """Drag the exposure slider of the form.

    Args:
        context: GL context of the window
        scene: the scene, all of which is graded
        grade: a key of `GRADES`
        steps: measured frames
        size: size of the picture, pixels
    """
    engine = ViewEngine(context, scene, (), "cpu")
    camera = first_camera(scene)
    editor = next(i for i, choice in enumerate(EDITORS) if choice.kind == "grade")
    form = NewEdit(editor=editor, folded=("Looks", "Color", "Palette", "Wheels", "Curve"))
    if GRADES[grade]:
        form = replace(with_settings(form, f"grade:{GRADES[grade]}") or form, folded=form.folded)
    frames = []
    processor = []
    parts = []
    with Mouse(context, engine, scene, (), ViewState(camera=camera, axes=False), size) as mouse:
        main_view = mouse.main_view
        preview = GradePreview(
            store=main_view.store,
            documents=DocumentStore(Document("scene.ply", scene), lambda *_: None),
            messages=main_view.messages,
            context=context,
            engine=lambda: engine,
        )
        main_view.store.replace(replace(main_view.work, form=form, form_open=True))
        for _ in range(3):
            mouse.frame()
        preview.take(_sample(scene), (), preview.region_key())
        mouse.wait_pyramid()
        mouse.move(*_slider_at(size, EXPOSURE[0]))
        mouse.press()
        draw = engine.renderer.draw
        drawing: list[float] = []

        def timed_draw(*arguments: Any) -> None:
            used = time.process_time()
            draw(*arguments)
            drawing.append(1e3 * (time.process_time() - used))

        engine.renderer.draw = timed_draw  # type: ignore[assignment, method-assign]
        for step in range(WARM_UP + steps):
            preview.update()  # the change of the last frame is in the next one
            frames.append(mouse.move(*_slider_at(size, _exposure(step, steps))))
            processor.append(mouse.processor_ms)
            parts.append(main_view.canvas.timings)
        preview.update()
        mouse.frame()
        moving = _picture(engine, size)
        mouse.release()
        preview.update()
        mouse.rest(_REST_S)
        rest = _picture(engine, size)
        settings = main_view.work.form.spec.partition(":")[2]
        preview.close()
    exact = _exact(scene, settings, size)
    engine.release()
    return GradingTimes(
        len(scene),
        grade,
        tuple(frames[WARM_UP:]),
        float(np.median(processor[WARM_UP:])),
        float(np.median(drawing[WARM_UP:])),
        tuple(parts[WARM_UP:]),
        _psnr(moving, exact),
        _psnr(rest, exact),
    )


def _sample(scene: Gaussians) -> RegionSample:
    """Return a sample of the scene's colors, for the histogram."""
    rows = np.arange(len(scene))
    colors = (scene.sh0[:: -(-len(scene) // 4096)] * C0 + 0.5).numpy()
    pixels = np.full((*LOOK_PX[::-1], 3), 0.5, np.float32)
    shares = np.ones(len(colors), np.float32)
    return RegionSample(rows, colors, shares, pixels, pixels, np.ones(LOOK_PX[::-1], np.float32))


def _exposure(step: int, steps: int) -> float:
    """Return the exposure of a step, up and down again, stops."""
    share = 1.0 - abs(2.0 * step / (WARM_UP + steps) - 1.0)
    return EXPOSURE[0] + share * (EXPOSURE[1] - EXPOSURE[0])


def _slider_at(size: tuple[int, int], exposure: float) -> tuple[float, float]:
    """Return the window position of an exposure on its slider, pixels."""
    share = (exposure + 5.0) / 10.0
    return size[0] + _SLIDER[0] + share * (_SLIDER[1] - _SLIDER[0]), _EXPOSURE_Y


def _exact(scene: Gaussians, settings: str, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the picture of the scene whose colors are graded one by one. [H,W,3]"""
    camera = to_camera(first_camera(scene), *size)
    rows = torch.arange(len(scene))
    before = drawn_colors(scene, rows, camera.position)
    after = grade_fully(before, parse_grade(settings))
    sh0 = scene.sh0 + ((after - before) / C0).to(scene.sh0)
    engine = ViewEngine(None, replace(scene, sh0=sh0), (), "cpu")
    image = engine.image(ViewState(camera=first_camera(scene)), size)
    engine.release()
    return to_pixels(image)


def _picture(engine: ViewEngine, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the last picture in pixels of the window, without panel and tools. [H,W,3]"""
    screen = np.empty((size[1], size[0], 4), np.uint8)
    fill_screen(engine.renderer.pixels(), screen)
    return screen[::-1, :, :3]


def _psnr(image: NDArray[np.uint8], target: NDArray[np.uint8]) -> float:
    drawn, expected = (torch.from_numpy(pixels.copy()).double() / 255.0 for pixels in (image, target))
    return psnr(drawn, expected)
