"""Cameras from entries of a JSON file: our own format, Inria's cameras.json, nerfstudio's transforms.json.

Each reader returns a float64 camera in the world and the fields that it ignores. Fields that change the
camera are used or refused; `_REFUSED_FIELDS` lists the refused ones.
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

from progdf.camera import Camera, Lens, rigid_fault
from progdf.errors import ProgdfError

from .file_rules import check_fields, unsupported_error
from .json_values import convert_json
from .picture_files import find_picture

_T = TypeVar("_T")

REMEDY = "undistort the pictures to pinhole cameras, for instance with `colmap image_undistorter`"

PINHOLE_MODELS = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "FULL_OPENCV",
    "PERSPECTIVE",
)
"""Names of camera models that are pinholes with lens distortion k1, k2, k3, p1 and p2."""

_REFUSED_FIELDS = {
    "is_fisheye": "a fisheye lens",
    "fisheye": "a fisheye lens",
    "ftheta_p0": "an f-theta lens",
    "ftheta_p1": "an f-theta lens",
    "ftheta_p2": "an f-theta lens",
    "ftheta_p3": "an f-theta lens",
    "ftheta_p4": "an f-theta lens",
    "omega": "the lens of the camera model FOV",
    "xi": "an omnidirectional lens",
    "distortion_params": "a list of lens distortion; k1, k2, k3, p1 and p2 are read",
    "k4": "lens distortion that programs read in different ways",
    "k5": "lens distortion that programs read in different ways",
    "k6": "lens distortion that programs read in different ways",
    "p3": "tangential distortion of higher order",
    "p4": "tangential distortion of higher order",
    "s1": "a thin prism",
    "s2": "a thin prism",
    "s3": "a thin prism",
    "s4": "a thin prism",
    "b1": "oblique pixel axes",
    "b2": "oblique pixel axes",
    "skew": "oblique pixel axes",
    "equirectangular": "a panorama",
    "latlong": "a panorama",
    "orthographic": "a camera without perspective",
    "rolling_shutter": "a pose for each row of the picture",
    "transform_matrix_start": "a pose that moves during the exposure",
    "transform_matrix_end": "a pose that moves during the exposure",
}
"""Unsupported fields that change a camera → their meaning. Zero or false switches them off."""

_NERFSTUDIO_REFUSED = {
    **_REFUSED_FIELDS,
    "intrinsic_matrix": "intrinsics of NeuS2; fl_x, fl_y, cx and cy are read",
    "from_na": "the axes of NeuS2",
}
_NERFSTUDIO_HONORED = frozenset(
    ("frames", "transform_matrix", "file_path", "w", "h", "fl_x", "fl_y", "camera_angle_x", "camera_angle_y",
     "x_fov", "y_fov", "cx", "cy", "k1", "k2", "k3", "p1", "p2", "camera_model", "camera_type",
     "applied_transform", "applied_scale")
)  # fmt: skip

_INRIA_REFUSED = {
    **_REFUSED_FIELDS,
    "trans": "a translation of the world",
    "scale": "a scale of the world",
}
_INRIA_HONORED = frozenset(
    ("id", "img_name", "width", "height", "position", "rotation", "fx", "fy", "FoVx", "FoVy", "cx", "cy",
     "k1", "k2", "k3", "p1", "p2", "camera_model", "camera_type")
)  # fmt: skip

_MAX_REPAIR = 1e-2  # largest deviation of R Rᵀ from I that counts as rounding and is repaired

_Number = Annotated[float, msgspec.Meta(gt=-3e38, lt=3e38)]  # finite in float32
_Pixels = Annotated[float, msgspec.Meta(ge=1, le=1_000_000, multiple_of=1)]
_Angle = Annotated[float, msgspec.Meta(gt=0, lt=math.pi)]
_Degrees = Annotated[float, msgspec.Meta(gt=0, lt=180)]
_Row3 = tuple[_Number, _Number, _Number]
_Row4 = tuple[_Number, _Number, _Number, _Number]
_Matrix3 = tuple[_Row3, _Row3, _Row3]


class _SavedCamera(msgspec.Struct):
    """Camera entry written by `save_cameras`."""

    viewmat: tuple[_Row4, _Row4, _Row4, _Row4]
    K: _Matrix3
    width: _Pixels
    height: _Pixels
    name: Any = ""
    lens: Lens = Lens()
    sampling: _Number = 1.0


class _InriaCamera(msgspec.Struct):
    """Camera entry of Inria's cameras.json, with fields that other writers add."""

    rotation: _Matrix3
    position: _Row3
    width: _Pixels
    height: _Pixels
    fx: _Number | None = None
    fy: _Number | None = None
    cx: _Number | None = None
    cy: _Number | None = None
    FoVx: _Angle | None = None  # radians
    FoVy: _Angle | None = None  # radians
    camera_model: Any = ""
    camera_type: Any = ""
    img_name: Any = ""


class _FocalLength(msgspec.Struct):
    """Focal length fields of transforms.json, of a frame or of the file."""

    fl_x: _Number | None = None
    fl_y: _Number | None = None
    camera_angle_x: _Angle | None = None  # radians
    camera_angle_y: _Angle | None = None  # radians
    x_fov: _Degrees | None = None
    y_fov: _Degrees | None = None


