"""Fewer pixels while something moves and a whole picture takes long; all of them once it rests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

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
