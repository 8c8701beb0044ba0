"""Settings of a grade in the form of a new edit: sections of sliders, wheels, curves and the palette."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import torch
from imgui_bundle import imgui, imgui_ctx

from progdf.color.edits import hex_color, parse_color
from progdf.color.grade import CURVES, GRADE_RANGES, RANGE_LIMITS
from progdf.color.oklab import fit_gamut, hue_of, srgb_to_oklab
from progdf.color.palette import Curve, bend_lightness, with_highlights
from progdf.color.tone import WHEELS, Wheel
from viewer.render.live_grade import BLACK_MARK, WHITE_MARK
from viewer.state.commands import Action, Plain, WithText
from viewer.state.forms import (
    CUBE_LOOK,
    LOOK_COLUMNS,
    LOOK_PX,
    NO_CURVES,
    NO_WHEELS,
    NewEdit,
    Point,
    parse_curve,
    with_look,
)
from viewer.state.transient import GradeScope, LookShelf
from viewer.ui.context import HALF_GAP_PX, PALETTE, SMALL_PX, Icon, Rgba, UiContext, u32
from viewer.ui.widgets import (
    choice,
    icon_button,
    inert,
    is_double_clicked,
    key_step,
    label,
    right_edge,
    small,
    tip,
    value_slider,
)

CURVE_PX = 92.0
"""Height of a curve, at 1×."""
_HISTOGRAM_PX = 64.0  # height of the histogram, at 1×
_HISTOGRAM_COLORS = (
    (0.75, 0.77, 0.80, 0.55), (0.93, 0.30, 0.28, 0.40), (0.30, 0.80, 0.35, 0.40), (0.30, 0.50, 1.00, 0.45),
)  # fmt: skip
"""Colors of luma, red, green and blue."""
_CLIPPED_SHARE = 0.001  # share of the region from which an end counts as clipped
_MAX_POINTS = 6  # largest number of points of a curve
_MIN_GAP = 0.02  # smallest difference in lightness between two points of a curve
_RING_STEPS = 36  # colors of a wheel's ring
_RING_LAB = (0.72, 0.11)  # lightness and chroma of the ring

_HELPS = {
    "exposure": "Stops: −1 halves the light, 1 doubles it",
    "contrast": "Contrast around middle gray",
    "highlights": "Bright tones; −1 recovers detail, white stays",
    "shadows": "Dark tones; 1 opens them, black stays",
    "whites": "White point; above 0 the brightest tones clip",
    "blacks": "Black point; below 0 the darkest tones clip",
    "temperature": "From blue to amber light",
    "tint": "From green to magenta light",
    "vibrance": "Chroma of weak colors",
    "saturation": "−1 is gray, 1 doubles the chroma",
    "clarity": """Local contrast: −1 smooths, 1 doubles it; not part of .cube files.
