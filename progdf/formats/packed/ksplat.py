"""Readers of .splat (antimatter15's viewer) and .ksplat (GaussianSplats3D).

A .splat has rows of 32 bytes without a header: float32 positions and linear scales, then bytes of color,
opacity and rotation.

A .ksplat has a header of 4096 bytes, a header of 1024 bytes per section, then the sections: the centers of
buckets, and rows. Level 0 stores float32. Levels 1 and 2 store positions as shares of their bucket's size,
and other numbers as half floats. SH coefficients of level 2 are bytes. Colors and opacities are bytes. SH
coefficients are stored band by band, channel-major within a band.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from progdf.errors import ProgdfError
from progdf.formats.repair import logits_of_shares
from progdf.gaussians import Gaussians, from_arrays
from progdf.io.atomic import read_file
from progdf.io.file_rules import damage_error, unsupported_error
from progdf.sh import C0

_HEADER_BYTES = 4096
_SECTION_HEADER_BYTES = 1024
_CONVERT = "convert it with `splat-transform in.ksplat out.ply`"
_SH_REST = (0, 9, 24, 45)  # SH coefficients per Gaussian above band 0, by SH degree
_SH_TYPES = ("<f4", "<f2", "u1")  # type of SH coefficients, by compression level
_SPLAT_DTYPE = np.dtype([("xyz", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_MIN_SCALE = 2e-9
"""Replacement for a scale of 0, whose logarithm is not finite; see `repair.FLAT_LOG_SCALE`."""

Floats = npt.NDArray[np.float32]


_SECTION_FIELDS = {
    "rows": ("<u4", 0),
    "most_rows": ("<u4", 4),
    "bucket_size": ("<u4", 8),
    "buckets": ("<u4", 12),
    "block": ("<f4", 16),
    "bucket_bytes": ("<u2", 20),
    "quantum": ("<u4", 24),
    "full_buckets": ("<u4", 32),
    "partial_buckets": ("<u4", 36),
    "degree": ("<u2", 40),
}
"""Type and byte offset of each field in a section's header."""


def read_splat(path: str | os.PathLike[str]) -> Gaussians:
    """Return the scene as stored in a .splat file.

    Raises:
        ProgdfError: the size of the file is not a multiple of 32 bytes.
    """
    content = read_file(path)
    if len(content) % _SPLAT_DTYPE.itemsize:
        raise damage_error(path, f"a .splat has rows of 32 bytes, the file has {len(content)} bytes")
    rows = np.frombuffer(content, _SPLAT_DTYPE)
    sh0, logits = _decode_colors(rows["rgba"])
    arrays = {
        "means": rows["xyz"].astype(np.float32),
        "quats": (rows["quat"].astype(np.float32) - 128.0) / 128.0,
        "log_scales": _logs(rows["scale"].astype(np.float32)),
        "logit_opacities": logits,
        "sh0": sh0,
        "shN": np.zeros((len(rows), 0, 3), np.float32),
    }
    return from_arrays(arrays)


def read_ksplat(path: str | os.PathLike[str]) -> tuple[Gaussians, int]:
    """Return the scene as stored in a .ksplat file, and its compression level, 0 to 2.

    Raises:
        ProgdfError: the version, the level or the SH degree is not supported, or the file is damaged.
    """
    content = read_file(path)
    if len(content) < _HEADER_BYTES:
        raise damage_error(
            path, f"the header of a .ksplat has {_HEADER_BYTES} bytes, the file {len(content)}"
        )
    if content[0] != 0 or content[1] < 1:
        raise unsupported_error(path, f".ksplat version {content[0]}.{content[1]}", _CONVERT)
    level = _number(content, 20, "<u2")
    sections = _number(content, 4, "<u4")
    if level > 2:
        raise unsupported_error(path, f"compression level {level} (0, 1 and 2 are)", _CONVERT)
    if _HEADER_BYTES + sections * _SECTION_HEADER_BYTES > len(content):
        raise damage_error(path, f"it ends within the headers of its {sections} sections")
    low, high = (float(np.frombuffer(content, "<f4", 1, at)[0]) for at in (36, 40))
    sh_range = (low or -1.5, high or 1.5)
    at = _HEADER_BYTES + sections * _SECTION_HEADER_BYTES
    parts = []
    for head in range(_HEADER_BYTES, _HEADER_BYTES + sections * _SECTION_HEADER_BYTES, _SECTION_HEADER_BYTES):
        fields = _SECTION_FIELDS.items()
        section = {name: np.frombuffer(content, t, 1, head + o).item() for name, (t, o) in fields}
        if not section["rows"] and not section["most_rows"]:
            continue
        if section["degree"] > 3:
            raise unsupported_error(path, f"SH degree {section['degree']}", _CONVERT)
        row = _row_layout(level, section["degree"])
        centers_at = at + 4 * section["partial_buckets"]
        rows_at = centers_at + section["bucket_bytes"] * section["buckets"]
        end = rows_at + row.itemsize * section["most_rows"]
        if end > len(content):
            raise damage_error(path, f"a section ends at byte {end}, the file has {len(content)}")
        if section["rows"] > section["most_rows"]:
            raise damage_error(path, f"a section of {section['most_rows']} rows claims {section['rows']}")
        rows = np.frombuffer(content, row, section["rows"], rows_at)
        centers = _centers(path, content, section, at, centers_at) if level else None
        parts.append(_unpack(rows, section, centers, level, sh_range))
        at = end
    count = sum(len(part["means"]) for part in parts)
    declared = _number(content, 16, "<u4")
    if count != declared:
        raise damage_error(path, f"it declares {declared} Gaussians, its sections hold {count}")
    if not count:
        raise ProgdfError(f"{path} holds 0 Gaussians; a scene needs at least one: export it again")
    max_bands = max(part["shN"].shape[1] for part in parts)
    for part in parts:
        part["shN"] = np.pad(part["shN"], ((0, 0), (0, max_bands - part["shN"].shape[1]), (0, 0)))
    arrays = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return from_arrays(arrays), level


