"""Reference of `progdf.rasterize.cpu.pyramid` in plain torch: a recursive tree, each node from its rows."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import normalize_quats
from progdf.quaternions import matrix_quats, rotation_matrices
from progdf.rasterize.cpu.nodes import LEAF
from progdf.rasterize.cpu.pyramid import (
    CELL,
    COARSE_CUT_FACTOR,
    DENSITY_EXPONENT,
    MAX_OPTICAL_DEPTH,
    SLICES,
)
from progdf.rasterize.engines import (
    ALPHA_MAX,
    ALPHA_MIN,
    ANTIALIAS_FLOOR,
    DILATION,
    FRUSTUM_MARGIN,
    ActivatedGaussians,
    RasterView,
)  # fmt: skip
from progdf.rasterize.reference import covariances
from progdf.sh import shade


class Node(NamedTuple):
    """Merged Gaussian of some rows."""

    rows: Tensor
    weight: float
    mean: Tensor  # [3]
    covariance: Tensor  # [3,3]
    spread: float  # spread of the centers
    contrast: float  # spread of the colors of band 0
    opacity: float  # density, also above 1
    points: float  # Σ opacity
    colors: Tensor  # [K,3]


def plain_tree(gaussians: ActivatedGaussians, visibility: Tensor | None = None) -> list[Node]:
    """Return every node, level by level. visibility: see `merge_rows`"""
    count = len(gaussians.means)
    levels = max((count // LEAF).bit_length() - 1, 0)
    lists = [torch.arange(count)]
    nodes = [merge_rows(gaussians, lists[0], visibility)]
    for level in range(levels):
        halves = []
        for node, rows in enumerate(lists):
            means = gaussians.means[rows]
            axis = int((means.amax(0) - means.amin(0)).argmax())
            begin = (node * count) >> level
            middle = ((2 * node + 1) * count) >> (level + 1)
            order = rows[means[:, axis].argsort(stable=True)]
            halves += [order[: middle - begin], order[middle - begin :]]
        lists = halves
        nodes += [merge_rows(gaussians, rows, visibility) for rows in lists]
    return nodes


def merge_rows(gaussians: ActivatedGaussians, rows: Tensor, visibility: Tensor | None = None) -> Node:
    """Return one Gaussian with the moments of some rows; colors also weighted by visibility [N]."""
    means, quats, scales, opacities, colors = (tensor[rows].double() for tensor in gaussians.tensors)
    weights = opacities * scales.sort(1).values[:, 1:].prod(1)
    weights = torch.where(opacities >= ALPHA_MIN, weights, 0.0)
    share = weights / weights.sum()
    mean = share @ means
    turned = rotation_matrices(normalize_quats(quats)) * scales[:, None]
    off = means - mean
    between = torch.einsum("n,ni,nj->ij", share, off, off)
    covariance = between + torch.einsum("n,nij,nkj->ik", share, turned, turned)
    area = float(torch.linalg.eigvalsh(covariance)[1:].clamp_min(0.0).prod().sqrt())
    opacity = float(weights.sum()) / area
    spread = math.sqrt(float(between.trace()))
    seen = share if visibility is None else share * visibility[rows].double()
    seen = seen / seen.sum()
    merged = torch.einsum("n,nkc->kc", seen, colors)
    contrast = math.sqrt(float(seen @ (colors[:, 0] - merged[0]).square().sum(1)))
    return Node(
        rows, float(weights.sum()), mean, covariance, spread, contrast, opacity,
        float(opacities[opacities >= ALPHA_MIN].sum()), merged,
    )  # fmt: skip


class PlainCut:
    """Cut of a scene for a view under a limit.

    Args:
        gaussians: the whole scene, colors as spherical harmonics
        camera: camera of the coarse picture
        limit: largest loss of a node, pixels²
        pixels: fine pixels per coarse pixel along each side
        gain: factor of the opacity of merged nodes
    """

    def __init__(
        self, gaussians: ActivatedGaussians, camera: Camera, limit: float, pixels: int, gain: float = 1.0
    ) -> None:
        self._gaussians = gaussians
        self._camera = camera
        self._nodes = plain_tree(gaussians)
        self._gain = gain
        self._dilation = DILATION / pixels**2
        self._depths: Tensor | None = None
        coarse = self._cut(0, limit * COARSE_CUT_FACTOR)
        shape = (-(-camera.height // CELL), -(-camera.width // CELL), SLICES)
        depths = torch.zeros(shape, dtype=torch.double)
        for pick in coarse:
            mean, covariance, opacity, _ = self._parts(pick)
            x, y, z = self._project(mean)
            if (
                z > camera.near
                and opacity >= ALPHA_MIN
                and 0 <= x <= camera.width
                and 0 <= y <= camera.height
            ):
                nearer = self._focal2 / z**2
                sizes = torch.linalg.eigvalsh(covariance)[1:].clamp_min(0.0) * nearer + self._dilation
                part = min(2 * math.pi * float(sizes.prod().sqrt()) / CELL**2, 1.0)
                for cell, share in self._cells(x, y, z):
                    depths[cell] -= math.log(1.0 - min(opacity, ALPHA_MAX)) * part * share
        self._depths = depths.cumsum(2) - depths
        self.picks = self._cut(0, limit)

    def taken(self, picks: list[int]) -> ActivatedGaussians:
        """Return the picks as they are drawn."""
        means, sigmas, opacities, colors = zip(*map(self._parts, picks), strict=True)
        mean = torch.stack(means)
        colors = torch.stack(colors)
        opacity = torch.tensor(opacities).double()
        values, vectors = torch.linalg.eigh(torch.stack(sigmas))
        vectors = vectors * torch.linalg.det(vectors)[:, None, None]  # makes mirrors rotations
        quats = matrix_quats(vectors)
        scales = values.clamp_min(0.0).sqrt()
        view = RasterView.of(self._camera, self._gaussians)
        rotation = self._camera.viewmat[:3, :3].double()
        translation = self._camera.viewmat[:3, 3].double()
        points = mean @ rotation.T + translation
        more = (self._dilation - DILATION) * points[:, 2:] ** 2 / self._focal2
        merged = torch.tensor(picks) >= 0
        if not self._gaussians.antialiased:
            own = torch.tensor(
                [(node.weight, node.points) for node in (self._nodes[max(pick, 0)] for pick in picks)]
            ).double()
            wide = self._dilation * points[:, 2] ** 2 / self._focal2
            dilated = (values[:, 1:].clamp_min(0.0) + wide[:, None]).prod(1).sqrt()
            dense = torch.maximum(opacity, (own[:, 0] + wide * own[:, 1]) / dilated)
            opacity = torch.where(merged, dense, opacity)
        opacity = torch.where(merged, self._gain * opacity.minimum(opacity**DENSITY_EXPONENT), opacity)
        sizes = (scales**2 + more).clamp_min(0.0).sqrt()
        a, _, c, det0 = covariances(points, quats, scales, view)
        fine = det0 + self._dilation * (a + c) + self._dilation**2
        a, _, c, det = covariances(points, quats, sizes, view)
        opacity = opacity * (fine / (det + DILATION * (a + c) + DILATION**2)).sqrt()
        if self._gaussians.antialiased:
            opacity = opacity * (det0 / fine).clamp_min(ANTIALIAS_FLOOR).sqrt()
        direction = torch.nn.functional.normalize(mean + rotation.T @ translation, dim=1)
        rgb = shade(view.sh_degree or 0, direction, colors)
        return ActivatedGaussians(mean, quats, sizes, opacity, rgb).each(Tensor.float)

    @property
    def _focal2(self) -> float:
        return float(self._camera.K[0, 0] * self._camera.K[1, 1])

    def _parts(self, pick: int) -> tuple[Tensor, Tensor, float, Tensor]:
        """Return mean, covariance, opacity and colors of a node or, if the pick is ~row, of a row."""
        if pick >= 0:
            node = self._nodes[pick]
            return node.mean, node.covariance, node.opacity, node.colors
        means, quats, scales, opacities, colors = (
            tensor[~pick].double() for tensor in self._gaussians.tensors
        )
        turned = rotation_matrices(normalize_quats(quats[None]))[0] * scales
        return means, turned @ turned.T, float(opacities), colors

    def _project(self, mean: Tensor) -> tuple[float, float, float]:
        x, y, z = (self._camera.viewmat[:3, :3].double() @ mean + self._camera.viewmat[:3, 3]).tolist()
        K = self._camera.K
        return float(K[0, 0]) * x / z + float(K[0, 2]), float(K[1, 1]) * y / z + float(K[1, 2]), z

    def _cells(self, x: float, y: float, z: float) -> list[tuple[tuple[int, int, int], float]]:
        """Return the cells around a point and its share of each."""
        near = torch.tensor(z / self._camera.near).float().view(torch.int32)
        slices = int(near - torch.tensor(1.0).view(torch.int32)) / 2**19
        sides = -(-self._camera.height // CELL), -(-self._camera.width // CELL), SLICES
        axes = []
        for at, side in zip((y / CELL, x / CELL, slices), sides, strict=True):
            at = min(max(at - 0.5, 0.0), side - (2.0 if side == SLICES else 1.0))
            low = math.floor(at)
            axes.append(((low, 1.0 - at + low), (min(low + 1, side - 1), at - low)))
        return [
            ((row, column, part), down * across * along)
            for row, down in axes[0]
            for column, across in axes[1]
            for part, along in axes[2]
        ]

    def _cut(self, index: int, limit: float) -> list[int]:
        """Return the picks below a node, unordered."""
        node = self._nodes[index]
        near = self._camera.near
        largest = float(torch.linalg.eigvalsh(node.covariance)[-1]) ** 0.5
        x, y, z = self._project(node.mean)
        if node.weight <= 0.0 or z + 3.0 * largest < near:
            return []
        loss = math.inf
        wide = 0.0 if self._gaussians.antialiased else self._dilation * z**2 / self._focal2
        dilated_opacity = (node.weight + wide * node.points) / (largest**2 + wide)  # dense, each dilated
        if z - 3.0 * largest > near and max(node.opacity, dilated_opacity) >= ALPHA_MIN:
            if not self._in_window(node.mean, largest):
                return []
            area = node.weight * math.sqrt(max(node.opacity, 1.0))
            loss = node.spread * (1.0 + node.contrast**2) * math.sqrt(area)
            loss *= self._focal2 / z**2
            if self._depths is not None:
                cells = self._cells(x, y, (z - largest) * 2 ** (-1 / 32))
                depth = sum(share * float(self._depths[cell]) for cell, share in cells)
                loss *= math.exp(-0.5 * min(depth, MAX_OPTICAL_DEPTH))
        leaf = 2 * index + 1 >= len(self._nodes)
        if loss <= limit or (leaf and self._depths is None):  # leaves determine the light unmerged
            return [index]
        if leaf:
            means = self._gaussians.means.double()
            scales = self._gaussians.scales.double()
            return [
                ~row
                for row in node.rows.tolist()
                if self._gaussians.opacities[row] >= ALPHA_MIN
                and self._in_window(means[row], float(scales[row].max()))
            ]
        return self._cut(2 * index + 1, limit) + self._cut(2 * index + 2, limit)

    def _in_window(self, mean: Tensor, extent: float) -> bool:
        """Return True if a Gaussian with this largest scale may reach the window."""
        x, y, z = self._project(mean)
        if z <= self._camera.near:
            return False
        for at, focal, center, side in (
            (x, float(self._camera.K[0, 0]), float(self._camera.K[0, 2]), self._camera.width),
            (y, float(self._camera.K[1, 1]), float(self._camera.K[1, 2]), self._camera.height),
        ):
            tangent = (at - center) / focal
            margin = FRUSTUM_MARGIN * 0.5 * side / focal
            tangent = min(max(tangent, -(center / focal + margin)), (side - center) / focal + margin)
            variance = (focal * extent / z) ** 2 * (1.0 + tangent**2) + DILATION
            reach = math.sqrt(-2.002 * math.log(ALPHA_MIN) * variance)
            if not -reach <= at <= side + reach:
                return False
        return True
