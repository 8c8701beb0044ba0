"""Reference measure of the coverage by painted discs, in numpy; see `progdf.compose.paint_sheets`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from progdf.compose.paint_sheets import Sheet

MIN_WEIGHT = 0.05  # opacity of a disc at a point; below it, the disc is beside the point
REACH_DEVIATIONS = 3.0  # extent of a disc, in standard deviations
BLUR_THICKNESSES = 5.5  # standard deviation of a renderer's blur, in thicknesses of a disc
POINTS_AT_ONCE = 1 << 14  # limits the memory

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


def measure_cover(
    sheet: Sheet, points: Floats, outward: Floats, distance: float
) -> tuple[Floats, Floats, Rows]:
    """Return the coverage of points on the same surface by a layer.

    Args:
        sheet: the layer
        points: [P,3]
        outward: direction away from the surface. [P,3]
        distance: largest distance of a point from a disc's plane

    Returns:
        Opacity of the layer's discs at the points, 0 to 1. [P]
        Height of the highest of them above the point, −∞ without any. [P]
        The most opaque of them. [P]
    """
    light = np.zeros(len(points))  # logarithm of the transmittance
    height = np.full(len(points), -np.inf)
    most = np.zeros(len(points))
    under = np.zeros(len(points), np.int64)
    size = sheet.scales.max(axis=1)
    classes = np.floor(np.log2(np.maximum(size, 1e-30))).astype(int)  # so that a point has few neighbors
    for size_class in np.unique(classes):
        members = np.flatnonzero(classes == size_class)
        blur = BLUR_THICKNESSES * float(np.max(sheet.scales[members].min(axis=1)))
        reach = REACH_DEVIATIONS * float(np.hypot(size[members].max(), blur))
        tree = cKDTree(sheet.points[members])
        for begin in range(0, len(points), POINTS_AT_ONCE):
            lists = tree.query_ball_point(points[begin : begin + POINTS_AT_ONCE], np.hypot(reach, distance))
            counts = np.array([len(found) for found in lists])
            if not counts.sum():
                continue
            disc = members[np.concatenate([np.asarray(found, np.int64) for found in lists])]
            owner = begin + np.repeat(np.arange(len(lists)), counts)
            weight, apart = _weights(sheet, disc, points[owner], outward[owner], distance)
            seen = weight > MIN_WEIGHT
            disc = disc[seen]
            owner = owner[seen]
            weight = weight[seen]
            apart = apart[seen]
            np.add.at(light, owner, np.log1p(-np.minimum(weight, 0.999)))
            np.maximum.at(height, owner, apart)
            order = np.argsort(weight, kind="stable")
            best = np.zeros(len(points))
            best_disc = np.zeros(len(points), np.int64)
            best[owner[order]] = weight[order]  # the last one, which is the largest, remains
            best_disc[owner[order]] = disc[order]
            better = best > most
            most[better] = best[better]
            under[better] = best_disc[better]
    return 1.0 - np.exp(light), height, under


def _weights(
    sheet: Sheet, disc: Rows, points: Floats, outward: Floats, distance: float
) -> tuple[Floats, Floats]:
    """Return the opacity of discs at points, and their heights above these. [n] each"""
    apart = sheet.points[disc] - points
    local = np.einsum("nji,nj->ni", sheet.axes[disc], apart)
    variance = sheet.scales[disc] ** 2
    thin = np.argmin(variance, axis=1)[:, None]
    thickness = np.take_along_axis(sheet.scales[disc], thin, axis=1)
    variance += (BLUR_THICKNESSES * thickness) ** 2
    np.put_along_axis(variance, thin, np.inf, axis=1)
    across = np.abs(np.take_along_axis(local, thin, axis=1))[:, 0]
    same = (across <= distance) & ((sheet.outward[disc] * outward).sum(axis=1) > 0)
    weight = sheet.opacity[disc] * np.exp(-0.5 * (local**2 / variance).sum(axis=1)) * same
    return weight, (apart * outward).sum(axis=1)