def _row_layout(level: int, degree: int) -> np.dtype[np.void]:
    small = [("xyz", "<u2", 3), ("scale", "<f2", 3), ("quat", "<f2", 4), ("rgba", "u1", 4)]
    large = [("xyz", "<f4", 3), ("scale", "<f4", 3), ("quat", "<f4", 4), ("rgba", "u1", 4)]
    return np.dtype([*(small if level else large), ("sh", _SH_TYPES[level], _SH_REST[degree])])


def _unpack(
    rows: npt.NDArray[np.void],
    section: Mapping[str, Any],
    centers: Floats | None,
    level: int,
    sh_range: tuple[float, float],
) -> dict[str, Floats]:
    means: Floats = rows["xyz"].astype(np.float32)
    if centers is not None:
        quantum = section["quantum"] or 32767
        means = np.asarray((means - quantum) * (section["block"] / 2 / quantum) + centers, np.float32)
    sh0, logits = _decode_colors(rows["rgba"])
    sh = rows["sh"].astype(np.float32).reshape(len(rows), -1)
    if level == 2:
        sh = np.asarray(sh_range[0] + sh / 255 * (sh_range[1] - sh_range[0]), np.float32)
    bands = [sh[:, 3 * (l * l - 1) : 3 * ((l + 1) ** 2 - 1)] for l in range(1, section["degree"] + 1)]
    higher = [band.reshape(len(rows), 3, -1).transpose(0, 2, 1) for band in bands]
    return {
        "means": means,
        "quats": rows["quat"].astype(np.float32),
        "log_scales": _logs(rows["scale"].astype(np.float32)),
        "logit_opacities": logits,
        "sh0": sh0,
        "shN": np.concatenate([np.zeros((len(rows), 0, 3), np.float32), *higher], axis=1),
    }


def _decode_colors(rgba: npt.NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """Decode RGBA bytes to SH band 0 and opacity logits. [N,4] -> [N,3] and [N]"""
    shares = rgba.astype(np.float32) / 255
    logits = logits_of_shares(shares[:, 3]).astype(np.float32)
    sh0 = (shares[:, :3] - 0.5) / np.float32(C0)
    return np.asarray(sh0, np.float32), logits


def _logs(scales: Floats) -> Floats:
    """Return log-scales. A scale of 0 becomes very small, a negative one NaN."""
    with np.errstate(invalid="ignore"):
        logs: Floats = np.log(np.where(scales == 0, np.float32(_MIN_SCALE), scales))
    return logs


def _centers(
    path: str | os.PathLike[str], content: bytes, section: Mapping[str, Any], sizes_at: int, centers_at: int
) -> Floats:
    """Return the center of each row's bucket. [N,3]

    Full buckets come first, then the partial ones, whose sizes are in the file.
    """
    sizes = np.frombuffer(content, "<u4", section["partial_buckets"], sizes_at).astype(np.int64)
    full_rows = section["full_buckets"] * section["bucket_size"]
    ends = np.concatenate([[full_rows], full_rows + np.cumsum(sizes)])
    index = np.arange(section["rows"])
    later = section["full_buckets"] + np.searchsorted(ends[1:], index, side="right")
    bucket = np.where(index < full_rows, index // max(section["bucket_size"], 1), later)
    if section["bucket_bytes"] < 12 or (len(index) and int(bucket.max()) >= section["buckets"]):
        raise damage_error(path, "a row refers to a missing bucket")
    kind = np.dtype({"names": ["xyz"], "formats": [("<f4", 3)], "itemsize": section["bucket_bytes"]})
    centers: Floats = np.frombuffer(content, kind, section["buckets"], centers_at)["xyz"][bucket]
    return centers


def _number(content: bytes, at: int, kind: str) -> int:
    return int(np.frombuffer(content, kind, 1, at)[0])
