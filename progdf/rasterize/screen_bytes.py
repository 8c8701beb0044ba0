"""A picture as the bytes of a screen, in its size or stretched smoothly into another."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cpu.jit import Number, kernel
from .cpu.parallel import run_chunks, threads

Array = NDArray[Any]

_ZERO: Number = np.float32(0.0)
_ONE: Number = np.float32(1.0)
_WHITE: Number = np.float32(255.0)
_CHUNK_ROWS = 64  # fewer are not worth a call


def fill_screen(image: Array, screen: Array) -> None:
    """Write a picture upside down into the bytes of a screen, as OpenGL has its rows.

    Args:
        image: rgb, upper row first; clamped to 0..1. [h,w,3] float32
        screen: rgba, lower row first, opaque; filtered linearly where its size is another. [H,W,4] uint8
    """
    (height, width), (rows, columns) = screen.shape[:2], image.shape[:2]
    chunks = max(1, min(height // _CHUNK_ROWS, 2 * threads()))
    cuts = [height * chunk // chunks for chunk in range(chunks + 1)]

    at = ((np.arange(width) + 0.5) * (columns / width) - 0.5).clip(0.0, columns - 1.0)
    lefts = at.astype(np.int32)
    shares = (at - lefts).astype(np.float32)

    def fill(chunk: int) -> None:
        if (height, width) == (rows, columns):
            _copy(cuts[chunk], cuts[chunk + 1], image, screen)
        else:
            mixed = np.empty((columns + 1, 3), np.float32)
            _stretch(cuts[chunk], cuts[chunk + 1], image, lefts, shares, screen, mixed)

    run_chunks(fill, chunks)


@kernel(inline=True)
def _byte(value: Number) -> Number:
    return np.rint(min(max(value, _ZERO), _ONE) * _WHITE)


@kernel(fast=True, cache=True)
def _copy(begin: int, end: int, image: Array, screen: Array) -> None:
    """Rows begin … end − 1 of the picture."""
    height, width = screen.shape[0], screen.shape[1]
    for row in range(begin, end):
        line, out = image[row], screen[height - 1 - row]
        for column in range(width):
            for k in range(3):
                out[column, k] = _byte(line[column, k])
            out[column, 3] = 255


@kernel(fast=True, cache=True)
def _stretch(
    begin: int, end: int, image: Array, lefts: Array, shares: Array, screen: Array, mixed: Array
) -> None:
    """Rows begin … end − 1 of the stretched picture.

    Args:
        lefts, shares: of each column: which of the picture's is to the left of it, and what it has of the
            next one. [W] int32, float32
        mixed: scratch. [w+1,3] float32
    """
    rows, columns, height, width = image.shape[0], image.shape[1], screen.shape[0], screen.shape[1]
    for row in range(begin, end):
        at = min(max((row + 0.5) * rows / height - 0.5, 0.0), rows - 1.0)
        upper, lower = image[int(at)], image[min(int(at) + 1, rows - 1)]
        share = np.float32(at - int(at))
        for column in range(columns):
            for k in range(3):
                mixed[column, k] = upper[column, k] + share * (lower[column, k] - upper[column, k])
        for k in range(3):
            mixed[columns, k] = mixed[columns - 1, k]
        out = screen[height - 1 - row]
        for column in range(width):
            left, share = np.uint64(lefts[column]), shares[column]
            for k in range(3):
                out[column, k] = _byte(mixed[left, k] + share * (mixed[left + 1, k] - mixed[left, k]))
            out[column, 3] = 255
