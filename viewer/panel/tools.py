"""Controls over the picture's edges: toolbar, tool options and comparison."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import TypeVar

from imgui_bundle import imgui, imgui_ctx

from viewer.pictures.compare import Labels
from viewer.render import highlight
from viewer.state.commands import Action, Plain, WithText, WithValue
from viewer.state.layers import is_visible
from viewer.state.transient import Measure
from viewer.state.view_state import (
    LARGEST_PX,
    MAX_AMPLIFIED,
    SELECT_MODES,
    SMALLEST_PX,
    Brush,
    ColorBrush,
    Comparison,
    SelectTool,
    ViewState,
)
from viewer.state.workspace import Pointed, Workspace
from viewer.ui import overlay
from viewer.ui.context import PALETTE, SMALL_PX, Icon, UiContext, u32
from viewer.ui.keys import COMMANDS, MODES, shortcut
from viewer.ui.overlay import Area
from viewer.ui.widgets import (
    choice,
    elide,
    group_digits,
    hint,
    icon_button,
    inert,
    menu,
    menu_item,
    more_button,
    name_field,
    plate,
    start_naming,
    tip,
    value_slider,
)

TOOLBAR_PX = 40.0  # width at 1×
EDGE_PX = 8.0  # distance from the picture's edges
LEFT_PX = TOOLBAR_PX + 2 * EDGE_PX  # width that the toolbar takes from the picture
NARROW_PX = 560.0  # below this picture width the options may cover the axes
_SIDE_PX = 32.0  # size of a button
_MIN_PX = 18.0  # minimum size of a button, in a low window
PAD_PX = 4.0  # padding around the buttons
_TOOLS = (
    (("navigate:orbit", Icon.ORBIT), ("navigate:fly", Icon.FLY)),
    (
        ("select_tool:box", Icon.BOX),
        ("select_tool:lasso", Icon.LASSO),
        ("select_tool:polygon", Icon.POLYGON),
        ("select_tool:brush", Icon.SELECT_BRUSH),
        ("select_tool:scribble", Icon.SCRIBBLE),
        ("select_tool:sphere", Icon.SPHERE),
        ("select_tool:flood", Icon.FLOOD),
        ("select_tool:color", Icon.COLOR),
        ("select_subject", Icon.SUBJECT),
    ),
    (("measure", Icon.MEASURE),),
    (("paint_tool:color", Icon.COLOR_BRUSH), ("paint_tool:clone", Icon.CLONE)),
    (("brush", Icon.BRUSH), ("decal", Icon.DECAL), ("move_selected", Icon.MOVE), ("pull", Icon.PULL)),
)
_OPERATIONS = (
    *("select_grow", "select_shrink"),
    *("select_smooth", "select_largest", "invert", "select_none"),
    *("select_with_paint", "select_without_paint", "select_paint"),
    *("hide_selected", "isolate"),
    *("remove_selected", "move_selected", "duplicate_selected"),
)
COLUMN_PX = 88.0  # at 1×: start of the control in a row
_DEPTHS = {False: "Front", True: "Through"}
_SOFTNESS_ACTIONS = ("brush_softness:-0.1", "brush_softness:0.1")
_SIZE_ACTIONS = ("brush_radius:0.8", "brush_radius:1.25")  # also change the tolerance of a click


def _with_chords(text: str, *actions: str) -> str:
    """Return a text with the chords of actions in parentheses, such as "Brush radius ([ and ])"."""
    chords = [chord for chord in map(shortcut, actions) if chord]
    return f"{text} ({' and '.join(chords)})" if chords else text


def open_below(share: float, ui: UiContext) -> None:
    """Place the next menu below the plate, at `share` of its width."""
    (x, y), size = imgui.get_window_pos(), imgui.get_window_size()
    at = (x + share * size.x, y + size.y + 4.0 * ui.scale)
    imgui.set_next_window_pos(at, 0, (share, 0.0))


def view_width(view: ViewState, area: Area, ui: UiContext) -> float:
    """Return the width that the axes and the buttons below them take from the picture, in window pixels."""
    buttons = 3 * imgui.get_frame_height() + 2 * (PAD_PX + EDGE_PX) * ui.scale
    return max(overlay.axes_height(view, area, ui), buttons)


def draw_toolbar(view: ViewState, area: Area, ui: UiContext, actions: list[Action], tool: str = "") -> None:
    """Draw the toolbar along the left edge of the picture.

    Args:
        view: the state
        area: the picture without the timeline
        ui: fonts and scale
        actions: receives the commands of pressed buttons
        tool: command of the active tool that is no part of the view, "" for none
    """
    active_tool: Action = WithText("navigate", view.camera.mode)
    if view.select.tool:
        active_tool = WithText("select_tool", view.select.tool)
    elif view.color_brush.tool:
        active_tool = WithText("paint_tool", view.color_brush.tool)
    elif view.brush.active:
        active_tool = Plain("brush")
    elif tool:
        active_tool = Plain(tool)
    off = {"brush": not view.layers, "move_selected": not view.selection.count}
    count = sum(map(len, _TOOLS))
    gap = 6.0 * ui.scale
    room = area.height - 2 * (EDGE_PX + PAD_PX) * ui.scale - gap * (len(_TOOLS) - 1)
    side = min(max(room / count, _MIN_PX * ui.scale), _SIDE_PX * ui.scale)
    imgui.push_style_var(imgui.StyleVar_.item_spacing, (0.0, 0.0))
    with plate("tools", (EDGE_PX * ui.scale, EDGE_PX * ui.scale), ui, pad=PAD_PX):
        for i, group in enumerate(_TOOLS):
            if i:
                imgui.dummy((1.0, gap))
            for command, icon in group:
                action = COMMANDS[command].action
                with inert(off.get(command, False)):
                    if icon_button(command, icon, ui, lit=action == active_tool, side=side):
                        actions.append(action)
                needs_selection = command == "move_selected" and off[command]
                hint(command, "Select something first" if needs_selection else "")
    imgui.pop_style_var()


Value = TypeVar("Value")


class _Bar:
    """Layout that places items on a line and wraps them at its end."""

    def __init__(self, limit: float, ui: UiContext) -> None:
        self.limit = limit  # end of the line, window pixels
        self.ui = ui

    def follow(self, wide: float) -> None:
        """Place the next item, of this width, on the same line if it fits."""
        gap = EDGE_PX * self.ui.scale
        if imgui.get_item_rect_max().x + gap + wide <= self.limit:
            imgui.same_line(0.0, gap)

    def segments(
        self, name: str, options: dict[Value, str], current: Value, help_: str, action: str = ""
    ) -> Value:
        """Draw a row of joined buttons and return the chosen value."""
        wide = sum(imgui.calc_text_size(text).x + 14.0 * self.ui.scale for text in options.values())
        self.follow(wide)
        pressed = choice(name, options, current, self.ui, wide)
        if action:
            hint(action, help_)
        else:
            tip(help_)
        return current if pressed is None else pressed

    def slider(
        self,
        title: str,
        value: float,
        ends: tuple[float, float],
        default: float,
        help_: str,
        form: str = "%.2f",
    ) -> float:
        """Draw a slider and return its value."""
        wide = imgui.calc_text_size(f"{title} 0.00").x + 14.0 * self.ui.scale
        self.follow(wide)
        value = value_slider(f"##{title}", value, ends, f"{title} {form}", default, self.ui, wide)
        tip(help_)
        return value

    def button(self, command: str, actions: list[Action], icon: str = "") -> None:
        text = icon + COMMANDS[command].name
        self.follow(imgui.calc_text_size(text).x + 2 * imgui.get_style().frame_padding.x)
        if imgui.button(f"{text}##{command}"):
            actions.append(COMMANDS[command].action)
        hint(command)


def draw_options(
    work: Workspace, area: Area, ui: UiContext, actions: list[Action], tip_text: str = ""
) -> tuple[Workspace, float]:
    """Draw the bar at the top of the picture: options of the active tool, and actions for the selection.

    Args:
        work: the workspace
        area: the picture
        ui: fonts and scale
        actions: receives the commands of pressed buttons
        tip_text: instruction for the next step with the active tool, "" for none

    Returns:
        The changed workspace; the y of the bar's lower edge, 0 if there is none.
    """
    view = work.view
    if work.transient.has_bar and (work.transient.takes_clicks or not view.has_tool):
        return work, 0.0
    measure = None if view.has_tool else work.transient.measure
    if not (view.has_tool or measure or view.painted or view.selection.count or view.selection.hidden):
        return work, 0.0
    left = LEFT_PX * ui.scale
    right = area.width - EDGE_PX * ui.scale
    narrow = area.width < NARROW_PX * ui.scale  # a wider picture has room for the bar beside the axes
    bar = _Bar(right - (0.0 if narrow else view_width(view, area, ui)) - EDGE_PX * ui.scale, ui)
    with plate("options", (left, EDGE_PX * ui.scale), ui):
        imgui.push_style_var(imgui.StyleVar_.item_spacing, (EDGE_PX * ui.scale, EDGE_PX * ui.scale))
        imgui.align_text_to_frame_padding()
        if measure is not None:
            _measure_options(measure, view.unit, bar, actions)
        elif view.color_brush.tool or (view.painted and not view.has_tool):
            view = replace(view, color_brush=_color_options(view, bar, actions))
        elif view.brush.active:
            imgui.text("Paint")
            view = _brush_options(view, work.focus, bar, actions)
        elif view.select.tool:
            imgui.text(view.select.tool.capitalize())
            view = replace(view, select=_select_options(view.select, bar))
            if tip_text:
                bar.follow(imgui.calc_text_size(tip_text).x)
                imgui.align_text_to_frame_padding()
                imgui.text_colored(imgui.ImVec4(*PALETTE.accent), tip_text)
        else:
            imgui.dummy((0.0, imgui.get_frame_height()))
        paints = view.brush.active or view.color_brush.tool or view.painted
        pointed = None if paints and not view.select.tool else _selection(view, bar, actions)
        foot = imgui.get_window_pos().y + imgui.get_window_size().y
        imgui.pop_style_var()
    return replace(work, view=view, pointed=work.pointed or pointed), foot


def _selection(view: ViewState, bar: _Bar, actions: list[Action]) -> Pointed | None:
    """Draw the number of selected Gaussians and the actions for them; return "selection" if it is hovered."""
    count = view.selection.count
    pointed = None
    if count or view.select.tool:
        text = f"{group_digits(count)} selected" if count else "Nothing selected"
        bar.follow(imgui.calc_text_size(text).x)
        imgui.align_text_to_frame_padding()
        imgui.text_disabled(text)
        if count and imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value):
            pointed = ("selection", 0)
        if count:
            bar.button("select_refine", actions)
            bar.follow(imgui.get_frame_height())
            more_button("more", _OPERATIONS, bar.ui, actions)
            tip("Grow, shrink, smooth, invert, paint on the object, hide, remove, move, copy")
            _save(len(view.selection.regions), bar, actions)
        else:
            bar.button("select_subject", actions)
    if view.selection.hidden:
        bar.button("show_hidden", actions, f"{Icon.HIDDEN}  ")
    return pointed


def _select_options(tool: SelectTool, bar: _Bar) -> SelectTool:
    """Draw the options of the selection tool."""
    modes = dict(zip(SELECT_MODES, ("New", "Add", "Subtract", "Intersect"), strict=True))
    help_ = f"Effect on the current selection.\n{MODES}"
    if tool.tool == "scribble":
        modes = {"new": "Object", "subtract": "Background"}
        help_ = "The next stroke marks the object, or the background (Ctrl)"
    tool = replace(tool, mode=bar.segments("mode", modes, tool.mode, help_))
    if tool.tool not in ("sphere", "flood", "scribble"):
        through = bar.segments("depth", _DEPTHS, tool.through, "", "select_through")
        tool = replace(tool, through=through)
    if tool.tool == "brush":
        ends = (SMALLEST_PX, LARGEST_PX)
        help_ = _with_chords("Brush radius", *_SIZE_ACTIONS)
        radius = bar.slider("Radius", tool.radius, ends, SelectTool.radius, help_, "%.0f px")
        tool = replace(tool, radius=radius)
    if tool.tool in ("flood", "color"):
        help_ = _with_chords("Maximum difference from the clicked color", *_SIZE_ACTIONS)
        help_ += ". A change updates the last click"
        tolerance = bar.slider("Tolerance", tool.tolerance, (0.01, 1.0), SelectTool.tolerance, help_)
        tool = replace(tool, tolerance=tolerance)
    return tool


def _measure_options(measure: Measure, unit: float, bar: _Bar, actions: list[Action]) -> None:
    """Draw the distance and the field for its true length."""
    imgui.text("Measure")
    distance = measure.distance
    if distance is None:
        text = "Click the second point" if measure.points else "Click two points of the surface"
        bar.follow(imgui.calc_text_size(text).x)
        imgui.text_colored(imgui.ImVec4(*PALETTE.accent), text)
        return
    text = f"Distance {distance * unit:.5g}, true length"
    wide = 96.0 * bar.ui.scale
    bar.follow(imgui.calc_text_size(text).x + wide)
    imgui.text(text)
    imgui.same_line()
    imgui.set_next_item_width(wide)
    slot = imgui.get_id(str(measure.points))
    if not imgui.get_state_storage().get_bool(slot):  # a number can be typed right after the second click
        imgui.get_state_storage().set_bool(slot, True)
        imgui.set_keyboard_focus_here()
    enters = imgui.InputTextFlags_.enter_returns_true.value | imgui.InputTextFlags_.auto_select_all.value
    entered, length = imgui.input_double("##true length", distance * unit, 0.0, 0.0, "%.6g", enters)
    tip("Type the true length and press Enter: the window shows lengths in its unit.\nFiles keep world units")
    if entered and length > 0.0:
        actions.append(WithValue("true_length", length))


def _save(regions: int, bar: _Bar, actions: list[Action]) -> None:
    """Draw the button that saves the selection, or in its place the field for the name."""
    text = "Save as region…"
    wide = 128.0 * bar.ui.scale
    bar.follow(wide)
    if name_field(f"region-{regions + 1}", wide, partial(WithText, "save_region"), actions):
        return
    if imgui.button(text, (wide, 0.0)):
        start_naming()
    else:
        tip("Save the selection as a file and list it under Regions")


PAINT_DRAG = "brush"
"""Name of the left drag while the brush is active, in addition to those of `keys.DRAGS`."""

WHOLE = ("paint_clear", "paint_fill", "paint_invert", "paint_feather")
"""Actions of the menu for all of a layer's paint."""


