"""Gaussians in glTF files, by the ratified extension KHR_gaussian_splatting.

A point primitive stores linear scales and opacities, quaternions xyzw and one attribute per SH coefficient.
Programs that do not know the extension show a cloud of colored points.
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting

Axes: the extension only requires y up. Files are written and read in glTF's own axes LUF (x left, y up, z
forward), as in splat-transform, PlayCanvas and Cesium. A file in other axes names them in `asset.extras`.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf import sh
from progdf.color.oklab import linear_from_srgb, srgb_from_linear
from progdf.errors import ProgdfError
from progdf.formats.repair import logits_of_shares
from progdf.gaussians import ZERO, Gaussians, concatenate, from_arrays
from progdf.io.file_rules import check_fields, damage_error, unsupported_error
from progdf.quaternions import multiply_quats
from progdf.terminal import escape_text

from .axes import AXES, Axes, convert_axes
from .gltf_file import (
    BINARY_CHUNK,
    BYTE,
    FLOAT,
    JSON_CHUNK,
    MAGIC,
    REFUSED_EXTENSIONS,
    SIZES,
    GltfFile,
    Primitive,
    entry,
)
from .gltf_nodes import VISIBILITY, Placement, find_placements, placement_similarity

EXTENSION = "KHR_gaussian_splatting"
MAX_DEGREE = 3

SRGB = "srgb_rec709_display"
LINEAR = "lin_rec709_display"
_SPZ_EXTENSIONS = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")
_SUPPORTED_EXTENSIONS = (EXTENSION, *_SPZ_EXTENSIONS, VISIBILITY, "KHR_mesh_quantization")
_IRRELEVANT_EXTENSIONS = (
    "KHR_materials_",
    "EXT_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "KHR_lights_",
    "EXT_lights_",
)
"""Extensions of materials and lights: Gaussians have neither."""

_ATTRIBUTE_TYPES = {
    "POSITION": "VEC3",
    f"{EXTENSION}:ROTATION": "VEC4",
    f"{EXTENSION}:SCALE": "VEC3",
    f"{EXTENSION}:OPACITY": "SCALAR",
}
"""Accessor types of all attributes except the SH coefficients."""

_EXPORT_AGAIN = "export it without that extension"

GENERATOR_AXES: tuple[tuple[str, Axes], ...] = (("splat-transform 1.", "RDF"), ("progdf", "RUB"))
"""Axes of files that do not name them, by the start of `asset.generator`.

