"""Handles that move a selection (ImGuizmo)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui
from imgui_bundle.imguizmo import im_guizmo
from numpy.typing import NDArray

from viewer.camera.view_camera import to_camera
from viewer.panel import tools
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.state.transient import Gizmo, GizmoPose, Pivot, Snap, Transform
from viewer.state.workspace import Workspace, with_transient
from viewer.ui.keys import Keys
from viewer.ui.pointer import PointerContext
from viewer.ui.widgets import accent_button, choice, choice_row, label, plate, tip

from . import select_tool, typed

_OPERATION = im_guizmo.OPERATION
_KEYS_HELP = """G, R or S moves, rotates or scales; then X, Y or Z (Shift: a plane), then a number.
Enter or a click takes it, Esc or a right click undoes it"""
_PIVOT_HELP = "Fixed point of rotations, scales and mirrors. Pointer: under the mouse when R or S is pressed"
_SNAP_HELP = """Ground: the base stays on the ground.
Surface: after G, the base follows the surface under the mouse, aligned with its normal"""
_PIVOTS: dict[Pivot, str] = {"center": "Center", "base": "Base", "pointer": "Pointer"}
_SNAPS: dict[Snap, str] = {"off": "Off", "ground": "Ground", "surface": "Surface"}
_COLUMN_PX = 64.0  # at 1×: start of the fields
_FIELD_PX = 72.0  # width of a field
_BUTTON_PX = 72.0
_SAME_MATRIX = 1e-4  # difference of matrix elements within a frame of a drag that counts as none
_STEPS_PER_RADIUS = 500.0  # pixels of a drag that move the part by the radius of the scene
_HANDLES = _OPERATION(_OPERATION.translate | _OPERATION.rotate | _OPERATION.scaleu)


def take_keys(work: Workspace, pointer: PointerContext, keys: Keys) -> tuple[Workspace, Keys]:
    """Handle the keys of the handles and of the selection tool; return the unused keys."""
    gizmo = work.transient.gizmo
    if isinstance(gizmo, Gizmo):
        if imgui.get_io().want_text_input:  # Enter and Escape end the field
            return work, replace(keys, pressed=(), fly=frozenset())
        undone, keys = _take_undo(gizmo, keys)
        moved, keys = typed.take_keys(undone, keys, pointer)
        if moved is not gizmo:
            work = with_transient(work, gizmo=moved)
    return select_tool.take_keys(work, pointer, keys)


def _take_undo(gizmo: Gizmo, keys: Keys) -> tuple[Gizmo, Keys]:
    """Undo or redo one motion of the handles; return the unused keys."""
    if gizmo.using or gizmo.typed is not None:
        return gizmo, keys
    unused = []
    for press in keys.pressed:
        if press.chord == "Ctrl+Z" and gizmo.past:
            gizmo = _at(gizmo, gizmo.past[-1], gizmo.past[:-1], (*gizmo.future, gizmo.rest))
        elif press.chord in ("Ctrl+Shift+Z", "Ctrl+Y") and gizmo.future:
            gizmo = _at(gizmo, gizmo.future[-1], (*gizmo.past, gizmo.rest), gizmo.future[:-1])
        else:
            unused.append(press)
    return gizmo, replace(keys, pressed=tuple(unused))


def _at(gizmo: Gizmo, pose: GizmoPose, past: tuple[GizmoPose, ...], future: tuple[GizmoPose, ...]) -> Gizmo:
    """Return the handles in another pose at rest."""
    return replace(gizmo, matrix=pose.matrix, angles=pose.angles, rest=pose, past=past, future=future)


def _record(gizmo: Gizmo) -> Gizmo:
    """Record a finished motion of the handles for undo."""
    if np.array_equal(gizmo.matrix, gizmo.rest.matrix):
        return gizmo
    pose = GizmoPose(gizmo.matrix, gizmo.angles)
    return replace(gizmo, rest=pose, past=(*gizmo.past, gizmo.rest), future=())


def draw_gizmo(gizmo: Gizmo, pointer: PointerContext, surfaces: DecalSurfaces) -> tuple[Gizmo, str]:
    """Draw the handles; return them after this frame's mouse input, and the request, "" for none.

    Args:
        gizmo: the handles
        pointer: the view
        surfaces: cache of the surface to snap to
    """
    moved, using = drag_gizmo(typed.follow(gizmo, pointer, surfaces), pointer)
    moved, request = _draw_panel(moved, pointer)
    if moved.snap == "ground" and not np.array_equal(moved.matrix, gizmo.matrix):
        moved = typed.on_ground(moved)
    if moved.typed is not None and not imgui.get_io().want_capture_mouse:
        if imgui.is_mouse_clicked(0):
            moved = replace(moved, typed=None)
        elif imgui.is_mouse_clicked(1):
            moved = typed.undo(moved)
    if not using and moved.typed is None and not imgui.is_any_item_active():
        moved = _record(moved)
    is_changed = not np.array_equal(moved.matrix, gizmo.shown)
    is_live = gizmo.does == "transform"  # a copy is shown where its handles are released
    if (is_changed and (is_live or not using)) or (gizmo.using and not using):
        moved = replace(moved, shown=moved.matrix)
        request = request or "place"
    return replace(moved, using=using), request


def drag_gizmo(gizmo: Gizmo, pointer: PointerContext, usable: bool = True) -> tuple[Gizmo, bool]:
    """Draw ImGuizmo's handles; return them after this frame's drag, and True during a drag.

    They are gray while keys transform, or while they are not usable.
    """
    size = pointer.size
    camera = to_camera(pointer.shown.camera, *size)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along −z
    view = flip @ camera.viewmat.double().numpy()
    place = np.eye(4)
    place[:3, 3] = gizmo.center
    pivot = np.eye(4)
    pivot[:3, 3] = gizmo.pivot_at
    im_guizmo.begin_frame()
    im_guizmo.set_drawlist(imgui.get_background_draw_list())
    im_guizmo.set_rect(0.0, 0.0, pointer.area.width, pointer.area.height)
    im_guizmo.enable(usable and gizmo.typed is None)
    model = _columns(place @ gizmo.matrix @ pivot)
    projection = _columns(_projection(pointer.shown.camera.fov_y, size[0] / size[1], pointer.engine.near))
    im_guizmo.manipulate(
        _columns(view), projection, _HANDLES, im_guizmo.MODE.world, model, None, _steps(gizmo)
    )
    using = bool(im_guizmo.is_using())
    dragged = gizmo
    if not using:  # while it is used, ImGuizmo counts every handle as under the mouse
        dragged = replace(dragged, grip=_grip())
    if using or gizmo.using:
        world = np.array(model.values, np.float64).reshape(4, 4).T
        dragged = replace(dragged, matrix=np.linalg.inv(place) @ world @ np.linalg.inv(pivot))
        dragged = replace(dragged, grip=_dragged_grip(gizmo, dragged.matrix))
    return dragged, using


def gizmo_takes_mouse(before: Gizmo, after: Gizmo) -> bool:
    """Return True if the mouse is over a handle or drags one, or gives or ends a transform by keys.

    Args:
        before, after: the handles before and after this frame
    """
    if before.typed is not None:
        ends = imgui.is_mouse_clicked(0) or imgui.is_mouse_clicked(1)
        return ends or not before.typed.text
    return after.using or bool(im_guizmo.is_over())


def _columns(matrix: NDArray[np.float64]) -> im_guizmo.Matrix16:
    return im_guizmo.Matrix16(matrix.T.ravel().tolist())


def _projection(fov_y: float, aspect: float, near: float) -> NDArray[np.float64]:
    """Return OpenGL's projection matrix for a vertical field of view in degrees."""
    tall = 1.0 / math.tan(math.radians(fov_y) / 2)
    far = 1e5 * near
    projection = np.zeros((4, 4))
    projection[0, 0] = tall / aspect
    projection[1, 1] = tall
    projection[2, 2:] = (far + near) / (near - far), 2.0 * far * near / (near - far)
    projection[3, 2] = -1.0
    return projection