The picture shows it now. The layer appears when training has ended""",
    "balance": "−1: more tones are highlights; 1: more are shadows",
}
_LIGHT = ("exposure", "contrast", "highlights", "shadows", "whites", "blacks", "clarity")
_COLOR = ("temperature", "tint", "vibrance", "saturation")
_NAMES = tuple(GRADE_RANGES)


def draw(
    form: NewEdit,
    scope: GradeScope,
    shelf: LookShelf,
    column: float,
    ui: UiContext,
    actions: list[Action],
) -> NewEdit:
    """Draw the sections of a grade; return the changed form. `actions` receives the requested actions."""
    form = _histogram(form, scope, ui)
    form = replace(form, hovered_look="")
    form, is_open = _section("Looks", form, False, ui)
    if is_open:
        form = _looks(form, shelf, ui, actions)
    form, is_open = _section("Light", form, _is_changed(form, _LIGHT), ui)
    if is_open == "reset":
        form = _reset(form, _LIGHT)
    elif is_open:
        form = _sliders(form, _LIGHT, column, ui)
    form, is_open = _section("Color", form, _is_changed(form, _COLOR), ui)
    if is_open == "reset":
        form = _reset(form, _COLOR)
    elif is_open:
        form = _sliders(form, _COLOR, column, ui)
    has_palette = any(source != target for source, target in form.palette)
    form, is_open = _section("Palette", form, has_palette, ui)
    if is_open == "reset":
        form = replace(form, palette=tuple((source, source) for source, _ in form.palette))
    elif is_open:
        form = _palette(form, column, ui)
    form, is_open = _section("Wheels", form, form.wheels != NO_WHEELS or _is_changed(form, ("balance",)), ui)
    if is_open == "reset":
        form = replace(_reset(form, ("balance",)), wheels=NO_WHEELS)
    elif is_open:
        form = _sliders(_wheels(form, ui), ("balance",), column, ui)
    form, is_open = _section("Curve", form, form.curves != NO_CURVES, ui)
    if is_open == "reset":
        form = replace(form, curves=NO_CURVES)
    elif is_open:
        form = _curves(form, column, ui)
    return form


def _histogram(form: NewEdit, scope: GradeScope, ui: UiContext) -> NewEdit:
    """Draw the histogram, with a mark at each end that clips, and the button that shows clipped colors."""
    tall = _HISTOGRAM_PX * ui.scale
    x, y = imgui.get_cursor_screen_pos()
    side = imgui.get_frame_height()
    gap = 4.0 * ui.scale
    wide = imgui.get_content_region_avail().x - side - gap
    imgui.dummy((wide, tall))
    tip(f"Clipped: {100 * scope.white:.1f} % to white, {100 * scope.black:.1f} % to black")
    imgui.same_line(0.0, 0.0)
    imgui.set_cursor_screen_pos((x + wide + gap, y))
    pressed = icon_button("clipping", Icon.SHOWN, ui, dim=not form.clipping, lit=form.clipping)
    tip("Clipped colors (J in this form)\nWhite in red, black in blue")
    key = imgui.is_window_focused() and not imgui.get_io().want_text_input
    if pressed or (key and imgui.is_key_pressed(imgui.Key.j, False)):
        form = replace(form, clipping=not form.clipping)
    imgui.set_cursor_screen_pos((x, y))
    imgui.dummy((wide + gap + side, tall))
    canvas = imgui.get_window_draw_list()
    low = (x, y)
    end = (x + wide, y + tall)
    canvas.add_rect_filled(low, end, u32(PALETTE.field), 4.0 * ui.scale)
    for values, color in zip(scope.bins, _HISTOGRAM_COLORS, strict=False):
        step = wide / len(values)
        for i, value in enumerate(values):
            if value > 0.0:
                top = y + tall - value * (tall - 3.0 * ui.scale)
                canvas.add_rect_filled((x + i * step, top), (x + (i + 1) * step, end[1]), u32(color))
    if not scope.bins:
        with imgui_ctx.push_font(None, SMALL_PX):
            words = scope.note or "Measuring the colors …"
            at = x + (wide - imgui.calc_text_size(words).x) / 2, y + (tall - imgui.get_font_size()) / 2
            canvas.add_text(at, u32(PALETTE.dim), words)
    side = 8.0 * ui.scale
    for share, corner, sign, mark in (
        (scope.black, x + 4.0 * ui.scale, 1.0, BLACK_MARK),
        (scope.white, x + wide - 4.0 * ui.scale, -1.0, WHITE_MARK),
    ):
        top = y + 4.0 * ui.scale
        shown = u32((*mark, 1.0)) if share > _CLIPPED_SHARE else u32(PALETTE.line)
        canvas.add_triangle_filled((corner, top), (corner + sign * side, top), (corner, top + side), shown)
    if form.clipping:
        canvas.add_rect(low, end, u32(PALETTE.accent), 4.0 * ui.scale, ui.scale)
    return form


def _looks(form: NewEdit, shelf: LookShelf, ui: UiContext, actions: list[Action]) -> NewEdit:
    """Draw the looks; the picture shows the one under the pointer, and a press applies it.

    A color table without settings becomes a layer, as the form has no settings for it.
    """
    gap = HALF_GAP_PX * ui.scale
    wide = (imgui.get_content_region_avail().x - (LOOK_COLUMNS - 1) * gap) / LOOK_COLUMNS
    side = (wide, wide * LOOK_PX[1] / LOOK_PX[0])
    canvas = imgui.get_window_draw_list()
    rows = -(-max(len(shelf.looks), 1) // LOOK_COLUMNS)
    imgui.push_style_var(imgui.StyleVar_.item_spacing, (gap, gap))
    for i, (name, look) in enumerate(shelf.looks):
        row, place = divmod(i, LOOK_COLUMNS)
        if place:
            imgui.same_line(0.0, gap)
        pressed = imgui.button(f"##look {i}", side)
        low = imgui.get_item_rect_min()
        high = imgui.get_item_rect_max()
        if shelf.sheet:
            start = (place / LOOK_COLUMNS, row / rows)
            end = ((place + 1) / LOOK_COLUMNS, (row + 1) / rows)
            white = u32((1.0, 1.0, 1.0, 1.0))
            canvas.add_image_rounded(
                imgui.ImTextureRef(shelf.sheet), low, high, start, end, white, 3.0 * ui.scale
            )
        else:
            pad = 3.0 * ui.scale
            with imgui_ctx.push_font(None, SMALL_PX):
                font = imgui.get_font()
                size = imgui.get_font_size()
                canvas.push_clip_rect(low, high, True)
                at = (low.x + pad, low.y + pad)
                canvas.add_text(font, size, at, u32(PALETTE.dim), name, wide - 2.0 * pad)
                canvas.pop_clip_rect()
        if imgui.is_item_hovered():
            form = replace(form, hovered_look=look)
            canvas.add_rect(low, high, u32(PALETTE.accent), 3.0 * ui.scale, 2.0 * ui.scale)
        is_table = look.startswith(CUBE_LOOK)
        tip(f"{name}: a color table, which becomes a layer" if is_table else name)
        if pressed and is_table:
            actions.append(WithText("open_file", look.removeprefix(CUBE_LOOK)))
        elif pressed:
            form = with_look(form, look)
    imgui.pop_style_var()
    imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + gap)
    with inert(form.spec == "grade"):
        saves = imgui.button("Save as a look", imgui.ImVec2(-1.0, 0.0))
    tip("Keep this grade as a .cube file, named like the edit or after what it does")
    if saves:
        actions.append(Plain("save_look"))
    return form


def _section(name: str, form: NewEdit, changed: bool, ui: UiContext) -> tuple[NewEdit, str]:
    """Draw the heading of a section; a press folds it.

    Args:
        changed: a setting in it is not neutral, so it has a button that resets it

    Returns:
        the form; "reset", "open", or "" if it is folded
    """
    is_folded = name in form.folded
    side = imgui.get_frame_height()
    x, y = imgui.get_cursor_screen_pos()
    right = right_edge()
    room = imgui.get_content_region_avail().x - side
    pressed = imgui.invisible_button(f"section {name}", (room, side), imgui.ButtonFlags_.enable_nav.value)
    color = u32(PALETTE.text if imgui.is_item_hovered() or changed else PALETTE.dim)
    canvas = imgui.get_window_draw_list()
    middle = round(y + (side - imgui.get_font_size()) / 2)
    canvas.add_text((round(x), middle), color, Icon.FOLDED if is_folded else Icon.UNFOLDED)
    with imgui_ctx.push_font(ui.fonts.bold, SMALL_PX):
        canvas.add_text((round(x + 14.0 * ui.scale), middle + round(ui.scale)), color, name)
    result = "" if is_folded else "open"
    if changed:
        imgui.same_line(right - side)
        if icon_button(f"reset {name}", Icon.UNDO, ui, dim=True):
            result = "reset"
        tip(f"Reset {name}")
    if pressed:
        others = tuple(other for other in form.folded if other != name)
        form = replace(form, folded=others if is_folded else (*others, name))
    return form, result


def _is_changed(form: NewEdit, names: tuple[str, ...]) -> bool:
    """Return whether a slider is not neutral."""
    return any(form.grade[_NAMES.index(name)] != GRADE_RANGES[name][2] for name in names)


def _reset(form: NewEdit, names: tuple[str, ...]) -> NewEdit:
    """Return the form with neutral sliders of some names."""
    values = zip(_NAMES, form.grade, strict=True)
    return replace(form, grade=tuple(GRADE_RANGES[n][2] if n in names else x for n, x in values))


def _sliders(form: NewEdit, names: tuple[str, ...], column: float, ui: UiContext) -> NewEdit:
    """Draw some sliders; a double click resets one."""
    values = list(form.grade)
    for name in names:
        low, high, neutral = GRADE_RANGES[name]
        label(name.capitalize(), column)
        index = _NAMES.index(name)
        values[index] = value_slider(f"##{name}", values[index], (low, high), "%.2f", neutral, ui)
        tip(_HELPS[name])
    return replace(form, grade=tuple(values))


def _wheels(form: NewEdit, ui: UiContext) -> NewEdit:
    """Draw the discs of shadows, midtones and highlights, each with its slider of lightness below."""
    gap = 8.0 * ui.scale
    wide = math.floor((imgui.get_content_region_avail().x - 2 * gap) / 3)
    left = imgui.get_cursor_pos_x()
    top = imgui.get_cursor_pos_y()
    wheels = []
    for i, (name, wheel) in enumerate(zip(WHEELS, form.wheels, strict=True)):
        # not `same_line`, which aligns the names with the baseline of the slider before
        imgui.set_cursor_pos((left + i * (wide + gap), top))
        with imgui_ctx.begin_group():
            small(name.capitalize(), PALETTE.dim, wide)
            wheel = _wheel(name, wheel, wide, ui)
            light = value_slider(f"##light of {name}", wheel.light, (-1.0, 1.0), "%.2f", 0.0, ui, wide)
            tip(f"Lightness of the {name}")
        wheels.append(wheel._replace(light=light))
    return replace(form, wheels=tuple(wheels))


def _wheel(name: str, wheel: Wheel, wide: float, ui: UiContext) -> Wheel:
    """Draw a disc of hues; a drag moves its point, a double click resets it."""
    x, y = imgui.get_cursor_screen_pos()
    imgui.invisible_button(f"wheel {name}", (wide, wide), imgui.ButtonFlags_.enable_nav.value)
    center = x + wide / 2, y + wide / 2
    radius = wide / 2 - 5.0 * ui.scale
    tip(f"Color of the {name}: {wheel.hue:.0f}°, {wheel.amount:.2f}; double click resets")
    angle = math.radians(wheel.hue)
    at = wheel.amount * math.cos(angle), wheel.amount * math.sin(angle)
    key = imgui.Key
    moved = None
    if is_double_clicked():
        wheel = Wheel(light=wheel.light)
        at = 0.0, 0.0
    elif _is_dragged():
        mouse = imgui.get_io().mouse_pos
        moved = (mouse.x - center[0]) / radius, (center[1] - mouse.y) / radius
    elif imgui.is_item_focused() and imgui.get_current_context().nav_cursor_visible:
        by = key_step(key.left_arrow, key.right_arrow), key_step(key.down_arrow, key.up_arrow)
        moved = (at[0] + by[0], at[1] + by[1]) if any(by) else None
    if moved is not None:
        amount = min(math.hypot(*moved), 1.0)
        hue = math.degrees(math.atan2(moved[1], moved[0])) % 360.0
        wheel = Wheel(round(hue, 1) % 360.0, round(amount, 2), wheel.light)
        at = amount * math.cos(math.radians(hue)), amount * math.sin(math.radians(hue))
    canvas = imgui.get_window_draw_list()
    canvas.add_circle_filled(center, radius, u32(PALETTE.field), 48)
    for step, color in enumerate(_ring()):
        start = -2.0 * math.pi * (step + 0.55) / _RING_STEPS
        canvas.path_arc_to(center, radius, start, start + 2.2 * math.pi / _RING_STEPS, 4)
        canvas.path_stroke(u32((*color, 1.0)), 3.0 * ui.scale)
    line = u32(PALETTE.line)
    canvas.add_line((center[0] - radius * 0.9, center[1]), (center[0] + radius * 0.9, center[1]), line)
    canvas.add_line((center[0], center[1] - radius * 0.9), (center[0], center[1] + radius * 0.9), line)
    point = center[0] + at[0] * radius, center[1] - at[1] * radius
    canvas.add_line(center, point, u32(PALETTE.dim), ui.scale)
    canvas.add_circle_filled(point, 4.5 * ui.scale, u32(PALETTE.text))
    return wheel


def _is_dragged() -> bool:
    """Return whether the mouse holds the last item, or has moved and released it in this frame."""
    if imgui.is_item_active():
        return bool(imgui.is_mouse_down(0))
    return bool(imgui.is_item_deactivated() and imgui.is_mouse_released(0))


@cache
def _ring() -> tuple[tuple[float, float, float], ...]:
    """Return the colors of a wheel's ring, counterclockwise from the right, sRGB."""
    lightness, chroma = _RING_LAB
    angles = [2.0 * math.pi * step / _RING_STEPS for step in range(_RING_STEPS)]
    lab = torch.tensor([[lightness, chroma * math.cos(a), chroma * math.sin(a)] for a in angles])
    return tuple((red, green, blue) for red, green, blue in fit_gamut(lab).tolist())


