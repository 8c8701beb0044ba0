"""Mouse input on the picture: drags of camera, divider and brush, and clicks that pick."""

from __future__ import annotations

from dataclasses import replace

from imgui_bundle import imgui

from viewer.camera import controls
from viewer.camera.view_camera import ViewCamera
from viewer.camera.views import AXES, look_at_view
from viewer.panel import tools
from viewer.render.picking import layer_at, seen_at, surface_point
from viewer.state import paint, workspace
from viewer.state.commands import MovePointer
from viewer.state.layers import with_paint
from viewer.state.transient import KeyPointer, MouseTool
from viewer.state.view_state import ViewState
from viewer.state.workspace import Workspace, with_tool, with_transient
from viewer.ui import overlay
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.keys import TOOL_KEYS, Keys, any_button_down, has_pending_input, modifier, started_drag
from viewer.ui.overlay import Area
from viewer.ui.pointer import PointerContext

from . import color_tool, measure, select_tool
from .inspect import frusta

REACH_PX = 8.0  # at 1×: the mouse grips the divider within this distance
DIVIDER = "divider"
"""Name of the divider's drag, in addition to those of `keys.DRAGS`."""


def place_divider(view: ViewState, divider: float) -> ViewState:
    """Place the divider at this fraction of the picture's width, clamped to 0 to 1."""
    return replace(view, compare=replace(view.compare, divider=max(0.0, min(1.0, divider))))


def draw_comparison(view: ViewState, area: Area, held: bool, ui: UiContext) -> None:
    """Draw the divider; `held`: the mouse drags it or is over it."""
    if view.compare.mode == "split":
        _divider(view.compare.divider, area, held, ui)
        _knob(round(view.compare.divider * area.width), area.height / 2, held, ui)
    if view.compare.mode == "beside":
        _divider(0.5, area, False, ui)


def _divider(share: float, area: Area, held: bool, ui: UiContext) -> None:
    x = round(share * area.width)
    canvas = imgui.get_background_draw_list()
    ink = u32(PALETTE.accent if held else PALETTE.handle)
    top = (x, 0.0)
    bottom = (x, area.height)
    canvas.add_line(top, bottom, u32(PALETTE.scrim), 3.0 * ui.scale)
    canvas.add_line(top, bottom, ink, 1.5 * ui.scale)


def _knob(x: float, y: float, held: bool, ui: UiContext) -> None:
    """Draw a round grip with an arrow on either side."""
    s = ui.scale
    canvas = imgui.get_background_draw_list()
    ink = u32(PALETTE.accent if held else PALETTE.handle)
    canvas.add_circle_filled((x, y), 12.0 * s, u32(PALETTE.scrim))
    canvas.add_circle((x, y), 12.0 * s, ink, 0, 1.5 * s)
    for side in (-1.0, 1.0):
        canvas.add_triangle_filled(
            (x + side * 7.5 * s, y),
            (x + side * 3.0 * s, y - side * 4.0 * s),
            (x + side * 3.0 * s, y + side * 4.0 * s),
            ink,
        )


CLICK_PX = 3.0  # at 1×: a press that moves no further is a click


def point_by_keys(
    held: KeyPointer, keys: Keys, pointer: PointerContext, clicks: bool
) -> tuple[KeyPointer, Keys]:
    """Move the pointer and press its button by keys; imgui receives them as mouse events.

    Args:
        clicks: the active tool needs only a click, which is released at once

    Returns:
        The pointer, and the unused keys.
    """
    io = imgui.get_io()
    area = pointer.area
    at = held.at
    down = held.down
    if (
        at is not None
        and not has_pending_input()
        and max(abs(io.mouse_pos.x - at[0]), abs(io.mouse_pos.y - at[1])) > 1.0
    ):
        at = None  # the mouse was moved
    for press in keys.pressed:
        if (command := TOOL_KEYS.get(press.chord)) is None:
            continue
        at = at or (area.width / 2, area.height / 2)
        action = command.action
        if isinstance(action, MovePointer):
            x = at[0] + action.x * pointer.ui.scale
            y = at[1] + action.y * pointer.ui.scale
            at = round(min(max(x, 0.0), area.width - 1.0)), round(min(max(y, 0.0), area.height - 1.0))
        elif press.again:
            continue
        io.add_mouse_pos_event(*at)
        if not isinstance(action, MovePointer):
            for pressed in (True, False) if clicks else (not down,):
                io.add_mouse_button_event(0, pressed)
            down = not (clicks or down)
    unused = tuple(press for press in keys.pressed if press.chord not in TOOL_KEYS)
    return KeyPointer(at, down), replace(keys, pressed=unused)


