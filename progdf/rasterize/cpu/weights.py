"""Blending weights of Gaussians as lists, for many pictures of a scene in which only colors change.

A Gaussian has spans of up to eight pixels in the rows of a tile, which are added at once. The loop over
spans has no branches: with an inner loop over the spans of a Gaussian, a picture takes 1.5 times as long. The
pixels of a tile lie in planes of 64 columns; if only some pixels of a row are selected, they are adjacent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .blend import (
    ALPHA_LIMIT,
    BATCH,
    EIGHT,
    END,
    FIRST,
    ONE,
    SPLAT,
    STEP,
    TRANSMITTANCE_LIMIT,
    ZERO,
    TileScratch,
    exp2,
    find_spans,
    row_span,
    tile_bounds,
    tile_corner,
)
from .forward import (
    TILE_H,
    TILE_W,
    Pinhole,
    Splats,
    TileLists,
)  # fmt: skip
from .jit import WIDTH, Number, kernel, lane_indices, lane_sum, load, load_numbers, select, store

Array = NDArray[Any]

WEIGHT_STEPS = 65535
"""Number of steps of a weight in 16 bits."""

_PLANE = TILE_W * TILE_H + WIDTH  # pixels of a tile, and room for the surplus of the last group of eight
_G = np.uint64(_PLANE)  # start of the plane of the second channel
_B = np.uint64(2 * _PLANE)
# Planes of a tile: transmittance (negative: the pixel is done), weight that may still be omitted, weights of
# the current splat, and index of the pixel in its row of the list.
_SPARE, _WEIGHT, _PIXEL = (np.uint64(k * _PLANE) for k in (1, 2, 3))


class Spans(NamedTuple):
    """Blending weights of M Gaussians in the pixels of a window."""

    tiles: Array  # number of spans of each tile. [T] int32
    firsts: Array  # first listed pixel of each row of each tile. [T,8] int32
    widths: Array  # number of listed pixels of each row of each tile. [T,8] int32
    rows: Array  # Gaussian of each span, 0..M−1. [S] int32
    places: Array  # first pixel of each span in its tile: 64 · row + index in the row. [S] uint16
    lengths: Array  # number of weights of each span, 1 to 8. [S] uint8
    weights: Array  # αT, 0 in gaps; the last 8 are padding. [E+8] float32, or uint16 in units of 1/65535


class ListSelection(NamedTuple):
    """Selection of the Gaussians and pixels to list."""

    rows: Array  # index of each Gaussian in the lists, −1: not listed. [N] int32
    places: Array  # index of each pixel of the window, ascending, −1: not listed. [h·w] int32
    lost: Number  # total weight of a pixel that may be omitted. float32


@dataclass(frozen=True)
class ListedWeights:
    """Color map as lists of weights."""

    count: int  # number of colored Gaussians M
    size: tuple[int, ...]  # height and width of the window, or its number of selected pixels
    spans: Spans

    def picture(self, colors: Tensor) -> Tensor:
        """Draw an image, see `ColorMap`."""
        channels = colors.shape[1]
        image = np.empty((math.prod(self.size), channels), np.float32)  # the tiles contain every pixel
        values = colors.to("cpu", torch.float32).contiguous().numpy()
        planes = np.zeros(channels * _PLANE, np.float32)
        add = add_images if channels == 3 else add_channels
        add(self.spans, self._unit, values, planes, image)
        return torch.from_numpy(image).view(*self.size, -1)

    def gradient(self, image: Tensor) -> Tensor:
        """Return the gradient of the colors, see `ColorMap`."""
        colors = np.zeros((self.count, 3), np.float32)
        values = image.to("cpu", torch.float32).contiguous().numpy().reshape(-1, 3)
        add_gradients(self.spans, self._unit, values, np.zeros(3 * _PLANE, np.float32), colors)
        return torch.from_numpy(colors)

    def entries(self) -> tuple[Array, Array, Array]:
        """Return Gaussian [E] int32, pixel [E] int32 and weight [E] float32 of every nonzero weight."""
        total = len(self.spans.weights)
        rows = np.empty(total, np.int32)
        pixels = np.empty(total, np.int32)
        weights = np.empty(total, np.float32)
        count = list_entries(self.spans, self._unit, rows, pixels, weights)
        return rows[:count], pixels[:count], weights[:count]

    @property
    def _unit(self) -> Number:
        """Weight of one step of the stored numbers."""
        return np.float32(1.0 / WEIGHT_STEPS if self.spans.weights.dtype == np.uint16 else 1.0)


def new_spans(tiles: int, runs: int, entries: int) -> Spans:
    """Return uninitialized spans for a number of Gaussians per tile, summed over tiles, and of weights."""
    spans = runs * TILE_H + entries // WIDTH
    return Spans(
        np.empty(tiles, np.int32),
        np.empty((tiles, TILE_H), np.int32),
        np.empty((tiles, TILE_H), np.int32),
        np.empty(spans, np.int32),
        np.empty(spans, np.uint16),
        np.empty(spans, np.uint8),
        np.empty(entries, np.float32),
    )


def take_spans(out: Spans, span: int, entry: int, is_exact: bool) -> Spans:
    """Return a copy of the used part, with weights in 16 bits unless they must be exact."""
    weights = out.weights[:entry]
    weights = weights.copy() if is_exact else (weights * np.float32(WEIGHT_STEPS) + 0.5).astype(np.uint16)
    return Spans(
        out.tiles,
        out.firsts,
        out.widths,
        out.rows[:span].copy(),
        out.places[:span].copy(),
        out.lengths[:span].copy(),
        weights,
    )


def join_spans(parts: list[Spans]) -> Spans:
    """Return the spans of consecutive tiles as one, with padding after the weights."""
    joined = [np.concatenate(arrays) for arrays in zip(*parts, strict=True)]
    joined[-1] = np.concatenate([joined[-1], np.zeros(WIDTH, joined[-1].dtype)])
    return Spans(*joined)


@kernel(fast=True, inline=True)
def _pass_row(state: Array, batch: Array, splat: Number, row: Number, is_listed: Number) -> None:
    """Pass one row of a splat through a tile's state, and put the weights to list into its plane.

    splat: start of its spans in `batch`
    """
    start, stop, p, u_peak, top = row_span(batch, splat, row)
    step = batch[splat + STEP]
    offset = start + lane_indices()
    while start < stop:
        u = u_peak + step * offset
        alpha = exp2(top - u * u)
        alpha = select(alpha < ALPHA_LIMIT, alpha, ALPHA_LIMIT)
        before = load(state, p)
        spare = load(state, p + _SPARE)
        after = before * (ONE - alpha)
        # a pixel is done if its remaining weight may be omitted
        is_open = (offset < stop) & (spare < before)
        taken = is_open & (after > TRANSMITTANCE_LIMIT)
        store(state, p, select(taken, after, select(is_open, ZERO - before, before)))
        if is_listed:
            weight = select(taken, alpha * before, ZERO)
            # omit a weight of at most an eighth of the remaining allowance
            is_kept = spare < EIGHT * weight
            store(state, p + _WEIGHT, select(is_kept, weight, ZERO))
            store(state, p + _SPARE, select(is_kept, spare, spare - weight))
        p += np.uint64(WIDTH)
        offset += EIGHT
        start += EIGHT


@kernel(inline=True)
def _list_row(
    state: Array, batch: Array, splat: Number, line: int, row: int, span: int, entry: int, out: Spans
) -> tuple[int, int]:
    """Write the weights of one row, as far as there is room. row: Gaussian, see `Spans`

    Returns:
        `span` and `entry` after this row, including those without room.
    """
    start, stop, p, _, _ = row_span(batch, splat, np.uint64(line))
    origin = entry  # entry of the span's first weight
    place = 0  # pixel of that weight
    for at in range(p, p + np.uint64(max(stop - start, ZERO))):
        weight = state[at + _WEIGHT]
        if weight == ZERO:
            continue
        pixel = int(state[at + _PIXEL])
        place = pixel if entry == origin else place
        while entry < origin + pixel - place:  # a gap of omitted weights
            if entry < out.weights.size:
                out.weights[entry] = ZERO
            entry += 1
        if entry < out.weights.size:
            out.weights[entry] = weight
        entry += 1
    for begin in range(origin, entry, WIDTH):
        if span < out.places.size:
            out.rows[span] = row
            out.places[span] = line * TILE_W + place + begin - origin
            out.lengths[span] = min(WIDTH, entry - begin)
        span += 1
    return span, entry


@kernel(fast=True, inline=True)
def _is_open(state: Array) -> Number:
    """Return true if some pixel of a tile may get further weights."""
    most = -ONE
    for p in range(np.uint64(TILE_H * TILE_W)):
        most = max(most, state[p] - state[p + _SPARE])
    return most > ZERO


@kernel(contract=True)
def _list_tile(
    tile: int, number: int, scratch: TileScratch, splats: Splats, listed: ListSelection, camera: Pinhole,
    members: Array, span: int, entry: int, out: Spans,
) -> tuple[int, int]:  # fmt: skip
    """Write one tile's spans and weights, as far as there is room. number: row of the tile in `out`

    Returns:
        `span` and `entry` after this tile, including those without room.
    """
    state, batch, bounds = scratch
    x, y = tile_corner(camera, tile)
    tile_bounds(camera, x, y, bounds)
    width = camera.window[2] - camera.window[0]
    corner = (y - camera.window[1]) * width + x - camera.window[0]
    state[:_PLANE] = ZERO  # transmittance, 0 in pixels that are not listed
    state[_PLANE : 2 * _PLANE] = listed.lost
    out.firsts[number], out.widths[number] = 0, 0
    for i in range(bounds[1], bounds[3]):
        for j in range(bounds[0], bounds[2]):
            pixel = listed.places[corner + i * width + j]
            if pixel >= 0:
                if out.widths[number, i] == 0:
                    out.firsts[number, i] = pixel
                at = np.uint64(i * TILE_W + j)
                state[at] = ONE
                state[at + _PIXEL] = np.float32(out.widths[number, i])
                out.widths[number, i] += 1
    count = members.size
    while count > 0 and listed.rows[members[count - 1]] < 0:  # nothing to list behind the last listed one
        count -= 1
    for begin in range(0, count, BATCH):
        end = min(begin + BATCH, count)
        find_spans(members, begin, end, splats, x, y, bounds, batch)
        for index in range(begin, end):
            splat = np.uint64(index - begin) * SPLAT
            row = listed.rows[members[index]]
            for line in range(np.int32(batch[splat + FIRST]), np.int32(batch[splat + END])):
                _pass_row(state, batch, splat, np.uint64(line), row >= 0)
                if row >= 0:
                    span, entry = _list_row(state, batch, splat, line, row, span, entry, out)
        if not _is_open(state):
            break
    return span, entry


@kernel(cache=True)
def list_weights(
    begin: int, end: int, scratch: TileScratch, splats: Splats, lists: TileLists, camera: Pinhole,
    listed: ListSelection, out: Spans,
) -> tuple[int, int]:  # fmt: skip
    """List the weights of the splats in tiles begin … end − 1.

    Returns:
        Numbers of spans and of weights, including those without room.
    """
    span = entry = 0
    for tile in range(begin, end):
        own = lists.members[lists.starts[tile] : lists.starts[tile + 1]]
        before = span
        span, entry = _list_tile(tile, tile - begin, scratch, splats, listed, camera, own, span, entry, out)
        out.tiles[tile - begin] = span - before
    return span, entry


@kernel(fast=True, cache=True)
def add_images(spans: Spans, unit: Number, colors: Array, planes: Array, image: Array) -> None:
    """Compute Σ w·c of every listed pixel.

    Args:
        spans: the weights
        unit: see `ListedWeights`
        colors: [M,3] float32
        planes: scratch. [3·PLANE] float32
        image: out. [P,3] float32
    """
    lanes = lane_indices()
    span_end = begin = np.uint64(0)
    for tile in range(spans.tiles.size):
        planes[:] = ZERO
        span_begin = span_end
        span_end += np.uint64(spans.tiles[tile])
        for span in range(span_begin, span_end):
            row = spans.rows[span]
            at = np.uint64(spans.places[span])
            w = (
                select(lanes < np.float32(spans.lengths[span]), load_numbers(spans.weights, begin), ZERO)
                * unit
            )
            begin += np.uint64(spans.lengths[span])
            store(planes, at, load(planes, at) + w * colors[row, 0])
            store(planes, at + _G, load(planes, at + _G) + w * colors[row, 1])
            store(planes, at + _B, load(planes, at + _B) + w * colors[row, 2])
        for i in range(TILE_H):
            first = np.uint64(spans.firsts[tile, i])
            for k in range(np.uint64(spans.widths[tile, i])):
                at = np.uint64(i * TILE_W) + k
                image[first + k, 0] = planes[at]
                image[first + k, 1] = planes[at + _G]
                image[first + k, 2] = planes[at + _B]


@kernel(fast=True, cache=True)
def add_channels(spans: Spans, unit: Number, values: Array, planes: Array, image: Array) -> None:
    """Compute `add_images` for any number of channels C. values: [M,C]; planes: [C·PLANE]; image: [P,C]

    For 3 channels `add_images` is faster.
    """
    lanes = lane_indices()
    channels = np.uint64(values.shape[1])
    span_end = begin = np.uint64(0)
    for tile in range(spans.tiles.size):
        planes[:] = ZERO
        span_begin = span_end
        span_end += np.uint64(spans.tiles[tile])
        for span in range(span_begin, span_end):
            row = spans.rows[span]
            at = np.uint64(spans.places[span])
            w = (
                select(lanes < np.float32(spans.lengths[span]), load_numbers(spans.weights, begin), ZERO)
                * unit
            )
            begin += np.uint64(spans.lengths[span])
            for c in range(channels):
                plane = at + c * _G
                store(planes, plane, load(planes, plane) + w * values[row, c])
        for i in range(TILE_H):
            first = np.uint64(spans.firsts[tile, i])
            for k in range(np.uint64(spans.widths[tile, i])):
                at = np.uint64(i * TILE_W) + k
                for c in range(channels):
                    image[first + k, c] = planes[at + c * _G]


@kernel(fast=True, cache=True)
def add_gradients(spans: Spans, unit: Number, image: Array, planes: Array, by_colors: Array) -> None:
    """Add Σ w·g to the gradient of each color.

    Args:
        spans: the weights
        unit: see `ListedWeights`
        image: gradient of the image. [P,3] float32
        planes: scratch, finite. [3·PLANE] float32
        by_colors: changed in place. [M,3] float32
    """
    lanes = lane_indices()
    span_end = begin = np.uint64(0)
    for tile in range(spans.tiles.size):
        if spans.tiles[tile] == 0:
            continue
        for i in range(TILE_H):
            first = np.uint64(spans.firsts[tile, i])
            for k in range(np.uint64(spans.widths[tile, i])):
                at = np.uint64(i * TILE_W) + k
                planes[at] = image[first + k, 0]
                planes[at + _G] = image[first + k, 1]
                planes[at + _B] = image[first + k, 2]
        span_begin = span_end
        span_end += np.uint64(spans.tiles[tile])
        for span in range(span_begin, span_end):
            row = spans.rows[span]
            at = np.uint64(spans.places[span])
            w = (
                select(lanes < np.float32(spans.lengths[span]), load_numbers(spans.weights, begin), ZERO)
                * unit
            )
            begin += np.uint64(spans.lengths[span])
            by_colors[row, 0] += lane_sum(w * load(planes, at))
            by_colors[row, 1] += lane_sum(w * load(planes, at + _G))
            by_colors[row, 2] += lane_sum(w * load(planes, at + _B))


@kernel(cache=True)
def list_entries(spans: Spans, unit: Number, rows: Array, pixels: Array, weights: Array) -> int:
    """Write Gaussian, pixel and weight of every nonzero weight, [E] each. Return their number."""
    span_end = begin = count = 0
    for tile in range(spans.tiles.size):
        span_begin = span_end
        span_end += spans.tiles[tile]
        for span in range(span_begin, span_end):
            line = spans.places[span] // TILE_W
            first = spans.firsts[tile, line] + spans.places[span] % TILE_W
            for k in range(spans.lengths[span]):
                if spans.weights[begin + k] == 0:
                    continue
                rows[count] = spans.rows[span]
                pixels[count] = first + k
                weights[count] = unit * np.float32(spans.weights[begin + k])
                count += 1
            begin += spans.lengths[span]
    return count
