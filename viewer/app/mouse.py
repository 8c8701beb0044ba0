"""The mouse on the picture: drags of the camera, the divider and the brush, clicks that pick."""

from __future__ import annotations

from dataclasses import dataclass, replace

from imgui_bundle import imgui

from viewer.camera import controls
from viewer.camera.named_views import AXES, look_at_view
from viewer.camera.view_camera import ViewCamera
from viewer.panel import brush
from viewer.render.picking import layer_at, seen_at, surface_point
from viewer.select import hand
from viewer.select.gesture import Click, Gesture
from viewer.state import paint, workspace
from viewer.state.layers import with_paint
from viewer.state.paint import Stroke
from viewer.state.view_state import Brush, SelectTool, ViewState
from viewer.state.workspace import Workspace
from viewer.ui import axis_gizmo
from viewer.ui.context import UiContext
from viewer.ui.keys import any_button_down, modifier, started_drag
from viewer.ui.pointer import PointerContext

from . import compare_overlay

CLICK_PX = 3.0  # a press that moves no further, at 1×, is a click


@dataclass(frozen=True)
class MouseTool:
    """What the mouse holds.

    Args:
        drag: one of `keys.DRAGS`, `compare_overlay.DIVIDER`, `brush.DRAG`, `hand.DRAG` or
            `axis_gizmo.DRAG`; None while it holds nothing
        stroke: of the brush, from its first drag on
        gesture: of the tool that selects; of a polygon also between its clicks
        click: the last of a tool that selects by one, while it follows the tool's tolerance
        divider: where that of a split stood when it was gripped, share of the picture's width
        axis: the end of an axis that was pressed, of `named_views.AXES`, or another part of the axes
        settings: of the tools that select and paint, as they were before a button was pressed
    """

    drag: str | None = None
    stroke: Stroke | None = None
    gesture: Gesture | None = None
    click: Click | None = None
    divider: float = 0.5
    axis: str = ""
    settings: tuple[SelectTool, Brush] | None = None


