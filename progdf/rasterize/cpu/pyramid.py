"""Level-of-detail pyramid for interactive rendering.

A binary tree over the scene, split at the median of the widest axis down to leaves of 4 to 8 Gaussians. Every
node is one Gaussian with the moments of its children, weighted by opacity times area. Its colors are weighted
by visibility too, and its opacity has a gain. Both are measured in pictures of the scene (pyramid_fit.py).

Cut: a view draws a node if the estimated error of merging it is below a threshold. Otherwise it descends to
the children, or to the Gaussians of a leaf. The error of a node, in pixels², is

    spread of the centers (px) × sqrt(visible area (px²) × transmittance in front of it)

and is scaled up where the colors vary or the children occlude each other. The root is there because errors
add up in squares. The transmittance comes from a coarser cut of the same view, accumulated in a grid of tiles
and depth slices. The threshold is searched so that about the requested number of Gaussians is drawn, starting
from the previous frame's.

Dense nodes have an opacity above 1, clamped when blending, which flattens their center.

Gain: Gaussians below a node overlap, so together they cover less than the sum of their areas.

Dilation: at full resolution each Gaussian is dilated by itself, so a node of many small Gaussians is as dense
as these are together. The dilation of the coarse picture is wider. The surplus is subtracted from the size of
a Gaussian, and the remainder from its opacity.

Reference implementation: tests/helpers/plain_pyramid.py.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
import torch

from progdf.camera import Camera
from progdf.rasterize.engines import (
    ALPHA_MAX,
    ALPHA_MIN,
    ANTIALIAS_FLOOR,
    DILATION,
    ActivatedGaussians,
    RasterView,
)  # fmt: skip
from progdf.threads import run_chunks

from .engine import make_pinhole, share_gaussians
from .forward import (
    Array,
    Pinhole,
    Scene,
    camera_center,
    cross,
    dot,
    extents,
    footprint,
    largest_extents,
    shade_splat,
    times,
    vec,
)
from .jit import Number, kernel, prefetch
from .nodes import (
    COLORS,
    DENSITY,
    LEAF,
    LONGEST,
    LOSS,
    MIN_WEIGHT,
    POINTS,
    PREFETCH_ROWS,
    SCALES,
    WEIGHT,
    Nodes,
    color_of,
    merge_nodes,
    part_of,
    prefetch_pick,
    roots,
    two_largest,
)

CELL = 8
"""Side of a grid cell in which optical depth is accumulated, pixels."""

SLICES = 224
"""Depth slices of the grid from the near plane on, 16 per factor of two in depth."""

MAX_OPTICAL_DEPTH = 3.0
"""Limit of the optical depth that reduces a node's error.

The grid does not resolve gaps, so more proves nothing.
"""

DENSITY_EXPONENT = 0.6
"""Exponent that turns a node's density above 1 into its opacity.

