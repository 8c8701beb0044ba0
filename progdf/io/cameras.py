"""Cameras as files: Inria cameras.json, nerfstudio transforms.json, our own JSON, also in a picture, known by
their content; and folders: a COLMAP sparse model, or a folder with one of these files in it.

Files have cameras in the world; in the program they are relative to the origin of their scene, as its means
are (`Gaussians.origin`). All of them pass here on their way in and out.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
import torch
from torch import Tensor

from progdf.camera import Camera, Lens
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin

from .atomic import read_file, write_file
from .colmap import find_model, load_model
from .json_values import convert_json, decode_json
from .picture_files import find_picture, without_common_folder

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
    sampling: _Number = 1.0


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
    camera = _read(where, entry, _Own)
    viewmat = _rigid(where, torch.tensor(camera.viewmat, dtype=torch.float64))
    K = torch.tensor(camera.K, dtype=torch.float64)
    lens, sampling = camera.lens or None, camera.sampling
    return _camera(where, viewmat, K, camera.width, camera.height, camera.name, lens, sampling)


def inria_camera(file: str, index: int, entry: object) -> Camera:
    """`rotation` and `position` are camera to world, OpenCV axes; the principal point is the center."""
    where = f"camera {index} of {file}"
    camera = _read(where, entry, _Inria)
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = torch.tensor(camera.rotation, dtype=torch.float64)
    c2w[:3, 3] = torch.tensor(camera.position, dtype=torch.float64)
    width, height = camera.width, camera.height
    K = _intrinsics(camera.fx, camera.fy, 0.5 * width, 0.5 * height)
    return _camera(where, torch.linalg.inv(_rigid(where, c2w)), K, width, height, camera.img_name)


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
    viewmat, K = torch.linalg.inv(_rigid(where, c2w)), _intrinsics(focal[0], focal[-1], cx, cy)
    return _camera(where, viewmat, K, width, height, frame.file_path, lens or None)


def _image_size(where: str, frame: _Frame, path: Path) -> tuple[float, float]:
    """From the file, else from the picture it names (synthetic NeRF scenes have no w and h)."""
    if frame.w is not None and frame.h is not None:
        return frame.w, frame.h
    from .images import picture_size  # Pillow, which files with sizes do without

    picture: Path | None = path.parent / str(frame.file_path)
    try:
        if not os.path.isfile(picture):  # pathlib's raises where a name is too long
            picture = find_picture(path.parent, str(frame.file_path))
        if picture is not None:
            return picture_size(picture, calibrated=True)
    except ProgdfError as error:
        raise ProgdfError(f"{where} has no image size, and {error}") from None
    raise ProgdfError(f"{where} has no image size; expected w and h")


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
    sampling: float = 1.0,
) -> Camera:
    try:
        return Camera(viewmat, K.float(), int(width), int(height), str(name), lens, sampling=sampling)
    except ValueError as error:
        raise ProgdfError(f"{where} is broken: {error}") from None


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)


_log = logging.getLogger(__name__)

_FORMAT = "progdf cameras 1"
PICTURE_KEY = "progdf:camera"
"""Of the text in a .png that holds the camera from which it was rendered."""
_LONGEST_TEXT = 1 << 16  # characters of one camera: a picture may claim megabytes
_PNG = b"\x89PNG\r\n"
_FILES = ("cameras.json", "transforms.json")
_MODEL_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")


def load_cameras(path: str | os.PathLike[str], origin: Origin = ZERO) -> list[Camera]:
    """The cameras in a JSON file, in file order, or of a COLMAP sparse model, in the order of their names.

    Three kinds of files are known: Inria `cameras.json` (a list with rotation, position, fx, fy), nerfstudio
    `transforms.json` (frames with an OpenGL camera-to-world matrix; intrinsics per file or per frame) and
    what `save_cameras` writes, also a single such camera, or one in a rendered picture. A folder is a sparse
    model (see `progdf.io.colmap`) or holds one, or a cameras.json or transforms.json.

    The views are those of pinholes. A lens that bends photographs is kept as `Camera.lens` and logged.

    Args:
        path: file or folder
        origin: of the scene, which the cameras are relative to; by default they are in the world

    Raises:
        ProgdfError: nothing of that name, none of these kinds, several of them in one folder, a broken
            camera, or one that is no pinhole behind a lens with k1, k2, k3, p1, p2 (fisheye, k4 and more).
    """
    cameras = _from_folder(Path(path)) if Path(path).is_dir() else _from_file(path)
    if not cameras:
        raise ProgdfError(f"{os.fspath(path)} holds no cameras; it needs at least one")
    if bent := sum(camera.lens is not None for camera in cameras):
        _log.info(
            "%s: %d of %d cameras have a lens that bends photographs; what is drawn is straight",
            path, bent, len(cameras),
        )  # fmt: skip
    return [_enter(camera, origin, os.fspath(path)) for camera in cameras]


def _enter(camera: Camera, origin: Origin, where: str) -> Camera:
    """A float64 camera of the world as the program has it: float32, relative to an origin."""
    viewmat = relative_viewmat(camera.viewmat, origin).float()
    if not bool(viewmat.isfinite().all()):
        raise ProgdfError(f"{where} has a camera too far away to be used; export the cameras again")
    return replace(camera, viewmat=viewmat)


def relative_viewmat(viewmat: Tensor, origin: Origin) -> Tensor:
    """World → camera as origin → camera: of coordinates that are `origin` less. [4,4] -> [4,4] float64"""
    moved = viewmat.double().clone()
    if origin != ZERO:  # -0.0 stays what it is
        moved[:3, 3] += moved[:3, :3] @ torch.tensor(origin, dtype=torch.float64)
    return moved


def read_camera(text: str, origin: Origin = ZERO) -> Camera:
    """The camera of `FILE[:INDEX]`, the first one where no index is given; −1 is the last.

    It is relative to `origin`, as of `load_cameras`, and sees pictures, whatever a training sampled there.

    Raises:
        ProgdfError: the file is missing or holds no cameras, or not that many.
    """
    name, colon, index = text.rpartition(":")
    numbered = re.fullmatch(r"-?[0-9]{1,18}", index) is not None and bool(colon) and not os.path.exists(text)
    path, number = (name, int(index)) if numbered else (text, 0)
    cameras = load_cameras(path, origin)
    if not -len(cameras) <= number < len(cameras):
        last = len(cameras) - 1
        raise ProgdfError(f"{path} has no camera {number}; it holds {len(cameras)}, numbered 0 to {last}")
    return replace(cameras[number], sampling=1.0)


def cameras_beside(path: Path, origin: Origin = ZERO) -> list[Camera]:
    """The cameras in a scene's folder or, of an Inria model's point_cloud/iteration_N, in the model's.

    They are relative to `origin`, as of `load_cameras`. None where there are none, or they cannot be told
    apart or read.
    """
    folder = path.resolve().parent
    if folder.name.startswith("iteration_") and folder.parent.name == "point_cloud":
        folder = folder.parent.parent
    try:
        return [_enter(camera, origin, os.fspath(folder)) for camera in _from_folder(folder)]
    except (ProgdfError, OSError):
        return []


def _from_folder(folder: Path) -> list[Camera]:
    """The one thing in a folder that holds cameras."""
    files = [folder / name for name in _FILES if (folder / name).is_file()]
    model = find_model(folder)
    if model is not None:
        files.append(model)
    if not files:
        raise ProgdfError(
            f"{folder} holds no cameras; give a COLMAP model (cameras.bin and images.bin, also in sparse/0), "
            "a cameras.json or a transforms.json"
        )
    if len(files) > 1:
        raise ProgdfError(
            f"{folder} holds cameras in {' and in '.join(str(file) for file in files)}; "
            "name the ones that belong to the scene"
        )
    return load_model(files[0]) if files[0] == model else _from_file(files[0])


def _from_file(path: str | os.PathLike[str]) -> list[Camera]:
    name = os.fspath(path)
    if Path(path).name in _MODEL_FILES and (model := find_model(Path(path).parent)):
        return load_model(model)
    data = read_file(path)
    if data.startswith(_PNG):
        camera = _carried_camera(path)
        if camera is None:
            raise ProgdfError(f"{name} carries no camera; give a picture that progdf render wrote")
        return [camera]
    try:
        content = decode_json(data)
    except ValueError as error:
        raise ProgdfError(
            f"{name} is not JSON ({error}); give a cameras.json, a transforms.json or a file of saved cameras"
        ) from None
    return _from_content(name, content, Path(path))


def camera_in_picture(path: str | os.PathLike[str], origin: Origin = ZERO) -> Camera | None:
    """The camera that a rendered picture carries, relative to `origin`; None for one that carries none.

    Raises:
        ProgdfError: no picture, or what it carries is no camera.
    """
    camera = _carried_camera(path)
    return None if camera is None else _enter(camera, origin, os.fspath(path))


def _carried_camera(path: str | os.PathLike[str]) -> Camera | None:
    """It in the world, in float64."""
    from .images import picture_text  # Pillow, which camera files do without

    text = picture_text(path, PICTURE_KEY)
    if text is None:
        return None
    where = f"the text {PICTURE_KEY} in {os.fspath(path)}"
    try:
        content = decode_json(text) if len(text) <= _LONGEST_TEXT else None
    except ValueError as error:
        raise ProgdfError(f"{where} is not JSON ({error}); render the picture again") from None
    match content:
        case {"format": format, "cameras": [entry]} if format == _FORMAT:
            return replace(own_camera(where, 0, entry), name=Path(path).stem)
    raise ProgdfError(f"{where} is not a camera; render the picture again")


def _from_content(name: str, content: Any, path: Path) -> list[Camera]:
    match content:
        case {"frames": list() as frames}:
            cameras = [nerfstudio_camera(name, i, content, frame, path) for i, frame in enumerate(frames)]
            names = without_common_folder([camera.name for camera in cameras])
            return [replace(camera, name=own) for camera, own in zip(cameras, names, strict=True)]
        case {"cameras": list() as entries}:
            return [own_camera(name, i, entry) for i, entry in enumerate(entries)]
        case {"viewmat": _}:
            return [own_camera(name, 0, content)]
        case [{"viewmat": _}, *_]:
            return [own_camera(name, i, entry) for i, entry in enumerate(content)]
        case [{"rotation": _, "position": _}, *_]:
            return [inria_camera(name, i, entry) for i, entry in enumerate(content)]
        case []:
            return []
    raise ProgdfError(
        f"{name} holds no cameras; give a cameras.json, a transforms.json or a file of saved cameras"
    )


def kind_of_cameras(path: str | os.PathLike[str]) -> str:
    """ "own" for a file that `save_cameras` wrote, "other" for anything else."""
    data = read_file(path)
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return "other"
    return "own" if isinstance(content, dict) and content.get("format") == _FORMAT else "other"


def save_cameras(path: str | os.PathLike[str], cameras: Sequence[Camera], origin: Origin = ZERO) -> None:
    """Write cameras as JSON, whole or not at all; `load_cameras` gives the same bits back.

    `origin`: of the scene, which the cameras are relative to; the file has them in the world.
    """
    write_file(path, cameras_to_json(cameras, 1, origin))


def cameras_to_json(cameras: Sequence[Camera], indent: int | None = None, origin: Origin = ZERO) -> str:
    """What a file of saved cameras holds, ASCII; see `save_cameras`."""
    x, y, z = origin
    entries = [
        {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.double().tolist(),
            "viewmat": relative_viewmat(camera.viewmat, (-x, -y, -z)).tolist(),
            **({"lens": asdict(camera.lens)} if camera.lens else {}),
            **({"sampling": camera.sampling} if camera.sampling != 1.0 else {}),
        }
        for camera in cameras
    ]
    return json.dumps({"format": _FORMAT, "cameras": entries}, indent=indent)
