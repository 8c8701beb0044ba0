"""Dynamic resolution: fewer pixels and Gaussians during motion, a full picture once input stops."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import ActivatedGaussians
from progdf.rasterize.cpu.compilation import compile_elsewhere, is_compiled, mark_compiled
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.rasterize.cpu.pyramid_fit import fit_pyramid
from progdf.rasterize.screen import fill_screen
from progdf.sh import C0
from progdf.system.equality import equal_fields
from progdf.threads import StoppedError, stopped_by, without_pool
from viewer.camera.view_camera import Vec3
from viewer.gl.scene_textures import SPLATS_PER_ROW, row_runs

from .highlight import HIDDEN

Array = NDArray[np.float32]
T = TypeVar("T")

SH = ("sh0", "shN")

BUDGETS = 20_000, 50_000, 500_000
"""Limits on the number of Gaussians in a picture during motion: smallest, initial, largest."""

MOVING_MS = 20.0, 27.0
"""Target range of the drawing time of a picture during motion, in ms. A frame takes slightly longer.

Outside the range, the next picture has fewer or more Gaussians.
"""

ERROR_LIMITS_PX2 = (0.25, 4.0, 64.0)
"""Smallest, initial and largest limit of the pyramid's merging error of a node, pixels²."""

FINE_ERROR = 9e-4
"""Target mean squared error of a picture during motion (30.5 dB), so that later ones keep 30 dB.

The error limit that achieves it is measured whenever a full picture follows one drawn during motion.
"""

FINE_MS = 6.0, 7.5
"""Limits of a picture's drawing time in ms: below the first, the next one is finer, above the second coarser.

With the time of the window itself, a frame takes 12 ms.
"""

SLOW_MS = 40.0
"""Drawing time in ms above which "auto" halves width and height: 25 pictures per second."""

REST_S = 0.06
"""Time without input before the full picture is begun, in seconds. Drawing it does not block the window."""

POLL_S = 0.01
"""Interval for polling the full picture, in seconds."""

SLOW_SCENE_GAUSSIANS = 150_000
"""Number of Gaussians from which CPU pictures are assumed to be slow before the first one is measured."""

JUMP_MS = 100.0
"""Drawing time in ms above which a picture after a click or a key is drawn in the background."""

_SAMPLE = 8
"""Number of Gaussians of a small pyramid with several nodes, so that its arrays are laid out as usual."""

COARSE_PIXELS = 2
"""Number of window pixels per pixel of a coarse picture, along each axis."""


