"""The timeline along the lower edge of the picture: keys and playhead to drag, and its few settings.

It changes nothing itself: it returns actions of `timeline.ACTIONS`, as keys do.
"""

from __future__ import annotations

import math

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui

from viewer.state.timeline import EASINGS, Player, key_at, key_before
from viewer.state.view_state import FASTEST, LONGEST, Timeline
from viewer.ui.context import PALETTE, SMALL_PX, UiContext, u32
from viewer.ui.overlay import Area
from viewer.ui.widgets import hint, icon_button, icon_row, is_released, plate, tip

HEIGHT_PX, ROW_PX = 46.0, 33.0  # at 1×: of the bar, and of a second row
ROOMY_PX = 520.0  # a narrower bar has its settings in a second row
SETTINGS_PX = 291.0
_KEY_PX, _GRIP_PX = 5.0, 8.0  # half a key's size; so near to a key the mouse takes it
_NICE = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)


def height(player: Player, area: Area, ui: UiContext) -> float:
    """How much of the picture it covers, window pixels."""
    return _bar_height(area, ui) if player.shown else 0.0


def _is_wide(area: Area, ui: UiContext) -> bool:
    return area.width >= ROOMY_PX * ui.scale


def _bar_height(area: Area, ui: UiContext) -> float:
    return (HEIGHT_PX if _is_wide(area, ui) else HEIGHT_PX + ROW_PX) * ui.scale


def draw(timeline: Timeline, player: Player, frame: str, area: Area, ui: UiContext) -> tuple[str, ...]:
    """Draw the bar over the lower edge of `area`, between `imgui.new_frame` and `imgui.render`.

    `frame`: the safe frame, see `ViewState`.

    Returns:
        What was asked for: actions of the workspace.
    """
    tall, roomy = _bar_height(area, ui), _is_wide(area, ui)
    actions: list[str] = []
    place = imgui.ImVec2(0.0, area.height - tall)
    with plate("timeline", place, ui, pad=10.0, size=imgui.ImVec2(area.width, tall)):
        at = min(player.frame, timeline.length)
        _buttons(timeline, player, at, actions, ui)
        settings = SETTINGS_PX * ui.scale if roomy else 0.0
        wide = max(imgui.get_content_region_avail().x - settings, 40.0 * ui.scale)
        _ruler(timeline, at, wide, actions, ui)
        if roomy:
            imgui.same_line(0.0, 12.0 * ui.scale)
        _settings(timeline, at, actions, ui)
        imgui.same_line(0.0, 4.0 * ui.scale)
        if icon_button("safe_frame", icons.ICON_FA_CROP_SIMPLE, ui, dim=not frame):
            actions.append("safe_frame")
        hint("safe_frame", f"Now {frame or 'none'}")
    return tuple(actions)


def place(timeline: Timeline, frame: float, start: float, span: float) -> float:
    """Where a frame stands on a ruler that begins at `start`, window pixels."""
    return start + span * frame / timeline.length


def label_step(timeline: Timeline, span: float, room: float) -> int:
    """Every how many frames the ruler has a number, so that each has `room` pixels."""
    least = timeline.length * room / max(span, 1.0)
    return next((step for step in _NICE if step >= least), _NICE[-1])


def _buttons(timeline: Timeline, player: Player, frame: int, actions: list[str], ui: UiContext) -> None:
    icon = icons.ICON_FA_PAUSE if player.playing else icons.ICON_FA_PLAY
    on_key, can_play = key_at(timeline, frame) is not None, len(timeline.keys) > 1
    items = (
        ("play", icon, "" if can_play else "Set at least two keyframes to play"),
        ("key", icons.ICON_FA_DIAMOND, "In place of the present one" if on_key else ""),
        ("drop_key", icons.ICON_FA_TRASH_CAN),
    )
    off = [*["play"] * (not can_play), *["drop_key"] * (not on_key)]
    icon_row(items, ui, actions, 2.0 * ui.scale, off=off)
    imgui.same_line(0.0, 10.0 * ui.scale)