def _curves(form: NewEdit, column: float, ui: UiContext) -> NewEdit:
    """Draw the choice of a curve, and this curve."""
    storage = imgui.get_state_storage()
    slot = imgui.get_id("curve/channel")
    channel = storage.get_int(slot, 0)
    label("Channel", column)
    chosen = choice("channel", dict(enumerate(("Light", "R", "G", "B"))), channel, ui)
    if chosen is not None:
        storage.set_int(slot, chosen)
        channel = chosen
    curves = list(form.curves)
    imgui.push_id(CURVES[channel])
    curves[channel] = _curve(curves[channel], column, ui, tuple, _CURVE_COLORS[channel])
    imgui.pop_id()
    return replace(form, curves=tuple(curves))


_CURVE_COLORS = (PALETTE.handle, (0.93, 0.38, 0.36, 1.0), (0.40, 0.78, 0.42, 1.0), (0.42, 0.58, 0.98, 1.0))


def _palette(form: NewEdit, column: float, ui: UiContext) -> NewEdit:
    """Draw the region's main colors, each with its new color, and the button to pick one in the picture."""
    flags = imgui.ColorEditFlags_
    label("Colors", column)
    side = imgui.get_frame_height()
    pairs = list(form.palette)
    canvas = imgui.get_window_draw_list()
    room = right_edge() - side - imgui.get_cursor_pos_x()
    button_width = min(room / max(len(pairs), 1) - 2.0 * ui.scale, 34.0 * ui.scale)
    for i, (source, target) in enumerate(pairs):
        words, _, curve = target.partition("/")
        new_color, _, reach = words.partition("~")
        (x, y), color = imgui.get_cursor_screen_pos(), (*parse_color(new_color).tolist(), 1.0)
        if imgui.color_button(
            f"##color {i}", color, flags.no_tooltip.value, imgui.ImVec2(button_width, side)
        ):
            form = replace(form, picked=i)
        if imgui.is_item_clicked(1):
            pairs[i] = source, source
        tip(f"{source} becomes {new_color}; right-click: reset" if source != target else f"{source} is kept")
        if source != target:  # original color, in a corner
            low = (x, y + side)
            corner = u32((*parse_color(source).tolist(), 1.0))
            canvas.add_triangle_filled((x, y + side / 2), low, (x + side / 2, y + side), corner)
        if form.picked == i:
            imgui.open_popup(f"color {i}")
            form = replace(form, picked=-1)
        if imgui.begin_popup(f"color {i}"):
            picker_flags = flags.display_hex.value | flags.no_side_preview.value
            changed, chosen = imgui.color_picker3("##picker", parse_color(new_color).tolist(), picker_flags)
            new_color = hex_color(chosen) if changed else new_color
            new_color = _shifts(source, new_color, column, ui)
            label("Range", column)
            ranged = value_slider("##range", float(reach or 1.0), RANGE_LIMITS, "%.2f", 1.0, ui)
            tip("Reach of this color towards its neighbors in the palette")
            curve = _curve(curve, column, ui, with_highlights)
            words = new_color if ranged == 1.0 else f"{new_color}~{ranged:.2f}"
            pairs[i] = source, "/".join(filter(None, (words, curve)))
            imgui.end_popup()
        imgui.same_line(0.0, 2.0 * ui.scale)
    imgui.set_cursor_pos_x(right_edge() - side)
    picks = form.picks != icon_button("pick", Icon.COLOR, ui, lit=form.picks)
    tip("Pick a color in the picture, then choose its new color")
    return replace(form, palette=tuple(pairs), picks=picks)


