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

from viewer.camera.decal_warp import project, vec3
from viewer.camera.view_camera import Vec3
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.state.transient import Pull, PullAxis, PullDrag, PullHandle
from viewer.state.workspace import Workspace
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext

from . import cutting, transform
from .aim import camera_of, is_over, moves_camera, normal_at, pick, unproject
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
    return not (view.has_tool or picks)


def take_keys(work: Workspace, pointer: PointerContext, keys: Keys) -> tuple[Workspace, Keys]:
    """Handle the keys of the Pull tool: transforms, axes, cuts, undo and redo; return the unused keys."""
    pull = work.transient.gizmo
    if not isinstance(pull, Pull) or imgui.get_io().want_text_input:
        return work, keys
    if pull.drag is None and pull.stroke is None:
        pull, keys = transform.take_keys(pull, pointer, keys)
    unused = []
    for press in keys.pressed:
        changed: Pull | None = None
        if press.chord in ("X", "Y", "Z") and pull.drag is not None:
            axis: dict[str, PullAxis] = {"X": "x", "Y": "y", "Z": "z"}
            chosen = axis[press.chord]
            drag = replace(pull.drag, axis="" if pull.drag.axis == chosen else chosen)
            changed = replace(pull, drag=drag)
        elif press.chord == "K" and not pull.is_held:
            changed = replace(pull, is_cutting=not pull.is_cutting)
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
    if pull.is_cutting and pull.transform is None:
        moved, is_taken = cutting.draw_stroke(pull, pointer, is_free(work), pressed)
    else:
        on_dot = _near(pull, pointer)[0] is not None
        moved, is_taken = transform.transform_picked(pull, pointer, surfaces, pressed, on_dot)
        is_idle = moved.transform is None and not is_taken
        moved = move_pull(moved, pointer, is_free(work) and is_idle, pressed)
        is_taken = is_taken or pull.drag is not None or (is_free(work) and takes_mouse(moved, pointer))
    if work.view.has_tool:  # its options take the place of the bar
        return moved, "", is_taken
    moved, request = draw_bar(moved, pointer)
    return moved, request, is_taken


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
    over = free and is_over(pointer) and not moves_camera()
    pull = _hover(pull, pointer) if over else replace(pull, hovered=None, hovered_for=None)
    if not over or (pull.hovered is None and _near(pull, pointer)[0] is None):
        return pull
    pull = _resize(pull, pointer)
    return _press(pull, pointer) if imgui.is_mouse_clicked(0) else pull


def takes_mouse(pull: Pull, pointer: PointerContext) -> bool:
    """Return True if the tool takes the mouse: during a drag, and over the surface or a handle."""
    if pull.drag is not None:
        return True
    return pull.hovered is not None and is_over(pointer) and not moves_camera()


def _hover(pull: Pull, pointer: PointerContext) -> Pull:
    """Return the pull with the point of the surface under the pointer."""
    key = (pointer.cursor, pointer.shown.camera, pointer.size, pointer.scene_key)
    if key == pull.hovered_for:
        return pull
    found = pick(pull.edit, pointer)
    return replace(pull, hovered=None if found is None else found.point, hovered_for=key)


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
            pixels, depths = project(np.array(points), camera_of(pointer))
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
    found = pick(pull.edit, pointer)
    normal = (0.0, 0.0, 1.0) if found is None else normal_at(pointer, found.row)
    is_new = handle is None
    if handle is None:
        if found is None:
            return pull
        handle = len(pose.handles)
        pose = replace(pose, handles=(*pose.handles, PullHandle(found.rest, found.offset)))
    start = pose.handles[handle].target
    pixel = project(np.array(start), camera_of(pointer))[0]
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
    camera = camera_of(pointer)
    start = np.array(drag.start)
    pixel = (pointer.cursor[0] - drag.grab[0], pointer.cursor[1] - drag.grab[1])
    depth = float(project(start, camera)[1])
    aimed = unproject(camera, pixel, depth)
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
