"""Cameras as files: Inria cameras.json, nerfstudio transforms.json, our own JSON, recognized by content; and
folders: a COLMAP sparse model, or a folder with one of these files in it.
"""

from __future__ import annotations

import json
import logging
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.lens import Lens

from .atomic import atomic_write, check_regular, open_error
from .colmap import find_model, load_model
from .json_values import angle_at, decode_json, matrix_at, number_at, pixels_at, table_at

_log = logging.getLogger(__name__)

_FORMAT = "progdf cameras 1"
_NOT_A_ROTATION = 1e-2
_LENS = ("k1", "k2", "p1", "p2", "k3")
_STRANGE_LENS = ("k4", "k5", "k6")  # a polynomial to some programs, a quotient to others: not guessed
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

_FILES = ("cameras.json", "transforms.json")
_MODEL_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
_IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")


def load_cameras(path: str | os.PathLike[str]) -> list[Camera]:
    """The cameras in a JSON file, in file order, or of a COLMAP sparse model, in the order of their names.

    Three kinds of files are known: Inria `cameras.json` (a list with rotation, position, fx, fy), nerfstudio
    `transforms.json` (frames with an OpenGL camera-to-world matrix; intrinsics per file or per frame) and
    what `save_cameras` writes, also a single such camera. A folder is a sparse model (see `progdf.io.colmap`)
    or holds one, or a cameras.json or transforms.json.

    The views are those of pinholes. A lens that bends photographs is kept as `Camera.lens` and logged.

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
    return cameras


def read_camera(text: str) -> Camera:
    """The camera of `FILE[:INDEX]`, the first one where no index is given; −1 is the last.

    Raises:
        ProgdfError: the file is missing or holds no cameras, or not that many.
    """
    name, colon, index = text.rpartition(":")
    numbered = re.fullmatch(r"-?[0-9]{1,18}", index) is not None and bool(colon) and not os.path.exists(text)
    path, number = (name, int(index)) if numbered else (text, 0)
    cameras = load_cameras(path)
    if not -len(cameras) <= number < len(cameras):
        last = len(cameras) - 1
        raise ProgdfError(f"{path} has no camera {number}; it holds {len(cameras)}, numbered 0 to {last}")
    return cameras[number]


def _from_folder(folder: Path) -> list[Camera]:
    """The one thing in a folder that holds cameras."""
    found = [folder / name for name in _FILES if (folder / name).is_file()]
    model = find_model(folder)
    if model is not None:
        found.append(model)
    if not found:
        raise ProgdfError(
            f"{folder} holds no cameras; give a COLMAP model (cameras.bin and images.bin, also in sparse/0), "
            "a cameras.json or a transforms.json"
        )
    if len(found) > 1:
        raise ProgdfError(
            f"{folder} holds cameras in {' and in '.join(str(place) for place in found)}; "
            "name the ones that belong to the scene"
        )
    return load_model(found[0]) if found[0] == model else _from_file(found[0])


def _from_file(path: str | os.PathLike[str]) -> list[Camera]:
    name = os.fspath(path)
    if Path(path).name in _MODEL_FILES and (model := find_model(Path(path).parent)):
        return load_model(model)
    check_regular(path)
    try:
        content = decode_json(Path(path).read_bytes())
    except OSError as error:
        raise open_error(path, error) from None
    except ValueError as error:
        raise ProgdfError(
            f"{name} is not JSON ({error}); give a cameras.json, a transforms.json or a file of saved cameras"
        ) from None
    match content:
        case {"frames": list() as frames}:
            return [_nerfstudio(name, i, content, frame, Path(path)) for i, frame in enumerate(frames)]
        case {"cameras": list() as entries}:
            return [_own(name, i, entry) for i, entry in enumerate(entries)]
        case {"viewmat": _}:
            return [_own(name, 0, content)]
        case [{"viewmat": _}, *_]:
            return [_own(name, i, entry) for i, entry in enumerate(content)]
        case [{"rotation": _, "position": _}, *_]:
            return [_inria(name, i, entry) for i, entry in enumerate(content)]
        case []:
            return []
    raise ProgdfError(
        f"{name} holds no cameras; give a cameras.json, a transforms.json or a file of saved cameras"
    )


def kind_of_cameras(path: str | os.PathLike[str]) -> str:
    """ "own" for a file that `save_cameras` wrote, "other" for anything else."""
    check_regular(path)
    try:
        content = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise open_error(path, error) from None
    except (ValueError, RecursionError):
        return "other"
    return "own" if isinstance(content, dict) and content.get("format") == _FORMAT else "other"


def save_cameras(path: str | os.PathLike[str], cameras: Sequence[Camera]) -> None:
    """Write cameras as JSON, whole or not at all; `load_cameras` gives the same bits back."""
    entries = [
        {
            "name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.double().tolist(),
            "viewmat": camera.viewmat.double().tolist(),
            **({"lens": asdict(camera.lens)} if camera.lens else {}),
        }
        for camera in cameras
    ]
    with atomic_write(path) as temporary_file:
        temporary_file.write_text(
            json.dumps({"format": _FORMAT, "cameras": entries}, indent=1), encoding="utf-8"
        )


def _own(file: str, index: int, entry: object) -> Camera:
    where = f"camera {index} of {file}"
    table = table_at(where, entry)
    return _camera(
        where,
        _rigid(where, matrix_at(where, table, "viewmat", (4,), 4)),
        matrix_at(where, table, "K", (3,), 3),
        pixels_at(where, table, "width"),
        pixels_at(where, table, "height"),
        str(table.get("name", "")),
        _lens(where, table_at(where, table.get("lens", {}))),
    )


def _inria(file: str, index: int, entry: object) -> Camera:
    """`rotation` and `position` are camera to world, OpenCV axes; the principal point is the center."""
    where = f"camera {index} of {file}"
    table = table_at(where, entry)
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = matrix_at(where, table, "rotation", (3,), 3)
    position = table.get("position")
    c2w[:3, 3] = matrix_at(where, {"position": [position]}, "position", (1,), 3)[0]
    width, height = pixels_at(where, table, "width"), pixels_at(where, table, "height")
    K = _intrinsics(number_at(where, table, "fx"), number_at(where, table, "fy"), 0.5 * width, 0.5 * height)
    return _camera(where, _world_to_camera(where, c2w), K, width, height, str(table.get("img_name", "")))


def _nerfstudio(file: str, index: int, shared: Mapping[str, Any], frame: object, path: Path) -> Camera:
    """Intrinsics of the frame go before those of the file; axes are OpenGL's (y up, z backwards)."""
    where = f"frame {index} of {file}"
    table = {**shared, **table_at(where, frame)}
    model = str(table.get("camera_model", "")).upper()
    if model not in _PINHOLES:
        raise ProgdfError(
            f"{where} has the camera model {model}; only pinhole cameras can be used: undistort first"
        )
    width, height = _image_size(where, table, path)
    if "fl_x" in table or "fl_y" in table:
        focal_x = number_at(where, table, "fl_x" if "fl_x" in table else "fl_y")
        focal_y = number_at(where, table, "fl_y" if "fl_y" in table else "fl_x")
    else:
        angles = [
            0.5 * side / math.tan(0.5 * angle_at(where, table, key))
            for key, side in (("camera_angle_x", width), ("camera_angle_y", height))
            if key in table
        ]
        if not angles:
            raise ProgdfError(f"{where} has no focal length; expected fl_x, fl_y or camera_angle_x")
        focal_x, focal_y = angles[0], angles[-1]
    cx = number_at(where, table, "cx") if "cx" in table else 0.5 * width
    cy = number_at(where, table, "cy") if "cy" in table else 0.5 * height
    c2w = matrix_at(where, table, "transform_matrix", (3, 4), 4)
    c2w = torch.cat([c2w[:3], torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)])
    c2w[:, 1:3] *= -1  # OpenGL -> OpenCV
    K = _intrinsics(focal_x, focal_y, cx, cy)
    viewmat, name = _world_to_camera(where, c2w), str(table.get("file_path", ""))
    return _camera(where, viewmat, K, width, height, name, _lens(where, table))