def drawn_size(size: tuple[int, int], pixels: int) -> tuple[int, int]:
    """Return the width and height of a picture whose pixels each cover `pixels` of `size` along each axis."""
    return -(-size[0] // pixels), -(-size[1] // pixels)


@dataclass(frozen=True)
class DynamicResolution:
    """Resolution during interaction, and the measured times of recent pictures."""

    pixels: int = 1  # window pixels per drawn pixel along each axis: 1 or `COARSE_PIXELS`
    # time of the next full picture, seconds on the main view's clock; None while the picture is full
    rest_at: float | None = None
    # render times of the last two full pictures, ms; two, as a single one may have been delayed
    camera_ms: tuple[float, ...] = ()
    slider_ms: tuple[float, ...] = ()  # the same for the last two slider steps of this drag
    # time of the last coarse picture; slider steps that take no longer at full resolution stay full
    coarse_ms: float = 0.0


def first_known(count: int, draws_with: str) -> DynamicResolution:
    """Return the initial state for a scene of `count` Gaussians that was not drawn yet."""
    slow = draws_with == "cpu" and count >= SLOW_SCENE_GAUSSIANS
    return DynamicResolution(camera_ms=(math.inf, math.inf) if slow else ())


def takes_long(before: DynamicResolution, known: DynamicResolution) -> bool:
    """Return whether the full picture that is due should be drawn in the background."""
    least = SLOW_MS if before.pixels > 1 else JUMP_MS
    return known.pixels == 1 and _slow(known.camera_ms, least)


def wait(known: DynamicResolution, now: float, coarsely: bool) -> DynamicResolution:
    """Wait for an unfinished full picture, and meanwhile draw coarsely or keep the last picture."""
    return replace(known, pixels=COARSE_PIXELS if coarsely else 1, rest_at=now + POLL_S)


def before_draw(
    known: DynamicResolution, mode: str, held: bool, turned: bool, slid: bool, now: float
) -> DynamicResolution:
    """Choose the resolution of the next picture.

    Args:
        known: the current state
        mode: one of `RESOLUTION_MODES`
        held: whether an input is held down, so that more changes will follow
        turned: whether the camera or the picture's size has changed since the last frame
        slid: whether the drawn scene has changed
        now: seconds on the main view's clock
    """
    known = known if held else replace(known, slider_ms=())
    full = replace(known, pixels=1, rest_at=None)
    if mode == "off":
        return full
    if turned or slid:
        slow = _slow(known.camera_ms) if turned else _slow(known.slider_ms, max(SLOW_MS, known.coarse_ms))
        pays = mode == "on" or known.pixels > 1 or slow
        return replace(known, pixels=COARSE_PIXELS, rest_at=now + REST_S) if held and pays else full
    return full if known.rest_at is None or now >= known.rest_at else known


def after_draw(known: DynamicResolution, timings: FrameTimings, turned: bool) -> DynamicResolution:
    """Record the time of a drawn picture. Coarse and full pictures are recorded separately."""
    if known.pixels > 1:
        return replace(known, coarse_ms=timings.total_ms)
    known = replace(known, camera_ms=(*known.camera_ms[-1:], timings.total_ms))
    return known if turned else replace(known, slider_ms=(*known.slider_ms[-1:], timings.total_ms))


def _slow(pictures_ms: tuple[float, ...], least: float = SLOW_MS) -> bool:
    return len(pictures_ms) == 2 and min(pictures_ms) > least


def next_frame_delay(known: DynamicResolution, now: float) -> float | None:
    """Return the seconds until the full picture is due, or None if the picture is already full."""
    return None if known.rest_at is None else max(known.rest_at - now, 0.0)


@dataclass(frozen=True)
class FrameTimings:
    """Time breakdown of one picture: wall-clock milliseconds, including the wait for the GPU."""

    compose_ms: float = 0.0  # composing attributes from strengths, on the CPU
    upload_ms: float = 0.0  # uploading attributes to the renderer
    sort_ms: float = 0.0  # depth sort (part of `draw_ms` with the CPU rasterizer)
    draw_ms: float = 0.0  # drawing
    changed: int = 0  # number of recomposed Gaussians
    drawn: int = 0  # number of Gaussians in front of the camera; all with the CPU rasterizer

    @property
    def total_ms(self) -> float:
        return self.compose_ms + self.upload_ms + self.sort_ms + self.draw_ms


@dataclass(frozen=True, eq=False)
class DrawnView:
    """Camera, background and resolution of a picture."""

    camera: Camera
    background: Vec3
    pixels: int = 1  # pixels of the full picture per pixel, along each axis
    mode: str = "splats"  # view mode, one of `view_state.VIEW_MODES`

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DrawnView) and self.pixels == other.pixels and self._matches(other)

    def is_coarse(self, full: DrawnView) -> bool:
        """Return whether it is `full` at a lower resolution."""
        return self.pixels > full.pixels and self._matches(full)

    def _matches(self, full: DrawnView) -> bool:
        scaled = self.camera.resize(full.camera.width, full.camera.height)
        pixels = self.pixels // full.pixels
        return (
            (self.mode, self.background, self.camera.width, self.camera.height)
            == (full.mode, full.background, *drawn_size((scaled.width, scaled.height), pixels))
            and torch.equal(full.camera.viewmat, scaled.viewmat)
            and torch.allclose(full.camera.K, scaled.K, rtol=0.01 * (pixels - 1), atol=0.0)
        )


@dataclass(frozen=True)
class MovingGrade:
    """Grade of pictures during motion. It changes the colors of a picture's Gaussians, not the scene's."""

    __eq__ = equal_fields

    rows: NDArray[np.int64]  # graded rows of the scene, ascending. [M]
    # returns graded colors of drawn ones [P,3], with their detail [P] if any. -> [P,3]
    apply: Callable[[torch.Tensor, torch.Tensor | None], torch.Tensor]
    detail: Array | None = None  # detail of the rows, see `local_detail`. [M]


