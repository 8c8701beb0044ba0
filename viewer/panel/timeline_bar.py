"""Timeline along the lower edge of the picture: keyframes and playhead to drag, rows, and settings.

It changes no state: it returns commands, like keyboard input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from imgui_bundle import icons_fontawesome_6 as icons
from imgui_bundle import imgui, imgui_ctx

from viewer.camera.views import value_between
from viewer.state.commands import Action, ChooseKeys, OnItem, Plain, WithValue
from viewer.state.timeline import (
    CAMERA,
    EASINGS,
    Player,
    RowKey,
    chosen_keys,
    key_before,
    keys_at,
    shift_keys,
    split_keys,
    tracks,
)
from viewer.state.view_state import MAX_FPS, MAX_FRAME, Keyframe, Timeline
from viewer.state.workspace import Workspace
from viewer.ui.context import GAP_PX, PALETTE, ROW_COLORS, SMALL_PX, Icon, Rgba, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.overlay import Area
from viewer.ui.widgets import elide, hint, icon_button, icon_row, inert, is_released, plate, tip

HEIGHT_PX = 40.0  # height of the bar, at 1×
ROW_PX = 32.0  # height of the second line of a narrow bar
TRACK_PX = 20.0  # height of a row of keyframes
_MAX_SHARE = 0.35  # maximum height of the rows, as a share of the picture's height
ROOMY_PX = 640.0  # a narrower bar has its settings in a second line
SETTINGS_PX = 285.0  # width of the settings
BUTTONS_PX = 131.0  # width of the buttons
_KEY_PX = 5.0  # half the size of a key
_GRIP_PX = 8.0  # distance within which the mouse grabs a key
_CURVE_PX = 3.0  # distance between two points of a curve
_GAP_PX = 8.0  # gap under the rows
_LABEL_STEPS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)


@dataclass(frozen=True)
class _Ruler:
    """Timeline on the screen."""

    timeline: Timeline
    player: Player
    keys: Mapping[RowKey, Keyframe]  # keys of each row, see `split_keys`
    start: float  # x of frame 0, window pixels
    span: float  # distance from frame 0 to the last frame, window pixels
    ui: UiContext

    @property
    def frame(self) -> int:
        """Frame of the playhead."""
        return min(self.player.frame, self.timeline.length)

    def x(self, frame: float) -> float:
        return place(self.timeline, frame, self.start, self.span)

    def frame_at(self, x: float) -> int:
        length = self.timeline.length
        return max(0, min(length, round((x - self.start) / self.span * length)))


def height(work: Workspace, area: Area, ui: UiContext) -> float:
    """Return the height of the picture that the bar covers, in window pixels."""
    return _bar_height(work, area, ui) if work.player.shown else 0.0


def _is_wide(area: Area, ui: UiContext) -> bool:
    return area.width >= ROOMY_PX * ui.scale


def _bar_height(work: Workspace, area: Area, ui: UiContext) -> float:
    tall = (HEIGHT_PX if _is_wide(area, ui) else HEIGHT_PX + ROW_PX) * ui.scale
    return tall + _rows_height(work, area, ui)


def _rows_height(work: Workspace, area: Area, ui: UiContext) -> float:
    max_rows = max(2, int(_MAX_SHARE * area.height / (TRACK_PX * ui.scale)))
    rows = min(len(work.view.layers) + 1, max_rows) * TRACK_PX
    return (rows + _GAP_PX) * ui.scale if work.player.unfolded else 0.0


def draw(work: Workspace, area: Area, ui: UiContext) -> tuple[Action, ...]:
    """Draw the bar over the lower edge of `area`, between `imgui.new_frame` and `imgui.render`.

    Returns:
        Requested actions of the workspace.
    """
    tall = _bar_height(work, area, ui)
    roomy = _is_wide(area, ui)
    scale = ui.scale
    timeline = work.view.timeline
    actions = list[Action]()
    corner = (0.0, area.height - tall)
    with plate("timeline", corner, ui, size=(area.width, tall)):
        left = imgui.get_cursor_screen_pos().x
        keys = split_keys(timeline)
        _buttons(timeline, work.player, actions, ui)
        imgui.same_line((BUTTONS_PX + GAP_PX) * scale)
        settings = SETTINGS_PX * scale if roomy else 0.0
        wide = max(imgui.get_content_region_avail().x - settings, 40.0 * scale)
        start = left + (BUTTONS_PX + 8.0) * scale
        ruler = _Ruler(timeline, work.player, keys, start, max(wide - 16.0 * scale, 1.0), ui)
        _draw_ruler(ruler, wide, actions)
        if roomy:
            imgui.same_line(0.0, GAP_PX * scale)
            _settings(work, ruler, actions)
        if work.player.unfolded:
            _rows(work, ruler, left, _rows_height(work, area, ui), actions)
        if not roomy:
            _settings(work, ruler, actions)
    return tuple(actions)


def place(timeline: Timeline, frame: float, start: float, span: float) -> float:
    """Return the x of a frame on a ruler that begins at `start`, in window pixels."""
    return start + span * frame / timeline.length


def label_step(timeline: Timeline, span: float, room: float) -> int:
    """Return the number of frames between two numbers on the ruler that gives each `room` pixels."""
    min_step = timeline.length * room / max(span, 1.0)
    return next((step for step in _LABEL_STEPS if step >= min_step), _LABEL_STEPS[-1])


def _buttons(timeline: Timeline, player: Player, actions: list[Action], ui: UiContext) -> None:
    gap = 2.0 * ui.scale
    auto = player.auto_key is not None
    folds = Icon.UNFOLDED if player.unfolded else Icon.FOLDED
    icon_row((("timeline_rows", folds),), ui, actions)
    imgui.same_line(0.0, gap)
    icon = icons.ICON_FA_PAUSE if player.playing else icons.ICON_FA_PLAY
    here = keys_at(timeline, player.frame)
    can_play = len(timeline.keys) > 1
    chosen = chosen_keys(timeline, player)
    items = (
        ("play", icon, "" if can_play else "Set at least two keyframes to play"),
        ("key", icons.ICON_FA_DIAMOND, "Replaces the current one" if here else ""),
        ("drop_key", icons.ICON_FA_TRASH_CAN, "The selected keyframes" if chosen else ""),
    )
    off = []
    if not can_play:
        off.append("play")
    if not (here or chosen):
        off.append("drop_key")
    icon_row(items, ui, actions, gap, off=off)
    imgui.same_line(0.0, gap)
    imgui.push_style_color(imgui.Col_.text, PALETTE.error if auto else PALETTE.faint)
    if imgui.button(f"{icons.ICON_FA_CIRCLE}##auto", (imgui.get_frame_height(), 0.0)):
        actions.append(Plain("auto_key"))
    imgui.pop_style_color()
    hint("auto_key", "Now " + ("on" if auto else "off"))


def _settings(work: Workspace, ruler: _Ruler, actions: list[Action]) -> None:
    timeline = ruler.timeline
    ui = ruler.ui
    gap = 4.0 * ui.scale
    with inert(not timeline.keys):
        easing = EASINGS[0]
        if timeline.keys:
            chosen = chosen_keys(timeline, ruler.player)
            easing = (ruler.keys[min(chosen)] if chosen else key_before(timeline, ruler.frame)).easing
        if imgui.button(f"{easing.capitalize()}##easing", (58.0 * ui.scale, 0.0)):
            actions.append(Plain("easing"))
    hint("easing", "Of the selected keyframes, if any")
    imgui.same_line(0.0, gap)
    if icon_button("ping_pong", icons.ICON_FA_RIGHT_LEFT, ui, dim=not timeline.ping_pong):
        actions.append(Plain("ping_pong"))
    hint("ping_pong", "Now " + ("on" if timeline.ping_pong else "off"))
    imgui.same_line(0.0, gap)
    count = timeline.length + 1
    for name, now, ends, unit, help_text in (
        ("length", count, (2, MAX_FRAME + 1), "f", f"0 to {timeline.length}: {count / timeline.fps:.2f} s"),
        ("fps", timeline.fps, (1, MAX_FPS), "fps", "Frames per second"),
    ):
        imgui.set_next_item_width(54.0 * ui.scale)
        clamp = imgui.SliderFlags_.always_clamp.value
        changed, value = imgui.drag_int(f"##{name}", now, 0.25, *ends, f"%d {unit}", clamp)
        if changed and value != now:
            actions.append(WithValue(name, value - 1 if name == "length" else value))
        tip(f"{help_text}; drag, or Ctrl+click to type")
        imgui.same_line(0.0, gap)
    if imgui.button("Film…"):
        actions.append(Plain("render_film"))
    hint("render_film")
    imgui.same_line(0.0, gap)
    frame = work.view.safe_frame
    if icon_button("safe_frame", icons.ICON_FA_CROP_SIMPLE, ui, dim=not frame):
        actions.append(Plain("safe_frame"))
    hint("safe_frame", f"Now {frame or 'none'}")


def _draw_ruler(ruler: _Ruler, wide: float, actions: list[Action]) -> None:
    """Draw the keys of all rows, the frame numbers and the playhead."""
    frames: dict[int, list[RowKey]] = {}
    for key in ruler.keys:
        frames.setdefault(key[1], []).append(key)
    top = imgui.get_cursor_screen_pos().y
    tall = imgui.get_frame_height()
    under = _drag("ruler", frames, (max(wide, 1.0), tall), ruler, actions)
    _paint(ruler, frames, top, top + tall - 6.0 * ruler.ui.scale, under)


def _drag(
    name: str,
    frames: Mapping[int, Sequence[RowKey]],
    size: imgui.ImVec2Like,
    ruler: _Ruler,
    actions: list[Action],
) -> int | None:
    """Drag the keys under the mouse, copies of them with Ctrl, or else the playhead.

    Returns:
        Frame of the keys under the mouse, None without any.
    """
    imgui.invisible_button(name, size)
    io = imgui.get_io()
    timeline = ruler.timeline
    player = ruler.player
    mouse = io.mouse_pos.x
    hovered_frame = None
    if imgui.is_item_hovered() or imgui.is_item_active():
        distance, nearest = min(((abs(mouse - ruler.x(f)), f) for f in frames), default=(math.inf, 0))
        hovered_frame = nearest if distance <= _GRIP_PX * ruler.ui.scale else None
    storage = imgui.get_state_storage()
    mouse_frame = ruler.frame_at(mouse)
    held = imgui.get_id(f"{name}/held")
    copies = imgui.get_id(f"{name}/copies")
    if imgui.is_item_activated():
        storage.set_int(held, -1 if hovered_frame is None else hovered_frame)
        storage.set_int(copies, int(io.key_ctrl))
        keys = () if hovered_frame is None else frames[hovered_frame]
        if io.key_shift or not keys or not set(keys) <= player.chosen:
            actions.append(ChooseKeys(frozenset(keys), toggles=io.key_shift))
        actions.append(WithValue("seek", mouse_frame if hovered_frame is None else hovered_frame))
    elif imgui.is_item_active() or is_released():  # a slow frame may contain move and release
        origin = storage.get_int(held, -1)
        moved = imgui.get_mouse_drag_delta(0, 3.0 * ruler.ui.scale).x != 0.0 or imgui.is_item_deactivated()
        if origin < 0 and mouse_frame != ruler.frame:
            actions.append(WithValue("seek", mouse_frame))
        elif origin >= 0 and moved and mouse_frame != origin:
            copy = bool(storage.get_int(copies, 0))
            chosen = chosen_keys(timeline, player)
            if shift_keys(timeline, chosen, mouse_frame - origin, copy) is not timeline:
                actions.append(WithValue("clone_keys" if copy else "move_keys", mouse_frame - origin))
                storage.set_int(held, mouse_frame)
                storage.set_int(copies, 0)
    if hovered_frame is not None:
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)
    return hovered_frame


def _rows(work: Workspace, ruler: _Ruler, left: float, tall: float, actions: list[Action]) -> None:
    """Draw a row of keys for the camera and each layer, in the panel's order; many rows scroll."""
    layers = list(enumerate(reversed(work.view.layers), 1))
    curves = tracks(ruler.timeline)
    imgui.push_style_var(imgui.StyleVar_.item_spacing, (0.0, 0.0))
    imgui.begin_child("rows", (0.0, tall - _GAP_PX * ruler.ui.scale))
    _row(CAMERA, "Camera", PALETTE.handle, (), ruler, left, False, actions)
    for number, layer in layers:
        focused = work.focus == len(layers) - number
        color = ROW_COLORS[layer.gdf % len(ROW_COLORS)]
        points = curves.get(layer.gdf, ())
        if _row(layer.gdf, layer.name, color, points, ruler, left, focused, actions):
            actions.append(OnItem("focus", number))
    imgui.end_child()
    imgui.pop_style_var()


