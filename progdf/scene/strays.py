"""Strays of a capture: Gaussians too faint to be drawn, and Gaussians that stick out into empty space.

The search has no absolute size or distance. An outlier lies beyond Tukey's fence (Q3 + 1.5 IQR) of the
logarithms of the scene, and distances are compared only with those of neighbors. So the result does not
change if the scene is moved or scaled.

Neighborhoods are measured only where a test needs them, and are cached between rounds. After the first round,
only those near strays that were found are measured again (see `_Neighborhoods`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.metrics.image import decibels
from progdf.quaternions import rotation_matrices
from progdf.rasterize.engines import render
from progdf.region import Region, from_mask
from progdf.system.equality import equal_fields
from progdf.terminal import format_count, group_digits
from progdf.threads import map_threads

from .orbit_rig import orbit_rig
from .point_tree import PointTree

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]

INVISIBLE = 1 / 255
"""Opacity below which no rasterizer draws a Gaussian. Removing such Gaussians changes no pixel."""

_NEIGHBORS = 16  # nearest neighbors that make a neighborhood
_EXTENT_SIGMAS = 2.0  # standard deviations along an axis, which hold 95 % of a Gaussian
_ISOLATION_RATIO = 2.0  # smallest ratio of a stray's distance to the spacing of its neighbors
_MIN_GAUSSIANS = 64  # Gaussians; fewer have no meaningful quartiles
_EMPTINESS_SAMPLE = 20_000  # Gaussians whose ends define the usual emptiness
_MAX_EXACT_GAUSSIANS = 200_000  # Gaussians; larger scenes define the usual loneliness by a sample
_LONELINESS_SAMPLE = 5_000  # Gaussians in that sample
_WIDE_SEARCH = 48  # neighbors searched where some of the nearest have left
_WINDOW = 16  # rows before and after in memory that are compared first
_TEST_ROWS = 64  # neighboring rows that are tested together for a change near them
_BLOCK = 20_000  # rows compared at once, which fit the processor's cache
_CHUNK = 200_000  # searches at once, which take 55 MB
_VIEWS = 8  # views of `picture_difference`
_VIEW_PX = 384  # width and height of these views, pixels
_BACKGROUND = (0.5, 0.5, 0.5)  # background that shows both black and white fog


@dataclass(frozen=True)
class Strays:
    """Rows of the strays of a scene by kind, disjoint. [M] int64 each, ascending"""

    __eq__ = equal_fields

    faint: Rows  # too transparent to be drawn, see `INVISIBLE`
    giants: Rows  # unusually long, with ends in empty space
    needles: Rows  # unusually thin for their length, with ends in empty space
    floaters: Rows  # isolated Gaussians and small groups, far from all others

    @property
    def rows(self) -> Rows:
        """Rows of all strays, ascending. [M] int64"""
        return np.sort(np.concatenate([self.faint, self.giants, self.needles, self.floaters]))

    def describe(self) -> str:
        """Return the kinds that occur and their counts as text."""
        kinds = ((self.giants, "giant"), (self.needles, "needle"), (self.floaters, "floater"))
        parts = [format_count(len(rows), kind) for rows, kind in kinds if len(rows)]
        if len(self.faint):
            parts.append(f"{group_digits(len(self.faint))} too transparent to be drawn")
        return ", ".join(parts) or "none"


def find_strays(scene: Gaussians) -> Strays:
    """Find the strays of a scene.

    A giant is an outlier in the length of its longest axis. A needle is an outlier in the ratio of the
    longest axis to the middle one. For both, an end of an axis (two standard deviations out) must lie in
    empty space. Its distance to the nearest other Gaussian must be more than twice the reach of that Gaussian
    and of its 16 neighbors, and unusually large for the scene.

    A floater is isolated or in a group of at most eight. Its 16th neighbor is more than twice as far away as
    its neighbors' own 16th neighbors, unusually far for the scene, and does not touch it.

    The search repeats until it finds no more strays.

    Args:
        scene: N Gaussians with finite numbers, as from `load_scene`. With fewer than 64 drawn Gaussians, only
            faint ones are found
    """
    drawn = (scene.opacities >= INVISIBLE).numpy()
    rows = np.flatnonzero(drawn)
    # neighbors in space become neighbors in memory: searches take a third of the time
    rows = rows[PointTree(scene.means[torch.from_numpy(rows)].numpy(), 1).order]
    index = torch.from_numpy(rows)
    sizes = scene.log_scales[index].sort(dim=1).values.double().numpy()
    body = _Neighborhoods(scene.means[index].numpy(), _EXTENT_SIGMAS * np.exp(sizes[:, 2]))
    remaining = np.ones(len(rows), bool)
    strays_by_kind: dict[str, list[Rows]] = {"giants": [], "needles": [], "floaters": []}
    while np.count_nonzero(remaining) >= _MIN_GAUSSIANS:
        kinds = _find_once(scene, rows, sizes, body, remaining)
        strays = np.concatenate([*kinds.values()])
        if not len(strays):
            break
        for kind, kind_rows in kinds.items():
            strays_by_kind[kind].append(rows[kind_rows])
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
    """Return the PSNR of `after` to `before` over views from all sides, and that of the worst view, dB.

    Both are `NO_DIFFERENCE` if no pixel differs.

    Args:
        before: the original; its bulk frames the views
        after: the same scene without some Gaussians
    """
    cameras = orbit_rig(before, _VIEWS, _VIEW_PX, _VIEW_PX)
    errors = [_squared_error(before, after, camera) for camera in cameras]
    return decibels(sum(errors) / len(errors)), decibels(max(errors))


def _squared_error(a: Gaussians, b: Gaussians, camera: Camera) -> float:
    with torch.no_grad():
        images = [render(scene, camera, _BACKGROUND).image.clamp(0.0, 1.0).double() for scene in (a, b)]
    return float((images[0] - images[1]).square().mean())


def _find_once(
    scene: Gaussians, drawn: Rows, sizes: Floats, body: _Neighborhoods, remaining: Mask
) -> dict[str, Rows]:
    """Find giants, needles and floaters once, see `find_strays`.

    Suspected giants and needles do not count as neighbors of others.

    Args:
        scene: all Gaussians
        drawn: rows of the N drawn Gaussians; the other arguments and the result index into these. [N]
        sizes: their log scales, ascending. [N,3]
        body: their neighborhoods
        remaining: drawn Gaussians that are not known as strays. [N]
    """
    longest = sizes[:, 2]
    thinness = sizes[:, 2] - sizes[:, 1]
    giant = remaining & (longest > _fence(longest[remaining]))
    needle = remaining & (thinness > _fence(thinness[remaining])) & (longest > np.median(longest[remaining]))
    suspects = np.flatnonzero(giant | needle)
    body.set_members(remaining & ~giant & ~needle)

    def ends_of(rows: Rows) -> Floats:
        return _ends(scene, drawn[rows])

    usual_emptiness = body.emptiness(body.sample(_EMPTINESS_SAMPLE), ends_of)
    min_emptiness = max(_fence(usual_emptiness), np.log(_ISOLATION_RATIO))
    outside = suspects[body.emptiness(suspects, ends_of) > min_emptiness]
    reference = body.members if len(body.members) <= _MAX_EXACT_GAUSSIANS else body.sample(_LONELINESS_SAMPLE)
    min_loneliness = max(_fence(body.loneliness(reference)), np.log(_ISOLATION_RATIO))
    isolated = body.find_isolated()
    floaters = isolated[body.loneliness(isolated) > min_loneliness]
    return {"giants": outside[giant[outside]], "needles": outside[~giant[outside]], "floaters": floaters}


def _ends(scene: Gaussians, rows: Rows) -> Floats:
    """Return the four ends of the two longer axes of some rows. [M] -> [M,4,3]"""
    selected = scene[torch.from_numpy(rows)]
    order = selected.log_scales.argsort(dim=1)[:, 1:]
    lengths = _EXTENT_SIGMAS * selected.log_scales.gather(1, order).double().exp()
    axes = rotation_matrices(selected.unit_quats.double())
    longer = axes.gather(2, order[:, None].expand(-1, 3, -1)).transpose(1, 2)
    tips = lengths[:, :, None] * longer
    center = selected.means.double()[:, None]
    return torch.cat([center + tips, center - tips], dim=1).numpy()


def _fence(values: Floats) -> float:
    """Return Tukey's upper fence."""
    low, high = np.quantile(values, (0.25, 0.75))
    return float(high + 1.5 * (high - low))


