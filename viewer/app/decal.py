"""Decal: a picture with transparency that follows the pointer over the scene until it is placed on the
surface."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
from imgui_bundle import imgui
from PIL import Image

from progdf.camera import Camera
from progdf.io.images import open_picture
from viewer.camera.view_camera import to_camera
from viewer.state.transient import Decal
from viewer.ui import overlay
from viewer.ui.pointer import PointerContext

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