An opacity above 1 makes the center opaque and the edge steep, like several Gaussians that cover each other. A
surface of nodes as soft as one Gaussian would have holes.
"""

COARSE_CUT_FACTOR = 4.0
"""Factor of the threshold for the coarser cut that provides the transmittance."""

MIN_ERROR_PX2 = 1e-3
"""Smallest threshold, pixels². An error below it is invisible in an 8-bit picture."""

BUDGET_FILL = 0.85
"""Share of the budget at which the threshold search stops."""

_ONE_BITS = int(np.float32(1.0).view(np.int32))
_SLICES_PER_BIT = 2.0**-19  # depth slices per unit in the last place of a float32: 16 per factor of two
_SHADOW_DEPTH_RATIO = 2.0 ** (-1 / 32)  # depth factor, half a slice nearer: a surface must not shadow itself
_CHUNK_LEVELS = 4  # upper levels of the tree whose nodes are chunks for the threads
# largest factor by which occlusion reduces the error of a node
_MAX_DARKENING = math.exp(0.5 * MAX_OPTICAL_DEPTH)
_MAX_TRIALS = 12  # cuts per threshold search
_NEAR_SIGMAS = 3.0  # a node is dropped if it lies behind the near plane by this many standard deviations


class Pyramid:
    """Tree over a scene. It reads the scene's arrays in place; call `refresh` after they change.

    Args:
        gaussians: the scene, float32, with SH colors

    Attributes:
        limit: threshold for a node's error, pixels². The last search ended here
        finest: smallest threshold of the search, pixels²
        gain: factor of the opacity of merged nodes, 0 to 1
        picks: nodes of the last cut, and rows of the scene as their complement (~row). [M] int32
    """

    def __init__(self, gaussians: ActivatedGaussians) -> None:
        self.gaussians = gaussians
        self.scene = Scene(*(tensor.detach().numpy() for tensor in gaussians.tensors))
        count = len(self.scene.means)
        levels = max((count // LEAF).bit_length() - 1, 0)
        order = _sort(self.scene.means, levels)
        total = (2 << levels) - 1
        shapes = np.zeros((total, COLORS + 3 * self.scene.colors.shape[1]), np.uint16)
        means = np.zeros((total, LOSS + 1), np.float32)
        quats = shapes[:, :SCALES].view(np.int16)
        self.nodes = Nodes(means, shapes, quats, order, levels, np.ones(count, np.float32))
        self.limit = 1.0
        self.finest = MIN_ERROR_PX2
        self.gain = 1.0
        self.picks: Array = np.zeros(0, np.int32)
        self._places: Array | None = (
            None  # position of each row in the order, computed on first use. [N] int32
        )
        for level in range(levels, -1, -1):
            self._merge(level, np.arange(1 << level))

    def refresh(self, rows: Array, colors_only: bool) -> None:
        """Merge the ancestors of changed rows of the scene again. rows: [M] int64"""
        count = len(self.nodes.order)
        levels = self.nodes.levels
        if self._places is None:
            self._places = np.empty(count, np.int32)
            self._places[self.nodes.order] = np.arange(count, dtype=np.int32)
        marks = np.zeros(1 << levels, np.bool_)
        # the first leaf whose rows end after this position
        marks[((self._places[rows].astype(np.int64) + 1 << levels) - 1) // max(count, 1)] = True
        for level in range(levels, -1, -1):
            self._merge(level, np.flatnonzero(marks), colors_only)
            marks = marks[0::2] | marks[1::2]

    def weigh_colors(self, visibility: Array) -> Pyramid:
        """Return a copy of the pyramid whose colors are weighted by visibility.

        Args:
            visibility: relative visibility of each row of the scene, > 0. [N] float32
        """
        other = copy(self)
        shapes = self.nodes.shapes.copy()
        other.nodes = self.nodes._replace(
            means=self.nodes.means.copy(),
            shapes=shapes,
            quats=shapes[:, :SCALES].view(np.int16),
            visibility=visibility[self.nodes.order],
        )
        for level in range(self.nodes.levels, -1, -1):
            other._merge(level, np.arange(1 << level), colors_only=True)
        return other

    def means_of(self, values: Array) -> Array:
        """Return the mean of a value in each node, then the value of each row, the last row first.

        So a pick indexes its mean: nodes count from the start, and the complements of rows from the end.

        Args:
            values: value of each row, such as 1 for those of a region and 0 for others. [N] float32

        Returns:
            [2L-1+N] float32
        """
        count = len(self.nodes.order)
        levels = self.nodes.levels
        total = (2 << levels) - 1
        means = np.zeros(total + count, np.float32)
        own = means[::-1][:count]
        own[:] = values
        starts = np.arange(1 << levels) * count >> levels
        sizes = np.diff(starts, append=count)
        leaves = np.add.reduceat(own[self.nodes.order], starts) if count else 0.0
        means[total - (1 << levels) : total] = leaves / np.maximum(sizes, 1)
        weights = self.nodes.means[:, WEIGHT] + np.float32(MIN_WEIGHT)
        for level in range(levels - 1, -1, -1):
            first = (1 << level) - 1
            last = 2 * first + 1
            below = slice(last, 2 * last + 1)
            parts = (weights[below] * means[below]).reshape(-1, 2).sum(axis=1)
            means[first:last] = parts / weights[below].reshape(-1, 2).sum(axis=1)
        return means

    def simplify(self, camera: Camera, budget: int, pixels: int = 1) -> ActivatedGaussians:
        """Return the Gaussians to draw in place of the scene while the view changes.

        Args:
            camera: the camera of the coarse picture
            budget: approximate number of Gaussians to draw. It is exceeded only if the threshold search runs
                out of trials
            pixels: size of a coarse pixel in pixels of the full resolution, per axis

        Returns:
            Gaussians with the colors seen by this camera; rgb [M,3]
        """
        view = make_pinhole(RasterView.of(camera, self.gaussians))
        dilation = DILATION / pixels**2
        picks = self.picks = self.cut(view, budget, dilation)
        out = Scene(*(np.empty((len(picks), width), np.float32) for width in (3, 4, 3, 1, 3)))

        def take(begin: int, end: int) -> None:
            scratch = np.empty(16), np.empty(self.scene.colors.shape[1:], np.float32)
            _resolve_picks(
                begin, end, picks, self.scene, self.nodes, view, dilation, self.gain, out, *scratch
            )

        share_gaussians(take, len(picks))
        means, quats, scales, opacities, rgb = map(torch.from_numpy, out)
        return ActivatedGaussians(means, quats, scales, opacities[:, 0], rgb)

    def cut(self, view: Pinhole, budget: int, dilation: float) -> Array:
        """Return the picks of a view: nodes, and rows of the scene as their complement (~row). [M] int32"""
        for _ in range(_MAX_TRIALS):
            self.limit = max(self.limit, self.finest)
            depths = np.zeros((-(-view.window[3] // CELL), -(-view.window[2] // CELL), SLICES), np.float32)
            coarse = self._cut(view, self.limit * COARSE_CUT_FACTOR, dilation, np.zeros(1, np.float32))
            _add_depths(coarse, self.nodes, view, dilation, depths.reshape(-1))
            _sum_depths(depths)
            picks = self._cut(view, self.limit, dilation, depths.reshape(-1))
            if len(picks) <= budget and (len(picks) >= BUDGET_FILL * budget or self.limit <= self.finest):
                break
            # twice the threshold leaves about half as many
            self.limit *= (len(picks) + 1) / (0.5 * (1.0 + BUDGET_FILL) * budget)
        return picks

    def _cut(self, view: Pinhole, limit: float, dilation: float, depths: Array) -> Array:
        top = min(_CHUNK_LEVELS, self.nodes.levels)
        room = -(-len(self.nodes.order) >> top) + 1

        def walk(chunk: int) -> Array:
            picks = np.empty(room, np.int32)
            stack = np.empty(64, np.int32)
            root = (1 << top) - 1 + chunk
            return picks[: _walk(root, self.scene, self.nodes, view, limit, dilation, depths, stack, picks)]

        return np.concatenate(run_chunks(walk, 1 << top))

    def _merge(self, level: int, nodes: Array, colors_only: bool = False) -> None:
        """Merge nodes of a level, counted from its first node, from the level below."""

        def merge(begin: int, end: int) -> None:
            count, bands, _ = self.scene.colors.shape
            colors = self.scene.colors.reshape(count, 3 * bands)
            scratch = (
                np.empty(2 * LEAF),
                np.empty(colors.shape[1], np.float32),
                np.empty((3, 3)),
                np.empty(4),
            )
            merge_nodes(begin, end, nodes, level, self.scene, colors, self.nodes, colors_only, *scratch)

        share_gaussians(merge, len(nodes))


def _sort(means: Array, levels: int) -> Array:
    """Return the rows in an order in which each node's rows are adjacent. means: [N,3] -> [N] int32"""
    points = np.nan_to_num(means, nan=0.0, posinf=0.0, neginf=0.0)
    order = np.arange(len(means), dtype=np.int32)
    top = min(2, levels)
    _split(points, order, 0, 0, top)
    run_chunks(lambda chunk: _split(points, order, top, chunk, levels), 1 << top)
    return order