def handle_mouse(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """What the mouse did in this frame, as imgui's io has it."""
    io = imgui.get_io()
    tool, work = _drag(tool, work, pointer)
    click, work = hand.adjust(tool.click, work, pointer)
    tool = replace(tool, click=click)
    if imgui.is_mouse_released(0) and tool.drag in ("orbit", "look") and not _has_traveled(pointer.ui):
        work = _focus_picked_layer(work, pointer)
    if tool.drag == hand.DRAG and imgui.is_mouse_released(0) and tool.gesture is not None:
        gesture, work = hand.release(tool.gesture, work, pointer)
        tool = replace(tool, gesture=gesture)
    if tool.drag == axis_gizmo.DRAG and imgui.is_mouse_released(0) and not _has_traveled(pointer.ui):
        work = _look_along(work, tool.axis)
    if not any_button_down():
        tool = replace(tool, drag=None, settings=(work.view.select, work.view.brush))
    if io.want_capture_mouse:
        return tool, work
    if grips_divider(tool, work.view, pointer):
        compare_overlay.show_grip()
        if imgui.is_mouse_clicked(0):
            return MouseTool(compare_overlay.DIVIDER, divider=work.view.compare.divider), work
    axis, plain = axis_gizmo.under(work.view, pointer.area, pointer.ui), not io.key_alt
    if axis and imgui.is_mouse_clicked(0):
        return replace(tool, drag=axis_gizmo.DRAG, axis=axis), work
    if work.view.brush.active and plain and imgui.is_mouse_clicked(0):
        return _begin_stroke(tool, work, pointer)
    if work.view.select.tool in ("flood", "color") and plain and imgui.is_mouse_clicked(0):
        click, work = hand.click(work, pointer)
        return MouseTool(hand.DRAG, click=click), work
    if work.view.select.tool and plain and imgui.is_mouse_clicked(0):
        gesture, work = hand.press(tool.gesture, work, pointer)
        return replace(tool, drag=hand.DRAG, gesture=gesture), work
    camera = work.view.camera
    if imgui.is_mouse_double_clicked(0):
        return tool, workspace.with_camera(work, _pick_pivot(camera, pointer))
    tool = replace(tool, drag=started_drag(camera.mode) or tool.drag)
    if io.mouse_wheel:
        work = workspace.with_camera(work, controls.zoom(camera, io.mouse_wheel, pointer.facts.bounds.radius))
    return tool, work


def cancel_drag(tool: MouseTool, work: Workspace) -> Workspace:
    """What is dragged goes back to where it was; undo knows where, but for the settings of the tools and the
    divider, which are no edits."""
    work = workspace.cancel_drag(work)
    if tool.settings is not None:
        select, brush_settings = tool.settings
        work = replace(work, view=replace(work.view, select=select, brush=brush_settings))
    if tool.drag != compare_overlay.DIVIDER:
        return work
    return replace(work, view=compare_overlay.place_divider(work.view, tool.divider))


def grips_divider(tool: MouseTool, view: ViewState, pointer: PointerContext) -> bool:
    """Whether the divider of a split is in the tool, or under it."""
    if tool.drag is not None:
        return tool.drag == compare_overlay.DIVIDER
    over = imgui.get_io().want_capture_mouse
    return not over and compare_overlay.near(view, pointer.area, pointer.ui)


def _drag(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """What is held follows the mouse."""
    io, scale = imgui.get_io(), pointer.ui.scale
    dx, dy = io.mouse_delta.x / scale, io.mouse_delta.y / scale
    if tool.drag == compare_overlay.DIVIDER:
        return tool, replace(work, view=compare_overlay.move_divider(work.view, pointer.area))
    if tool.drag == brush.DRAG:
        return _paint(tool, work, pointer)
    if tool.drag == hand.DRAG:
        if tool.gesture is None:
            return tool, work
        gesture, work = hand.follow(tool.gesture, work, pointer)
        return replace(tool, gesture=gesture), work
    if tool.drag == axis_gizmo.DRAG:
        camera = work.view.camera
        turned = controls.orbit(camera, dx, dy) if _has_traveled(pointer.ui) else camera
        return tool, workspace.with_camera(work, turned)
    if tool.drag and (dx or dy):
        # also where the button went up within this frame: a slow frame must not lose the end of a drag
        height, radius = pointer.scale * pointer.area.height / scale, pointer.facts.bounds.radius
        camera = controls.drag(work.view.camera, tool.drag, dx, dy, height, radius)
        return tool, workspace.with_camera(work, camera)
    return tool, work


def _begin_stroke(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """The brush comes down on the focused layer, or says why it cannot."""
    reason = brush.obstacle(work.view, work.focus)
    if reason or work.focus is None:
        return tool, workspace.with_message(work, f"Cannot paint: {reason}", pointer.now, error=True)
    layer, held = work.view.layers[work.focus], work.view.brush
    mode = paint.mode_while(held.mode, modifier())
    gdf = pointer.engine.gdfs[layer.gdf]
    stroke = paint.begin_stroke(layer.paint, gdf, pointer.surface, held.through, mode)
    return _paint(MouseTool(brush.DRAG, stroke), work, pointer)


def _paint(tool: MouseTool, work: Workspace, pointer: PointerContext) -> tuple[MouseTool, Workspace]:
    """The brush moves to the cursor; what it has painted so far is shown at once."""
    view, focus = work.view, work.focus
    if tool.stroke is None or focus is None:
        return tool, work
    density = imgui.get_io().display_framebuffer_scale.x * pointer.ui.scale
    stroke = paint.extend_stroke(tool.stroke, *pointer.cursor, view.brush, density)
    painted = with_paint(view, focus, paint.apply_stroke(stroke, view.brush, density))
    return replace(tool, stroke=stroke), replace(work, view=painted)


def _has_traveled(ui: UiContext) -> bool:
    """Whether the left button moved between its press and its release, by more than a tremor."""
    way = imgui.get_mouse_drag_delta(0, CLICK_PX * ui.scale)
    return bool(way.x or way.y)


def _look_along(work: Workspace, axis: str) -> Workspace:
    """A click on an end of an axis: seen from there."""
    camera = work.view.camera
    if axis not in AXES:
        return work
    return workspace.glide_from(workspace.with_camera(work, look_at_view(camera, axis)), camera)


def _focus_picked_layer(work: Workspace, pointer: PointerContext) -> Workspace:
    """A click on the picture: the layer there, if there is one, is focused."""
    engine, view = pointer.engine, pointer.shown
    camera = pointer.camera(work.view.camera)
    seen = seen_at(pointer.scene, camera, *pointer.cursor, engine.near)
    layer = None if seen is None else layer_at(view, engine.gdfs, seen)
    return work if layer is None else workspace.focus_layer(work, layer)


def _pick_pivot(camera: ViewCamera, pointer: PointerContext) -> ViewCamera:
    """A double click: what lies under the cursor becomes the pivot."""
    engine = pointer.engine
    point = surface_point(pointer.scene, pointer.camera(camera), *pointer.cursor, engine.near)
    return camera if point is None else controls.pivot_on(camera, point, pointer.facts.bounds.radius)
