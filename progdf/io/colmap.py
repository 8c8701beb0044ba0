"""Cameras of a COLMAP sparse model.

The text form is parsed here, as image names may contain blanks, which pycolmap cuts off. The binary form is
read by pycolmap (`pip install progdf-studio[colmap]`). Only cameras are read. The 3D points make up most of a
model and are often missing from shared models, so pycolmap gets an empty list of them.
"""

from __future__ import annotations

import importlib.util
import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import torch

from progdf.camera import Camera, Lens
from progdf.errors import ProgdfError
from progdf.quaternions import rotation_matrices
from progdf.system.packages import install_extra
from progdf.terminal import format_count

from . import native_child
from .atomic import open_error, read_file
from .camera_json import make_camera, make_intrinsics, make_rigid, portable_name
from .file_rules import damage_error, unsupported_error
from .json_values import convert_json, decode_json

_REQUIRED_FILES = ("cameras", "images")
_OPTIONAL_FILES = ("rigs", "frames")
"""Binary files since COLMAP 3.12. Without them each image has its own rig. images.txt has all poses."""

_MODEL_FOLDERS = ("sparse", "", "colmap/sparse")
"""Folders in a project that may hold a model, or several models in subfolders 0, 1, …"""

_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
"""Supported camera models (pinhole with lens distortion) → their parameters."""

_LENS_PARAMETERS = ("k1", "k2", "p1", "p2", "k3")
_UNSUPPORTED_LENS = ("k4", "k5", "k6")

_REMEDY = "run `colmap image_undistorter` and give its sparse folder"

_IMAGE_FIELDS = 10  # IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; the name is the rest of the line
_CAMERA_FIELDS = 4  # CAMERA_ID MODEL WIDTH HEIGHT, then the parameters
_MAX_SIDE = 1_000_000  # pixels
_MAX_NORM_ERROR = 1e-2  # largest deviation of a quaternion's squared length from 1
_IMAGE_COUNT = re.compile(rb"#\s*Number of images:\s*(\d{1,18})\b")
_NUMERIC = b"0123456789+-.eE \t"


@dataclass(frozen=True)
class ColmapModel:
    """COLMAP sparse model in binary or text form."""

    folder: Path
    suffix: str  # .bin or .txt
    note: str = ""  # one line if it was chosen among several

    @property
    def files(self) -> tuple[Path, ...]:
        """Files that are read."""
        names = (*_REQUIRED_FILES, *_OPTIONAL_FILES) if self.suffix == ".bin" else _REQUIRED_FILES
        paths = [self.folder / f"{name}{self.suffix}" for name in names]
        return tuple(path for path in paths if path.stem in _REQUIRED_FILES or path.is_file())


class _Image(msgspec.Struct):
    """Registered image."""

    name: str
    pose: list[list[float]]  # world → camera, OpenCV axes, pixel centers at +0.5. [3,4]
    width: int
    height: int
    model: str
    params: list[float]


@dataclass(frozen=True)
class _TextCamera:
    """Line of cameras.txt."""

    model: str
    width: int
    height: int
    params: list[float]


def open_model(folder: Path, suffix: str = "") -> ColmapModel | None:
    """Return the model in a folder itself, or None. The binary form is preferred.

    Args:
        folder: the folder
        suffix: .bin or .txt to accept only one form
    """
    for kind in (suffix,) if suffix else (".bin", ".txt"):
        if all((folder / f"{name}{kind}").is_file() for name in _REQUIRED_FILES):
            return ColmapModel(folder, kind)
    return None


def find_model(folder: Path) -> ColmapModel | None:
    """Return the model of a folder: its own, or the largest in sparse, in subfolders, or in colmap/sparse."""
    model = open_model(folder)
    if model is not None:
        return _with_larger_sibling(model)
    for name in _MODEL_FOLDERS:
        models = _models_in(folder / name)
        if models:
            return _choose_largest(models)
    return None


def _models_in(folder: Path) -> list[ColmapModel]:
    """Return the models in subfolders 0, 1, …, otherwise the model in the folder itself."""
    try:
        numbers = sorted(
            (int(path.name), path.name) for path in folder.iterdir() if re.fullmatch(r"[0-9]{1,9}", path.name)
        )
    except OSError:
        return []
    found = [open_model(folder / name) for _, name in numbers]
    models = [model for model in found if model is not None]
    own = open_model(folder)
    return models or ([own] if own is not None else [])


def _with_larger_sibling(model: ColmapModel) -> ColmapModel:
    """Return a model, with a note if its folder is a number and a model beside it has more images."""
    if re.fullmatch(r"[0-9]{1,9}", model.folder.name) is None:
        return model
    count = _count_images(model)
    larger = [other for other in _models_in(model.folder.parent) if _count_images(other) > count]
    if not larger:
        return model
    best = max(larger, key=_count_images)
    images = format_count(count, "image")
    note = f"{model.folder} has {images}; {best.folder} beside it has {_count_images(best)}"
    return replace(model, note=note)