def paint_obstacle(view: ViewState, focus: int | None) -> str:
    """Return the reason why the brush cannot paint, in one line; "" if it can."""
    if focus is None or focus >= len(view.layers):
        first = shortcut("focus:1")
        return "no layer is selected; click one" + (f", or press {first} for the first" if first else "")
    layer = view.layers[focus]
    if layer.locked:
        return f"{layer.name} is locked; press {shortcut('lock')} to unlock it"
    if not is_visible(view, layer):
        return f"{layer.name} is hidden; press {shortcut('hide')} to show it"
    return ""


def _brush_options(view: ViewState, focus: int | None, bar: _Bar, actions: list[Action]) -> ViewState:
    """Draw the options of the brush."""
    brush = view.brush
    modes = {"add": "Add", "erase": "Erase", "smooth": "Smooth"}
    help_ = "While painting, Ctrl swaps Add and Erase, and Shift smooths"
    brush = replace(brush, mode=bar.segments("mode", modes, brush.mode, help_, "brush_mode"))
    ends = (SMALLEST_PX, LARGEST_PX)
    help_ = _with_chords("Brush radius", *_SIZE_ACTIONS)
    radius = bar.slider("Radius", brush.radius, ends, Brush.radius, help_, "%.0f px")
    help_ = _with_chords("Brush softness", *_SOFTNESS_ACTIONS)
    softness = bar.slider("Softness", brush.softness, (0.0, 1.0), Brush.softness, help_)
    help_ = "Effect of one stroke; repeated strokes increase it"
    flow = bar.slider("Flow", brush.flow, (0.0, 1.0), Brush.flow, help_)
    value = brush.value
    if brush.mode == "add":
        value = bar.slider("Value", value, (0.0, 1.0), Brush.value, "Weight that Add paints, 0 to 1")
    through = bar.segments("depth", _DEPTHS, brush.through, "", "brush_through")
    help_ = "Tint parts with less than the full edit, or color all weights from blue (0) to yellow (1)"
    kinds = {False: "Tint", True: "Colors"}
    weights = bar.segments("weights", kinds, brush.weights, help_, "brush_weights")
    if weights:
        _legend(bar)
    with inert(focus is None or view.layers[focus].locked):
        bar.follow(imgui.get_frame_height())
        more_button("paint", WHOLE, bar.ui, actions)
    tip("Clear, fill, invert or feather all paint of the layer")
    changed = replace(
        brush, radius=radius, softness=softness, flow=flow, value=value, through=through, weights=weights
    )
    return replace(view, brush=changed)


