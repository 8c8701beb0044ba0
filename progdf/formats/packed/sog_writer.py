"""Writer of SOG scenes (PlayCanvas), version 2, as one zip archive; `sog` describes the format.

Rows are written in the order of the scene. Codebooks are one-dimensional k-means. The palette of SH rows
comes from a tree of splits (see `palette_kernel`), which takes seconds where k-means in 45 dimensions takes
minutes.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from progdf.formats.packed.palette_kernel import reassign, split_groups
from progdf.formats.packed.sog import META
from progdf.gaussians import Gaussians

_VERSION = 2
_LEVELS = 256  # values of a codebook
_CODEBOOK_CELLS = 1024  # cells of the density of values
_EVEN_SHARE = 0.5  # share of the values that are evenly spaced, which bounds the error of rare values
_CODEBOOK_ROUNDS = 3  # rounds of k-means; many more would take the evenly spaced values away
_MAX_PALETTE = 1 << 16  # rows of a palette, whose index has 16 bits
_PALETTE_COLUMNS = 64  # palette rows in each row of the image
_REACH = 32  # neighboring palette rows to which a Gaussian may move
_PIXEL_MULTIPLE = 4  # image sides are multiples of it
_OPAQUE = 255
_WEBP_METHOD = 1  # effort, 0 to 6
_W_LARGEST_ALPHA = 252

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
Doubles = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


def write_sog(path: Path, scene: Gaussians) -> None:
    """Write a scene with its rows in their order; neighbors in space should be neighbors in the file.

    Args:
        path: the file, which is overwritten
        scene: N Gaussians of SH degree 3 at most, finite
    """
    count = len(scene)
    images: dict[str, bytes] = {}

    def add(name: str, *channels: npt.NDArray[np.integer[Any]] | int) -> str:
        pixels = np.zeros((count, 4), np.uint8)
        for i, channel in enumerate(channels):
            pixels[:, i] = channel
        images[f"{name}.webp"] = _encode(_to_square(pixels))
        return f"{name}.webp"

    means = scene.world_means.numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low = logs.min(axis=0)
    high = logs.max(axis=0)
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1.0) * 65535.0).astype(np.uint16)
    scale_book, scales = _codebook(scene.log_scales.numpy())
    color_book, colors = _codebook(scene.sh0.numpy())
    opacities = np.rint(scene.opacities.numpy() * 255.0).astype(np.uint8)
    largest, others = _rotations(scene.unit_quats.numpy())
    meta: dict[str, Any] = {
        "version": _VERSION,
        "count": count,
        "antialias": scene.antialiased,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [add("means_l", *(steps & 255).T, _OPAQUE), add("means_u", *(steps >> 8).T, _OPAQUE)],
        },
        "scales": {"codebook": scale_book.tolist(), "files": [add("scales", *scales.T, _OPAQUE)]},
        "quats": {"files": [add("quats", *others.T, largest + _W_LARGEST_ALPHA)]},
        "sh0": {"codebook": color_book.tolist(), "files": [add("sh0", *colors.T, opacities)]},
    }
    bands = scene.shN.shape[1]
    if bands:
        centers, labels = make_palette(np.ascontiguousarray(scene.shN.numpy().reshape(count, 3 * bands)))
        book, levels = _codebook(centers)
        images["shN_centroids.webp"] = _encode(_palette_image(levels.reshape(len(centers), bands, 3)))
        meta["shN"] = {
            "count": len(centers),
            "bands": scene.sh_degree,
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", add("shN_labels", labels & 255, labels >> 8, 0, _OPAQUE)],
        }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, content in {META: json.dumps(meta).encode(), **images}.items():
            archive.writestr(zipfile.ZipInfo(name), content)


def make_palette(rows: Floats) -> tuple[Floats, Rows]:
    """Return the palette of SH rows [P,C], and the palette row of each Gaussian. [N,C] -> [P,C], [N]"""
    if len(rows) <= _MAX_PALETTE:
        return rows, np.arange(len(rows))
    order, starts = split_groups(rows, _MAX_PALETTE)
    labels = np.empty(len(rows), np.int64)
    labels[order] = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    centers = _group_means(rows, labels, len(starts) - 1)
    reassign(rows, centers, labels, _REACH)
    used, labels = np.unique(labels, return_inverse=True)
    return _group_means(rows, labels, len(used)), labels


def _group_means(rows: Floats, labels: Rows, count: int) -> Floats:
    """Return the mean row of each group; every group has a row. [N,C], [N] -> [count,C]"""
    order = np.argsort(labels, kind="stable")
    sizes = np.bincount(labels, minlength=count)
    starts = np.cumsum(sizes) - sizes
    sums = np.add.reduceat(rows[order], starts, axis=0, dtype=np.float64)
    means: Floats = (sums / sizes[:, None]).astype(np.float32)
    return means


def _codebook(values: Floats) -> tuple[Doubles, Bytes]:
    """Return 256 values, ascending [256], and the index of the nearest one to each value.

    Half of them follow the cube root of the density, which has the least mean square error. The others are
    evenly spaced, so that rare values differ by 1/256 of the range at most. Then k-means moves them.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    grid = np.linspace(ordered[0], ordered[-1], _CODEBOOK_CELLS + 1)
    density = np.cbrt(np.diff(np.searchsorted(ordered, grid)))
    share = (1.0 - _EVEN_SHARE) * density / max(density.sum(), 1.0) + _EVEN_SHARE / _CODEBOOK_CELLS
    levels = np.concatenate([[0.0], np.cumsum(share)])
    at = (np.arange(_LEVELS) + 0.5) / _LEVELS * levels[-1]
    book = np.interp(at, levels, grid)
    for _ in range(_CODEBOOK_ROUNDS):
        edges = np.searchsorted(ordered, 0.5 * (book[1:] + book[:-1]))
        starts = np.concatenate([[0], edges])
        ends = np.concatenate([edges, [len(ordered)]])
        is_used = ends > starts
        book[is_used] = (sums[ends] - sums[starts])[is_used] / (ends - starts)[is_used]
        book = np.sort(book)
    indices = np.searchsorted(0.5 * (book[1:] + book[:-1]), values)
    return book, indices.astype(np.uint8)


