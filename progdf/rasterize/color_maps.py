"""A view as a linear map from the colors of some Gaussians to its pixels, for as long as nothing moves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .blend_lists import add_gradients, add_pictures, list_weights
from .cpu import float32, list_view, make_view
from .jit import running

Array = NDArray[Any]


@dataclass(frozen=True)
class ColorMap:
    """What each of M Gaussians weighs in each pixel of a window: αT, run by run of one Gaussian in one tile.

    Args:
        count: M
        size: height and width of the window
        rows: the Gaussian of each run, 0..M−1. [R] int32
        starts: first entry of each run, and the number of entries. [R+1] int64
        pixels, weights: of each entry: pixel of the window, row by row; αT. [E] int32, [E] float32
    """

    count: int
    size: tuple[int, int]
    rows: Array
    starts: Array
    pixels: Array
    weights: Array

    def picture(self, colors: Tensor) -> Tensor:
        """Σ αT·c of every pixel, on black. [M,3] -> [h,w,3]"""
        image = np.zeros((self.size[0] * self.size[1], 3), np.float32)
        add_pictures(self.rows, self.starts, self.pixels, self.weights, float32(colors).numpy(), image)
        return torch.from_numpy(image).view(*self.size, 3)

    def gradient(self, image: Tensor) -> Tensor:
        """The transpose: Σ αT·g of every Gaussian. [h,w,3] -> [M,3]"""
        colors = np.zeros((self.count, 3), np.float32)
        flat = float32(image).numpy().reshape(-1, 3)
        add_gradients(self.rows, self.starts, self.pixels, self.weights, flat, colors)
        return torch.from_numpy(colors)


def color_map(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near: float,
    crop: tuple[int, int, int, int],
    rows: Tensor,
    antialiased: bool = False,
) -> ColorMap:
    """List what some Gaussians weigh in a window of a view, as `rasterize` draws it.

    Args:
        means, quats, scales, opacities, viewmat, K, width, height, near, antialiased: see `rasterize`
        crop: x0, y0, x1, y1 of the window
        rows: which of the N Gaussians, distinct. [M] int64
    """
    view = make_view(viewmat, K, width, height, near, None, antialiased, crop)
    gaussians = [float32(tensor).detach().numpy() for tensor in (means, quats, scales, opacities)]
    gaussians.append(np.zeros((len(means), 1, 3), np.float32))
    listed = np.full(len(means), -1, np.int32)
    listed[rows.numpy()] = np.arange(len(rows), dtype=np.int32)
    with running("weights", 4) as workers:
        team, lists = list_view(view, gaussians, workers, 2)
        of_splats = np.empty(len(lists.ids), np.int32)
        of_splats[lists.ranks] = listed[lists.ids]
        counts = np.zeros((view.tiles, 2), np.int64)
        given = (lists.splats, of_splats, view.window, view.grid, lists.tile_starts, lists.members)
        none, floats = np.empty(0, np.int32), np.empty(0, np.float32)
        team.share(list_weights, *given, False, counts, none, none.astype(np.int64), none, floats)
        runs, entries = counts.sum(axis=0).tolist()
        places = np.cumsum(counts, axis=0) - counts
        run_rows, starts = np.empty(runs, np.int32), np.empty(runs + 1, np.int64)
        pixels, weights = np.empty(entries, np.int32), np.empty(entries, np.float32)
        team.share(list_weights, *given, True, places, run_rows, starts, pixels, weights)
    starts[-1] = entries
    x0, y0, x1, y1 = crop
    return ColorMap(len(rows), (y1 - y0, x1 - x0), run_rows, starts, pixels, weights)