class LiveScene:
    """Activated copy of the scene with its highlights, and a level-of-detail pyramid for motion.

    Args:
        scene: scene to copy; pass later changes to `update`
        stop: ends a compilation of the pyramid's kernels once it is set
    """

    def __init__(self, scene: Gaussians, stop: threading.Event | None = None) -> None:
        self.drawn = ActivatedGaussians(
            means=torch.from_numpy(_copy(scene.means)),
            quats=torch.from_numpy(_copy(scene.quats)),
            scales=torch.from_numpy(_exp(scene.log_scales)),
            opacities=torch.from_numpy(_sigmoid(scene.logit_opacities)),
            colors=scene.sh,
            antialiased=scene.antialiased,
        )
        self.moving_grade: MovingGrade | None = None
        """Grade of pictures during motion; None for none."""
        self._scene = scene
        self._graded: tuple[Gaussians, NDArray[np.int64]] | None = None  # see `show_grade`
        self._holds_grade = False  # whether `drawn` has the graded colors
        self._cut: tuple[object, ActivatedGaussians] | None = None  # last cut with its inputs
        # inputs, the grade, and the means of its rows and its detail in the pyramid, see `_grade_cut`
        self._means: tuple[object, MovingGrade, Array, Array | None] | None = None
        self._highlights: Array | None = None  # rgb and share, 0 to 1; None for no highlights. [N,4]
        self._budget = BUDGETS[1]
        self._finest = ERROR_LIMITS_PX2[1]  # error limit of the next picture in motion, pixels²
        self._max_finest = ERROR_LIMITS_PX2[1]  # its largest value, see `measure`
        self._limit = 0.0  # error limit of the last picture in motion, pixels²; 0 if it had all Gaussians
        self._pyramid: Future[Pyramid] | None = None
        self._fitted: Future[Pyramid] | None = None  # the pyramid fitted to full pictures, until it is in use
        self._is_fitted = False  # whether the fit of this pyramid has begun
        self._camera: Camera | None = None  # camera of the last picture in motion
        self._pixels = COARSE_PIXELS  # window pixels per pixel of the last picture in motion
        # outdated rows of the pyramid: 0 up to date, 1 colors only, 2 more. [N] uint8
        self._outdated = np.zeros(len(scene), np.uint8)
        self._changed = np.zeros(len(scene), np.uint8)  # the same for rows changed since the fit began
        self._stop = stop or threading.Event()

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        """See `GlRenderer.update`."""
        self._scene = scene
        names = tuple(attributes)
        for first, last in row_runs(rows):  # slices are many times faster than indices
            part = slice(first * SPLATS_PER_ROW, last * SPLATS_PER_ROW)
            for name in names:
                self._write(scene, name, part)
        lacks = 1 if all(name in SH for name in names) else 2
        for outdated in (self._outdated, self._changed):
            outdated[rows] = np.maximum(outdated[rows], lacks)

    def show_grade(self, graded: Gaussians | None, rows: NDArray[np.int64]) -> None:
        """Draw full pictures with other base colors of some rows, until the next call.

        Pictures during motion keep the scene's own colors, which the pyramid has merged, see `MovingGrade`.

        Args:
            graded: the scene with these base colors; None for its own
            rows: ascending. [M]
        """
        if self._graded is not None and self._graded[1] is not rows:
            self._hold_grade(False)
        self._graded = (graded, rows) if graded is not None else None
        self._holds_grade = graded is not None
        self._write_base(graded or self._scene, rows)

    def begin_full(self) -> None:
        """Prepare `drawn` for a full picture."""
        self._hold_grade(True)

    def _hold_grade(self, held: bool) -> None:
        """Put the graded colors into `drawn`, or the scene's own."""
        if self._graded is None or self._holds_grade == held:
            return
        graded, rows = self._graded
        self._write_base(graded if held else self._scene, rows)
        self._holds_grade = held

    def _write_base(self, scene: Gaussians, rows: NDArray[np.int64]) -> None:
        for first, last in row_runs(rows):
            self._write(scene, "sh0", slice(first * SPLATS_PER_ROW, last * SPLATS_PER_ROW))

    @property
    def has_pyramid(self) -> bool:
        """True if pictures during motion can be drawn."""
        return self._pyramid is not None and self._pyramid.done()

    def highlight(self, rows: NDArray[np.int64], highlights: NDArray[np.uint8]) -> None:
        """See `GlRenderer.highlight`."""
        if self._highlights is None:
            self._highlights = np.zeros((len(self.drawn.means), 4), np.float32)
        hidden = self._highlights[rows, 3] == 1.0
        self._highlights[rows] = highlights.astype(np.float32) / 255.0
        names = SH if (hidden == (highlights[:, 3] == HIDDEN)).all() else ("logit_opacities", *SH)
        self.update(self._scene, names, rows)
        if not self._highlights[:, 3].any():
            self._highlights = None

    @property
    def highlights(self) -> torch.Tensor | None:
        """Highlights: rgb and share, 0 to 1; None for none. [N,4]"""
        return None if self._highlights is None else torch.from_numpy(self._highlights)

    def begin_pyramid(self) -> Future[Pyramid]:
        """Build the pyramid in another thread. Rows changed meanwhile are merged again afterwards."""
        self._outdated[:] = 0
        self._fitted = None
        self._is_fitted = False
        self._pyramid = _worker().submit(_build, self.drawn, self._stop)
        return self._pyramid

    def draw_fewer(self, draw: Callable[[ActivatedGaussians], T], camera: Camera, pixels: int) -> T | None:
        """Draw as many Gaussians as the frame's time permits, and adapt the budget to the time taken.

        Args:
            draw: draws the given Gaussians
            camera: camera of the coarse picture
            pixels: window pixels per pixel of the picture, along each axis

        Returns:
            Result of `draw`, or None until the pyramid is built.
        """
        future = self._pyramid or self.begin_pyramid()
        if not future.done():
            return None
        started = time.perf_counter()
        self._camera = camera
        self._pixels = pixels
        self._hold_grade(False)
        pyramid = self._use_fit() or future.result()
        if self._outdated.any():
            for lacks in (2, 1):
                rows = np.flatnonzero(self._outdated == lacks)
                if len(rows):
                    pyramid.refresh(rows, colors_only=lacks == 1)
            self._outdated[:] = 0
            self._cut = None
        fewer = self._cut_scene(pyramid, camera, pixels)
        picture = draw(self._grade_cut(pyramid, fewer))
        taken_ms = 1e3 * (time.perf_counter() - started)
        low, high = MOVING_MS
        if taken_ms > high or (taken_ms < low and len(fewer.means) > 0.8 * self._budget):
            budget = int(self._budget * (0.85 if taken_ms > high else 1.15))
            self._budget = min(max(budget, BUDGETS[0]), BUDGETS[2])
        finest = self._finest
        if taken_ms > FINE_MS[1]:
            finest *= 1.15
        elif taken_ms < FINE_MS[0]:
            finest *= 0.85
        self._finest = min(max(finest, ERROR_LIMITS_PX2[0]), self._max_finest)
        return picture

    def _cut_scene(self, pyramid: Pyramid, camera: Camera, pixels: int) -> ActivatedGaussians:
        """Return the Gaussians to draw. A still camera keeps them, as while the color of a region changes."""
        view = (*camera.viewmat.flatten().tolist(), *camera.K.flatten().tolist(), camera.width, camera.height)
        inputs = (id(pyramid), view, pixels, self._budget, self._finest)
        if self._cut is None or self._cut[0] != inputs:
            pyramid.finest = self._finest
            self._cut = inputs, pyramid.simplify(camera, self._budget, pixels)
            self._limit = pyramid.limit
        return self._cut[1]

    def _grade_cut(self, pyramid: Pyramid, fewer: ActivatedGaussians) -> ActivatedGaussians:
        """Return the Gaussians to draw with the moving grade's colors, as far as its rows make them up."""
        grade = self.moving_grade
        if grade is None:
            return fewer
        inputs = (id(pyramid), id(grade.rows), id(grade.detail))
        if self._means is None or self._means[0] != inputs:
            values = np.zeros((2, len(self.drawn.means)), np.float32)
            values[0, grade.rows] = 1.0
            shares = pyramid.means_of(values[0])
            details = None
            if grade.detail is not None:
                values[1, grade.rows] = grade.detail
                details = pyramid.means_of(values[1])
            self._means = inputs, grade, shares, details
        _, _, shares, details = self._means
        share = torch.from_numpy(shares[pyramid.picks])[:, None]
        detail = None if details is None else torch.from_numpy(details[pyramid.picks])
        graded = grade.apply(fewer.colors, detail)
        return fewer._replace(colors=torch.lerp(fewer.colors, graded, share))

    def measure(self, moving: Array, full: Array) -> None:
        """Measure the error limit that gives `FINE_ERROR`.

        Args:
            moving: the last picture during motion. [H,W,3]
            full: the full picture of the same view. [H,W,3]
        """
        screen = np.empty((*full.shape[:2], 4), np.uint8)
        fill_screen(moving, screen)
        difference = screen[::-8, :, :3] / np.float32(255.0) - full[::8].clip(0.0, 1.0)
        # the error grows with the limit's power of 0.6 to 1.5 (docs/lab/experiments.md, The viewer)
        limit = self._limit * (FINE_ERROR / max(float(np.square(difference).mean()), 1e-9)) ** (1 / 1.5)
        self._max_finest = (
            min(max(limit, ERROR_LIMITS_PX2[0]), ERROR_LIMITS_PX2[2]) if self._limit else self._max_finest
        )
        self._begin_fit()

    def _begin_fit(self) -> None:
        """Fit the pyramid to full pictures in another thread, once, after the first motion has stopped."""
        future = self._pyramid
        if self._is_fitted or future is None or not future.done() or self._camera is None:
            return
        self._is_fitted = True
        self._changed[:] = self._outdated
        self._fitted = _worker().submit(
            _fit, future.result(), self._camera, self._max_finest, self._pixels, self._stop
        )

    def _use_fit(self) -> Pyramid | None:
        """Replace the pyramid by the fitted one as soon as it is finished, and return it."""
        fitted = self._fitted
        if fitted is None or not fitted.done():
            return None
        self._fitted = None
        pyramid = fitted.result()  # after an error the first pyramid stays in use
        self._pyramid = fitted
        self._outdated[:] = self._changed
        return pyramid

    def _write(self, scene: Gaussians, name: str, part: slice) -> None:
        """Write one attribute of some rows, with their highlights."""
        means, quats, scales, opacities, sh = (tensor.numpy() for tensor in self.drawn.tensors)
        values = getattr(scene, name)[part].detach()
        if name == "means":
            means[part] = values.numpy()
        elif name == "quats":
            quats[part] = values.numpy()
        elif name == "log_scales":
            scales[part] = _exp(values)
        elif name == "logit_opacities":
            opacities[part] = _sigmoid(values)
            if self._highlights is not None:
                opacities[part] *= self._highlights[part, 3] < 1.0
        else:
            colors = sh[part, :1] if name == "sh0" else sh[part, 1:]
            plain = values.numpy().reshape(colors.shape)
            if self._highlights is None:
                colors[:] = plain
                return
            share = self._highlights[part, 3:, None]
            np.multiply(plain, 1.0 - share, out=colors)  # colors are linear in all bands
            if name == "sh0":
                colors += share * (self._highlights[part, None, :3] - 0.5) / C0


