"""Card of a layer in the panel: visibility, name, strength, slider, and the gains when unfolded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from imgui_bundle import imgui, imgui_ctx

from progdf.terminal import format_duration
from viewer.state.commands import Action, OnItem, Plain, WithText
from viewer.state.facts import LayerRow
from viewer.state.forms import NewEdit, with_settings
from viewer.state.layers import (
    SLIDERS,
    change_layer,
    largest_strength,
    largest_value,
    rename_layer,
    slider_value,
    toggle_solo,
    with_slider_value,
)
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import Workspace, is_compact
from viewer.ui.context import HALF_GAP_PX, LAYER_PADDING_PX, PALETTE, SMALL_PX, Icon, Rgba, UiContext, u32
from viewer.ui.keys import shortcut
from viewer.ui.widgets import (
    card,
    checkbox,
    elide,
    entry,
    grip,
    group_digits,
    hint,
    icon_button,
    inert,
    is_entered,
    label,
    menu,
    menu_item,
    picture,
    right_edge,
    tip,
    typed_name,
    value_slider,
    with_added,
    wrapped_text,
)

from . import slider

GAINS = SLIDERS[1:]


_GAIN_TIPS = {
    "color": "How much of the color change is applied, apart from its texture",
    "texture": "How much of the texture is applied: strokes, patterns and details of the color change",
}


def draw_details(
    view: ViewState, layer: LayerState, row: LayerRow, active_slider: str | None, ui: UiContext
) -> LayerState:
    """Draw the gains and return the changed layer.

    Args:
        view: state of the view
        layer: the layer to show and change
        row: data of its .gdf
        active_slider: slider that the arrow keys move; None if another layer is focused
        ui: fonts and scale
    """
    with inert(layer.locked):
        for kind in GAINS:
            layer = _gain(layer, kind, row.kinds, kind == active_slider, largest_value(view, kind), ui)
    return layer


def _gain(
    layer: LayerState, kind: str, kinds: frozenset[str], active: bool, upper: float, ui: UiContext
) -> LayerState:
    """Draw one gain as a slider and return the changed layer.

    Args:
        layer: the layer
        kind: the gain
        kinds: gains that have an effect
        active: the arrow keys move the slider
        upper: upper end of the slider
        ui: fonts and scale
    """
    moves = kind in kinds
    if active:
        imgui.push_style_color(imgui.Col_.text_disabled, PALETTE.accent)
    label(kind.capitalize(), 84.0 * ui.scale)
    if active:
        imgui.pop_style_color()
    with inert(not moves):
        value = slider_value(layer, kind)
        new = value_slider(f"##{kind}", value, (0.0, upper), "%.2f", 1.0, ui)
    if moves:
        about = _GAIN_TIPS.get(kind, f"How much of the {kind} change is applied")
        tip(f"{about} (Tab, then arrow keys). Double-click: reset to 1")
    elif kind == "texture" and "color" in kinds:
        tip("This edit changes colors evenly. It has no texture")
    else:
        tip(f"This edit does not change the {kind}")
    return layer if new == value else with_slider_value(layer, kind, new, upper)


TOGGLE_PX = 20.0  # side of a toggle, at 1×
THUMBNAIL_PX = 24.0  # side of a thumbnail, at 1×
CARD_PX = 64.0  # height of a card with the gap to the next one, at 1×
COMPACT_PX = 8.0  # padding of a compact row, at 1×
SLIDER_PX = 80.0  # width of the slider in a compact row or a group row, at 1×
SLIM_PX = 16.0  # height of this slider, at 1×
BLEND_TITLES = {"normalized": "Average", "sum": "Add", "over": "Over", "adjust": "Adjust"}
BLEND_HELP = {
    "normalized": "Overlapping edits are averaged by weight, never more than one full edit.",
    "sum": "Overlapping edits add up.",
    "over": "An edit covers those below it, in proportion to its change.",
    "adjust": "Like Over, but color edits change the colors below: darkened stripes stay stripes.",
}
_BUSY = ("queued", "running", "stopping")  # states of a job that will fill a hole
_MENU = "menu of a layer"
_MENU_ITEMS = (
    *("rename", "duplicate", "replace", "again", "copy_edit", "paste_edit", "", "remove", ""),
    *("limit_to_selection", "select_painted", "", "reset", ""),
    *("group", "set_blend", "select_layers", "reset_all"),
)
_LAYER_ACTIONS = (
    *("rename", "duplicate", "replace", "again", "copy_edit", "remove"),
    *("limit_to_selection", "select_painted"),
)
"""Actions that receive the layer's index. All other actions of the menu apply to the selected layers."""


