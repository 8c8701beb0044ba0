"""Fewer pixels and Gaussians while something moves and a whole picture takes long; all once it rests."""

from __future__ import annotations

import math
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
from progdf.rasterize.cpu.pyramid import Pyramid
from progdf.rasterize.screen import fill_screen
from progdf.sh import C0
from viewer.camera.view_camera import Vec3
from viewer.gl.scene_textures import SPLATS_PER_ROW, row_runs

from .highlight import HIDDEN

Array = NDArray[np.float32]
T = TypeVar("T")

SH = ("sh0", "shN")

BUDGETS = 20_000, 50_000, 500_000
"""How many Gaussians a picture in motion has at most: on a slow machine, at first, on a quick one."""

MOVING_MS = 20.0, 27.0
"""What such a picture shall take, some ms less than its frame; with more or less time, the next one has fewer
or more Gaussians."""

FINE = (0.25, 4.0, 64.0)
FINE_ERROR = 9e-4
"""Least, first and largest limit of what a node may lose, pixels². A picture in motion is fine enough with a
mean squared error like this, 30.5 dB, so that those which follow it have 30; the limit for it is measured
where the picture in full follows one."""

FINE_MS = 6.0, 7.5
"""It is finer than that only as far as it takes no longer: with the window's own time a frame has 12 ms."""

SLOW_MS = 40.0
"""What a picture may take before "auto" halves its sides: 25 pictures a second."""

REST_S = 0.06
"""How long nothing moves before the picture in full is begun. What is begun keeps nobody waiting."""

POLL_S = 0.01
"""Between two looks whether it is done."""

MANY = 150_000
"""Gaussians of which the CPU's pictures are taken for slow before the first one is known."""

JUMP_MS = 100.0
"""What one may take that comes alone, after a click or a key, before the window goes on without it."""

COARSE = 2
"""How many pixels of the window one pixel of a coarse picture covers, each way."""