def _color_options(view: ViewState, bar: _Bar, actions: list[Action]) -> ColorBrush:
    """Draw the options of the color brush or the clone stamp, and the buttons for all paint."""
    brush = view.color_brush
    if brush.tool:
        imgui.text("Clone" if brush.tool == "clone" else "Color")
        if brush.tool == "color":
            bar.follow(imgui.get_frame_height())
            picker = imgui.ColorEditFlags_.no_inputs.value | imgui.ColorEditFlags_.no_alpha.value
            changed, (red, green, blue) = imgui.color_edit3("##paint color", list(brush.color), picker)
            tip("Color. Alt+click the picture to take a color from it")
            brush = replace(brush, color=(red, green, blue)) if changed else brush
        modes = {False: "Paint" if brush.tool == "color" else "Stamp", True: "Erase"}
        help_ = "Erase removes paint that is not a layer yet"
        if brush.tool == "clone":
            help_ += ". Alt+click sets the source of the stamp"
        brush = replace(brush, erases=bar.segments("paint mode", modes, brush.erases, help_, "brush_mode"))
        ends = (SMALLEST_PX, LARGEST_PX)
        help_ = _with_chords("Brush radius", *_SIZE_ACTIONS)
        radius = bar.slider("Size", brush.radius, ends, ColorBrush.radius, help_, "%.0f px")
        help_ = _with_chords("Share of the radius with full color", *_SOFTNESS_ACTIONS)
        hardness = bar.slider("Hardness", brush.hardness, (0.0, 1.0), ColorBrush.hardness, help_)
        help_ = "Opacity of one stroke; repeated strokes increase it"
        flow = bar.slider("Flow", brush.flow, (0.0, 1.0), ColorBrush.flow, help_)
        brush = replace(brush, radius=radius, hardness=hardness, flow=flow)
    else:
        imgui.text("Paint that is not a layer yet")
    with inert(not view.painted):
        bar.button("finish_paint", actions)
        bar.button("discard_paint", actions)
    return brush