def _row(
    row: int,
    name: str,
    color: Rgba,
    points: Sequence[tuple[int, str, float]],
    ruler: _Ruler,
    left: float,
    focused: bool,
    actions: list[Action],
) -> bool:
    """Draw the name, the button for a key at the playhead, the keys and the curve; return True if the name
    is pressed."""
    canvas = imgui.get_window_draw_list()
    p = PALETTE
    scale = ruler.ui.scale
    tall = TRACK_PX * ruler.ui.scale
    top = imgui.get_cursor_screen_pos().y
    end = ruler.start + ruler.span + 8.0 * scale
    with imgui_ctx.push_id(row):
        with imgui_ctx.push_font(None, SMALL_PX):
            names = ruler.start - 8.0 * scale - left - tall
            pressed = imgui.invisible_button("name", (names, tall))
            lit = focused or (imgui.is_item_hovered() and row != CAMERA)
            if focused:
                corner = (end, top + tall)
                canvas.add_rect_filled((left, top), corner, u32(p.card_focused), 3.0 * scale)
            at = (round(left + 6.0 * scale), round(top + 3.0 * scale))
            ink = u32(p.text if lit else p.dim)
            canvas.add_text(at, ink, elide(name, names - 8.0 * scale))
            imgui.same_line(0.0, 0.0)
            here = (row, ruler.frame) in ruler.keys
            if imgui.invisible_button("key", (tall, tall)):
                actions.append(OnItem("drop_key" if here else "key", row))
            ink = u32(color if here else p.faint)
            if imgui.is_item_hovered():
                ink = u32(p.handle)
            middle = (left + names + tall / 2, top + tall / 2)
            (canvas.add_ngon_filled if here else canvas.add_ngon)(middle, 4.5 * scale, ink, 4)
            tip(f"{'Delete' if here else 'Insert'} a keyframe of {name} at the playhead")
        imgui.same_line(0.0, 0.0)
        frames = {frame: [(row, frame)] for r, frame in ruler.keys if r == row}
        under = _drag("keys", frames, (end - ruler.start + 8.0 * scale, tall), ruler, actions)
    line = max(1.0, scale)
    low = top + tall - 3.0 * scale
    high = top + 3.0 * scale
    ends = (ruler.start, low), (ruler.start + ruler.span, low)
    canvas.add_line(*ends, u32(p.line), line)
    if points:
        count = max(2, int(ruler.span / (_CURVE_PX * scale)))
        frames_shown = [ruler.timeline.length * i / count for i in range(count + 1)]
        curve = [(ruler.x(f), low - min(value_between(points, f), 1.0) * (low - high)) for f in frames_shown]
        canvas.add_polyline([*curve], u32((*color[:3], 0.75)), line, 0)
    _paint_keys(ruler, frames, top + tall / 2, under, color)
    x = round(ruler.x(ruler.frame)) + 0.5
    canvas.add_line((x, top), (x, top + tall), u32(p.accent), line)
    return bool(pressed and row != CAMERA)


