"""Inspection of the picture: the Gaussians that make the pixel under the mouse, and the status line."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import partial

import numpy as np
from imgui_bundle import imgui, imgui_ctx
from numpy.typing import NDArray

from progdf.gaussians import Gaussians
from progdf.system.equality import equal_fields
from progdf.system.processes import resident_bytes
from progdf.threads import without_pool
from viewer.render.background import LatestResult
from viewer.render.picking import PREPARE_MIN_GAUSSIANS, PixelGaussians, outlines, seen_at
from viewer.render.properties import PROPERTIES, Distribution, distribution
from viewer.render.view_modes import CONTRIBUTION, visible_count
from viewer.state.workspace import Workspace
from viewer.ui.context import PALETTE, SMALL_PX, UiContext, u32
from viewer.ui.overlay import Area
from viewer.ui.pointer import PointerContext
from viewer.ui.widgets import group_digits

MAX_OUTLINES = 24  # number of outlines around the pixel, those with the largest shares
HALF = 0.5  # share of the color that the second line of the readout counts to
_IDLE_S = 0.25  # a longer time between two frames is no frame rate
_RATE_FRAMES = 20  # frames averaged for the rate
_DIRECT_MS = 50.0  # processor time above which a histogram is computed in the background


@dataclass(frozen=True)
class _Probe:
    """Gaussians of one pixel, with the text and the outlines to draw."""

    __eq__ = equal_fields

    key: object  # picture and pixel
    lines: tuple[str, ...] = ()
    outlines: NDArray[np.float64] | None = None  # pixels of the picture. [M,P,2]
    shares: NDArray[np.float64] | None = None  # of the color, 0 to 1. [M]


class Inspection:
    """Readouts over the picture, with the values that they keep between frames."""

    def __init__(self) -> None:
        self._probe = _Probe(None)
        self._frames: deque[float] = deque(maxlen=_RATE_FRAMES)  # seconds between frames in motion
        self._visible: tuple[object, int] = (None, 0)  # key of the picture and its visible Gaussians
        self.distributions = Distributions()

    def step(self, seconds: float) -> None:
        """Record the time since the last frame."""
        if seconds > _IDLE_S:
            self._frames.clear()
        else:
            self._frames.append(seconds)

    def draw(self, work: Workspace, pointer: PointerContext, ms: float, left: float) -> None:
        """Draw the readout at the pointer and the status line, see `_draw_status`."""
        self._draw_contribution(work, pointer)
        self._draw_status(work, pointer, ms, left)

    def _draw_contribution(self, work: Workspace, pointer: PointerContext) -> None:
        """Draw the number, depth and outlines of the Gaussians that make the pixel under the mouse."""
        io = imgui.get_io()
        inside = 0 <= io.mouse_pos.x < pointer.area.width and 0 <= io.mouse_pos.y < pointer.area.height
        is_on = pointer.shown.mode == CONTRIBUTION and pointer.shown.compare.mode == "off"
        if not is_on or not inside or io.want_capture_mouse or work.transient.tool.drag is not None:
            return
        key = (pointer.scene_key, pointer.shown.camera, pointer.size, pointer.cursor)
        moves = bool(io.mouse_delta.x or io.mouse_delta.y)
        if key != self._probe.key and not (moves and pointer.facts.count >= PREPARE_MIN_GAUSSIANS):
            self._probe = _probe(key, pointer)
        if key == self._probe.key:
            _draw_probe(self._probe, pointer)

    def _draw_status(self, work: Workspace, pointer: PointerContext, ms: float, left: float) -> None:
        """Draw the status line at the bottom of the picture, if it is on.

        Args:
            work: the state
            pointer: the picture
            ms: time of the last picture, milliseconds
            left: first free column, window pixels
        """
        if not work.layout.status or not work.view.panel:
            return
        key = (pointer.scene_key, pointer.shown.camera, pointer.size)
        if key != self._visible[0] and work.transient.tool.drag is None and work.glide is None:
            camera = pointer.camera(pointer.shown.camera)
            self._visible = key, visible_count(pointer.scene, camera, pointer.engine.near)
        words = [
            f"{group_digits(pointer.facts.count)} splats",
            f"{group_digits(self._visible[1])} visible",
            self._rate(),
            f"{ms:.0f} ms",
            memory(),
        ]
        _draw_line("   ".join(word for word in words if word), left, pointer.area, pointer.ui)

    def _rate(self) -> str:
        if len(self._frames) < 2:
            return "idle"
        return f"{len(self._frames) / max(sum(self._frames), 1e-6):.0f} fps"


class Distributions:
    """Histograms of the scene on screen, each computed once. `drop` them with the window."""

    def __init__(self) -> None:
        self._scene: object = None  # key of the scene of the known histograms
        self._known: dict[str, Distribution] = {}
        self._requested = ""  # property of the histogram in the background
        self._latest = LatestResult[Distribution]("histogram")

    def get(self, name: str, pointer: PointerContext) -> Distribution | None:
        """Return the histogram of a property; None while it is computed. `name`: key of `PROPERTIES`"""
        if self._scene != pointer.scene_key:
            self.drop()
            self._scene = pointer.scene_key
        found = self._known.get(name)
        if found is None:
            found = self._find(name, pointer)
        if found is not None:
            self._known[name] = found
        return found

    def _find(self, name: str, pointer: PointerContext) -> Distribution | None:
        if 1e-3 * PROPERTIES[name].us * pointer.facts.count <= _DIRECT_MS:
            return distribution(pointer.scene, name)
        if name == self._requested:
            return self._latest.value
        if imgui.is_any_item_active():  # a slider changes the scene again in the next frame
            return None
        self._requested = name
        return self._latest.get((name, self._scene), partial(_compute_alone, pointer.copy_scene(), name))

    @property
    def is_busy(self) -> bool:
        """True while a histogram is computed."""
        return self._latest.is_busy

    def drop(self) -> None:
        """Cancel the computation and forget the histograms."""
        self._known = {}
        self._scene = None
        self._requested = ""
        self._latest.drop()


def _compute_alone(scene: Gaussians, name: str) -> Distribution:
    """Return the histogram of a property, on one thread, which leaves the others to the window."""
    with without_pool():
        return distribution(scene, name)


def memory() -> str:
    """Return the memory of the process as text; "" where the system does not report it."""
    resident = resident_bytes()
    return f"{resident / 1e9:.1f} GB" if resident else ""


def _probe(key: object, pointer: PointerContext) -> _Probe:
    """Find the Gaussians of the pixel under the mouse."""
    camera = pointer.camera(pointer.shown.camera)
    scene = pointer.scene
    seen = seen_at(scene, camera, *pointer.cursor, pointer.engine.near)
    if seen is None:
        return _Probe(key, ("No splats here",))
    most = np.sort(np.argsort(-seen.shares)[:MAX_OUTLINES])
    rows, lines = outlines(scene, seen.rows[most], camera, pointer.engine.near)
    shares = dict(zip(seen.rows.tolist(), seen.shares.tolist(), strict=True))
    return _Probe(
        key, describe(seen, pointer.shown.unit), lines, np.array([shares[row] for row in rows.tolist()])
    )


def describe(seen: PixelGaussians, unit: float) -> tuple[str, ...]:
    """Return the readout of a pixel: number of Gaussians, depth, and how many make half of its color.

    Args:
        seen: its Gaussians, nearest first
        unit: true length of a world unit
    """
    drawn = seen.shares > 0.0
    shares = seen.shares[drawn]
    depth = float((shares * seen.depths[drawn]).sum() / shares.sum())
    largest = np.sort(shares)[::-1].cumsum()
    count = int(np.searchsorted(largest, HALF * largest[-1])) + 1
    noun = "splat makes" if count == 1 else "splats make"
    return (
        f"{group_digits(len(shares))} splats, depth {unit * depth:.4g}",
        f"{count} {noun} half of the color",
    )


def _draw_probe(probe: _Probe, pointer: PointerContext) -> None:
    canvas = imgui.get_background_draw_list()
    scale = pointer.ui.scale
    density = imgui.get_io().display_framebuffer_scale
    if probe.outlines is not None and probe.shares is not None:
        strongest = max(float(probe.shares.max(initial=0.0)), 1e-9)
        for outline, share in zip(probe.outlines, probe.shares, strict=True):
            points = [((x + pointer.left) / density.x, y / density.y) for x, y in outline.tolist()]
            if not all(math.isfinite(x) and math.isfinite(y) for x, y in points):
                continue
            strength = 0.25 + 0.75 * math.sqrt(float(share) / strongest)
            closed = imgui.ImDrawFlags_.closed.value
            canvas.add_polyline([*points], u32((*PALETTE.scrim[:3], 0.6 * strength)), 3.0 * scale, closed)
            canvas.add_polyline([*points], u32((*PALETTE.handle[:3], strength)), 1.25 * scale, closed)
    mouse = imgui.get_io().mouse_pos
    pad = 6.0 * scale
    sizes = [imgui.calc_text_size(line) for line in probe.lines]
    wide = max(size.x for size in sizes)
    tall = sum(size.y for size in sizes)
    left = min(mouse.x + 3.0 * pad, pointer.area.width - wide - 2.0 * pad)
    top = min(mouse.y + 3.0 * pad, pointer.area.height - tall - 2.0 * pad)
    corner = (left + wide + 2.0 * pad, top + tall + 2.0 * pad)
    canvas.add_rect_filled((left, top), corner, u32(PALETTE.scrim), pad)
    top += pad
    for line, size in zip(probe.lines, sizes, strict=True):
        canvas.add_text((round(left + pad), round(top)), u32(PALETTE.text), line)
        top += size.y


def _draw_line(text: str, left: float, area: Area, ui: UiContext) -> None:
    """Draw a small text at the bottom of the picture, right of `left`."""
    pad = 6.0 * ui.scale
    canvas = imgui.get_background_draw_list()
    with imgui_ctx.push_font(None, SMALL_PX):
        size = imgui.calc_text_size(text)
        right = area.width - pad
        at = (max(right - size.x - 2.0 * pad, left), area.height - size.y - 2.5 * pad)
        end = (at[0] + size.x + 2.0 * pad, area.height - pad)
        canvas.add_rect_filled(at, end, u32(PALETTE.scrim), pad)
        canvas.add_text((round(at[0] + pad), round(at[1] + 0.75 * pad)), u32(PALETTE.text), text)
