"""Pull tool: handles on the surface that the mouse drags, held points, and their drawing.

The tool changes only its handles. `viewer.app.parts.pulling` deforms the scene in other threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from imgui_bundle import imgui

from progdf.camera import Camera
from progdf.quaternions import normalize_quats, rotation_matrices
from viewer.camera.decal_warp import Floats, project, vec3
from viewer.camera.view_camera import Vec3
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.render.picking import SURFACE_OPACITY, seen_at
from viewer.state.transient import Pull, PullAxis, PullDrag, PullHandle
from viewer.state.workspace import Workspace
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext

from . import transform
from .marks import direction, draw_bar
from .transform import redo, undo, with_pose

_Item = TypeVar("_Item")

_STEP = 1.1  # factor of the radius per notch of the wheel
_REACH_PX = 10.0  # at 1×: the mouse takes a handle within this distance
_CLICK_PX = 3.0  # at 1×: a press that moves no further is a click
_MAX_PULL = 20.0  # largest displacement, in radii of the scene
_MIN_RADIUS = 1e-3  # smallest radius of the influence, in radii of the scene
_MAX_RADIUS = 4.0  # largest radius, in radii of the scene


def is_free(work: Workspace) -> bool:
    """Return True if no other tool uses the left button."""
    view = work.view
    picks = work.form_open and work.form.picks
    return not (view.select.tool or view.brush.active or view.color_brush.tool or picks)


def take_keys(work: Workspace, pointer: PointerContext, keys: Keys) -> tuple[Workspace, Keys]:
    """Handle the keys of the Pull tool: transforms, X, Y and Z, undo and redo; return the unused keys."""
    pull = work.transient.gizmo
    if not isinstance(pull, Pull) or imgui.get_io().want_text_input:
        return work, keys
    if pull.drag is None:
        pull, keys = transform.take_keys(pull, pointer, keys)
    unused = []
    for press in keys.pressed:
        changed: Pull | None = None
        if press.chord in ("X", "Y", "Z") and pull.drag is not None:
            axis: dict[str, PullAxis] = {"X": "x", "Y": "y", "Z": "z"}
            chosen = axis[press.chord]
            drag = replace(pull.drag, axis="" if pull.drag.axis == chosen else chosen)
            changed = replace(pull, drag=drag)
        elif press.chord == "Ctrl+Z" and not pull.is_held and pull.past:
            changed = undo(pull)
        elif press.chord in ("Ctrl+Shift+Z", "Ctrl+Y") and not pull.is_held and pull.future:
            changed = redo(pull)
        if changed is None:
            unused.append(press)
        else:
            pull = changed
    transient = replace(work.transient, gizmo=pull)
    return replace(work, transient=transient), replace(keys, pressed=tuple(unused))


def update(
    pull: Pull,
    work: Workspace,
    pointer: PointerContext,
    surfaces: DecalSurfaces,
    pressed: Sequence[str],
) -> tuple[Pull, str, bool]:
    """Handle this frame's mouse input and draw the gizmo and the buttons.

    Args:
        pull: the tool with its handles
        work: the workspace
        pointer: the view
        surfaces: cache of surfaces, for transforms by keys
        pressed: chords pressed in this frame

    Returns:
        The changed tool, its request ("" for none), and True if it takes the mouse.
    """
    on_dot = _near(pull, pointer)[0] is not None
    moved, is_taken = transform.transform_picked(pull, pointer, surfaces, pressed, on_dot)
    is_idle = moved.transform is None and not is_taken
    moved = move_pull(moved, pointer, is_free(work) and is_idle, pressed)
    below = bool(work.view.selection.count or work.view.selection.hidden or work.view.painted)
    moved, request = draw_bar(moved, pointer, below or not is_free(work))
    takes = is_taken or pull.drag is not None or (is_free(work) and takes_mouse(moved, pointer))
    return moved, request, takes


def move_pull(pull: Pull, pointer: PointerContext, free: bool, pressed: Sequence[str]) -> Pull:
    """Return the pull after this frame's mouse input.

    Args:
        pull: the tool with its handles
        pointer: the view
        free: no other tool uses the left button
        pressed: chords pressed in this frame
    """
    if pull.drag is not None:
        return _drag(pull, pull.drag, pointer, pressed)
    over = free and _is_over(pointer) and not _moves_camera()
    pull = _hover(pull, pointer) if over else replace(pull, hovered=None, hovered_for=None)
    if not over or (pull.hovered is None and _near(pull, pointer)[0] is None):
        return pull
    pull = _resize(pull, pointer)
    return _press(pull, pointer) if imgui.is_mouse_clicked(0) else pull


def takes_mouse(pull: Pull, pointer: PointerContext) -> bool:
    """Return True if the tool takes the mouse: during a drag, and over the surface or a handle."""
    if pull.drag is not None:
        return True
    return pull.hovered is not None and _is_over(pointer) and not _moves_camera()


def _is_over(pointer: PointerContext) -> bool:
    """Return True if the mouse is over the picture and no part of the interface takes it."""
    io = imgui.get_io()
    area = pointer.area
    inside = 0.0 <= io.mouse_pos.x < area.width and 0.0 <= io.mouse_pos.y < area.height
    return inside and not io.want_capture_mouse


def _moves_camera() -> bool:
    return any(imgui.is_mouse_down(button) for button in (1, 2))


def _camera(pointer: PointerContext) -> Camera:
    return pointer.camera(pointer.shown.camera)


def _hover(pull: Pull, pointer: PointerContext) -> Pull:
    """Return the pull with the point of the surface under the pointer."""
    key = (pointer.cursor, pointer.shown.camera, pointer.size, pointer.scene_key)
    if key == pull.hovered_for:
        return pull
    found = _pick(pull, pointer)
    return replace(pull, hovered=None if found is None else found[0], hovered_for=key)


def _pick(pull: Pull, pointer: PointerContext) -> tuple[Vec3, Vec3, int] | None:
    """Return the point of the surface under the pointer, its displacement by the pull, and its Gaussian.

    The Gaussian is one of the scene's own, as paint has no place of its own. None on the background.
    """
    scene = pointer.scene
    camera = _camera(pointer)
    seen = seen_at(scene, camera, *pointer.cursor, pointer.engine.near)
    if seen is None:
        return None
    own = seen.rows < pointer.facts.count - pointer.facts.added
    if not own.any():
        return None
    reached = np.flatnonzero(own & (np.cumsum(seen.shares) >= SURFACE_OPACITY))
    at = int(reached[0]) if len(reached) else int(np.argmax(np.where(own, seen.shares, -1.0)))
    row = int(seen.rows[at])
    point = _unproject(camera, pointer.cursor, float(seen.depths[at]))
    center = scene.means[row].double().numpy()
    reach = 2.0 * float(scene.log_scales[row].double().exp().max())
    away = float(np.linalg.norm(point - center))
    if away > reach:  # the pixel only touches the edge of the Gaussian
        point = center + (point - center) * (reach / away)
    if not np.isfinite(point).all():
        return None
    return vec3(point), vec3(_offset(pull, row)), row


def _offset(pull: Pull, row: int) -> Floats:
    """Return the displacement of a Gaussian by the pull on screen. [3]"""
    if pull.edit is None:
        return np.zeros(3)
    members = pull.edit.region.members.numpy()
    at = int(np.searchsorted(members, row))
    if at == len(members) or members[at] != row:
        return np.zeros(3)
    offset: Floats = pull.edit.field.attributes["means"].end_offset[at].double().numpy()
    return offset


def _unproject(camera: Camera, pixel: tuple[float, float], depth: float) -> Floats:
    """Return the point at a pixel and a depth, world units. [3]"""
    K = camera.K.double().numpy()
    viewmat = camera.viewmat.double().numpy()
    x = (pixel[0] - K[0, 2]) / K[0, 0] * depth
    y = (pixel[1] - K[1, 2]) / K[1, 1] * depth
    point: Floats = viewmat[:3, :3].T @ (np.array([x, y, depth]) - viewmat[:3, 3])
    return point


def _normal(pointer: PointerContext, row: int) -> Vec3:
    """Return the direction of a Gaussian's shortest axis, towards the camera."""
    scene = pointer.scene
    rotation = rotation_matrices(normalize_quats(scene.quats[row : row + 1].double()))[0].numpy()
    normal = rotation[:, int(scene.log_scales[row].argmin())]
    eye = _camera(pointer).position.double().numpy()
    towards = float(normal @ (eye - scene.means[row].double().numpy()))
    return vec3(normal if towards >= 0.0 else -normal)


