"""Reader and writer of the 3DGS .ply format.

Properties: x y z, f_dc_0..2, f_rest_* (channel-major), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz).
Some variants are converted (see `read_ply`) and some refused (see `variant_fields`). All other properties are
ignored and reported. Rows are never dropped, as labels and .gdf files rely on row indices. An unusable row
becomes an invisible Gaussian (see `progdf.formats.repair`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from progdf.color.oklab import srgb_from_linear
from progdf.errors import ProgdfError, check_first_argument
from progdf.gaussians import ATTRIBUTES, ZERO, Gaussians, from_arrays
from progdf.io.atomic import atomic_write
from progdf.io.file_rules import PLAIN_GAUSSIANS, check_fields, unsupported_error, variant_fields
from progdf.quaternions import normalize_quats
from progdf.sh import map_colors, rgb_to_sh0

from .ply_file import ANTIALIASED_COMMENT, PlyFile, read_header, row_blocks
from .ply_view import CAMERA_ELEMENTS, check_frames, has_linear_colors, read_view
from .repair import LoadReport, repair

Floats = npt.NDArray[np.float32]

GEOMETRY = {
    "means": ("x", "y", "z"),
    "sh0": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacities": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
"""Columns of each attribute in every 3DGS .ply."""
_NORMALS = ("nx", "ny", "nz")
_RGB_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Color columns of a .ply without f_dc, as by nerfstudio's `--ply-color-mode rgb`. The first match counts."""
_RGB_TYPES = {"u1", "u2", "f4", "f8"}
RGB_MARGIN = 0.5  # float colors farther outside 0 to 1 are refused, as their range is unknown
FILTER_3D = "filter_3D"  # property of Mip-Splatting and Gaussian Opacity Fields
_BLOCK_ROWS = 4096
"""Rows per block when columns are split: 1 MB at SH degree 3, which fits into the second-level cache."""
_SH_REST = (0, 9, 24, 45, 72)  # number of f_rest properties for SH degree 0 to 4


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """Load a scene from a 3DGS .ply file as float32; log repairs and losses as warnings.

    Positions stored as doubles are read as doubles, and become relative to `Gaussians.origin`. Quaternions
    are normalized, wxyz. Rows keep their order and number.

    Raises:
        ProgdfError: the file is missing, broken, holds no Gaussians, or is not a 3DGS .ply.
    """
    check_first_argument("load_ply(path)", path, (str, os.PathLike))
    scene, report = load_ply_with_report(path)
    report.log()
    return scene


def load_ply_with_report(path: str | os.PathLike[str]) -> tuple[Gaussians, LoadReport]:
    """Load a scene as `load_ply` does, and return it with the report on its content and repairs."""
    ply = read_header(path)
    stored, content = read_ply(ply)
    scene, counts = repair(stored, path)
    order = {"<": " little-endian", ">": " big-endian"}[ply.layout.byte_order] if not ply.layout.text else ""
    report = LoadReport(
        file=Path(path).name,
        file_bytes=ply.size,
        format=f"binary{order}" if order else "ascii",
        count=len(scene),
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        **content,
        **counts,
    )
    return scene, report


