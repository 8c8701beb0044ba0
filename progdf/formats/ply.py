"""3DGS .ply <-> Gaussians.

The file's own words: x y z, f_dc_0..2, f_rest_* (channel-major), opacity (logit), scale_0..2 (log), rot_0..3
(wxyz). Anything else is reported and not used. Rows are never dropped, as labels and .gdf files count on
their indices: an unusable row becomes an invisible Gaussian (see `progdf.formats.repair`).
"""

from __future__ import annotations

import io
import itertools
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyListProperty, PlyParseError

from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, ZERO, Gaussians, from_arrays
from progdf.io.atomic import atomic_write, check_regular, open_error
from progdf.io.file_rules import unsupported_error
from progdf.quaternions import normalize_quats

from .repair import LoadReport, repair

ANTIALIASED_COMMENT = "SplatRenderMode: mip"
"""What the header of a scene says that was trained with Mip-Splatting's 2D filter (Brush's words)."""

_RENDERING = {
    "splatrendermode: mip": True,
    "splatrendermode: default": False,
    "antialiased 1": True,
    "antialiased 0": False,
}
"""The comments that tell it, Brush's and Postshot's, in lower case; the last one counts."""

_MAX_HEADER_BYTES = 1 << 20
"""A header that has not ended by then is no header."""

_MOST_LISTS = 200_000
"""Values of list rows before the vertices, which plyfile reads one by one in about two seconds."""

_SKIPPED = ("comment", "obj_info")
_ELEMENT = re.compile(r"(element\s+\S+\s+)(\d{1,19})")
_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)
_FOREIGN = (
    (b"version https://git-lfs", "is a Git LFS pointer, not the file itself; run `git lfs pull` to fetch it"),
    (b"\x1f\x8b", "is gzip data, but no .spz scene; unpack it first"),
    (b"PK\x03\x04", "is a zip archive, but no .sog scene; unpack it first"),
    (b"<", "is a web page or XML, not a .ply; download the file itself"),
)


@dataclass(frozen=True)
class PlyFile:
    """A .ply file of which the header is read and checked."""

    path: Path  # the file
    layout: PlyData  # its format and elements, without rows
    counts: dict[str, int]  # rows of each element, by name; they fit into the file
    header: tuple[str, ...]  # its lines before end_header, comments empty
    length: int  # bytes of the header
    size: int  # bytes of the file
    antialiased: bool  # a comment says that the scene was trained with Mip-Splatting's 2D filter

    def columns(self, element: str) -> dict[str, str]:
        """numpy's type of each property that is no list, by name; of an element that is not there nothing."""
        properties = self.layout[element].properties if element in self.layout else ()
        return {p.name: p.val_dtype for p in properties if not isinstance(p, PlyListProperty)}

    def rows(self, *names: str) -> tuple[list[npt.NDArray[np.void]], int]:
        """The rows of elements, of a binary file memory-mapped, and the bytes behind the file's last row.

        The latter are 0 where lists follow, whose length nobody knows.

        Raises:
            ProgdfError: a row up to the last of the elements is not what the header says.
        """
        elements = self.layout.elements
        last = 1 + max(i for i, element in enumerate(elements) if element.name in names)
        for element in elements[:last]:
            self._check_lists(element, element.name in names)
        try:
            with np.errstate(over="ignore"):
                rows, after = self._text_rows(last) if self.layout.text else self._binary_rows(last)
        except OSError as error:
            raise open_error(self.path, error) from None
        except (PlyElementParseError, ValueError, OverflowError, MemoryError) as error:
            row = re.search(r"at row \d+", str(error))
            what = f"has too many or too few numbers, or no number, {row[0] if row else 'in a row'}"
            if isinstance(error, PlyElementParseError):
                what = f"ends within element '{error.element.name}'"
            raise ProgdfError(
                f"{self.path} {what}; it is truncated or damaged: copy or export it again"
            ) from None
        lists_follow = any(_has_lists(element) for element in elements[last:])
        return [rows[name] for name in names], 0 if lists_follow else after

    def _check_lists(self, element: PlyElement, is_needed: bool) -> None:
        name, lists = element.name, _has_lists(element)
        if lists and is_needed:
            feature = f"a list among its {name} properties"
            raise unsupported_error(self.path, feature, "export it as a plain 3DGS .ply")
        if lists and self.counts[name] * len(element.properties) > _MOST_LISTS:
            raise ProgdfError(
                f"{self.path} has {self.counts[name]} rows of lists, '{name}', before its vertices; "
                "export it with the vertices first"
            )

    def _binary_rows(self, last: int) -> tuple[dict[str, npt.NDArray[np.void]], int]:
        with _Stream(self, last) as stream:
            rows = {element.name: element.data for element in PlyData.read(stream)}
            following = self.layout.elements[last:]
            bytes_after = sum(self.counts[element.name] * _row_bytes(element) for element in following)
            return rows, self.size - stream.tell() - bytes_after

    def _text_rows(self, last: int) -> tuple[dict[str, npt.NDArray[np.void]], int]:
        """By numpy, which reads text many times as fast as plyfile."""
        rows = {}
        with self.path.open("rb") as file:
            file.seek(self.length)
            for i, element in enumerate(self.layout):
                lines = list(itertools.islice(file, self.counts[element.name]))
                if i >= last:
                    continue
                if len(lines) < self.counts[element.name]:
                    raise PlyElementParseError("early end-of-file", element)
                if not _has_lists(element):
                    rows[element.name] = np.loadtxt(lines, element.dtype(), comments=None, ndmin=1)
                    if len(rows[element.name]) < len(lines):
                        raise ValueError("an empty row")
            return rows, len(file.read().strip())