def _grip() -> Transform:
    """Return the transform of the handle under the mouse, as far as ImGuizmo tells it."""
    if im_guizmo.is_over(_OPERATION.translate):
        return "move"
    return "rotate" if im_guizmo.is_over(_OPERATION.rotate) else "scale"


def _dragged_grip(before: Gizmo, matrix: NDArray[np.float64]) -> Transform:
    """Return the transform of the handle that the mouse drags, from the matrix after this frame. [4,4]"""
    step = np.linalg.inv(before.matrix) @ matrix
    lengths = np.linalg.norm(step[:3, :3], axis=0)
    if np.abs(lengths - 1.0).max() > _SAME_MATRIX:
        return "scale"
    if np.abs(step[:3, :3] - np.eye(3)).max() > _SAME_MATRIX:
        return "rotate"
    return before.grip


def _steps(gizmo: Gizmo) -> im_guizmo.Matrix3 | None:
    """Return the step of the dragged handle while Ctrl is held: 15°, or a factor of 0.1; None for none."""
    if not imgui.get_io().key_ctrl or gizmo.grip == "move":
        return None
    step = typed.ANGLE_STEP_DEG if gizmo.grip == "rotate" else typed.SCALE_STEP
    return im_guizmo.Matrix3([step] * 3)


def _draw_panel(gizmo: Gizmo, pointer: PointerContext) -> tuple[Gizmo, str]:
    """Draw the fields and the buttons at the top of the picture; return the handles and a request."""
    ui = pointer.ui
    at = (tools.LEFT_PX * ui.scale, tools.EDGE_PX * ui.scale)
    column = _COLUMN_PX * ui.scale
    with plate("placing", at, ui):
        imgui.align_text_to_frame_padding()
        name = "Copy" if gizmo.does == "duplicate" else "Move"
        if gizmo.typed is not None:
            name = typed.describe(gizmo.typed, gizmo.matrix, pointer.shown.unit)
        imgui.text(name)
        tip(_KEYS_HELP)
        gizmo = _draw_fields(gizmo, pointer)
        chosen = choice_row("Pivot", _PIVOTS, gizmo.pivot, column, ui, _PIVOT_HELP)
        if chosen != gizmo.pivot:
            gizmo = typed.with_pivot(gizmo, chosen)
        snap = choice_row("Snap", _SNAPS, gizmo.snap, column, ui, _SNAP_HELP)
        if snap != gizmo.snap:
            gizmo = replace(gizmo, snap=snap)
            if snap == "ground":
                gizmo = typed.on_ground(gizmo)
        label("Mirror", column)
        axis = choice("mirror", {0: "X", 1: "Y", 2: "Z"}, None, ui)
        tip("Mirror at the plane through the pivot, across this axis of the world")
        if axis is not None:
            gizmo = typed.mirror_part(gizmo, axis)
        button = _BUTTON_PX * ui.scale
        imgui.set_cursor_pos_x(column)
        request = "keep_placed" if accent_button("Keep", (button, 0.0)) else ""
        imgui.same_line()
        if imgui.button("Cancel", (button, 0.0)):
            request = "put_back"
    return gizmo, request


