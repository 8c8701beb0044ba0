"""Reader of SOG scenes (PlayCanvas), versions 1 and 2.

A scene has a table, meta.json, and images with one pixel per Gaussian, in a folder or a zip archive (.sog,
.zip):

    means_l, means_u    low and high byte of a share of the range of sign(x) · log(1 + |x|), per axis
    quats               the three smaller components; alpha − 252 is the index of the largest one
    scales, sh0         log-scales, color and opacity
    shN                 a palette of SH rows, 64 in each image row, and the index of each Gaussian's row

Version 1 has no version number. Its bytes are shares of the range of their channel, and its opacities are
logits. In version 2, bytes are indices into a codebook, and opacities are shares of 255.
"""

from __future__ import annotations

import io
import os
import warnings
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from PIL import Image

from progdf.errors import ProgdfError
from progdf.formats.repair import logits_of_shares
from progdf.gaussians import Gaussians, from_arrays
from progdf.io.atomic import open_error, read_file
from progdf.io.file_rules import check_fields, damage_error, unsupported_error
from progdf.io.json_values import convert_json, decode_json

META = "meta.json"
"""File name of the table. In a folder, the path of this file stands for the scene."""

CONVERT = "convert it with `splat-transform in.sog out.ply`"
"""Remedy in errors about a version or a feature that is not supported."""

_MAX_META_BYTES = 1 << 20  # a table has about 20 kB; parsed JSON takes 30 times its size
_MAX_PIXELS = (1 << 20, 16)  # pixels of an image: a base, and an increment per byte of the scene's files
_IMAGE_FORMATS = ("WEBP", "PNG")
_PALETTE_COLUMNS = 64  # palette entries (SH rows) per row of the palette image
_PALETTE_WIDTHS = (192, 512, 960)  # 3, 8 or 15 SH functions
_PALETTE_INDEX = 5  # position of the palette among the images
_W_LARGEST_ALPHA = 252  # alpha of a rotation whose first component (w) is the largest
_KNOWN_FIELDS = ("version", "count", "antialias", "model", "means", "scales", "quats", "sh0", "shN", "asset")
_MODELS = (None, "default", "3dgs", "antialiased")

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


class _Part(msgspec.Struct):
    """Entry of one attribute in meta.json."""

    files: list[str]  # image names, in the order of the format
    shape: list[int] = []  # version 1: rows first
    mins: list[float] | float | None = None  # one number per channel; a single number for shN in version 1
    maxs: list[float] | float | None = None
    codebook: list[float | None] | None = None  # version 2: 256 values
    encoding: str = "quaternion_packed"  # version 1, quats only
    quantization: int = 8  # version 1, shN only; bits


class _Meta(msgspec.Struct):
    """Fields of meta.json that are read."""

    means: _Part
    scales: _Part
    quats: _Part
    sh0: _Part
    shN: _Part | None = None
    count: int | None = None  # version 2
    version: int = 1
    antialias: bool = False
    model: str | None = None


@dataclass(frozen=True)
class SogScene:
    """Scene as stored, with the facts for its report."""

    gaussians: Gaussians
    version: int  # 1 or 2
    ignored: tuple[str, ...]  # unused fields of the table