def _choose_largest(models: list[ColmapModel]) -> ColmapModel:
    """Return the model with the most images; the first one if several are equal."""
    if len(models) == 1:
        return models[0]
    counts = [_count_images(model) for model in models]
    largest = counts.index(max(counts))
    other_counts = [
        f"{model.folder.name} has {count}"
        for i, (model, count) in enumerate(zip(models, counts, strict=True))
        if i != largest
    ]
    chosen = models[largest]
    note = (
        f"{chosen.folder} is used, the largest of {len(models)} COLMAP models: "
        f"{format_count(counts[largest], 'image')}, "
        f"{', '.join(other_counts)}"
    )
    return replace(chosen, note=note)


def _count_images(model: ColmapModel) -> int:
    """Return the number of images that a model states, without checking them."""
    if model.suffix == ".bin":
        return int.from_bytes(read_file(model.folder / "images.bin", 8), "little")
    return sum(1 for _ in _image_lines(read_file(model.folder / "images.txt")))


def load_model(model: ColmapModel) -> list[Camera]:
    """Return the registered images of a model as float64 world cameras, in the order of their names.

    Raises:
        ProgdfError: a file is damaged, a camera model or lens is not supported, no image is registered, or
            pycolmap, which the binary form needs, is not installed.
    """
    images = _read_binary(model) if model.suffix == ".bin" else _read_text(model)
    if not images:
        raise ProgdfError(f"{model.folder} has no registered image; it needs at least one")
    return [_make_camera(model.folder, image) for image in sorted(images, key=lambda image: image.name)]


def _make_camera(folder: Path, image: _Image) -> Camera:
    where = f"image {image.name} of {folder}"
    names = _PARAMETERS.get(image.model)
    if names is None:
        raise unsupported_error(where, f"the camera model {image.model}", _REMEDY)
    if len(image.params) != len(names):
        numbers = f"{len(image.params)} parameters of a {image.model} camera, which has {len(names)}"
        raise ProgdfError(f"{where} has {numbers}; export the model again")
    if not (1 <= image.width <= _MAX_SIDE and 1 <= image.height <= _MAX_SIDE):
        raise ProgdfError(f"{where} has {image.width}x{image.height} pixels; export the model again")
    values = dict(zip(names, image.params, strict=True))
    for name in _UNSUPPORTED_LENS:
        if values.get(name):
            raise unsupported_error(where, f"{name} of the camera model {image.model}", _REMEDY)
    fx = values.get("fx", values.get("f", 0.0))
    K = make_intrinsics(fx, values.get("fy", fx), values["cx"], values["cy"])
    lens = Lens(**{name: values[name] for name in _LENS_PARAMETERS if name in values})
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3] = torch.tensor(image.pose, dtype=torch.float64)
    if not bool(viewmat.isfinite().all()):
        raise ProgdfError(f"{where} has a pose that is not finite; export the model again")
    viewmat = make_rigid(where, viewmat)
    return make_camera(
        where, viewmat, K, (image.width, image.height), portable_name(image.name), lens or None
    )


def _read_binary(model: ColmapModel) -> list[_Image]:
    """Read the images with pycolmap in a separate process (see `native_child`)."""
    if importlib.util.find_spec("pycolmap") is None:
        raise ProgdfError(
            f"{model.folder} is a binary COLMAP model, which needs pycolmap; "
            f"{install_extra('colmap')}, or run `colmap model_converter --output_type TXT`"
        )
    with tempfile.TemporaryDirectory() as folder:
        try:
            for source in model.files:
                shutil.copyfile(source, Path(folder, source.name))
        except OSError as error:
            raise open_error(error.filename or model.folder, error) from None
        Path(folder, "points3D.bin").write_bytes(bytes(8))
        size = sum(file.stat().st_size for file in Path(folder).iterdir())
        memory = (1 << 30) + 64 * size
        seconds = 10 + int(2e-6 * size)
        try:
            result = native_child.run((memory, 0, seconds), 6 * seconds, "cameras", folder)
            if result.returncode == 0:
                return convert_json(decode_json(result.stdout), list[_Image])
        except (subprocess.TimeoutExpired, ValueError):
            pass
    raise ProgdfError(
        f"pycolmap cannot read {model.folder / 'cameras.bin'} and images.bin; copy or export them again, "
        "or run `colmap model_converter --output_type TXT`"
    )


