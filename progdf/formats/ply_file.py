"""Container of .ply files: header, elements and rows, independent of their meaning.

Every count in a header is checked against the size of the file before a row is read.
"""

from __future__ import annotations

import io
import itertools
import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from plyfile import PlyData, PlyElement, PlyElementParseError, PlyListProperty, PlyParseError

from progdf.errors import ProgdfError
from progdf.io.atomic import check_regular, open_error
from progdf.io.file_rules import unsupported_error

from .containers import GZIP, START_BYTES, ZIP, check_foreign

ANTIALIASED_COMMENT = "SplatRenderMode: mip"
"""Header comment of a scene trained with Mip-Splatting's 2D filter, in the form that Brush uses."""

_ANTIALIASED_COMMENTS = {
    "splatrendermode: mip": True,
    "splatrendermode: default": False,
    "antialiased 1": True,
    "antialiased 0": False,
}
"""Antialiasing comments of Brush and Postshot, in lower case. The last one in a header counts."""

_MAX_HEADER_BYTES = 1 << 20
"""Largest size of a header."""

_MAX_LIST_VALUES = 200_000
"""Largest number of list values before the vertices. plyfile reads that many one by one in about 2 s."""

_MAX_COMMENT_LENGTH = 200  # characters; longer comments are cut

_COMMENT_KEYWORDS = ("comment", "obj_info")
_ELEMENT = re.compile(r"(element\s+\S+\s+)(\d{1,19})")
_END = re.compile(rb"^end_header[ \t]*\r?\n", re.MULTILINE)


@dataclass(frozen=True)
class PlyFile:
    """Opened .ply file with a checked header."""

    path: Path  # the file
    layout: PlyData  # format and elements, without rows
    counts: dict[str, int]  # rows of each element, by name; they fit into the file
    header: tuple[str, ...]  # header lines before end_header; comments are emptied
    length: int  # bytes of the header
    size: int  # bytes of the file
    antialiased: bool  # a comment states that the scene was trained with Mip-Splatting's 2D filter
    # texts of the comment and obj_info lines, in order; printable ASCII, single spaces
    comments: tuple[str, ...] = ()

    def columns(self, element: str) -> dict[str, str]:
        """Return the numpy type of each property that is not a list; empty if the element is missing."""
        properties = self.layout[element].properties if element in self.layout else ()
        return {p.name: p.val_dtype for p in properties if not isinstance(p, PlyListProperty)}

    def rows(self, *names: str) -> tuple[list[npt.NDArray[np.void]], int]:
        """Return the rows of elements, and the number of bytes after the last row of the file.

        Rows of a binary file are memory-mapped. The number of bytes is 0 if elements with lists follow, whose
        length is unknown.

        Raises:
            ProgdfError: a row up to the last requested element does not match the header.
        """
        elements = self.layout.elements
        last = 1 + max(i for i, element in enumerate(elements) if element.name in names)
        for element in elements[:last]:
            self._check_lists(element, element.name in names)
        try:
            with np.errstate(over="ignore"):
                rows, after = self._text_rows(last, names) if self.layout.text else self._binary_rows(last)
        except OSError as error:
            raise open_error(self.path, error) from None
        except (PlyElementParseError, ValueError, OverflowError, MemoryError) as error:
            row = re.search(r"at row \d+", str(error))
            problem = f"has too many or too few numbers, or no number, {row[0] if row else 'in a row'}"
            if isinstance(error, PlyElementParseError):
                problem = f"ends within element '{error.element.name}'"
            raise ProgdfError(
                f"{self.path} {problem}; it is truncated or damaged: copy or export it again"
            ) from None
        lists_follow = any(_has_lists(element) for element in elements[last:])
        return [rows[name] for name in names], 0 if lists_follow else after

    def _check_lists(self, element: PlyElement, is_needed: bool) -> None:
        name = element.name
        lists = _has_lists(element)
        if lists and is_needed:
            feature = f"a list among its {name} properties"
            raise unsupported_error(self.path, feature, "export it as a plain 3DGS .ply")
        if lists and self.counts[name] * len(element.properties) > _MAX_LIST_VALUES:
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

    def _text_rows(self, last: int, names: Collection[str]) -> tuple[dict[str, npt.NDArray[np.void]], int]:
        """Parse the named elements with numpy, which reads text many times faster than plyfile."""
        rows = {}
        with self.path.open("rb") as file:
            file.seek(self.length)
            for i, element in enumerate(self.layout):
                lines = list(itertools.islice(file, self.counts[element.name]))
                if i >= last:
                    continue
                if len(lines) < self.counts[element.name]:
                    raise PlyElementParseError("early end-of-file", element)
                if element.name in names:
                    rows[element.name] = np.loadtxt(lines, element.dtype(), comments=None, ndmin=1)
                    if len(rows[element.name]) < len(lines):
                        raise ValueError("an empty row")
            return rows, len(file.read().strip())


class _Stream(io.FileIO):
    """Stream for plyfile: a header with the first elements only, then the data of the file."""

    def __init__(self, ply: PlyFile, elements: int) -> None:
        super().__init__(os.fspath(ply.path))  # a text, so that numpy keeps it as the name of the mapped file
        self.seek(ply.length)
        starts = [i for i, line in enumerate(ply.header) if line.startswith("element")]
        head = ply.header[: (*starts, None)[elements]]
        self._head = io.BytesIO("\n".join([*head, "end_header", ""]).encode("ascii"))

    def read(self, size: int | None = -1) -> bytes:
        return self._head.read(size) or super().read(size)