def _settings(timeline: Timeline, frame: int, actions: list[str], ui: UiContext) -> None:
    gap = 4.0 * ui.scale
    imgui.begin_disabled(not timeline.keys)
    easing = key_before(timeline, frame).easing if timeline.keys else EASINGS[0]
    if imgui.button(f"{easing.capitalize()}##easing", imgui.ImVec2(62.0 * ui.scale, 0.0)):
        actions.append("easing")
    imgui.end_disabled()
    hint("easing")
    imgui.same_line(0.0, gap)
    if icon_button("ping_pong", icons.ICON_FA_RIGHT_LEFT, ui, dim=not timeline.ping_pong):
        actions.append("ping_pong")
    hint("ping_pong", "Now " + ("on" if timeline.ping_pong else "off"))
    imgui.same_line(0.0, gap)
    for name, now, most, unit, what in (
        ("length", timeline.length, LONGEST, "f", "Length in frames"),
        ("fps", timeline.fps, FASTEST, "fps", "Frames per second"),
    ):
        imgui.set_next_item_width(58.0 * ui.scale)
        changed, value = imgui.drag_int(
            f"##{name}", now, 0.25, 1, most, f"%d {unit}", imgui.SliderFlags_.always_clamp.value
        )
        if changed and value != now:
            actions.append(f"{name}:{value}")
        tip(f"{what}; drag, or Ctrl+click to type")
        imgui.same_line(0.0, gap)
    imgui.begin_disabled(not timeline.keys)
    if icon_button("timeline_file", icons.ICON_FA_FILE_EXPORT, ui, dim=not timeline.keys):
        actions.append("timeline_file")
    imgui.end_disabled()
    hint("timeline_file")


def _ruler(timeline: Timeline, frame: int, wide: float, actions: list[str], ui: UiContext) -> None:
    """The ruler: press or drag moves the playhead, or the key that was under the mouse."""
    scale = ui.scale
    left, top = imgui.get_cursor_screen_pos()
    tall = imgui.get_frame_height()
    inset = 8.0 * scale
    start, span = left + inset, max(wide - 2 * inset, 1.0)
    imgui.invisible_button("ruler", imgui.ImVec2(max(wide, 1.0), tall))
    lit = imgui.is_item_hovered() or imgui.is_item_active()
    mouse = imgui.get_io().mouse_pos.x
    under = _key_under(timeline, start, span, mouse, scale) if lit else None
    storage, slot = imgui.get_state_storage(), imgui.get_id("ruler/held")
    to = max(0, min(timeline.length, round((mouse - start) / span * timeline.length)))
    if imgui.is_item_activated():
        storage.set_int(slot, -1 if under is None else under)
        actions.append(f"seek:{to if under is None else under}")
    elif imgui.is_item_active() or is_released():  # a slow frame may hold move and release
        origin = storage.get_int(slot, -1)
        moved = imgui.get_mouse_drag_delta(0, 3.0 * scale).x != 0.0 or imgui.is_item_deactivated()
        if origin < 0 and to != frame:
            actions.append(f"seek:{to}")
        elif origin >= 0 and moved and to != origin and key_at(timeline, to) is None:
            actions.append(f"move_key:{origin}>{to}")
            storage.set_int(slot, to)
    if under is not None:
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)
    _paint(timeline, frame, start, span, top, top + tall - 6.0 * scale, under, ui)


def _key_under(timeline: Timeline, start: float, span: float, mouse: float, scale: float) -> int | None:
    """The frame of the nearest key within reach of the mouse."""
    places = [(abs(mouse - place(timeline, key.frame, start, span)), key.frame) for key in timeline.keys]
    distance, frame = min(places, default=(math.inf, 0))
    return frame if distance <= _GRIP_PX * scale else None