def read_table(path: Path) -> dict[str, Any] | None:
    """Return the table of a SOG scene, or None if the file is not a SOG scene.

    Args:
        path: a zip archive, or the meta.json of a folder

    Raises:
        ProgdfError: the table is larger than `_MAX_META_BYTES`.
    """
    try:
        if path.name.lower() == META:
            content = read_file(path, _MAX_META_BYTES + 1)
        else:
            with zipfile.ZipFile(path) as archive:
                entry = archive.getinfo(_table_name(archive))
                if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    return None  # with other methods zipfile inflates the whole entry, even for a short read
                with archive.open(entry) as file:
                    content = file.read(_MAX_META_BYTES + 1)
        table = decode_json(content) if len(content) <= _MAX_META_BYTES else None
    except (OSError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return None
    if len(content) > _MAX_META_BYTES:
        raise damage_error(
            path, f"it has a {META} of more than {_MAX_META_BYTES >> 20} MB; usual ones have some kB"
        )
    is_known = isinstance(table, dict) and "means" in table and "quats" in table
    return table if is_known else None


def read_sog(path: Path) -> SogScene:
    """Return the scene in a zip archive, or in the folder of a meta.json.

    Axes are those of the original .ply.

    Raises:
        ProgdfError: the version or a feature is not supported, or the file is damaged.
    """
    table = read_table(path)
    if table is None:
        raise damage_error(path, f"it has no readable {META} of a SOG scene")
    meta = _check_table(path, table)
    ignored = check_fields(path, table, _KNOWN_FIELDS, {}, CONVERT)
    count = _count(path, meta)
    low, high, scales, quats, colors, *bands = _load_images(path, meta, count)
    shares = (low[:, :3] + high[:, :3] * 256.0) / 65535.0
    logs = _lerp(path, meta.means, "means", shares)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # repaired later
        means = np.sign(logs) * np.expm1(np.abs(logs))
        if meta.version == 1:
            log_scales = _lerp(path, meta.scales, "scales", scales[:, :3] / 255.0)
            base = _lerp(path, meta.sh0, "sh0", colors / 255.0)
            sh0 = base[:, :3]
            logits = base[:, 3]
        else:
            log_scales = _codebook(path, meta.scales, "scales")[scales[:, :3]]
            sh0 = _codebook(path, meta.sh0, "sh0")[colors[:, :3]]
            logits = logits_of_shares(colors[:, 3] / 255.0)
        arrays = {
            "means": means.astype(np.float32),
            "quats": _quats(quats),
            "log_scales": log_scales.astype(np.float32),
            "logit_opacities": logits.astype(np.float32),
            "sh0": sh0.astype(np.float32),
            "shN": _higher_bands(path, meta, bands, count),
        }
    antialiased = meta.antialias or meta.model == "antialiased"
    return SogScene(from_arrays(arrays, antialiased), meta.version, ignored)


def _check_table(path: Path, table: dict[str, Any]) -> _Meta:
    """Parse the table, and check that its version, model and encodings are supported."""
    version = table.get("version", 1)
    if version not in (1, 2) or isinstance(version, bool):
        raise unsupported_error(path, f"SOG version {str(version)[:20]}", CONVERT)
    try:
        meta = convert_json(table, _Meta)
    except ValueError as error:
        raise damage_error(path, f"in {META}, {error}") from None
    if meta.model not in _MODELS:
        raise unsupported_error(path, f"the model '{str(meta.model)[:40]}'", CONVERT)
    if meta.version == 1 and meta.quats.encoding != "quaternion_packed":
        raise unsupported_error(path, f"quats.encoding '{meta.quats.encoding[:40]}'", CONVERT)
    if meta.version == 1 and meta.shN is not None and meta.shN.quantization != 8:
        raise unsupported_error(path, f"shN.quantization {meta.shN.quantization} (bits)", CONVERT)
    return meta


def _count(path: Path, meta: _Meta) -> int:
    """Return the number of Gaussians that the table declares."""
    count = meta.count or 0
    if meta.version == 1 and meta.means.shape:
        count = meta.means.shape[0]
    if count < 1:
        raise ProgdfError(f"{path} holds 0 Gaussians; a scene needs at least one: export it again")
    return count


def _load_images(path: Path, meta: _Meta, count: int) -> list[Bytes]:
    """Return the pixels of each image as rows, in the order of the module docstring. [N,4] each

    The palette is returned whole, as [P,K,4]. All image sizes are checked before the first is decoded.
    """
    parts = {"means": 2, "scales": 1, "quats": 1, "sh0": 1}
    if meta.shN is not None:
        parts["shN"] = 2
    images = []
    for name, expected in parts.items():
        files = getattr(meta, name).files
        if len(files) != expected:
            raise damage_error(path, f"{name} names {len(files)} images, the format has {expected}")
        images += [(file, _open_image(path, file)) for file in files]
    rows = []
    for index, (file, image) in enumerate(images):
        is_palette = index == _PALETTE_INDEX
        pixels = image.width * image.height
        if is_palette and image.width not in _PALETTE_WIDTHS:
            raise damage_error(path, f"{file} is {image.width} pixels wide; a palette has 192, 512 or 960")
        if pixels < count and not is_palette:
            raise damage_error(path, f"{file} has {pixels} pixels for {count} Gaussians")
    for index, (file, image) in enumerate(images):
        try:
            decoded = np.asarray(image.convert("RGBA"))
        except Exception as error:  # each format's reader raises its own errors
            raise damage_error(path, f"{file} is not a readable image ({type(error).__name__})") from None
        if index == _PALETTE_INDEX:
            rows.append(decoded.reshape(-1, image.width // _PALETTE_COLUMNS, 4))
        else:
            rows.append(decoded.reshape(-1, 4)[:count])
    return rows


def _lerp(path: Path, part: _Part, name: str, shares: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Convert shares of each channel's range to values. [N,C] -> [N,C]"""
    channels = shares.shape[1]
    edges = []
    for key, numbers in (("mins", part.mins), ("maxs", part.maxs)):
        if not isinstance(numbers, list) or len(numbers) != channels:
            raise damage_error(path, f"{name}.{key} is not a list of {channels} numbers")
        edges.append(np.array(numbers))
    low, high = edges
    values: npt.NDArray[np.float64] = low + (high - low) * shares
    return values


def _codebook(path: Path, part: _Part, name: str) -> npt.NDArray[np.float64]:
    """Return the 256 values of a codebook, one per byte value.

    Some files have no first value. It is extrapolated with the mean spacing of the others.
    """
    values = part.codebook
    if values is None or len(values) != 256 or any(value is None for value in values[1:]):
        raise damage_error(path, f"{name}.codebook is not a list of 256 numbers")
    book = np.array([0.0 if value is None else value for value in values])
    if values[0] is None:
        book[0] = book[1] + (book[1] - book[255]) / 255.0
    return book


def _quats(pixels: Bytes) -> Floats:
    """Decode quaternions wxyz from pixels. Unknown tags give 0, repaired by the caller. [N,4] -> [N,4]"""
    others = (pixels[:, :3] / 255.0 - 0.5) * np.sqrt(2.0)
    largest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    tags = pixels[:, 3].astype(np.int64) - _W_LARGEST_ALPHA
    index = tags.clip(min=0)
    quats = np.zeros((len(pixels), 4), np.float32)
    other_indices = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[index]
    np.put_along_axis(quats, other_indices, others.astype(np.float32), axis=1)
    np.put_along_axis(quats, index[:, None], largest[:, None].astype(np.float32), axis=1)
    quats[tags < 0] = 0.0
    return quats


def _higher_bands(path: Path, meta: _Meta, images: list[Bytes], count: int) -> Floats:
    """Return the SH bands above 0 from their palette. [N,K,3]

    Args:
        path: the scene
        meta: its table
        images: empty, or the palette [P,K,4] and the labels [N,4]
        count: number of Gaussians N
    """
    part = meta.shN
    if part is None:
        return np.zeros((count, 0, 3), np.float32)
    palette, labels = images
    colors = palette[:, :, :3]
    if meta.version == 1:
        low = part.mins
        high = part.maxs
        if not isinstance(low, float | int) or not isinstance(high, float | int):
            raise damage_error(path, "shN.mins and shN.maxs are not numbers")
        values = low + (high - low) * (colors / 255.0)
    else:
        values = _codebook(path, part, "shN")[colors]
    index = labels[:, 0] + 256 * labels[:, 1].astype(np.int64)
    max_index = int(index.max())
    if max_index >= len(palette):
        raise damage_error(path, f"{part.files[1]} names row {max_index} of a palette of {len(palette)}")
    bands: Floats = values.astype(np.float32)[index]
    return bands


def _open_image(path: Path, name: str) -> Image.Image:
    """Open an image and check its size. Its pixels are not decoded yet."""
    content = _read_image(path, name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit below is lower
            image = Image.open(io.BytesIO(content), formats=_IMAGE_FORMATS)
    except Exception as error:  # each format's reader raises its own errors
        raise damage_error(path, f"{name[:80]} is not an image ({type(error).__name__})") from None
    base, each = _MAX_PIXELS
    if image.width * image.height > base + each * scene_bytes(path):
        raise damage_error(path, f"{name} claims {image.width}x{image.height} pixels, more than it can hold")
    return image


def _read_image(path: Path, name: str) -> bytes:
    """Return the bytes of an image of the scene.

    Pipes and links are refused: reading a pipe blocks, and a link may lead out of the folder.
    """
    if not name or PurePosixPath(name).name != name or "\\" in name or "\0" in name:
        raise damage_error(path, f"{META} names images outside its folder ({name[:80]!r})")
    if path.name.lower() == META:
        image = path.parent / name
        try:
            is_file = image.is_file() and not image.is_symlink()
        except OSError:  # a name that is too long
            is_file = False
        if not is_file:
            raise damage_error(path, f"{name[:80]} is missing, a link or no regular file")
        return read_file(image)
    try:
        with zipfile.ZipFile(path) as archive:
            entry = archive.getinfo(str(PurePosixPath(_table_name(archive)).with_name(name)))
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or entry.flag_bits & 1:
                raise unsupported_error(
                    path, f"a packed or encrypted {name[:80]}", "pack the folder as a plain .zip"
                )
            if entry.file_size > _MAX_META_BYTES + 64 * path.stat().st_size:
                raise damage_error(path, f"{name[:80]} claims {entry.file_size} bytes, more than it can hold")
            return archive.read(entry)
    except KeyError:
        raise damage_error(path, f"{name[:80]} is missing") from None
    except OSError as error:
        raise open_error(path, error) from None
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        if isinstance(error, ProgdfError):
            raise
        raise damage_error(path, f"{name[:80]} cannot be unpacked ({str(error)[:80]})") from None


def _table_name(archive: zipfile.ZipFile) -> str:
    """Return the name of the table in an archive: at the root, otherwise in the only folder with a table.

    Raises:
        KeyError: no folder or several folders have a table.
    """
    names = [name for name in archive.namelist() if PurePosixPath(name).name.lower() == META]
    if META in names:
        return META
    inside = [name for name in names if not name.startswith("__MACOSX/")]
    if len(inside) != 1:
        raise KeyError(META)
    return inside[0]


def scene_bytes(path: Path) -> int:
    """Return the size of a scene in bytes. A meta.json counts all regular files of its folder."""
    if path.name.lower() != META:
        return path.stat().st_size
    with os.scandir(path.parent) as entries:
        return sum(entry.stat().st_size for entry in entries if entry.is_file(follow_symlinks=False))