def row_blocks(rows: npt.NDArray[np.void], count: int) -> Iterator[tuple[int, npt.NDArray[np.void]]]:
    """Yield the first index and the values of successive blocks of `PlyFile.rows`.

    Memory-mapped rows are read from their file into one buffer. Pages of the mapping would count as memory of
    the process until the end, and would double the memory of a large scene while it is loaded.

    Args:
        rows: rows of an element. [N]
        count: rows of a block. A block is valid until the next one is requested
    """
    if not isinstance(rows, np.memmap) or rows.filename is None:
        for first in range(0, len(rows), count):
            yield first, rows[first : first + count]
        return
    buffer: npt.NDArray[Any] = np.empty(min(count, len(rows)), rows.dtype)
    with open(rows.filename, "rb", buffering=0) as file:
        file.seek(rows.offset)
        for first in range(0, len(rows), count):
            block = buffer[: len(rows) - first]
            if file.readinto(block.view(np.uint8).data) < block.nbytes:
                block[:] = rows[first : first + len(block)]  # an interrupted read
                file.seek(rows.offset + (first + len(block)) * rows.itemsize)
            yield first, block


def read_header(path: str | os.PathLike[str]) -> PlyFile:
    """Read the header of a .ply file, and check that the declared rows fit into the file.

    Raises:
        ProgdfError: the file is not a .ply, its header is broken, or it declares more rows than it holds.
    """
    check_regular(path)
    try:
        with Path(path).open("rb") as file:
            start = file.read(_MAX_HEADER_BYTES)
            size = os.fstat(file.fileno()).st_size
    except OSError as error:
        raise open_error(path, error) from None
    if start[:32].split(b"\n")[0].strip() != b"ply":
        check_foreign(path, start[:START_BYTES])
        if start.startswith((GZIP, ZIP)):
            kind = "gzip data" if start.startswith(GZIP) else "a zip archive"
            raise ProgdfError(f"{path} is {kind}, not a .ply; open it with load_scene, or unpack it")
        raise ProgdfError(f"{path} is not a .ply file; its first line should be 'ply'")
    end = _END.search(start)
    if end is None:
        raise ProgdfError(f"{path} has a header without 'end_header'; the file is truncated or not a .ply")
    text = start[: end.start()].decode("ascii", "replace").encode("ascii", "replace").decode()
    lines = [" ".join(line.split()) for line in text.split("\n")[:-1]]
    antialiased_flags = [
        _ANTIALIASED_COMMENTS.get(line[8:].lower()) for line in lines if line.startswith("comment ")
    ]
    header = ["comment" if line.startswith(_COMMENT_KEYWORDS) or not line else line for line in lines]
    counts = [match for line in header if (match := _ELEMENT.fullmatch(line))]
    for line in header:
        if line.startswith("element ") and not _ELEMENT.fullmatch(line):
            raise ProgdfError(
                f"{path} has a broken header: '{line:.60}' should be a name and a count; export it again"
            )
    empty = [_ELEMENT.sub(r"\g<1>0", line) for line in header]
    try:
        layout = PlyData.read(io.BytesIO("\n".join([*empty, "end_header", ""]).encode()))
    except (PlyParseError, ValueError, OverflowError, MemoryError) as error:
        raise ProgdfError(f"{path} has a broken header: {str(error)[:100]}; export it again") from None
    rows = {element.name: int(match[2]) for element, match in zip(layout, counts, strict=False)}
    antialiased = next((known for known in reversed(antialiased_flags) if known is not None), False)
    texts = [line.partition(" ")[2] for line in lines if line.startswith(_COMMENT_KEYWORDS)]
    comments = tuple(re.sub(r"[^ -~]", "?", text[:_MAX_COMMENT_LENGTH]) for text in texts)
    ply = PlyFile(Path(path), layout, rows, tuple(header), end.end(), size, antialiased, comments)
    _check_counts(ply)
    return ply


def _check_counts(ply: PlyFile) -> None:
    remaining = ply.size - ply.length
    for element in ply.layout:
        # an ascii value takes at least a digit and a separator; the file's last separator may be missing
        text = ply.layout.text
        count = ply.counts[element.name]
        needed = 2 * len(element.properties) if text else _row_bytes(element)
        if count * needed > remaining + text:
            row_kind = "Gaussians" if element.name == "vertex" else f"rows of '{element.name}'"
            raise ProgdfError(
                f"{ply.path} declares {count} {row_kind} of {'at least ' if text else ''}{needed} bytes but "
                f"has room for {max(remaining, 0) // needed}, so it is truncated or its header is wrong; "
                f"copy or export it again"
            )
        remaining -= count * needed


def _has_lists(element: PlyElement) -> bool:
    return any(isinstance(column, PlyListProperty) for column in element.properties)


def _row_bytes(element: PlyElement) -> int:
    """Return the bytes of a binary row, with all lists empty."""
    return sum(np.dtype(getattr(p, "len_dtype", p.val_dtype)).itemsize for p in element.properties)
