"""Kernels: what some Gaussians weigh in every pixel, as lists, and pictures and gradients made from these.

While only colors change, a picture is linear in them: Σ w·c, w = αT. The lists hold w, so that a picture or
a gradient costs two multiplications an entry instead of a rasterisation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binning import TILE_H, TILE_W
from .conventions import ALPHA_MAX, TRANSMITTANCE_MIN
from .jit import kernel
from .pixels import LOG2_ALPHA_MIN
from .projection import EXTENT_Y, INV_L11, L11, L22, MX, MY, R2, SLOPE
from .shares import enter, leave, pieces

Array = NDArray[Any]

_BASE, _MOST, _LEAST = np.float32(LOG2_ALPHA_MIN), np.float32(ALPHA_MAX), np.float32(TRANSMITTANCE_MIN)
_ONE = np.float32(1.0)


@kernel(contract=True, allocates=True)
def _list_tile(
    tile: int, splats: Array, rows: Array, window: Array, grid: Array, members: Array, through: Array,
    write: bool, run: int, entry: int, run_rows: Array, run_starts: Array, pixels: Array, weights: Array,
) -> tuple[int, int]:  # fmt: skip
    """One tile's runs and entries, written from places `run` and `entry` on; the places one past the last."""
    x, y = (grid[0] + tile % grid[2]) * TILE_W, (grid[1] + tile // grid[2]) * TILE_H
    left, right = max(0, window[0] - x), min(TILE_W, window[2] - x)
    top, bottom = max(0, window[1] - y), min(TILE_H, window[3] - y)
    wide = window[2] - window[0]
    through[:] = _ONE
    for s in members:
        mx, my = splats[s, MX] - x - 0.5, splats[s, MY] - y - 0.5
        slope, l11 = splats[s, SLOPE], splats[s, L11]
        first = max(math.ceil(my - splats[s, EXTENT_Y]), top)
        end = min(math.floor(my + splats[s, EXTENT_Y]) + 1, bottom)
        begun = entry
        for i in range(first, end):
            v = splats[s, L22] * (i - my)
            rest = splats[s, R2] - v * v
            if rest < 0.0:
                continue
            center = mx - slope * (i - my)
            half = math.sqrt(rest) * splats[s, INV_L11]
            start = max(math.ceil(center - half), left)
            stop = min(math.floor(center + half) + 1, right)
            for j in range(start, stop):
                before = through[i, j]
                if before < 0.0:  # the pixel is done
                    continue
                u = l11 * (j - center)
                alpha = min(np.exp2(np.float32(rest - u * u) + _BASE), _MOST)
                after = before * (_ONE - alpha)
                if after <= _LEAST:
                    through[i, j] = -before
                    continue
                through[i, j] = after
                if rows[s] >= 0:
                    if write:
                        pixels[entry] = (y - window[1] + i) * wide + x - window[0] + j
                        weights[entry] = alpha * before
                    entry += 1
        if entry > begun:
            if write:
                run_rows[run], run_starts[run] = rows[s], begun
            run += 1
    return run, entry


@kernel(cache=True, allocates=True)
def list_weights(
    splats: Array, rows: Array, window: Array, grid: Array, tile_starts: Array, members: Array, write: bool,
    places: Array, run_rows: Array, run_starts: Array, pixels: Array, weights: Array, claims: Array,
) -> None:  # fmt: skip
    """List what the splats weigh, tile by tile; the first arguments as in `blend.blend`.

    Args:
        rows: the row under which a splat is listed, −1: not at all. [V] int32
        write: whether to fill the lists, or only to count
        places: runs and entries of each tile, out; where they begin if `write`. [tiles,2] int64
        run_rows, run_starts: out, the row of each run and its first entry. [R], [R+1]
        pixels, weights: out, of each entry: pixel of the window, row by row, and αT. [E], [E]
        claims: as `shares.Team` gives them
    """
    through = np.empty((TILE_H, TILE_W), np.float32)
    seat = enter(claims)
    for tile in pieces(claims, 0, seat, tile_starts.size - 1):
        run, entry = (places[tile, 0], places[tile, 1]) if write else (0, 0)
        listed = members[tile_starts[tile] : tile_starts[tile + 1]]
        run, entry = _list_tile(
            tile, splats, rows, window, grid, listed, through, write, run, entry, run_rows, run_starts,
            pixels, weights,
        )  # fmt: skip
        if not write:
            places[tile, 0], places[tile, 1] = run, entry
    leave(seat, claims)


@kernel(fast=True, cache=True)
def add_pictures(
    run_rows: Array, run_starts: Array, pixels: Array, weights: Array, colors: Array, image: Array
) -> None:
    """image += Σ w·c. colors: [M,3] float32; image: [h·w,3] float32"""
    for run in range(run_rows.size):
        row = run_rows[run]
        red, green, blue = colors[row, 0], colors[row, 1], colors[row, 2]
        for k in range(run_starts[run], run_starts[run + 1]):
            p, w = pixels[k], weights[k]
            image[p, 0] += w * red
            image[p, 1] += w * green
            image[p, 2] += w * blue


@kernel(fast=True, cache=True)
def add_gradients(
    run_rows: Array, run_starts: Array, pixels: Array, weights: Array, gradient: Array, by_colors: Array
) -> None:
    """by_colors += Σ w·g. gradient: of the picture, [h·w,3] float32; by_colors: [M,3] float32"""
    for run in range(run_rows.size):
        red = green = blue = np.float32(0.0)
        for k in range(run_starts[run], run_starts[run + 1]):
            p, w = pixels[k], weights[k]
            red += w * gradient[p, 0]
            green += w * gradient[p, 1]
            blue += w * gradient[p, 2]
        row = run_rows[run]
        by_colors[row, 0] += red
        by_colors[row, 1] += green
        by_colors[row, 2] += blue
