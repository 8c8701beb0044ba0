"""Handles that move a selection (ImGuizmo), and the decal that follows the pointer until it is placed."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
from imgui_bundle import imgui
from imgui_bundle.imguizmo import im_guizmo
from numpy.typing import NDArray
from PIL import Image
from scipy.spatial.transform import Rotation

from progdf.camera import Camera
from progdf.io.images import open_picture
from viewer.camera.view_camera import to_camera
from viewer.state.transient import Decal, Gizmo
from viewer.ui import overlay
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


_MAX_TEXTURE_PX = 1024  # maximum longer side of the picture shown on screen, pixels
_INITIAL_SIZE = 0.25  # initial longer side, as a fraction of the view's height
_STEP = 1.08  # size factor per notch of the wheel
_TURN = 5.0  # rotation per notch of the wheel, degrees
_SIZE_RANGE_PX = (8.0, 8192.0)  # minimum and maximum, window pixels
_HINT = "Wheel: size. Shift+wheel: rotate. Click or Enter: place. Esc: cancel"


def load_decal(context: moderngl.Context, path: Path) -> Decal:
    """Load a picture as a decal.

    Raises:
        ProgdfError: it cannot be read.
    """
    picture = open_picture(path).convert("RGBA")
    picture.thumbnail((_MAX_TEXTURE_PX, _MAX_TEXTURE_PX))
    texture = context.texture(picture.size, 4, np.asarray(picture).tobytes(), alignment=1)
    texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
    return Decal(path, int(texture.glo), picture.size)


def draw_decal(decal: Decal, pointer: PointerContext) -> tuple[Decal, str]:
    """Draw the decal; return it after this frame's mouse input, and its request, "" for none."""
    io = imgui.get_io()
    area = pointer.area
    inside = 0.0 <= io.mouse_pos.x < area.width and 0.0 <= io.mouse_pos.y < area.height
    over = inside and not io.want_capture_mouse
    size = decal.size or _INITIAL_SIZE * area.height
    angle = decal.angle
    # some systems turn the wheel sideways with Shift
    notches = (io.mouse_wheel or io.mouse_wheel_h) if over else 0.0
    if notches and io.key_shift:
        angle += math.copysign(_TURN, notches)
    elif notches:
        size = min(max(size * _STEP**notches, _SIZE_RANGE_PX[0]), _SIZE_RANGE_PX[1])
    at = (io.mouse_pos.x, io.mouse_pos.y) if over else decal.at or (area.width / 2, area.height / 2)
    moved = replace(decal, size=size, angle=angle, at=at)
    a, b, c, d = decal_corners(moved)
    imgui.get_background_draw_list().add_image_quad(imgui.ImTextureRef(decal.texture), a, b, c, d)
    overlay.banner(_HINT, area, pointer.ui)
    return moved, "lay_decal" if over and imgui.is_mouse_clicked(0) else ""


def decal_corners(decal: Decal) -> list[tuple[float, float]]:
    """Return the corners in the window, clockwise from the upper left of the picture."""
    scale = decal.size / max(decal.texture_size)
    x0, y0 = decal.at or (0.0, 0.0)
    across, down = (scale * side / 2 for side in decal.texture_size)
    cosine = math.cos(math.radians(decal.angle))
    sine = math.sin(math.radians(decal.angle))
    return [
        (x0 + x * cosine + y * sine, y0 - x * sine + y * cosine)
        for x, y in ((-across, -down), (across, -down), (across, down), (-across, down))
    ]


def place_decal(decal: Decal, pointer: PointerContext) -> tuple[Camera, str]:
    """Return the camera from which the decal is placed, and the value of `progdf train --at`."""
    camera = to_camera(pointer.shown.camera, *pointer.size)
    density = camera.height / pointer.area.height
    x, y = decal.at or (0.0, 0.0)
    numbers = (density * x, density * y, density * decal.size, decal.angle)
    return camera, ",".join(f"{number:.2f}" for number in numbers)


def decal_takes_mouse() -> bool:
    """Return True if the decal takes the mouse, that is, no button that moves the camera is pressed."""
    return not any(imgui.is_mouse_down(button) or imgui.is_mouse_released(button) for button in (1, 2))


def is_decal(path: Path) -> bool:
    """Return True if a picture has both transparent and visible pixels."""
    with Image.open(path) as picture:
        if "A" not in picture.getbands() and "transparency" not in picture.info:
            return False
        low, high = picture.convert("RGBA").getchannel("A").getextrema()
    return bool(isinstance(low, int) and isinstance(high, int) and low < 255 and high > 0)
