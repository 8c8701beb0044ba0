"""Histogram of a property over the scene, with a range to drag that selects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from imgui_bundle import imgui

from viewer.render.properties import BINS, PROPERTIES, Distribution, rows_between
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.transient import Histogram
from viewer.state.workspace import Workspace, with_transient
from viewer.ui.context import PALETTE, Icon, UiContext, u32
from viewer.ui.keys import modifier
from viewer.ui.overlay import Area
from viewer.ui.widgets import choice, drop_down, group_digits, hint, icon_button, plate, small, tip

from .tools import EDGE_PX, LEFT_PX

WIDTH_PX = 476.0  # at 1×, like the next ones
HEIGHT_PX = 92.0
_FOOT_PX = 36.0  # room of the status line
_GRIP_PX = 6.0  # distance within which an end of the range is dragged
_MODES = {"": "new", "Shift": "add", "Ctrl": "subtract"}
"""Modifier at the press, and the combination with the selection before it."""


def draw(
    work: Workspace, found: Distribution | None, area: Area, ui: UiContext
) -> tuple[Workspace, Plain | None]:
    """Draw the histogram over the lower right corner of the picture.

    Args:
        work: the state, with a histogram
        found: histogram of its property; None while it is computed
        area: the picture without the timeline
        ui: fonts and scale

    Returns:
        The workspace, with the rows of the range selected, and the requested action, None for none.
    """
    state = work.transient.histogram
    if state is None:
        return work, None
    requested = None
    wide = min(WIDTH_PX * ui.scale, area.width - (LEFT_PX + 3.0 * EDGE_PX) * ui.scale)
    corner = (area.width - EDGE_PX * ui.scale, area.height - _FOOT_PX * ui.scale)
    with plate("histogram", corner, ui, (1.0, 1.0)):
        button = imgui.get_frame_height()
        names = {key: one.name for key, one in PROPERTIES.items()}
        room = wide - button - 4.0 * ui.scale
        help_ = f"{PROPERTIES[state.property].help}. Drag over the bars to select a range"
        if wide >= WIDTH_PX * ui.scale:
            pressed = choice("property", names, state.property, ui, room)
            tip(help_)
        else:
            imgui.set_next_item_width(room)
            chosen = drop_down(
                "##property",
                names[state.property],
                [*names.values()],
                [*names].index(state.property),
                ui,
                help_,
            )
            pressed = None if chosen is None else [*names][chosen]
        imgui.same_line(0.0, 4.0 * ui.scale)
        if icon_button("close histogram", Icon.CLOSE, ui):
            requested = Plain("histogram")
        hint("histogram")
        if pressed is not None and pressed != state.property:
            return with_transient(work, histogram=Histogram(pressed)), requested
        if found is None:
            _draw_wait(work, wide, ui)
            return work, requested
        work = _draw_bars(work, state, found, wide, ui)
        state = work.transient.histogram or state
        small(_caption(work, state, found), PALETTE.dim, wide)
        tip("Shift adds to the selection, Ctrl subtracts from it")
    return work, requested


def _draw_wait(work: Workspace, wide: float, ui: UiContext) -> None:
    """Draw an empty field in place of the bars, with a line below."""
    left, top = imgui.get_cursor_screen_pos()
    low = (left + wide, top + HEIGHT_PX * ui.scale)
    imgui.get_window_draw_list().add_rect_filled((left, top), low, u32(PALETTE.field), 3.0 * ui.scale)
    imgui.dummy((wide, HEIGHT_PX * ui.scale))
    small("Measuring …", PALETTE.dim, wide)


def _caption(work: Workspace, state: Histogram, found: Distribution) -> str:
    """Return the range and its number of Gaussians, or the ends of the axis."""
    text = PROPERTIES[state.property].text
    unit = work.view.unit
    low, high = state.range or (found.low, found.high)
    ends = f"{text(low, unit)} to {text(high, unit)}"
    if state.range is None:
        return f"{ends}. Drag over the bars to select"
    return f"{ends}: {group_digits(work.view.selection.count)} splats selected"


def _draw_bars(
    work: Workspace, state: Histogram, found: Distribution, wide: float, ui: UiContext
) -> Workspace:
    tall = HEIGHT_PX * ui.scale
    left, top = imgui.get_cursor_screen_pos()
    imgui.invisible_button("bars", (wide, tall))
    span = found.high - found.low

    def value_at(x: float) -> float:
        return found.low + min(max((x - left) / wide, 0.0), 1.0) * span

    def column_of(value: float) -> float:
        return left + wide * min(max((value - found.low) / span, 0.0), 1.0)

    mouse = value_at(imgui.get_io().mouse_pos.x)
    if imgui.is_item_activated():
        state = _begin(work, state, mouse, _GRIP_PX * ui.scale / wide * span)
    if imgui.is_item_active() and state.anchor is not None:
        state = replace(state, range=(min(state.anchor, mouse), max(state.anchor, mouse)))
        work = _select(work, state, found)
    elif imgui.is_item_deactivated():
        state = replace(state, anchor=None)
    work = with_transient(work, histogram=state)
    if imgui.is_item_hovered() or imgui.is_item_active():
        work = replace(work, pointed=("selection", 0))  # the picture shows the full tint
    canvas = imgui.get_window_draw_list()
    canvas.add_rect_filled((left, top), (left + wide, top + tall), u32(PALETTE.field), 3.0 * ui.scale)
    heights = np.sqrt(found.counts / max(int(found.counts.max()), 1))  # small bins stay visible
    step = wide / BINS
    for i, height in enumerate(heights.tolist()):
        middle = found.low + (i + 0.5) / BINS * span
        inside = state.range is not None and state.range[0] <= middle <= state.range[1]
        color = u32(PALETTE.accent if inside else PALETTE.dim)
        if height > 0.0:
            high = top + tall - max(height * (tall - 4.0 * ui.scale), ui.scale)
            canvas.add_rect_filled(
                (left + i * step, high), (left + (i + 1) * step - 0.15 * step, top + tall), color
            )
    for end in state.range or ():
        x = column_of(end)
        canvas.add_line((x, top), (x, top + tall), u32(PALETTE.handle), 1.5 * ui.scale)
    return work


def _begin(work: Workspace, state: Histogram, at: float, grip: float) -> Histogram:
    """Begin a range at a value, or drag the end of the last range that is within `grip`."""
    if state.range is not None:
        low, high = state.range
        if min(abs(at - low), abs(at - high)) <= grip:
            return replace(state, anchor=high if abs(at - low) < abs(at - high) else low)
    mode = _MODES.get(modifier(), "new")
    return replace(state, anchor=at, mode=mode, base=work.view.selection.members)


def _select(work: Workspace, state: Histogram, found: Distribution) -> Workspace:
    """Select the Gaussians of the range, combined with the selection before the press."""
    if state.range is None:
        return work
    mask = rows_between(found, *state.range)
    base = selection.unpack(state.base, len(mask))
    if state.mode == "add":
        mask |= base
    elif state.mode == "subtract":
        mask = base & ~mask
    view = work.view
    return replace(work, view=replace(view, selection=selection.select(view.selection, mask)))
