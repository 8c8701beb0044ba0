"""Reader and writer of 3D color lookup tables as .cube text (Adobe, DaVinci Resolve).

TITLE "Late sunset"
LUT_3D_SIZE 33
DOMAIN_MIN 0 0 0
DOMAIN_MAX 1 1 1
0.012 0.004 0.031        one color per row, red varies fastest; # begins a comment
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
"""Lattice points per edge of a written table. All color programs read this size."""

_MAX_FILE_BYTES = 80 << 20  # `MAX_SIDE`³ rows of usual length take 60 MB
_SETTINGS_MARK = "# progdf grade: "
_SETTINGS_BYTES = 8192  # the comment with the settings is within the first part of a file
_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?|nan|inf)", re.IGNORECASE)
_MAX_COLOR = 100.0  # a channel with a larger absolute value is refused
_KEYWORD_COUNTS = {"LUT_3D_SIZE": 1, "DOMAIN_MIN": 3, "DOMAIN_MAX": 3, "LUT_3D_INPUT_RANGE": 2}
"""Number of values that follow each keyword."""
_REFUSED_KEYWORDS = {
    "LUT_1D_SIZE": "a table of one dimension",
    "LUT_1D_INPUT_RANGE": "a table of one dimension",
    "LUT_IN_VIDEO_RANGE": "colors of video levels",
    "LUT_OUT_VIDEO_RANGE": "colors of video levels",
}
"""Unsupported keywords that change colors → their meaning."""
_REMEDY = "export a 3D table for full-range colors"


def read_cube(path: str | os.PathLike[str]) -> Tensor:
    """Read the colors at the points of a lattice over 0 to 1, red varying fastest. [side³,3] float32

    A table with another domain is resampled at 65³ points. Line ends of any system are read.

    Raises:
        ProgdfError: the file cannot be read, is not a 3D table, or its rows do not match its header.
    """
    name = Path(path).name
    content = read_file(path, _MAX_FILE_BYTES + 1)
    if len(content) > _MAX_FILE_BYTES:
        raise ProgdfError(f"{name} is larger than {_MAX_FILE_BYTES >> 20} MB; save a table of 33³ colors")
    text = _decode(content)
    first = re.search(r"^[ \t]*[-+.\d]", text, re.MULTILINE)
    head, rows = (text, "") if first is None else (text[: first.start()], text[first.start() :])
    keywords = _read_head(head, path)
    if "LUT_3D_SIZE" not in keywords:
        raise ProgdfError(f"{name} is not a .cube file of a 3D table: it has no LUT_3D_SIZE before its rows")
    (size,) = keywords["LUT_3D_SIZE"]
    if not (2 <= size <= MAX_SIDE and size == int(size)):
        raise ProgdfError(f"{name} has LUT_3D_SIZE {size:g}; sizes of 2 to {MAX_SIDE} are supported")
    count = int(size) ** 3
    try:
        numbers = np.loadtxt(io.StringIO(rows or "0 0 0"), ndmin=2)
    except ValueError:
        row = _invalid_row(rows)
        raise ProgdfError(
            f"{name} has an invalid row '{row:.40}', expected 3 numbers; save it again"
        ) from None
    if numbers.shape != (count, 3):
        found = f"{numbers.shape[0]} rows of {numbers.shape[1]} numbers"
        raise ProgdfError(f"{name} holds {found}, LUT_3D_SIZE {size:g} needs {count} of 3; save it again")
    if not (np.abs(numbers) <= _MAX_COLOR).all():
        raise ProgdfError(f"{name} has a color that is not finite or beyond ±{_MAX_COLOR:g}; save it again")
    table = torch.from_numpy(numbers).float()
    min_color, max_color = _domain(keywords, name)
    if bool((min_color == 0.0).all()) and bool((max_color == 1.0).all()):
        return table
    positions = ((lattice_colors(65) - min_color) / (max_color - min_color)).clamp(0.0, 1.0)
    return look_up(positions.float().T, table).T.contiguous()


def _invalid_row(rows: str) -> str:
    """Return the first line that is not three numbers, "" if there is none."""
    for line in rows.splitlines():
        values = line.partition("#")[0].split()
        if values and not (len(values) == 3 and all(map(_NUMBER.fullmatch, values))):
            return line.strip()
    return ""


def _decode(content: bytes) -> str:
    """Decode the text of a file by its byte order mark, and convert all line ends to newlines."""
    encoding = "utf-16" if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig"
    text = content.decode(encoding, "replace")
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _domain(said: Mapping[str, list[float]], name: str) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest color of the table's domain. [3] float64 each

    Raises:
        ProgdfError: the domain is empty, or two keywords contradict each other.
    """
    low, high = said.get("LUT_3D_INPUT_RANGE", [0.0, 1.0])
    min_color = said.get("DOMAIN_MIN", [low] * 3)
    max_color = said.get("DOMAIN_MAX", [high] * 3)
    if "LUT_3D_INPUT_RANGE" in said and (min_color, max_color) != ([low] * 3, [high] * 3):
        raise ProgdfError(
            f"{name} has a domain from {min_color} to {max_color}, but LUT_3D_INPUT_RANGE {low:g} {high:g}; "
            "remove the wrong one"
        )
    if any(start >= end for start, end in zip(min_color, max_color, strict=True)):
        raise ProgdfError(f"{name} has a domain from {min_color} to {max_color}, which is empty")
    return torch.tensor(min_color, dtype=torch.float64), torch.tensor(max_color, dtype=torch.float64)


