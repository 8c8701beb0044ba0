"""Kernels: what Gaussians weigh in the pixels (w = αT): summed up, or as lists."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from progdf.rasterize.conventions import ALPHA_MAX, TRANSMITTANCE_MIN

from . import spans
from .bin import TILE_H, TILE_W, TileLists
from .jit import Number, kernel
from .project import EXTENT_Y, INV_L11, L11, L22, MX, MY, R2, SLOPE, Pinhole, Splats
from .simd import WIDTH, broadcast, lane_indices, lane_sum, load, select, store

Array = NDArray[Any]

SUMS = 4
"""Numbers of one intersection: Σ w·m, Σ m, Σ w, n."""

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
_ALPHA_MAX, _T_MIN, _BASE = (
    np.float32(ALPHA_MAX),
    np.float32(TRANSMITTANCE_MIN),
    np.float32(spans.LOG2_ALPHA_MIN),
)


class Runs(NamedTuple):
    """What each of M Gaussians weighs in each pixel of a window, run by run of one Gaussian in one tile.

    Args:
        rows: the Gaussian of each run, 0..M−1. [R] int32
        starts: first entry of each run, and the number of entries. [R+1] int64
        pixels, weights: of each entry: pixel of the window, row by row; αT. [E] int32, [E] float32
    """

    rows: Array
    starts: Array
    pixels: Array
    weights: Array


@kernel(fast=True, inline=True)
def _add_weights(state: Array, batch: Array, splat: Number, out: Array) -> None:
    """Blend one splat's transmittance into a tile and add its weights to `out`.

    Args:
        state: transmittance (negative: the pixel is done) and mask. [2·spans.PLANE] float32
        batch, splat: the spans of a batch, and where the splat's begin
        out: [4] float64
    """
    inside = within = weights = pixels = broadcast(_ZERO)
    step = batch[splat + spans.STEP]
    for line in range(np.int32(batch[splat + spans.FIRST]), np.int32(batch[splat + spans.END])):
        row = np.uint64(line)
        start, stop, p, u_peak, top = spans.row_span(batch, splat, row)
        offset = start + lane_indices()
        while start < stop:
            u = u_peak + step * offset
            covered = offset < stop
            alpha = select(covered, spans.exp2(top - u * u), _ZERO)
            alpha = select(alpha < spans.MOST, alpha, spans.MOST)
            before, mask = load(state, p), load(state, p + spans.PLANE)
            after = before * (spans.ONE - alpha)
            taken = covered & (after > spans.LEAST)
            weight = select(taken, alpha * before, _ZERO)
            done = select(before < _ZERO, before, _ZERO - before)
            store(state, p, select(covered, select(taken, after, done), before))
            inside += weight * mask
            within += select(taken, mask, _ZERO)
            weights += weight
            pixels += select(taken, _ONE, _ZERO)
            p += np.uint64(WIDTH)
            offset += spans.EIGHT
            start += spans.EIGHT
    out[0] += lane_sum(inside)
    out[1] += lane_sum(within)
    out[2] += lane_sum(weights)
    out[3] += lane_sum(pixels)


@kernel(cache=True)
def accumulate_weights(
    begin: int, end: int, scratch: spans.TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    mask: Array, sums: Array,
) -> None:  # fmt: skip
    """Add up the weights of every (splat, tile) intersection in tiles begin … end − 1.

    Args:
        mask: of the full image. [H,W] float32
        sums: out, a row for each slot, zero on entry. [I,4] float64
    """
    plane = np.int64(spans.PLANE)
    state, batch, bounds = scratch
    for tile in range(begin, end):
        x, y = spans.tile_corner(camera, tile)
        state[: 2 * plane] = _ONE
        spans.tile_bounds(camera, x, y, bounds)
        for row in range(bounds[1], bounds[3]):
            for column in range(bounds[0], bounds[2]):
                state[plane + row * TILE_W + column] = mask[y + row, x + column]
        for first in range(lists.starts[tile], lists.starts[tile + 1], spans.BATCH):
            last = min(first + spans.BATCH, lists.starts[tile + 1])
            spans.find_spans(lists.members, first, last, splats, x, y, bounds, batch)
            for place in range(first, last):
                _add_weights(state, batch, np.uint64(place - first) * spans.SPLAT, sums[lists.slots[place]])


@kernel(cache=True)
def sum_slots(offsets: Array, sums: Array, totals: Array) -> None:
    """Add up each Gaussian's intersections in their fixed order. totals: out, [N,4] float64, zero on entry"""
    for i in range(totals.shape[0]):
        for slot in range(offsets[i], offsets[i + 1]):
            for k in range(SUMS):
                totals[i, k] += sums[slot, k]


