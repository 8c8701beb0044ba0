"""3D lookup tables of colors as .cube text (Adobe, DaVinci Resolve): read into a lattice, and written.

TITLE "Late sunset"
LUT_3D_SIZE 33
DOMAIN_MIN 0 0 0
DOMAIN_MAX 1 1 1
0.012 0.004 0.031        one row a color, red fastest; # begins a comment
"""

from __future__ import annotations

import io
import os
import re
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import MOST_SIDE, lattice_colors, lattice_side
from progdf.field.grade import look_up
from progdf.io.atomic import read_file, write_file

SUFFIX = ".cube"
SIDE = 33
"""Points along an edge of what is written; all color programs read it."""

_LARGEST = 80 << 20  # bytes; `MOST_SIDE`³ rows of usual length take 60 MB
_FARTHEST = 100.0  # a color beyond is none
_KEYWORDS = {"LUT_3D_SIZE": 1, "DOMAIN_MIN": 3, "DOMAIN_MAX": 3, "LUT_3D_INPUT_RANGE": 2}
"""How many numbers each is followed by."""


def read_cube(path: str | os.PathLike[str]) -> Tensor:
    """The colors at the points of a lattice over 0..1, red fastest. [side³,3] float32

    A table with another domain is looked up at 65³ points.

    Raises:
        ProgdfError: it cannot be read, is no 3D table, or has other rows than it says.
    """
    name = Path(path).name
    content = read_file(path, _LARGEST + 1)
    if len(content) > _LARGEST:
        raise ProgdfError(f"{name} is larger than {_LARGEST >> 20} MB; save a table of 33³ colors")
    text = content.decode("utf-8-sig", "replace")
    first = re.search(r"^[ \t]*[-+.\d]", text, re.MULTILINE)
    head, rows = (text, "") if first is None else (text[: first.start()], text[first.start() :])
    said = _read_head(head, name)
    if "LUT_3D_SIZE" not in said:
        raise ProgdfError(f"{name} is not a .cube file of a 3D table: it has no LUT_3D_SIZE before its rows")
    (size,) = said["LUT_3D_SIZE"]
    if not (2 <= size <= MOST_SIDE and size == int(size)):
        raise ProgdfError(f"{name} says LUT_3D_SIZE {size:g}; a size of 2 to {MOST_SIDE} can be read")
    count = int(size) ** 3
    try:
        numbers = np.loadtxt(io.StringIO(rows or "0 0 0", newline=None), ndmin=2)
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise ProgdfError(f"{name} has a row that is no color ({reason:.100}); save it again") from None
    if numbers.shape != (count, 3):
        held = f"{numbers.shape[0]} rows of {numbers.shape[1]} numbers"
        raise ProgdfError(f"{name} holds {held}, LUT_3D_SIZE {size:g} needs {count} of 3; save it again")
    if not (np.abs(numbers) <= _FARTHEST).all():
        raise ProgdfError(f"{name} holds a number that is no color (not finite, or beyond {_FARTHEST:g})")
    table = torch.from_numpy(numbers).float()
    low, high = said.get("LUT_3D_INPUT_RANGE", [0.0, 1.0])
    least = torch.tensor(said.get("DOMAIN_MIN", [low] * 3), dtype=torch.float64)
    most = torch.tensor(said.get("DOMAIN_MAX", [high] * 3), dtype=torch.float64)
    if not bool((most > least).all()):
        raise ProgdfError(f"{name} has a domain from {least.tolist()} to {most.tolist()}, which is empty")
    if bool((least == 0.0).all()) and bool((most == 1.0).all()):
        return table
    places = ((lattice_colors(65) - least) / (most - least)).clamp(0.0, 1.0)
    return look_up(places.float().T, table).T.contiguous()


def _read_head(head: str, name: str) -> dict[str, list[float]]:
    """The numbers after each keyword."""
    said: dict[str, list[float]] = {}
    for line in head.splitlines():
        word, *values = line.partition("#")[0].split() or [""]
        if word in ("", "TITLE"):
            continue
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