def let_go(held: KeyPointer) -> KeyPointer:
    """Release the button that keys pressed."""
    if held.down:
        imgui.get_io().add_mouse_button_event(0, False)
    return replace(held, down=False)


def handle_mouse(work: Workspace, pointer: PointerContext) -> Workspace:
    """Handle the mouse input of this frame from imgui's io."""
    work = _handle_release(select_tool.adjust(_drag(work, pointer), pointer), pointer)
    return work if imgui.get_io().want_capture_mouse else _handle_press(work, pointer)


def _handle_release(work: Workspace, pointer: PointerContext) -> Workspace:
    """End the drag of a released button."""
    tool = work.transient.tool
    if imgui.is_mouse_released(0) and tool.drag in ("orbit", "look") and not _has_traveled(pointer.ui):
        if work.view.color_brush.tool:
            work = color_tool.pick(work, pointer)
        elif (viewpoint := frusta.under(work, pointer)) is not None:
            work = frusta.look_through(work, viewpoint, pointer)
        else:
            work = _focus_picked_layer(work, pointer)
    if tool.drag == color_tool.COLOR_DRAG and imgui.is_mouse_released(0):
        work = color_tool.release(work, pointer)
    if tool.drag == select_tool.SELECT_DRAG and imgui.is_mouse_released(0) and tool.gesture is not None:
        work = select_tool.release(tool.gesture, work, pointer)
    if tool.drag == overlay.AXES_DRAG and imgui.is_mouse_released(0) and not _has_traveled(pointer.ui):
        work = _look_along(work, tool.axis)
    if any_button_down():
        return work
    return with_tool(work, drag=None, settings=(work.view.select, work.view.brush, work.view.color_brush))


def _handle_press(work: Workspace, pointer: PointerContext) -> Workspace:
    """Begin the drag or gesture of a pressed button, or zoom by the wheel."""
    io = imgui.get_io()
    if grips_divider(work, pointer):
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)
        if imgui.is_mouse_clicked(0):
            return with_tool(work, drag=DIVIDER, divider=work.view.compare.divider)
    axis = overlay.axis_under(work.view, pointer.area, pointer.ui)
    plain = not io.key_alt
    if axis and imgui.is_mouse_clicked(0):
        return with_tool(work, drag=overlay.AXES_DRAG, axis=axis)
    if work.form_open and work.form.picks and plain and imgui.is_mouse_clicked(0):
        return with_tool(select_tool.pick_color(work, pointer), drag=select_tool.SELECT_DRAG)
    if work.view.brush.active and plain and imgui.is_mouse_clicked(0):
        return _begin_stroke(work, pointer)
    if work.view.color_brush.tool and plain and imgui.is_mouse_clicked(0):
        return color_tool.press(work, pointer)
    if work.view.select.tool in ("flood", "color") and plain and imgui.is_mouse_clicked(0):
        return select_tool.click(work, pointer)
    if work.view.select.tool and plain and imgui.is_mouse_clicked(0):
        return with_tool(select_tool.press(work, pointer), drag=select_tool.SELECT_DRAG)
    if measure.is_measuring(work) and plain and imgui.is_mouse_clicked(0):
        return measure.click(work, pointer)
    camera = work.view.camera
    if imgui.is_mouse_double_clicked(0):
        return workspace.with_camera(work, _pick_pivot(camera, pointer))
    if drag := started_drag(camera.mode):
        work = with_tool(work, drag=drag)
    if io.mouse_wheel:
        work = workspace.with_camera(work, controls.zoom(camera, io.mouse_wheel, pointer.facts.bounds.radius))
    return work


def cancel_drag(work: Workspace) -> Workspace:
    """End the drag and restore the state from before it.

    Edits come back from the undo history. Settings of the tools and the divider are not edits and come back
    from the `MouseTool`.
    """
    tool = work.transient.tool
    work = with_transient(workspace.cancel_drag(work), tool=MouseTool())
    if tool.settings is not None:
        select, brush, color_brush = tool.settings
        work = replace(work, view=replace(work.view, select=select, brush=brush, color_brush=color_brush))
    if tool.drag != DIVIDER:
        return work
    return replace(work, view=place_divider(work.view, tool.divider))


def grips_divider(work: Workspace, pointer: PointerContext) -> bool:
    """Return True if the divider of a split is dragged or under the mouse."""
    view = work.view
    drag = work.transient.tool.drag
    if drag is not None:
        return drag == DIVIDER
    mouse = imgui.get_io().mouse_pos
    area = pointer.area
    within = abs(mouse.x - view.compare.divider * area.width) <= REACH_PX * pointer.ui.scale
    over = imgui.get_io().want_capture_mouse or not 0.0 <= mouse.y < area.height
    return view.compare.mode == "split" and within and not over


