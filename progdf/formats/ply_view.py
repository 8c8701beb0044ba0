"""Up axis and camera that a .ply stores next to its Gaussians.

Up axis, from a comment in the header:

    comment Vertical Axis: z          nerfstudio: the positive axis
    comment Vertical axis: y          Brush: −y (in its convention, x is +x, y is −y, z is −z)
    comment Vertical axis: 0 -1 0     Brush: a vector

Camera, from the elements of Apple's SHARP, which makes a scene from one photo: `extrinsic` (world to camera,
OpenCV axes, 16 numbers row by row), `intrinsic` (9 numbers row by row) and `image_size` (width, height). Two
more elements change the rendering: `color_space` (0 sRGB, 1 linear RGB) and `frame` (frames in the file).
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.cameras import relative_viewmat
from progdf.io.file_rules import unsupported_error
from progdf.system.equality import equal_fields

from .ply_file import PlyFile, read_header

CAMERA_ELEMENTS = {"extrinsic": 16, "intrinsic": 9, "image_size": 2}
"""Elements that together form a camera, and their row counts. Each has one property of the same name."""

LARGEST_SIDE = 1_000_000  # largest width or height, pixels
ROTATION_TOLERANCE = 1e-2  # largest deviation of R Rᵀ from the identity

_UP_COMMENT = re.compile(r"(?:vertical|up)[ _-]?axis(?P<mark> *[:=]| +) *(?P<value>.*)", re.I)
_AXIS = re.compile(r"(?P<sign>[+-]?) ?(?P<axis>[xyz])(?:[ -]?up)?", re.I)
_BRUSH = "exported from brush"


@dataclass(frozen=True)
class PlyView:
    """Up axis and camera that a .ply stores."""

    __eq__ = equal_fields

    up: Tensor | None = None  # in the world, unit length. [3] float32
    up_comment: str = ""  # the comment that states the up axis
    unknown_comments: tuple[str, ...] = ()  # comments about the up axis that name no axis
    camera: Camera | None = None  # the stored camera, relative to the requested origin


def stored_view(path: Path, origin: Origin = ZERO) -> PlyView:
    """Return the up axis and the camera in a scene's file; an empty `PlyView` for files other than .ply.

    Args:
        path: the scene's file
        origin: origin of the scene; the camera is relative to it
    """
    try:
        return read_view(read_header(path), origin)
    except ProgdfError:
        return PlyView()


def read_view(ply: PlyFile, origin: Origin = ZERO) -> PlyView:
    """Return the up axis and the camera of a .ply; see `stored_view`."""
    camera = _stored_camera(ply)
    if camera is not None:
        viewmat = relative_viewmat(camera.viewmat, origin).float()
        camera = replace(camera, viewmat=viewmat) if bool(viewmat.isfinite().all()) else None
    is_brush = any(comment.lower() == _BRUSH for comment in ply.comments)
    directions: dict[str, Tensor] = {}
    unknown = []
    for comment in ply.comments:
        match = _UP_COMMENT.fullmatch(comment)
        if match is None:
            continue
        direction = _parse_direction(match["value"], is_brush)
        if direction is not None:
            directions[comment] = direction
        elif match["mark"].strip():  # without a mark it is prose
            unknown.append(comment)
    first = next(iter(directions.values()), None)
    if first is None or any(float(first @ other) < 0.999 for other in directions.values()):
        return PlyView(None, "", (*directions, *unknown), camera)
    return PlyView(first, next(iter(directions)), tuple(unknown), camera)


def _parse_direction(text: str, is_brush: bool) -> Tensor | None:
    """Parse a direction such as "z", "-y", "y-up" or "0 -1 0"; None for other text. [3] unit length"""
    text = text.strip()
    axis = _AXIS.fullmatch(text)
    if axis is not None:
        is_negative = axis["sign"] == "-" or (is_brush and not axis["sign"] and axis["axis"] in "yYzZ")
        direction = torch.zeros(3)
        direction["xyz".index(axis["axis"].lower())] = -1.0 if is_negative else 1.0
        return direction
    numbers = [number for number in re.split(r"[,\s\[\]()]+", text) if number]
    try:
        x, y, z = (float(number) for number in numbers)
    except ValueError:
        return None
    length = math.hypot(x, y, z)
    if not 1e-6 < length < 1e6:
        return None
    return torch.tensor([x / length, y / length, z / length], dtype=torch.float32)


def _stored_camera(ply: PlyFile) -> Camera | None:
    """Return the camera of SHARP's elements in float64, in the world; None if they form no camera."""
    numbers = {name: _numbers(ply, name, rows) for name, rows in CAMERA_ELEMENTS.items()}
    extrinsic, intrinsic, size = (numbers[name] for name in CAMERA_ELEMENTS)
    if extrinsic is None or intrinsic is None or size is None:
        return None
    viewmat = torch.tensor(extrinsic, dtype=torch.float64).reshape(4, 4)
    K = torch.tensor(intrinsic, dtype=torch.float64).reshape(3, 3)
    width, height = size
    rotation = viewmat[:3, :3]
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    is_rigid = error < ROTATION_TOLERANCE and float(torch.linalg.det(rotation)) > 0
    is_rigid &= viewmat[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    is_pinhole = float(K[0, 0]) > 0 and float(K[1, 1]) > 0 and K[2].tolist() == [0.0, 0.0, 1.0]
    is_pinhole &= float(K[0, 1]) == float(K[1, 0]) == 0.0
    has_size = all(1 <= side <= LARGEST_SIDE and side == int(side) for side in size)
    if not (is_rigid and is_pinhole and has_size):
        return None
    try:
        return Camera(viewmat, K.float(), int(width), int(height), ply.path.stem)
    except ValueError:
        return None


def _numbers(ply: PlyFile, name: str, rows: int) -> Sequence[float] | None:
    """Return the numbers of an element whose only property has the same name; None for any other element."""
    if ply.counts.get(name) != rows or list(ply.columns(name)) != [name]:
        return None
    try:
        (table,), _ = ply.rows(name)
    except ProgdfError:  # the element is optional, and the Gaussians may be readable without it
        return None
    numbers = np.asarray(table[name], np.float64)
    return numbers.tolist() if bool(np.isfinite(numbers).all()) else None


def has_linear_colors(ply: PlyFile) -> bool:
    """Return whether SHARP's `color_space` declares linear RGB colors.

    Raises:
        ProgdfError: the value is neither sRGB (0) nor linear RGB (1).
    """
    if "color_space" not in ply.counts:
        return False
    numbers = _numbers(ply, "color_space", 1)
    if numbers is None or numbers[0] not in (0.0, 1.0):
        found = "of an unknown form" if numbers is None else f"{numbers[0]:g}"
        remedy = "convert the colors to sRGB and write 0, or leave the element out"
        raise unsupported_error(ply.path, f"'color_space' {found} (0 is sRGB, 1 is linear RGB)", remedy)
    return numbers[0] == 1.0


def check_frames(ply: PlyFile) -> None:
    """Refuse a file that holds several frames of a moving scene.

    Raises:
        ProgdfError: SHARP's `frame` counts more than one frame.
    """
    numbers = _numbers(ply, "frame", 2)
    if numbers is not None and numbers[0] > 1:
        feature = f"'frame' ({numbers[0]:g} frames of {numbers[1]:g} Gaussians in one file)"
        raise unsupported_error(ply.path, feature, "write each frame to a .ply of its own")
