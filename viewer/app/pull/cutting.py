"""Cuts of the Pull tool: lines that the mouse draws where things touch, so that only one of them moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui

from viewer.camera.decal_warp import project, vec3
from viewer.camera.view_camera import Vec3
from viewer.state.transient import CutStroke, Pull, PullCut
from viewer.ui.pointer import PointerContext

from .aim import camera_of, is_over, moves_camera, pick, unproject
from .transform import with_pose

_STEP_PX = 4.0  # at 1×: smallest distance between corners of a line
_REACH_PX = 12.0  # at 1×: Shift+click takes a line with a corner within this distance


def draw_stroke(pull: Pull, pointer: PointerContext, free: bool, pressed: Sequence[str]) -> tuple[Pull, bool]:
    """Draw or remove a cut by this frame's mouse input. Escape ends the line, and then the drawing.

    Args:
        pull: the tool
        pointer: the view
        free: no other tool uses the left button
        pressed: chords pressed in this frame

    Returns:
        The changed tool, and True if it takes the mouse.
    """
    stroke = pull.stroke
    if stroke is not None:
        if "Escape" in pressed or imgui.is_mouse_clicked(1):
            return replace(pull, stroke=None), True
        stroke = _extend(stroke, pull, pointer)
        if imgui.is_mouse_down(0):
            return replace(pull, stroke=stroke), True
        return _end(replace(pull, stroke=None), stroke), True
    if "Escape" in pressed:
        return replace(pull, is_cutting=False), False
    if not free or not is_over(pointer) or moves_camera() or not imgui.is_mouse_clicked(0):
        return pull, False
    if imgui.get_io().key_shift:
        return _remove_near(pull, pointer), True
    return replace(pull, stroke=_begin(pull, pointer)), True


def clear(pull: Pull) -> Pull:
    """Return the pull without cuts."""
    return with_pose(pull, replace(pull.pose, cuts=()))


def _begin(pull: Pull, pointer: PointerContext) -> CutStroke:
    camera = camera_of(pointer)
    center = np.array(pointer.facts.bounds.center)
    depth = max(float(project(center, camera)[1]), 2.0 * pointer.engine.near)
    eye = vec3(camera.position.double().numpy())
    stroke = CutStroke(PullCut(eye, ()), (), (-math.inf, -math.inf), depth)
    return _extend(stroke, pull, pointer)


def _extend(stroke: CutStroke, pull: Pull, pointer: PointerContext) -> CutStroke:
    """Return the line with a corner under the pointer, if it has moved far enough.

    A corner on the background takes the depth and the displacement of the last one.
    """
    step = _STEP_PX * pointer.ui.scale * imgui.get_io().display_framebuffer_scale.x
    if math.dist(stroke.pixel, pointer.cursor) < step:
        return stroke
    camera = camera_of(pointer)
    found = pick(pull.edit, pointer)
    if found is None:
        point = vec3(unproject(camera, pointer.cursor, stroke.depth))
    else:
        point = found.point
        depth = float(project(np.array(point), camera)[1])
        if not stroke.is_on_surface:  # the line began on the background
            stroke = replace(stroke, cut=replace(stroke.cut, points=_rest_points(stroke.shown, found.offset)))
        stroke = replace(stroke, depth=depth, offset=found.offset, is_on_surface=True)
    cut = replace(stroke.cut, points=(*stroke.cut.points, *_rest_points((point,), stroke.offset)))
    return replace(stroke, cut=cut, shown=(*stroke.shown, point), pixel=pointer.cursor)


def _rest_points(points: tuple[Vec3, ...], offset: Vec3) -> tuple[Vec3, ...]:
    """Return points without their displacement."""
    dx, dy, dz = offset
    return tuple((x - dx, y - dy, z - dz) for x, y, z in points)


def _end(pull: Pull, stroke: CutStroke) -> Pull:
    """Return the pull with a finished line, unless it is a click or lies on the background."""
    if len(stroke.cut.points) < 2 or not stroke.is_on_surface:
        return pull
    return with_pose(pull, replace(pull.pose, cuts=(*pull.pose.cuts, stroke.cut)))


def _remove_near(pull: Pull, pointer: PointerContext) -> Pull:
    """Return the pull without the cut under the pointer."""
    reach = _REACH_PX * pointer.ui.scale * imgui.get_io().display_framebuffer_scale.x
    distances = [_distance(cut.points, pointer) for cut in pull.pose.cuts]
    if not distances or min(distances) > reach:
        return pull
    nearest = distances.index(min(distances))
    left = (*pull.pose.cuts[:nearest], *pull.pose.cuts[nearest + 1 :])
    return with_pose(pull, replace(pull.pose, cuts=left))


def _distance(points: tuple[Vec3, ...], pointer: PointerContext) -> float:
    """Return the distance of the pointer from the nearest corner of a line, pixels."""
    pixels, depths = project(np.array(points), camera_of(pointer))
    distance = np.linalg.norm(pixels - np.array(pointer.cursor), axis=1)
    return float(np.where(depths > pointer.engine.near, distance, math.inf).min())
