"""Deformation graph: nodes over the Gaussians of a region, with edges where the Gaussians belong together.

A node is a group of linked Gaussians inside one cell of a grid. Two Gaussians are linked if they are near for
their extent in the direction of each other. The limit is measured on the scene. Pairs with different color
and normal must be nearer. So two things that touch inside one cell become two nodes.

Nodes are connected if their Gaussians are linked. Near nodes of one part are also connected through its
inside, which makes it resist bending. They are not if the way between them along the part is a long detour.

Cuts remove links and connections between things that no limit tells apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra

from progdf.color.oklab import srgb_to_oklab
from progdf.gaussians import Gaussians
from progdf.scene.neighbors import join_pairs, nearest_rows
from progdf.scene.point_tree import PointTree
from progdf.sh import sh0_to_rgb
from progdf.system.equality import equal_fields
from progdf.threads import run_chunks

from . import graph_kernel
from .cuts import NO_CUTS, Cuts, find_cut_links

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

MAX_NODES = 1000
"""Default largest number of nodes; more make no visible difference on objects of 30 000 Gaussians."""
_MEMBERS_PER_NODE = 8  # Gaussians; fewer do not determine a node
_LINKED_NEIGHBORS = 8  # nearest neighbors that a Gaussian may be linked with
_GAP_FACTOR = 3.0  # median gaps between neighbors; wider gaps are not linked
_UNLIKE_GAP_FACTOR = 1.0  # the same for neighbors with different color and normal
_UNLIKE_COLOR_FACTOR = 3.0  # median color distances between neighbors; more is a different color
_UNLIKE_COSINE = 0.5  # cosine of the angle between normals; less is a different normal
_FRAGMENT_SHARE = 0.125  # share of the mean node's Gaussians; smaller nodes join others
_NEAR_NODES = 8  # nearest nodes that may be connected through the inside of a part
_MAX_EDGE = 2.5  # median lengths; longer edges through the inside are left out
_MAX_DETOUR = 4.0  # length of the way along the part per distance; the way around a cylinder is π/2
_MAX_ALIKE_DETOUR = 12.0  # the same for nodes of like color, such as both sides of an ear
_CELL_SEARCH_STEPS = 24
_PAIR_CHUNK = 1 << 14  # Gaussians whose pairs a thread measures at once


@dataclass(frozen=True)
class NodeGraph:
    """Deformation graph with n nodes and E directed edges, both directions of each."""

    __eq__ = equal_fields

    positions: Floats  # means of the nodes' Gaussians, weighted by opacity. [n,3]
    node_of: Rows  # node of each Gaussian. [M]
    starts: Rows  # start of each edge, ascending. [E]
    ends: Rows  # end of each edge. [E]
    part: Rows  # connected part of each node. [n]
    spacing: float  # median length of the edges, or the size of the Gaussians without edges; > 0
    cut_count: int = 0  # number of links between Gaussians that cuts removed

    def __len__(self) -> int:
        return len(self.positions)

    @property
    def arms(self) -> Floats:
        """Vector from the start of each edge to its end. [E,3]"""
        arms: Floats = self.positions[self.ends] - self.positions[self.starts]
        return arms


def build_graph(members: Gaussians, max_nodes: int = MAX_NODES, cuts: Cuts = NO_CUTS) -> NodeGraph:
    """Return the deformation graph of some Gaussians.

    Args:
        members: the Gaussians, at least one. [M]
        max_nodes: target number of nodes, at least 1; fewer for few Gaussians
        cuts: cuts between them
    """
    points = np.ascontiguousarray(members.means.detach().double().numpy())
    colors = srgb_to_oklab(sh0_to_rgb(members.sh0.detach().double()).clamp(0.0, 1.0)).numpy()
    start, end = find_links(members, points, colors)
    is_cut = find_cut_links(cuts, points, start, end)
    cut_count = int(is_cut.sum())
    if cut_count:
        start = start[~is_cut]
        end = end[~is_cut]
    target = max(1, min(max_nodes, len(points) // _MEMBERS_PER_NODE))
    group = graph_kernel.join_links(start, end, grid_cells(points, target))
    node_of = _join_fragments(points, group, start, end, cuts.sides(len(points)))
    weights = members.opacities.detach().double().numpy().clip(1e-6)
    positions = _node_means(node_of, weights, points)
    node_colors = _node_means(node_of, weights, colors)
    linked = _pairs(node_of[start], node_of[end], len(positions))
    part = join_pairs(linked[:, 0], linked[:, 1], len(positions))
    near = _inner_pairs(positions, node_colors, linked, part)
    if cut_count:
        node_cuts = cuts.of_groups(node_of, len(positions))
        near = near[~find_cut_links(node_cuts, positions, near[:, 0], near[:, 1])]
    pairs = np.unique(np.concatenate([linked, near]), axis=0)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.lexsort((both[:, 1], both[:, 0]))]
    lengths = np.linalg.norm(positions[both[:, 1]] - positions[both[:, 0]], axis=1)
    size = float(members.scales.detach().amax(dim=1).double().median())
    spacing = float(np.median(lengths)) if len(lengths) else size
    return NodeGraph(positions, node_of, both[:, 0], both[:, 1], part, max(spacing, 1e-9), cut_count)


def find_links(members: Gaussians, points: Floats, colors: Floats) -> tuple[Rows, Rows]:
    """Return both ends of the pairs of linked Gaussians. [L], [L]

    Args:
        members: the Gaussians. [M]
        points: their means. [M,3]
        colors: their colors, OKLab. [M,3]
    """
    count = len(points)
    nothing = np.zeros(0, np.int64)
    if count < 2:
        return nothing, nothing
    found = nearest_rows(
        torch.from_numpy(points), torch.arange(count), min(_LINKED_NEIGHBORS, count - 1), workers=-1
    )
    near = np.ascontiguousarray(found[0].numpy())
    distance = np.ascontiguousarray(found[1].numpy())
    quats = np.ascontiguousarray(members.unit_quats.detach().double().numpy())
    scales = np.ascontiguousarray(members.scales.detach().double().numpy())
    shapes = (points, quats, scales, np.ascontiguousarray(colors))
    gaps = np.empty(near.shape)
    color_distance = np.empty(near.shape)
    unlike = np.empty(near.shape, bool)

    def measure(chunk: int) -> None:
        first = chunk * _PAIR_CHUNK
        limits = (_UNLIKE_COSINE, first, min(first + _PAIR_CHUNK, count))
        graph_kernel.measure_pairs(shapes, near, distance, limits, gaps, color_distance, unlike)

    run_chunks(measure, -(-count // _PAIR_CHUNK))
    unlike &= color_distance > _UNLIKE_COLOR_FACTOR * np.median(color_distance)
    limit = np.median(gaps) * np.where(unlike, _UNLIKE_GAP_FACTOR, _GAP_FACTOR)
    start, neighbor = np.nonzero(gaps <= limit)
    return np.ascontiguousarray(start), near[start, neighbor]


def grid_cells(points: Floats, target: int) -> Rows:
    """Return the index of the grid cell of each point; about `target` cells are occupied. [M]"""
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max())
    if target == 1 or extent <= 0.0:
        return np.zeros(len(points), np.int64)
    small = extent / 2.0**20
    large = 2.0 * extent
    for _ in range(_CELL_SEARCH_STEPS):
        size = float(np.sqrt(small * large))
        if graph_kernel.exceeds_cells(points, low, size, target):
            small = size
        else:
            large = size
    cells: Rows = np.unique(_cell_ids(points - low, large), return_inverse=True)[1].astype(np.int64)
    return cells


def _cell_ids(points: Floats, size: float) -> Rows:
    index = (points / size).astype(np.int64)
    ids: Rows = (index[:, 0] * (1 << 21) + index[:, 1]) * (1 << 21) + index[:, 2]
    return ids


def _join_fragments(points: Floats, group: Rows, start: Rows, end: Rows, sides: Rows) -> Rows:
    """Return the node of each Gaussian, after small groups have joined others. [M]

    A small group joins the group with most links to it. Groups without links join the nearest large one, on
    the same side of cuts if there is one.
    """
    counts = np.bincount(group)
    expected = float((counts.astype(float) ** 2).sum() / len(points))  # group size that a Gaussian sees
    small = counts < _FRAGMENT_SHARE * expected
    target = np.arange(len(counts))
    crossing = small[group[start]] & ~small[group[end]]
    keys = group[start[crossing]] * len(counts) + group[end[crossing]]
    pairs, links = np.unique(keys, return_counts=True)
    ascending = pairs[np.argsort(links, kind="stable")]
    target[ascending // len(counts)] = ascending % len(counts)
    joined = target[group]
    left = small[joined]
    if left.any() and not left.all():
        for side in np.unique(sides[left]):
            alone = left & (sides == side)
            others = ~left & (sides == side)
            if not others.any():
                others = ~left
            joined[alone] = joined[others][_nearest(points[others], points[alone])]
    nodes: Rows = np.unique(joined, return_inverse=True)[1].astype(np.int64)
    return nodes


def _nearest(points: Floats, places: Floats) -> Rows:
    rows = PointTree(points, 1).query(places, 1)[1]
    return rows[:, 0]


def _node_means(node_of: Rows, weights: Floats, values: Floats) -> Floats:
    """Return the weighted mean of the Gaussians of each node. [M], [M], [M,c] -> [n,c]"""
    columns = [np.bincount(node_of, weights * column) for column in values.T]
    means: Floats = np.stack(columns, axis=1) / np.bincount(node_of, weights)[:, None]
    return means


def _pairs(start: Rows, end: Rows, count: int) -> Rows:
    """Return each unordered pair of different nodes once, of `count` nodes. [P,2]"""
    apart = start != end
    low = np.minimum(start[apart], end[apart])
    high = np.maximum(start[apart], end[apart])
    keys = np.unique(low * count + high)
    return np.stack([keys // count, keys % count], axis=1)


def _inner_pairs(positions: Floats, colors: Floats, linked: Rows, part: Rows) -> Rows:
    """Return pairs of near nodes of one part, except those far apart along the part. [P,2]"""
    count = len(positions)
    if count < 3 or not len(linked):
        return np.zeros((0, 2), np.int64)
    near, distance = nearest_rows(
        torch.from_numpy(positions), torch.arange(count), min(_NEAR_NODES, count - 1)
    )
    start = np.repeat(np.arange(count), near.shape[1])
    end = near.numpy().ravel()
    length = distance.numpy().ravel()
    linked_lengths = np.linalg.norm(positions[linked[:, 0]] - positions[linked[:, 1]], axis=1)
    spacing = float(np.median(linked_lengths))
    ways = _ways(linked, linked_lengths, count, _MAX_ALIKE_DETOUR * _MAX_EDGE * spacing)
    color_distance = np.linalg.norm(colors[start] - colors[end], axis=1)
    alike = color_distance <= _UNLIKE_COLOR_FACTOR * np.median(color_distance)
    detour = np.where(alike, _MAX_ALIKE_DETOUR, _MAX_DETOUR) * np.maximum(length, spacing)
    kept = (part[start] == part[end]) & (length <= _MAX_EDGE * spacing) & (ways[start, end] <= detour)
    return _pairs(start[kept], end[kept], count)


def _ways(linked: Rows, lengths: Floats, count: int, limit: float) -> Floats:
    """Return the lengths of the shortest ways along the links, infinite beyond a limit. [n,n]"""
    links = csr_array(
        coo_array((np.maximum(lengths, 1e-12), (linked[:, 0], linked[:, 1])), shape=(count, count))
    )
    ways: Floats = dijkstra(links, directed=False, limit=limit)
    return ways