def _lens(where: str, table: Mapping[str, Any]) -> Lens | None:
    """The lens, if it bends anything."""
    strange = [key for key in _STRANGE_LENS if key in table and number_at(where, table, key) != 0]
    if strange:
        raise ProgdfError(
            f"{where} has lens distortion with {', '.join(strange)}, which programs read in different ways; "
            "undistort the images and give the new file"
        )
    lens = Lens(**{key: number_at(where, table, key) for key in _LENS if key in table})
    return lens or None


def _image_size(where: str, table: Mapping[str, Any], path: Path) -> tuple[int, int]:
    """From the file, else from the picture it names (synthetic NeRF scenes have no w and h)."""
    if "w" in table and "h" in table:
        return pixels_at(where, table, "w"), pixels_at(where, table, "h")
    from .images import picture_size  # Pillow, which files with sizes do without

    for suffix in _IMAGE_SUFFIXES:
        picture = path.parent / (str(table.get("file_path", "")) + suffix)
        if os.path.isfile(picture):  # pathlib's raises where a name is too long
            try:
                return picture_size(picture)
            except ProgdfError:
                raise ProgdfError(
                    f"{picture}, which {where} names, is not an image; repair or replace it"
                ) from None
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
    where: str, viewmat: Tensor, K: Tensor, width: int, height: int, name: str, lens: Lens | None = None
) -> Camera:
    try:
        return Camera(viewmat.float(), K.float(), width, height, name, lens)
    except ValueError as error:
        raise ProgdfError(f"{where} is broken: {error}") from None


def _intrinsics(fx: float, fy: float, cx: float, cy: float) -> Tensor:
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