def _paint_keys(
    ruler: _Ruler, frames: Mapping[int, Sequence[RowKey]], y: float, under: int | None, color: Rgba
) -> None:
    """Draw the keys on a line. Chosen and hovered ones are white, and a key of a single row is smaller."""
    canvas = imgui.get_window_draw_list()
    scale = ruler.ui.scale
    for frame, keys in frames.items():
        size = _KEY_PX
        if len(keys) == 1:
            size -= 0.5
        if frame == under:
            size += 1.0
        chosen = not ruler.player.chosen.isdisjoint(keys)
        ink = u32(PALETTE.handle if chosen or frame == under else color)
        _paint_key(canvas, ruler.x(frame), y, size * scale, ink, ruler.keys[keys[0]].easing)


def _paint(
    ruler: _Ruler, frames: Mapping[int, Sequence[RowKey]], top: float, line: float, under: int | None
) -> None:
    timeline = ruler.timeline
    ui = ruler.ui
    start = ruler.start
    span = ruler.span
    canvas = imgui.get_window_draw_list()
    p = PALETTE
    scale = ui.scale
    thin = max(1.0, scale)
    canvas.add_line((start, line), (start + span, line), u32(p.faint), thin)
    _paint_numbers(timeline, ruler.frame, start, span, top, line, ui)
    here = {frame: keys for frame, keys in frames.items() if frame == ruler.frame}
    _paint_keys(
        ruler, {frame: keys for frame, keys in frames.items() if frame not in here}, line, under, p.dim
    )
    _paint_keys(ruler, here, line, under, p.handle)
    if not timeline.keys:
        chord = shortcut("key")
        text = f"Press {chord} to insert a keyframe" if chord else "No keyframes yet"
        size = SMALL_PX * scale
        at = (round(start + 40.0 * scale), round(line - size - 3.0 * scale))
        canvas.add_text(ui.fonts.regular, size, at, u32(p.dim), text)
    x = round(ruler.x(ruler.frame)) + 0.5
    canvas.add_line((x, top - 2.0 * scale), (x, line), u32(p.accent), 1.5 * scale)
    canvas.add_triangle_filled(
        (x - 5.0 * scale, top - 4.0 * scale),
        (x + 5.0 * scale, top - 4.0 * scale),
        (x, top + 3.0 * scale),
        u32(p.accent),
    )


