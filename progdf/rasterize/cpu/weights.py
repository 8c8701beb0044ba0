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

from progdf.rasterize.engines import TRANSMITTANCE_MIN

from .blend import ALPHA_LIMIT, EIGHT, LOG2_ALPHA_MIN, ONE, ZERO, TileScratch, tile_corner
from .forward import (
    EXTENT_Y,
    INV_L11,
    L11,
    L22,
    MX,
    MY,
    R2,
    SLOPE,
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
_LOG2_ALPHA_MIN: Number = np.float32(LOG2_ALPHA_MIN)
_TRANSMITTANCE_LIMIT: Number = np.float32(TRANSMITTANCE_MIN)


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


@kernel(contract=True, inline=True)
def _list_tile(
    tile: int, number: int, splats: Splats, listed: ListSelection, camera: Pinhole, members: Array,
    state: Array, span: int, entry: int, out: Spans,
) -> tuple[int, int]:  # fmt: skip
    """Write one tile's spans and weights, as far as there is room. number: row of the tile in `out`

    Returns:
        `span` and `entry` after this tile, including those without room.
    """
    x, y = tile_corner(camera, tile)
    left = max(0, camera.window[0] - x)
    right = min(TILE_W, camera.window[2] - x)
    top = max(0, camera.window[1] - y)
    bottom = min(TILE_H, camera.window[3] - y)
    width = camera.window[2] - camera.window[0]
    corner = (y - camera.window[1]) * width + x - camera.window[0]
    through = state[: TILE_H * TILE_W]
    spare = state[TILE_H * TILE_W : 2 * TILE_H * TILE_W]
    through[:], spare[:] = ZERO, listed.lost  # spare: weight that may still be omitted
    out.firsts[number], out.widths[number] = 0, 0
    for i in range(top, bottom):
        for j in range(left, right):
            pixel = listed.places[corner + i * width + j]
            through[i * TILE_W + j] = ONE if pixel >= 0 else ZERO
            if pixel >= 0:
                if out.widths[number, i] == 0:
                    out.firsts[number, i] = pixel
                out.widths[number, i] += 1
    for s in members:
        shape = splats.shapes[s]
        mx = shape[MX] - x - 0.5
        my = shape[MY] - y - 0.5
        first = max(math.ceil(my - shape[EXTENT_Y]), top)
        end = min(math.floor(my + shape[EXTENT_Y]) + 1, bottom)
        for i in range(first, end):
            v = shape[L22] * (i - my)
            remaining = shape[R2] - v * v
            if remaining < 0.0:
                continue
            center = mx - shape[SLOPE] * (i - my)
            half = math.sqrt(remaining) * shape[INV_L11]
            start = max(math.ceil(center - half), left)
            stop = min(math.floor(center + half) + 1, right)
            origin = entry  # entry of the span's first weight
            place = 0  # pixel of that weight
            for j in range(start, stop):
                before = through[i * TILE_W + j]
                # the pixel is done, or the remaining weight may be omitted
                if before <= spare[i * TILE_W + j]:
                    continue
                u = shape[L11] * (j - center)
                alpha = min(np.exp2(np.float32(remaining - u * u) + _LOG2_ALPHA_MIN), ALPHA_LIMIT)
                after = before * (ONE - alpha)
                if after <= _TRANSMITTANCE_LIMIT:
                    through[i * TILE_W + j] = -before
                    continue
                through[i * TILE_W + j] = after
                if listed.rows[s] >= 0 and EIGHT * alpha * before <= spare[i * TILE_W + j]:
                    # the weight is at most an eighth of the remaining allowance
                    spare[i * TILE_W + j] -= alpha * before
                elif listed.rows[s] >= 0:
                    pixel = listed.places[corner + i * width + j] - out.firsts[number, i]
                    place = pixel if entry == origin else place
                    while entry < origin + pixel - place:  # a gap of omitted weights
                        if entry < out.weights.size:
                            out.weights[entry] = ZERO
                        entry += 1
                    if entry < out.weights.size:
                        out.weights[entry] = alpha * before
                    entry += 1
            for begin in range(origin, entry, WIDTH):
                if span < out.places.size:
                    out.rows[span] = listed.rows[s]
                    out.places[span] = i * TILE_W + place + begin - origin
                    out.lengths[span] = min(WIDTH, entry - begin)
                span += 1
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
        span, entry = _list_tile(
            tile, tile - begin, splats, listed, camera, own, scratch.state, span, entry, out
        )
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