def _curve(
    curve: str, column: float, ui: UiContext, ended: Callable[[Curve], Curve], color: Rgba = PALETTE.handle
) -> str:
    """Draw a curve from original to new lightness and return it. A press adds a point and drags it.

    `ended` returns the curve as it is applied, including its value at white.

    By keyboard, Space selects the next point. After the last point, it adds one in the widest gap. The arrow
    keys move the selected point.
    """
    label("Lightness" if color == PALETTE.handle else "Values", column)
    tall = CURVE_PX * ui.scale
    reach = 9.0 * ui.scale
    x, y = imgui.get_cursor_screen_pos()
    wide = imgui.get_content_region_avail().x
    imgui.invisible_button("curve", (wide, tall), imgui.ButtonFlags_.enable_nav.value)
    tip("Press to add and drag a point, double-click to delete it; or Space, arrows, Del")
    dragged = _is_dragged()
    keyed = imgui.is_item_focused() and imgui.get_current_context().nav_cursor_visible and not dragged
    storage = imgui.get_state_storage()
    held = imgui.get_id("curve/held")
    mouse = imgui.get_io().mouse_pos
    at = (mouse.x - x) / wide, 1.0 - (mouse.y - y) / tall

    def apart(point: Point) -> float:
        return math.hypot((point[0] - at[0]) * wide, (point[1] - at[1]) * tall)

    points = parse_curve(curve)
    chosen = storage.get_int(held, -1)
    key = imgui.Key
    near = min(range(len(points)), key=lambda i: apart(points[i]), default=-1)
    near = near if near >= 0 and apart(points[near]) <= reach else -1
    near = chosen if keyed else near
    if adds_point := keyed and imgui.is_key_pressed(key.space, False):
        ends = [0.0, *(across for across, _ in points), 1.0]
        widest = max(range(len(points) + 1), key=lambda i: ends[i + 1] - ends[i])
        middle = torch.tensor((ends[widest] + ends[widest + 1]) / 2)
        at = float(middle), float(bend_lightness(middle, ended(tuple(points))))
        near = chosen + 1 if chosen + 1 < len(points) else -1
    removes = near >= 0 and is_double_clicked()
    if removes or imgui.is_item_clicked(1) or (keyed and imgui.is_key_pressed(key.delete)):
        points = [point for i, point in enumerate(points) if i != near]
        storage.set_int(held, -1)
    elif imgui.is_item_clicked(0) or adds_point:
        if near < 0 and len(points) < _MAX_POINTS and all(abs(p[0] - at[0]) > _MIN_GAP for p in points):
            points = sorted([*points, (round(at[0], 2), round(at[1], 2))])
            near = min(range(len(points)), key=lambda i: apart(points[i]))
        storage.set_int(held, near)
    elif (keyed or dragged) and 0 <= (i := chosen) < len(points):
        if keyed:
            by = key_step(key.left_arrow, key.right_arrow), key_step(key.down_arrow, key.up_arrow)
            at = points[i][0] + by[0], points[i][1] + by[1]
        low = points[i - 1][0] if i else 0.0
        high = points[i + 1][0] if i + 1 < len(points) else 1.0
        across = min(max(at[0], low + _MIN_GAP), high - _MIN_GAP)
        points[i] = round(across, 2), round(min(max(at[1], 0.0), 1.0), 2)
    canvas = imgui.get_window_draw_list()
    p = PALETTE
    canvas.add_rect_filled(imgui.ImVec2(x, y), imgui.ImVec2(x + wide, y + tall), u32(p.field), 4.0 * ui.scale)
    canvas.add_line(imgui.ImVec2(x, y + tall), imgui.ImVec2(x + wide, y), u32(p.chosen), ui.scale)
    steps = [i / 48 for i in range(49)]
    bent = bend_lightness(torch.tensor(steps), ended(tuple(points))).tolist()
    line = [imgui.ImVec2(x + wide * s, y + tall * (1.0 - l)) for s, l in zip(steps, bent, strict=True)]
    canvas.add_polyline([*line], u32(color), 1.5 * ui.scale, 0)
    for i, (across, up) in enumerate(points):
        center = imgui.ImVec2(x + wide * across, y + tall * (1.0 - up))
        canvas.add_circle_filled(center, (4.0 + (i == near)) * ui.scale, u32(p.accent))
    return "+".join(f"{x:.2f}:{y:.2f}" for x, y in points)


