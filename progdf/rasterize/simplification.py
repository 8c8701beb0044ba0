"""Fewer Gaussians for a picture in motion: of those that matter little some, each standing for several.

After Cook, Halstead, Planck, Ryu: Stochastic simplification of aggregate detail (2007), for one view:

- a Gaussian weighs its opacity times the area that the fine picture shows of it, and matters by that and by
  what reaches it of the light (the optical depth before it, added up in a grid of cells and slices of depth);
- beyond the budget one of importance w is drawn with probability p = min(1, w / t); which ones, a number
  decides that stays with each, so that nothing flickers while the camera moves;
- one that is drawn stands for those of its weight that are not: by more opacity, and only where it has no
  more to give by a larger area, since that blurs outlines; where the scene is dense by no more area than
  covers: there the others hide what is missing;
- the dilation, wider in a coarse picture, is taken off the size, and the remainder off the opacity.

The plain version is in tests/helpers/plain_simplification.py.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.threads import run_chunks, threads

from .cpu.engine import make_pinhole, share_gaussians
from .cpu.forward import (
    Pinhole,
    Scene,
    camera_center,
    cross,
    dot,
    footprint,
    largest_extents,
    shade_splat,
    times,
    vec,
)
from .cpu.jit import Number, kernel, prefetch
from .engines import (
    ALPHA_MAX,
    ANTIALIAS_FLOOR,
    DILATION,
    ActivatedGaussians,
    RasterView,
)  # fmt: skip

Array = NDArray[Any]

CELL = 8
"""Side of a cell of the grid in which optical depth is added up, pixels. This and the next four are from
seven real scenes of a million (docs/experiments.md, The viewer)."""

SLICES = 224
"""Of a cell's depth from the near plane on, sixteen to a factor of two."""

LEAST_LIGHT = 0.05
"""Share of a hidden one's importance that remains, as cells know nothing of gaps."""

MOST_TIMES = 5.0
"""As much of its area one takes that stands for others, at most."""

DENSE = 8.0
"""Optical depth of a slice beyond which there is no need of more area."""

GOLDEN = 0.6180339887498949
"""Multiples of it, less the whole ones, are spread evenly however many are taken: the lots."""

_ONE = int(np.float32(1.0).view(np.int32))
_SLICE_SHIFT = 19  # of a float's bits: sixteen slices for a factor of two
_SHIFT = 20  # of a float's bits: eight bins for a factor of two
_MOST = 1e30  # of a weight
_BINS = (int(np.float32(_MOST).view(np.uint32)) >> _SHIFT) + 2
_EDGES = np.maximum((np.arange(_BINS, dtype=np.uint32) << _SHIFT).view(np.float32), 1e-30).astype(np.float64)
_AHEAD = 8  # rows that are fetched before it is their turn: they lie far apart
_FULL_TURN = 2.0 * math.pi  # ∫ exp(−r²/2)


class Chosen(NamedTuple):
    """Which Gaussians of N are drawn, and how."""

    rows: Array  # their indices. [M] int32
    weights: Array  # importance of each. [N] float32
    cells: Array  # in the flat grid, where there is a weight. [N] int32
    density: Array  # optical depth of each slice of the flat grid. float32
    threshold: float  # of a weight; a lighter one stands for several
    dilation: float  # of the fine picture, in pixels of the coarse one


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
    view, dilation = make_pinhole(RasterView.of(camera, gaussians)), DILATION / pixels**2
    weights, cells = np.empty(len(means), np.float32), np.empty(len(means), np.int32)
    density = _weigh_all(scene, view, dilation, weights, cells)
    threshold = 0.0
    if np.count_nonzero(weights) > budget:
        before, light = np.empty_like(density), np.empty_like(density)
        light_at(density, before, light)
        threshold = _hide_all(weights, cells, light.ravel(), budget)
        rows = _choose_all(weights, threshold)
    else:
        rows = np.flatnonzero(weights).astype(np.int32)
    chosen = Chosen(rows, weights, cells, density.ravel(), threshold, dilation)
    out = Scene(*(np.empty((len(rows), width), np.float32) for width in (3, 4, 3, 1, 3)))
    share_gaussians(lambda begin, end: _take(begin, end, chosen, scene, view, out, np.empty(16)), len(rows))
    out_means, out_quats, out_scales, out_opacities, rgb = map(torch.from_numpy, out)
    return ActivatedGaussians(out_means, out_quats, out_scales, out_opacities[:, 0], rgb)


