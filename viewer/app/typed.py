"""Transforms while the handles are shown: by keys (G, R or S, axes, a number or the mouse), and by fields.

The pivot is the fixed point of rotations, scales and mirrors. Snapping puts the base of the part, its lowest
points, on the ground or on the surface under the pointer, where its up axis is aligned with the normal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from imgui_bundle import imgui
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from progdf.camera import Camera
from progdf.similarity import MIN_STRETCH, affine_motion
from progdf.surface.footprint import fit_footprint
from progdf.system.equality import equal_fields
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.render.picking import surface_point
from viewer.state.transient import Gizmo, Pivot, PlacedPart, Transform, TypedTransform
from viewer.ui.keys import Keys, Press
from viewer.ui.pointer import PointerContext

ANGLE_STEP_DEG = 15.0
"""Steps of a rotation while Ctrl is held."""
SCALE_STEP = 0.1  # steps of a factor while Ctrl is held
_KINDS: dict[str, Transform] = {"G": "move", "R": "rotate", "S": "scale"}
_NAMES = {"move": "Move", "rotate": "Rotate", "scale": "Scale"}
_AXES = "XYZ"
_DIGITS = {**{str(i): str(i) for i in range(10)}, **{f"Num{i}": str(i) for i in range(10)}}
_POINTS = (".", ",", "Num.")
_MAX_DIGITS = 16  # longest typed number
_SNAP_PX = 12.0  # radius of the surface whose normal a part is aligned with, at 1×
_BASE_SHARE = 0.005  # share of the Gaussians' centers below the base; strays lie lower
_SAME_SHAPE = 1e-9  # relative difference of matrices that counts as none
_MIN_SINE = 0.05  # sine of the angle between the line of sight and an axis or plane below which it is edge-on

Floats = NDArray[np.float64]


def take_keys(gizmo: Gizmo, keys: Keys, pointer: PointerContext) -> tuple[Gizmo, Keys]:
    """Handle the keys of transforms; return the handles and the unused keys."""
    unused = []
    for press in keys.pressed:
        changed = _press(gizmo, press)
        if changed is None:
            unused.append(press)
            continue
        if gizmo.pivot == "pointer" and press.chord in _KINDS and not press.again:
            changed = _pivot_under(changed, pointer)
        gizmo = changed
    fly = keys.fly - {"S"} if gizmo.typed is None else frozenset()
    return gizmo, replace(keys, pressed=tuple(unused), fly=fly)


def _press(gizmo: Gizmo, press: Press) -> Gizmo | None:
    """Return the handles after a key; None if it does something else."""
    typed = gizmo.typed
    chord = press.chord
    if chord in _KINDS:
        if press.again:
            return gizmo
        start = gizmo.matrix
        if typed is not None and not typed.text:
            start = typed.start  # only the kind changes
        return replace(gizmo, matrix=start, typed=TypedTransform(_KINDS[chord], start))
    if typed is None:
        return None
    if chord == "Enter":
        return replace(gizmo, typed=None)
    if chord == "Escape":
        return undo(gizmo)
    key = chord.removeprefix("Shift+")
    if key in _AXES and len(key) == 1:
        axes = key
        if chord.startswith("Shift+"):
            axes = _AXES.replace(key, "")
            if typed.does == "rotate":
                axes = key  # a plane is rotated about its normal
        if axes == typed.axes and not press.again:
            axes = ""
        return replace(gizmo, typed=replace(typed, axes=axes))
    text = _edit(typed, chord)
    return None if text is None else replace(gizmo, typed=replace(typed, text=text))


def _edit(typed: TypedTransform, chord: str) -> str | None:
    """Return the typed text after a key; None if the key does not belong to a number."""
    *before, number = typed.text.split("\t")
    if chord in _DIGITS:
        number += _DIGITS[chord]
    elif chord in _POINTS:
        number += "" if "." in number else "."
    elif chord == "-":
        number = number[1:] if number.startswith("-") else f"-{number}"
    elif chord == "Backspace":
        if not number and before:
            return "\t".join(before)
        number = number[:-1]
    elif chord == "Tab":
        if typed.does != "move" or len(before) + 1 >= len(typed.axes or _AXES):
            return typed.text
        return f"{typed.text}\t"
    else:
        return None
    return "\t".join([*before, number[:_MAX_DIGITS]])


def _pivot_under(gizmo: Gizmo, pointer: PointerContext) -> Gizmo:
    """Return the handles with the pivot on the surface under the mouse; unchanged where there is none."""
    camera = pointer.camera(pointer.shown.camera)
    point = surface_point(pointer.scene, camera, *pointer.cursor, pointer.engine.near)
    if point is None:
        return gizmo
    offset = np.append(np.subtract(point, gizmo.center), 1.0)
    x, y, z, _ = np.linalg.solve(gizmo.matrix, offset).tolist()
    return replace(gizmo, pivot_at=(x, y, z))


def undo(gizmo: Gizmo) -> Gizmo:
    """Undo the transform in progress."""
    return gizmo if gizmo.typed is None else replace(gizmo, matrix=gizmo.typed.start, typed=None)


def numbers(text: str, nothing: float) -> list[float]:
    """Return the typed numbers; one without digits is `nothing`, with its sign."""
    found = []
    for part in text.split("\t"):
        number = nothing
        if part.startswith("-"):
            number = -nothing
        found.append(float(part) if part.strip("-.") else number)
    return found


@dataclass(frozen=True)
class Sight:
    """View of the handles: camera, and the mouse at the start and now, pixels of the picture."""

    camera: Camera
    before: tuple[float, float]
    now: tuple[float, float]
    steps: bool = False  # Ctrl is held
    unit: float = 1.0  # typed length of a world unit


def follow(gizmo: Gizmo, pointer: PointerContext, surfaces: DecalSurfaces) -> Gizmo:
    """Return the handles after the transform in progress, with the value of the text or of the mouse.

    Args:
        gizmo: the handles
        pointer: the view
        surfaces: cache of the surface to snap to
    """
    typed = gizmo.typed
    if typed is None:
        return gizmo
    mouse = imgui.get_io().mouse_pos
    now = (mouse.x, mouse.y)
    if typed.mouse is None:
        typed = replace(typed, mouse=now)
    density = imgui.get_io().display_framebuffer_scale
    start = typed.mouse or now
    sight = Sight(
        pointer.camera(pointer.shown.camera),
        (start[0] * density.x - pointer.left, start[1] * density.y),
        (now[0] * density.x - pointer.left, now[1] * density.y),
        imgui.get_io().key_ctrl,
        pointer.shown.unit,
    )
    gizmo = replace(gizmo, typed=typed)
    if gizmo.snap == "surface" and typed.does == "move" and not typed.text and gizmo.part is not None:
        picture = surfaces.depth(gizmo.part.rest, sight.camera)
        footprint = None
        if picture is not None:
            footprint = fit_footprint(picture, *sight.now, _SNAP_PX * density.x * pointer.ui.scale)
        if footprint is not None:
            matrix = on_surface(gizmo.part, gizmo.center, typed.start, footprint.center, footprint.normal)
            return replace(gizmo, matrix=matrix)
    values = value_of(gizmo, typed, sight)
    return replace(gizmo, matrix=apply(gizmo, typed, values, sight.camera))


def value_of(gizmo: Gizmo, typed: TypedTransform, sight: Sight) -> list[float]:
    """Return the value of a transform: three offsets, degrees or a factor."""
    if typed.text:
        typed_numbers = numbers(typed.text, 1.0 if typed.does == "scale" else 0.0)
        if typed.does != "move":
            return typed_numbers[:1]
        offsets = [0.0, 0.0, 0.0]
        for axis, number in zip(typed.axes or _AXES, typed_numbers, strict=False):
            offsets[_AXES.index(axis)] = number / sight.unit
        return offsets
    pivot = np.array(gizmo.center) + pivot_of(gizmo, typed.start)
    if typed.does == "move":
        return [float(value) for value in _offset(typed, pivot, sight)]
    if not _is_in_front(pivot, sight.camera):
        return [0.0 if typed.does == "rotate" else 1.0]
    middle = _project(pivot, sight.camera)
    before = np.subtract(sight.before, middle)
    now = np.subtract(sight.now, middle)
    if typed.does == "scale":
        factor = float(np.linalg.norm(now)) / max(float(np.linalg.norm(before)), 1.0)
        return [SCALE_STEP * round(factor / SCALE_STEP) if sight.steps else factor]
    # y points down in a picture
    angle = math.degrees(math.atan2(-now[1], now[0]) - math.atan2(-before[1], before[0]))
    angle = (angle + 180.0) % 360.0 - 180.0
    if typed.axes and float(_view_axis(sight.camera) @ _unit(typed.axes)) < 0.0:
        angle = -angle
    return [ANGLE_STEP_DEG * round(angle / ANGLE_STEP_DEG) if sight.steps else angle]


def apply(gizmo: Gizmo, typed: TypedTransform, values: list[float], camera: Camera) -> Floats:
    """Return the matrix of the handles after a transform with these values. [4,4]"""
    step = np.eye(4)
    if typed.does == "move":
        step[:3, 3] = values
        return step @ typed.start
    if typed.does == "rotate":
        direction = _unit(typed.axes) if typed.axes else _view_axis(camera)
        step[:3, :3] = _rotation(direction, values[0])
    else:
        factor = values[0]
        if abs(factor) < MIN_STRETCH:
            factor = math.copysign(MIN_STRETCH, factor)
        for axis in typed.axes or _AXES:
            step[_AXES.index(axis), _AXES.index(axis)] = factor
    return _about(step[:3, :3], pivot_of(gizmo, typed.start)) @ typed.start


def pivot_of(gizmo: Gizmo, matrix: Floats) -> Floats:
    """Return the pivot under a matrix of the handles, from the center of the selection. [3]"""
    pivot: Floats = matrix[:3, :3] @ np.array(gizmo.pivot_at) + matrix[:3, 3]
    return pivot


def _about(linear: Floats, pivot: Floats) -> Floats:
    """Return the transform of a matrix [3,3] about a point. [4,4]"""
    step = np.eye(4)
    step[:3, :3] = linear
    step[:3, 3] = pivot - linear @ pivot
    return step


def with_pivot(gizmo: Gizmo, pivot: Pivot) -> Gizmo:
    """Choose the pivot. "pointer" keeps the current one until a key begins a transform."""
    place = gizmo.pivot_at
    if pivot == "center":
        place = (0.0, 0.0, 0.0)
    elif pivot == "base" and gizmo.part is not None:
        low = _base(gizmo.part, np.eye(3))
        x, y, z = (low * np.array(gizmo.part.up)).tolist()
        place = (x, y, z)
    return replace(gizmo, pivot=pivot, pivot_at=place)


def _base(part: PlacedPart, linear: Floats) -> float:
    """Return the height of the lowest points after a matrix, along the up axis from the center."""
    heights = part.points @ linear.T @ np.array(part.up)
    return float(np.quantile(heights, _BASE_SHARE))


def mirror_part(gizmo: Gizmo, axis: int) -> Gizmo:
    """Mirror the part at the plane through the pivot, perpendicular to a world axis, 0 to 2."""
    flip = np.eye(3)
    flip[axis, axis] = -1.0
    return replace(gizmo, matrix=_about(flip, pivot_of(gizmo, gizmo.matrix)) @ gizmo.matrix)


def on_ground(gizmo: Gizmo) -> Gizmo:
    """Shift the part along the up axis until its base is on the ground."""
    part = gizmo.part
    if part is None:
        return gizmo
    up = np.array(part.up)
    center = np.array(gizmo.center) + gizmo.matrix[:3, 3]
    height = float(center @ up) + _base(part, gizmo.matrix[:3, :3])
    matrix = gizmo.matrix.copy()
    matrix[:3, 3] += (part.ground - height) * up
    return replace(gizmo, matrix=matrix)


def on_surface(
    part: PlacedPart, center: tuple[float, float, float], start: Floats, point: Floats, normal: Floats
) -> Floats:
    """Return the matrix that puts the base of a part on a point of a surface. [4,4]

    Args:
        part: the part
        center: its center
        start: matrix of the handles before. [4,4]
        point: point of the surface, in the scene's coordinates. [3]
        normal: unit normal, with which the up axis is aligned. [3]
    """
    up = np.array(part.up)
    turn, _ = Rotation.align_vectors(normal[None], up[None])
    align = turn.as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3] = align @ start[:3, :3]
    base = align @ (_base(part, start[:3, :3]) * up)
    matrix[:3, 3] = point - np.array(center) - base
    return matrix


@dataclass(frozen=True)
class Fields:
    """Values of the fields: the pivot's position, rotation about X, then Y, then Z, and factors."""

    __eq__ = equal_fields

    position: Floats  # from the center of the selection before the motion, world units. [3]
    angles: Floats  # degrees. [3]
    scale: Floats  # factors along the part's own axes; negative for a mirrored one. [3]