def read_ply(ply: PlyFile) -> tuple[Gaussians, dict[str, Any]]:
    """Return the Gaussians of a 3DGS .ply as stored, before repairs, and fields of their `LoadReport`.

    Colors come from `f_dc`, or from RGB columns without it. Mip-Splatting's `filter_3D` is fused.

    Raises:
        ProgdfError: the file is not a 3DGS .ply, or has an unsupported property or element.
    """
    ignored = _check_variants(ply)
    columns = _find_columns(ply)
    check_frames(ply)
    is_linear = has_linear_colors(ply)
    (rows,), trailing = ply.rows("vertex")
    scene = replace(_gaussians(rows, columns), antialiased=ply.antialiased)
    used = {column for names in columns.values() for column in names}
    conversions = []
    if columns["sh0"] != GEOMETRY["sh0"]:
        scene = replace(scene, sh0=_rgb_to_sh0(ply, columns["sh0"], scene.sh0))
        conversions.append(f"{', '.join(columns['sh0'])} to SH degree 0")
    if is_linear:
        coefficients = map_colors(scene.sh, srgb_from_linear)
        scene = replace(scene, sh0=coefficients[:, 0], shN=coefficients[:, 1:])
        conversions.append("linear RGB (color_space 1) to sRGB")
    if FILTER_3D in ply.columns("vertex"):
        scene = _fuse_filter(scene, torch.from_numpy(rows[FILTER_3D].astype(np.float64)))
        used.add(FILTER_3D)
        conversions.append("Mip-Splatting's filter_3D, fused into scales and opacities")
    view = read_view(ply)
    used_elements = {"vertex", *(CAMERA_ELEMENTS if view.camera is not None else ())}
    used_elements |= {"color_space"} if "color_space" in ply.counts else set()
    return scene, {
        "conversions": tuple(conversions),
        "ignored_properties": tuple(name for name in ignored if name not in used and name not in _NORMALS),
        "ignored_elements": tuple(item for item in ply.counts.items() if item[0] not in used_elements),
        "ignored_comments": view.unknown_comments,
        "trailing_bytes": trailing,
    }


def _check_variants(ply: PlyFile) -> tuple[str, ...]:
    """Return the vertex properties; raise ProgdfError if one belongs to an unsupported variant of 3DGS."""
    present = ply.columns("vertex")
    is_scene = bool({"opacity", "scale_0", "rot_0"} & set(present))
    refused = variant_fields(present) if is_scene else {}
    return check_fields(ply.path, present, (), refused, PLAIN_GAUSSIANS)


def _rgb_to_sh0(ply: PlyFile, names: tuple[str, ...], values: Tensor) -> Tensor:
    """Convert RGB (bytes, 16-bit integers or floats from 0 to 1) to SH band 0. [N,3] -> [N,3]

    Raises:
        ProgdfError: floats lie outside 0 to 1 by more than `RGB_MARGIN`, so their range is unknown.
    """
    dtype = np.dtype(ply.columns("vertex")[names[0]])
    if dtype.kind == "f":
        numbers = values[values.isfinite()]
        low, high = (float(edge) for edge in numbers.aminmax()) if len(numbers) else (0.0, 1.0)
        if low < -RGB_MARGIN or high > 1.0 + RGB_MARGIN:
            feature = f"'{names[0]}' as floats from {low:.4g} to {high:.4g} (0 to 1 is expected)"
            remedy = "write colors as bytes, as floats from 0 to 1, or as f_dc_0..2"
            raise unsupported_error(ply.path, feature, remedy)
        return rgb_to_sh0(values)
    return rgb_to_sh0(values / float(np.iinfo(dtype).max))


def _fuse_filter(scene: Gaussians, sizes: Tensor) -> Gaussians:
    """Apply Mip-Splatting's 3D smoothing filter to a scene (Yu et al. 2024, eq. 7).

    Convolution with a Gaussian of standard deviation f gives the variances s² + f². The opacity is multiplied
    by the square root of the ratio of the determinants.

    Args:
        scene: N Gaussians as stored
        sizes: standard deviation of the filter, world units. [N] float64
    """
    log_scales = scene.log_scales.double()
    fused = 0.5 * torch.logaddexp(2 * log_scales, 2 * sizes.abs().log()[:, None])
    shrink = (log_scales - fused).sum(dim=1)
    shrink = torch.where(fused.isneginf().any(dim=1), 0.0, shrink)  # a flat Gaussian without a filter
    log_opacities = torch.nn.functional.logsigmoid(scene.logit_opacities.double()) + shrink
    logits = log_opacities - (-torch.expm1(log_opacities)).log()
    unchanged = sizes == 0
    return replace(
        scene,
        log_scales=torch.where(unchanged[:, None], scene.log_scales, fused.float()),
        logit_opacities=torch.where(unchanged, scene.logit_opacities, logits.float()),
    )