@kernel(cache=True)
def light_at(density: Array, before: Array, light: Array) -> None:
    """What is left of the light at each slice in which something lies, by what is before it in its cell and
    in those around it, the least.

    Args:
        density: optical depth of each slice. [rows,columns,slices] float32
        before: scratch of that shape
        light: out, `LEAST_LIGHT` .. 1. The same shape
    """
    rows, columns, slices = density.shape
    for y in range(rows):
        for x in range(columns):
            total = np.float32(0.0)
            for k in range(slices):
                before[y, x, k] = total
                total += density[y, x, k]
    for y in range(rows):
        for x in range(columns):
            for k in range(slices):
                light[y, x, k] = before[y, x, k]
            for v in range(max(y - 1, 0), min(y + 2, rows)):
                for u in range(max(x - 1, 0), min(x + 2, columns)):
                    for k in range(slices):
                        light[y, x, k] = min(light[y, x, k], before[v, u, k])
            for k in range(slices):
                if density[y, x, k] > 0.0:
                    light[y, x, k] = max(math.exp(-light[y, x, k]), LEAST_LIGHT)


def find_threshold(counts: Array, sums: Array, budget: int) -> float:
    """The t with Σ min(1, w / t) = budget; 0 where there are no more Gaussians than that.

    Args:
        counts, sums: of the weights in each bin of their shifted bits: how many, and their sum. [bins]
    """
    above = np.append(np.cumsum(counts[::-1])[::-1], 0)
    if above[0] <= budget:
        return 0.0
    below = np.concatenate([[0.0], np.cumsum(sums)])
    expected = above[:-1] + below[:-1] / _EDGES  # falls with the edge
    at = min(int(np.flatnonzero(expected >= budget)[-1]), _BINS - 2)
    # between two edges, or it would jump from one to the next while the camera moves
    share = (expected[at] - budget) / max(expected[at] - expected[at + 1], 1e-9)
    return float(_EDGES[at] * (_EDGES[at + 1] / _EDGES[at]) ** share)


