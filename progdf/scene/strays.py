"""Strays of a capture: Gaussians that no picture draws, and those that stick out into empty space.

No size or distance is given: an outlier lies beyond Tukey's fence (Q3 + 1.5 IQR) of the scene's own
logarithms, and only ratios of neighbors are compared, so moving or scaling a scene changes nothing.

The search takes about 5 s of processor for a million Gaussians: a neighborhood is measured only where a test
needs it, and kept from round to round (see `_Body`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.metrics.image import decibels
from progdf.quaternions import rotation_matrices
from progdf.rasterize.engines import render
from progdf.terminal import format_count, group_digits
from progdf.threads import map_threads

from .orbit_rig import orbit_rig
from .point_tree import PointTree

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

INVISIBLE = 1 / 255
"""Opacity under which no rasterizer draws a Gaussian: to leave these out changes no pixel."""

_NEIGHBORS = 16
_REACH = 2.0  # standard deviations along an axis: 95 % of a Gaussian lies within
_FAR = 2.0  # times as far from others as these are from their own neighbors
_ENOUGH = 64  # Gaussians; fewer have no distribution
_SAMPLE = 20_000  # Gaussians whose ends tell the usual emptiness
_EXACT = 200_000  # Gaussians; of more, a sample tells the usual loneliness
_LONELY_SAMPLE = 5_000
_WINDOW = 16  # rows before and after, in the order of the tree, that are compared at first
_BLOCK = 20_000  # rows whose windows are compared at once, in the processor's cache
_CHUNK = 200_000  # searches at once, which take 55 MB
_VIEWS = 8
_VIEW_PX = 384
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
    """Find the strays of a scene whose numbers are finite, as `load_scene` makes them.

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
    index = torch.from_numpy(rows)
    sizes = scene.log_scales[index].sort(dim=1).values.double().numpy()
    body = _Body(scene.means[index].numpy(), _REACH * np.exp(sizes[:, 2]))
    remaining = np.ones(len(rows), bool)
    strays_by_kind: dict[str, list[Rows]] = {"giants": [], "needles": [], "floaters": []}
    while np.count_nonzero(remaining) >= _ENOUGH:
        kinds = _find_once(scene, rows, sizes, body, remaining)
        strays = np.concatenate([*kinds.values()])
        if not len(strays):
            break
        for kind, those in kinds.items():
            strays_by_kind[kind].append(rows[those])
        remaining[strays] = False
    empty = np.zeros(0, np.int64)
    return Strays(
        np.flatnonzero(~drawn),
        **{kind: np.sort(np.concatenate([empty, *f])) for kind, f in strays_by_kind.items()},
    )


def clean(scene: Gaussians, strays: Strays) -> Gaussians:
    """Return the scene without its strays, in the same order."""
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


def _find_once(scene: Gaussians, drawn: Rows, sizes: Floats, body: _Body, remaining: Mask) -> dict[str, Rows]:
    """Find the Gaussians that stick out of the rest, see `find_strays`; a suspect holds no other one up.

    Args:
        scene: all Gaussians
        drawn: rows of the N that are drawn; all other rows here count among these. [N]
        sizes: their log scales, ascending. [N,3]
        body: their neighborhoods
        remaining: those that are no strays yet. [N]
    """
    longest = sizes[:, 2]
    thinness = sizes[:, 2] - sizes[:, 1]
    giant = remaining & (longest > _fence(longest[remaining]))
    needle = remaining & (thinness > _fence(thinness[remaining])) & (longest > np.median(longest[remaining]))
    suspects = np.flatnonzero(giant | needle)
    body.set_members(remaining & ~giant & ~needle)
    usual = body.emptiness(_ends(scene, drawn[body.sample(_SAMPLE)]))
    outside = suspects[body.emptiness(_ends(scene, drawn[suspects])) > max(_fence(usual), np.log(_FAR))]
    every = body.members if len(body.members) <= _EXACT else body.sample(_LONELY_SAMPLE)
    least = max(_fence(body.loneliness(every)), np.log(_FAR))
    apart = body.find_isolated()
    floaters = apart[body.loneliness(apart) > least]
    return {"giants": outside[giant[outside]], "needles": outside[~giant[outside]], "floaters": floaters}


def _ends(scene: Gaussians, rows: Rows) -> Floats:
    """Return the four ends of the two longer axes of some rows. [M] -> [M,4,3]"""
    some = scene[torch.from_numpy(rows)]
    order = some.log_scales.argsort(dim=1)[:, 1:]
    lengths = _REACH * some.log_scales.gather(1, order).double().exp()
    axes = rotation_matrices(some.unit_quats.double())
    longer = axes.gather(2, order[:, None].expand(-1, 3, -1)).transpose(1, 2)
    tips = lengths[:, :, None] * longer
    center = some.means.double()[:, None]
    return torch.cat([center + tips, center - tips], dim=1).numpy()


def _fence(values: Floats) -> float:
    """Return Tukey's upper fence."""
    low, high = np.quantile(values, (0.25, 0.75))
    return float(high + 1.5 * (high - low))


