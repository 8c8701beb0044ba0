"""Strays of a capture: what no picture draws, and what sticks out into space where the scene is not.

No size or distance is given: an outlier is what lies beyond Tukey's fence (Q3 + 1.5 IQR) of the scene's own
logarithms, and only ratios of neighbors are compared, so moving or scaling a scene changes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.metrics.image import decibels
from progdf.quaternions import rotation_matrices
from progdf.rasterize.engines import render
from progdf.terminal import format_count, group_digits
from progdf.threads import threads

from .orbit_rig import orbit_rig

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]

INVISIBLE = 1 / 255
"""Opacity under which no rasterizer draws a Gaussian: to leave these out changes no pixel."""

_NEIGHBORS = 16
_REACH = 2.0  # standard deviations along an axis: 95 % of a Gaussian lies within
_FAR = 2.0  # times as far from others as these are from their own neighbors
_ENOUGH = 64  # Gaussians; fewer have no distribution
_SAMPLE = 20_000  # whose ends say what is usual
_VIEWS, _VIEW_PX = 8, 384
_GRAY = (0.5, 0.5, 0.5)  # a background on which neither black nor white fog is lost


@dataclass(frozen=True)
class Strays:
    """Rows of a scene by what is wrong with them; no row is in two. [M] int64 each, ascending"""

    faint: Rows  # too transparent to be drawn, see `INVISIBLE`
    giants: Rows  # unusually long, and the ends stick out into empty space
    needles: Rows  # unusually thin for their length, likewise
    floaters: Rows  # alone or a few together, far from all others

    @property
    def rows(self) -> Rows:
        """All of them, ascending. [M] int64"""
        return np.sort(np.concatenate([self.faint, self.giants, self.needles, self.floaters]))

    def describe(self) -> str:
        """Each kind there is with its count, for a person."""
        kinds = ((self.giants, "giant"), (self.needles, "needle"), (self.floaters, "floater"))
        parts = [format_count(len(rows), kind) for rows, kind in kinds if len(rows)]
        if len(self.faint):
            parts.append(f"{group_digits(len(self.faint))} too transparent to be drawn")
        return ", ".join(parts) or "none"


def find_strays(scene: Gaussians) -> Strays:
    """The strays of a scene whose numbers are finite, as `load_scene` makes them.

    A giant or needle is two things: an outlier in the length of its longest axis, or in how much longer that
    is than the middle one; and at an end of an axis (two standard deviations out) more than twice as far from
    the nearest other Gaussian as that one or its 16 neighbors reach, and farther than is usual. A floater is
    alone, or one of at most eight: its 16th neighbor is more than twice as far as its neighbors' are from
    them, farther than is usual, and does not touch it. Sought until there are none: what stays has none.

    Args:
        scene: N Gaussians; of fewer than 64 that are drawn, only faint ones are found
    """
    drawn = (scene.opacities >= INVISIBLE).numpy()
    rows = np.flatnonzero(drawn)
    strays_by_kind: dict[str, list[Rows]] = {"giants": [], "needles": [], "floaters": []}
    points, sizes, tips = _measure(scene[torch.from_numpy(rows)])
    remaining = np.arange(len(rows))
    while len(remaining) >= _ENOUGH:
        kinds = _find_once(points[remaining], sizes[remaining], tips[remaining])
        strays = np.concatenate([*kinds.values()])
        if not len(strays):
            break
        for kind, those in kinds.items():
            strays_by_kind[kind].append(rows[remaining[those]])
        remaining = np.delete(remaining, strays)
    empty = np.zeros(0, np.int64)
    return Strays(
        np.flatnonzero(~drawn),
        **{kind: np.sort(np.concatenate([empty, *f])) for kind, f in strays_by_kind.items()},
    )


def clean(scene: Gaussians, strays: Strays) -> Gaussians:
    """The scene without its strays, in the same order."""
    return scene[torch.from_numpy(np.delete(np.arange(len(scene)), strays.rows))]


def picture_difference(before: Gaussians, after: Gaussians) -> tuple[float, float]:
    """PSNR of `after` to `before` over views from all around, and of the view that differs most, dB.

    `NO_DIFFERENCE` where no pixel differs.

    Args:
        before: frames the views, by its bulk
        after: the same scene without some Gaussians
    """
    cameras = orbit_rig(before, _VIEWS, _VIEW_PX, _VIEW_PX)
    errors = [_squared_error(before, after, camera) for camera in cameras]
    return decibels(sum(errors) / len(errors)), decibels(max(errors))


def _squared_error(a: Gaussians, b: Gaussians, camera: Camera) -> float:
    with torch.no_grad():
        images = [render(scene, camera, _GRAY).image.clamp(0.0, 1.0).double() for scene in (a, b)]
    return float((images[0] - images[1]).square().mean())


def _measure(scene: Gaussians) -> tuple[Floats, Floats, Floats]:
    """Means [N,3]; log scales, ascending [N,3]; from the mean to the ends of the two longer axes [N,2,3]"""
    order = scene.log_scales.argsort(dim=1)
    sizes = scene.log_scales.gather(1, order).double()
    axes = rotation_matrices(scene.unit_quats.double())
    longer = axes.gather(2, order[:, None, 1:].expand(-1, 3, -1)).transpose(1, 2)
    tips = _REACH * sizes[:, 1:, None].exp() * longer
    return scene.means.double().numpy(), sizes.numpy(), tips.numpy()


def _find_once(points: Floats, sizes: Floats, tips: Floats) -> dict[str, Rows]:
    """What sticks out of the rest, see `find_strays`; a Gaussian in question holds no other up."""
    longest, thin = sizes[:, 2], sizes[:, 2] - sizes[:, 1]
    giant = longest > _fence(longest)
    suspect = giant | ((thin > _fence(thin)) & (longest > np.median(longest)))
    body, suspects = np.flatnonzero(~suspect), np.flatnonzero(suspect)
    k = min(_NEIGHBORS, len(body) - 1)
    tree = cKDTree(points[body], balanced_tree=False, compact_nodes=False)
    distances, near = tree.query(points[body], k + 1, workers=threads())
    distances, near = np.maximum(distances[:, 1:], 1e-30), near[:, 1:]
    spacing = distances[:, -1]
    extent = _REACH * np.exp(longest[body])
    log_reach = np.log(np.maximum(spacing, extent))  # how far from each its neighborhood goes

    def emptiness(rows: Rows) -> Floats:
        """How far the ends lie outside the neighborhood of what is nearest to them, log. [M] -> [M]"""
        ends = points[rows, None, None] + tips[rows, :, None] * np.array([1.0, -1.0])[:, None]
        away, nearest = tree.query(ends, workers=threads())
        empty: Floats = (
            (np.log(np.maximum(away, 1e-30)) - log_reach[nearest]).reshape(len(rows), 4).max(axis=1)
        )
        return empty

    usual = emptiness(body[:: -(-len(body) // _SAMPLE)])
    outside = suspects[emptiness(suspects) > max(_fence(usual), np.log(_FAR))]
    lonely = np.log(spacing) - np.log(np.median(spacing[near], axis=1))
    touches = distances <= extent[:, None] + extent[near]
    floats = (lonely > max(_fence(lonely), np.log(_FAR))) & ~touches[:, k // 2 :].any(axis=1)
    return {"giants": outside[giant[outside]], "needles": outside[~giant[outside]], "floaters": body[floats]}


def _fence(values: Floats) -> float:
    """Tukey's upper fence."""
    low, high = np.quantile(values, (0.25, 0.75))
    return float(high + 1.5 * (high - low))
