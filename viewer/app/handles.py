"""Handles that move a selection (ImGuizmo)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from imgui_bundle import imgui
from imgui_bundle.imguizmo import im_guizmo
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from viewer.camera.view_camera import to_camera
from viewer.state.transient import Gizmo
from viewer.ui.pointer import PointerContext
from viewer.ui.widgets import accent_button, plate

_OPERATION = im_guizmo.OPERATION
_HANDLES = _OPERATION(_OPERATION.translate | _OPERATION.rotate | _OPERATION.scaleu)


def draw_gizmo(gizmo: Gizmo, pointer: PointerContext) -> tuple[Gizmo, str]:
    """Draw the handles; return them after this frame's mouse input, and the request, "" for none."""
    size = pointer.size
    camera = to_camera(pointer.shown.camera, *size)
    flip = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along −z
    view = flip @ camera.viewmat.double().numpy()
    place = np.eye(4)
    place[:3, 3] = gizmo.center
    im_guizmo.begin_frame()
    im_guizmo.set_drawlist(imgui.get_background_draw_list())
    im_guizmo.set_rect(0.0, 0.0, pointer.area.width, pointer.area.height)
    model = _columns(place @ gizmo.matrix)
    projection = _columns(_projection(pointer.shown.camera.fov_y, size[0] / size[1], pointer.engine.near))
    im_guizmo.manipulate(_columns(view), projection, _HANDLES, im_guizmo.MODE.world, model)
    moved = np.linalg.inv(place) @ np.array(model.values, np.float64).reshape(4, 4).T
    using = bool(im_guizmo.is_using())
    matrix = moved if using or gizmo.using else gizmo.matrix
    request = "place" if gizmo.using and not using else _buttons(gizmo, pointer)
    return replace(gizmo, matrix=matrix, using=using), request


def gizmo_takes_mouse(gizmo: Gizmo) -> bool:
    """Return True if the mouse is over a handle or drags one."""
    return gizmo.using or bool(im_guizmo.is_over())


def gizmo_step(gizmo: Gizmo) -> tuple[list[float], list[float], float]:
    """Return translation, rotation (axis times radians) and scale of the selection."""
    linear = gizmo.matrix[:3, :3]
    scale = max(abs(float(np.linalg.det(linear))) ** (1 / 3), 1e-6)
    rotation = Rotation.from_matrix(linear / scale).as_rotvec()
    return gizmo.matrix[:3, 3].tolist(), rotation.tolist(), scale


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


def _buttons(gizmo: Gizmo, pointer: PointerContext) -> str:
    """Draw the buttons that keep or cancel the change at the top of the picture."""
    scale = pointer.ui.scale
    at = (pointer.area.width / 2, 14.0 * scale)
    with plate("placing", at, pointer.ui, (0.5, 0.0)):
        imgui.align_text_to_frame_padding()
        imgui.text("Copy" if gizmo.does == "duplicate" else "Move")
        imgui.same_line()
        request = "keep_placed" if accent_button("Keep", (72.0 * scale, 0.0)) else ""
        imgui.same_line()
        return "put_back" if imgui.button("Cancel", (72.0 * scale, 0.0)) else request
