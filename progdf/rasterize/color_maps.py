"""A view as a linear map from the colors of some Gaussians to its pixels, for as long as nothing moves."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera

from .cpu.engine import bin_view, make_pinhole, share_tiles, to_float32
from .cpu.jit import compilation
from .cpu.weights import Runs, add_gradients, add_images, list_weights
from .engines import ActivatedGaussians, Crop, RasterView


@dataclass(frozen=True)
class ColorMap:
    """What each of M Gaussians weighs in each pixel of a window: αT.

    Args:
        count: M
        size: height and width of the window
        runs: the weights
    """

    count: int
    size: tuple[int, int]
    runs: Runs

    def picture(self, colors: Tensor) -> Tensor:
        """Σ αT·c of every pixel, on black. [M,3] -> [h,w,3]"""
        image = np.zeros((self.size[0] * self.size[1], 3), np.float32)
        add_images(self.runs, to_float32(colors).numpy(), image)
        return torch.from_numpy(image).view(*self.size, 3)

    def gradient(self, image: Tensor) -> Tensor:
        """The transpose: Σ αT·g of every Gaussian. [h,w,3] -> [M,3]"""
        colors = np.zeros((self.count, 3), np.float32)
        add_gradients(self.runs, to_float32(image).numpy().reshape(-1, 3), colors)
        return torch.from_numpy(colors)


def color_map(gaussians: ActivatedGaussians, camera: Camera, crop: Crop, rows: Tensor) -> ColorMap:
    """List what some Gaussians weigh in a window of a view, as `render` draws it.

    Args:
        gaussians: all N that are drawn; their colors are not read
        camera: the view
        crop: x0, y0, x1, y1 of the window
        rows: which of the N Gaussians, distinct. [M] int64
    """
    pinhole = make_pinhole(RasterView.of(camera, gaussians, crop))
    listed = np.full(len(gaussians.means), -1, np.int32)
    listed[rows.numpy()] = np.arange(len(rows), dtype=np.int32)
    with compilation("weights", 4):
        splats, lists = bin_view(gaussians, pinhole)
        counts = np.zeros((len(lists.starts) - 1, 2), np.int64)
        share_tiles(list_weights, pinhole, splats, lists, pinhole, listed, False, counts, _new_runs(0, 0))
        runs = _new_runs(*counts.sum(axis=0).tolist())
        places = np.cumsum(counts, axis=0) - counts
        share_tiles(list_weights, pinhole, splats, lists, pinhole, listed, True, places, runs)
    x0, y0, x1, y1 = crop
    return ColorMap(len(rows), (y1 - y0, x1 - x0), runs)


def _new_runs(runs: int, entries: int) -> Runs:
    starts = np.full(runs + 1, entries, np.int64)
    return Runs(np.empty(runs, np.int32), starts, np.empty(entries, np.int32), np.empty(entries, np.float32))