@dataclass(frozen=True)
class CardTouch:
    """User input on one card."""

    touched: bool = False  # the layer becomes the focused one, unless `press` changes that
    drag: str = ""  # drag of its name, see `grip`
    press: str = ""  # one of `layer_selection.PRESSES`; "" if no button was pressed
    named: bool = False  # the mouse button is held down on the name


def draw_card(
    work: Workspace,
    index: int,
    active: bool,
    rows: Sequence[LayerRow],
    texture: int,
    ui: UiContext,
    actions: list[Action],
) -> tuple[Workspace, CardTouch]:
    """Draw the card of a layer: visibility, thumbnail, name, value and slider. Return the changed state.

    A hovered card has toggles, an unfolded one shows the details. A compact row has visibility, swatch, name,
    a short slider and the value.

    Args:
        active: the layer is visible in the picture
        rows: one per .gdf, indexed by `LayerState.gdf`
        texture: GL name of the edit's thumbnail, 0 before it is drawn
    """
    scale = ui.scale
    p = PALETTE
    compact = is_compact(work)
    layer = work.view.layers[index]
    focused = work.focus == index
    selected = focused or layer.gdf in work.selected
    row = rows[layer.gdf]
    max_strength = largest_strength(work.view)
    imgui.push_id(index)
    canvas = imgui.get_window_draw_list()
    clip = canvas.get_clip_rect_min(), canvas.get_clip_rect_max()
    color = p.card_focused if selected else p.card
    padding = (COMPACT_PX, 0.0) if compact else LAYER_PADDING_PX
    with card("card", color, ui, padding=padding):
        right = right_edge()
        work, touch = _head(work, index, row, active, texture, ui, actions)
        number_at = imgui.get_item_rect_min()
        layer = work.view.layers[index]
        if compact:
            imgui.same_line(right - SLIDER_PX * scale - _number_width(layer, compact) - 6.0 * scale)
            imgui.set_cursor_pos_y(
                imgui.get_cursor_pos_y() + (imgui.get_frame_height() - SLIM_PX * scale) / 2
            )
        else:
            imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() - HALF_GAP_PX * scale)
        with inert(layer.locked):
            strength = slider.draw(
                "##strength",
                layer.strength,
                row.recorded,
                SLIDER_PX * scale if compact else imgui.get_content_region_avail().x,
                ui,
                fill=p.accent if selected else p.faint,
                active=active,
                most=max_strength,
                height=SLIM_PX if compact else slider.HEIGHT_PX,
            )
            touched = touch.touched or imgui.is_item_active()
        _number(number_at, strength, active, compact)
        if strength != layer.strength:  # building a new state is slow, and most cards do not change
            work = _change_layer(work, index, lambda old: replace(old, strength=strength))
        if focused and row.hole:
            actions += _fill_box(work, index, row, ui)
        if layer.gdf in work.view.unfolded:
            work = _about(work, index, row, ui)
            active_slider = work.active_slider if focused else None
            unfolded = draw_details(work.view, work.view.layers[index], row, active_slider, ui)
            work = _change_layer(work, index, lambda _: unfolded)
            if compact:
                imgui.dummy((0.0, 2.0 * scale))
        over = imgui.is_window_hovered(imgui.HoveredFlags_.allow_when_blocked_by_active_item.value)
        press = _press(touch.named) if over and imgui.is_mouse_clicked(imgui.MouseButton_.left.value) else ""
        several = len(work.selected) if selected else 0
        alone = imgui.get_id("alone")
        if press:  # a press starts a drag of all selected layers; a click selects this one on release
            imgui.get_state_storage().set_bool(alone, press == "one" and several > 1)
            press = "keep" if press == "one" and several > 1 else press
        left = imgui.MouseButton_.left.value
        moved = imgui.get_mouse_drag_delta(left)
        is_click = imgui.is_mouse_released(left) and not (moved.x or moved.y)
        if over and is_click and imgui.get_state_storage().get_bool(alone):
            press = "one"
            imgui.get_state_storage().set_bool(alone, False)
        down = imgui.is_mouse_down(imgui.MouseButton_.left.value)  # then the right button cancels the drag
        if over and not down and imgui.is_mouse_clicked(imgui.MouseButton_.right.value):
            press = "keep"
            imgui.open_popup(_MENU)
        _menu(work.view, index, row, several, ui, actions)
        if selected:
            _focus_bar(clip, p.accent if focused else p.faint, scale)
    imgui.pop_id()
    return work, replace(touch, touched=touched or bool(press), press=press)


