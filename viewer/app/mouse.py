"""Mouse input on the picture: drags of camera, divider and brush, and clicks that pick."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgui_bundle import imgui

from viewer.camera import controls
from viewer.camera.view_camera import ViewCamera
from viewer.camera.views import AXES, look_at_view
from viewer.panel import tools
from viewer.render.picking import layer_at, seen_at, surface_point
from viewer.state import paint, workspace
from viewer.state.commands import MovePointer
from viewer.state.layers import with_paint
from viewer.state.paint import Stroke
from viewer.state.transient import KeyPointer
from viewer.state.view_state import Brush, SelectTool, ViewState
from viewer.state.workspace import Workspace
from viewer.ui import overlay
from viewer.ui.context import PALETTE, UiContext, u32
from viewer.ui.keys import TOOL_KEYS, Keys, any_button_down, has_pending_input, modifier, started_drag
from viewer.ui.overlay import Area
from viewer.ui.pointer import PointerContext

from . import select_tool
from .select_tool import Click, Gesture, Strokes

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


@dataclass(frozen=True)
class MouseTool:
    """Active mouse drag and gesture."""

    # one of `keys.DRAGS`, `DIVIDER`, `PAINT_DRAG`, `SELECT_DRAG` or `AXES_DRAG`; None without a drag
    drag: str | None = None
    stroke: Stroke | None = None  # brush stroke, from its first drag on
    gesture: Gesture | None = None  # gesture of a selection tool; for a polygon also between its clicks
    # the last click of a tool that selects by one click, while it follows the tool's tolerance
    click: Click | None = None
    strokes: tuple[Strokes, ...] = ()  # strokes that a tool spreads, one entry per change
    divider: float = 0.5  # divider before the drag, fraction of the picture's width
    axis: str = ""  # the pressed end of an axis, of `AXES`, or another part of the axes
    # settings of the selection tool and the brush before a button was pressed
    settings: tuple[SelectTool, Brush] | None = None


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


def handle_mouse(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """Handle the mouse input of this frame from imgui's io."""
    io = imgui.get_io()
    tool, work = _drag(tool, work, pointer)
    click, work = select_tool.adjust(tool.click, work, pointer)
    tool = replace(tool, click=click)
    if imgui.is_mouse_released(0) and tool.drag in ("orbit", "look") and not _has_traveled(pointer.ui):
        work = _focus_picked_layer(work, pointer)
    if tool.drag == select_tool.SELECT_DRAG and imgui.is_mouse_released(0) and tool.gesture is not None:
        strokes = tool.strokes
        held = tool.gesture
        if held.tool == "scribble":
            strokes, work = select_tool.spread(strokes, held, work, pointer)
        gesture, work = select_tool.release(held, work, pointer)
        tool = replace(tool, gesture=gesture, strokes=strokes)
    if tool.drag == overlay.AXES_DRAG and imgui.is_mouse_released(0) and not _has_traveled(pointer.ui):
        work = _look_along(work, tool.axis)
    if not any_button_down():
        tool = replace(tool, drag=None, settings=(work.view.select, work.view.brush))
    if io.want_capture_mouse:
        return tool, work
    if grips_divider(tool, work.view, pointer):
        imgui.set_mouse_cursor(imgui.MouseCursor_.resize_ew.value)
        if imgui.is_mouse_clicked(0):
            return replace(tool, drag=DIVIDER, divider=work.view.compare.divider), work
    axis = overlay.axis_under(work.view, pointer.area, pointer.ui)
    plain = not io.key_alt
    if axis and imgui.is_mouse_clicked(0):
        return replace(tool, drag=overlay.AXES_DRAG, axis=axis), work
    if work.form_open and work.form.picks and plain and imgui.is_mouse_clicked(0):
        return replace(tool, drag=select_tool.SELECT_DRAG), select_tool.pick_color(work, pointer)
    if work.view.brush.active and plain and imgui.is_mouse_clicked(0):
        return _begin_stroke(tool, work, pointer)
    if work.view.select.tool in ("flood", "color") and plain and imgui.is_mouse_clicked(0):
        click, work = select_tool.click(work, pointer)
        return MouseTool(select_tool.SELECT_DRAG, click=click), work
    if work.view.select.tool and plain and imgui.is_mouse_clicked(0):
        gesture, work = select_tool.press(tool.gesture, work, pointer)
        return replace(tool, drag=select_tool.SELECT_DRAG, gesture=gesture), work
    camera = work.view.camera
    if imgui.is_mouse_double_clicked(0):
        return tool, workspace.with_camera(work, _pick_pivot(camera, pointer))
    tool = replace(tool, drag=started_drag(camera.mode) or tool.drag)
    if io.mouse_wheel:
        work = workspace.with_camera(work, controls.zoom(camera, io.mouse_wheel, pointer.facts.bounds.radius))
    return tool, work


