"""A few boxes around the marked cells of a picture, so that little else is drawn with them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize import Crop
from progdf.rasterize.pixel_cells import CELL

MOST_RECTANGLES = 6


def dirty_rectangles(cells: NDArray[np.bool_], size: tuple[int, int], worth: int) -> list[Crop]:
    """Boxes that do not overlap and hold all marked cells.

    Args:
        cells: see `progdf.rasterize.pixel_cells`
        size: of the picture: width, height
        worth: pixels that a further box has to save

    Returns:
        x0, y0, x1, y1 in pixels, one past the last; at most `MOST_RECTANGLES`
    """
    least = worth / CELL**2
    found = _trim(cells, (0, 0, cells.shape[1], cells.shape[0]))
    whole = [found] if found else []
    while len(whole) < MOST_RECTANGLES:
        cuts = [(_cut(cells, box), i) for i, box in enumerate(whole)]
        (saved, parts), at = max(cuts, key=lambda cut: cut[0][0], default=((0, ()), 0))
        if not parts or saved < least:
            break
        whole[at : at + 1] = parts
    width, height = size
    return [(x0 * CELL, y0 * CELL, min(x1 * CELL, width), min(y1 * CELL, height)) for x0, y0, x1, y1 in whole]


def area(crops: list[Crop]) -> int:
    """Pixels in boxes that do not overlap."""
    return sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in crops)


def _cut(cells: NDArray[np.bool_], box: Crop) -> tuple[int, tuple[Crop, ...]]:
    """The straight cut through `box` that leaves most cells out, how many, and the two boxes it makes."""
    x0, y0, x1, y1 = box
    part = cells[y0:y1, x0:x1]
    best: tuple[int, tuple[Crop, ...]] = (0, ())
    for axis, offset in ((0, x0), (1, y0)):
        gaps = np.flatnonzero(~part.any(axis))  # never at an end, as boxes are trimmed
        # the ends of the runs of empty columns (rows): between them nothing can be gained
        for at in gaps[np.flatnonzero(np.diff(gaps, prepend=-2) > 1)] + offset:
            halves = (
                ((x0, y0, at, y1), (at, y0, x1, y1)) if axis == 0 else ((x0, y0, x1, at), (x0, at, x1, y1))
            )
            parts = tuple(half for half in (_trim(cells, half) for half in halves) if half)
            saved = area([box]) - area(list(parts))
            if saved > best[0]:
                best = saved, parts
    return best


def _trim(cells: NDArray[np.bool_], box: Crop) -> Crop | None:
    """The least box around the marked cells in `box`."""
    x0, y0, x1, y1 = (int(value) for value in box)
    part = cells[y0:y1, x0:x1]
    columns, rows = np.flatnonzero(part.any(0)), np.flatnonzero(part.any(1))
    if not len(columns):
        return None
    return (x0 + int(columns[0]), y0 + int(rows[0]), x0 + int(columns[-1]) + 1, y0 + int(rows[-1]) + 1)