def fields_of(gizmo: Gizmo) -> Fields:
    """Return the values of the fields."""
    linear = gizmo.matrix[:3, :3]
    position = pivot_of(gizmo, gizmo.matrix)
    angles = np.array(gizmo.angles)
    stretch = Rotation.from_euler("xyz", angles, degrees=True).as_matrix().T @ linear
    smallest = _SAME_SHAPE * np.abs(stretch).max()
    negative = (np.linalg.eigvalsh((stretch + stretch.T) / 2.0) < 0.0).sum()
    is_mirrored = negative == 1 and np.abs(stretch - np.diag(stretch.diagonal())).max() <= smallest
    is_stretched = negative == 0 and np.abs(stretch - stretch.T).max() <= smallest
    if is_mirrored or is_stretched:  # the last angles still hold
        return Fields(position, angles, stretch.diagonal().copy())
    motion = affine_motion(torch.from_numpy(linear.copy()), torch.zeros(3))
    scale = torch.linalg.matrix_exp(motion.stretch).diagonal().numpy().copy()
    if motion.mirror is not None:
        scale[motion.mirror] *= -1.0
    turn = Rotation.from_rotvec(motion.turn.numpy()).as_matrix()
    return Fields(position, _angles(turn), scale)


def _angles(turn: Floats) -> Floats:
    """Return the rotation about X, then Y, then Z of a rotation matrix, degrees. [3,3] -> [3]"""
    y = math.asin(min(max(-turn[2, 0], -1.0), 1.0))
    if abs(turn[2, 0]) < 1.0 - 1e-12:
        angles = (math.atan2(turn[2, 1], turn[2, 2]), y, math.atan2(turn[1, 0], turn[0, 0]))
    else:  # rotations about X and Z are the same
        angles = (math.atan2(-turn[1, 2], turn[1, 1]), y, 0.0)
    return np.degrees(angles) + 0.0


