"""3D lookup tables of colors as .cube text (Adobe, DaVinci Resolve): read into a lattice, and written.

TITLE "Late sunset"
LUT_3D_SIZE 33
DOMAIN_MIN 0 0 0
DOMAIN_MAX 1 1 1
0.012 0.004 0.031        one row a color, red fastest; # begins a comment
"""

from __future__ import annotations

import codecs
import io
import os
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import MAX_SIDE, lattice_colors, lattice_side
from progdf.field.grade import look_up
from progdf.io.atomic import read_file, write_file
from progdf.io.file_rules import check_fields

SUFFIX = ".cube"
SIDE = 33
"""Points along an edge of what is written; all color programs read it."""

_LARGEST = 80 << 20  # bytes; `MAX_SIDE`³ rows of usual length take 60 MB
_FARTHEST = 100.0  # a color beyond is none
_KEYWORDS = {"LUT_3D_SIZE": 1, "DOMAIN_MIN": 3, "DOMAIN_MAX": 3, "LUT_3D_INPUT_RANGE": 2}
"""How many numbers each is followed by."""
_REFUSED = {
    "LUT_1D_SIZE": "a table of one dimension",
    "LUT_1D_INPUT_RANGE": "a table of one dimension",
    "LUT_IN_VIDEO_RANGE": "colors of video levels",
    "LUT_OUT_VIDEO_RANGE": "colors of video levels",
}
"""Keywords of the format that change colors and are not supported → their meaning."""
_REMEDY = "export a 3D table for full-range colors"


def read_cube(path: str | os.PathLike[str]) -> Tensor:
    """Read the colors at the points of a lattice over 0..1, red fastest. [side³,3] float32

    A table with another domain is looked up at 65³ points. Lines end as on any system.

    Raises:
        ProgdfError: it cannot be read, is no 3D table, or has other rows than its head announces.
    """
    name = Path(path).name
    content = read_file(path, _LARGEST + 1)
    if len(content) > _LARGEST:
        raise ProgdfError(f"{name} is larger than {_LARGEST >> 20} MB; save a table of 33³ colors")
    text = _decode(content)
    first = re.search(r"^[ \t]*[-+.\d]", text, re.MULTILINE)
    head, rows = (text, "") if first is None else (text[: first.start()], text[first.start() :])
    said = _read_head(head, path)
    if "LUT_3D_SIZE" not in said:
        raise ProgdfError(f"{name} is not a .cube file of a 3D table: it has no LUT_3D_SIZE before its rows")
    (size,) = said["LUT_3D_SIZE"]
    if not (2 <= size <= MAX_SIDE and size == int(size)):
        raise ProgdfError(f"{name} says LUT_3D_SIZE {size:g}; a size of 2 to {MAX_SIDE} can be read")
    count = int(size) ** 3
    try:
        numbers = np.loadtxt(io.StringIO(rows or "0 0 0"), ndmin=2)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ProgdfError(f"{name} has a row that is no color ({reason:.100}); save it again") from None
    if numbers.shape != (count, 3):
        held = f"{numbers.shape[0]} rows of {numbers.shape[1]} numbers"
        raise ProgdfError(f"{name} holds {held}, LUT_3D_SIZE {size:g} needs {count} of 3; save it again")
    if not (np.abs(numbers) <= _FARTHEST).all():
        raise ProgdfError(f"{name} holds a number that is no color (not finite, or beyond {_FARTHEST:g})")
    table = torch.from_numpy(numbers).float()
    least, most = _domain(said, name)
    if bool((least == 0.0).all()) and bool((most == 1.0).all()):
        return table
    places = ((lattice_colors(65) - least) / (most - least)).clamp(0.0, 1.0)
    return look_up(places.float().T, table).T.contiguous()


def _decode(content: bytes) -> str:
    """Return the text of a file with any byte order mark, with line ends of any system as newlines."""
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    text = content.decode(encoding, "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _domain(said: Mapping[str, list[float]], name: str) -> tuple[Tensor, Tensor]:
    """Return the least and the largest color that the table covers. [3] float64 each

    Raises:
        ProgdfError: the domain is empty, or two keywords contradict each other.
    """
    low, high = said.get("LUT_3D_INPUT_RANGE", [0.0, 1.0])
    least = said.get("DOMAIN_MIN", [low] * 3)
    most = said.get("DOMAIN_MAX", [high] * 3)
    if "LUT_3D_INPUT_RANGE" in said and (least, most) != ([low] * 3, [high] * 3):
        raise ProgdfError(
            f"{name} has a domain from {least} to {most}, but LUT_3D_INPUT_RANGE {low:g} {high:g}; "
            "remove the wrong one"
        )
    if any(start >= end for start, end in zip(least, most, strict=True)):
        raise ProgdfError(f"{name} has a domain from {least} to {most}, which is empty")
    return torch.tensor(least, dtype=torch.float64), torch.tensor(most, dtype=torch.float64)


def _read_head(head: str, path: str | os.PathLike[str]) -> dict[str, list[float]]:
    """Read the numbers after each keyword.

    Raises:
        ProgdfError: a line is none of the format's, or has a keyword that is not supported.
    """
    name = Path(path).name
    said: dict[str, list[float]] = {}
    for line in head.splitlines():
        word, *values = line.partition("#")[0].split() or [""]
        if word in ("", "TITLE"):
            continue
        check_fields(path, [word], _KEYWORDS, _REFUSED, _REMEDY)
        if word not in _KEYWORDS or word in said:
            raise ProgdfError(
                f"{name} has a line '{line.strip():.40}', which no .cube file of a 3D table has"
            )
        try:
            said[word] = [float(value) for value in values]
        except ValueError:
            said[word] = []
        if len(said[word]) != _KEYWORDS[word] or not all(abs(value) <= 1e9 for value in said[word]):
            raise ProgdfError(f"{name}: {word} is followed by '{' '.join(values):.40}', expected numbers")
    return said


def write_cube(path: str | os.PathLike[str], table: Tensor, title: str) -> None:
    """Write a lattice of colors, held to 0..1, whole or not at all. [side³,3]

    Raises:
        ProgdfError: the folder does not exist or cannot be written to.
    """
    title = re.sub(r'[^ -~]|"', " ", title)
    head = f'TITLE "{title}"\nLUT_3D_SIZE {lattice_side(len(table))}\n'
    rows = (f"{red:.6f} {green:.6f} {blue:.6f}\n" for red, green, blue in table.clamp(0.0, 1.0).tolist())
    write_file(path, head + "".join(rows))