def swatch(color: tuple[float, float, float], alpha: float, edge: bool, ui: UiContext) -> None:
    """Draw a color swatch on the current line; `edge`: with an outline."""
    side = 12.0 * ui.scale
    tall = imgui.get_frame_height()
    x, y = imgui.get_cursor_screen_pos()
    top = y + (tall - side) / 2
    corners = (x, top), (x + side, top + side)
    imgui.dummy((side, tall))
    canvas = imgui.get_window_draw_list()
    canvas.add_rect_filled(*corners, u32((*color, alpha)), 3 * ui.scale)
    if edge:
        canvas.add_rect(*corners, u32(PALETTE.line), 3 * ui.scale)


def _fill_box(work: Workspace, index: int, row: LayerRow, ui: UiContext) -> list[Action]:
    """Draw the check box that fills the hole of a removal; return its action if it was pressed."""
    gdf = work.view.layers[index].gdf
    job = next((job for job in work.jobs if job.fills == gdf and job.status in _BUSY), None)
    text = f"Fill the hole (about {format_duration(row.fill_seconds)})"
    is_stopping = job is not None and job.status == "stopping"
    if row.hole == "filled":
        text = "Fill the hole"
    elif job is not None:
        left = "" if job.seconds_left is None else f", {format_duration(job.seconds_left)} left"
        text = f"Filling the hole: {100 * job.share:.0f} %{left}"
    with inert(work.view.layers[index].locked or is_stopping):
        fills = row.hole == "filled" or job is not None
        pressed = checkbox(f"{text}##hole", fills, ui) != fills
    tip(
        "Continue the surface around the hole, with its texture if the extra fill is installed. The fill has "
        "the scene's own colors: recolored surroundings do not recolor it"
    )
    return [OnItem("fill_hole", index)] if pressed else []


def _change_layer(work: Workspace, index: int, change: Callable[[LayerState], LayerState]) -> Workspace:
    return replace(work, view=change_layer(work.view, index, change))


def _press(named: bool) -> str:
    """Return the press's effect on the selection, one of `layer_selection.PRESSES`.

    On buttons and sliders the modifiers have their own meaning.
    """
    if imgui.is_any_item_active() and not named:
        return "keep"
    io = imgui.get_io()
    if io.key_ctrl:
        return "toggle"
    return "range" if io.key_shift else "one"


def _menu(
    state: ViewState, index: int, row: LayerRow, several: int, ui: UiContext, actions: list[Action]
) -> None:
    """Draw the context menu of a layer.

    Args:
        row: data of its .gdf
        several: number of selected layers, this one included; 0 or 1 for this one alone
    """
    with menu(_MENU, ui) as is_open:
        off = []
        if is_open and with_settings(NewEdit(), row.instruction) is None:
            off += ["again", "copy_edit"]
        if not state.selection.count:
            off.append("limit_to_selection")
        for action in _MENU_ITEMS if is_open else ():
            if action == "group":
                _group_menu(state, state.layers[index], ui, actions)
            elif action == "set_blend":
                _blend_menu(state, state.layers[index], ui, actions)
            elif not action:
                imgui.separator()
            else:
                name = f"Delete {several} layers" if action == "remove" and several > 1 else ""
                if menu_item(action, enabled=action not in off, name=name):
                    on_layer = action in _LAYER_ACTIONS
                    actions.append(OnItem(action, index) if on_layer else Plain(action))


def _group_menu(state: ViewState, layer: LayerState, ui: UiContext, actions: list[Action]) -> None:
    if imgui.begin_menu("Group"):
        if menu_item("group"):
            actions.append(Plain("group"))
        for group in state.groups:
            name = elide(group.name, 200.0 * ui.scale)
            if imgui.menu_item(f"{name}##{group.name}", "", group.name == layer.group)[0]:
                actions.append(WithText("group", group.name))
        if layer.group and menu_item("ungroup"):
            actions.append(Plain("ungroup"))
        imgui.end_menu()


def _blend_menu(state: ViewState, layer: LayerState, ui: UiContext, actions: list[Action]) -> None:
    """Draw the choice of the layer's blend rule."""
    if imgui.begin_menu("Blend"):
        titles = {"": f"As all layers ({BLEND_TITLES[state.blend]})", **BLEND_TITLES}
        for rule, title in titles.items():
            if entry(title, BLEND_HELP.get(rule, ""), layer.blend == rule, PALETTE.text, ui):
                actions.append(WithText("set_blend", rule))
        imgui.end_menu()