def _drag(work: Workspace, pointer: PointerContext) -> Workspace:
    """Apply this frame's mouse movement to the active drag."""
    io = imgui.get_io()
    tool = work.transient.tool
    scale = pointer.ui.scale
    dx = io.mouse_delta.x / scale
    dy = io.mouse_delta.y / scale
    if tool.drag == DIVIDER:
        return replace(work, view=place_divider(work.view, io.mouse_pos.x / pointer.area.width))
    if tool.drag == tools.PAINT_DRAG:
        return _paint(work, pointer)
    if tool.drag == color_tool.COLOR_DRAG:
        return color_tool.follow(work, pointer)
    if tool.drag == select_tool.SELECT_DRAG:
        return work if tool.gesture is None else select_tool.follow(tool.gesture, work, pointer)
    if tool.drag == overlay.AXES_DRAG:
        camera = work.view.camera
        turned = controls.orbit(camera, dx, dy) if _has_traveled(pointer.ui) else camera
        return workspace.with_camera(work, turned)
    if tool.drag and (dx or dy):
        # also if the button went up within this frame: a slow frame must not lose the end of a drag
        height = pointer.scale * pointer.area.height / scale
        radius = pointer.facts.bounds.radius
        lens = pointer.shown.camera.fov_y  # a safe frame widens the view beyond the camera's own angle
        camera = controls.drag(replace(work.view.camera, fov_y=lens), tool.drag, dx, dy, height, radius)
        return workspace.with_camera(work, replace(camera, fov_y=work.view.camera.fov_y))
    return work


def _begin_stroke(work: Workspace, pointer: PointerContext) -> Workspace:
    """Begin a brush stroke on the focused layer, or show why it cannot be painted."""
    reason = tools.paint_obstacle(work.view, work.focus)
    if reason or work.focus is None:
        return workspace.with_message(work, f"Cannot paint: {reason}", pointer.now, error=True)
    layer = work.view.layers[work.focus]
    brush = work.view.brush
    mode = paint.mode_while(brush.mode, modifier())
    gdf = pointer.engine.gdfs[layer.gdf]
    stroke = paint.begin_stroke(layer.paint, gdf, pointer.surface, brush.through, mode)
    return _paint(with_transient(work, tool=MouseTool(tools.PAINT_DRAG, stroke)), pointer)


def _paint(work: Workspace, pointer: PointerContext) -> Workspace:
    """Extend the brush stroke to the cursor and show the result at once."""
    view = work.view
    focus = work.focus
    begun_stroke = work.transient.tool.stroke
    if begun_stroke is None or focus is None:
        return work
    density = imgui.get_io().display_framebuffer_scale.x * pointer.ui.scale
    stroke = paint.extend_stroke(begun_stroke, *pointer.cursor, view.brush, density)
    painted = with_paint(view, focus, paint.apply_stroke(stroke, view.brush, density))
    return with_tool(replace(work, view=painted), stroke=stroke)


def _has_traveled(ui: UiContext) -> bool:
    """Return True if the left button moved further than `CLICK_PX` since its press."""
    delta = imgui.get_mouse_drag_delta(0, CLICK_PX * ui.scale)
    return bool(delta.x or delta.y)


def _look_along(work: Workspace, axis: str) -> Workspace:
    """Look from the clicked end of an axis."""
    camera = work.view.camera
    if axis not in AXES:
        return work
    return workspace.glide_from(workspace.with_camera(work, look_at_view(camera, axis)), camera)


def _focus_picked_layer(work: Workspace, pointer: PointerContext) -> Workspace:
    """Focus the layer at a click on the picture, if there is any."""
    engine = pointer.engine
    view = pointer.shown
    camera = pointer.camera(view.camera)
    seen = seen_at(pointer.scene, camera, *pointer.cursor, engine.near)
    layer = None if seen is None else layer_at(view, engine.gdfs, seen)
    return work if layer is None else workspace.focus_layer(work, layer)


def _pick_pivot(camera: ViewCamera, pointer: PointerContext) -> ViewCamera:
    """Set the pivot to the surface at a double click."""
    engine = pointer.engine
    point = surface_point(pointer.scene, pointer.camera(pointer.shown.camera), *pointer.cursor, engine.near)
    return camera if point is None else controls.pivot_on(camera, point, pointer.facts.bounds.radius)