def _rotations(quats: Floats) -> tuple[Rows, Bytes]:
    """Return the index of the largest component of wxyz [N], and bytes of the three others [N,3]."""
    largest = np.abs(quats).argmax(axis=1)
    is_largest = np.arange(4) == largest[:, None]
    signs = np.where(quats[is_largest] < 0, -1.0, 1.0)
    others = quats[~is_largest].reshape(len(quats), 3) * signs[:, None]
    levels = np.rint((others / math.sqrt(2.0) + 0.5) * 255.0)
    return largest, levels.clip(0, 255).astype(np.uint8)


def _palette_image(levels: Bytes) -> Bytes:
    """Return the palette as an image, 64 palette rows in each row of pixels. [P,K,3] -> [P/64,64 K,4]"""
    count, bands, _ = levels.shape
    height = -(-count // _PALETTE_COLUMNS)
    pixels = np.zeros((height * _PALETTE_COLUMNS, bands, 4), np.uint8)
    pixels[:count, :, :3] = levels
    pixels[:, :, 3] = _OPAQUE
    return pixels.reshape(height, _PALETTE_COLUMNS * bands, 4)


def _to_square(pixels: Bytes) -> Bytes:
    """Return rows as an image that is nearly square, filled up with zeros. [N,4] -> [H,W,4]"""
    width = -(-math.isqrt(len(pixels) - 1) // _PIXEL_MULTIPLE) * _PIXEL_MULTIPLE or _PIXEL_MULTIPLE
    height = -(-len(pixels) // width)
    height = -(-height // _PIXEL_MULTIPLE) * _PIXEL_MULTIPLE
    image = np.zeros((height * width, 4), np.uint8)
    image[: len(pixels)] = pixels
    return image.reshape(height, width, 4)


def _encode(pixels: Bytes) -> bytes:
    """Return a lossless WebP image. Colors are kept where alpha is 0."""
    file = io.BytesIO()
    Image.fromarray(pixels, "RGBA").save(file, "WEBP", lossless=True, exact=True, method=_WEBP_METHOD)
    return file.getvalue()