def _legend(bar: _Bar) -> None:
    """Draw the color ramp of the weights with its end values."""
    wide = 96.0 * bar.ui.scale
    tall = imgui.get_frame_height()
    bar.follow(wide)
    (left, top), canvas = imgui.get_cursor_screen_pos(), imgui.get_window_draw_list()
    imgui.dummy((wide, tall))
    for (start, a), (end, b) in pairwise(highlight.RAMP):
        low, high = (u32(highlight.rgba(color)) for color in (a, b))
        corners = (left + start * wide, top), (left + end * wide, top + tall)
        canvas.add_rect_filled_multi_color(*corners, low, high, high, low)
    for x, text, color in (
        (left + 6.0 * bar.ui.scale, "0", PALETTE.handle),
        (left + wide - 14.0 * bar.ui.scale, "1", PALETTE.ink),
    ):
        canvas.add_text((round(x), round(top + 5.0 * bar.ui.scale)), u32(color), text)


def draw_ring(view: ViewState, ui: UiContext) -> None:
    """Draw the brush of painted strength at the cursor."""
    draw_circles(view.brush.radius, 1.0 - view.brush.softness, ui)


def draw_circles(radius_px: float, hardness: float, ui: UiContext) -> None:
    """Draw a brush at the cursor: its edge, and the circle within which it has full effect.

    Args:
        radius_px: pixels at 1×
        hardness: share of the radius with full effect, 0 to 1
    """
    mouse = imgui.get_mouse_pos()
    canvas = imgui.get_background_draw_list()
    radius = radius_px * ui.scale
    inner = radius * hardness
    for size, alpha in ((radius, 1.0), (inner, 0.45)):
        if size > 2.0 * ui.scale:
            canvas.add_circle(mouse, size, u32((0.0, 0.0, 0.0, 0.5 * alpha)), 0, 3.0 * ui.scale)
            canvas.add_circle(mouse, size, u32((*PALETTE.handle[:3], alpha)), 0, 1.25 * ui.scale)