def with_fields(gizmo: Gizmo, before: Fields, after: Fields) -> Gizmo:
    """Return the handles after changed fields."""
    matrix = gizmo.matrix.copy()
    matrix[:3, 3] += after.position - before.position
    if not np.array_equal(after.angles, before.angles):
        turns = [Rotation.from_euler("xyz", f.angles, degrees=True) for f in (before, after)]
        turn = (turns[1] * turns[0].inv()).as_matrix()
        matrix = _about(turn, pivot_of(gizmo, matrix)) @ matrix
    if not np.array_equal(after.scale, before.scale):
        size = np.maximum(np.abs(after.scale), MIN_STRETCH) * np.where(after.scale < 0.0, -1.0, 1.0)
        matrix = matrix @ _about(np.diag(size / before.scale), np.array(gizmo.pivot_at))
    x, y, z = after.angles.tolist()
    return replace(gizmo, matrix=matrix, angles=(x, y, z))


def describe(typed: TypedTransform, matrix: Floats, unit: float = 1.0) -> str:
    """Return the text of the transform in progress, such as "Rotate Z 45°".

    Args:
        typed: the transform
        matrix: the handles' matrix after it. [4,4]
        unit: length of a world unit
    """
    words = [_NAMES[typed.does]]
    if typed.axes:
        words.append(typed.axes)
    if typed.text:
        typed_text = "  ".join(part or "0" for part in f"{typed.text}_".split("\t"))
        words.append(typed_text)
    else:
        words.append(_mouse_value_text(typed, matrix, unit))
    if typed.does == "rotate":
        words[-1] += "°"
    return " ".join(words)


