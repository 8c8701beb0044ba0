"""Compressed .ply (SuperSplat, splat-transform): 16 bytes per Gaussian in chunks of 256, plus SH bytes.

Positions, log-scales and, in newer files, colors are stored as shares of the range of their chunk. A rotation
is stored as the three smaller components of its quaternion. Opacities are bytes. The bytes of f_rest cover
−4 to 4.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.formats.ply_file import ANTIALIASED_COMMENT, PlyFile
from progdf.formats.repair import logits_of_shares
from progdf.gaussians import ATTRIBUTES, Gaussians, from_arrays
from progdf.io.file_rules import damage_error, unsupported_error
from progdf.sh import C0

_CHUNK_ROWS = 256
_CONVERT = "convert it with `splat-transform in.ply out.compressed.ply`"
_MORTON_BITS = 21  # per axis: three axes fit into 63 bits
_SPREAD_STEPS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that move groups of 16, 8, 4, 2 and 1 bits apart, so that two bits fit between two."""
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_XYZ = ("x", "y", "z")
_SCALES = ("scale_x", "scale_y", "scale_z")
_RGB = ("r", "g", "b")
_SH_REST = (0, 9, 24, 45)  # number of f_rest properties for SH degree 0 to 3

Floats = npt.NDArray[np.float32]


def is_compressed(ply: PlyFile) -> bool:
    """Return whether the Gaussians of a .ply are packed."""
    return "packed_position" in ply.columns("vertex")


