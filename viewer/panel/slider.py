"""Strength slider: 0 is the original, 1 the full edit; ticks mark the recorded strengths.

A press on the track jumps there, a press on the handle grabs it, and Shift drags ten times finer. Ctrl+click,
or a click on the number, opens a text field. A double click resets to 0. With overshoot the slider goes
beyond 1, on a warning color.
"""

from __future__ import annotations

from collections.abc import Sequence

from imgui_bundle import imgui

from viewer.ui.context import PALETTE, Rgba, UiContext, u32
from viewer.ui.widgets import is_entered, is_released, key_step, tip_once

HEIGHT_PX = 20.0  # at 1×; also the height of its text field, so that opening it moves nothing
RADIUS_PX = 7.0  # radius of the handle, at 1×
FINE = 0.1  # factor on the movement of a drag with Shift
DEFAULT = 0.0
"""Strength of the original; a double click resets to it."""
TIP = "Double-click: reset to 0. Ctrl+click: type a value. Shift+drag: fine adjustment."


def parse_strength(text: str, most: float = 1.0) -> float | None:
    """Parse a typed strength ("0.7", "70%", ",7") and clamp it to 0..`most`; return None if it is
    not a number."""
    cleaned = text.strip().replace(",", ".")
    percent = cleaned.endswith("%")
    try:
        value = float(cleaned.rstrip("% "))
    except ValueError:
        return None
    value = value / 100.0 if percent else value
    return min(most, max(0.0, value)) if value == value else None


def draw(
    label: str,
    value: float,
    ticks: Sequence[float],
    width: float,
    ui: UiContext,
    fill: Rgba,
    active: bool = True,
    most: float = 1.0,
    height: float = HEIGHT_PX,
    default: float = DEFAULT,
    help_: str = TIP,
) -> float:
    """Draw the slider at the cursor and return its new value.

    Args:
        label: imgui id
        value: strength, 0..`most`
        ticks: recorded strengths, 0..1
        width: width in window pixels
        ui: fonts and scale
        fill: color of the track up to the handle
        active: False draws it muted, for a hidden layer; it still works
        most: upper end; beyond 1 the track has a warning color
        height: height at 1×; at less than `HEIGHT_PX` there are no ticks
        default: value after a double click
        help_: text of the tooltip, shown for one slider per session
    """
    scale = ui.scale
    storage = imgui.get_state_storage()
    if storage.get_bool(_slot(label, "typing")):
        return _text_field(label, value, width, most)
    left, top = imgui.get_cursor_screen_pos()
    if storage.get_bool(_slot(label, "entered")):  # after typing, the keyboard focus returns to the slider
        storage.set_bool(_slot(label, "entered"), False)
        imgui.set_keyboard_focus_here()
        imgui.set_nav_cursor_visible(True)
    imgui.invisible_button(label, (width, height * scale), imgui.ButtonFlags_.enable_nav.value)
    hovered = imgui.is_item_hovered()
    pressed = imgui.is_item_active()
    radius = RADIUS_PX * scale
    start = left + radius
    span = max(width - 2 * radius, 1.0) / most
    mouse = imgui.get_io().mouse_pos.x
    if imgui.is_item_focused() and imgui.get_current_context().nav_cursor_visible:
        value = min(most, max(0.0, value + key_step(imgui.Key.left_arrow, imgui.Key.right_arrow)))
    if is_entered():
        start_typing(label)
        storage.set_bool(_slot(label, "entered"), True)
    elif imgui.is_item_activated():
        if imgui.get_io().key_ctrl:
            start_typing(label)
            imgui.set_cursor_screen_pos((left, top))
            return _text_field(label, value, width, most)  # at once, so that no typed letter is lost
        on_handle = abs(mouse - (start + value * span)) <= radius + 2.0 * scale
        value = value if on_handle else min(most, max(0.0, (mouse - start) / span))
        value = default if imgui.is_mouse_double_clicked(imgui.MouseButton_.left.value) else value
        _anchor(label, mouse, value)
    elif pressed or is_released():  # a slow frame may contain the last move and the release
        was_fine = storage.get_bool(_slot(label, "fine"))
        moved = (mouse - storage.get_float(_slot(label, "x"))) / span * (FINE if was_fine else 1.0)
        value = min(most, max(0.0, storage.get_float(_slot(label, "value")) + moved))
        if was_fine != imgui.get_io().key_shift:
            _anchor(label, mouse, value)  # after the move: a slow frame may contain both
    if not pressed:
        tip_once(help_, ui)
    ui.is_sliding |= pressed
    color = fill if active else PALETTE.faint
    ticks = ticks if height >= HEIGHT_PX else ()
    _paint((start, top, span), value, ticks, scale, color, hovered or pressed, most)
    return value


