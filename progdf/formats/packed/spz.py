"""Writer of .spz version 3 (Niantic). A file is gzip data: a header, then a block of bytes per attribute.

    position    24 bits per coordinate, fixed point
    opacity     8 bits
    color       8 bits per channel, range of about ±3.3 around 0.5
    scale       8 bits per axis, log-scale in steps of 1/16 from −10
    rotation    index of the largest component (xyzw) and the three others, 10 bits each
    SH bands    5 bits per coefficient of degree 1, 4 bits above, in bytes

Axes are those of the file (y up, z towards the viewer). The library gaussforge reads the files, and writes
the same bytes in the tests.
"""

from __future__ import annotations

import gzip
import struct
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians

MAGIC = b"NGSP"
ANTIALIASED = 1
"""Flag of a scene that was trained with antialiasing."""

MAX_BITS = 12
"""Fractional bits of a position, for scenes that stay within ±2048."""

MAX_STEPS = 2**23 - 1
"""Largest coordinate, in steps of 2^-bits."""

_VERSION = 3
_GZIP_LEVEL = 6  # level 9 takes 4.5 times as long for 2 % fewer bytes
_COLOR_SCALE = 0.15  # share of the byte range per unit of SH band 0
_SCALE_OFFSET = 10.0  # added to a log-scale
_STEPS_PER_LOG = 16.0
_ROTATION_LEVELS = 511.0  # of a component between 0 and √½
_SH_LEVELS = 128.0  # per unit of a coefficient
_BAND_ONE = 3  # SH functions of degree 1
_FIRST_STEP = 8  # bytes per step of a coefficient of degree 1
_STEP = 16  # bytes per step of a coefficient of a higher degree

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]
_Real = TypeVar("_Real", np.float32, np.float64)


def position_bits(scene: Gaussians) -> int:
    """Return the number of fractional bits with which all positions fit into 24 bits; negative if none."""
    farthest = float(scene.world_means.abs().max())
    bits = MAX_BITS
    while bits >= 0 and farthest * 2.0**bits > MAX_STEPS:
        bits -= 1
    return bits


def range_error(path: Path, scene: Gaussians) -> ProgdfError:
    """Return the error for a scene that exceeds the range of an .spz."""
    means = scene.world_means
    row, axis = divmod(int(means.abs().argmax()), 3)
    return ProgdfError(
        f"{path} was not written: {'xyz'[axis]} of Gaussian {row} is {float(means[row, axis]):.7g}, "
        f"and an .spz holds ±{MAX_STEPS}; write a .ply, or a scene nearer to 0"
    )


def write_spz(path: Path, scene: Gaussians, bits: int) -> None:
    """Write a scene, with its rows in their order.

    Args:
        path: the file, which is overwritten
        scene: N Gaussians of SH degree 3 at most, finite, in the axes of the file
        bits: fractional bits of a position, see `position_bits`
    """
    flags = ANTIALIASED if scene.antialiased else 0
    header = MAGIC + struct.pack("<IIBBBB", _VERSION, len(scene), scene.sh_degree, bits, flags, 0)
    colors = scene.sh0.numpy() * np.float32(_COLOR_SCALE * 255.0) + np.float32(0.5 * 255.0)
    scales = (scene.log_scales.numpy() + np.float32(_SCALE_OFFSET)) * np.float32(_STEPS_PER_LOG)
    blocks = (
        _positions(scene, bits),
        _to_bytes(scene.opacities.numpy() * np.float32(255.0)),
        _to_bytes(colors),
        _to_bytes(scales),
        _rotations(scene.unit_quats.numpy()),
        _higher_bands(scene.shN.numpy()),
    )
    content = b"".join([header, *(block.tobytes() for block in blocks)])
    path.write_bytes(gzip.compress(content, _GZIP_LEVEL, mtime=0))


def _positions(scene: Gaussians, bits: int) -> Bytes:
    """Return the coordinates as 24-bit integers, lowest byte first. [N,3,3]"""
    steps = _round_away((scene.world_means * 2.0**bits).numpy())
    words = np.ascontiguousarray(steps.astype("<i4"))
    return words.view(np.uint8).reshape(len(scene), 3, 4)[:, :, :3]


def _rotations(quats: Floats) -> npt.NDArray[np.uint32]:
    """Pack unit quaternions wxyz: index of the largest component of xyzw, sign and size of the others. [N]"""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest = np.abs(xyzw).argmax(axis=1)
    is_largest = np.arange(4) == largest[:, None]
    is_flipped = xyzw[is_largest] < 0
    others = xyzw[~is_largest].reshape(len(xyzw), 3)
    shares = np.abs(others) / np.float32(np.sqrt(0.5))
    sizes = (np.float32(_ROTATION_LEVELS) * shares + np.float32(0.5)).astype(np.uint32)
    signs = ((others < 0) ^ is_flipped[:, None]).astype(np.uint32)
    parts = (signs << 9) | sizes
    words = largest.astype(np.uint32) << 30
    for part, shift in zip(parts.T, (20, 10, 0), strict=True):
        words |= part << shift
    packed: npt.NDArray[np.uint32] = words.astype("<u4")
    return packed


def _higher_bands(bands: Floats) -> Bytes:
    """Quantize the SH coefficients above band 0 to the middles of their steps. [N,K,3] -> [N,K,3]"""
    levels = _round_away(bands * np.float32(_SH_LEVELS)).clip(-1024, 1024).astype(np.int16) + 128
    steps = np.full((levels.shape[1], 1), _STEP, np.int16)
    steps[:_BAND_ONE] = _FIRST_STEP
    rounded = (levels + steps // 2) // steps * steps
    return rounded.clip(0, 255).astype(np.uint8)


def _to_bytes(values: Floats) -> Bytes:
    """Round to bytes; values outside 0 to 255 are clamped."""
    return _round_away(values.clip(0.0, 255.0)).astype(np.uint8)


def _round_away(values: npt.NDArray[_Real]) -> npt.NDArray[_Real]:
    """Round to the nearest integer, halves away from 0, as C++ does."""
    rounded: npt.NDArray[_Real] = np.trunc(values + np.copysign(values.dtype.type(0.5), values))
    return rounded
