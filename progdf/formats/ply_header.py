"""The header of a .ply file: what it says, checked against the size of the file before anything is read."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from progdf.errors import ProgdfError
from progdf.io.atomic import check_regular, open_error

MAX_HEADER_BYTES = 1 << 20
"""A header that has not ended by then is no header."""

TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""The .ply type names, old and new, and numpy's codes for them."""

ANTIALIASED_COMMENT = "SplatRenderMode: mip"
"""What the header of a scene says that was trained with Mip-Splatting's 2D filter (Brush's words)."""

_RENDERING = {
    "splatrendermode: mip": True,
    "splatrendermode: default": False,
    "antialiased 1": True,
    "antialiased 0": False,
}
"""The comments that tell it, Brush's and Postshot's, in lower case; the last one counts."""

BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}

_FOREIGN = (
    (b"version https://git-lfs", "is a Git LFS pointer, not the file itself; run `git lfs pull` to fetch it"),
    (b"\x1f\x8b", "is gzip data, but no .spz scene; unpack it first"),
    (b"PK\x03\x04", "is a zip archive, but no .sog scene; unpack it first"),
    (b"<", "is a web page or XML, not a .ply; download the file itself"),
)


@dataclass(frozen=True)
class Property:
    """One column. `count_type` is set for list properties only. Types are numpy codes without byte order."""

    name: str
    type: str
    count_type: str | None = None


@dataclass(frozen=True)
class Element:
    """One table: `count` rows of the given columns."""

    name: str
    count: int
    properties: tuple[Property, ...]

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(column.name for column in self.properties)

    @property
    def has_lists(self) -> bool:
        return any(column.count_type for column in self.properties)

    @property
    def least_row_bytes(self) -> int:
        """Bytes of a binary row, or of one with empty lists."""
        return sum(int((column.count_type or column.type)[1]) for column in self.properties)


@dataclass(frozen=True)
class PlyHeader:
    """A parsed header.

    Args:
        format: "ascii", "binary_little_endian" or "binary_big_endian"
        elements: the tables in file order
        length: bytes up to and with the line break after end_header, where the first row starts
        file_size: bytes of the whole file
        antialiased: a comment says that the scene was trained with Mip-Splatting's 2D filter
    """

    format: str
    elements: tuple[Element, ...]
    length: int
    file_size: int
    antialiased: bool = False

    @property
    def byte_order(self) -> str:
        """numpy's byte order character, "" for ascii."""
        return BYTE_ORDERS[self.format]


def read_header(path: str | os.PathLike[str]) -> PlyHeader:
    """The header of a .ply file.

    Every element's count is checked: its rows must fit into the rest of the file.

    Raises:
        ProgdfError: not a .ply, a broken header, or one that promises more than the file holds.
    """
    name = os.fspath(path)
    check_regular(path)
    try:
        with Path(path).open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            return _parse(name, _header_lines(name, file), file.tell(), size)
    except OSError as error:
        raise open_error(path, error) from None


def _header_lines(name: str, file: BinaryIO) -> list[str]:
    start = file.read(32)
    if not start:
        raise ProgdfError(f"{name} is empty (0 bytes); copy or download it again")
    if start.split(b"\n")[0].strip() != b"ply":
        for magic, what in _FOREIGN:
            if start.startswith(magic):
                raise ProgdfError(f"{name} {what}")
        raise ProgdfError(f"{name} is not a .ply file; its first line should be 'ply'")
    file.seek(0)
    lines: list[str] = []
    while file.tell() < MAX_HEADER_BYTES:
        line = file.readline(MAX_HEADER_BYTES)
        text = line.decode("ascii", errors="replace").strip()
        if text == "end_header" and line.endswith(b"\n"):
            return lines
        if not line.endswith(b"\n"):
            break
        lines.append(text)
    raise ProgdfError(f"{name} has a header without 'end_header'; the file is truncated or not a .ply")


def _parse(name: str, lines: list[str], length: int, size: int) -> PlyHeader:
    form = ""
    tables: dict[str, tuple[int, dict[str, Property]]] = {}
    columns: dict[str, Property] = {}
    antialiased = False
    for line in lines[1:]:
        words = line.split()
        match words:
            case ["comment", *said]:  # never shown: whoever made the file may have written anything there
                antialiased = _RENDERING.get(" ".join(said).lower(), antialiased)
            case [] | ["obj_info", *_]:
                continue
            case ["format", kind, "1.0"] if kind in BYTE_ORDERS and not form:
                form = kind
            case ["element", table, count] if count.isascii() and count.isdigit() and len(count) < 20:
                if table in tables:
                    raise ProgdfError(f"{name} has the element '{table}' twice; export it again")
                columns = {}
                tables[table] = int(count), columns
            case ["property", "list", counts, kind, column] if tables and counts in TYPES and kind in TYPES:
                _add(name, columns, Property(column, TYPES[kind], TYPES[counts]))
            case ["property", kind, column] if tables and kind in TYPES:
                _add(name, columns, Property(column, TYPES[kind]))
            case _:
                raise ProgdfError(f"{name} has an invalid header line: {line[:60]!r}; export it again")
    if not form:
        raise ProgdfError(f"{name} does not name its format; its second line should be 'format … 1.0'")
    elements = tuple(Element(table, count, tuple(found.values())) for table, (count, found) in tables.items())
    header = PlyHeader(form, elements, length, size, antialiased)
    _check_counts(name, header)
    return header


def _add(name: str, columns: dict[str, Property], column: Property) -> None:
    if column.name in columns:
        raise ProgdfError(f"{name} has the property '{column.name}' twice; export it again")
    if column.count_type and column.count_type[0] == "f":
        raise ProgdfError(f"{name} counts the list '{column.name}' in fractions; export it again")
    columns[column.name] = column


def _check_counts(name: str, header: PlyHeader) -> None:
    room = header.file_size - header.length
    for element in header.elements:
        # an ascii value takes at least a digit and a separator; the file's last separator may be missing
        least = 2 * len(element.properties) if header.format == "ascii" else element.least_row_bytes
        slack = 1 if header.format == "ascii" else 0
        if element.count * least > room + slack:
            what = "Gaussians" if element.name == "vertex" else f"rows of '{element.name}'"
            raise ProgdfError(
                f"{name} declares {element.count} {what} of {'at least ' if slack else ''}{least} bytes but "
                f"has room for {max(room, 0) // least}, so it is truncated or its header is wrong; "
                f"copy or export it again"
            )
        room -= element.count * least