def _focus_bar(clip: tuple[imgui.ImVec2, imgui.ImVec2], color: Rgba, scale: float) -> None:
    """Draw a stripe along the left edge of the current card, within the panel's clip rectangle."""
    canvas = imgui.get_window_draw_list()
    corner = imgui.get_window_pos()
    edge = (corner.x + 3 * scale, corner.y + imgui.get_window_size().y)
    canvas.push_clip_rect(*clip, False)
    canvas.add_rect_filled(corner, edge, u32(color), 3 * scale)
    canvas.pop_clip_rect()


def _head(
    work: Workspace,
    index: int,
    row: LayerRow,
    active: bool,
    texture: int,
    ui: UiContext,
    actions: list[Action],
) -> tuple[Workspace, CardTouch]:
    """Draw visibility, thumbnail, name and toggles. Reserve space for the strength, which is drawn after the
    slider."""
    scale = ui.scale
    compact = is_compact(work)
    layer = work.view.layers[index]
    right = right_edge()
    gap = 4.0 * scale
    if icon_button("eye", Icon.SHOWN if layer.enabled else Icon.HIDDEN, ui, dim=not active):
        if imgui.get_io().key_alt:
            work = replace(work, view=toggle_solo(work.view, index))
        else:
            work = _change_layer(work, index, lambda old: replace(old, enabled=not old.enabled))
    hint("hide")
    imgui.same_line(0.0, gap)
    if compact:
        swatch(row.swatch, 1.0 if active else 0.35, True, ui)
    else:
        work = _thumbnail(work, index, row, texture, active, ui)
    imgui.same_line(0.0, 2 * gap)
    number_width = _number_width(layer, compact)
    end = right - number_width - 6.0 * scale
    over = imgui.is_window_hovered(imgui.HoveredFlags_.allow_when_blocked_by_active_item.value)
    over |= ui.keyboard == "panel" and work.focus == index
    if compact:
        toggles = 0
    elif over:
        toggles = 5
    else:
        toggles = 2 if layer.locked else int(layer.solo)
    reserved = SLIDER_PX * scale if compact else toggles * TOGGLE_PX * scale
    work, touch = _name(work, index, end - reserved - 4.0 * scale - imgui.get_cursor_pos_x(), active, ui)
    if toggles:
        imgui.same_line(end - reserved)
        _toggles(work, index, over, ui, actions)
    imgui.same_line(right - number_width)
    imgui.dummy((number_width, imgui.get_frame_height()))
    if imgui.is_item_clicked() and not layer.locked:
        slider.start_typing("##strength")
    tip("Locked" if layer.locked else "Click to type a value")
    return work, touch


def _toggles(work: Workspace, index: int, over: bool, ui: UiContext, actions: list[Action]) -> None:
    """Draw the buttons for menu, brush, details, lock and solo. Without hover, draw only an
    active lock or solo."""
    view = work.view
    layer = work.view.layers[index]
    side = TOGGLE_PX * ui.scale
    lock = Icon.LOCKED if layer.locked else Icon.UNLOCKED
    painting = view.brush.active and work.focus == index
    unfolded = layer.gdf in view.unfolded
    buttons = (
        ("menu", Icon.MENU, False),
        ("brush", Icon.BRUSH, painting),
        ("fold", Icon.GAINS, unfolded),
        ("lock", lock, layer.locked),
        ("solo", Icon.SOLO, layer.solo),
    )
    top = imgui.get_cursor_pos_y() + (imgui.get_frame_height() - side) / 2
    with imgui_ctx.push_font(None, SMALL_PX):
        pressed = []
        for action, icon, on in buttons if over else buttons[3 if layer.locked else 4 :]:
            imgui.set_cursor_pos_y(top)
            if not over and not on:
                continue
            if icon_button(action, icon, ui, dim=not on, side=side):
                pressed.append(action)
            if action == "menu":
                tip("Rename, duplicate, replace or delete (right-click)")
            else:
                hint(action)
            imgui.same_line(0.0, 0.0)
    if "menu" in pressed:
        imgui.open_popup(_MENU)
    else:
        actions += map(Plain, pressed)  # they apply to the focused layer, which is now this one


