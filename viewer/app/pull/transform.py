"""Turning, scaling and moving the picked handle of a pull: by keys as a placed selection, or by its gizmo."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui
from imgui_bundle.imguizmo import im_guizmo
from scipy.spatial.transform import Rotation

from progdf.camera import Camera
from progdf.pull.course import MAX_HANDLE_SCALE
from viewer.app import handles, typed
from viewer.camera.decal_warp import Floats, vec3
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.state.transient import Gizmo, Pull, PullHandle, PullPose, PullTransform, Transform, TypedTransform
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext

_TURN_PART_DEG = 90.0  # largest part of a typed angle that is turned at once
_SAME_MATRIX = 1e-6  # difference of matrix elements within a frame that counts as none
_MAX_TURN = 2.0 * math.pi - 1e-3  # longest turn of a handle, radians


def undo(pull: Pull) -> Pull:
    """Return to the pose before the last change."""
    return replace(pull, pose=pull.past[-1], past=pull.past[:-1], future=(*pull.future, pull.pose))


def redo(pull: Pull) -> Pull:
    """Return to the pose that was undone last."""
    return replace(pull, pose=pull.future[-1], future=pull.future[:-1], past=(*pull.past, pull.pose))


def with_pose(pull: Pull, pose: PullPose, before: PullPose | None = None) -> Pull:
    """Return the pull with a new pose; undo returns to `before`, by default the current one."""
    before = pull.pose if before is None else before
    if pose == before:
        return replace(pull, pose=pose)
    return replace(pull, pose=pose, past=(*pull.past, before), future=())


def take_keys(pull: Pull, pointer: PointerContext, keys: Keys) -> tuple[Pull, Keys]:
    """Handle the keys that move, turn and scale the picked handle, as those of a placed selection."""
    handle = pull.picked_handle
    running = pull.transform
    if handle is None or (running is not None and running.typed is None):
        return pull, keys
    before = None if running is None else running.typed
    gizmo, keys = typed.take_keys(gizmo_of(handle, before), keys, pointer)
    now = gizmo.typed
    if now == before:
        return pull, keys
    if now is not None and now.does == "scale":
        now = replace(now, axes="")  # a handle scales evenly
    starts_anew = before is None or now is None or now.start is not before.start
    if now is None and np.array_equal(gizmo.matrix, before.start if before is not None else np.eye(4)):
        return _cancel_transform(pull), keys
    if running is not None and starts_anew:
        pull = _end_transform(pull, running)
    if now is None:
        return pull, keys
    start = running.before if running is not None and not starts_anew else pull.pose
    return replace(pull, transform=PullTransform(start, now)), keys


def gizmo_of(handle: PullHandle, by_keys: TypedTransform | None = None) -> Gizmo:
    """Return the handles of a selection that has moved like the surface around a handle of a pull."""
    matrix = np.eye(4)
    turn = Rotation.from_rotvec(handle.turn or (0.0, 0.0, 0.0))
    matrix[:3, :3] = handle.scale * turn.as_matrix()
    matrix[:3, 3] = handle.pull
    return Gizmo("transform", handle.point, matrix, typed=by_keys)


def with_matrix(handle: PullHandle, matrix: Floats, does: Transform) -> PullHandle:
    """Return a handle that is moved, turned or scaled as its surface by a matrix about its point.

    A factor that differs between the axes counts where it has changed most. The turn goes on from the last
    one, so that it can be longer than 180°.

    Args:
        handle: the handle before
        matrix: an invertible matrix, see `Gizmo.matrix`. [4,4]
        does: the other two properties stay
    """
    if does == "move":
        return replace(handle, pull=vec3(matrix[:3, 3]))
    linear = matrix[:3, :3]
    before = np.array(handle.turn or (0.0, 0.0, 0.0))
    if does == "scale":
        factors = np.linalg.norm(linear, axis=0).clip(1.0 / MAX_HANDLE_SCALE, MAX_HANDLE_SCALE)
        scale = float(factors[np.abs(np.log(factors / handle.scale)).argmax()])
        return replace(handle, turn=vec3(before), scale=scale)
    turn = Rotation.from_matrix(linear / np.linalg.norm(linear, axis=0)).as_rotvec()
    angle = float(np.linalg.norm(turn))
    if angle > 0.0:
        longer = turn * (1.0 - 2.0 * math.pi / angle)
        is_nearer = np.linalg.norm(longer - before) < np.linalg.norm(turn - before)
        if is_nearer and np.linalg.norm(longer) < _MAX_TURN:
            turn = longer
    return replace(handle, turn=vec3(turn))


def transform_picked(
    pull: Pull, pointer: PointerContext, surfaces: DecalSurfaces, pressed: Sequence[str], on_dot: bool
) -> tuple[Pull, bool]:
    """Move, turn and scale the picked handle by keys or by its gizmo, and draw the gizmo.

    Args:
        pull: the tool with its handles
        pointer: the view
        surfaces: cache of surfaces, for transforms by keys
        pressed: chords pressed in this frame
        on_dot: the mouse is over the dot of a handle, which takes it

    Returns:
        The pull, and True if the gizmo or a transform by keys takes the mouse.
    """
    handle = pull.picked_handle
    if handle is None or pull.drag is not None:
        return replace(pull, picked=None if handle is None else pull.picked), False
    running = pull.transform
    by_keys = None if running is None else running.typed
    drags = running is not None and by_keys is None
    gizmo = replace(gizmo_of(handle, by_keys), using=drags, grip=pull.grip)
    followed = typed.follow(gizmo, pointer, surfaces)
    if drags and "Escape" in pressed:
        im_guizmo.enable(False)  # ends the drag
        return _cancel_transform(pull), True
    moved, using = handles.drag_gizmo(followed, pointer, usable=running is not None or not on_dot)
    if by_keys is not None and running is not None:
        camera = pointer.camera(pointer.shown.camera)
        pull = _with_handle(pull, _typed_handle(pull, running, gizmo, followed, camera))
        pull = replace(pull, transform=replace(running, typed=followed.typed))
        if not imgui.get_io().want_capture_mouse:
            if imgui.is_mouse_clicked(0):
                return _end_transform(pull, running), True
            if imgui.is_mouse_clicked(1):
                return _cancel_transform(pull), True
        return pull, not by_keys.text
    if using or running is not None:
        if running is None:
            running = PullTransform(pull.pose)
        is_still = np.allclose(moved.matrix[:3, :3], gizmo.matrix[:3, :3], rtol=0.0, atol=_SAME_MATRIX)
        changed = handle
        if moved.grip == "move" or not is_still:
            changed = with_matrix(handle, moved.matrix, moved.grip)
        pull = replace(_with_handle(pull, changed), transform=running, grip=moved.grip)
        return (pull if using else _end_transform(pull, running)), True
    return replace(pull, grip=moved.grip), not on_dot and bool(im_guizmo.is_over())


def _typed_handle(
    pull: Pull, running: PullTransform, before: Gizmo, after: Gizmo, camera: Camera
) -> PullHandle:
    """Return the picked handle after a transform by keys.

    A typed angle is turned in parts, so that it may be longer than 180°.
    """
    by_keys = after.typed
    handle = pull.pose.handles[pull.picked or 0]
    if by_keys is None or np.array_equal(before.matrix, after.matrix):
        return handle
    if by_keys.does != "rotate" or not by_keys.text:
        return with_matrix(handle, after.matrix, by_keys.does)
    turned = running.before.handles[pull.picked or 0]
    degrees = typed.numbers(by_keys.text, 0.0)[0]
    count = max(1, math.ceil(abs(degrees) / _TURN_PART_DEG))
    for part in range(1, count + 1):
        matrix = typed.apply(before, by_keys, [degrees * part / count], camera)
        turned = with_matrix(turned, matrix, "rotate")
    return turned


def _with_handle(pull: Pull, handle: PullHandle) -> Pull:
    """Return the pull with the picked handle replaced."""
    at = pull.picked or 0
    handles = (*pull.pose.handles[:at], handle, *pull.pose.handles[at + 1 :])
    return replace(pull, pose=replace(pull.pose, handles=handles))


def _end_transform(pull: Pull, running: PullTransform) -> Pull:
    """Take the transform in progress; undo returns to the pose before it."""
    return with_pose(replace(pull, transform=None, hovered_for=None), pull.pose, running.before)


def _cancel_transform(pull: Pull) -> Pull:
    """Undo the transform in progress."""
    if pull.transform is None:
        return pull
    return replace(pull, pose=pull.transform.before, transform=None, hovered_for=None)