def _mouse_value_text(typed: TypedTransform, matrix: Floats, unit: float) -> str:
    """Return the value that the mouse gives."""
    step = matrix @ np.linalg.inv(typed.start)
    if typed.does == "move":
        moved = unit * (matrix[:3, 3] - typed.start[:3, 3])
        return "  ".join(f"{moved[_AXES.index(axis)]:.4g}" for axis in typed.axes or _AXES)
    if typed.does == "scale":
        axis = _AXES.index((typed.axes or _AXES)[0])
        return f"{step[axis, axis]:.3g}"
    turn = Rotation.from_matrix(step[:3, :3]).as_rotvec(degrees=True)
    angle = float(np.linalg.norm(turn))
    if typed.axes:
        angle = float(turn @ _unit(typed.axes))
    return f"{angle:.1f}"


def _rotation(axis: Floats, degrees: float) -> Floats:
    """Return a rotation matrix, exact for quarter turns about a world axis. [3,3]"""
    matrix: Floats = Rotation.from_rotvec(math.radians(degrees) * axis).as_matrix()
    if degrees % 90.0 == 0.0 and np.count_nonzero(axis) == 1:
        matrix = np.round(matrix)
    return matrix


def _unit(axes: str) -> Floats:
    """Return the unit vector of an axis. [3]"""
    unit = np.zeros(3)
    unit[_AXES.index(axes[0])] = 1.0
    return unit