splat-transform used the axes of the .ply before version 2, and early versions of this program used OpenGL's.
"""

LOG_SCALE_LIMIT = -1e-6  # a scale below it is a logarithm, as splat-transform wrote before June 2026

ReadSpz = Callable[[bytes], Gaussians]
"""Function that reads the bytes of an .spz, in its own axes (RUB)."""


@dataclass(frozen=True)
class GltfScene:
    """The Gaussians of a glTF file."""

    scene: Gaussians  # in the axes of the .ply, means in float64 and in the world
    storage: tuple[str, ...]  # axes and compression, a phrase each
    conversions: tuple[str, ...]  # conversions from other conventions, a phrase each
    ignored: tuple[str, ...]  # unused parts of the file
    file_bytes: int  # size of the file and its buffers


def write_glb(path: Path, scene: Gaussians, axes: Axes = "LUF") -> None:
    """Write a scene as float32; SH bands above 3 are left out.

    Args:
        path: the file, which is replaced
        scene: N ≥ 1 Gaussians in the axes of the .ply; an origin becomes the node's translation
        axes: axes of the file, LUF or RUB
    """
    scene = convert_axes(scene, "RDF", axes)
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    attributes: dict[str, int] = {}
    parts: list[bytes] = []
    start = 0
    for name, table in _columns(scene).items():
        rounded = table.dtype == np.uint8
        accessor: dict[str, Any] = {"bufferView": len(views), "count": len(scene)}
        accessor["componentType"] = BYTE if rounded else FLOAT
        accessor["type"] = next(kind for kind, size in SIZES.items() if size == table.shape[1])
        if rounded:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}
        attributes[name] = len(accessors)
        content = table.tobytes()
        views.append({"buffer": 0, "byteOffset": start, "byteLength": len(content), "target": 34962})
        accessors.append(accessor)
        parts.append(content)
        start += len(content)
    properties = {"kernel": "ellipse", "colorSpace": SRGB, "projection": "perspective"}
    properties["sortingMethod"] = "cameraDistance"
    node: dict[str, Any] = {"mesh": 0}
    if scene.origin != ZERO:
        node["translation"] = list(scene.origin)
    tables = {
        "asset": {"version": "2.0", "generator": "progdf", "extras": {"axes": axes}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [
            {"primitives": [{"attributes": attributes, "mode": 0, "extensions": {EXTENSION: properties}}]}
        ],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    text = json.dumps(tables).encode()
    text += b" " * (-len(text) % 4)
    with path.open("wb") as file:
        file.write(MAGIC + struct.pack("<II", 2, 12 + 8 + len(text) + 8 + start))
        file.write(struct.pack("<II", len(text), JSON_CHUNK) + text)
        file.write(struct.pack("<II", start, BINARY_CHUNK))
        file.writelines(parts)


def _columns(scene: Gaussians) -> dict[str, NDArray[Any]]:
    """Return the attributes of a primitive by name: float32, or bytes for the point colors. [N,size]"""
    points = linear_from_srgb(sh.sh0_to_rgb(scene.sh0).clamp(0, 1))  # glTF's vertex colors are linear light
    tables: dict[str, Tensor] = {
        "POSITION": scene.means,
        f"{EXTENSION}:ROTATION": scene.unit_quats[:, [1, 2, 3, 0]],
        f"{EXTENSION}:SCALE": scene.scales,
        f"{EXTENSION}:OPACITY": scene.opacities[:, None],
    }
    coefficients = scene.sh
    for degree in range(min(MAX_DEGREE, scene.sh_degree) + 1):
        for i, name in enumerate(_coefficient_names(degree)):
            tables[name] = coefficients[:, degree**2 + i]
    columns: dict[str, NDArray[Any]] = {
        name: table.detach().cpu().float().numpy().astype("<f4") for name, table in tables.items()
    }
    colors = torch.cat([points, scene.opacities[:, None]], dim=1)
    columns["COLOR_0"] = (colors * 255).round().to(torch.uint8).cpu().numpy()
    return columns


def _coefficient_names(degree: int) -> list[str]:
    return [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}" for i in range(2 * degree + 1)]


def read_gltf(path: Path, read_spz: ReadSpz) -> GltfScene:
    """Read the Gaussians in the scene of a .glb or .gltf, one copy per instance of a mesh.

    Args:
        path: the file; a .gltf refers to buffer files inside its folder
        read_spz: reader for parts that are compressed as .spz

    Raises:
        ProgdfError: the file is damaged, holds no Gaussians, or has a feature that is not supported.
    """
    file = GltfFile(path)
    _check_required(file)
    reader = _Reader(file, read_spz)
    placements = find_placements(file)
    draws: list[tuple[Placement, int]] = []
    for placement in placements:
        mesh = entry(file, file.tables.meshes, placement.mesh, "meshes")
        for index, primitive in enumerate(mesh.primitives):
            if _is_splats(primitive):
                reader.measure(placement.mesh, index)
                draws.append((placement, index))
    parts: list[Gaussians] = []
    for placement, index in draws:
        similarity = placement_similarity(file, placement)
        parts.append(_place(reader.read(placement.mesh, index), placement.matrix, *similarity))
    if not parts:
        raise ProgdfError(
            f"{path} holds no Gaussians: its scene has no {EXTENSION}; give a scene of Gaussians"
        )
    scene = _join(file, parts)
    axes = stored_axes(file)
    storage = ["compressed as .spz"] if reader.has_spz else []
    if axes != "RDF":
        storage.append(f"turned from axes {axes} to RDF")
    ignored = (*reader.ignored, *_ignored_parts(file, placements))
    converted = convert_axes(scene, axes, "RDF")
    return GltfScene(converted, tuple(storage), tuple(reader.conversions), ignored, file.stored_bytes)


def stored_axes(file: GltfFile) -> Axes:
    """Return the axes of a file: as declared, otherwise by its generator, otherwise glTF's LUF."""
    asset = file.tables.asset
    declared = asset.extras.get("axes") if isinstance(asset.extras, dict) else None
    for axes in AXES:
        if declared == axes:
            return axes
    for beginning, axes in GENERATOR_AXES:
        if asset.generator.startswith(beginning):
            return axes
    return "LUF"