class _Frame(msgspec.Struct):
    """Frame of transforms.json, with the fields that it inherits from the file."""

    transform_matrix: Annotated[list[_Row4], msgspec.Meta(min_length=3, max_length=4)]
    w: _Pixels | None = None
    h: _Pixels | None = None
    cx: _Number | None = None
    cy: _Number | None = None
    camera_model: Any = ""
    camera_type: Any = ""
    file_path: Any = ""


def read_own_camera(file: str, index: int, entry: object) -> tuple[Camera, tuple[str, ...]]:
    """Return the camera of an entry written by `save_cameras`, and its ignored fields."""
    where = f"camera {index} of {file}"
    ignored = _check_fields(where, entry, frozenset(_SavedCamera.__struct_fields__), _REFUSED_FIELDS)
    camera = _read(where, entry, _SavedCamera)
    viewmat = make_rigid(where, torch.tensor(camera.viewmat, dtype=torch.float64))
    K = torch.tensor(camera.K, dtype=torch.float64)
    size = camera.width, camera.height
    lens = camera.lens or None
    return make_camera(where, viewmat, K, size, str(camera.name), lens, camera.sampling), ignored


def read_inria_camera(file: str, index: int, entry: object) -> tuple[Camera, tuple[str, ...]]:
    """Return the camera of an entry in Inria's cameras.json, and its ignored fields.

    `rotation` and `position` are camera to world, OpenCV axes. Without cx and cy the principal point is the
    image center.
    """
    where = f"camera {index} of {file}"
    ignored = _check_fields(where, entry, _INRIA_HONORED, _INRIA_REFUSED, switched_off={"scale": 1})
    camera = _read(where, entry, _InriaCamera)
    lens = _read(where, entry, Lens)
    _check_model(where, camera.camera_model, camera.camera_type)
    size = camera.width, camera.height
    lengths = [camera.fx, camera.fy]
    angles = [camera.FoVx, camera.FoVy]
    focal = _focal_lengths(size, lengths, angles)
    if focal is None:
        raise ProgdfError(f"{where} has no focal length; expected fx and fy")
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = torch.tensor(camera.rotation, dtype=torch.float64)
    c2w[:3, 3] = torch.tensor(camera.position, dtype=torch.float64)
    viewmat = torch.linalg.inv(make_rigid(where, c2w))
    K = make_intrinsics(*focal, *_principal_point(size, camera.cx, camera.cy))
    return make_camera(where, viewmat, K, size, portable_name(camera.img_name), lens or None), ignored


def read_nerfstudio_camera(
    file: str, index: int, shared: Mapping[str, Any], entry: object, path: Path
) -> tuple[Camera, tuple[str, ...]]:
    """Return the camera of a frame in transforms.json, and the ignored fields of the frame and the file.

    Fields of the frame override those of the file. The axes are OpenGL's (y up, z backwards).

    Args:
        file: name of the file for messages
        index: number of the frame
        shared: fields of the file
        entry: the frame
        path: path of the file; `file_path` is relative to its folder
    """
    where = f"frame {index} of {file}"
    table = {**shared, **entry} if isinstance(entry, dict) else entry
    ignored = _check_fields(where, table, _NERFSTUDIO_HONORED, _NERFSTUDIO_REFUSED)
    frame = _read(where, table, _Frame)
    lens = _read(where, table, Lens)
    _check_model(where, frame.camera_model, frame.camera_type)
    name = portable_name(frame.file_path)
    size = _image_size(where, frame, path.parent, name)
    focal = _stated_focal(where, size, entry) or _stated_focal(where, size, shared)
    if focal is None:
        raise ProgdfError(f"{where} has no focal length; expected fl_x, fl_y or camera_angle_x")
    c2w = torch.tensor([*frame.transform_matrix[:3], (0.0, 0.0, 0.0, 1.0)], dtype=torch.float64)
    c2w[:, 1:3] *= -1  # OpenGL -> OpenCV
    viewmat = torch.linalg.inv(make_rigid(where, c2w))
    K = make_intrinsics(*focal, *_principal_point(size, frame.cx, frame.cy))
    return make_camera(where, viewmat, K, size, name, lens or None), ignored


class _AppliedTransform(msgspec.Struct):
    """Transform from the dataset's world to the coordinate frame of a transforms.json."""

    applied_transform: Annotated[list[_Row4], msgspec.Meta(min_length=3, max_length=4)] | None = None
    applied_scale: Annotated[float, msgspec.Meta(gt=0, lt=3e38)] = 1.0


def read_applied_transform(file: str, content: object) -> Tensor:
    """Return the similarity from the dataset's world to the world of a transforms.json. [4,4] float64"""
    applied = _read(file, content, _AppliedTransform)
    matrix = torch.eye(4, dtype=torch.float64)
    if applied.applied_transform is not None:
        matrix[:3] = torch.tensor(applied.applied_transform[:3], dtype=torch.float64)
    matrix = make_rigid(f"applied_transform of {file}", matrix).clone()
    matrix[:3] *= applied.applied_scale
    return matrix


