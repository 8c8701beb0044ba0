"""Cameras of a COLMAP sparse model, binary or text, read with pycolmap (`pip install progdf-studio[colmap]`).

Only the cameras are wanted. The 3D points, which are most of a model and are often left out when one is
passed on, are not read: pycolmap gets the other files beside an empty list of points.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import msgspec
import torch

from progdf.camera import Camera, Lens
from progdf.errors import ProgdfError

from . import native_child
from .atomic import open_error
from .json_values import convert_json, decode_json

_NEEDED = ("cameras", "images")
_OPTIONAL = ("rigs", "frames")
"""Written since COLMAP 3.12; older models have a rig of one camera per image."""

_PLACES = ("", "sparse/0", "sparse", "0", "colmap/sparse/0")
"""Where a model is looked for in the folder that is named."""

_LENSES = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV": ("k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("k1", "k2", "p1", "p2", "k3"),
}
"""Camera models that are a pinhole behind a lens → what their parameters after the principal point mean."""


class _Image(msgspec.Struct):
    """A registered image: world → camera, OpenCV axes, pixel centers at +0.5, as ours."""

    name: str
    pose: list[list[float]]
    K: list[list[float]]
    width: int
    height: int
    model: str
    params: list[float]


def find_model(folder: Path) -> Path | None:
    """The sparse model in a folder: itself, sparse/0, sparse, 0 or colmap/sparse/0; None where none is."""
    for name in _PLACES:
        if _suffix(folder / name):
            return folder / name
    return None


def load_model(model: Path) -> list[Camera]:
    """The registered images of a sparse model as float64 cameras of the world, in the order of their names.

    Args:
        model: the folder with cameras.bin and images.bin, or .txt

    Raises:
        ProgdfError: pycolmap is not installed, a file is broken, a camera is no pinhole behind a lens that
            we know, or no image is registered.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise ProgdfError(
            f"{model} is a COLMAP model, which needs pycolmap; pip install 'progdf-studio[colmap]'"
        )
    suffix = _suffix(model)
    with tempfile.TemporaryDirectory() as folder:
        try:
            for name in (*_NEEDED, *_OPTIONAL):
                source = model / f"{name}{suffix}"
                if name in _NEEDED or source.is_file():
                    shutil.copyfile(source, Path(folder, source.name))
        except OSError as error:
            raise open_error(error.filename or model, error) from None
        Path(folder, f"points3D{suffix}").write_bytes(bytes(8) if suffix == ".bin" else b"")
        images = _images(Path(folder))
    if images is None:
        raise ProgdfError(
            f"{model} is a broken COLMAP model; export cameras{suffix} and images{suffix} again"
        )
    if not images:
        raise ProgdfError(f"{model} has no registered image; it needs at least one")
    return [_camera(model, image) for image in sorted(images, key=lambda image: image.name)]


def _images(folder: Path) -> list[_Image] | None:
    """What pycolmap reads, in a process of its own (see `native_child`); None: nothing that it can."""
    size = sum(file.stat().st_size for file in folder.iterdir())
    memory, seconds = (1 << 30) + 64 * size, 10 + int(2e-6 * size)
    try:
        ended = native_child.run((memory, 0, seconds), 6 * seconds, "cameras", str(folder))
        return None if ended.returncode else convert_json(decode_json(ended.stdout), list[_Image])
    except (subprocess.TimeoutExpired, ValueError):
        return None


def _suffix(model: Path) -> str | None:
    for suffix in (".bin", ".txt"):
        if all((model / f"{name}{suffix}").is_file() for name in _NEEDED):
            return suffix
    return None


def _camera(model: Path, image: _Image) -> Camera:
    where = f"image {image.name} of {model}"
    lens = _lens(where, image)
    viewmat = torch.eye(4, dtype=torch.float64)
    try:
        viewmat[:3] = torch.tensor(image.pose, dtype=torch.float64)
        K = torch.tensor(image.K, dtype=torch.float64)
        camera = Camera(viewmat, K.float(), image.width, image.height, image.name)
    except ValueError as error:
        raise ProgdfError(f"{where} is broken: {error}") from None
    rotation = viewmat[:3, :3]
    if not float((rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()) < 1e-3:
        raise ProgdfError(f"{where} has an invalid rotation; export the model again")
    return replace(camera, lens=lens)


def _lens(where: str, image: _Image) -> Lens | None:
    kind = image.model
    if kind not in _LENSES:
        raise ProgdfError(
            f"{where} has the camera model {kind}; only pinhole cameras can be used: "
            "run colmap image_undistorter and give its sparse folder"
        )
    first = 3 if kind.startswith("SIMPLE") or kind == "RADIAL" else 4
    numbers = [float(number) for number in image.params[first:]]
    names = _LENSES[kind]
    if any(numbers[len(names) :]):
        raise ProgdfError(
            f"{where} has a lens with k4, k5 or k6, which cannot be undistorted here; "
            "run colmap image_undistorter and give its sparse folder"
        )
    lens = Lens(**dict(zip(names, numbers, strict=False)))
    return lens or None