def _check_required(file: GltfFile) -> None:
    """Raise ProgdfError if the file requires an extension that is not supported."""
    for name in file.tables.extensionsRequired:
        if name not in _SUPPORTED_EXTENSIONS and not name.startswith(_IRRELEVANT_EXTENSIONS):
            feature = f"the required extension {escape_text(name)[:80]}"
            raise unsupported_error(file.path, feature, REFUSED_EXTENSIONS.get(name, _EXPORT_AGAIN))


def _is_splats(primitive: Primitive) -> bool:
    """Return whether a primitive holds Gaussians: by the extension, or by its attributes without it.

    Some converters drop the extension and leave the attributes.
    """
    return EXTENSION in primitive.extensions or f"{EXTENSION}:SCALE" in primitive.attributes


def _ignored_parts(file: GltfFile, placements: list[Placement]) -> Iterator[str]:
    """Yield the parts of the file that are not read and may matter to the user."""
    tables = file.tables
    used_meshes = {placement.mesh for placement in placements}
    unused_splats = [
        index
        for index, mesh in enumerate(tables.meshes)
        if index not in used_meshes and any(map(_is_splats, mesh.primitives))
    ]
    mixed_meshes = [
        index
        for index, mesh in enumerate(tables.meshes)
        if index in used_meshes and not all(map(_is_splats, mesh.primitives))
    ]
    if unused_splats:
        yield f"meshes[{unused_splats[0]}] outside the scene" + (
            f" and {len(unused_splats) - 1} more" if unused_splats[1:] else ""
        )
    if mixed_meshes:
        yield f"triangles of meshes[{mixed_meshes[0]}]" + (
            f" and {len(mixed_meshes) - 1} more" if mixed_meshes[1:] else ""
        )
    if tables.animations:
        yield "animations (the rest pose is read)"
    for name in tables.extensionsUsed:
        if name not in _SUPPORTED_EXTENSIONS:
            yield escape_text(name)[:80]


def _place(part: Gaussians, matrix: NDArray[np.float64], turn: Tensor, factor: float) -> Gaussians:
    """Transform the Gaussians of a mesh to the world.

    Args:
        part: N Gaussians in the axes of the mesh, means in float64
        matrix: mesh to world, a similarity. [4,4]
        turn, factor: the rotation (unit quaternion [1,4]) and the scale of the matrix
    """
    linear = torch.from_numpy(matrix[:3, :3])
    placed = replace(part, means=part.means @ linear.T + torch.from_numpy(matrix[:3, 3]))
    if factor != 1.0:
        placed = replace(placed, log_scales=placed.log_scales + float(np.log(factor)))
    if not torch.equal(turn, torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=turn.dtype)):
        quats = multiply_quats(turn, placed.quats.double()).float()
        bands = placed.shN + sh.rotation_change(placed.shN, turn)
        placed = replace(placed, quats=quats, shN=bands)
    return placed


def _join(file: GltfFile, parts: list[Gaussians]) -> Gaussians:
    """Join all parts to one scene, and pad parts of a lower SH degree with zeros."""
    if len({part.antialiased for part in parts}) > 1:
        raise unsupported_error(
            file.path, "parts with and without antialiasing (SPZ)", "export them as separate scenes"
        )
    if len(parts) == 1:
        return parts[0]
    count = max(part.shN.shape[1] for part in parts)
    padded = []
    for part in parts:
        missing = part.shN.new_zeros(len(part), count - part.shN.shape[1], 3)
        padded.append(replace(part, shN=torch.cat([part.shN, missing], dim=1)))
    return concatenate(padded)


@dataclass(frozen=True)
class _PrimitivePlan:
    """Checked primitive of N Gaussians whose data is not read yet."""

    name: str  # for errors
    color_space: str
    spz: int | None  # buffer view of an .spz with all attributes
    columns: dict[str, str]  # attributes to read and their types; SH coefficients last, in order
    attributes: dict[str, int]  # accessors by name
    rows: int  # N; 0 if only the .spz states it
    indices: int | None  # accessor of the row indices to use; None: all rows

    @property
    def width(self) -> int:
        """Number of values per Gaussian."""
        return 11 + 3 * (len(self.columns) - len(_ATTRIBUTE_TYPES))