@kernel(contract=True, inline=True)
def _list_tile(
    tile: int, splats: Splats, rows: Array, camera: Pinhole, members: Array, through: Array, write: bool,
    run: int, entry: int, out: Runs,
) -> tuple[int, int]:  # fmt: skip
    """One tile's runs and entries, written from places `run` and `entry` on; the places one past the last."""
    x, y = spans.tile_corner(camera, tile)
    left, right = max(0, camera.window[0] - x), min(TILE_W, camera.window[2] - x)
    top, bottom = max(0, camera.window[1] - y), min(TILE_H, camera.window[3] - y)
    width = camera.window[2] - camera.window[0]
    through[: TILE_H * TILE_W] = _ONE
    for s in members:
        shape = splats.shapes[s]
        mx, my = shape[MX] - x - 0.5, shape[MY] - y - 0.5
        first = max(math.ceil(my - shape[EXTENT_Y]), top)
        end = min(math.floor(my + shape[EXTENT_Y]) + 1, bottom)
        begun = entry
        for i in range(first, end):
            v = shape[L22] * (i - my)
            rest = shape[R2] - v * v
            if rest < 0.0:
                continue
            center = mx - shape[SLOPE] * (i - my)
            half = math.sqrt(rest) * shape[INV_L11]
            start = max(math.ceil(center - half), left)
            stop = min(math.floor(center + half) + 1, right)
            for j in range(start, stop):
                before = through[i * TILE_W + j]
                if before < 0.0:  # the pixel is done
                    continue
                u = shape[L11] * (j - center)
                alpha = min(np.exp2(np.float32(rest - u * u) + _BASE), _ALPHA_MAX)
                after = before * (_ONE - alpha)
                if after <= _T_MIN:
                    through[i * TILE_W + j] = -before
                    continue
                through[i * TILE_W + j] = after
                if rows[s] >= 0:
                    if write:
                        out.pixels[entry] = (y - camera.window[1] + i) * width + x - camera.window[0] + j
                        out.weights[entry] = alpha * before
                    entry += 1
        if entry > begun:
            if write:
                out.rows[run], out.starts[run] = rows[s], begun
            run += 1
    return run, entry


@kernel(cache=True)
def list_weights(
    begin: int, end: int, scratch: spans.TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    rows: Array, write: bool, places: Array, out: Runs,
) -> None:  # fmt: skip
    """List what the splats weigh in tiles begin … end − 1.

    Args:
        rows: the row under which a Gaussian is listed, −1: not at all. [N] int32
        write: whether to fill the lists, or only to count
        places: runs and entries of each tile, out; where they begin if `write`. [tiles,2] int64
        out: where `write`
    """
    for tile in range(begin, end):
        run, entry = (places[tile, 0], places[tile, 1]) if write else (0, 0)
        members = lists.members[lists.starts[tile] : lists.starts[tile + 1]]
        run, entry = _list_tile(tile, splats, rows, camera, members, scratch.state, write, run, entry, out)
        if not write:
            places[tile, 0], places[tile, 1] = run, entry


@kernel(fast=True, cache=True)
def add_images(runs: Runs, colors: Array, image: Array) -> None:
    """image += Σ w·c. colors: [M,3] float32; image: [h·w,3] float32"""
    for run in range(runs.rows.size):
        row = runs.rows[run]
        red, green, blue = colors[row, 0], colors[row, 1], colors[row, 2]
        for k in range(runs.starts[run], runs.starts[run + 1]):
            p, w = runs.pixels[k], runs.weights[k]
            image[p, 0] += w * red
            image[p, 1] += w * green
            image[p, 2] += w * blue


@kernel(fast=True, cache=True)
def add_gradients(runs: Runs, gradient: Array, by_colors: Array) -> None:
    """by_colors += Σ w·g. gradient: of the image, [h·w,3] float32; by_colors: [M,3] float32"""
    for run in range(runs.rows.size):
        red = green = blue = np.float32(0.0)
        for k in range(runs.starts[run], runs.starts[run + 1]):
            p, w = runs.pixels[k], runs.weights[k]
            red += w * gradient[p, 0]
            green += w * gradient[p, 1]
            blue += w * gradient[p, 2]
        row = runs.rows[run]
        by_colors[row, 0] += red
        by_colors[row, 1] += green
        by_colors[row, 2] += blue