class _Neighborhoods:
    """Cached neighborhoods of the Gaussians that are not suspected strays (the members).

    The 16 nearest neighbors of a row are searched when they are first needed. Their distance is cached until
    a member joins or leaves within it. One tree serves many rounds: members that left are skipped.

    Args:
        points: means of N Gaussians, so ordered that neighbors in space are near in memory. [N,3] float32
        extents: two standard deviations along their longest axes. [N]
    """

    def __init__(self, points: NDArray[np.float32], extents: Floats) -> None:
        self._points = points
        self._extents = extents
        self._is_member = np.zeros(len(points), bool)
        self._spacing = np.full(len(points), np.nan)  # distance of the 16th neighbor; NaN: unknown
        # true: touches one of the farther 8 neighbors; valid if spacing is known
        self._touches = np.zeros(len(points), bool)
        # radius within which the members prove that a row touches one of these; NaN: unproven
        self._proof_radius = np.full(len(points), np.nan)
        self._ends = _EndCache(len(points))
        self.members: Rows = np.zeros(0, np.int64)

    def set_members(self, is_member: Mask) -> None:
        """Change the members, and forget the neighborhoods that this changes. [N]"""
        changed = np.flatnonzero(is_member != self._is_member)
        if not len(changed):
            return
        is_first = not len(self.members)
        self._is_member = is_member
        self.members = np.flatnonzero(is_member)
        self._neighbors = min(_NEIGHBORS, len(self.members) - 1)
        if is_first:
            self._build_tree()
            self._prove_enclosed()
            return
        self._forget(changed)
        if is_member[changed].any():
            self._build_tree()
            self._ends = _EndCache(len(self._points))

    def sample(self, count: int) -> Rows:
        """Return about `count` evenly spread members, nearly the same ones after a change of members."""
        rows = np.arange(0, len(self._points), -(-len(self._points) // count))
        return rows[self._is_member[rows]]

    def emptiness(self, rows: Rows, ends_of: Callable[[Rows], Floats]) -> Floats:
        """Return the log of how far the ends of rows lie outside the neighborhood of the nearest member.

        Args:
            rows: [M]
            ends_of: returns the ends of rows, [M] -> [M,4,3]

        Returns:
            The largest of the four. [M]
        """
        distances, near = self._ends.look_up(rows, self._is_member, partial(self._nearest_to_ends, ends_of))
        reach = np.maximum(self._spacing_of(near.ravel()).reshape(near.shape), self._extents[near])
        empty: Floats = np.log(np.maximum(distances, 1e-30)) - np.log(reach)
        largest: Floats = empty.max(axis=1)
        return largest

    def loneliness(self, rows: Rows) -> Floats:
        """Return the log ratio of the spacing of members to the median of their neighbors'. [M] -> [M]"""
        lonely = [np.zeros(0)]
        for start in range(0, len(rows), _CHUNK):
            chunk = rows[start : start + _CHUNK]
            near = self._search(chunk, self._neighbors)[1]
            neighbor_spacing = np.median(self._spacing_of(near.ravel()).reshape(near.shape), axis=1)
            lonely.append(np.log(self._spacing_of(chunk)) - np.log(neighbor_spacing))
        return np.concatenate(lonely)

    def find_isolated(self) -> Rows:
        """Return the members that touch none of the farther half of their neighbors. [M]

        Most members touch the first of that half, which is found in half the time of all neighbors.
        """
        unproven = self.members[np.isnan(self._proof_radius[self.members])]
        unknown = unproven[np.isnan(self._spacing[unproven])]
        for start in range(0, len(unknown), _CHUNK):
            chunk = unknown[start : start + _CHUNK]
            distances, near = self._search(chunk, self._neighbors // 2 + 1)
            first = distances[:, -1]
            touches = first <= self._extents[chunk] + self._extents[near[:, -1]]
            self._proof_radius[chunk[touches]] = first[touches]
        rows: Rows = unproven[np.isnan(self._proof_radius[unproven])]
        self._spacing_of(rows)
        return rows[~self._touches[rows]]

    def _build_tree(self) -> None:
        self._tree_rows = self.members
        self._tree = PointTree(self._points[self.members], _WIDE_SEARCH)

    def _forget(self, changed: Rows) -> None:
        """Forget the neighborhoods in which members joined or left. [C]

        Rows are tested in blocks of neighbors first: few blocks are near a changed row.
        """
        limits = np.fmax(self._spacing, self._proof_radius)
        changes = PointTree(self._points[changed], 1)
        starts = np.arange(0, len(limits), _TEST_ROWS)
        low = np.minimum.reduceat(self._points, starts).astype(np.float64)
        high = np.maximum.reduceat(self._points, starts).astype(np.float64)
        reach = 0.5 * np.linalg.norm(high - low, axis=1) + np.fmax.reduceat(limits, starts)
        distances = changes.kth_distances(0.5 * (low + high), 1)
        blocks = starts[distances <= (1.0 + 1e-9) * reach]  # false where no limit is known
        rows = (blocks[:, None] + np.arange(_TEST_ROWS)).ravel()
        rows = rows[rows < len(limits)]
        rows = rows[~np.isnan(limits[rows])]
        distances = changes.kth_distances(self._points[rows], 1)
        for radii in (self._spacing, self._proof_radius):
            radii[rows[distances <= radii[rows]]] = np.nan

    def _prove_enclosed(self) -> None:
        """Set the radius of members whose extent contains over half of their neighbors, without a search.

        Only rows near each other in memory are compared. That finds 3 of 4 such members, in 5 % of the time
        of searching all neighbors.
        """
        enclosed = np.zeros(len(self.members), bool)

        def compare(start: int) -> None:
            first = max(start - _WINDOW, 0)
            rows = self.members[first : start + _BLOCK + _WINDOW]
            columns = np.ascontiguousarray(self._points[rows].T)
            # reduced by more than float32 rounding
            squares = (self._extents[rows] ** 2 * (1.0 - 1e-5)).astype(np.float32)
            count = np.zeros(len(rows), np.int8)
            for step in range(1, min(_WINDOW, len(rows) - 1) + 1):
                x, y, z = columns[:, step:] - columns[:, :-step]
                squared_distances = x * x + y * y + z * z
                count[step:] += squared_distances <= squares[step:]
                count[:-step] += squared_distances <= squares[:-step]
            inner = count[start - first : start - first + _BLOCK]
            enclosed[start : start + _BLOCK] = inner > self._neighbors // 2

        map_threads(compare, range(0, len(self.members), _BLOCK))
        rows = self.members[enclosed]
        self._proof_radius[rows] = self._extents[rows]

    def _spacing_of(self, rows: Rows) -> Floats:
        """Return the distance to the 16th neighbor of some members, at least 1e-30. [M] -> [M]"""
        needed = np.zeros(len(self._points), bool)
        needed[rows] = np.isnan(self._spacing[rows])
        unknown = np.flatnonzero(needed)
        for start in range(0, len(unknown), _CHUNK):
            chunk = unknown[start : start + _CHUNK]
            distances, near = self._search(chunk, self._neighbors)
            half = self._neighbors // 2
            reach = self._extents[chunk, None] + self._extents[near[:, half:]]
            self._spacing[chunk] = distances[:, -1]
            self._touches[chunk] = (distances[:, half:] <= reach).any(axis=1)
        spacing: Floats = np.maximum(self._spacing[rows], 1e-30)
        return spacing

    def _search(self, rows: Rows, count: int) -> tuple[Floats, Rows]:
        """Return the distances and rows of the nearest neighbors of some members. [M] -> [M,count] each"""
        distances, near = self._nearest(self._points[rows], count + 1)
        return distances[:, 1:], near[:, 1:]

    def _nearest_to_ends(self, ends_of: Callable[[Rows], Floats], rows: Rows) -> tuple[Floats, Rows]:
        """Return the distance and row of the member nearest to each end of rows. [M] -> [M,4] each"""
        distances, near = self._nearest(ends_of(rows).reshape(-1, 3), 1)
        return distances.reshape(len(rows), 4), near.reshape(len(rows), 4)

    def _nearest(self, places: NDArray[np.floating], count: int) -> tuple[Floats, Rows]:
        """Return the distances and rows of the members nearest to positions. [M,3] -> [M,count] each

        Where the tree returns members that have left, a wider search follows. The tree is built again if too
        many have left for that.
        """
        distances, found = self._tree.query(places, count)
        near = self._tree_rows[found]
        if len(self._tree_rows) == len(self.members):
            return distances, near
        stale = np.flatnonzero(~self._is_member[near].all(axis=1))
        if not len(stale):
            return distances, near
        wide, found = self._tree.query(places[stale], min(_WIDE_SEARCH, len(self._tree_rows)))
        wide_near = self._tree_rows[found]
        has_left = ~self._is_member[wide_near]
        if int((~has_left).sum(axis=1).min()) < count:
            self._build_tree()
            return self._nearest(places, count)
        first = np.argsort(has_left, axis=1, kind="stable")[:, :count]
        distances[stale] = np.take_along_axis(wide, first, axis=1)
        near[stale] = np.take_along_axis(wide_near, first, axis=1)
        return distances, near


class _EndCache:
    """Nearest members of the ends of rows, valid while they are members and none joins. For N rows."""

    def __init__(self, count: int) -> None:
        self._slots = np.full(count, -1, np.int32)  # index of each row in the next two; -1: not cached
        self._distances = np.zeros((0, 4))
        self._near = np.zeros((0, 4), np.int64)

    def look_up(
        self, rows: Rows, is_member: Mask, search: Callable[[Rows], tuple[Floats, Rows]]
    ) -> tuple[Floats, Rows]:
        """Return the distance and row of the member nearest to each of four ends. [M] -> [M,4] each

        Args:
            rows: [M]
            is_member: [N]
            search: computes the same for rows that are not cached
        """
        new = rows[self._slots[rows] < 0]
        is_stale = ~is_member[self._near[self._slots[rows]]].all(axis=1) if len(self._near) else True
        stale = rows[(self._slots[rows] >= 0) & is_stale]
        self._slots[new] = np.arange(len(self._near), len(self._near) + len(new))
        self._distances = np.concatenate([self._distances, np.zeros((len(new), 4))])
        self._near = np.concatenate([self._near, np.zeros((len(new), 4), np.int64)])
        searched = np.concatenate([new, stale])
        slots = self._slots[searched]
        self._distances[slots], self._near[slots] = search(searched)
        return self._distances[self._slots[rows]], self._near[self._slots[rows]]


def with_strays(scene: Gaussians, region: Region) -> Region:
    """Return the region with the floaters that its removal would leave behind, see `find_strays`."""
    mask = ~region.mask
    alone = mask.nonzero()[:, 0][find_strays(scene[mask]).floaters]
    mask[alone[~torch.isin(alone, torch.from_numpy(find_strays(scene).floaters))]] = False
    return from_mask(region.name, ~mask)