def _read_head(head: str, path: str | os.PathLike[str]) -> dict[str, list[float]]:
    """Return the numbers after each keyword of the header.

    Raises:
        ProgdfError: a line does not belong to the format, or has a keyword that is not supported.
    """
    name = Path(path).name
    keywords: dict[str, list[float]] = {}
    for line in head.splitlines():
        word, *values = line.partition("#")[0].split() or [""]
        if word in ("", "TITLE"):
            continue
        check_fields(path, [word], _KEYWORD_COUNTS, _REFUSED_KEYWORDS, _REMEDY)
        if word not in _KEYWORD_COUNTS or word in keywords:
            raise ProgdfError(
                f"{name} has a line '{line.strip():.40}', which is invalid in a 3D table; save it again"
            )
        try:
            keywords[word] = [float(value) for value in values]
        except ValueError:
            keywords[word] = []
        if len(keywords[word]) != _KEYWORD_COUNTS[word] or not all(
            abs(value) <= 1e9 for value in keywords[word]
        ):
            raise ProgdfError(f"{name}: {word} is followed by '{' '.join(values):.40}', expected numbers")
    return keywords


def read_settings(path: str | os.PathLike[str]) -> str:
    """Return the settings in the comment of `write_cube`; "" if there are none."""
    with open(path, encoding="utf-8", errors="replace") as file:
        head = file.read(_SETTINGS_BYTES)
    found = re.search(rf"^{_SETTINGS_MARK}(.*)$", head, re.MULTILINE)
    return "" if found is None else found[1].strip()


def write_cube(path: str | os.PathLike[str], table: Tensor, title: str, settings: str = "") -> None:
    """Write a lattice of colors, clamped to 0 to 1, complete or not at all.

    Args:
        path: the file
        table: colors, red varying fastest. [side³,3]
        title: name of the table; characters outside ASCII become blanks
        settings: settings of a grade, kept in a comment; "" for none

    Raises:
        ProgdfError: the folder does not exist or cannot be written to.
    """
    title = re.sub(r'[^ -~]|"', " ", title)
    comment = f"{_SETTINGS_MARK}{settings}\n" if settings else ""
    head = f'TITLE "{title}"\n{comment}LUT_3D_SIZE {lattice_side(len(table))}\n'
    rows = (f"{red:.6f} {green:.6f} {blue:.6f}\n" for red, green, blue in table.clamp(0.0, 1.0).tolist())
    write_file(path, head + "".join(rows))
