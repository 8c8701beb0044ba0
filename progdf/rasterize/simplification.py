"""Fewer Gaussians for a picture in motion: of those that matter little some, each standing for several.

After Cook, Halstead, Planck, Ryu: Stochastic simplification of aggregate detail (2007), for one view:

- a Gaussian matters by its opacity, the area that the camera sees of it, and what reaches it of the light
  (the optical depth before it, added up in a grid of cells and slices of depth);
- beyond the budget one of importance w is kept with probability p = min(1, w / t); which ones, a number
  decides that stays with each, so that nothing flickers while the camera moves;
- one that is kept takes 1/p of its area, but no more than covers where the scene is dense: there the others
  hide what is missing, and larger ones would blur its outline;
- a coarse picture is as bright as the fine one: the dilation, wider there, takes off the opacity what it adds
  to the area.

`reference.simplify` is the plain version.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera

from .conventions import ANTIALIAS_FLOOR, DILATION, GOLDEN, SIMPLIFY
from .cpu.engine import make_pinhole, share_gaussians
from .cpu.jit import Number, compilation, kernel
from .cpu.parallel import run_chunks, threads
from .cpu.project import Pinhole, Scene, camera_center, footprint, largest_extents, shade_splat
from .cpu.simd import prefetch
from .engines import ActivatedGaussians, RasterView

Array = NDArray[Any]

_ONE = int(np.float32(1.0).view(np.int32))
_SLICE_SHIFT = 19  # of a float's bits: sixteen slices for a factor of two
_SHIFT = 20  # of a float's bits: eight bins for a factor of two
_MOST = 1e30  # of a weight
_BINS = (int(np.float32(_MOST).view(np.uint32)) >> _SHIFT) + 2
_EDGES = np.maximum((np.arange(_BINS, dtype=np.uint32) << _SHIFT).view(np.float32), 1e-30).astype(np.float64)
_AHEAD = 8  # rows that are fetched before it is their turn: they lie far apart
_FULL_TURN = 2.0 * math.pi  # ∫ exp(−r²/2)


def simplify(
    gaussians: ActivatedGaussians, camera: Camera, budget: int, pixels: int = 1
) -> ActivatedGaussians:
    """What `render` draws in place of `gaussians` while something moves.

    Args:
        gaussians: the scene, float32
        camera: of the coarse picture
        budget: about how many Gaussians are drawn at most
        pixels: of the fine picture that one of the coarse one covers, each way

    Returns:
        Gaussians in the colors that this camera sees, in the order of the scene; rgb [M,3]
    """
    means, quats, scales, opacities, colors = (tensor.detach().numpy() for tensor in gaussians.tensors)
    scene = Scene(means, quats, scales, opacities, colors if colors.ndim == 3 else colors[:, None])
    view, dilation, rules = make_pinhole(RasterView.of(camera, gaussians)), DILATION / pixels**2, SIMPLIFY
    with compilation("simplification", 5):
        weights, places = np.empty(len(means), np.float32), np.empty(len(means), np.int32)
        density = _weigh_all(scene, view, dilation, weights, places)
        threshold = 0.0
        if np.count_nonzero(weights) > budget:
            before = optical_depths(density)
            threshold = _hide_all(weights, places, before, rules.least_light, budget)
        rows = _choose_all(weights, threshold)
        out = Scene(*(np.empty((len(rows), width), np.float32) for width in (3, 4, 3, 1, 3)))

        def take(begin: int, end: int) -> None:
            _take(
                begin, end, rows, weights, places, threshold, density.ravel(), dilation, rules.most_times,
                rules.dense, scene, view, out, np.empty(16),
            )  # fmt: skip

        share_gaussians(take, len(rows))
    turned, sizes, covers, shown = map(torch.from_numpy, out[1:])
    return ActivatedGaussians(torch.from_numpy(out.means), turned, sizes, covers[:, 0], shown)


def optical_depths(density: Array) -> Array:
    """What lies before each slice of a cell and of those around it, the least. [rows,columns,slices]"""
    before: Array = np.cumsum(density, axis=2) - density
    for least in (before, before.transpose(1, 0, 2)):
        around = least.copy()
        np.minimum(least[1:], around[:-1], out=least[1:])
        np.minimum(least[:-1], around[1:], out=least[:-1])
    return before


def find_threshold(counts: Array, sums: Array, budget: int) -> float:
    """The t with Σ min(1, w / t) = budget; 0 where there are no more Gaussians than that.

    Args:
        counts, sums: of the weights in each bin of their shifted bits: how many, and their sum. [bins]
    """
    above = np.append(np.cumsum(counts[::-1])[::-1], 0)
    if above[0] <= budget:
        return 0.0
    below = np.concatenate([[0.0], np.cumsum(sums)])
    kept = above[:-1] + below[:-1] / _EDGES  # falls with the edge
    at = min(int(np.flatnonzero(kept >= budget)[-1]), _BINS - 2)
    # between two edges, or it would jump from one to the next while the camera moves
    share = (kept[at] - budget) / max(kept[at] - kept[at + 1], 1e-9)
    return float(_EDGES[at] * (_EDGES[at + 1] / _EDGES[at]) ** share)


def _weigh_all(scene: Scene, view: Pinhole, dilation: float, weights: Array, places: Array) -> Array:
    """Weights and places of all Gaussians, as `_weigh`, and the optical depth of all slices."""
    size, count = SIMPLIFY.cell, len(weights)
    shape = (-(-view.window[3] // size), -(-view.window[2] // size), SIMPLIFY.slices)
    chunks = threads()
    cuts = [count * chunk // chunks for chunk in range(chunks + 1)]

    def weigh(chunk: int) -> Array:
        density = np.zeros(math.prod(shape), np.float32)
        _weigh(
            cuts[chunk], cuts[chunk + 1], scene, view, dilation, size, SIMPLIFY.slices, weights, places,
            density,
        )  # fmt: skip
        return density

    first, *others = run_chunks(weigh, chunks)
    for other in others:
        first += other
    return first.reshape(shape)


def _hide_all(weights: Array, places: Array, before: Array, least: float, budget: int) -> float:
    """Take from the weights what others hide; the threshold of the budget."""

    def hide(begin: int, end: int) -> tuple[Array, Array]:
        counts, sums = np.zeros(_BINS, np.int64), np.zeros(_BINS)
        _hide(begin, end, weights, places, before.ravel(), least, counts, sums)
        return counts, sums

    counts, sums = zip(*share_gaussians(hide, len(weights)), strict=True)
    return find_threshold(np.sum(counts, axis=0), np.sum(sums, axis=0), budget)


def _choose_all(weights: Array, threshold: float) -> Array:
    def choose(begin: int, end: int) -> Array:
        rows = np.empty(end - begin, np.int32)
        return rows[: _choose(begin, end, weights, threshold, rows)]

    return np.concatenate(share_gaussians(choose, len(weights)))


@kernel(contract=True, cache=True)
def _weigh(
    begin: int, end: int, scene: Scene, camera: Pinhole, dilation: float, size: int, slices: int,
    weights: Array, places: Array, density: Array,
) -> None:  # fmt: skip
    """Weigh Gaussians begin … end − 1.

    Args:
        dilation: of the fine picture, in pixels of this one
        size: side of a cell, pixels
        slices: of depth
        weights: out, opacity times area in pixels; 0 for what the window does not show. [N] float32
        places: out, of that in the flat grid, where there is a weight. [N] int32
        density: its optical depth is added here, see `places`. float32
    """
    x1, y1 = float(camera.window[2]), float(camera.window[3])
    focal, share = camera.fx * camera.fy, _FULL_TURN / (size * size)
    columns = -(-camera.window[2] // size)
    for i in range(begin, end):
        weights[i] = 0.0
        usable, px, py, z, wide2, high2 = largest_extents(camera, scene, i)
        out_x, out_y = max(max(-px, px - x1), 0.0), max(max(-py, py - y1), 0.0)
        if not (usable and out_x * out_x <= wide2 and out_y * out_y <= high2):
            continue
        a, b, c = abs(scene.scales[i, 0]), abs(scene.scales[i, 1]), abs(scene.scales[i, 2])
        area = max(a * b, max(a * c, b * c)) * focal / (z * z) + dilation
        weights[i] = min(scene.opacities[i] * area, _MOST)
        column = int(min(max(px, 0.0), x1 - 1.0)) // size
        row = int(min(max(py, 0.0), y1 - 1.0)) // size
        # of the logarithm of the depth, nearly
        at: Number = (np.float32(z / camera.near).view(np.int32) - _ONE) >> _SLICE_SHIFT
        places[i] = (row * columns + column) * slices + min(max(at, 0), slices - 1)
        density[places[i]] += weights[i] * share


@kernel(contract=True, cache=True)
def _hide(
    begin: int, end: int, weights: Array, places: Array, before: Array, least: float, counts: Array,
    sums: Array,
) -> None:  # fmt: skip
    """Take from the weights of Gaussians begin … end − 1 what does not reach them of the light, but for the
    share `least`; count them and add them up by bins of their bits."""
    for i in range(begin, end):
        if weights[i] > 0.0:
            weights[i] *= max(math.exp(-before[places[i]]), least)
            place = np.float32(weights[i]).view(np.int32) >> _SHIFT
            counts[place] += 1
            sums[place] += weights[i]


@kernel(cache=True)
def _choose(begin: int, end: int, weights: Array, threshold: float, rows: Array) -> int:
    """Which of the Gaussians begin … end − 1 are kept, into `rows`; how many."""
    at = 0
    for i in range(begin, end):
        lot = i * GOLDEN
        if weights[i] > 0.0 and weights[i] >= threshold * (lot - math.floor(lot)):
            rows[at] = i
            at += 1
    return at


@kernel(contract=True, cache=True)
def _take(
    begin: int, end: int, rows: Array, weights: Array, places: Array, threshold: float, density: Array,
    dilation: float, most: float, dense: float, scene: Scene, camera: Pinhole, out: Scene, basis: Array,
) -> None:  # fmt: skip
    """Take the chosen Gaussians of places begin … end − 1 as they are drawn."""
    eye = camera_center(camera)
    for at in range(begin, end):
        i, ahead = rows[at], rows[min(at + _AHEAD, end - 1)]
        prefetch(scene.means, ahead)
        prefetch(scene.quats, ahead)
        prefetch(scene.scales, ahead)
        prefetch(scene.colors, ahead)
        seen = footprint(camera, scene, i)
        enough = min(dense / max(density[places[i]], 1e-6), 1.0)
        times = min(max(enough * threshold / weights[i], 1.0), most)
        fine = seen.det0 + dilation * (seen.a + seen.c) + dilation * dilation
        wider = max(times * dilation - DILATION, 0.0)  # what the coarse picture's dilation lacks
        total = wider + DILATION
        coarse = times * times * seen.det0 + total * times * (seen.a + seen.c) + total * total
        opacity = np.float64(scene.opacities[i])
        if camera.antialiased:
            opacity *= math.sqrt(max(ANTIALIAS_FLOOR, seen.det0 / fine))
        out.opacities[at, 0] = opacity * times * math.sqrt(fine / coarse)
        extra = wider / (camera.fx * camera.fy * seen.inv_z * seen.inv_z)
        for k in range(3):
            scale = np.float64(scene.scales[i, k])
            out.means[at, k] = scene.means[i, k]
            out.scales[at, k] = math.sqrt(times * scale * scale + extra)
        for k in range(4):
            out.quats[at, k] = scene.quats[i, k]
        red, green, blue = shade_splat(scene, i, camera.degree, eye, basis)
        if camera.degree >= 0:
            red, green, blue = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
        out.colors[at, 0], out.colors[at, 1], out.colors[at, 2] = red, green, blue