class _Stream(io.FileIO):
    """The file as plyfile is given it: a header of its first elements alone, then what is behind its own."""

    def __init__(self, ply: PlyFile, elements: int) -> None:
        super().__init__(ply.path)
        self.seek(ply.length)
        starts = [i for i, line in enumerate(ply.header) if line.startswith("element")]
        head = ply.header[: (*starts, None)[elements]]
        self._head = io.BytesIO("\n".join([*head, "end_header", ""]).encode("ascii"))

    def read(self, size: int | None = -1) -> bytes:
        return self._head.read(size) or super().read(size)


def read_header(path: str | os.PathLike[str]) -> PlyFile:
    """A .ply file, its header read and every element's count checked: its rows must fit into the file.

    Raises:
        ProgdfError: not a .ply, a broken header, or one that declares more than the file holds.
    """
    check_regular(path)
    try:
        with Path(path).open("rb") as file:
            start, size = file.read(_MAX_HEADER_BYTES), os.fstat(file.fileno()).st_size
    except OSError as error:
        raise open_error(path, error) from None
    if not start:
        raise ProgdfError(f"{path} is empty (0 bytes); copy or download it again")
    if start[:32].split(b"\n")[0].strip() != b"ply":
        plain = "is not a .ply file; its first line should be 'ply'"
        what = next((what for magic, what in _FOREIGN if start.startswith(magic)), plain)
        raise ProgdfError(f"{path} {what}")
    end = _END.search(start)
    if end is None:
        raise ProgdfError(f"{path} has a header without 'end_header'; the file is truncated or not a .ply")
    text = start[: end.start()].decode("ascii", "replace").encode("ascii", "replace").decode()
    lines = [" ".join(line.split()) for line in text.split("\n")[:-1]]
    renderings = [_RENDERING.get(line[8:].lower()) for line in lines if line.startswith("comment ")]
    header = ["comment" if line.startswith(_SKIPPED) or not line else line for line in lines]
    counts = [match for line in header if (match := _ELEMENT.fullmatch(line))]
    empty = [_ELEMENT.sub(r"\g<1>0", line) for line in header]
    try:
        layout = PlyData.read(io.BytesIO("\n".join([*empty, "end_header", ""]).encode()))
    except (PlyParseError, ValueError, OverflowError, MemoryError) as error:
        raise ProgdfError(f"{path} has a broken header: {str(error)[:100]}; export it again") from None
    rows = {element.name: int(match[2]) for element, match in zip(layout, counts, strict=False)}
    if len(rows) < len(layout.elements):
        raise ProgdfError(f"{path} has a broken header: counts are digits; export it again")
    antialiased = next((known for known in reversed(renderings) if known is not None), False)
    ply = PlyFile(Path(path), layout, rows, tuple(header), end.end(), size, antialiased)
    _check_counts(ply)
    return ply