_COMPARISONS = ("beside", "split", "difference")
_AGAINST = (
    ("original", "Against the original", ""),
    ("snapshots", "Snapshot A against B", "compare_snapshots"),
    ("photograph", "Against the photograph", ""),
)
_MISSING_SIDES = {
    "snapshots": "Add a snapshot first",
    "photograph": "Click a training camera with a photograph first",
}
"""Reasons why a comparison is not available."""


def draw_comparison(
    work: Workspace, words: Labels, original: bool, place: imgui.ImVec2Like, room: float, ui: UiContext
) -> tuple[Workspace, Action | None]:
    """Draw the pill at the top of the picture that chooses the two sides and the kind of comparison.

    Args:
        words: labels of the comparison on screen
        original: the original is shown
        place: the middle of its upper edge, window pixels
        room: largest width of the note below it, window pixels

    Returns:
        The changed workspace, and the requested action, None for none.
    """
    compare = work.view.compare
    requested = ""
    on = compare.mode != "off" and not original
    right, _, figure = words.right.partition(" · ")
    figure = words.line if compare.mode == "difference" else figure
    imgui.push_style_var(imgui.StyleVar_.item_spacing, (0.0, 2.0 * ui.scale))
    with plate("comparison", place, ui, (0.5, 0.0), PAD_PX):
        if _word("left", words.left.capitalize(), on or original, ui):
            requested = "before"
        hint("before")
        imgui.same_line()
        if icon_button("split", Icon.SPLIT, ui, lit=on):
            requested = compare.mode if on else "split"
        hint("split", figure)
        imgui.same_line()
        name = right.capitalize() + (f" × {compare.amplify:g}" if compare.mode == "difference" else "")
        if _word("right", name, not original, ui):
            requested = compare.mode if on else ""
            if work.before:
                requested = "before"
        tip(figure or "The scene with its edits")
        imgui.same_line()
        if icon_button("comparisons", Icon.UNFOLDED, ui):
            imgui.open_popup("comparisons")
        tip("Kind and sides of the comparison")
        imgui.pop_style_var()
        open_below(0.5, ui)
        with menu("comparisons", ui) as is_open:
            compare = _choose_comparison(compare, _sides(work), ui) if is_open else compare
        (left, top), size = imgui.get_window_pos(), imgui.get_window_size()
    if words.note:
        _draw_note(words.note, (left + 0.5 * size.x, top + size.y), room, ui)
    work = replace(work, view=replace(work.view, compare=compare))
    return work, Plain(requested) if requested else None


