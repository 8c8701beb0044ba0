"""View settings: the buttons under the axes, and the popover of view mode, up axis, lens and background."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui, imgui_ctx

from viewer.camera.view_camera import Vec3, ViewCamera, axes, with_up
from viewer.state.commands import Action, Plain, WithText
from viewer.state.view_state import VIEW_MODES, ViewState
from viewer.ui import overlay
from viewer.ui.context import SMALL_PX, Icon, UiContext
from viewer.ui.keys import shortcut
from viewer.ui.overlay import Area
from viewer.ui.widgets import (
    choice,
    hint,
    icon_button,
    icon_row,
    label,
    menu,
    menu_item,
    plate,
    tip,
    value_slider,
)

from .tools import COLUMN_PX, EDGE_PX, NARROW_PX, PAD_PX, open_below

UPS: dict[str, Vec3] = {
    "+X": (1.0, 0.0, 0.0),
    "−X": (-1.0, 0.0, 0.0),
    "+Y": (0.0, 1.0, 0.0),
    "−Y": (0.0, -1.0, 0.0),
    "+Z": (0.0, 0.0, 1.0),
    "−Z": (0.0, 0.0, -1.0),
}


_MODE_ROWS = VIEW_MODES[:3], VIEW_MODES[3:6], VIEW_MODES[6:]
_VIEW_BUTTONS = (("frame", Icon.FRAME), ("home", Icon.HOME))


def draw_view(view: ViewState, area: Area, foot: float, ui: UiContext, actions: list[Action]) -> ViewState:
    """Draw the buttons under the axes: frame, home, and the view settings. `foot`: lower edge of the
    options bar, window pixels."""
    top = max(overlay.axes_height(view, area, ui), EDGE_PX * ui.scale)
    if top < foot and area.width < NARROW_PX * ui.scale:
        return view  # the options bar covers it
    with plate("view", (area.width - EDGE_PX * ui.scale, top), ui, (1.0, 0.0), PAD_PX):
        imgui.push_style_var(imgui.StyleVar_.item_spacing, (0.0, 0.0))
        icon_row(_VIEW_BUTTONS, ui, actions)
        imgui.same_line()
        if icon_button("view", Icon.VIEW, ui, lit=view.mode != ViewState.mode):
            imgui.open_popup("view settings")
        tip("View mode, up axis, field of view, background, grid")
        imgui.pop_style_var()
        open_below(1.0, ui)
        with menu("view settings", ui) as is_open:
            view = _view_rows(view, ui, actions) if is_open else view
        foot = imgui.get_window_pos().y + imgui.get_window_size().y
    if view.mode != ViewState.mode:
        _draw_mode(view.mode, (area.width - EDGE_PX * ui.scale, foot + PAD_PX * ui.scale), ui, actions)
    return view


def _draw_mode(mode: str, corner: tuple[float, float], ui: UiContext, actions: list[Action]) -> None:
    """Draw the name and key of the view mode; a click returns to the splats.

    Args:
        mode: the view mode
        corner: upper right corner, window pixels
        ui: fonts and scale
        actions: receives the command of a click
    """
    key = shortcut("next_view_mode")
    text = mode.capitalize() + (f" — {key}" if key else "")
    with plate("view mode", corner, ui, (1.0, 0.0), PAD_PX):
        imgui.push_style_color(imgui.Col_.button, (0.0, 0.0, 0.0, 0.0))
        with imgui_ctx.push_font(None, SMALL_PX):
            pressed = imgui.button(text)
        imgui.pop_style_color()
        hint("view_mode:splats")
    if pressed:
        actions.append(WithText("view_mode", ViewState.mode))


def _view_rows(view: ViewState, ui: UiContext, actions: list[Action]) -> ViewState:
    column = COLUMN_PX * ui.scale
    wide = 232.0 * ui.scale
    camera = view.camera
    label("View mode", column)
    for i, names in enumerate(_MODE_ROWS):
        if i:
            label("", column)
        pressed = choice("mode", {name: name.capitalize() for name in names}, view.mode, ui, wide)
        hint("next_view_mode")
        if pressed is not None:
            actions.append(WithText("view_mode", pressed))
    label("Up axis", column)
    current = next((name for name, up in UPS.items() if up == camera.up), "View")
    ups = {**UPS, "View": axes(camera).up}
    chosen = choice("up", {name: name for name in ups}, current, ui, wide)
    tip("Up axis of the scene. View: use the current view's up direction")
    if chosen is not None:
        camera = with_up(camera, ups[chosen])
    label("View angle", column)
    fov_y = value_slider("##fov", camera.fov_y, (10.0, 110.0), "%.0f°", ViewCamera.fov_y, ui, wide)
    camera = replace(camera, fov_y=fov_y)
    tip(f"Vertical field of view. Double-click: reset to {ViewCamera.fov_y:g}°")
    label("Background", column)
    picker = imgui.ColorEditFlags_.no_inputs.value | imgui.ColorEditFlags_.no_alpha.value
    changed, (red, green, blue) = imgui.color_edit3("##background", list(view.background), picker)
    background = (red, green, blue) if changed else view.background
    if menu_item("histogram"):
        actions.append(Plain("histogram"))
    for action, on in (("grid", view.grid), ("axes", view.axes)):
        if menu_item(action, on):
            actions.append(Plain(action))
    return replace(view, camera=camera, background=background)