def _resize(pull: Pull, pointer: PointerContext) -> Pull:
    """Return the pull with the radius after this frame's wheel."""
    notches = imgui.get_io().mouse_wheel
    if not notches or pull.whole:
        return pull
    size = pointer.facts.bounds.radius
    radius = min(max(pull.radius * _STEP**notches, _MIN_RADIUS * size), _MAX_RADIUS * size)
    return replace(pull, radius=radius)


def _near(pull: Pull, pointer: PointerContext) -> tuple[int | None, int | None]:
    """Return the handle and the pin under the pointer, by their indices."""
    reach = _REACH_PX * pointer.ui.scale * imgui.get_io().display_framebuffer_scale.x
    found = list[int | None]()
    for points in ([handle.target for handle in pull.pose.handles], list(pull.pose.pins)):
        nearest = None
        if points:
            pixels, depths = project(np.array(points), _camera(pointer))
            distance = np.linalg.norm(pixels - np.array(pointer.cursor), axis=1)
            distance = np.where(depths > pointer.engine.near, distance, math.inf)
            if distance.min() <= reach:
                nearest = int(distance.argmin())
        found.append(nearest)
    return found[0], found[1]


def _press(pull: Pull, pointer: PointerContext) -> Pull:
    """Return the pull after a press: a handle is grabbed or created; with Shift, a handle or pin is freed."""
    handle, pin = _near(pull, pointer)
    pose = pull.pose
    if imgui.get_io().key_shift:
        if pin is not None:
            return with_pose(pull, replace(pose, pins=_without(pose.pins, pin)))
        if handle is not None:
            freed = replace(pose, handles=_without(pose.handles, handle))
            return with_pose(replace(pull, picked=None), freed)
        return pull
    found = _pick(pull, pointer)
    normal = (0.0, 0.0, 1.0) if found is None else _normal(pointer, found[2])
    is_new = handle is None
    if handle is None:
        if found is None:
            return pull
        point, offset, _ = found
        rest = (point[0] - offset[0], point[1] - offset[1], point[2] - offset[2])
        handle = len(pose.handles)
        pose = replace(pose, handles=(*pose.handles, PullHandle(rest, offset)))
    start = pose.handles[handle].target
    pixel = project(np.array(start), _camera(pointer))[0]
    grab = (pointer.cursor[0] - float(pixel[0]), pointer.cursor[1] - float(pixel[1]))
    surface = pointer.known_surface(pointer.shown.camera, pointer.size)
    drag = PullDrag(handle, start, grab, normal, pull.pose, surface, is_new=is_new)
    return replace(pull, pose=pose, drag=drag)