class _Reader:
    """Reader that decodes each primitive once, however many nodes refer to it."""

    def __init__(self, file: GltfFile, read_spz: ReadSpz) -> None:
        self.file = file
        self.has_spz = False
        self.conversions: dict[str, None] = {}  # in the order found
        self.ignored: dict[str, None] = {}
        self._read_spz = read_spz
        self._plans: dict[tuple[int, int], _PrimitivePlan] = {}
        self._parts: dict[tuple[int, int], Gaussians] = {}

    def measure(self, mesh: int, index: int) -> None:
        """Add the memory for one more copy of a primitive to the total before it is read.

        Raises:
            ProgdfError: the primitive is damaged or not supported, or the file repeats it too often.
        """
        key = (mesh, index)
        if key not in self._plans:
            self._plans[key] = self._plan(mesh, index)
        plan = self._plans[key]
        rows = plan.rows
        if plan.indices is not None:
            rows += self.file.accessor(plan.indices, "SCALAR").count
        self.file.take(rows, plan.width)

    def read(self, mesh: int, index: int) -> Gaussians:
        """Return the Gaussians of a measured primitive as stored, means in float64.

        Raises:
            ProgdfError: data lies outside the file, or its .spz cannot be read.
        """
        key = (mesh, index)
        plan = self._plans[key]
        if key not in self._parts:
            self._parts[key] = self._read_part(plan)
        part = self._parts[key]
        if plan.spz is not None:  # its size is only known once it is decoded
            self.file.take(len(part), 14 + 3 * part.shN.shape[1])
        return part

    def _plan(self, mesh: int, index: int) -> _PrimitivePlan:
        """Check a primitive and find its columns."""
        file = self.file
        primitive = file.tables.meshes[mesh].primitives[index]
        name = f"meshes[{mesh}].primitives[{index}]"
        attributes = primitive.attributes
        color_space, spz = self._check_extension(primitive, name)
        if spz is not None:
            rows = 0
            if "POSITION" in attributes:
                rows = file.accessor(attributes["POSITION"], "VEC3").count
            return _PrimitivePlan(
                name, color_space, spz, _ATTRIBUTE_TYPES, attributes, rows, primitive.indices
            )
        degree = 0
        while degree < MAX_DEGREE and any(n in attributes for n in _coefficient_names(degree + 1)):
            degree += 1
        bands = [column for l in range(degree + 1) for column in _coefficient_names(l)]
        columns = _ATTRIBUTE_TYPES | dict.fromkeys(bands, "VEC3")
        absent = next((column for column in columns if column not in attributes), None)
        if absent is not None:
            raise damage_error(file.path, f"{name} lacks {absent}")
        positions = file.accessor(attributes["POSITION"], "VEC3")
        if positions.bufferView is None and positions.sparse is None:
            feature = f"{name} without stored positions, as an unknown extension may hold them"
            raise unsupported_error(file.path, feature, "export it without compression")
        for column, kind in columns.items():
            accessor = file.accessor(attributes[column], kind)
            if accessor.count != positions.count:
                counts = f"{positions.count} of POSITION and {accessor.count} of {column}"
                raise damage_error(file.path, f"{name} has {counts}")
            if accessor.bufferView is not None:
                file.view_bytes(accessor.bufferView)  # adds an external buffer to `stored_bytes`
        extra = [column for column in attributes if column.startswith(EXTENSION) and column not in columns]
        self.ignored.update(dict.fromkeys(escape_text(column)[:60] for column in extra))
        return _PrimitivePlan(
            name, color_space, None, columns, attributes, positions.count, primitive.indices
        )

    def _read_part(self, plan: _PrimitivePlan) -> Gaussians:
        """Return the Gaussians of a primitive in sRGB, with its indices applied."""
        part = self._read_columns(plan) if plan.spz is None else self._read_compressed(plan, plan.spz)
        if plan.indices is not None:
            part = part[torch.from_numpy(self.file.read_indices(plan.indices, len(part)))]
        if plan.color_space == LINEAR:
            self.conversions[f"linear light ({LINEAR}) to sRGB"] = None
            coefficients = sh.map_colors(part.sh, srgb_from_linear)
            part = replace(part, sh0=coefficients[:, 0], shN=coefficients[:, 1:])
        return part

    def _check_extension(self, primitive: Primitive, name: str) -> tuple[str, int | None]:
        """Return the color space, and the buffer view of the .spz if there is one.

        Raises:
            ProgdfError: the primitive uses a rendering feature that is not supported.
        """
        path = self.file.path
        if primitive.targets:
            remedy = "export it with the shape applied"
            raise unsupported_error(path, f"morph targets in {name}", remedy)
        for extension, remedy in REFUSED_EXTENSIONS.items():
            if extension in primitive.extensions:
                raise unsupported_error(path, f"{extension} in {name}", remedy)
        properties = primitive.extensions.get(EXTENSION)
        if properties is None:
            self.conversions[f"colors taken as sRGB, as {EXTENSION} is absent"] = None
            return SRGB, None
        if not isinstance(properties, dict):
            raise damage_error(path, f"{EXTENSION} of {name} is not an object")
        known = {
            "kernel": ("ellipse",),
            "projection": ("perspective",),
            "colorSpace": (SRGB, LINEAR),
            "sortingMethod": ("cameraDistance",),
        }
        for field, values in known.items():
            value = properties.get(field, values[0])
            if value not in values:
                feature = f"{field} '{escape_text(str(value))[:40]}' in {name}"
                raise unsupported_error(path, feature, f"export it with {' or '.join(values)}")
        if "colorSpace" not in properties:
            self.conversions["colors taken as sRGB, as colorSpace is absent"] = None
        unknown = check_fields(path, properties, (*known, "extensions", "extras"), {}, _EXPORT_AGAIN)
        self.ignored.update(dict.fromkeys(escape_text(field)[:40] for field in unknown))
        extensions = properties.get("extensions", {})
        if not isinstance(extensions, dict):
            raise damage_error(path, f"{EXTENSION}.extensions of {name} is not an object")
        spz_view = None
        for extension, content in extensions.items():
            if extension not in _SPZ_EXTENSIONS:
                feature = f"{escape_text(extension)[:80]} in {name}"
                raise unsupported_error(path, feature, _EXPORT_AGAIN)
            spz_view = content.get("bufferView") if isinstance(content, dict) else None
            if type(spz_view) is not int or spz_view < 0:
                raise damage_error(path, f"{extension} of {name} has no bufferView")
        return str(properties.get("colorSpace", SRGB)), spz_view

    def _read_columns(self, plan: _PrimitivePlan) -> Gaussians:
        """Return the Gaussians of a primitive whose columns are accessors."""
        tables = {
            name: self.file.read_accessor(plan.attributes[name], kind) for name, kind in plan.columns.items()
        }
        coefficients = np.stack(
            [tables[name] for name in plan.columns if name not in _ATTRIBUTE_TYPES], axis=1
        )
        logits = logits_of_shares(tables[f"{EXTENSION}:OPACITY"][:, 0])
        return from_arrays(
            {
                "means": tables["POSITION"].astype(np.float64),
                "quats": tables[f"{EXTENSION}:ROTATION"][:, [3, 0, 1, 2]],
                "log_scales": self._log_scales(tables[f"{EXTENSION}:SCALE"]),
                "logit_opacities": logits.astype(np.float32),
                "sh0": coefficients[:, 0],
                "shN": coefficients[:, 1:],
            }
        )

    def _log_scales(self, scales: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return log-scales. Stored scales are logarithms already if any is negative. [N,3]"""
        if bool((scales < LOG_SCALE_LIMIT).any()):
            self.conversions["negative scales taken as logarithms (splat-transform before June 2026)"] = None
            return scales
        with np.errstate(divide="ignore"):  # a flat Gaussian becomes infinite and is repaired later
            return np.log(np.maximum(scales, np.float32(0.0)))

    def _read_compressed(self, plan: _PrimitivePlan, view: int) -> Gaussians:
        """Return the Gaussians of an .spz inside the file, in glTF's axes LUF as its extension requires."""
        content = bytes(self.file.view_bytes(view))
        self.has_spz = True
        part = convert_axes(self._read_spz(content), "RUB", "LUF")
        if plan.rows not in (0, len(part)):
            counts = f"{plan.rows} Gaussians and its .spz {len(part)}"
            raise damage_error(self.file.path, f"{plan.name} has {counts}")
        bands = part.shN[:, : (MAX_DEGREE + 1) ** 2 - 1]
        return replace(part, means=part.world_means, origin=ZERO, shN=bands)
