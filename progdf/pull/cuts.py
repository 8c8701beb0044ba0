"""Cuts between things that touch: Gaussians on both sides are not linked in the deformation graph.

A cut separates a region from the rest, or the two sides of a line drawn over a view. The line is swept along
its view rays, so that it also separates what lies behind the visible surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CutLine:
    """Line over a view, swept along its rays away from the eye."""

    eye: Floats  # position of the camera. [3]
    points: Floats  # any points on the rays of the line's corners. [P,3]


@dataclass(frozen=True, eq=False)
class Cuts:
    """Cuts of M Gaussians or nodes."""

    regions: tuple[Mask, ...] = ()  # each is separated from the rest. [M] each
    lines: tuple[CutLine, ...] = ()

    def __len__(self) -> int:
        return len(self.regions) + len(self.lines)

    def of_rows(self, rows: Rows) -> Cuts:
        """Return the cuts of some of the Gaussians. [K]"""
        return Cuts(tuple(region[rows] for region in self.regions), self.lines)

    def of_groups(self, group: Rows, count: int) -> Cuts:
        """Return the cuts of groups, which lie in a region if most of their Gaussians do.

        Args:
            group: group of each Gaussian. [M]
            count: number of groups, none of them empty
        """
        sizes = np.bincount(group, minlength=count)
        regions = [2 * np.bincount(group, region, minlength=count) >= sizes for region in self.regions]
        return Cuts(tuple(regions), self.lines)

    def sides(self, count: int) -> Rows:
        """Return a number of each Gaussian that is the same for those in the same regions. [M]

        Args:
            count: M
        """
        if not self.regions:
            return np.zeros(count, np.int64)
        sides: Rows = np.unique(np.stack(self.regions), axis=1, return_inverse=True)[1].reshape(-1)
        return sides


NO_CUTS = Cuts()
"""Cuts that separate nothing."""


def find_cut_links(cuts: Cuts, points: Floats, start: Rows, end: Rows) -> Mask:
    """Return True for each link between Gaussians that a cut separates. [L]

    Args:
        cuts: the cuts
        points: means of the Gaussians. [M,3]
        start: Gaussian at one end of each link. [L]
        end: Gaussian at the other end. [L]
    """
    is_cut = np.zeros(len(start), bool)
    for region in cuts.regions:
        is_cut |= region[start] != region[end]
    for line in cuts.lines:
        is_cut |= _crosses_line(line, points, start, end)
    return is_cut


def _crosses_line(line: CutLine, points: Floats, start: Rows, end: Rows) -> Mask:
    """Return True for each link that crosses the surface of a swept line. [L]"""
    crosses = np.zeros(len(start), bool)
    corners = line.points - line.eye
    corners = corners / np.linalg.norm(corners, axis=1, keepdims=True).clip(1e-30)
    rays = points - line.eye
    for left, right in pairwise(corners):
        normal = np.cross(left, right)
        height = rays @ normal  # of each Gaussian over the plane through the eye and this part of the line
        is_above = height >= 0.0
        links = np.flatnonzero(is_above[start] != is_above[end])
        first = start[links]
        last = end[links]
        share = height[first] / (height[first] - height[last])
        at = rays[first] + share[:, None] * (rays[last] - rays[first])
        is_between = (np.cross(left, at) @ normal >= 0.0) & (np.cross(at, right) @ normal >= 0.0)
        is_ahead = at @ (left + right) > 0.0
        crosses[links] |= is_between & is_ahead
    return crosses