def _shifts(source: str, target: str, column: float, ui: UiContext) -> str:
    """Draw hue, saturation and lightness of a color relative to its original; return its new color."""
    own, new = (srgb_to_oklab(parse_color(text)) for text in (source, target))
    own_chroma, new_chroma = (float(lab[1:].norm()) for lab in (own, new))
    turn = math.degrees(float(hue_of(new) - hue_of(own))) if min(own_chroma, new_chroma) > 0.01 else 0.0
    before = (
        round((turn + 180.0) % 360.0 - 180.0) / 180.0,
        round(new_chroma / max(own_chroma, 1e-3) - 1.0, 2) if own_chroma > 0.01 else 0.0,
        round(float(new[0] - own[0]), 2),
    )
    after = []
    for name, value, help_ in zip(("Hue", "Saturation", "Lightness"), before, _SHIFT_HELPS, strict=True):
        label(name, column)
        after.append(value_slider(f"##{name}", value, (-1.0, 1.0), "%.2f", 0.0, ui))
        tip(help_)
    if tuple(after) == before:
        return target
    hue = float(hue_of(own)) + math.pi * after[0]
    chroma = own_chroma * (1.0 + after[1])
    lightness = min(max(float(own[0]) + after[2], 0.0), 1.0)
    lab = torch.tensor([[lightness, chroma * math.cos(hue), chroma * math.sin(hue)]])
    return hex_color(fit_gamut(lab)[0].tolist())


_SHIFT_HELPS = ("−1 and 1 are the opposite hue", "−1 is gray, 1 doubles the chroma", "Change of lightness")