def cancel_drag(tool: MouseTool, work: Workspace) -> Workspace:
    """Restore the state from before the drag.

    Edits come back from the undo history. Settings of the tools and the divider are not edits and come back
    from `tool`.
    """
    work = workspace.cancel_drag(work)
    if tool.settings is not None:
        select, brush_settings = tool.settings
        work = replace(work, view=replace(work.view, select=select, brush=brush_settings))
    if tool.drag != DIVIDER:
        return work
    return replace(work, view=place_divider(work.view, tool.divider))


def grips_divider(tool: MouseTool, view: ViewState, pointer: PointerContext) -> bool:
    """Return True if the divider of a split is dragged or under the mouse."""
    if tool.drag is not None:
        return tool.drag == DIVIDER
    mouse = imgui.get_io().mouse_pos
    area = pointer.area
    within = abs(mouse.x - view.compare.divider * area.width) <= REACH_PX * pointer.ui.scale
    over = imgui.get_io().want_capture_mouse or not 0.0 <= mouse.y < area.height
    return view.compare.mode == "split" and within and not over


def _drag(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """Apply this frame's mouse movement to the active drag."""
    io = imgui.get_io()
    scale = pointer.ui.scale
    dx = io.mouse_delta.x / scale
    dy = io.mouse_delta.y / scale
    if tool.drag == DIVIDER:
        return tool, replace(work, view=place_divider(work.view, io.mouse_pos.x / pointer.area.width))
    if tool.drag == tools.PAINT_DRAG:
        return _paint(tool, work, pointer)
    if tool.drag == select_tool.SELECT_DRAG:
        if tool.gesture is None:
            return tool, work
        gesture, work = select_tool.follow(tool.gesture, work, pointer)
        return replace(tool, gesture=gesture), work
    if tool.drag == overlay.AXES_DRAG:
        camera = work.view.camera
        turned = controls.orbit(camera, dx, dy) if _has_traveled(pointer.ui) else camera
        return tool, workspace.with_camera(work, turned)
    if tool.drag and (dx or dy):
        # also if the button went up within this frame: a slow frame must not lose the end of a drag
        height = pointer.scale * pointer.area.height / scale
        radius = pointer.facts.bounds.radius
        lens = pointer.shown.camera.fov_y  # a safe frame widens the view beyond the camera's own angle
        camera = controls.drag(replace(work.view.camera, fov_y=lens), tool.drag, dx, dy, height, radius)
        return tool, workspace.with_camera(work, replace(camera, fov_y=work.view.camera.fov_y))
    return tool, work


def _begin_stroke(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """Begin a brush stroke on the focused layer, or show why it cannot be painted."""
    reason = tools.paint_obstacle(work.view, work.focus)
    if reason or work.focus is None:
        return tool, workspace.with_message(work, f"Cannot paint: {reason}", pointer.now, error=True)
    layer = work.view.layers[work.focus]
    brush = work.view.brush
    mode = paint.mode_while(brush.mode, modifier())
    gdf = pointer.engine.gdfs[layer.gdf]
    stroke = paint.begin_stroke(layer.paint, gdf, pointer.surface, brush.through, mode)
    return _paint(MouseTool(tools.PAINT_DRAG, stroke), work, pointer)


def _paint(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """Extend the brush stroke to the cursor and show the result at once."""
    view = work.view
    focus = work.focus
    if tool.stroke is None or focus is None:
        return tool, work
    density = imgui.get_io().display_framebuffer_scale.x * pointer.ui.scale
    stroke = paint.extend_stroke(tool.stroke, *pointer.cursor, view.brush, density)
    painted = with_paint(view, focus, paint.apply_stroke(stroke, view.brush, density))
    return replace(tool, stroke=stroke), replace(work, view=painted)


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
