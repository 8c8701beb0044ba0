"""Loading and saving of cameras, from files and folders.

Files are recognized by content: Inria cameras.json, nerfstudio transforms.json, our own JSON, also embedded
in a rendered picture. A folder is a COLMAP sparse model, or contains one of these files.

Files store cameras in the world. In the program, cameras are relative to the origin of their scene, as its
means are (`Gaussians.origin`). This module converts between the two.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError, check_first_argument
from progdf.gaussians import ZERO, Origin
from progdf.system.equality import equal_fields

from .atomic import read_file, write_file
from .camera_json import (
    read_applied_transform,
    read_inria_camera,
    read_nerfstudio_camera,
    read_own_camera,
)
from .colmap import ColmapModel, find_model, load_model, open_model
from .json_values import decode_json
from .picture_files import without_common_folder

_log = logging.getLogger(__name__)

_FORMAT = "progdf cameras 1"
PICTURE_KEY = "progdf:camera"
"""Key of the .png text chunk with the camera of the rendering."""
_MAX_CAMERA_TEXT = 1 << 16  # characters of an embedded camera; longer texts are refused
_PNG = b"\x89PNG\r\n"
_CAMERA_FILES = ("cameras.json", "transforms.json")
_MODEL_FILES = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")


@dataclass(frozen=True)
class CameraReport:
    """Notes collected while a camera file is read."""

    __eq__ = equal_fields

    notes: tuple[str, ...]  # one line each, such as the choice among several COLMAP models
    ignored: tuple[str, ...]  # fields of the file that are not read
    # transform from the world of the dataset to that of the file (`applied_transform` in transforms.json);
    # None: the cameras were saved by this program, in the frame of a scene. [4,4] float64
    dataset: Tensor | None = None


@dataclass(frozen=True)
class _Source:
    """Source of cameras: a file or a COLMAP model."""

    file: Path
    model: ColmapModel | None = None


def load_cameras(path: str | os.PathLike[str], origin: Origin = ZERO) -> list[Camera]:
    """Load the cameras of a JSON file in its order, or of a COLMAP model in the order of their names.

    Three file formats are supported. Inria `cameras.json` is a list with rotation, position, fx, fy.
    nerfstudio `transforms.json` has frames with an OpenGL camera-to-world matrix, and intrinsics per file or
    per frame. The third is the format of `save_cameras`, also for a single camera or inside a rendered
    picture. A folder is or contains a sparse model (see `progdf.io.colmap`), or contains a cameras.json or
    transforms.json.

    Cameras are pinholes. Lens distortion is stored in `Camera.lens` and logged. A choice among several COLMAP
    models is logged as a warning.

    Args:
        path: file or folder
        origin: origin of the scene; cameras are relative to it. By default they are in the world.

    Raises:
        ProgdfError: the path does not exist, has none of these formats, or is a folder with several of them.
            Or a camera is broken, or has a lens with more than k1, k2, k3, p1, p2 (fisheye, k4 and more).
    """
    check_first_argument("load_cameras(path)", path, (str, os.PathLike))
    cameras, report = load_cameras_with_report(path, origin)
    log_cameras(path, cameras, report)
    return cameras


def log_cameras(path: str | os.PathLike[str], cameras: Sequence[Camera], report: CameraReport) -> None:
    """Log the notes of a report as warnings, once per process, and the number of distorted cameras."""
    for note in report.notes:
        _warn_once(note)
    distorted_count = sum(camera.lens is not None for camera in cameras)
    if distorted_count:
        _log.info(
            "%s: %d of %d cameras have lens distortion; renderings are undistorted",
            path, distorted_count, len(cameras),
        )  # fmt: skip


def load_cameras_with_report(
    path: str | os.PathLike[str], origin: Origin = ZERO
) -> tuple[list[Camera], CameraReport]:
    """Load cameras as `load_cameras` does without logging, and return them with the report."""
    cameras, report = _read_source(_find_source(path))
    if not cameras:
        raise ProgdfError(f"{os.fspath(path)} holds no cameras; it needs at least one")
    return [_to_scene_frame(camera, origin, os.fspath(path)) for camera in cameras], report


def camera_files(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return the files that `load_cameras` reads cameras from, in a fixed order. Pictures are not included.

    Raises:
        ProgdfError: the folder has no cameras, or several kinds of them.
    """
    source = _find_source(path)
    return (source.file,) if source.model is None else source.model.files


