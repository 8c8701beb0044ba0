"""Order of painted layers: where the paint of two layers overlaps, the upper layer covers the lower one.

Splats are drawn in the order of their centers. Discs of two layers on one surface would therefore cut through
each other, whatever the order of the layers. For a layer of paint above another one:

- Its rows rise above the lower layer's rows that they overlap, by ten thicknesses of a disc, which is about
  one pixel of the painted picture. They rise along the ray of this picture, in which nothing shifts.
- Lower rows that it covers completely fade as its strength s approaches 1, by the factor 1 − c s⁸ with their
  coverage c. Otherwise a row with a nearer center would cover the upper layer when seen from the side. In the
  painted picture this changes a color by at most 4 % of the difference between both layers.
- Rows at its rim repeat the colors beside the paint. They take the colors that are there now: those of the
  lower paint, and those of recolored Gaussians below.

`compose_layers` and `Composer` both call `find_paint`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from progdf.field.baked import BakedField
from progdf.gaussians import Gaussians
from progdf.gdf.anchors import NOTHING
from progdf.gdf.file import Gdf
from progdf.quaternions import normalize_quats, rotation_matrices

from .layers import Layer

ARRANGED = ("means", "logit_opacities", "sh0")
"""Attributes that the order of painted layers changes."""

_CLEARANCE_THICKNESSES = 10.0  # distance between the rows of two layers, in thicknesses of a disc
_BLUR_THICKNESSES = 5.5  # standard deviation of a renderer's blur (0.3 px²), in thicknesses of a disc
_REACH_DEVIATIONS = 3.0  # extent of a disc, in standard deviations
_CORNER_DEVIATIONS = 1.5  # points at which the coverage of a row is measured, in its standard deviations
_MIN_WEIGHT = 0.05  # opacity of a disc at a point; below it, the disc is beside the point
_COVERED = (0.5, 0.95)  # least and full coverage at which a row fades
_SCATTER_QUANTILE = 0.9  # quantile of the pushed Gaussians' movements; surfaces within it are the same one
_NEAREST_PUSHED = 8  # pushed Gaussians whose movement gives the direction of the painted picture
_POINTS_AT_ONCE = 1 << 14  # limits the memory
MIN_OPACITY = 1e-30
"""Opacity of a row that is covered completely, which keeps its logit finite."""
_MAX_REMEMBERED = 64  # entries of a cache

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]
Result = TypeVar("Result")
_Cache = dict[tuple[int, ...], tuple[tuple[BakedField, ...], Result]]  # results by the ids of their fields


@dataclass(frozen=True)
class Overlap:
    """Overlap of two painted layers of an extended scene, if one lies above the other.

    Rows are indices into `PaintRows.rows`.
    """

    over: Rows  # rows of the upper layer on the lower one. [P]
    under: Rows  # row of the lower layer that is most visible there. [P]
    cover: Floats  # opacity of the lower layer there at strength 1. [P]
    rise: Floats  # distance by which the row has to rise to be above the lower layer. [P]
    hidden: Rows  # rows of the lower layer that the upper one covers. [H]
    above: Rows  # row of the upper layer that is most visible there. [H]
    share: Floats  # share of them that fades below the upper layer at strength 1. [H]


@dataclass(frozen=True)
class PaintRows:
    """Rows of painted layers of an extended scene that depend on other layers."""

    rows: Rows  # rows of the scene, ascending. [A]
    edits: Rows  # index of the edit that adds each row. [A]
    members: Rows  # its position among the members of this edit. [A]
    rim: Floats  # see `Anchors.rim`. [A]
    outward: Floats  # unit vectors from the surface towards the painted picture's camera. [A,3]
    pairs: Mapping[tuple[int, int], Overlap]  # by the indices of the upper and the lower edit
    spans: Mapping[int, slice]  # by edit: its rows, which are adjacent

    def __len__(self) -> int:
        return len(self.rows)

    def partners(self, edit: int) -> frozenset[int]:
        """Return the edits whose rows may change with an edit, itself included."""
        found = {edit}
        while True:
            linked = {upper for upper, lower in self.pairs if lower in found} | {
                lower for upper, lower in self.pairs if upper in found
            }
            if linked <= found:
                return frozenset(found)
            found |= linked


@dataclass(frozen=True)
class PaintLayer:
    """Active layer of paint in a stack."""

    edit: int  # index of the edit
    strength: float  # strength times the gain of opacity, 0 to 1
    weights: NDArray[np.float32] | None  # weights of the edit's members; None if all are 1. [M]


@dataclass(frozen=True)
class _Sheet:
    """Discs of a painted layer at strength 1."""

    points: Floats  # centers. [B,3]
    axes: Floats  # columns are the axes. [B,3,3]
    scales: Floats  # standard deviations along the axes. [B,3]
    opacity: Floats  # [B]
    outward: Floats  # [B,3]
    scatter: float  # distance from the surface within which Gaussians were pushed, world units


_SHEETS: _Cache[_Sheet] = {}
_OVERLAPS: _Cache[Overlap | None] = {}


def find_paint(scene: Gaussians, gdfs: Sequence[Gdf]) -> PaintRows | None:
    """Return the rows of paint that depend on other layers; None if there are none.

    Args:
        scene: the extended scene
        gdfs: its edits
    """
    paints = [edit for edit, gdf in enumerate(gdfs) if is_paint(gdf)]
    if not paints:
        return None
    counts = {edit: _added_count(gdfs[edit]) for edit in paints}
    sheets = {}
    for edit in paints if len(paints) > 1 else ():
        sheets[edit] = _look_up(_SHEETS, (gdfs[edit].field,), partial(_sheet, scene, gdfs[edit]))
    pairs = {}
    used = {edit: np.zeros(counts[edit], bool) for edit in paints}
    for upper, lower in permutations(paints, 2):
        find = partial(_overlap, sheets[upper], sheets[lower])
        found = _look_up(_OVERLAPS, (gdfs[upper].field, gdfs[lower].field), find)
        if found is not None:
            pairs[upper, lower] = found
            used[upper][found.over] = True
            used[upper][found.above] = True
            used[lower][found.under] = True
            used[lower][found.hidden] = True
    rims = {edit: _rim(gdfs[edit]) for edit in paints}
    parts = []
    spans = {}
    index = {}
    first = 0
    for edit in sorted(paints, key=lambda edit: int(gdfs[edit].region.members[-1])):
        chosen = np.flatnonzero(used[edit] | (rims[edit] > 0))
        index[edit] = np.full(counts[edit], -1)
        index[edit][chosen] = first + np.arange(len(chosen))
        spans[edit] = slice(first, first + len(chosen))
        first += len(chosen)
        members = len(gdfs[edit].region.members) - counts[edit] + chosen
        outward = sheets[edit].outward[chosen] if edit in sheets else np.zeros((len(chosen), 3))
        added = gdfs[edit].region.members.numpy()[members]
        parts.append((added, np.full(len(chosen), edit), members, rims[edit][chosen], outward))
    if not first:
        return None
    rows, edits, members, rim, outward = (np.concatenate(column) for column in zip(*parts, strict=True))
    placed = {
        (upper, lower): replace(
            pair,
            over=index[upper][pair.over],
            under=index[lower][pair.under],
            hidden=index[lower][pair.hidden],
            above=index[upper][pair.above],
        )
        for (upper, lower), pair in pairs.items()
    }
    return PaintRows(rows, edits, members, rim, outward, placed, spans)


def _look_up(cache: _Cache[Result], fields: tuple[BakedField, ...], make: Callable[[], Result]) -> Result:
    """Return the result for some fields, from the cache if it is there.

    A layer that is added to a stack, or taken from it, leaves the overlaps of the others as they are.
    """
    key = tuple(map(id, fields))
    if key not in cache:
        while len(cache) >= _MAX_REMEMBERED:
            cache.pop(next(iter(cache)))
        cache[key] = fields, make()
    return cache[key][1]


def is_paint(gdf: Gdf) -> bool:
    """Return whether an edit of an extended scene adds rows of paint."""
    return gdf.anchors is not None and bool(gdf.anchors.pushes) and len(gdf.anchors) > 0


def tints_rim(gdf: Gdf) -> bool:
    """Return whether an edit changes colors below the rims of other edits' paint.

    A grade of the whole scene does not, as it changes the colors of the paint's own rows.
    """
    pushes = NOTHING if gdf.anchors is None else gdf.anchors.pushes
    return "sh0" in gdf.field.attributes and "color" not in pushes and not gdf.from_others


def paint_layers(stack: Sequence[tuple[int, Layer]]) -> list[PaintLayer]:
    """Return the active layers of paint, lowest first.

    Args:
        stack: active layers, lowest first, with the index of their edit
    """
    layers = []
    for edit, layer in stack:
        if is_paint(layer.gdf):
            weights = None if layer.weights is None else layer.weights.float().numpy()
            gain = min(abs(layer.gains.opacity), 1.0)
            layers.append(PaintLayer(edit, layer.clamped_strength * gain, weights))
    return layers


def _added_count(gdf: Gdf) -> int:
    """Return the number of rows that a painted edit adds."""
    return 0 if gdf.anchors is None else len(gdf.anchors)


def _rim(gdf: Gdf) -> Floats:
    """Return the shares of a rim in the colors of the rows that an edit adds. [B]"""
    if gdf.anchors is None or gdf.anchors.rim is None:
        return np.zeros(_added_count(gdf))
    return gdf.anchors.rim.double().numpy()


def arrange(
    paint: PaintRows,
    layers: Sequence[PaintLayer],
    tints: Floats,
    values: Mapping[str, NDArray[np.float32]],
) -> None:
    """Move, fade and recolor the rows of paint by the order of the layers.

    `progdf.compose.paint_order.PaintOrder` computes the same values for the rows that a slider changes.

    Args:
        paint: see `find_paint`
        layers: active layers of paint, lowest first
        tints: change of the SH coefficients of degree 0 that other layers make to the anchors of the rows.
            [A,3]
        values: attributes of all rows without the order of layers; updated in place. [N,…]
    """
    opacity = opacities(paint, layers)
    order = paint_order(paint, layers)
    risen, kept = _heights(paint, order, opacity)
    colors = values["sh0"].reshape(-1, 3)
    own = colors[paint.rows].astype(np.float64)
    mixed = _rim_colors(paint, order, opacity, own, own + tints)
    active = opacity != 0.0
    recolored = active & (mixed != own).any(axis=1)
    colors[paint.rows[recolored]] = mixed[recolored]
    higher = active & (risen > 0.0)
    step = risen[higher, None] * paint.outward[higher]
    values["means"][paint.rows[higher]] += step.astype(np.float32)
    fading = active & (kept < 1.0)
    logits = values["logit_opacities"].reshape(-1)
    visible = kept[fading] / (1.0 + np.exp(-logits[paint.rows[fading]].astype(np.float64)))
    visible = np.maximum(visible, MIN_OPACITY)
    logits[paint.rows[fading]] = np.log(visible) - np.log1p(-visible)


def opacities(paint: PaintRows, layers: Sequence[PaintLayer]) -> Floats:
    """Return the strength at which each row of paint shows, 0 to 1. [A]

    Of two layers of one edit, the stronger one shows, see `Anchors.pushes`.
    """
    opacity = np.zeros(len(paint))
    for layer in layers:
        if layer.edit not in paint.spans:
            continue
        mine = paint.spans[layer.edit]
        visible: float | Floats = layer.strength
        if layer.weights is not None:
            visible = layer.strength * layer.weights[paint.members[mine]].astype(np.float64)
        opacity[mine] = np.maximum(opacity[mine], visible)
    return opacity


def paint_order(paint: PaintRows, layers: Sequence[PaintLayer]) -> tuple[int, ...]:
    """Return the edits with rows of paint, in the order of their uppermost layers, lowest first."""
    upper_first = dict.fromkeys(layer.edit for layer in reversed(layers) if layer.edit in paint.spans)
    return tuple(upper_first)[::-1]


def overlaps_below(paint: PaintRows, order: Sequence[int], edit: int) -> list[Overlap]:
    """Return the overlaps of an edit with the edits below it, lowest first."""
    lower = order[: order.index(edit)]
    return [paint.pairs[edit, each] for each in lower if (edit, each) in paint.pairs]


def _heights(paint: PaintRows, order: Sequence[int], opacity: Floats) -> tuple[Floats, Floats]:
    """Return the distance by which each row rises, and the factor of its opacity. [A], [A]"""
    risen = np.zeros(len(paint))
    kept = np.ones(len(paint))
    for edit in order:
        for pair in overlaps_below(paint, order, edit):
            risen[pair.over] = np.maximum(risen[pair.over], pair.rise + risen[pair.under])
            kept[pair.hidden] *= 1.0 - pair.share * _eighth_power(opacity[pair.above])
    return risen, kept


def _rim_colors(
    paint: PaintRows, order: Sequence[int], opacity: Floats, own: Floats, beside: Floats
) -> Floats:
    """Return the colors of the rows, of which rims take those beside the paint.

    Args:
        paint: see `find_paint`
        order: edits, lowest first
        opacity: see `opacities`. [A]
        own: colors without the order of layers. [A,3]
        beside: colors of the surface beside the paint; overwritten. [A,3]

    Returns:
        [A,3]
    """
    color = own.copy()
    rim = paint.rim[:, None]
    for edit in order:
        for pair in overlaps_below(paint, order, edit):
            share = (pair.cover * opacity[pair.under])[:, None]
            beside[pair.over] += share * (color[pair.under] - beside[pair.over])
        mine = paint.spans[edit]
        color[mine] += rim[mine] * (beside[mine] - own[mine])
    return color


def _eighth_power(strength: Floats) -> Floats:
    """Return the power by which covered rows fade, as in the module docstring."""
    square = strength * strength
    fourth = square * square
    return fourth * fourth


def _sheet(scene: Gaussians, gdf: Gdf) -> _Sheet:
    """Return the discs of a painted edit of the extended scene."""
    count = len(gdf.region.members) - _added_count(gdf)
    rows = gdf.region.members[count:]
    ends = {name: bases.end for name, bases in gdf.field.attributes.items()}
    end = {}
    for name in ("means", "log_scales", "quats", "logit_opacities"):
        old = getattr(scene, name)[rows].double()
        change = ends[name][count:].double().reshape(old.shape) if name in ends else 0.0
        end[name] = old + change
    points = end["means"].numpy()
    axes = rotation_matrices(normalize_quats(end["quats"])).numpy()
    moves = ends["means"][:count].double().numpy() if "means" in ends else np.zeros((count, 3))
    lengths = np.linalg.norm(moves, axis=1)
    starts = scene.means[gdf.region.members[:count]].double().numpy()
    pushed = (lengths > 0) & np.isfinite(starts).all(axis=1)
    if pushed.any():
        number = min(_NEAREST_PUSHED, int(pushed.sum()))
        nearest = cKDTree(starts[pushed]).query(points, list(range(1, number + 1)))[1]
        outward = -(moves[pushed] / lengths[pushed, None])[nearest].mean(axis=1)
        scatter = float(np.quantile(lengths[pushed], _SCATTER_QUANTILE))
    else:
        # nothing was in the way; the thin axis shows the direction, away from the surface
        assert gdf.anchors is not None
        share = gdf.anchors.weights.double()[..., None]
        surface = (share * scene.means[gdf.anchors.rows].double()).sum(dim=1).numpy()
        thin = axes[:, :, 2]
        outward = np.where(((points - surface) * thin).sum(axis=1, keepdims=True) < 0, -thin, thin)
        scatter = float(end["log_scales"].exp().amin(dim=1).median()) * _CLEARANCE_THICKNESSES
    length = np.linalg.norm(outward, axis=1, keepdims=True)
    return _Sheet(
        points,
        axes,
        end["log_scales"].exp().numpy(),
        end["logit_opacities"].sigmoid().numpy(),
        outward / np.maximum(length, 1e-12),
        scatter,
    )


def _overlap(upper: _Sheet, lower: _Sheet) -> Overlap | None:
    """Return the overlap of a layer above another, in rows that each adds; None if they do not meet."""
    scatter = max(upper.scatter, lower.scatter)
    margin = scatter + _REACH_DEVIATIONS * max(float(upper.scales.max()), float(lower.scales.max()))
    inside = _near(upper.points, lower.points, margin)
    below = _near(lower.points, upper.points, margin)
    distance = _distance(lower, upper.points[inside], upper.outward[inside], scatter)
    if distance is None or not len(below):
        return None
    cover, height, under = _cover(lower, upper.points[inside], upper.outward[inside], distance)
    meets = height > -np.inf
    over = inside[meets]
    clearance = _CLEARANCE_THICKNESSES * upper.scales[over].min(axis=1)
    rise = np.maximum(height[meets] + clearance, 0.0)
    hidden, above, share = _hidden(upper, lower, below, distance)
    return Overlap(over, under[meets], cover[meets], rise, hidden, above, share)


def _distance(sheet: _Sheet, points: Floats, outward: Floats, scatter: float) -> float | None:
    """Return a distance that joins points to the planes of discs of the same surface; None if none is near.

    It is the largest distance from the plane of the nearest disc, and the distance between two layers.

    Args:
        sheet: a layer
        points: centers of the discs of another layer. [P,3]
        outward: directions away from their surface. [P,3]
        scatter: surfaces within this distance are the same one
    """
    if not len(points):
        return None
    disc = cKDTree(sheet.points).query(points)[1]
    apart = sheet.points[disc] - points
    thin = np.argmin(sheet.scales[disc], axis=1)
    normal = np.take_along_axis(sheet.axes[disc], thin[:, None, None], axis=2)[:, :, 0]
    across = np.abs((apart * normal).sum(axis=1))
    along = np.sqrt(np.maximum((apart**2).sum(axis=1) - across**2, 0.0))
    near = (across <= scatter) & ((sheet.outward[disc] * outward).sum(axis=1) > 0)
    near &= along <= _REACH_DEVIATIONS * sheet.scales[disc].max(axis=1)
    if not near.any():
        return None
    return float(across[near].max() + _CLEARANCE_THICKNESSES * np.median(sheet.scales.min(axis=1)))


def _near(points: Floats, others: Floats, margin: float) -> Rows:
    """Return the points in the bounding box of others, extended by a margin."""
    low = others.min(axis=0) - margin
    high = others.max(axis=0) + margin
    return np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))


def _hidden(upper: _Sheet, lower: _Sheet, below: Rows, distance: float) -> tuple[Rows, Rows, Floats]:
    """Return the covered lower rows, the rows that cover them, and the shares that fade. [H] each"""
    least, full = _COVERED
    points = lower.points[below]
    outward = lower.outward[below]
    cover, _, above = _cover(upper, points, outward, distance)
    covered = np.flatnonzero(cover > least)
    smallest = cover[covered]
    rows = below[covered]
    sides = np.argsort(lower.scales[rows], axis=1)[:, 1:]  # the two wide axes
    for side in sides.T:
        axis = np.take_along_axis(lower.axes[rows], side[:, None, None], axis=2)[:, :, 0]
        step = _CORNER_DEVIATIONS * np.take_along_axis(lower.scales[rows], side[:, None], axis=1) * axis
        for corner in (lower.points[rows] + step, lower.points[rows] - step):
            smallest = np.minimum(smallest, _cover(upper, corner, lower.outward[rows], distance)[0])
    share = np.clip((smallest - least) / (full - least), 0.0, 1.0)
    share = share * share * (3.0 - 2.0 * share)
    fades = share > 0
    return rows[fades], above[covered][fades], share[fades]


def _cover(sheet: _Sheet, points: Floats, outward: Floats, distance: float) -> tuple[Floats, Floats, Rows]:
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
    for one in np.unique(classes):
        members = np.flatnonzero(classes == one)
        blur = _BLUR_THICKNESSES * float(np.median(sheet.scales[members].min(axis=1)))
        reach = _REACH_DEVIATIONS * float(np.hypot(size[members].max(), blur))
        tree = cKDTree(sheet.points[members])
        for begin in range(0, len(points), _POINTS_AT_ONCE):
            lists = tree.query_ball_point(points[begin : begin + _POINTS_AT_ONCE], np.hypot(reach, distance))
            counts = np.array([len(found) for found in lists])
            if not counts.sum():
                continue
            disc = members[np.concatenate([np.asarray(found, np.int64) for found in lists])]
            owner = begin + np.repeat(np.arange(len(lists)), counts)
            weight, apart = _weights(sheet, disc, points[owner], outward[owner], distance)
            seen = weight > _MIN_WEIGHT
            disc, owner, weight, apart = disc[seen], owner[seen], weight[seen], apart[seen]
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
    sheet: _Sheet, disc: Rows, points: Floats, outward: Floats, distance: float
) -> tuple[Floats, Floats]:
    """Return the opacity of discs at points, and their heights above these. [n] each"""
    apart = sheet.points[disc] - points
    local = np.einsum("nji,nj->ni", sheet.axes[disc], apart)
    variance = sheet.scales[disc] ** 2
    thin = np.argmin(variance, axis=1)[:, None]
    thickness = np.take_along_axis(sheet.scales[disc], thin, axis=1)
    variance += (_BLUR_THICKNESSES * thickness) ** 2
    np.put_along_axis(variance, thin, np.inf, axis=1)
    across = np.abs(np.take_along_axis(local, thin, axis=1))[:, 0]
    same = (across <= distance) & ((sheet.outward[disc] * outward).sum(axis=1) > 0)
    weight = sheet.opacity[disc] * np.exp(-0.5 * (local**2 / variance).sum(axis=1)) * same
    return weight, (apart * outward).sum(axis=1)