def drawn_size(size: tuple[int, int], pixels: int) -> tuple[int, int]:
    """Width and height of a picture of which each pixel fills `pixels` of `size`, each way."""
    return -(-size[0] // pixels), -(-size[1] // pixels)


@dataclass(frozen=True)
class DynamicResolution:
    """How pictures are drawn while the hand is on something, and what is known of their cost."""

    pixels: int = 1  # of the window that one pixel drawn covers, each way: 1 or `COARSE`
    # when to draw in full, seconds on the main view's clock; None while the picture is in full
    rest_at: float | None = None
    # what the last two whole pictures in full took; one alone may have waited for something
    camera_ms: tuple[float, ...] = ()
    slider_ms: tuple[float, ...] = ()  # the same of the last two steps of a slider, within this grip
    # what the last coarse picture took; a slider's step in full that takes no longer stays so
    coarse_ms: float = 0.0


def first_known(count: int, draws_with: str) -> DynamicResolution:
    """What is known of a scene of which nothing was drawn yet."""
    slow = draws_with == "cpu" and count >= MANY
    return DynamicResolution(camera_ms=(math.inf, math.inf) if slow else ())


def takes_long(before: DynamicResolution, known: DynamicResolution) -> bool:
    """Whether the picture, which shall be in full now, should be made beside the window's work."""
    least = SLOW_MS if before.pixels > 1 else JUMP_MS
    return known.pixels == 1 and _slow(known.camera_ms, least)


def wait(known: DynamicResolution, now: float, coarsely: bool) -> DynamicResolution:
    """The picture in full is not done yet: a coarse one takes its place, or the last one stays."""
    return replace(known, pixels=COARSE if coarsely else 1, rest_at=now + POLL_S)


def before_draw(
    known: DynamicResolution, mode: str, held: bool, turned: bool, slid: bool, now: float
) -> DynamicResolution:
    """Before a picture is drawn: how it shall be drawn.

    Args:
        mode: of `RESOLUTION_MODES`
        held: whether a hand is on something, so that more will follow
        turned: whether the camera or the picture's size is another than in the last frame
        slid: whether what is drawn is another
        now: seconds on the main view's clock
    """
    known = known if held else replace(known, slider_ms=())
    full = replace(known, pixels=1, rest_at=None)
    if mode == "off":
        return full
    if turned or slid:
        slow = _slow(known.camera_ms) if turned else _slow(known.slider_ms, max(SLOW_MS, known.coarse_ms))
        pays = mode == "on" or known.pixels > 1 or slow
        return replace(known, pixels=COARSE, rest_at=now + REST_S) if held and pays else full
    return full if known.rest_at is None or now >= known.rest_at else known


def after_draw(known: DynamicResolution, timings: FrameTimings, turned: bool) -> DynamicResolution:
    """After a picture was drawn: what it took. A coarse one tells nothing of a full one."""
    if known.pixels > 1:
        return replace(known, coarse_ms=timings.total_ms)
    known = replace(known, camera_ms=(*known.camera_ms[-1:], timings.total_ms))
    return known if turned else replace(known, slider_ms=(*known.slider_ms[-1:], timings.total_ms))


def _slow(pictures_ms: tuple[float, ...], least: float = SLOW_MS) -> bool:
    return len(pictures_ms) == 2 and min(pictures_ms) > least


def next_frame_delay(known: DynamicResolution, now: float) -> float | None:
    """Seconds until the picture has to be drawn in full; None where it is."""
    return None if known.rest_at is None else max(known.rest_at - now, 0.0)


@dataclass(frozen=True)
class FrameTimings:
    """Where the time of one picture went: wall clock, milliseconds, the GPU's work waited for."""

    compose_ms: float = 0.0  # strengths → attributes, by the CPU
    upload_ms: float = 0.0  # attributes → where they are drawn from
    sort_ms: float = 0.0  # depth order (the CPU rasterizer sorts within `draw_ms`)
    draw_ms: float = 0.0  # the picture
    changed: int = 0  # Gaussians whose attributes were composed anew
    drawn: int = 0  # Gaussians in front of the camera; all of them where the CPU rasterizer draws

    @property
    def total_ms(self) -> float:
        return self.compose_ms + self.upload_ms + self.sort_ms + self.draw_ms


@dataclass(frozen=True, eq=False)
class DrawnView:
    """What a picture shows of a scene."""

    camera: Camera
    background: Vec3
    pixels: int = 1  # of the picture in full that one of its pixels covers, each way

    def __eq__(self, other: object) -> bool:
        return isinstance(other, DrawnView) and self.pixels == other.pixels and self._has(other)

    def is_coarse(self, full: DrawnView) -> bool:
        """Whether it is `full`, in fewer pixels."""
        return self.pixels > full.pixels and self._has(full)

    def _has(self, full: DrawnView) -> bool:
        mine = self.camera.resize(full.camera.width, full.camera.height)
        pixels = self.pixels // full.pixels
        return (
            (self.background, self.camera.width, self.camera.height)
            == (full.background, *drawn_size((mine.width, mine.height), pixels))
            and torch.equal(full.camera.viewmat, mine.viewmat)
            and torch.allclose(full.camera.K, mine.K, rtol=0.01 * (pixels - 1), atol=0.0)
        )


class LiveScene:
    """The scene as it is drawn, activated, under its highlights; and a pyramid over it for what moves.

    Args:
        scene: what is copied; later changes come by `update`
    """

    def __init__(self, scene: Gaussians) -> None:
        self.drawn = ActivatedGaussians(
            means=torch.from_numpy(_copy(scene.means)),
            quats=torch.from_numpy(_copy(scene.quats)),
            scales=torch.from_numpy(_exp(scene.log_scales)),
            opacities=torch.from_numpy(_sigmoid(scene.logit_opacities)),
            colors=scene.sh,
            antialiased=scene.antialiased,
        )
        self._scene = scene
        self._highlights: Array | None = None  # rgb and its share, 0..1; None is no highlight. [N,4]
        self._budget, self._finest, self._enough = BUDGETS[1], FINE[1], FINE[1]
        self._limit = 0.0  # of the last picture in motion; 0 while these have all Gaussians
        self._pyramid: Future[Pyramid] | None = None
        # what the pyramid lacks of each row: nothing, its colors, or more. [N] uint8
        self._behind = np.zeros(len(scene), np.uint8)

    def update(self, scene: Gaussians, attributes: Iterable[str], rows: NDArray[np.int64]) -> None:
        """See `GlRenderer.update`."""
        self._scene, names = scene, tuple(attributes)
        highlighted = self._highlights is not None and any(name in SH for name in names)
        names = tuple(dict.fromkeys((*names, *SH))) if highlighted else names
        for first, last in row_runs(rows):  # whole runs, as slices are many times faster than indices
            part = slice(first * SPLATS_PER_ROW, last * SPLATS_PER_ROW)
            for name in names:
                self._write(scene, name, part)
            if highlighted:
                self._apply_highlight(part)
        lacks = 1 if all(name in SH for name in names) else 2
        self._behind[rows] = np.maximum(self._behind[rows], lacks)

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

    def begin_pyramid(self) -> Future[Pyramid]:
        """Build it beside everything else; what is written meanwhile is merged anew afterwards."""
        self._behind[:] = 0
        self._pyramid = _worker().submit(_build, self.drawn)
        return self._pyramid

    def draw_fewer(self, draw: Callable[[ActivatedGaussians], T], camera: Camera, pixels: int) -> T | None:
        """Draw as many as there is time for; None until there is a pyramid.

        Args:
            camera: of the coarse picture
            pixels: of the window that one of its pixels covers, each way
        """
        pyramid = self._pyramid or self.begin_pyramid()
        if not pyramid.done():
            return None
        started = time.perf_counter()
        merged = pyramid.result()
        for lacks in (2, 1):
            if len(rows := np.flatnonzero(self._behind == lacks)):
                merged.refresh(rows, colors_only=lacks == 1)
        self._behind[:], merged.finest = 0, self._finest
        fewer = merged.simplify(camera, self._budget, pixels)
        self._limit = merged.limit
        picture = draw(fewer)
        taken, (low, high) = 1e3 * (time.perf_counter() - started), MOVING_MS
        if taken > high or (taken < low and len(fewer.means) > 0.8 * self._budget):
            budget = int(self._budget * (0.85 if taken > high else 1.15))
            self._budget = min(max(budget, BUDGETS[0]), BUDGETS[2])
        finest = self._finest * (1.15 if taken > FINE_MS[1] else 0.85 if taken < FINE_MS[0] else 1.0)
        self._finest = min(max(finest, FINE[0]), self._enough)
        return picture

    def measure(self, moving: Array, full: Array) -> None:
        """Learn what a node may lose here, of the last picture in motion and of the same in full. [H,W,3]"""
        screen = np.empty((*full.shape[:2], 4), np.uint8)
        fill_screen(moving, screen)
        off = screen[::-8, :, :3] / np.float32(255.0) - full[::8].clip(0.0, 1.0)
        # it grows with the limit's power of .6 to 1.5 (docs/experiments.md, The viewer)
        enough = self._limit * (FINE_ERROR / max(float(np.square(off).mean()), 1e-9)) ** (1 / 1.5)
        self._enough = min(max(enough, FINE[0]), FINE[2]) if self._limit else self._enough

    def _write(self, scene: Gaussians, name: str, part: slice) -> None:
        means, quats, scales, opacities, sh = (tensor.numpy() for tensor in self.drawn.tensors)
        target, activated = {
            "means": (means, _copy),
            "quats": (quats, _copy),
            "log_scales": (scales, _exp),
            "logit_opacities": (opacities, _sigmoid),
            "sh0": (sh[:, 0], _copy),
            "shN": (sh[:, 1:], _copy),
        }[name]
        target[part] = activated(getattr(scene, name)[part])
        if name == "logit_opacities" and self._highlights is not None:
            opacities[part] *= self._highlights[part, 3] < 1.0

    def _apply_highlight(self, part: slice) -> None:
        """Mix the highlights into colors that were just written: all bands, as color is linear in them."""
        assert self._highlights is not None, "nothing to highlight with"
        sh = self.drawn.colors.numpy()[part]
        share = self._highlights[part, 3:]
        sh *= 1.0 - share[:, :, None]
        sh[:, 0] += share * (self._highlights[part, :3] - 0.5) / C0


def _build(gaussians: ActivatedGaussians) -> Pyramid:
    few = Pyramid(gaussians.select(torch.arange(min(len(gaussians.means), 2))))
    few.simplify(Camera(torch.eye(4), torch.eye(3), 1, 1), 1)  # compiles now what else the first touch would
    return Pyramid(gaussians)


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="pyramid")


def _copy(values: torch.Tensor) -> Array:
    return np.array(values.detach().numpy(), np.float32, order="C")


def _exp(values: torch.Tensor) -> Array:
    """With numpy, on one thread: torch's threads would spin against the rasterizer's."""
    with np.errstate(over="ignore", invalid="ignore"):
        return np.exp(_copy(values))


def _sigmoid(values: torch.Tensor) -> Array:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(1.0 / (1.0 + np.exp(-_copy(values))), np.float32)