def start_typing(label: str) -> None:
    """Turn the slider of this label into a text field with the keyboard focus."""
    for slot in ("typing", "wants focus"):
        imgui.get_state_storage().set_bool(_slot(label, slot), True)


def _slot(label: str, name: str) -> int:
    """Return the id of a stored value of this slider in imgui's state storage."""
    return int(imgui.get_id(f"{label}/{name}"))


def _anchor(label: str, mouse: float, value: float) -> None:
    storage = imgui.get_state_storage()
    storage.set_float(_slot(label, "x"), mouse)
    storage.set_float(_slot(label, "value"), value)
    storage.set_bool(_slot(label, "fine"), imgui.get_io().key_shift)


def _text_field(label: str, value: float, width: float, most: float) -> float:
    storage = imgui.get_state_storage()
    if storage.get_bool(_slot(label, "wants focus")):
        imgui.set_keyboard_focus_here()
        storage.set_bool(_slot(label, "wants focus"), False)
    imgui.set_next_item_width(width)
    padding = imgui.get_style().frame_padding
    imgui.push_style_var(imgui.StyleVar_.frame_padding, (padding.x, padding.y / 2))
    flags = imgui.InputTextFlags_.enter_returns_true.value | imgui.InputTextFlags_.auto_select_all.value
    entered, text = imgui.input_text(f"{label}/field", f"{value:.3f}", flags)
    imgui.pop_style_var()
    left = imgui.is_item_deactivated()
    if entered or left:
        storage.set_bool(_slot(label, "typing"), False)
    accepted = entered or imgui.is_item_deactivated_after_edit()
    parsed = parse_strength(text, most) if accepted else None
    return value if parsed is None else parsed


def _paint(
    track: tuple[float, float, float],
    value: float,
    ticks: Sequence[float],
    scale: float,
    fill: Rgba,
    lit: bool,
    most: float,
) -> None:
    """Draw the slider; `track`: x of strength 0, its top, and the length of strength 1, window pixels."""
    canvas = imgui.get_window_draw_list()
    p = PALETTE
    start, top, span = track
    radius = RADIUS_PX * scale
    middle = top + radius + 1.0 * scale
    half = 2.0 * scale
    at = start + value * span
    canvas.add_rect_filled(
        (start - half, middle - half), (start + span * most + half, middle + half), u32(p.field), half
    )
    canvas.add_rect_filled((start - half, middle - half), (at, middle + half), u32(fill), half)
    if most > 1.0:
        for end, ink in ((start + span * most + half, p.warning_dark), (max(at, start + span), p.warning)):
            canvas.add_rect_filled((start + span, middle - half), (end, middle + half), u32(ink), half)
    foot = middle + radius + 1.0 * scale
    for tick in ticks:
        x = round(start + tick * span) + 0.5
        tall = 4.0 if tick in (0.0, 1.0) else 3.0
        canvas.add_line((x, foot), (x, foot + tall * scale), u32(p.dim), max(1.0, scale))
    canvas.add_circle_filled((at, middle), radius + 1.0 * scale, u32(p.card))
    canvas.add_circle_filled((at, middle), radius - (0.0 if lit else 1.0) * scale, u32(p.handle))