def holds_cameras(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is a folder with cameras or a file of a COLMAP model. No other file is opened."""
    file = Path(path)
    if os.path.isdir(file):
        return bool(_sources_in(file))
    return _find_source(file).model is not None


@cache
def _warn_once(line: str) -> None:
    """Log a warning once per process: a training reads its cameras several times."""
    _log.warning("%s", line)


def _to_scene_frame(camera: Camera, origin: Origin, where: str) -> Camera:
    """Convert a float64 world camera to float32, relative to the origin of a scene."""
    viewmat = relative_viewmat(camera.viewmat, origin).float()
    if not bool(viewmat.isfinite().all()):
        raise ProgdfError(f"{where} has a camera too far away to be used; export the cameras again")
    return replace(camera, viewmat=viewmat)


def relative_viewmat(viewmat: Tensor, origin: Origin) -> Tensor:
    """Convert a world → camera matrix to one for coordinates relative to `origin`. [4,4] -> [4,4] float64"""
    relative = viewmat.double().clone()
    if origin != ZERO:  # adding zero would change −0.0
        relative[:3, 3] += relative[:3, :3] @ torch.tensor(origin, dtype=torch.float64)
    return relative


def read_camera(text: str, origin: Origin = ZERO) -> Camera:
    """Load one camera from `FILE[:INDEX]`: the first one without an index; −1 is the last.

    The camera is relative to `origin`, as in `load_cameras`. Its `sampling` is reset to 1, for full pictures.

    Raises:
        ProgdfError: the file is missing, has no cameras, or has no camera of that index.
    """
    name, colon, index = text.rpartition(":")
    has_index = re.fullmatch(r"-?[0-9]{1,18}", index) is not None and bool(colon) and not os.path.exists(text)
    path, number = (name, int(index)) if has_index else (text, 0)
    cameras = load_cameras(path, origin)
    if not -len(cameras) <= number < len(cameras):
        last = len(cameras) - 1
        raise ProgdfError(f"{path} has no camera {number}; it holds {len(cameras)}, numbered 0 to {last}")
    return replace(cameras[number], sampling=1.0)


def camera_search_folder(path: Path) -> Path:
    """Return the folder that may hold a scene's cameras: its own, or the model folder of an Inria run."""
    folder = path.resolve().parent
    if folder.name.startswith("iteration_") and folder.parent.name == "point_cloud":
        return folder.parent.parent
    return folder


def _find_source(path: str | os.PathLike[str]) -> _Source:
    """Return the file or model of a path. A file of a COLMAP model gives the model in the file's form."""
    file = Path(path)
    if os.path.isdir(file):
        return _search_folder(file)
    if file.name in _MODEL_FILES:
        return _Source(file, open_model(file.parent, file.suffix))
    return _Source(file)


def _search_folder(folder: Path) -> _Source:
    """Return the only source of cameras in a folder; raise ProgdfError for none or several."""
    sources = _sources_in(folder)
    if not sources:
        raise ProgdfError(
            f"{folder} holds no cameras; give a COLMAP model (cameras.bin and images.bin, also in sparse/0), "
            "a cameras.json or a transforms.json"
        )
    if len(sources) > 1:
        raise ProgdfError(
            f"{folder} holds cameras in {' and in '.join(str(source.file) for source in sources)}; "
            "name the ones that belong to the scene"
        )
    return sources[0]


def _sources_in(folder: Path) -> list[_Source]:
    sources = [_Source(folder / name) for name in _CAMERA_FILES if (folder / name).is_file()]
    model = find_model(folder)
    return sources if model is None else [*sources, _Source(model.folder, model)]


def _read_source(source: _Source) -> tuple[list[Camera], CameraReport]:
    """Read the float64 world cameras of a source, and the report."""
    if source.model is not None:
        notes = (source.model.note,) if source.model.note else ()
        return load_model(source.model), CameraReport(notes, (), torch.eye(4, dtype=torch.float64))
    path = source.file
    name = os.fspath(path)
    data = read_file(path)
    if data.startswith(_PNG):
        camera = _embedded_camera(path)
        if camera is None:
            raise ProgdfError(f"{name} has no stored camera; give a picture written by progdf render")
        return [camera], CameraReport((), ())
    try:
        content = decode_json(data)
    except ValueError as error:
        raise ProgdfError(
            f"{name} is not JSON ({error}); give a cameras.json, a transforms.json or a file of saved cameras"
        ) from None
    cameras, ignored = _from_content(name, content, path)
    return cameras, CameraReport((), ignored, _dataset_frame(name, content))


def _dataset_frame(name: str, content: Any) -> Tensor | None:
    """Return `CameraReport.dataset` of a camera file's JSON value."""
    match content:
        case {"frames": list()}:
            return read_applied_transform(name, content)
        case [{"rotation": _, "position": _}, *_]:
            return torch.eye(4, dtype=torch.float64)
    return None


def camera_in_picture(path: str | os.PathLike[str], origin: Origin = ZERO) -> Camera | None:
    """Return the camera embedded in a rendered picture, relative to `origin`; None if there is none.

    Raises:
        ProgdfError: the file is not a picture, or the embedded text is not a camera.
    """
    camera = _embedded_camera(path)
    return None if camera is None else _to_scene_frame(camera, origin, os.fspath(path))


def _embedded_camera(path: str | os.PathLike[str]) -> Camera | None:
    """Return the camera embedded in a picture, in the world and in float64; None if there is none."""
    from .images import picture_text  # imports Pillow, which camera files do not need

    text = picture_text(path, PICTURE_KEY)
    if text is None:
        return None
    where = f"the text {PICTURE_KEY} in {os.fspath(path)}"
    try:
        content = decode_json(text) if len(text) <= _MAX_CAMERA_TEXT else None
    except ValueError as error:
        raise ProgdfError(f"{where} is not JSON ({error}); render the picture again") from None
    match content:
        case {"format": format, "cameras": [entry]} if format == _FORMAT:
            return replace(read_own_camera(where, 0, entry)[0], name=Path(path).stem)
    raise ProgdfError(f"{where} is not a camera; render the picture again")


def _from_content(name: str, content: Any, path: Path) -> tuple[list[Camera], tuple[str, ...]]:
    """Return the cameras of a JSON value and the ignored fields."""
    match content:
        case {"frames": list() as frames}:
            entries = [
                read_nerfstudio_camera(name, i, content, frame, path) for i, frame in enumerate(frames)
            ]
            names = without_common_folder([camera.name for camera, _ in entries])
            read = [
                (replace(camera, name=own), fields)
                for (camera, fields), own in zip(entries, names, strict=True)
            ]
        case [{"rotation": _, "position": _}, *_]:
            read = [read_inria_camera(name, i, entry) for i, entry in enumerate(content)]
        case {"cameras": list() as entries}:
            read = [read_own_camera(name, i, entry) for i, entry in enumerate(entries)]
        case {"viewmat": _}:
            read = [read_own_camera(name, 0, content)]
        case [{"viewmat": _}, *_]:
            read = [read_own_camera(name, i, entry) for i, entry in enumerate(content)]
        case []:
            return [], ()
        case _:
            raise ProgdfError(
                f"{name} holds no cameras; give a cameras.json, a transforms.json or a file of saved cameras"
            )
    ignored = dict.fromkeys(field for _, fields in read for field in fields)
    return [camera for camera, _ in read], tuple(ignored)


def kind_of_cameras(path: str | os.PathLike[str]) -> str:
    """Return "own" for a file written by `save_cameras`, otherwise "other"."""
    data = read_file(path)
    try:
        content = json.loads(data)
    except (ValueError, RecursionError):
        return "other"
    return "own" if isinstance(content, dict) and content.get("format") == _FORMAT else "other"


def save_cameras(path: str | os.PathLike[str], cameras: Sequence[Camera], origin: Origin = ZERO) -> None:
    """Write cameras as JSON, complete or not at all. `load_cameras` restores the same bits.

    Args:
        path: the file
        cameras: cameras relative to `origin`
        origin: origin of the scene; the file stores world cameras
    """
    write_file(path, cameras_to_json(cameras, 1, origin))


def cameras_to_json(cameras: Sequence[Camera], indent: int | None = None, origin: Origin = ZERO) -> str:
    """Return the JSON text of saved cameras, ASCII; see `save_cameras`."""
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