def _weigh_all(scene: Scene, view: Pinhole, dilation: float, weights: Array, cells: Array) -> Array:
    """Weights and cells of all Gaussians, as `_weigh`, and the optical depth of all slices."""
    count, shape = len(weights), (-(-view.window[3] // CELL), -(-view.window[2] // CELL), SLICES)
    chunks = threads()
    cuts = [count * chunk // chunks for chunk in range(chunks + 1)]

    def weigh(chunk: int) -> Array:
        density = np.zeros(math.prod(shape), np.float32)
        _weigh(cuts[chunk], cuts[chunk + 1], scene, view, dilation, weights, cells, density)
        return density

    first, *others = run_chunks(weigh, chunks)
    for other in others:
        first += other
    return first.reshape(shape)


def _hide_all(weights: Array, cells: Array, light: Array, budget: int) -> float:
    """Take from the weights what others hide; the threshold of the budget."""

    def hide(begin: int, end: int) -> tuple[Array, Array]:
        counts, sums = np.zeros(_BINS, np.int64), np.zeros(_BINS)
        _hide(begin, end, weights, cells, light, counts, sums)
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
    begin: int, end: int, scene: Scene, camera: Pinhole, dilation: float, weights: Array, cells: Array,
    density: Array,
) -> None:  # fmt: skip
    """Weigh Gaussians begin … end − 1.

    Args:
        dilation: of the fine picture, in pixels of this one
        weights: out, opacity times area in pixels; 0 for what the window does not show. [N] float32
        cells: out, index of each in the flat grid, where there is a weight. [N] int32
        density: its optical depth is added here, see `cells`. float32
    """
    x1, y1 = float(camera.window[2]), float(camera.window[3])
    focal, share, scale = camera.fx * camera.fy, _FULL_TURN / (CELL * CELL), 1.0 / CELL
    columns = -(-camera.window[2] // CELL)
    for i in range(begin, end):
        weights[i] = 0.0
        usable, px, py, z, wide2, high2 = largest_extents(camera, scene, i)
        out_x, out_y = max(max(-px, px - x1), 0.0), max(max(-py, py - y1), 0.0)
        if not (usable and out_x * out_x <= wide2 and out_y * out_y <= high2):
            continue
        a, b, c = abs(scene.scales[i, 0]), abs(scene.scales[i, 1]), abs(scene.scales[i, 2])
        longest, middle = max(a, max(b, c)), max(min(a, b), min(max(a, b), c))
        nearer = focal / (z * z)
        longest2, middle2 = longest * longest * nearer, middle * middle * nearer
        more = 0.0 if camera.antialiased else dilation
        area = math.sqrt((longest2 + more) * (middle2 + more))
        weights[i] = min(scene.opacities[i] * area, _MOST)
        column, row = (
            int(min(max(px, 0.0), x1 - 1.0) * scale),
            int(min(max(py, 0.0), y1 - 1.0) * scale),
        )
        # of the logarithm of the depth, nearly
        at: Number = (np.float32(z / camera.near).view(np.int32) - _ONE) >> _SLICE_SHIFT
        cells[i] = (row * columns + column) * SLICES + min(max(at, 0), SLICES - 1)
        density[cells[i]] += weights[i] * share


@kernel(cache=True)
def _hide(
    begin: int, end: int, weights: Array, cells: Array, light: Array, counts: Array, sums: Array
) -> None:
    """Take from the weights of Gaussians begin … end − 1 what does not reach their cells of the light; count
    them and add them up by bins of their bits."""
    for i in range(begin, end):
        if weights[i] > 0.0:
            weights[i] *= light[cells[i]]
            bin_index = np.float32(weights[i]).view(np.int32) >> _SHIFT
            counts[bin_index] += 1
            sums[bin_index] += weights[i]


@kernel(cache=True)
def _choose(begin: int, end: int, weights: Array, threshold: float, rows: Array) -> int:
    """Which of the Gaussians begin … end − 1 are drawn, into `rows`; how many."""
    at = 0
    for i in range(begin, end):
        lot = i * GOLDEN
        if weights[i] > 0.0 and weights[i] >= threshold * (lot - math.floor(lot)):
            rows[at] = i
            at += 1
    return at


@kernel(contract=True, cache=True)
def _take(
    begin: int, end: int, chosen: Chosen, scene: Scene, camera: Pinhole, out: Scene, basis: Array
) -> None:
    """Take the chosen Gaussians begin … end − 1 as they are drawn."""
    eye, dilation = camera_center(camera), chosen.dilation
    for at in range(begin, end):
        i, ahead = chosen.rows[at], chosen.rows[min(at + _AHEAD, end - 1)]
        prefetch(scene.means, ahead)
        prefetch(scene.quats, ahead)
        prefetch(scene.scales, ahead)
        prefetch(scene.colors, ahead)
        seen = footprint(camera, scene, i)
        opacity, stands_for = np.float64(scene.opacities[i]), chosen.threshold / chosen.weights[i]
        denser = max(min(stands_for, ALPHA_MAX / opacity), 1.0)
        enough = min(DENSE / max(chosen.density[chosen.cells[i]], 1e-6), 1.0)
        larger = min(max(enough * stands_for / denser, 1.0), MOST_TIMES)
        # the coarse picture's dilation instead of the fine one's: off the size, as far as that goes
        more = (larger * dilation - DILATION) / (camera.fx * camera.fy * seen.inv_z * seen.inv_z)
        a, b, c = vec(scene.scales, i)
        size = (
            math.sqrt(max(larger * a * a + more, 0.0)), math.sqrt(max(larger * b * b + more, 0.0)),
            math.sqrt(max(larger * c * c + more, 0.0)),
        )  # fmt: skip
        p0, p1 = times(seen.turned0, size), times(seen.turned1, size)
        normal = cross(p0, p1)
        fine = seen.det0 + dilation * (seen.a + seen.c) + dilation * dilation
        coarse = dot(normal, normal) + DILATION * (dot(p0, p0) + dot(p1, p1)) + DILATION * DILATION
        if camera.antialiased:
            opacity *= math.sqrt(max(ANTIALIAS_FLOOR, seen.det0 / fine))
        out.opacities[at, 0] = opacity * denser * larger * math.sqrt(fine / coarse)
        for k in range(3):
            out.means[at, k] = scene.means[i, k]
        out.scales[at, 0], out.scales[at, 1], out.scales[at, 2] = size
        for k in range(4):
            out.quats[at, k] = scene.quats[i, k]
        red, green, blue = shade_splat(scene, i, camera.degree, eye, basis)
        if camera.degree >= 0:
            red, green, blue = max(red, 0.0), max(green, 0.0), max(blue, 0.0)
        out.colors[at, 0], out.colors[at, 1], out.colors[at, 2] = red, green, blue