def _paint(
    timeline: Timeline,
    frame: int,
    start: float,
    span: float,
    top: float,
    line: float,
    under: int | None,
    ui: UiContext,
) -> None:
    canvas, p, scale = imgui.get_window_draw_list(), PALETTE, ui.scale
    thin = max(1.0, scale)
    canvas.add_line(imgui.ImVec2(start, line), imgui.ImVec2(start + span, line), u32(p.faint), thin)
    _paint_numbers(timeline, frame, start, span, top, line, ui)
    for key in timeline.keys:
        x, size = place(timeline, key.frame, start, span), (_KEY_PX + (key.frame == under)) * scale
        color = u32(p.handle if key.frame in (frame, under) else p.dim)
        _paint_key(canvas, x, line, size, color, key.easing)
    if not timeline.keys:
        hint = "Press K to insert a keyframe"
        size = SMALL_PX * scale
        at = imgui.ImVec2(round(start + 40.0 * scale), round(line - size - 3.0 * scale))
        canvas.add_text(ui.fonts.regular, size, at, u32(p.dim), hint)
    x = round(place(timeline, frame, start, span)) + 0.5
    canvas.add_line(imgui.ImVec2(x, top - 2.0 * scale), imgui.ImVec2(x, line), u32(p.accent), 1.5 * scale)
    canvas.add_triangle_filled(
        imgui.ImVec2(x - 5.0 * scale, top - 4.0 * scale),
        imgui.ImVec2(x + 5.0 * scale, top - 4.0 * scale),
        imgui.ImVec2(x, top + 3.0 * scale),
        u32(p.accent),
    )


def _paint_numbers(
    timeline: Timeline, frame: int, start: float, span: float, top: float, line: float, ui: UiContext
) -> None:
    """Ticks and frame numbers; the playhead's own number in place of those near it."""
    canvas, p, scale = imgui.get_window_draw_list(), PALETTE, ui.scale
    size = 11.0 * scale
    step = label_step(timeline, span, 38.0 * scale)
    fine = label_step(timeline, span, 7.0 * scale)
    for tick in range(0, timeline.length + 1, fine):
        x = round(place(timeline, tick, start, span)) + 0.5
        high = (5.0 if tick % step == 0 else 2.5) * scale
        canvas.add_line(imgui.ImVec2(x, line - high), imgui.ImVec2(x, line), u32(p.faint), max(1.0, scale))
    here = place(timeline, frame, start, span)
    numbers = range(0, timeline.length + 1, step) if timeline.keys else ()
    for number in (*(n for n in numbers if n != frame), frame):
        x, text = place(timeline, number, start, span), str(number)
        if number != frame and -16.0 * scale < x - here < 36.0 * scale:
            continue
        color = u32(p.accent if number == frame else p.dim)
        # the playhead's number stands beside its handle, left of it at the end of the ruler
        after = x - 3.2 * scale * len(text)
        if number == frame:
            after = x + 7.0 * scale if x < start + span - 20.0 * scale else x - (7 + 6.4 * len(text)) * scale
        at = imgui.ImVec2(round(after), round(top - 4.0 * scale))
        canvas.add_text(ui.fonts.regular, size, at, color, text)


def _paint_key(canvas: imgui.ImDrawList, x: float, y: float, size: float, color: int, easing: str) -> None:
    """Smooth is round, linear a diamond, hold a square."""
    edge = u32(PALETTE.panel)
    if easing == "smooth":
        canvas.add_circle_filled(imgui.ImVec2(x, y), size + 1.5, edge)
        canvas.add_circle_filled(imgui.ImVec2(x, y), size, color)
        return
    corners = 4
    turn = 0.0 if easing == "linear" else math.pi / 4
    for radius, ink in ((size * 1.2 + 2.0, edge), (size * 1.2, color)):
        points = [turn + 2 * math.pi * i / corners for i in range(corners)]
        a, b, c, d = (imgui.ImVec2(x + radius * math.cos(t), y + radius * math.sin(t)) for t in points)
        canvas.add_quad_filled(a, b, c, d, ink)