def _draw_note(text: str, at: tuple[float, float], room: float, ui: UiContext) -> None:
    """Draw a small text centered below the pill, on as many lines as it needs.

    Args:
        text: the text
        at: middle of the pill's lower edge, window pixels
        room: largest width, window pixels
        ui: fonts and scale
    """
    place = (at[0], at[1] + PAD_PX * ui.scale)
    with plate("comparison note", place, ui, (0.5, 0.0), PAD_PX), imgui_ctx.push_font(None, SMALL_PX):
        wrap = room if imgui.calc_text_size(text).x > room else -1.0
        with imgui_ctx.push_text_wrap_pos(wrap):
            imgui.text(text)


def _word(name: str, text: str, bright: bool, ui: UiContext) -> bool:
    """Draw one side of the comparison; return True if it was pressed."""
    imgui.push_style_color(imgui.Col_.text, PALETTE.handle if bright else PALETTE.dim)
    imgui.push_style_color(imgui.Col_.button, (0.0, 0.0, 0.0, 0.0))
    pressed = imgui.button(f"{elide(text, 200.0 * ui.scale)}##{name}")
    imgui.pop_style_color(2)
    return bool(pressed)


def _sides(work: Workspace) -> tuple[str, ...]:
    """Return the available values of `Comparison.against`."""
    through = work.transient.through
    has_photograph = through is not None and through.photograph is not None
    available = {"original": True, "snapshots": bool(work.snapshots), "photograph": has_photograph}
    return tuple(name for name, is_available in available.items() if is_available)


def _choose_comparison(compare: Comparison, sides: Sequence[str], ui: UiContext) -> Comparison:
    """Draw the menu and return the chosen comparison. `sides`: available values of `Comparison.against`"""
    if imgui.menu_item("Edited only", "", compare.mode == "off")[0]:
        compare = replace(compare, mode="off")
    for mode in _COMPARISONS:
        if menu_item(mode, compare.mode == mode):
            compare = replace(compare, mode=mode)
    imgui.separator()
    for against, text, action in _AGAINST:
        is_available = against in sides
        if imgui.menu_item(text, shortcut(action), compare.against == against, is_available)[0]:
            compare = replace(
                compare, against=against, mode="split" if compare.mode == "off" else compare.mode
            )
        if not is_available:
            tip(_MISSING_SIDES[against])
    if compare.mode == "difference":
        ends = 1.0, MAX_AMPLIFIED
        gain = value_slider("##amplify", compare.amplify, ends, "Gain × %.0f", Comparison.amplify, ui)
        compare = replace(compare, amplify=float(round(gain)))
    return compare
