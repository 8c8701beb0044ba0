"""Gaussians in a binary glTF file (.glb), as the ratified extension KHR_gaussian_splatting stores them.

Points with attributes: linear scales and opacities, quaternions xyzw, a column for each SH coefficient, y up
and z towards the viewer. Programs that do not know the extension show a cloud of colored points.
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting
"""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, concatenate, from_arrays
from progdf.io.json_values import convert_json, decode_json
from progdf.sh import sh0_to_rgb

EXTENSION = "KHR_gaussian_splatting"
MAGIC = b"glTF"
MOST_DEGREE = 3

_FLOAT, _BYTE = 5126, 5121
_TYPES = {5120: "i1", _BYTE: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_JSON, _BIN = 0x4E4F534A, 0x004E4942

_Count = Annotated[int, msgspec.Meta(ge=0)]


class _View(msgspec.Struct):
    byteLength: _Count
    byteOffset: _Count = 0
    byteStride: _Count = 0
    buffer: _Count = 0


class _Accessor(msgspec.Struct):
    componentType: int
    count: _Count
    type: str
    bufferView: _Count
    byteOffset: _Count = 0
    normalized: bool = False


class _Primitive(msgspec.Struct):
    attributes: dict[str, _Count]
    extensions: dict[str, Any] = {}


class _Mesh(msgspec.Struct):
    primitives: list[_Primitive]


class _Node(msgspec.Struct):
    mesh: _Count | None = None
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    matrix: tuple[float, ...] | None = None
    children: list[_Count] = []


class _File(msgspec.Struct):
    meshes: list[_Mesh]
    accessors: list[_Accessor]
    bufferViews: list[_View]
    nodes: list[_Node] = []


def write_glb(path: Path, scene: Gaussians) -> None:
    """Write a scene whose y is up and z towards the viewer, in float32; bands above 3 are left out.

    Args:
        path: the file, which is written over
        scene: N Gaussians; an origin becomes the node's translation
    """
    columns: dict[str, Tensor] = {
        "POSITION": scene.means,
        "COLOR_0": torch.cat([sh0_to_rgb(scene.sh0).clamp(0, 1), scene.opacities[:, None]], dim=1),
        f"{EXTENSION}:ROTATION": scene.unit_quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scene.scales,
        f"{EXTENSION}:OPACITY": scene.opacities[:, None],
    }
    coefficients = scene.sh
    for degree in range(min(MOST_DEGREE, scene.sh_degree) + 1):
        for i in range(2 * degree + 1):
            columns[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = coefficients[:, degree**2 + i]
    views, accessors, parts, at = list[dict[str, Any]](), list[dict[str, Any]](), list[bytes](), 0
    for name, values in columns.items():
        color, table = name == "COLOR_0", values.detach().cpu().float().numpy()
        content = (table * 255).round().astype("u1").tobytes() if color else table.astype("<f4").tobytes()
        accessor: dict[str, Any] = {"bufferView": len(views), "count": len(scene)}
        accessor["componentType"] = _BYTE if color else _FLOAT
        accessor["type"] = next(kind for kind, size in _SIZES.items() if size == table.shape[1])
        if color:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(content), "target": 34962})
        accessors.append(accessor)
        parts.append(content)
        at += len(content)
    look = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
    primitive = {
        "attributes": {name: i for i, name in enumerate(columns)},
        "mode": 0,
        "extensions": {EXTENSION: {**look, "sortingMethod": "cameraDistance"}},
    }
    node = {"mesh": 0} | ({"translation": list(scene.origin)} if scene.origin != ZERO else {})
    table_of_contents = {
        "asset": {"version": "2.0", "generator": "progdf"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": at}],
    }
    text = json.dumps(table_of_contents).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(MAGIC + struct.pack("<II", 2, 12 + 8 + len(text) + 8 + at))
        file.write(struct.pack("<II", len(text), _JSON) + text + struct.pack("<II", at, _BIN))
        file.writelines(parts)


def read_glb(path: Path) -> Gaussians:
    """The Gaussians of a .glb as stored, in its axes: those of all primitives that have the extension.

    Raises:
        ProgdfError: it is broken, holds no Gaussians, or its nodes turn or scale them.
    """
    content = path.read_bytes()
    try:
        size, kind = struct.unpack_from("<II", content, 12)
        if content[:4] != MAGIC or kind != _JSON or 20 + size > len(content):
            raise ValueError("its first part is not the table of contents")
        table = convert_json(decode_json(content[20 : 20 + size]), _File)
        data = memoryview(content)[28 + size :]
        parts = [
            _read_primitive(table, data, primitive, mesh)
            for mesh, one in enumerate(table.meshes)
            for primitive in one.primitives
            if EXTENSION in primitive.extensions
        ]
    except (ValueError, IndexError, KeyError, struct.error) as error:
        raise ProgdfError(f"{path} cannot be read as .glb: {error}; export it again") from None
    if not parts:
        raise ProgdfError(f"{path} holds no Gaussians, which {EXTENSION} stores; give a scene of those")
    bands = min(part.shN.shape[1] for part in parts)
    return concatenate([replace(part, shN=part.shN[:, :bands]) for part in parts])


def _read_primitive(table: _File, data: memoryview, primitive: _Primitive, mesh: int) -> Gaussians:
    def column(name: str) -> NDArray[np.float32]:
        if name not in primitive.attributes:
            raise ValueError(f"it lacks {name}")
        return _read_accessor(table, data, table.accessors[primitive.attributes[name]])

    nodes, still = [node for node in table.nodes if node.mesh == mesh], _Node()
    as_they_are = [
        (node.matrix, node.rotation, node.scale) for node in table.nodes if node.children or node in nodes
    ]
    groups = [node.translation for node in table.nodes if node.children]
    if {*as_they_are} - {(None, still.rotation, still.scale)} or {*groups} - {ZERO} or len(nodes) > 1:
        raise ValueError("its nodes turn, scale or repeat the Gaussians")
    shift = np.array(nodes[0].translation if nodes else (0.0, 0.0, 0.0))
    rest, degree = list[NDArray[np.float32]](), 1
    while f"{EXTENSION}:SH_DEGREE_{degree}_COEF_0" in primitive.attributes and degree <= MOST_DEGREE:
        rest += [column(f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}") for i in range(2 * degree + 1)]
        degree += 1
    means, opacities = column("POSITION"), column(f"{EXTENSION}:OPACITY")[:, 0].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):  # 0 and 1 are infinite, and repaired
        arrays = {
            "means": means.astype(np.float64) + shift if shift.any() else means,
            "quats": column(f"{EXTENSION}:ROTATION")[:, [3, 0, 1, 2]],
            "log_scales": np.log(column(f"{EXTENSION}:SCALE")),
            "logit_opacities": (np.log(opacities) - np.log1p(-opacities)).astype(np.float32),
            "sh0": column(f"{EXTENSION}:SH_DEGREE_0_COEF_0"),
            "shN": np.stack(rest, axis=1) if rest else np.zeros((len(means), 0, 3), np.float32),
        }
    return from_arrays(arrays)


def _read_accessor(table: _File, data: memoryview, accessor: _Accessor) -> NDArray[np.float32]:
    """The numbers of an accessor, normalized integers as shares. [count,size]"""
    view, size = table.bufferViews[accessor.bufferView], _SIZES.get(accessor.type, 0)
    if accessor.componentType not in _TYPES or not size or view.buffer:
        raise ValueError(
            f"an accessor is {accessor.type} of {accessor.componentType}, in buffer {view.buffer}"
        )
    dtype = np.dtype(_TYPES[accessor.componentType])
    stride, first = view.byteStride or size * dtype.itemsize, view.byteOffset + accessor.byteOffset
    last = first + max(0, accessor.count - 1) * stride + size * dtype.itemsize
    if not accessor.count or stride < size * dtype.itemsize or last > len(data):
        raise ValueError("an accessor lies outside its data")
    values = np.ndarray((accessor.count, size), dtype, data, first, (stride, dtype.itemsize)).astype(
        np.float32
    )
    if accessor.normalized and dtype.kind != "f":
        values = np.maximum(values / np.iinfo(dtype).max, -1.0)
    return values