def _without(items: tuple[_Item, ...], index: int) -> tuple[_Item, ...]:
    return (*items[:index], *items[index + 1 :])


def _drag(pull: Pull, drag: PullDrag, pointer: PointerContext, pressed: Sequence[str]) -> Pull:
    """Return the pull after this frame of a drag, which Escape and the right button cancel."""
    if "Escape" in pressed or imgui.is_mouse_clicked(1):
        return replace(pull, pose=drag.before, drag=None)
    if not drag.moved:
        travel = imgui.get_mouse_drag_delta(0, _CLICK_PX * pointer.ui.scale)
        drag = replace(drag, moved=bool(travel.x or travel.y))
    pull = _resize(replace(pull, drag=drag), pointer)
    if drag.moved:
        handle = pull.pose.handles[drag.index]
        target = _target(drag, pointer)
        offset = np.array(target) - np.array(handle.point)
        length = float(np.linalg.norm(offset))
        limit = _MAX_PULL * pointer.facts.bounds.radius
        if length > limit:
            offset *= limit / length
        if np.isfinite(offset).all():
            moved = replace(handle, pull=vec3(offset))
            handles = (*pull.pose.handles[: drag.index], moved, *pull.pose.handles[drag.index + 1 :])
            pull = replace(pull, pose=replace(pull.pose, handles=handles))
    if imgui.is_mouse_down(0):
        return pull
    return _release(pull, drag)


def _release(pull: Pull, drag: PullDrag) -> Pull:
    """Return the pull after the button went up. The handle is picked then.

    A click on the surface pins it: where it has moved by a handle, else by a pin.
    """
    pose = pull.pose
    handle = pose.handles[drag.index]
    picked: int | None = drag.index
    if not drag.moved and not (drag.is_new and any(handle.pull)):
        pose = drag.before
        if drag.is_new:
            pose = replace(pose, pins=(*pose.pins, handle.point))
            picked = pull.picked
    return with_pose(replace(pull, drag=None, picked=picked, hovered_for=None), pose, drag.before)


def _target(drag: PullDrag, pointer: PointerContext) -> Vec3:
    """Return the position of the dragged handle for the pointer."""
    camera = _camera(pointer)
    start = np.array(drag.start)
    pixel = (pointer.cursor[0] - drag.grab[0], pointer.cursor[1] - drag.grab[1])
    depth = float(project(start, camera)[1])
    aimed = _unproject(camera, pixel, depth)
    axis = direction(drag)
    if axis is None:
        return vec3(aimed)
    # the point on the line through the start that is nearest to the pointer's ray
    line = np.array(axis)
    ray = aimed - camera.position.double().numpy()
    ray /= max(float(np.linalg.norm(ray)), 1e-12)
    across = line - float(line @ ray) * ray
    slope = float(across @ across)
    if slope < 1e-4:
        return drag.start
    return vec3(start + line * (float(across @ (aimed - start)) / slope))
