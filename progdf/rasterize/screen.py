"""Screen output on the CPU: convert a picture to bytes, scale it, and draw lines behind it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from progdf.threads import run_chunks, threads

from .cpu.jit import Number, kernel

Array = NDArray[Any]

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
_WHITE: Number = np.float32(255.0)
_CHUNK_ROWS = 64  # rows per chunk; fewer are not worth a call


def fill_screen(image: Array, screen: Array) -> None:
    """Write a picture into the bytes of a screen, upside down because OpenGL's first row is the lowest.

    Args:
        image: rgb, upper row first, clamped to 0..1. [h,w,3] float32
        screen: rgba, lower row first, opaque. Filtered linearly if its size differs. [H,W,4] uint8
    """
    height, width = screen.shape[:2]
    rows, columns = image.shape[:2]
    chunks = max(1, min(height // _CHUNK_ROWS, 2 * threads()))
    cuts = [height * chunk // chunks for chunk in range(chunks + 1)]

    at = ((np.arange(width) + 0.5) * (columns / width) - 0.5).clip(0.0, columns - 1.0)
    lefts = at.astype(np.int32)
    shares = (at - lefts).astype(np.float32)

    def fill(chunk: int) -> None:
        if (height, width) == (rows, columns):
            _copy(cuts[chunk], cuts[chunk + 1], image, screen)
        else:
            mixed = np.empty(3 * columns + 3, np.float32)
            line = np.ones(4 * width, np.float32)
            _stretch(cuts[chunk], cuts[chunk + 1], image, lefts, shares, screen, mixed, line)

    run_chunks(fill, chunks)


@kernel(inline=True)
def _byte(value: Number) -> Number:
    return np.rint(min(max(value, _ZERO), _ONE) * _WHITE)


@kernel(fast=True, cache=True)
def _copy(begin: int, end: int, image: Array, screen: Array) -> None:
    """Copy rows begin … end − 1 of the picture."""
    height = screen.shape[0]
    width = screen.shape[1]
    for row in range(begin, end):
        line = image[row]
        out = screen[height - 1 - row]
        for column in range(width):
            for k in range(3):
                out[column, k] = _byte(line[column, k])
            out[column, 3] = 255


@kernel(fast=True, cache=True)
def _stretch(
    begin: int, end: int, image: Array, lefts: Array, shares: Array, screen: Array, mixed: Array, line: Array
) -> None:
    """Draw rows begin … end − 1 of the scaled picture, in plain loops that LLVM can vectorize.

    Args:
        lefts, shares: for each column, the picture's column left of it and the weight of the next one. [W]
            int32, float32
        mixed: scratch. [3w+3] float32
        line: scratch, initialized to ones for the opaque channel. [4W] float32
    """
    rows = image.shape[0]
    height = screen.shape[0]
    count = np.uint64(3 * image.shape[1])
    for row in range(begin, end):
        at = min(max((row + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
        upper = image[int(at)].reshape(-1)
        lower = image[min(int(at) + 1, rows - 1)].reshape(-1)
        share = np.float32(at - int(at))
        for k in range(count):
            mixed[k] = upper[k] + share * (lower[k] - upper[k])
        for k in range(np.uint64(3)):
            mixed[count + k] = mixed[count - np.uint64(3) + k]
        for column in range(np.uint64(screen.shape[1])):
            first = np.uint64(3) * np.uint64(lefts[column])
            to = np.uint64(4) * column
            share = shares[column]
            for k in range(first, first + np.uint64(3)):
                line[to + k - first] = mixed[k] + share * (mixed[k + np.uint64(3)] - mixed[k])
        out = screen[height - 1 - row].reshape(-1)
        for k in range(np.uint64(out.size)):
            out[k] = _byte(line[k])


@contextmanager
def draw_lines_behind(image: Array, transmittance: Array, lines: Array, clear: float) -> Iterator[None]:
    """Draw smooth lines, one pixel wide, into a picture for the duration of the context.

    The picture is restored afterwards, bit for bit.

    Args:
        image: [H,W,3] float32
        transmittance: visible share of the background, 0..1. [H,W]
        lines: both ends in pixels (4), their depths (2), both positions in a disc of radius 1 outside which
            no line is drawn (4), and rgb with opacity (4). [L,14] float32
        clear: radius in that disc within which a line does not fade, < 1
    """
    max_pixels = 2 * len(lines) * (max(transmittance.shape) + 1)
    pixels = np.empty((max_pixels, 2), np.int32)
    before = np.empty((max_pixels, 3), np.float32)
    count = _draw_lines(lines, clear, image, transmittance, pixels, before)
    try:
        yield
    finally:
        _restore(image, pixels[:count], before)


@kernel(cache=True, fast=True)
def _draw_lines(
    lines: Array, clear: float, image: Array, through: Array, pixels: Array, before: Array
) -> int:
    """Draw the lines. Write the changed pixels and their old colors, and return their number."""
    height, width = through.shape
    count = 0
    for i in range(len(lines)):
        x0 = lines[i, 0]
        y0 = lines[i, 1]
        dx = lines[i, 2] - x0
        dy = lines[i, 3] - y0
        first, last = _cut(x0, dx, width, 0.0, 1.0)
        first, last = _cut(y0, dy, height, first, last)
        near = 1.0 / lines[i, 4]
        far = 1.0 / lines[i, 5]
        steep = abs(dy) > abs(dx)
        start, way, extent = (y0, dy, height) if steep else (x0, dx, width)
        if way == 0.0 or not first < last:
            continue
        # pixel by pixel, because rounding would decide the number of steps of about one pixel
        ends = start + first * way, start + last * way
        begin = int(max(np.ceil(min(ends[0], ends[1]) - 0.5), 0.0))
        for pixel in range(begin, int(min(np.ceil(max(ends[0], ends[1]) - 0.5), extent))):
            at = (pixel + 0.5 - start) / way
            # position along the line in the world, which is not linear in the picture
            along = at * far / ((1.0 - at) * near + at * far)
            u = lines[i, 6] + along * (lines[i, 8] - lines[i, 6])
            v = lines[i, 7] + along * (lines[i, 9] - lines[i, 7])
            strength = lines[i, 13] * min((1.0 - np.sqrt(u * u + v * v)) / (1.0 - clear), 1.0)
            if not strength > 0.0:
                continue
            beside = (x0 + at * dx if steep else y0 + at * dy) - 0.5
            low = int(np.floor(beside))
            for side in range(2):
                column, row = (low + side, pixel) if steep else (pixel, low + side)
                if column < 0 or column >= width or row < 0 or row >= height:
                    continue
                share = strength * (beside - low if side == 1 else 1.0 - beside + low) * through[row, column]
                if not share > 0.0:
                    continue
                pixels[count, 0] = row
                pixels[count, 1] = column
                for c in range(3):
                    under = image[row, column, c]
                    before[count, c] = under
                    image[row, column, c] = under + share * (lines[i, 10 + c] - under)
                count += 1
    return count


@kernel(inline=True)
def _cut(start: float, way: float, size: float, first: float, last: float) -> tuple[float, float]:
    """Return the part of first..last of a line in which it lies between 0 and `size`."""
    if way == 0.0:
        return (first, last) if 0.0 <= start < size else (0.0, 0.0)
    a = -start / way
    b = (size - start) / way
    return max(first, min(a, b)), min(last, max(a, b))


@kernel(cache=True)
def _restore(image: Array, pixels: Array, before: Array) -> None:
    """Restore the pixels, the last one first because lines cross."""
    for k in range(len(pixels)):
        i = len(pixels) - 1 - k
        for c in range(3):
            image[pixels[i, 0], pixels[i, 1], c] = before[i, c]
