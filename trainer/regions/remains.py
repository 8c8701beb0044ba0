"""Remains of a removed region: its Gaussians that the selection missed.

Slivers at a selection's cut, crumbs and halos are invisible next to the object and stay behind without it.

1. Candidates are the remaining Gaussians whose visible weight without the region lies inside the region's
   former pixels, in nearly every view. A neighbor and the surface below also show outside of these.
2. Every candidate joins the removed region or the rest: the one that a chain of touching neighbors of similar
   color reaches at the smaller largest step (a minimum spanning forest with the two as roots). A step is a
   difference in color plus the gap between two Gaussians in units of their extents. The ground under an
   object thus stays with the ground around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.rasterize import alpha_weights
from progdf.rasterize.engines import render_depth
from progdf.region import Region
from progdf.scene.point_tree import PointTree
from progdf.sh import sh0_to_rgb
from progdf.system.equality import equal_fields
from progdf.threads import map_threads, stream_threads
from trainer.views.view import View, render_view

_REGION_WEIGHT = (
    0.3  # weight of the region from which a pixel belongs to it; less may shine through what is in front
)
_MARGIN_PX = 2  # width of the border around the region's pixels that its halo covers
_MIN_INSIDE = 0.9  # smallest share of a candidate's visible weight inside these pixels
_NEIGHBORS = 12  # nearest Gaussians that a chain can step to
_EXTENT_SIGMAS = 2.0  # standard deviations that a Gaussian reaches in a direction
_OPAQUE = 0.5  # alpha of a visible surface, and weight of the region that shows its surface
_HIDDEN_SHARE = 0.2  # visible weight before the removal, as a share of that after it, of a hidden Gaussian
_COLOR_TOLERANCE = 0.1  # color difference of equal surfaces
_REACH_PX = 4.0  # a surface this far behind the region's is still at its place


@dataclass(frozen=True)
class Remains:
    """Remains of a removed region."""

    __eq__ = equal_fields

    seen: Tensor  # rows of the scene, visible next to the region before the removal. [R] int64, ascending
    hidden: Tensor  # rows that only the removal makes visible. [H] int64, ascending


def find_remains(scene: Gaussians, region: Region, views: Sequence[View]) -> Remains:
    """Find the Gaussians outside a region that belong to its object.

    Args:
        scene: the original
        region: the removed region
        views: views of the original with the region's mask
    """
    remaining = (~region.mask).nonzero()[:, 0]
    rest = scene[remaining]
    inside = torch.zeros(len(rest), dtype=torch.float64)
    after = torch.zeros(len(rest), dtype=torch.float64)
    before = torch.zeros(len(rest), dtype=torch.float64)

    def weigh(view: View) -> tuple[Tensor, Tensor]:
        mask = grown_mask(view)
        return alpha_weights(rest, view.camera, mask), alpha_weights(scene, view.camera, mask)[remaining, 2]

    for weights, original in stream_threads(weigh, views):
        inside += weights[:, 0]
        after += weights[:, 2]
        before += original
    is_candidate = (after > 0) & (inside >= _MIN_INSIDE * after)
    candidates = remaining[is_candidate]
    anchors = remaining[(after > 0) & ~is_candidate]
    joins = _join(scene, candidates, region.members, anchors)
    is_hidden = (before < _HIDDEN_SHARE * after)[is_candidate]
    return Remains(candidates[joins & ~is_hidden], candidates[joins & is_hidden])


def grown_mask(view: View) -> Tensor:
    """Return the pixels of the region with a border. [H,W] bool"""
    shown = (view.mask > _REGION_WEIGHT).numpy()
    return torch.from_numpy(ndimage.binary_dilation(shown, np.ones((3, 3)), iterations=_MARGIN_PX))


def remaining_share(scene: Gaussians, removed: Gaussians, views: Sequence[View]) -> float:
    """Return the share of the region's visible pixels that still show its surface, 0 to 1.

    Such a pixel shows an opaque surface at the same depth, in the same color.

    Args:
        scene: the original
        removed: the scene after the removal
        views: views of the original with the region's mask
    """
    background = torch.ones(3)

    def count(view: View) -> tuple[int, int]:
        shown = view.mask > _OPAQUE
        before = render_depth(scene, view.camera).depth
        after = render_depth(removed, view.camera)
        reach = 1.0 + _REACH_PX / float(view.camera.K[0, 0])
        stands = (after.alpha > _OPAQUE) & (after.depth <= reach * before)
        image = render_view(removed, view.camera, background).clamp(0.0, 1.0)
        is_same = (image - view.image).abs().amax(dim=2) < _COLOR_TOLERANCE
        return int(shown.sum()), int((shown & stands & is_same).sum())

    counts = map_threads(count, views)
    return sum(left for _, left in counts) / max(1, sum(pixels for pixels, _ in counts))


def _join(scene: Gaussians, candidates: Tensor, members: Tensor, anchors: Tensor) -> Tensor:
    """Return the candidates that join the members and not the anchors. [C] bool"""
    count = len(candidates)
    rows = torch.cat([candidates, anchors, members])
    points = scene.means[rows].numpy()
    places = points[:count]
    starts = list[Tensor]()
    ends = list[Tensor]()
    # the two sides are searched apart, so that neither side's density hides the other
    for start, stop in ((0, count + len(anchors)), (count + len(anchors), len(rows))):
        _, near = PointTree(points[start:stop], _NEIGHBORS + 1).query(places, _NEIGHBORS + 1)
        found = torch.from_numpy(near) + start
        exists = (found < stop) & (found != torch.arange(count)[:, None])
        starts.append(exists.nonzero()[:, 0])
        ends.append(found[exists])
    first = torch.cat(starts)
    second = torch.cat(ends)
    cost = _steps(scene, rows[first], rows[second])
    order = cost.argsort(stable=True)
    # roots: 0 is the region, 1 the rest; members and anchors are contracted into them
    node = torch.cat(
        [torch.arange(count) + 2, torch.ones(len(anchors)).long(), torch.zeros(len(members)).long()]
    )
    return torch.from_numpy(
        _forest(node[first[order]].numpy(), node[second[order]].numpy(), count + 2)[2:] == 0
    )


def _forest(first: np.ndarray, second: np.ndarray, nodes: int) -> np.ndarray:
    """Return the root, 0 or 1, that each node joins in a spanning forest; −1 without a connection. [nodes]

    Args:
        first, second: ends of the edges, cheapest first. [E] each
        nodes: number of nodes; the first two are the roots
    """
    parent = list(range(nodes))

    def find(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for a, b in zip(first.tolist(), second.tolist(), strict=True):
        root_a = find(a)
        root_b = find(b)
        low = min(root_a, root_b)
        high = max(root_a, root_b)
        if low != high and high > 1:  # the two roots are never joined
            parent[high] = low
    roots = np.array([find(node) for node in range(nodes)])
    return np.where(roots < 2, roots, -1)


def _steps(scene: Gaussians, first: Tensor, second: Tensor) -> Tensor:
    """Return the cost of steps between Gaussians: their color difference plus the gap. [E] rows -> [E]"""
    colors = sh0_to_rgb(scene.sh0).clamp(0.0, 1.0)
    color_steps = (colors[first] - colors[second]).norm(dim=1)
    between = scene.means[second] - scene.means[first]
    distance = between.norm(dim=1).clamp_min(1e-12)
    direction = between / distance[:, None]
    reach = _EXTENT_SIGMAS * (_extent(scene, first, direction) + _extent(scene, second, direction))
    gaps = (distance / reach - 1.0).clamp_min(0.0)
    steps: Tensor = color_steps + gaps
    return steps


def _extent(scene: Gaussians, rows: Tensor, direction: Tensor) -> Tensor:
    """Return the standard deviation of Gaussians along a direction. [E] rows, [E,3] -> [E]"""
    axes = rotation_matrices(scene.unit_quats[rows])
    along = torch.einsum("eij,ei->ej", axes, direction)
    extent: Tensor = (along * scene.scales[rows]).norm(dim=1)
    return extent