@kernel(cache=True)
def _split(points: Array, order: Array, level: int, first: int, levels: int) -> None:
    """Split node `first` of a level at the medians, down to `levels`. Reorders points and order alike."""
    count = points.shape[0]
    for deeper in range(level, levels):
        for node in range(first << (deeper - level), (first + 1) << (deeper - level)):
            begin = (node * count) >> deeper
            end = ((node + 1) * count) >> deeper
            axis = 0
            widest = np.float32(-1.0)
            for k in range(3):
                least = most = points[begin, k]
                for i in range(begin, end):
                    least = min(least, points[i, k])
                    most = max(most, points[i, k])
                if most - least > widest:
                    axis = k
                    widest = most - least
            _select(points, order, axis, begin, end, ((2 * node + 1) * count) >> (deeper + 1))


@kernel()
def _select(points: Array, order: Array, axis: int, begin: int, end: int, middle: int) -> None:
    """Reorder begin … end − 1 so that none before `middle` is greater than any after it (Hoare's select)."""
    low = begin
    high = end - 1
    while low < high:
        a = points[low, axis]
        b = points[(low + high) >> 1, axis]
        c = points[high, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        i = low
        j = high
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    points[i, k], points[j, k] = points[j, k], points[i, k]
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@kernel(contract=True, inline=True)
def _cell(x: float, y: float, z: float, corner: int, camera: Pinhole) -> tuple[int, float]:
    """Return one of the eight cells around pixel (x, y) at depth z.

    Args:
        corner: 0..7

    Returns:
        Index of the cell in the flat grid, and the point's share of it. Shares vary continuously with the
        point.
    """
    columns = -(-camera.window[2] // CELL)
    rows = -(-camera.window[3] // CELL)
    # approximates the logarithm of the depth
    bits: Number = np.float32(z / camera.near).view(np.int32) - _ONE_BITS
    across = min(max(x / CELL - 0.5, 0.0), columns - 1.0)
    down = min(max(y / CELL - 0.5, 0.0), rows - 1.0)
    along = min(max(bits * _SLICES_PER_BIT - 0.5, 0.0), SLICES - 2.0)
    column = int(across)
    row = int(down)
    slice_index = int(along)
    a = corner & 1
    b = corner >> 1 & 1
    c = corner >> 2
    share = abs(1 - a - across + column) * abs(1 - b - down + row) * abs(1 - c - along + slice_index)
    cell = min(row + b, rows - 1) * columns + min(column + a, columns - 1)
    return cell * SLICES + slice_index + c, share


@kernel(contract=True, inline=True)
def _is_outside(camera: Pinhole, x: float, y: float, wide2: float, high2: float) -> bool:
    """Return true if a box around pixel (x, y) lies outside the window.

    wide2, high2: half its sides, squared
    """
    out_x = max(max(-x, x - camera.window[2]), 0.0)
    out_y = max(max(-y, y - camera.window[3]), 0.0)
    return bool(out_x * out_x > wide2 or out_y * out_y > high2)


@kernel(contract=True, inline=True)
def _is_inside(camera: Pinhole, x: float, y: float, wide2: float, high2: float) -> bool:
    """Return true if the box lies inside the window. Same arguments as `_is_outside`."""
    in_x = min(x, camera.window[2] - x)
    in_y = min(y, camera.window[3] - y)
    return bool(in_x > 0.0 and in_x * in_x >= wide2 and in_y > 0.0 and in_y * in_y >= high2)


@kernel(contract=True, cache=True)
def _walk(
    root: int, scene: Scene, nodes: Nodes, camera: Pinhole, limit: float, dilation: float, depths: Array,
    stack: Array, picks: Array,
) -> int:  # fmt: skip
    """Cut the tree below a node.

    Args:
        limit: threshold for a node's error, pixels²
        depths: optical depth in front of each slice. With [1], nothing is in shadow and leaves are not opened
        stack: scratch, longer than the number of levels
        picks: out, as in `Pyramid.cut`

    Returns:
        Number of picks.
    """
    means = nodes.means
    focal = math.sqrt(camera.fx * camera.fy)
    first_leaf = (1 << nodes.levels) - 1
    count = 0
    top = 1
    stack[0] = root
    while top > 0:
        top -= 1
        i = stack[top]
        longest = np.float64(means[i, LONGEST])
        density = abs(np.float64(means[i, DENSITY]))
        z = dot(camera.rows[2], vec(means, i)) + camera.shift[2]
        reach = _NEAR_SIGMAS * longest
        if means[i, WEIGHT] <= 0.0 or z - camera.near + reach < 0.0:
            continue
        loss = np.inf
        inside = False
        wide = 0.0 if camera.antialiased else dilation * z * z / (focal * focal)
        least = (means[i, WEIGHT] + wide * means[i, POINTS]) / max(longest * longest + wide, MIN_WEIGHT)
        if z - camera.near > reach and max(density, least) >= ALPHA_MIN:
            x, y, wide2, high2 = extents(camera, vec(means, i), z, longest, density)
            if _is_outside(camera, x, y, wide2, high2):
                continue
            inside = _is_inside(camera, x, y, wide2, high2) and means[i, DENSITY] > 0.0
            area = math.sqrt(max(density, 1.0)) * means[i, WEIGHT]
            loss = np.float64(means[i, LOSS]) * math.sqrt(area) * focal * focal / (z * z)
            if depths.size > 1 and limit < loss < limit * _MAX_DARKENING:
                depth = 0.0
                for corner in range(8):
                    cell, share = _cell(x, y, (z - longest) * _SHADOW_DEPTH_RATIO, corner, camera)
                    depth += share * depths[cell]
                loss *= math.exp(-0.5 * min(depth, MAX_OPTICAL_DEPTH))
        if loss <= limit or (i >= first_leaf and depths.size == 1):
            picks[count] = i
            count += 1
        elif i >= first_leaf:
            leaf = i - first_leaf
            rows = nodes.order.shape[0]
            for k in range((leaf * rows) >> nodes.levels, ((leaf + 1) * rows) >> nodes.levels):
                picks[count] = ~nodes.order[k]
                if inside:
                    count += 1
                    continue
                usable, x, y, _, wide2, high2 = largest_extents(camera, scene, nodes.order[k])
                if usable and not _is_outside(camera, x, y, wide2, high2):
                    count += 1
        else:
            stack[top] = 2 * i + 1
            stack[top + 1] = 2 * i + 2
            prefetch(means, 4 * i + 3)
            prefetch(means, 4 * i + 5)
            top += 2
    return count


@kernel(contract=True, cache=True)
def _add_depths(picks: Array, nodes: Nodes, camera: Pinhole, dilation: float, depths: Array) -> None:
    """Add the optical depth of each node to its cells of the flat grid, at most once the area of a cell."""
    for i in picks:
        density = abs(np.float64(nodes.means[i, DENSITY]))
        mean = vec(nodes.means, i)
        longest = np.float64(nodes.means[i, LONGEST])
        z = dot(camera.rows[2], mean) + camera.shift[2]
        x, y, _, _ = extents(camera, mean, z, longest, density)
        inside = 0.0 <= x <= camera.window[2] and 0.0 <= y <= camera.window[3]
        if z > camera.near and density >= ALPHA_MIN and inside:
            nearer = camera.fx * camera.fy / (z * z)
            middle = nodes.means[i, WEIGHT] / max(density * longest, MIN_WEIGHT)
            area = math.sqrt((longest * longest * nearer + dilation) * (middle * middle * nearer + dilation))
            depth = -math.log(1.0 - min(density, ALPHA_MAX)) * min(2.0 * math.pi * area / (CELL * CELL), 1.0)
            for corner in range(8):
                cell, share = _cell(x, y, z, corner, camera)
                depths[cell] += share * depth


@kernel(cache=True)
def _sum_depths(depths: Array) -> None:
    """Replace the value of each slice by the sum of all slices in front of it. [rows,columns,slices]"""
    for row in range(depths.shape[0]):
        for column in range(depths.shape[1]):
            total = np.float32(0.0)
            for k in range(depths.shape[2]):
                total, depths[row, column, k] = total + depths[row, column, k], total


@kernel(contract=True, cache=True)
def _resolve_picks(
    begin: int, end: int, picks: Array, scene: Scene, nodes: Nodes, camera: Pinhole, dilation: float,
    gain: float, out: Scene, basis: Array, bands: Array,
) -> None:  # fmt: skip
    """Write the Gaussians to draw for picks begin … end − 1. basis, bands: scratch."""
    eye = camera_center(camera)
    for at in range(begin, end):
        prefetch_pick(picks[min(at + PREFETCH_ROWS, end - 1)], scene, nodes, True)
        merged = picks[at] >= 0
        i = max(picks[at], ~picks[at])
        mean, scale, quat = part_of(i, not merged, scene, nodes)
        seen = footprint(camera, mean, scale, quat)
        unit = 1.0 / (camera.fx * camera.fy * seen.inv_z * seen.inv_z)  # area of a pixel, world units²
        if merged:
            own = nodes.means[i]
            opacity = abs(float(own[DENSITY]))  # above 1 where several Gaussians cover each other
            if not camera.antialiased:
                longest, middle = two_largest(scale)
                wide = dilation * unit
                dilated = math.sqrt((longest * longest + wide) * (middle * middle + wide))
                opacity = max(opacity, (own[WEIGHT] + wide * own[POINTS]) / max(dilated, MIN_WEIGHT))
            opacity = gain * min(opacity, opacity**DENSITY_EXPONENT)
        else:
            opacity = float(scene.opacities[i])
        # replace the fine dilation by the coarse one: reduce the size as far as possible, then the opacity
        more = (dilation - DILATION) * unit
        a, b, c = scale
        size = roots(a * a + more, b * b + more, c * c + more)
        p0 = times(seen.turned0, size)
        p1 = times(seen.turned1, size)
        normal = cross(p0, p1)
        fine = seen.det0 + dilation * (seen.a + seen.c + dilation)
        coarse = dot(normal, normal) + DILATION * (dot(p0, p0) + dot(p1, p1)) + DILATION * DILATION
        if camera.antialiased:
            opacity *= math.sqrt(max(ANTIALIAS_FLOOR, seen.det0 / fine))
        out.opacities[at, 0] = opacity * math.sqrt(fine / coarse)
        out.quats[at, 0], out.quats[at, 1], out.quats[at, 2], out.quats[at, 3] = seen.quat
        for band in range(bands.shape[0]):
            for k in range(3):
                bands[band, k] = color_of(i, not merged, band, k, scene, nodes)
        rgb = shade_splat(mean, bands, camera.degree, eye, basis)
        for k in range(3):
            out.means[at, k], out.scales[at, k], out.colors[at, k] = mean[k], size[k], max(rgb[k], 0.0)