def _view_axis(camera: Camera) -> Floats:
    """Return the direction from the scene to the viewer. [3]"""
    axis: Floats = -camera.viewmat.double().numpy()[2, :3]
    return axis


def _is_in_front(point: Floats, camera: Camera) -> bool:
    viewmat = camera.viewmat.double().numpy()
    return float(viewmat[2, :3] @ point + viewmat[2, 3]) > 0.0


def _project(point: Floats, camera: Camera) -> Floats:
    """Return a point of the scene in pixels of the picture. [3] -> [2]"""
    viewmat = camera.viewmat.double().numpy()
    x, y, z = camera.K.double().numpy() @ (viewmat[:3, :3] @ point + viewmat[:3, 3])
    return np.array([x / z, y / z])


def _ray(at: tuple[float, float], camera: Camera) -> tuple[Floats, Floats]:
    """Return the camera's position and the direction of a pixel, of depth 1. [3], [3]"""
    viewmat = camera.viewmat.double().numpy()
    turn = viewmat[:3, :3]
    direction = np.linalg.inv(camera.K.double().numpy()) @ np.array([at[0], at[1], 1.0])
    return -turn.T @ viewmat[:3, 3], turn.T @ direction


def _offset(typed: TypedTransform, pivot: Floats, sight: Sight) -> Floats:
    """Return the movement that keeps the pivot under the mouse, along the axes. [3]"""
    places = [_place(typed, pivot, at, sight.camera) for at in (sight.before, sight.now)]
    offset: Floats = places[1] - places[0]
    return offset


def _place(typed: TypedTransform, pivot: Floats, at: tuple[float, float], camera: Camera) -> Floats:
    """Return the point under a pixel on the axis or plane through the pivot. [3]"""
    origin, ray = _ray(at, camera)
    toward = _view_axis(camera)
    if len(typed.axes) == 1:
        axis = _unit(typed.axes)
        # the plane through the axis that faces the viewer most
        normal = toward - float(toward @ axis) * axis
        length = float(np.linalg.norm(normal))
        if length < _MIN_SINE:
            return pivot
        hit = _meet(origin, ray, pivot, normal / length)
        return pivot + float((hit - pivot) @ axis) * axis
    normal = toward
    if typed.axes:
        normal = 1.0 - sum((_unit(axis) for axis in typed.axes), np.zeros(3))
        if abs(float(normal @ toward)) < _MIN_SINE:
            return pivot
    return _meet(origin, ray, pivot, normal)


def _meet(origin: Floats, ray: Floats, point: Floats, normal: Floats) -> Floats:
    """Return the point of a ray on a plane; the plane's point if the ray does not meet it in front. [3]"""
    slope = float(ray @ normal)
    if slope == 0.0:
        return point
    depth = float((point - origin) @ normal) / slope
    if depth <= 0.0:
        return point
    met: Floats = origin + depth * ray
    return met