def _draw_fields(gizmo: Gizmo, pointer: PointerContext) -> Gizmo:
    """Draw the fields of position, rotation and scale; return the handles after a change."""
    before = typed.fields_of(gizmo)
    origin = np.add(gizmo.center, pointer.facts.origin)
    unit = pointer.shown.unit
    step = unit * pointer.facts.bounds.radius / _STEPS_PER_RADIUS
    scale = pointer.ui.scale
    shown = unit * (before.position + origin)
    typed_position = _field("Position", shown, step, "%.4g", scale)
    position = before.position if typed_position is shown else typed_position / unit - origin
    tip("Position of the pivot in units of the scene. Drag, or double-click and type")
    angles = _field("Rotation", before.angles, 0.5, "%.4g°", scale)
    tip("Rotation about X, then Y, then Z, in degrees. Drag, or double-click and type")
    factors = _field("Scale", before.scale, 0.01, "%.4g", scale)
    tip("Factors along the part's own axes; a negative one mirrors. Drag, or double-click and type")
    after = typed.Fields(position, angles, factors)
    if all(np.array_equal(a, b) for a, b in zip(vars(before).values(), vars(after).values(), strict=True)):
        return gizmo
    return replace(typed.with_fields(gizmo, before, after), typed=None)


def _field(
    name: str, values: NDArray[np.float64], speed: float, form: str, scale: float
) -> NDArray[np.float64]:
    """Draw three fields in a row; return their values. [3]"""
    label(name, _COLUMN_PX * scale)
    imgui.set_next_item_width(3 * _FIELD_PX * scale)
    given = values.tolist()
    changed, numbers = imgui.drag_float3(f"##{name}", given, speed, 0.0, 0.0, form)
    if not changed:
        return values
    new = values.copy()
    for i, number in enumerate(numbers):
        if np.float32(number) != np.float32(given[i]):
            new[i] = float(str(np.float32(number)))  # the shortest decimal that imgui's number stands for
    return new