def read_compressed_ply(ply: PlyFile) -> tuple[Gaussians, tuple[str, ...]]:
    """Return the scene as stored, and the names of unused vertex properties.

    Raises:
        ProgdfError: an element is missing or does not match the others, or a feature is not supported.
    """
    name = ply.path
    count = ply.counts["vertex"]
    counts = ply.counts
    if ply.layout.text:
        raise unsupported_error(name, "packed Gaussians as text (format ascii)", _CONVERT)
    if not count:
        raise ProgdfError(f"{name} holds 0 Gaussians; a scene needs at least one: export it again")
    chunks = -(-count // _CHUNK_ROWS)
    if counts.get("chunk") != chunks:
        found = counts.get("chunk", 0)
        raise damage_error(name, f"{count} packed Gaussians need {chunks} chunks, and it has {found}")
    vertex, chunk, sh = (ply.columns(element) for element in ("vertex", "chunk", "sh"))
    if "sh" in counts and counts["sh"] != count:
        raise damage_error(name, f"the element 'sh' has {counts['sh']} rows for {count} Gaussians")
    if len(sh) not in _SH_REST:
        raise unsupported_error(name, f"{len(sh)} SH coefficients (0, 9, 24 or 45 are)", _CONVERT)
    wide = next((column for column, kind in sh.items() if kind != "u1"), None)
    if wide:
        raise unsupported_error(name, f"'{wide}' of a type other than uchar", _CONVERT)
    ranged = [_XYZ, _SCALES]
    if "min_r" in chunk:
        ranged.append(_RGB)
    needed = [f"{edge}_{name}" for names in ranged for name in names for edge in ("min", "max")]
    missing = [n for n in needed if n not in chunk] + [n for n in _PACKED if n not in vertex]
    if missing:
        raise damage_error(name, f"a compressed .ply has {missing[0]}, and this one lacks it")
    other = next((column for column in _PACKED if vertex[column] != "u4"), None)
    if other:
        raise unsupported_error(name, f"'{other}' of a type other than uint", _CONVERT)
    elements = ["chunk", "vertex"]
    if sh:
        elements.append("sh")
    (ranges, packed, *bands), _ = ply.rows(*elements)
    chunk_of_row = np.arange(count) // _CHUNK_ROWS
    position, rotation, scale, color = (packed[column].astype(np.uint32) for column in _PACKED)
    rgba = _unpack_shares(color, (24, 16, 8, 0), (8, 8, 8, 8))
    rgb = rgba[:, :3] if "min_r" not in chunk else _dequantize(ranges, chunk_of_row, rgba, _RGB)
    logits = logits_of_shares(rgba[:, 3])
    higher = np.zeros((count, 0, 3), np.float32)
    if bands:
        higher = _higher_bands(name, bands[0], len(sh))
    arrays = {
        "means": _dequantize(ranges, chunk_of_row, _unpack_shares(position, (21, 11, 0), (11, 10, 11)), _XYZ),
        "quats": _quats(rotation),
        "log_scales": _dequantize(
            ranges, chunk_of_row, _unpack_shares(scale, (21, 11, 0), (11, 10, 11)), _SCALES
        ),
        "logit_opacities": logits.astype(np.float32),
        "sh0": (rgb - 0.5) / C0,
        "shN": higher,
    }
    ignored = tuple(column for column in vertex if column not in _PACKED)
    return from_arrays(arrays, ply.antialiased), ignored


def write_compressed_ply(path: Path, scene: Gaussians) -> None:
    """Write the rows in their order, each value rounded to the nearest level of its chunk's range.

    A scene in `morton_order` loses least, as neighbors share a chunk.

    Args:
        path: the file, which is overwritten
        scene: N Gaussians of SH degree 3 at most, finite
    """
    arrays: dict[str, Floats] = {name: getattr(scene, name).cpu().numpy() for name in ATTRIBUTES}
    count = len(scene)
    chunk_of_row = np.arange(len(scene)) // _CHUNK_ROWS
    starts = np.arange(0, count, _CHUNK_ROWS)
    values = {
        _XYZ: scene.world_means.cpu().numpy().astype(np.float32),
        _SCALES: arrays["log_scales"].clip(-20.0, 20.0),
        _RGB: arrays["sh0"] * C0 + 0.5,
    }
    edges = {"min": np.minimum.reduceat, "max": np.maximum.reduceat}
    ranges = np.zeros(
        len(starts), [(f"{edge}_{name}", "<f4") for names in values for edge in edges for name in names]
    )
    shares = dict[tuple[str, ...], Floats]()
    for names, table in values.items():
        low, high = (edge(table, starts, axis=0) for edge in edges.values())
        for i, name in enumerate(names):
            ranges[f"min_{name}"] = low[:, i]
            ranges[f"max_{name}"] = high[:, i]
        span = np.where(high > low, high - low, 1.0)
        shares[names] = ((table - low[chunk_of_row]) / span[chunk_of_row]).astype(np.float32)
    quats = scene.unit_quats.cpu().numpy()
    largest_index = np.abs(quats).argmax(axis=1)
    quats = quats * np.where(np.take_along_axis(quats, largest_index[:, None], axis=1) < 0, -1.0, 1.0)
    others = quats[np.arange(4) != largest_index[:, None]].reshape(count, 3)
    rotation = _pack_shares(others / np.float32(np.sqrt(2.0)) + 0.5, (20, 10, 0), (10, 10, 10))
    rgba = np.concatenate([shares[_RGB], scene.opacities.cpu().numpy()[:, None]], axis=1)
    words = (
        _pack_shares(shares[_XYZ], (21, 11, 0), (11, 10, 11)),
        rotation | (largest_index.astype(np.uint32) << 30),
        _pack_shares(shares[_SCALES], (21, 11, 0), (11, 10, 11)),
        _pack_shares(rgba, (24, 16, 8, 0), (8, 8, 8, 8)),
    )
    packed = np.zeros(count, [(name, "<u4") for name in _PACKED])
    for name, column in zip(_PACKED, words, strict=True):
        packed[name] = column
    elements = [PlyElement.describe(ranges, "chunk"), PlyElement.describe(packed, "vertex")]
    bands = arrays["shN"].shape[1]
    if bands:
        levels = arrays["shN"].transpose(0, 2, 1).reshape(count, 3 * bands) * np.float32(256.0 / 8.0)
        levels += np.float32(0.5 * 256.0)
        table = levels.clip(0, 255, out=levels).astype("u1")
        rows = np.ascontiguousarray(table).view([(f"f_rest_{i}", "u1") for i in range(3 * bands)])[:, 0]
        elements.append(PlyElement.describe(rows, "sh"))
    comments = [ANTIALIASED_COMMENT] if scene.antialiased else []
    PlyData(elements, byte_order="<", comments=comments).write(str(path))


def position_steps(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """Return the quantization step of each coordinate in a file, and the largest coordinate of its chunk.

    A reader computes with the ends of the chunk's range, so its float32 rounding is that of the largest end.

    Args:
        scene: N Gaussians in the order of the file

    Returns:
        Steps and largest absolute coordinates, world units. [N,3] float64 each
    """
    means = scene.world_means.float().numpy()
    starts = np.arange(0, len(means), _CHUNK_ROWS)
    low = np.minimum.reduceat(means, starts, axis=0).astype(np.float64)
    high = np.maximum.reduceat(means, starts, axis=0).astype(np.float64)
    steps = (high - low) / np.array([2.0**11 - 1, 2.0**10 - 1, 2.0**11 - 1])
    largest = np.maximum(np.abs(low), np.abs(high))
    chunk_of_row = np.arange(len(means)) // _CHUNK_ROWS
    return torch.from_numpy(steps[chunk_of_row]), torch.from_numpy(largest[chunk_of_row])


def morton_order(means: Tensor) -> Tensor:
    """Return the rows in Z-order (Morton order) of their bounding box, so that neighbors are close in space.

    Args:
        means: [N,3]

    Returns:
        Permutation of the rows. [N] int64
    """
    low = means.amin(dim=0)
    span = (means.amax(dim=0) - means.amin(dim=0)).clamp_min(1e-30)
    cells = ((means - low) / span * (2**_MORTON_BITS - 1)).long()
    x, y, z = cells.unbind(1)
    code = _spread_bits(x) | _spread_bits(y) << 1 | _spread_bits(z) << 2
    return code.argsort(stable=True)


def _spread_bits(numbers: Tensor) -> Tensor:
    """Move bit i of numbers of `_MORTON_BITS` bits to bit 3 i, by halving groups of bits. [N] int64"""
    spread = numbers
    for shift, mask in _SPREAD_STEPS:
        spread = (spread | spread << shift) & mask
    return spread


def _pack_shares(shares: Floats, shifts: tuple[int, ...], bits: tuple[int, ...]) -> npt.NDArray[np.uint32]:
    """Pack shares 0 to 1 into bit fields of 32-bit words, rounded to the nearest level. [N,parts] -> [N]"""
    max_levels = np.array([2**b - 1 for b in bits])
    parts = (shares.clip(0.0, 1.0) * max_levels).round().astype(np.uint32)
    words: npt.NDArray[np.uint32] = np.bitwise_or.reduce(parts << np.array(shifts, np.uint32), axis=1)
    return words


def _unpack_shares(words: npt.NDArray[np.uint32], shifts: tuple[int, ...], bits: tuple[int, ...]) -> Floats:
    """Unpack bit fields of 32-bit words to shares 0 to 1. [N] -> [N,parts]"""
    parts = [((words >> s) & (2**b - 1)) / np.float32(2**b - 1) for s, b in zip(shifts, bits, strict=True)]
    return np.stack(parts, axis=1).astype(np.float32)


def _dequantize(
    ranges: npt.NDArray[np.void], at: npt.NDArray[np.int64], share: Floats, names: tuple[str, ...]
) -> Floats:
    """Return values from shares of the range of their chunk. [N,3]

    Args:
        ranges: rows of the element `chunk`
        at: chunk of each Gaussian. [N]
        share: position in the range, 0 to 1. [N,3]
        names: channels of the range
    """
    columns = []
    for i, name in enumerate(names):
        low, high = (ranges[f"{edge}_{name}"].astype(np.float32)[at] for edge in ("min", "max"))
        with np.errstate(over="ignore", invalid="ignore"):  # damaged ranges are repaired later
            columns.append(low * (1 - share[:, i]) + high * share[:, i])
    return np.stack(columns, axis=1)


def _quats(packed: npt.NDArray[np.uint32]) -> Floats:
    """Decode quaternions wxyz from the index of the largest component and the three others. [N] -> [N,4]"""
    others = (_unpack_shares(packed, (20, 10, 0), (10, 10, 10)) - 0.5) * np.float32(np.sqrt(2.0))
    largest = np.sqrt(np.maximum(0.0, 1.0 - (others**2).sum(axis=1)))
    largest_index = (packed >> 30).astype(np.int64)
    quats = np.empty((len(packed), 4), np.float32)
    other_indices = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest_index]
    np.put_along_axis(quats, other_indices, others, axis=1)
    np.put_along_axis(quats, largest_index[:, None], largest[:, None].astype(np.float32), axis=1)
    return quats


def _higher_bands(name: Path, rows: npt.NDArray[np.void], count: int) -> Floats:
    """Decode f_rest_0 … (channel-major bytes for −4 to 4) to SH bands above 0. [N,K,3]"""
    names = [f"f_rest_{i}" for i in range(count)]
    absent = next((column for column in names if column not in (rows.dtype.names or ())), None)
    if absent:
        raise damage_error(
            name, f"{count} SH coefficients are f_rest_0 to f_rest_{count - 1}, {absent} is missing"
        )
    if rows.dtype.names == tuple(names):  # as written by SuperSplat: the rows are a table of bytes
        levels = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), count)
    else:
        levels = np.stack([rows[column] for column in names], axis=1)
    shares = (np.arange(256, dtype=np.float32) + 0.5) / 256.0
    shares[0] = 0.0
    shares[255] = 1.0
    values = ((shares - 0.5) * 8.0).astype(np.float32)
    bands: Floats = values[np.ascontiguousarray(levels.reshape(len(rows), 3, -1).transpose(0, 2, 1))]
    return bands