class _Body:
    """The neighborhoods of the Gaussians that hold others up.

    The 16 nearest neighbors of a row are searched when they are first needed. Their distance is kept until a
    member joins or leaves within it.

    Args:
        points: means of N Gaussians. [N,3] float32
        extents: two standard deviations along their longest axes. [N]
    """

    def __init__(self, points: NDArray[np.float32], extents: Floats) -> None:
        self._points = points
        self._extents = extents
        self._is_member = np.zeros(len(points), bool)
        self._spacing = np.full(len(points), np.nan)  # distance of the last of the 16 neighbors; NaN: unknown
        self._touches = np.zeros(len(points), bool)  # one of the farther half of them; where that is known
        self.members: Rows = np.zeros(0, np.int64)

    def set_members(self, is_member: Mask) -> None:
        """Change the members, and forget the neighborhoods that this changes. [N]"""
        changed = np.flatnonzero(is_member != self._is_member)
        if not len(changed):
            return
        known = np.flatnonzero(~np.isnan(self._spacing))
        if len(known):
            spacing = self._spacing[known]
            usual = float(np.quantile(spacing, 0.99))  # a bound makes the searches twice as fast
            away = PointTree(self._points[changed], 1).kth_distances(self._points[known], 1, within=usual)
            self._spacing[known[(away <= spacing) | (spacing >= usual)]] = np.nan
        self._is_member = is_member
        self.members = np.flatnonzero(is_member)
        self._neighbors = min(_NEIGHBORS, len(self.members) - 1)
        self._tree = PointTree(self._points[self.members], self._neighbors + 1)

    def sample(self, count: int) -> Rows:
        """Return about so many members, or all of fewer; nearly the same ones after a change of members."""
        rows = np.arange(0, len(self._points), -(-len(self._points) // count))
        return rows[self._is_member[rows]]

    def emptiness(self, ends: Floats) -> Floats:
        """Return the log of how far the ends lie outside the neighborhood of the member nearest to them.

        Args:
            ends: [M,4,3]

        Returns:
            The most of the four. [M]
        """
        distances, nearest = self._tree.query(ends.reshape(-1, 3), 1)
        near = self.members[nearest[:, 0]]
        reach = np.maximum(self._spacing_of(near), self._extents[near])
        empty: Floats = np.log(np.maximum(distances[:, 0], 1e-30)) - np.log(reach)
        largest: Floats = empty.reshape(len(ends), 4).max(axis=1)
        return largest

    def loneliness(self, rows: Rows) -> Floats:
        """Return the log of how much farther the neighbors of some members are than theirs. [M] -> [M]"""
        lonely = [np.zeros(0)]
        for start in range(0, len(rows), _CHUNK):
            some = rows[start : start + _CHUNK]
            near = self._search(some)[1]
            around = np.median(self._spacing_of(near.ravel()).reshape(near.shape), axis=1)
            lonely.append(np.log(self._spacing_of(some)) - np.log(around))
        return np.concatenate(lonely)

    def find_isolated(self) -> Rows:
        """Return the members that touch none of the farther half of their neighbors. [M]"""
        rows = self.members[~self._is_enclosed()]
        self._spacing_of(rows)
        return rows[~self._touches[rows]]

    def _is_enclosed(self) -> Mask:
        """Return the members that reach half of their neighbors, of rows near them in the tree. [M]

        This misses some: it finds 3 of 4 in a twentieth of the time that all searches take.
        """
        order = self._tree.order
        enclosed = np.zeros(len(order), bool)

        def compare(start: int) -> None:
            first = max(start - _WINDOW, 0)
            block = order[first : start + _BLOCK + _WINDOW]
            rows = self.members[block]
            columns = np.ascontiguousarray(self._points[rows].T)
            squares = (self._extents[rows] ** 2 * (1.0 - 1e-5)).astype(np.float32)  # less than rounding
            count = np.zeros(len(rows), np.int8)
            for step in range(1, min(_WINDOW, len(rows) - 1) + 1):
                x, y, z = columns[:, step:] - columns[:, :-step]
                away = x * x + y * y + z * z
                count[step:] += away <= squares[step:]
                count[:-step] += away <= squares[:-step]
            inner = slice(start - first, start - first + _BLOCK)
            enclosed[block[inner]] = count[inner] > self._neighbors // 2

        map_threads(compare, range(0, len(order), _BLOCK))
        return enclosed

    def _spacing_of(self, rows: Rows) -> Floats:
        """Return the distance to the last neighbor of some members, at least 1e-30. [M] -> [M]"""
        needed = np.zeros(len(self._points), bool)
        needed[rows] = np.isnan(self._spacing[rows])
        unknown = np.flatnonzero(needed)
        for start in range(0, len(unknown), _CHUNK):
            some = unknown[start : start + _CHUNK]
            distances, near = self._search(some)
            half = self._neighbors // 2
            reach = self._extents[some, None] + self._extents[near[:, half:]]
            self._spacing[some] = distances[:, -1]
            self._touches[some] = (distances[:, half:] <= reach).any(axis=1)
        spacing: Floats = np.maximum(self._spacing[rows], 1e-30)
        return spacing

    def _search(self, rows: Rows) -> tuple[Floats, Rows]:
        """Return the distances and rows of the neighbors of some members. [M] -> [M,16] each"""
        distances, near = self._tree.query(self._points[rows], self._neighbors + 1)
        return distances[:, 1:], self.members[near[:, 1:]]