def warm_up() -> None:
    """Load the kernels of pyramids, or compile them the first time on a machine."""
    random = torch.Generator().manual_seed(0)
    means = torch.rand(_SAMPLE, 3, generator=random)
    sample = ActivatedGaussians(
        means=means,
        quats=torch.eye(4)[:1].expand(_SAMPLE, 4).contiguous(),
        scales=0.1 + means,
        opacities=means[:, 0].contiguous(),
        colors=means[:, None, :].contiguous(),
    )
    pyramid = Pyramid(sample)
    pyramid.refresh(np.arange(_SAMPLE), colors_only=False)
    camera = Camera(torch.eye(4), torch.eye(3), 1, 1)
    pyramid.simplify(camera, 1)
    fit_pyramid(pyramid, camera, 1.0, 1, COARSE_PIXELS)
    mark_compiled(__name__)


def _build(gaussians: ActivatedGaussians, stop: threading.Event) -> Pyramid:
    """Build a pyramid, after its kernels are compiled in another process.

    Raises:
        StoppedError: the scene was released meanwhile.
    """
    if not is_compiled(__name__):
        compile_elsewhere(__name__, stop)
    if stop.is_set():
        raise StoppedError
    warm_up()
    return Pyramid(gaussians)


def _fit(pyramid: Pyramid, camera: Camera, limit: float, pixels: int, stop: threading.Event) -> Pyramid:
    """Return the pyramid fitted to full pictures. One thread leaves the others to the window.

    Raises:
        StoppedError: the scene was released meanwhile.
    """
    with stopped_by(stop), without_pool():
        return fit_pyramid(pyramid, camera, limit, BUDGETS[2], pixels)


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="pyramid")


def _copy(values: torch.Tensor) -> Array:
    return np.array(values.detach().numpy(), np.float32, order="C")


def _exp(values: torch.Tensor) -> Array:
    """Return exp(values), by numpy on one thread, as torch's threads would compete with the rasterizer's."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.exp(_copy(values))


def _sigmoid(values: torch.Tensor) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(1.0 / (1.0 + np.exp(-_copy(values))), np.float32)