def save_ply(path: str | os.PathLike[str], scene: Gaussians) -> None:
    """Write a 3DGS .ply: binary little-endian float32, properties in the order of the original 3DGS code.

    If the scene has an origin, x, y and z are doubles. The file appears complete or not at all. A comment
    marks an antialiased scene. If the quaternions have unit length, loading gives the same bits.

    Raises:
        ProgdfError: the scene is empty or holds a NaN or an infinity, or the folder does not exist.
    """
    check_first_argument("save_ply(path, scene)", path, (str, os.PathLike))
    if not len(scene):
        raise ProgdfError(f"{path} was not written: the scene has no Gaussians; a .ply needs at least one")
    for key in ATTRIBUTES:
        if not bool(getattr(scene, key).isfinite().all()):
            raise ProgdfError(f"{path} was not written: {key} holds NaN or infinity; repair the scene first")
    columns = {
        "means": scene.means,
        "normals": torch.zeros(len(scene), 3),
        "sh0": scene.sh0,
        "shN": scene.shN.transpose(1, 2).flatten(1),
        "logit_opacities": scene.logit_opacities[:, None],
        "log_scales": scene.log_scales,
        "quats": scene.quats,
    }
    table = torch.cat([tensor.detach().cpu().to(torch.float32) for tensor in columns.values()], dim=1).numpy()
    names = {
        **GEOMETRY,
        "normals": _NORMALS,
        "shN": tuple(f"f_rest_{i}" for i in range(columns["shN"].shape[1])),
    }
    rows = table.view([(name, "=f4") for key in columns for name in names[key]])[:, 0]
    if scene.origin != ZERO:
        layout = [(name, "=f8" if name in "xyz" else "=f4") for key in columns for name in names[key]]
        rows = rows.astype(layout)
        for name, column in zip("xyz", scene.world_means.unbind(1), strict=True):
            rows[name] = column.cpu().numpy()
    vertex = PlyElement.describe(rows, "vertex")
    comments = [ANTIALIASED_COMMENT] if scene.antialiased else []
    with atomic_write(path) as temporary_file:
        PlyData([vertex], byte_order="<", comments=comments).write(str(temporary_file))


def save_ply_checked(path: str | os.PathLike[str], scene: Gaussians) -> None:
    """Write a .ply as `save_ply` does, and read it back before it replaces `path`.

    Raises:
        ProgdfError: the file read back differs from the scene; `path` is unchanged.
    """
    with atomic_write(Path(path)) as temporary_file:
        save_ply(temporary_file, scene)
        read = load_ply(temporary_file)
        for name in ATTRIBUTES:
            written = getattr(scene, name)
            loaded = getattr(read, name)
            if name == "means" and (scene.origin, read.origin) != (ZERO, ZERO):
                # an edit that moves Gaussians may move the origin, and means are rounded relative to it
                off = (read.world_means - scene.world_means).abs()
                same = bool((off <= 2.0**-23 * (loaded.abs() + written.abs())).all())
            elif name == "quats":
                same = torch.allclose(normalize_quats(written), loaded, rtol=0.0, atol=1e-6)
            else:
                same = torch.equal(written, loaded)
            if not same:
                raise ProgdfError(
                    f"the written file does not match in its {name}; check the disk and try again"
                )


def _find_columns(ply: PlyFile) -> dict[str, tuple[str, ...]]:
    """Return the columns of each attribute, after a check that all properties of 3DGS are present.

    Raises:
        ProgdfError: a property is missing, or the file holds no Gaussians.
    """
    if "vertex" not in ply.counts:
        hint = "" if "chunk" in ply.counts else "; it is not a 3DGS .ply"
        raise ProgdfError(f"{ply.path} has no element 'vertex'{hint}")
    present = ply.columns("vertex")
    columns = dict(GEOMETRY)
    if not any(name in present for name in GEOMETRY["sh0"]):
        columns["sh0"] = next((names for names in _RGB_NAMES if _are_colors(present, names)), GEOMETRY["sh0"])
    missing = [column for names in columns.values() for column in names if column not in present]
    if missing:
        raise ProgdfError(f"{ply.path} {_describe(ply, missing)}")
    sh_count = sum(column.startswith("f_rest_") for column in present)
    absent = next((f"f_rest_{i}" for i in range(sh_count) if f"f_rest_{i}" not in present), None)
    if sh_count not in _SH_REST or absent:
        raise ProgdfError(
            f"{ply.path} has {sh_count} f_rest properties{f' without {absent}' if absent else ''}; "
            f"expected 0, 9, 24, 45 or 72: export it again"
        )
    if sh_count and columns["sh0"] != GEOMETRY["sh0"]:
        raise ProgdfError(f"{ply.path} has f_rest properties without f_dc_0, f_dc_1, f_dc_2; export it again")
    if not ply.counts["vertex"]:
        raise ProgdfError(f"{ply.path} holds 0 Gaussians; a scene needs at least one: export it again")
    return {**columns, "shN": tuple(f"f_rest_{i}" for i in range(sh_count))}


