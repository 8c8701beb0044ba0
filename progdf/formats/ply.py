"""3DGS .ply <-> Gaussians.

The file's own words: x y z, f_dc_0..2, f_rest_* (channel-major), opacity (logit), scale_0..2 (log), rot_0..3
(wxyz). Anything else is reported and not used. Rows are never dropped, as labels and .gdf files count on
their indices: an unusable row becomes an invisible Gaussian (see `progdf.formats.repair`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.io.atomic import atomic_write, open_error

from .load_report import LoadReport
from .ply_header import ANTIALIASED_COMMENT, Element, PlyHeader, read_header
from .ply_rows import BLOCK_ROWS, read_blocks
from .repair import repair

Floats = npt.NDArray[np.float32]

_log = logging.getLogger(__name__)

GEOMETRY = {
    "means": ("x", "y", "z"),
    "sh0": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacities": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
"""The columns of each attribute that every 3DGS .ply has."""
_NORMALS = ("nx", "ny", "nz")
_SH_REST = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}
_MOST_THREADS = 4


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """The scene in a 3DGS .ply file, float32; what had to be repaired is logged as a warning.

    Quaternions come out with unit length, wxyz. Rows keep their order and number.

    Raises:
        ProgdfError: the file is missing, broken, holds no Gaussians, or is no 3DGS .ply.
    """
    scene, report = load_ply_with_report(path)
    for phrase in report.repairs:
        _log.warning("%s: repaired: %s", report.file, phrase)
    return scene


def load_ply_with_report(path: str | os.PathLike[str]) -> tuple[Gaussians, LoadReport]:
    """As `load_ply`, with the report of what the file held and what was repaired."""
    header = read_header(path)
    name = os.fspath(path)
    vertex = _vertex(name, header)
    rest = _check_properties(name, header, vertex)
    columns = dict(GEOMETRY)
    columns["shN"] = tuple(f"f_rest_{i}" for i in range(rest))
    used = tuple(column for names in columns.values() for column in names)
    attributes = {key: np.empty((vertex.count, len(names)), np.float32) for key, names in columns.items()}
    store = _store_into(attributes, columns)
    try:
        trailing = read_blocks(path, header, vertex, used, store, _threads(vertex.count))
    except OSError as error:
        raise open_error(path, error) from None
    scene, counts = repair(replace(_gaussians(attributes), antialiased=header.antialiased))
    return scene, LoadReport(
        file=Path(path).name,
        file_bytes=header.file_size,
        format=header.format.replace("_", " ").replace(" endian", "-endian"),
        count=vertex.count,
        sh_degree=_SH_REST[rest],
        antialiased=header.antialiased,
        ignored_properties=tuple(p for p in vertex.names if p not in used and p not in _NORMALS),
        ignored_elements=tuple((e.name, e.count) for e in header.elements if e is not vertex),
        trailing_bytes=trailing,
        **counts,
    )


def save_ply(path: str | os.PathLike[str], scene: Gaussians) -> None:
    """Write a 3DGS .ply: binary little-endian float32, properties in the order of the original 3DGS code.

    The file appears whole or not at all, and says if the scene is anti-aliased. If the quaternions have unit
    length it loads to the same bits.

    Raises:
        ProgdfError: the scene is empty or holds a NaN or an infinity, or the folder does not exist.
    """
    if not len(scene):
        raise ProgdfError(f"{path} was not written: the scene has no Gaussians; a .ply needs at least one")
    for key in ATTRIBUTES:
        if not bool(getattr(scene, key).isfinite().all()):
            raise ProgdfError(f"{path} was not written: {key} holds NaN or infinity; repair the scene first")
    arrays = {key: _numpy(scene, key) for key in ATTRIBUTES}
    higher = arrays["shN"].shape[1]
    names = (
        "x",
        "y",
        "z",
        *_NORMALS,
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        *(f"f_rest_{i}" for i in range(3 * higher)),
    )
    names += ("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    head = ["ply", "format binary_little_endian 1.0"]
    head += [f"comment {ANTIALIASED_COMMENT}"] if scene.antialiased else []
    head += [f"element vertex {len(scene)}"]
    head += [f"property float {name}" for name in names]
    with atomic_write(path) as temporary_file, temporary_file.open("wb") as file:
        file.write(("\n".join([*head, "end_header"]) + "\n").encode("ascii"))
        for start in range(0, len(scene), BLOCK_ROWS):
            part = {key: array[start : start + BLOCK_ROWS] for key, array in arrays.items()}
            rows = len(part["means"])
            block = np.concatenate(
                [
                    part["means"],
                    np.zeros((rows, 3), np.float32),
                    part["sh0"],
                    part["shN"].transpose(0, 2, 1).reshape(rows, -1),
                    part["logit_opacities"][:, None],
                    part["log_scales"],
                    part["quats"],
                ],
                axis=1,
            )
            file.write(block.astype("<f4", copy=False).tobytes())


def _vertex(name: str, header: PlyHeader) -> Element:
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    if vertex is None:
        packed = any(element.name == "chunk" for element in header.elements)
        raise ProgdfError(f"{name} has no element 'vertex'" + ("" if packed else "; it is not a 3DGS .ply"))
    return vertex


def _check_properties(name: str, header: PlyHeader, vertex: Element) -> int:
    """The number of f_rest properties, once every property that 3DGS needs is known to be there."""
    present = {column.name for column in vertex.properties if not column.count_type}
    missing = [column for names in GEOMETRY.values() for column in names if column not in present]
    if missing:
        raise ProgdfError(f"{name} {_describe(header, present, missing)}")
    rest = sum(column.startswith("f_rest_") for column in present)
    absent = next((f"f_rest_{i}" for i in range(rest) if f"f_rest_{i}" not in present), None)
    if rest not in _SH_REST or absent:
        raise ProgdfError(
            f"{name} has {rest} f_rest properties{f' without {absent}' if absent else ''}; "
            f"expected 0, 9, 24, 45 or 72: export it again"
        )
    if not vertex.count:
        raise ProgdfError(f"{name} holds 0 Gaussians; a scene needs at least one: export it again")
    return rest


def _describe(header: PlyHeader, present: set[str], missing: list[str]) -> str:
    if "packed_position" in present:
        return "is a compressed .ply; open it with load_scene"
    if missing == ["scale_2"]:
        return "has no scale_2, so it holds 2D Gaussians; a 3DGS .ply has scale_0, scale_1 and scale_2"
    listed = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
    if {"f_dc_0", "opacity", "scale_0", "rot_0"} & present:
        return f"lacks {listed}, which a 3DGS .ply has; export it again"
    kind = "a mesh" if any(element.name == "face" for element in header.elements) else "a point cloud"
    return f"is {kind}, not a Gaussian scene: it lacks {listed}; train one with 3DGS and give its .ply"


def _store_into(
    attributes: dict[str, Floats], columns: dict[str, tuple[str, ...]]
) -> Callable[[int, Floats, dict[str, int]], None]:
    """The function that takes a block of rows apart: (first row, block [B,P], column of each property)."""

    def store(first: int, block: Floats, where: dict[str, int]) -> None:
        for key, names in columns.items():
            if not names:
                continue
            target = attributes[key][first : first + len(block)]
            index = [where[name] for name in names]
            run = index == list(range(index[0], index[0] + len(index)))
            source = block[:, index[0] : index[0] + len(index)] if run else block[:, index]
            if key == "shN":  # channel-major in the file, rgb innermost here
                source = source.reshape(len(block), 3, -1).transpose(0, 2, 1)
                target = target.reshape(source.shape)
            np.copyto(target, source)

    return store


def _gaussians(attributes: dict[str, Floats]) -> Gaussians:
    tensors: dict[str, Any] = {key: torch.from_numpy(array) for key, array in attributes.items()}
    tensors["logit_opacities"] = tensors["logit_opacities"][:, 0]
    count, rest = tensors["shN"].shape
    tensors["shN"] = tensors["shN"].reshape(count, rest // 3, 3)
    return Gaussians(**tensors)


def _numpy(scene: Gaussians, key: str) -> Floats:
    return np.asarray(getattr(scene, key).detach().cpu().to(torch.float32).numpy())


def _threads(count: int) -> int:
    return 1 if count < 4 * BLOCK_ROWS else min(_MOST_THREADS, os.cpu_count() or 1)