def _check_counts(ply: PlyFile) -> None:
    remaining = ply.size - ply.length
    for element in ply.layout:
        # an ascii value takes at least a digit and a separator; the file's last separator may be missing
        text, count = ply.layout.text, ply.counts[element.name]
        least = 2 * len(element.properties) if text else _row_bytes(element)
        if count * least > remaining + text:
            what = "Gaussians" if element.name == "vertex" else f"rows of '{element.name}'"
            raise ProgdfError(
                f"{ply.path} declares {count} {what} of {'at least ' if text else ''}{least} bytes but "
                f"has room for {max(remaining, 0) // least}, so it is truncated or its header is wrong; "
                f"copy or export it again"
            )
        remaining -= count * least


def _has_lists(element: PlyElement) -> bool:
    return any(isinstance(column, PlyListProperty) for column in element.properties)


def _row_bytes(element: PlyElement) -> int:
    """Bytes of a binary row, or of one with empty lists."""
    return sum(np.dtype(getattr(p, "len_dtype", p.val_dtype)).itemsize for p in element.properties)


Floats = npt.NDArray[np.float32]

GEOMETRY = {
    "means": ("x", "y", "z"),
    "sh0": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "logit_opacities": ("opacity",),
    "log_scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
"""The columns of each attribute that every 3DGS .ply has."""
_NORMALS = ("nx", "ny", "nz")
_BLOCK_ROWS = 4096
"""1 MB of SH3 rows: taken apart while they are in the second-level cache."""
_SH_REST = (0, 9, 24, 45, 72)


def load_ply(path: str | os.PathLike[str]) -> Gaussians:
    """The scene in a 3DGS .ply file, float32; what had to be repaired or was lost is logged as a warning.

    Positions are read as doubles where they are, and kept relative to `Gaussians.origin`. Quaternions come
    out with unit length, wxyz. Rows keep their order and number.

    Raises:
        ProgdfError: the file is missing, broken, holds no Gaussians, or is no 3DGS .ply.
    """
    scene, report = load_ply_with_report(path)
    report.log()
    return scene


def load_ply_with_report(path: str | os.PathLike[str]) -> tuple[Gaussians, LoadReport]:
    """As `load_ply`, with the report of what the file held and what was repaired."""
    ply = read_header(path)
    sh_count = _check_properties(ply)
    columns = {**GEOMETRY, "shN": tuple(f"f_rest_{i}" for i in range(sh_count))}
    (rows,), trailing = ply.rows("vertex")
    scene, counts = repair(replace(_gaussians(rows, columns), antialiased=ply.antialiased))
    used = {column for names in columns.values() for column in names}
    order = {"<": " little-endian", ">": " big-endian"}[ply.layout.byte_order] if not ply.layout.text else ""
    return scene, LoadReport(
        file=Path(path).name,
        file_bytes=ply.size,
        format=f"binary{order}" if order else "ascii",
        count=len(scene),
        sh_degree=scene.sh_degree,
        antialiased=ply.antialiased,
        ignored_properties=tuple(p for p in ply.columns("vertex") if p not in used and p not in _NORMALS),
        ignored_elements=tuple((name, count) for name, count in ply.counts.items() if name != "vertex"),
        trailing_bytes=trailing,
        **counts,
    )


def save_ply(path: str | os.PathLike[str], scene: Gaussians) -> None:
    """Write a 3DGS .ply: binary little-endian float32, properties in the order of the original 3DGS code.

    Of a scene with an origin x, y and z are doubles. The file appears whole or not at all, and says if the
    scene is anti-aliased. If the quaternions have unit length it loads to the same bits.

    Raises:
        ProgdfError: the scene is empty or holds a NaN or an infinity, or the folder does not exist.
    """
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
    """`save_ply` that reads the file back before it takes the place of `path`.

    Raises:
        ProgdfError: the file gives back anything but what was written into it; `path` is as it was.
    """
    with atomic_write(Path(path)) as temporary_file:
        save_ply(temporary_file, scene)
        read = load_ply(temporary_file)
        for name in ATTRIBUTES:
            written, loaded = getattr(scene, name), getattr(read, name)
            if name == "means" and (scene.origin, read.origin) != (ZERO, ZERO):
                # what moved may have moved the origin, about which each is rounded
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


def _check_properties(ply: PlyFile) -> int:
    """The number of f_rest properties, once every property that 3DGS needs is known to be there."""
    if "vertex" not in ply.counts:
        known = "" if "chunk" in ply.counts else "; it is not a 3DGS .ply"
        raise ProgdfError(f"{ply.path} has no element 'vertex'{known}")
    present = ply.columns("vertex")
    missing = [column for names in GEOMETRY.values() for column in names if column not in present]
    if missing:
        raise ProgdfError(f"{ply.path} {_describe(ply, missing)}")
    sh_count = sum(column.startswith("f_rest_") for column in present)
    absent = next((f"f_rest_{i}" for i in range(sh_count) if f"f_rest_{i}" not in present), None)
    if sh_count not in _SH_REST or absent:
        raise ProgdfError(
            f"{ply.path} has {sh_count} f_rest properties{f' without {absent}' if absent else ''}; "
            f"expected 0, 9, 24, 45 or 72: export it again"
        )
    if not ply.counts["vertex"]:
        raise ProgdfError(f"{ply.path} holds 0 Gaussians; a scene needs at least one: export it again")
    return sh_count


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
    """The rows taken apart, in blocks that stay in the cache; those of a plain file are a matrix."""
    rows, names = np.asarray(rows), rows.dtype.names or ()
    plain = all(rows.dtype[name] == np.dtype("<f4") for name in names)
    if not plain:
        names = tuple(name for part in columns.values() for name in part)
    index = {key: _run([names.index(name) for name in part]) for key, part in columns.items()}
    arrays: dict[str, npt.NDArray[Any]] = {
        key: np.empty((len(rows), len(part)), np.float32) for key, part in columns.items()
    }
    bands = len(columns["shN"]) // 3
    arrays["shN"] = arrays["shN"].reshape(len(rows), bands, 3)
    for first in range(0, len(rows), _BLOCK_ROWS):
        block = rows[first : first + _BLOCK_ROWS]
        if plain:
            table: Floats = block.view("<f4").reshape(len(block), -1)
        else:
            with np.errstate(
                over="ignore", invalid="ignore"
            ):  # what is beyond float32 becomes ±inf: repaired
                table = np.stack([block[name].astype(np.float32) for name in names], axis=1)
        for key, array in arrays.items():
            values: npt.NDArray[Any] = table[:, index[key]]
            if key == "shN":  # channel-major in the file, rgb innermost here
                values = values.reshape(len(block), 3, bands).transpose(0, 2, 1)
            array[first : first + _BLOCK_ROWS] = values
    places = [rows[name] for name in columns["means"]]
    if np.result_type(np.float32, *places) == np.float64:
        arrays["means"] = np.stack(places, axis=1).astype(np.float64)
    return from_arrays(arrays | {"logit_opacities": arrays["logit_opacities"][:, 0]})


def _run(index: list[int]) -> slice | list[int]:
    """Neighbouring columns as a slice, which numpy does not copy."""
    run = slice(index[0], index[-1] + 1) if index else slice(0)
    return run if index == list(range(run.start or 0, run.stop)) else index