def _read(where: str, entry: object, kind: type[_T]) -> _T:
    try:
        return convert_json(entry, kind)
    except ValueError as error:
        raise ProgdfError(f"{where} cannot be used: {error}; export the cameras again") from None


def _check_fields(
    where: str,
    entry: object,
    honored: frozenset[str],
    refused: Mapping[str, str],
    switched_off: Mapping[str, object] | None = None,
) -> tuple[str, ...]:
    """Return the ignored fields; raise ProgdfError for a refused field that is not switched off.

    Args:
        where: the entry, for errors
        entry: decoded JSON
        honored: fields that the reader uses
        refused: see `check_fields`
        switched_off: values that make a refused field harmless, besides zero, false and empty values
    """
    if not isinstance(entry, dict):
        return ()
    off = switched_off or {}
    present = [
        name
        for name, value in entry.items()
        if not (name in refused and (_is_off(value) or (name in off and off[name] == value)))
    ]
    return check_fields(where, present, honored, refused, REMEDY)


def _is_off(value: object) -> bool:
    """Return whether a field has no effect: it is zero, false, empty, or a list of such values."""
    return all(map(_is_off, value)) if isinstance(value, list) else not value


def _check_model(where: str, *models: object) -> None:
    for model in models:
        if model and str(model).upper() not in PINHOLE_MODELS:
            raise unsupported_error(where, f"the camera model {model}", REMEDY)


def portable_name(name: object) -> str:
    """Return a picture's name with forward slashes. Windows programs write backslashes."""
    return str(name).replace("\\", "/")


def _stated_focal(where: str, size: tuple[float, float], entry: object) -> tuple[float, float] | None:
    """Return the focal lengths stated in a frame or in the file, pixels; None if it states none."""
    stated = _read(where, entry, _FocalLength)
    degrees = [None if angle is None else math.radians(angle) for angle in (stated.x_fov, stated.y_fov)]
    angles = [stated.camera_angle_x, stated.camera_angle_y]
    lengths = [stated.fl_x, stated.fl_y]
    return _focal_lengths(size, lengths, angles) or _focal_lengths(size, [], degrees)


def _focal_lengths(
    size: tuple[float, float], lengths: list[float | None], angles: list[float | None]
) -> tuple[float, float] | None:
    """Return both focal lengths in pixels. A missing one equals the other (square pixels).

    Args:
        size: image width and height, pixels
        lengths: focal lengths along x and y, pixels
        angles: fields of view along x and y, radians; used if no length is given
    """
    known = [length for length in lengths if length is not None]
    if not known:
        known = [
            0.5 * side / math.tan(0.5 * angle)
            for side, angle in zip(size, angles, strict=True)
            if angle is not None
        ]
    return (known[0], known[-1]) if known else None


def _principal_point(size: tuple[float, float], cx: float | None, cy: float | None) -> tuple[float, float]:
    return (0.5 * size[0] if cx is None else cx, 0.5 * size[1] if cy is None else cy)


def _image_size(where: str, frame: _Frame, folder: Path, name: str) -> tuple[float, float]:
    """Return the stated image size, otherwise the picture's (synthetic NeRF scenes have no w and h)."""
    if frame.w is not None and frame.h is not None:
        return frame.w, frame.h
    from .images import picture_size  # imports Pillow, which is not needed if the size is stated

    picture: Path | None = folder / name
    try:
        if not os.path.isfile(folder / name):  # Path.is_file raises for a name that is too long
            picture = find_picture(folder, name)
        if picture is not None:
            return picture_size(picture, calibrated=True)
    except ProgdfError as error:
        raise ProgdfError(f"{where} has no image size, and {error}") from None
    raise ProgdfError(f"{where} has no image size; expected w and h")


def make_rigid(where: str, matrix: Tensor) -> Tensor:
    """Check that a matrix is a rotation and a translation, and repair rounding errors. [4,4] -> [4,4]

    Raises:
        ProgdfError: the matrix scales, shears or mirrors.
    """
    if not rigid_fault(matrix):
        return matrix
    fault = rigid_fault(matrix, _MAX_REPAIR)
    if fault:
        raise ProgdfError(
            f"{where} has a matrix that is not a rotation and a translation: it {fault}; "
            "export the cameras again"
        )
    left, _, right = torch.linalg.svd(matrix[:3, :3])
    repaired = matrix.clone()
    repaired[:3, :3] = left @ right  # the nearest rotation
    return repaired


def make_camera(
    where: str,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[float, float],
    name: str,
    lens: Lens | None = None,
    sampling: float = 1.0,
) -> Camera:
    """Return a float64 camera in the world; raise ProgdfError for invalid numbers."""
    width, height = map(int, size)
    try:
        return Camera(viewmat, K.float(), width, height, name, lens, sampling=sampling)
    except ValueError as error:
        raise ProgdfError(f"{where} is broken: {error}; export the cameras again") from None


def make_intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    """Return the intrinsic matrix K. [3,3] float64"""
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