def _paint_numbers(
    timeline: Timeline, frame: int, start: float, span: float, top: float, line: float, ui: UiContext
) -> None:
    """Draw ticks and frame numbers. The playhead's number replaces those near it."""
    canvas = imgui.get_window_draw_list()
    p = PALETTE
    scale = ui.scale
    size = 11.0 * scale
    step = label_step(timeline, span, 38.0 * scale)
    fine = label_step(timeline, span, 7.0 * scale)
    for tick in range(0, timeline.length + 1, fine):
        x = round(place(timeline, tick, start, span)) + 0.5
        high = (5.0 if tick % step == 0 else 2.5) * scale
        canvas.add_line((x, line - high), (x, line), u32(p.faint), max(1.0, scale))
    here = place(timeline, frame, start, span)
    numbers = range(0, timeline.length + 1, step) if timeline.keys else ()
    for number in (*(n for n in numbers if n != frame), frame):
        x = place(timeline, number, start, span)
        text = str(number)
        if number != frame and -16.0 * scale < x - here < 36.0 * scale:
            continue
        color = u32(p.accent if number == frame else p.dim)
        # the playhead's number is beside its handle, to its left near the end of the ruler
        after = x - 3.2 * scale * len(text)
        if number == frame:
            after = x + 7.0 * scale if x < start + span - 20.0 * scale else x - (7 + 6.4 * len(text)) * scale
        at = (round(after), round(top - 4.0 * scale))
        canvas.add_text(ui.fonts.regular, size, at, color, text)


def _paint_key(canvas: imgui.ImDrawList, x: float, y: float, size: float, color: int, easing: str) -> None:
    """Draw a key: smooth is round, linear a diamond, hold a square."""
    edge = u32(PALETTE.panel)
    if easing == "smooth":
        canvas.add_circle_filled((x, y), size + 1.5, edge)
        canvas.add_circle_filled((x, y), size, color)
        return
    corners = 4
    turn = 0.0 if easing == "linear" else math.pi / 4
    for radius, ink in ((size * 1.2 + 2.0, edge), (size * 1.2, color)):
        points = [turn + 2 * math.pi * i / corners for i in range(corners)]
        a, b, c, d = ((x + radius * math.cos(t), y + radius * math.sin(t)) for t in points)
        canvas.add_quad_filled(a, b, c, d, ink)
