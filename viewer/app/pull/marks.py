"""Drawing of the Pull tool: its options, handles, pins, radius, and the line of a drag."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui

from progdf.painting.projection import ViewSurface
from viewer.app import typed
from viewer.camera.decal_warp import project, vec3
from viewer.camera.view_camera import Vec3, axes
from viewer.state.transient import Pull, PullDrag
from viewer.ui.context import PALETTE, Rgba, UiContext, u32
from viewer.ui.pointer import PointerContext
from viewer.ui.widgets import accent_button, checkbox, elide, group_digits, inert, plate, small, tip

from .cutting import clear
from .ring import surface_ring
from .transform import gizmo_of

_HANDLE_PX = 5.0  # at 1×: radius of a handle
_PIN_PX = 4.0  # at 1×: half the side of a pin
_CIRCLE_POINTS = 64  # corners of the circle that shows the radius
_RING_PX = 1.25  # at 1×: width of the ring
_CUT_PX = 2.5  # at 1×: width of a cut
_PLATE_PX = 8.0  # at 1×: distance of the buttons from the upper edge of the picture
_SIDE_PX = 64.0  # at 1×: smallest distance of the bar from the sides of the picture
_HINT_PX = 430.0  # at 1×: width of the line below the buttons
_HANDLE_COLOR = (1.0, 0.72, 0.05, 1.0)
_PIN_COLOR = (0.35, 0.75, 1.0, 1.0)
_PICKED_COLOR = (1.0, 1.0, 1.0, 1.0)
_OUTLINE_COLOR = (0.0, 0.0, 0.0, 0.6)
_CUT_COLOR = (1.0, 0.2, 0.55, 1.0)
_AXES: dict[str, Vec3] = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_AXIS_COLORS = {"x": (0.93, 0.30, 0.32), "y": (0.48, 0.79, 0.25), "z": (0.26, 0.54, 0.95)}


def direction(drag: PullDrag) -> Vec3 | None:
    """Return the direction that a drag is restricted to; None for the plane of the view."""
    if drag.axis:
        return _AXES[drag.axis]
    return drag.normal if imgui.get_io().key_alt else None


def draw_bar(pull: Pull, pointer: PointerContext) -> tuple[Pull, str]:
    """Draw the options and buttons of the tool; return the pull and the request, "" for none."""
    scale = pointer.ui.scale
    at = (pointer.area.width / 2, _PLATE_PX * scale)
    request = ""
    with plate("placing", at, pointer.ui, (0.5, 0.0)):
        imgui.align_text_to_frame_padding()
        imgui.text(_title(pull, pointer))
        _follow_box("Whole part", pointer)
        whole = checkbox("Whole part", pull.whole, pointer.ui)
        tip("Move all that is connected, except pins and what is held; else only what lies in the radius")
        holds = pull.holds_selection
        if pointer.shown.selection.count:
            _follow_box("Hold selection", pointer)
            holds = checkbox("Hold selection", holds, pointer.ui)
            tip("Keep the selection in place; else only the selection moves")
        _follow_box("Cut", pointer)
        cuts = checkbox("Cut", pull.is_cutting, pointer.ui)
        tip("Draw lines where things touch, so that only one of them moves (K)")
        if pull.pose.cuts:
            _follow_box("Clear cuts", pointer)
            if imgui.button("Clear cuts"):
                pull = clear(pull)
            tip("Remove all cuts; Shift+click removes one while Cut is on")
        _follow(160.0 * scale, pointer)  # both buttons
        with inert(not pull.pose.handles):
            if accent_button("Keep", (72.0 * scale, 0.0)):
                request = pull.enter_request
        tip("Make a layer with a slider (Enter)")
        imgui.same_line()
        if imgui.button("Cancel", (72.0 * scale, 0.0)):
            request = "leave_pull"
        room = min(_HINT_PX * scale, _room(pointer))
        hint = elide(pull.status or _hint(pull), room)
        small(hint, PALETTE.dim, imgui.calc_text_size(hint).x)
    return replace(pull, whole=whole, holds_selection=holds, is_cutting=cuts), request


def _room(pointer: PointerContext) -> float:
    """Return the largest width of the bar, window pixels."""
    return pointer.area.width - 2.0 * _SIDE_PX * pointer.ui.scale


def _follow(width: float, pointer: PointerContext) -> None:
    """Place the next item, of this width, on the same line if it fits."""
    right = imgui.get_item_rect_max().x - imgui.get_window_pos().x
    if right + imgui.get_style().item_spacing.x + width <= _room(pointer):
        imgui.same_line()


def _follow_box(text: str, pointer: PointerContext) -> None:
    """Place the next checkbox on the same line if it fits."""
    gap = imgui.get_style().item_inner_spacing.x
    _follow(imgui.get_frame_height() + gap + imgui.calc_text_size(text).x, pointer)


def _title(pull: Pull, pointer: PointerContext) -> str:
    """Return the transform in progress, or the name and the radius of the tool."""
    handle = pull.picked_handle
    if pull.transform is not None and handle is not None:
        by_keys = pull.transform.typed
        if by_keys is not None:
            return typed.describe(by_keys, gizmo_of(handle).matrix, pointer.shown.unit)
        degrees = math.degrees(math.hypot(*(handle.turn or (0.0,))))
        return f"Turn {degrees:.1f}°, scale {handle.scale:.3g}"
    return "Pull" if pull.whole else f"Pull, radius {pull.radius:.3g}"


def _hint(pull: Pull) -> str:
    if pull.transform is not None and pull.transform.typed is not None:
        return "X, Y, Z: axis. Type a number. Ctrl: steps. Enter or click: take. Esc: back"
    if pull.transform is not None:
        return "Ctrl: steps of 15° and 0.1. Esc: back"
    if pull.is_cutting:
        return _cut_hint(pull)
    if pull.picked_handle is not None and pull.drag is None:
        return "Rings, R, S: turn, scale. G: move. Click: pin. Shift+click: free. Enter: keep"
    if pull.drag is not None:
        return "Alt: along the normal. X, Y, Z: along an axis. Wheel: radius. Esc: back"
    if pull.pose.handles:
        return "Drag a dot again, or pull elsewhere. Click: pin. Shift+click: free. Enter: keep"
    return "Drag the surface. Wheel: radius. Click: pin. Shift+click: free. Esc: leave"


def _cut_hint(pull: Pull) -> str:
    if pull.stroke is not None:
        return "Draw across all of the place where they touch. Esc: back"
    influence = pull.influence
    if not pull.pose.cuts or influence is None:
        return "Draw a line where two things touch. Shift+click: remove it. K, Esc: done"
    if not influence.is_cut:
        return "The line cuts nothing that the handles reach. Shift+click: remove it. K, Esc: done"
    count = group_digits(len(influence.rows))
    return f"{count} splats can move. Also draw from other sides. Shift+click: remove. K, Esc: done"


def draw_marks(pull: Pull, pointer: PointerContext) -> None:
    """Draw the radius, the handles, the pins, and the axis of the drag."""
    ui = pointer.ui
    if pull.drag is not None:
        handle = pull.pose.handles[pull.drag.index]
        _draw_line(pull.drag, pointer)
        if not pull.whole:
            has_moved = pull.drag.start != handle.point
            _draw_radius(handle.point, pull.radius, pull.drag.surface, has_moved, pointer)
    elif pull.hovered is not None and not pull.whole and not pull.is_cutting:
        surface = pointer.known_surface(pointer.shown.camera, pointer.size, request=True)
        _draw_radius(pull.hovered, pull.radius, surface, False, pointer)
    for cut in pull.pose.cuts:
        _outline(_places(cut.points, pointer), pointer.ui, _CUT_COLOR, is_closed=False)
    if pull.stroke is not None:
        _outline(_places(pull.stroke.shown, pointer), pointer.ui, _CUT_COLOR, is_closed=False)
    canvas = imgui.get_background_draw_list()
    for x, y in _places(pull.pose.pins, pointer):
        for size, color in ((_PIN_PX + 1.5, _OUTLINE_COLOR), (_PIN_PX, _PIN_COLOR)):
            half = size * ui.scale
            canvas.add_rect_filled((x - half, y - half), (x + half, y + half), u32(color))
    picked = pull.picked_handle
    if picked is not None:
        for x, y in _places([picked.target], pointer):
            canvas.add_circle_filled((x, y), (_HANDLE_PX + 3.0) * ui.scale, u32(_PICKED_COLOR))
    for x, y in _places([handle.target for handle in pull.pose.handles], pointer):
        canvas.add_circle_filled((x, y), (_HANDLE_PX + 1.5) * ui.scale, u32(_OUTLINE_COLOR))
        canvas.add_circle_filled((x, y), _HANDLE_PX * ui.scale, u32(_HANDLE_COLOR))


def _places(points: Sequence[Vec3], pointer: PointerContext) -> list[tuple[float, float]]:
    """Return the window positions of the points in front of the camera."""
    if not points:
        return []
    density = imgui.get_io().display_framebuffer_scale
    pixels, depths = project(np.array(points), pointer.camera(pointer.shown.camera))
    shown = pixels[depths > pointer.engine.near]
    return [((x + pointer.left) / density.x, y / density.y) for x, y in shown.tolist()]


def _draw_radius(
    center: Vec3, radius: float, surface: ViewSurface | None, has_moved: bool, pointer: PointerContext
) -> None:
    """Draw the end of the influence on the surface; as a circle while the surface is not known.

    Args:
        center: point of a handle
        radius: radius of its influence, world units
        surface: the visible surface
        has_moved: the surface near the center has moved away
        pointer: the view
    """
    if surface is None or pointer.is_beside:
        _draw_circle(center, radius, pointer)
        return
    _outline(_places(surface_ring(center, radius, surface, has_moved), pointer), pointer.ui)


def _draw_circle(center: Vec3, radius: float, pointer: PointerContext) -> None:
    """Draw the outline of a ball around a point of the surface."""
    turn = axes(pointer.shown.camera)
    angles = np.linspace(0.0, 2.0 * math.pi, _CIRCLE_POINTS, endpoint=False)
    right = np.array(turn.right)
    up = np.array(turn.up)
    points = np.array(center) + radius * (np.cos(angles)[:, None] * right + np.sin(angles)[:, None] * up)
    places = _places([vec3(point) for point in points], pointer)
    _outline(places, pointer.ui)


def _outline(
    places: list[tuple[float, float]], ui: UiContext, color: Rgba = PALETTE.handle, is_closed: bool = True
) -> None:
    """Draw a line with a dark outline. Cuts are wider than rings."""
    if len(places) < 2:
        return
    canvas = imgui.get_background_draw_list()
    flags = imgui.ImDrawFlags_.closed.value if is_closed else imgui.ImDrawFlags_.none.value
    width = _RING_PX if is_closed else _CUT_PX
    corners = [imgui.ImVec2(x, y) for x, y in places]
    for rgba, thickness in ((_OUTLINE_COLOR, width + 1.75), (color, width)):
        canvas.add_polyline([*corners], u32(rgba), thickness * ui.scale, flags)


def _draw_line(drag: PullDrag, pointer: PointerContext) -> None:
    """Draw the line that the handle stays on."""
    axis = direction(drag)
    if axis is None:
        return
    length = pointer.facts.bounds.radius
    start = np.array(drag.start)
    ends = [vec3(start + sign * length * np.array(axis)) for sign in (-1.0, 1.0)]
    places = _places(ends, pointer)
    if len(places) == 2:
        first, last = places
        color = (*_AXIS_COLORS[drag.axis], 0.9) if drag.axis else (*PALETTE.handle[:3], 0.9)
        imgui.get_background_draw_list().add_line(first, last, u32(color), 1.5 * pointer.ui.scale)