def _thumbnail(
    work: Workspace, index: int, row: LayerRow, texture: int, active: bool, ui: UiContext
) -> Workspace:
    """Draw the rendered thumbnail of the edit. Hovering it shows the details and highlights the region."""
    side, (x, y) = THUMBNAIL_PX * ui.scale, imgui.get_cursor_screen_pos()
    imgui.dummy((side, side))
    picture(texture, (x, y), (x + side, y + side), 3.0 * ui.scale, 1.0 if active else 0.4)
    return _region_tooltip(work, index, row)


def _region_tooltip(work: Workspace, index: int, row: LayerRow) -> Workspace:
    """Show the details as the tooltip of the last item, and highlight the layer's region in the picture."""
    if imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value):
        work = replace(work, pointed=("layer", index))
    tip(_details(work, index, row))
    return work


def _details(work: Workspace, index: int, row: LayerRow) -> str:
    """Return the details of the layer, one per line: size, instruction, overlap with other layers."""
    about = f"{with_added(row.count, row.added)} splats"
    if row.draft:
        about = f"Draft  ·  {about}"
    kind, _, argument = row.instruction.partition(":")
    about += f"  ·  {kind.capitalize()} {argument}" if kind else ""
    shares = (
        f"Shares {'all' if count == row.count else group_digits(count)} with {layer.name}"
        for i, layer in enumerate(work.view.layers)
        if i != index and layer.gdf < len(row.shared) and (count := row.shared[layer.gdf])
    )
    sources = (row.sources,) if row.sources else ()
    return "\n".join((about, *sources, *shares))


def _about(work: Workspace, index: int, row: LayerRow, ui: UiContext) -> Workspace:
    """Draw the details in small text, and the mean color of the edit."""
    swatch(row.swatch, 1.0, True, ui)
    imgui.same_line()
    imgui.set_cursor_pos_y(imgui.get_cursor_pos_y() + 5.0 * ui.scale)
    wrapped_text(_details(work, index, row), PALETTE.dim)
    return _region_tooltip(work, index, row)


def _digits(strength: float, compact: bool) -> str:
    return f"{strength:.2f}" if compact else f"{strength:.3f}"


def _number_width(layer: LayerState, compact: bool) -> float:
    return float(imgui.calc_text_size(_digits(layer.strength, compact)).x)


def _number(corner: imgui.ImVec2, strength: float, active: bool, compact: bool) -> None:
    """Draw the strength in the card's upper right corner. All digits have the same width."""
    color = PALETTE.warning if strength > 1.0 else PALETTE.text
    at = (corner.x, corner.y + imgui.get_style().frame_padding.y)
    text = _digits(strength, compact)
    imgui.get_window_draw_list().add_text(at, u32(color if active else PALETTE.dim), text)


def _name(
    work: Workspace, index: int, room: float, active: bool, ui: UiContext
) -> tuple[Workspace, CardTouch]:
    """Draw the name. A drag moves the card, a double click opens a text field."""
    layer = work.view.layers[index]
    if work.renaming == index:
        text = typed_name(layer.name, room)
        if text is not None:
            work = replace(work, renaming=None, view=rename_layer(work.view, index, text))
        return work, CardTouch()
    x, y = imgui.get_cursor_screen_pos()
    size = (max(room, 1.0), imgui.get_frame_height())
    nav = imgui.ButtonFlags_.enable_nav
    imgui.invisible_button("name", size, nav.value)
    if is_entered():
        return work, CardTouch(touched=True)
    gesture = grip(ui)
    named = imgui.is_item_active()
    at = (x, y + imgui.get_style().frame_padding.y)
    color = PALETTE.text if active else PALETTE.dim
    compact = is_compact(work)
    marks = ""
    if compact and layer.locked:
        marks += f"{Icon.LOCKED} "
    if compact and layer.solo:
        marks += f"{Icon.SOLO} "
    imgui.get_window_draw_list().add_text(at, u32(color), elide(marks + layer.name, room))
    if imgui.is_item_hovered(imgui.HoveredFlags_.for_tooltip.value):
        work = replace(work, pointed=("layer", index))  # highlights its region in the picture
    tip(f"{layer.name}\nDrag to reorder, double-click to rename ({shortcut('rename')})")
    double = imgui.is_mouse_double_clicked(imgui.MouseButton_.left.value) and _press(named) == "one"
    if imgui.is_item_hovered() and double:
        return replace(work, renaming=index), CardTouch(touched=True, named=named)
    return work, CardTouch(drag=gesture, named=named)