def _are_colors(present: Mapping[str, str], names: tuple[str, ...]) -> bool:
    """Return whether all three properties are present and share one of the RGB types."""
    types = {np.dtype(present[name]).str[1:] for name in names if name in present}
    return all(name in present for name in names) and len(types) == 1 and types <= _RGB_TYPES


def _describe(ply: PlyFile, missing: list[str]) -> str:
    present = set(ply.columns("vertex"))
    if "packed_position" in present:
        return "is a compressed .ply; open it with load_scene"
    if missing == ["scale_2"]:
        return "has no scale_2, so it holds 2D Gaussians; a 3DGS .ply has scale_0, scale_1 and scale_2"
    listed = ", ".join(missing[:4]) + (f" and {len(missing) - 4} more" if len(missing) > 4 else "")
    if {"f_dc_0", "opacity", "scale_0", "rot_0"} & present:
        return f"lacks {listed}, which a 3DGS .ply has; export it again"
    kind = "a mesh" if "face" in ply.counts else "a point cloud"
    return f"is {kind}, not a Gaussian scene: it lacks {listed}; train one with 3DGS and give its .ply"


def _gaussians(rows: npt.NDArray[np.void], columns: dict[str, tuple[str, ...]]) -> Gaussians:
    """Split rows into attributes, in blocks that stay in the cache.

    If all columns are float32, each block is viewed as a matrix; otherwise the needed columns are stacked.
    """
    names = rows.dtype.names or ()
    is_plain = all(rows.dtype[name] == np.dtype("<f4") for name in names)
    if not is_plain:
        names = tuple(name for part in columns.values() for name in part)
    index = {key: _as_slice([names.index(name) for name in part]) for key, part in columns.items()}
    arrays: dict[str, npt.NDArray[Any]] = {
        key: np.empty((len(rows), len(part)), np.float32) for key, part in columns.items()
    }
    bands = len(columns["shN"]) // 3
    arrays["shN"] = arrays["shN"].reshape(len(rows), bands, 3)
    for first, block in row_blocks(rows, _BLOCK_ROWS):
        if is_plain:
            table: Floats = block.view("<f4").reshape(len(block), -1)
        else:
            # numbers beyond float32 become ±inf and are repaired later
            with np.errstate(over="ignore", invalid="ignore"):
                table = np.stack([block[name].astype(np.float32) for name in names], axis=1)
        for key, array in arrays.items():
            values: npt.NDArray[Any] = table[:, index[key]]
            if key == "shN":  # channel-major in the file, RGB innermost here
                values = values.reshape(len(block), 3, bands).transpose(0, 2, 1)
            array[first : first + _BLOCK_ROWS] = values
    coordinates = [rows[name] for name in columns["means"]]
    if np.result_type(np.float32, *coordinates) == np.float64:
        arrays["means"] = np.stack(coordinates, axis=1).astype(np.float64)
    return from_arrays(arrays | {"logit_opacities": arrays["logit_opacities"][:, 0]})


def _as_slice(index: list[int]) -> slice | list[int]:
    """Return consecutive column indices as a slice, which numpy does not copy; other indices unchanged."""
    columns = slice(index[0], index[-1] + 1) if index else slice(0)
    return columns if index == list(range(columns.start or 0, columns.stop)) else index