def _read_text(model: ColmapModel) -> list[_Image]:
    """Read the images from cameras.txt and images.txt."""
    cameras = _read_text_cameras(model.folder / "cameras.txt")
    path = model.folder / "images.txt"
    content = read_file(path)
    images: dict[int, _Image] = {}
    for number, line in _image_lines(content):
        fields = _decode_line(path, number, line).split(None, _IMAGE_FIELDS - 1)
        if len(fields) < _IMAGE_FIELDS:
            raise damage_error(path, f"line {number} has {len(fields)} of {_IMAGE_FIELDS} fields of an image")
        image_id = _parse_whole(path, number, fields[0])
        camera_id = _parse_whole(path, number, fields[8])
        if image_id in images:
            raise damage_error(path, f"line {number} repeats the image {image_id}")
        if camera_id not in cameras:
            raise damage_error(
                path, f"line {number} names the camera {camera_id}, which is not in cameras.txt"
            )
        camera = cameras[camera_id]
        pose = _pose(path, number, [_parse_finite(path, number, field) for field in fields[1:8]])
        name = fields[9].rstrip()
        images[image_id] = _Image(name, pose, camera.width, camera.height, camera.model, camera.params)
    _check_header(path, content, len(images))
    return list(images.values())


def _read_text_cameras(path: Path) -> dict[int, _TextCamera]:
    cameras = {}
    for number, line in enumerate(_split_lines(read_file(path)), 1):
        if not line.strip() or line.lstrip().startswith(b"#"):
            continue
        fields = _decode_line(path, number, line).split()
        if len(fields) < _CAMERA_FIELDS:
            raise damage_error(
                path, f"line {number} has {len(fields)} of {_CAMERA_FIELDS} fields of a camera"
            )
        camera_id = _parse_whole(path, number, fields[0])
        if camera_id in cameras:
            raise damage_error(path, f"line {number} repeats the camera {camera_id}")
        width = _parse_whole(path, number, fields[2])
        height = _parse_whole(path, number, fields[3])
        params = [_parse_finite(path, number, field) for field in fields[_CAMERA_FIELDS:]]
        cameras[camera_id] = _TextCamera(fields[1], width, height, params)
    return cameras


def _image_lines(content: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the line number and the line of every image in images.txt.

    A line of 2D points follows each image. It may be blank, and some writers leave it out.
    """
    points_may_follow = False
    for number, line in enumerate(_split_lines(content), 1):
        bare = line.strip()
        if bare.startswith(b"#"):
            continue
        if not bare or (points_may_follow and _is_points(bare)):
            points_may_follow = False
            continue
        yield number, line
        points_may_follow = True


def _split_lines(content: bytes) -> list[bytes]:
    return content.removeprefix(b"\xef\xbb\xbf").splitlines()


def _is_points(line: bytes) -> bool:
    """Return whether a line is a list of 2D points (X Y POINT3D_ID each). No image line has this form."""
    return not line.translate(None, _NUMERIC) and len(line.split()) % 3 == 0


def _check_header(path: Path, content: bytes, count: int) -> None:
    """Raise ProgdfError if the header states more images than the file lists.

    Fewer are accepted: some writers copy a template header.
    """
    stated = _IMAGE_COUNT.search(content)
    if stated is not None and int(stated[1]) > count:
        raise ProgdfError(
            f"{path} lists {count} of the {int(stated[1])} images that its header counts; export it again, "
            "or correct the header"
        )


def _decode_line(path: Path, number: int, line: bytes) -> str:
    try:
        return line.decode("utf-8")
    except UnicodeDecodeError:
        raise unsupported_error(
            path, f"a text encoding other than UTF-8 (line {number})", "save it as UTF-8"
        ) from None


def _parse_whole(path: Path, number: int, field: str) -> int:
    if re.fullmatch(r"[0-9]{1,18}", field, re.ASCII) is None:
        raise damage_error(path, f"line {number} has {field!r:.40} in place of a whole number")
    return int(field)


def _parse_finite(path: Path, number: int, field: str) -> float:
    try:
        value = float(field)
    except ValueError:
        value = math.nan
    if not abs(value) < 3e38:  # finite in float32
        raise damage_error(path, f"line {number} has {field!r:.40} in place of a number")
    return value


def _pose(path: Path, number: int, values: list[float]) -> list[list[float]]:
    """Return the world → camera matrix of a quaternion wxyz and a translation. [7] -> [3,4]"""
    quat = torch.tensor([values[:4]], dtype=torch.float64)
    if not abs(float(quat.square().sum()) - 1.0) < _MAX_NORM_ERROR:
        raise damage_error(path, f"line {number} has a quaternion of length {float(quat.norm()):.4g}, not 1")
    rotation = rotation_matrices(quat / quat.norm())[0].tolist()
    return [[*row, shift] for row, shift in zip(rotation, values[4:], strict=True)]
