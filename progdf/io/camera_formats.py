"""Cameras as the formats describe them: our own entries, Inria's and nerfstudio's. All are read, checked and
turned into `Camera`s of the world here, in float64; `cameras` knows the files.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import torch
from torch import Tensor

from progdf.camera import Camera, Lens
from progdf.errors import ProgdfError

from .json_values import convert_json

_T = TypeVar("_T")

_NOT_A_ROTATION = 1e-2
_PINHOLES = (
    "",
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "OPENCV",
    "RADIAL",
    "SIMPLE_RADIAL",
    "FULL_OPENCV",
    "PERSPECTIVE",
)
"""Camera models that are a pinhole behind a lens whose numbers we know."""

_IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")

_Number = Annotated[float, msgspec.Meta(gt=-3e38, lt=3e38)]  # finite in float32
_Pixels = Annotated[float, msgspec.Meta(ge=1, le=1_000_000, multiple_of=1)]
_Angle = Annotated[float, msgspec.Meta(gt=0, lt=math.pi)]
_Row3 = tuple[_Number, _Number, _Number]
_Row4 = tuple[_Number, _Number, _Number, _Number]
_Matrix3 = tuple[_Row3, _Row3, _Row3]


class _Own(msgspec.Struct):
    """A camera that `save_cameras` wrote."""

    viewmat: tuple[_Row4, _Row4, _Row4, _Row4]
    K: _Matrix3
    width: _Pixels
    height: _Pixels
    name: Any = ""
    lens: Lens = Lens()


class _Inria(msgspec.Struct):
    """A camera of Inria's cameras.json."""

    rotation: _Matrix3
    position: _Row3
    fx: _Number
    fy: _Number
    width: _Pixels
    height: _Pixels
    img_name: Any = ""


class _Frame(msgspec.Struct):
    """A frame of nerfstudio's transforms.json, with what it has of the file."""

    transform_matrix: Annotated[list[_Row4], msgspec.Meta(min_length=3, max_length=4)]
    w: _Pixels | None = None
    h: _Pixels | None = None
    fl_x: _Number | None = None
    fl_y: _Number | None = None
    cx: _Number | None = None
    cy: _Number | None = None
    camera_angle_x: _Angle | None = None
    camera_angle_y: _Angle | None = None
    k4: _Number = 0.0  # k4, k5 and k6: a polynomial to some programs, a quotient to others, so not guessed
    k5: _Number = 0.0
    k6: _Number = 0.0
    camera_model: Any = ""
    file_path: Any = ""


def _read(where: str, entry: object, kind: type[_T]) -> _T:
    try:
        return convert_json(entry, kind)
    except ValueError as error:
        raise ProgdfError(f"{where} cannot be used: {error}; export the cameras again") from None


def own_camera(file: str, index: int, entry: object) -> Camera:
    """An entry that `save_cameras` wrote."""
    where = f"camera {index} of {file}"
    found = _read(where, entry, _Own)
    viewmat = _rigid(where, torch.tensor(found.viewmat, dtype=torch.float64))
    K = torch.tensor(found.K, dtype=torch.float64)
    return _camera(where, viewmat, K, found.width, found.height, found.name, found.lens or None)


def inria_camera(file: str, index: int, entry: object) -> Camera:
    """`rotation` and `position` are camera to world, OpenCV axes; the principal point is the center."""
    where = f"camera {index} of {file}"
    found = _read(where, entry, _Inria)
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = torch.tensor(found.rotation, dtype=torch.float64)
    c2w[:3, 3] = torch.tensor(found.position, dtype=torch.float64)
    width, height = found.width, found.height
    K = _intrinsics(found.fx, found.fy, 0.5 * width, 0.5 * height)
    return _camera(where, _world_to_camera(where, c2w), K, width, height, found.img_name)


def nerfstudio_camera(file: str, index: int, shared: Mapping[str, Any], entry: object, path: Path) -> Camera:
    """Intrinsics of the frame go before those of the file; axes are OpenGL's (y up, z backwards)."""
    where = f"frame {index} of {file}"
    table = {**shared, **entry} if isinstance(entry, dict) else entry
    frame, lens = _read(where, table, _Frame), _read(where, table, Lens)
    model = str(frame.camera_model).upper()
    if model not in _PINHOLES:
        raise ProgdfError(
            f"{where} has the camera model {model}; only pinhole cameras can be used: undistort first"
        )
    if frame.k4 or frame.k5 or frame.k6:
        raise ProgdfError(
            f"{where} has lens distortion with k4, k5 or k6, which programs read in different ways; "
            "undistort the images and give the new file"
        )
    width, height = _image_size(where, frame, path)
    focal = [length for length in (frame.fl_x, frame.fl_y) if length is not None] or [
        0.5 * side / math.tan(0.5 * angle)
        for angle, side in ((frame.camera_angle_x, width), (frame.camera_angle_y, height))
        if angle is not None
    ]
    if not focal:
        raise ProgdfError(f"{where} has no focal length; expected fl_x, fl_y or camera_angle_x")
    cx = 0.5 * width if frame.cx is None else frame.cx
    cy = 0.5 * height if frame.cy is None else frame.cy
    c2w = torch.tensor([*frame.transform_matrix[:3], (0.0, 0.0, 0.0, 1.0)], dtype=torch.float64)
    c2w[:, 1:3] *= -1  # OpenGL -> OpenCV
    K = _intrinsics(focal[0], focal[-1], cx, cy)
    return _camera(where, _world_to_camera(where, c2w), K, width, height, frame.file_path, lens or None)


def _image_size(where: str, frame: _Frame, path: Path) -> tuple[float, float]:
    """From the file, else from the picture it names (synthetic NeRF scenes have no w and h)."""
    if frame.w is not None and frame.h is not None:
        return frame.w, frame.h
    from .images import picture_size  # Pillow, which files with sizes do without

    for suffix in _IMAGE_SUFFIXES:
        picture = path.parent / (str(frame.file_path) + suffix)
        if os.path.isfile(picture):  # pathlib's raises where a name is too long
            try:
                return picture_size(picture, calibrated=True)
            except ProgdfError as error:
                raise ProgdfError(f"{where} has no image size, and {error}") from None
    raise ProgdfError(f"{where} has no image size; expected w and h")


def _world_to_camera(where: str, c2w: Tensor) -> Tensor:
    viewmat: Tensor = torch.linalg.inv(_rigid(where, c2w))
    return viewmat


def _rigid(where: str, matrix: Tensor) -> Tensor:
    """The matrix, if it turns and moves and does nothing else. [4,4]"""
    rotation = matrix[:3, :3]
    error = float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max())
    last = matrix[3].tolist() == [0, 0, 0, 1]
    if not last or not error < _NOT_A_ROTATION or float(torch.det(rotation)) < 0:
        raise ProgdfError(
            f"{where} has a matrix that is not a rotation and a translation; export the cameras again"
        )
    return matrix


def _camera(
    where: str,
    viewmat: Tensor,
    K: Tensor,
    width: float,
    height: float,
    name: object,
    lens: Lens | None = None,
) -> Camera:
    try:
        return Camera(viewmat, K.float(), int(width), int(height), str(name), lens)
    except ValueError as error:
        raise ProgdfError(f"{where} is broken: {error}") from None


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
