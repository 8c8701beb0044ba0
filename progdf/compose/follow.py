"""Added rows follow the surface on which they lie, when other layers change it.

An added row has up to four anchors among the scene's rows (see `progdf.gdf.anchors`). With weighted means
over the anchors, let a and a' be the centers in the original and under the other layers, R the rotation
between them, log s the mean change of the log-scales, and v and v' the visible opacities (above 1/255, below
which nothing is drawn). A row with center x, rotation q, log-scales l and opacity o then has

    x' = a' + s R (x − a),   q' = R q,   l' = l + log s,   o' = o · min(1, v' / v)

A rigid motion of all anchors is thus the row's motion. R also turns the higher SH bands of the row, which
grown rows have; discs of paint have none. The other layers are all but the row's own and those that paint:
paint only pushes Gaussians out of its way, see `Anchors.pushes`. A pushed Gaussian that other
layers change too is carried along in the same way, with its own row as its only anchor. Changes of color are
not followed.

Rows whose anchors keep all bits keep theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.field.baked import BakedField, GradeForm
from progdf.gaussians import BASE_CHANNELS, Gaussians
from progdf.gdf.anchors import free_anchors
from progdf.gdf.file import Gdf, fingerprint
from progdf.quaternions import multiply_quats, normalize_quats, rotate_vectors
from progdf.region import Region
from progdf.sh import rotation_change
from progdf.system.equality import equal_fields

from .overlap import PaintRows, tints_rim

FOLLOWED = ("means", "log_scales", "quats", "logit_opacities")
"""Attributes that follow the surface, in the order of `pack_shapes`."""
COLORS = ("sh0", "shN")
"""Attributes that decide on the colors of rims."""
_MEANS = slice(0, 3)
_LOG_SCALES = slice(3, 6)
_QUATS = slice(6, 10)
_GEOMETRY = slice(0, 10)
_LOGIT = slice(10, 11)
_MIN_DRAWN_OPACITY = 1 / 255  # renderers skip Gaussians below it, see `UNSEEN_LOGIT`
_MIN_OPACITY = 1e-30  # keeps the logit of a vanished row finite

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class Followers:
    """Rows of an extended scene that can follow other rows, and the states that they need.

    A state is one row of the scene under some of the edits. E states are composed, for F following rows.
    """

    __eq__ = equal_fields

    rows: Rows  # rows that follow, those of each edit in a run; a pushed row comes last. [F]
    edits: Rows  # index of the edit that adds the row; -1 for a pushed row. [F]
    anchors: Rows  # states of the anchors. [F,4]
    weights: NDArray[np.float64]  # weights of the anchors. [F,4]
    own: Rows  # state of a pushed row under all paint; -1 for an added row. [F]
    state_rows: Rows  # row of the scene of each state. [E]
    changed: tuple[tuple[Rows, Rows], ...]  # by edit: states that it changes, and its members there. [m], [m]
    pushing: frozenset[int]  # edits that push their members

    def dependents(self, edit: int) -> Rows:
        """Return the rows that may move when an edit changes, besides its members."""
        is_changed = np.zeros(len(self.state_rows), bool)
        is_changed[self.changed[edit][0]] = True
        return np.unique(self.rows[(is_changed[self.anchors] & (self.weights > 0)).any(axis=1)])


def changes_shape(gdf: Gdf) -> bool:
    """Return whether an edit changes geometry or opacity."""
    return any(name in FOLLOWED for name in gdf.field.attributes)


def carries_others(gdf: Gdf) -> bool:
    """Return whether rows of other edits follow an edit's change of its own members."""
    return gdf.anchors is None or gdf.anchors.carries_others


def find_rims(gdfs: Sequence[Gdf], count: int, paint: PaintRows) -> Followers | None:
    """Return the rows whose colors repeat the surface beside the paint; None if there are none.

    Their states show the colors of the surface under the other edits.

    Args:
        gdfs: edits of an extended scene
        count: number of rows of this scene
        paint: see `find_paint`
    """
    members = [gdf.region.members.numpy() for gdf in gdfs]
    tinting = [edit for edit, gdf in enumerate(gdfs) if tints_rim(gdf)]
    builder = _Builder(members, count)
    for edit in np.unique(paint.edits).tolist():
        found = gdfs[edit].anchors
        if found is None:
            continue
        mine = (paint.edits == edit) & (paint.rim > 0)
        at = paint.members[mine] - (len(members[edit]) - len(found))
        changing = tuple(other for other in tinting if other != edit)
        anchors = found.rows.numpy()[at]
        weights = found.weights.double().numpy()[at]
        touched = (builder.rows_of(changing)[anchors] & (weights > 0)).any(axis=1)
        builder.add(paint.rows[mine][touched], edit, anchors[touched], weights[touched], changing)
    return builder.finish(frozenset())


def find_followers(gdfs: Sequence[Gdf], count: int) -> Followers | None:
    """Return the rows that can follow the changes of other edits; None if there are none.

    Args:
        gdfs: edits of an extended scene
        count: number of rows of this scene
    """
    members = [gdf.region.members.numpy() for gdf in gdfs]
    shaping = [edit for edit, gdf in enumerate(gdfs) if changes_shape(gdf)]
    # a move that leaves paint behind has no shape here, but pushed rows return to their own state
    pushing = [
        edit
        for edit, gdf in enumerate(gdfs)
        if not carries_others(gdf)
        and (edit in shaping or (gdf.anchors is not None and gdf.anchors.leaves_paint))
    ]
    others = [edit for edit in shaping if edit not in pushing]
    builder = _Builder(members, count)
    for edit, gdf in enumerate(gdfs):
        if gdf.anchors is None or not len(gdf.anchors):
            continue
        anchors = gdf.anchors.rows.numpy()
        weights = gdf.anchors.weights.double().numpy()
        changing = tuple(other for other in others if other != edit)
        touched = (builder.rows_of(changing)[anchors] & (weights > 0)).any(axis=1)
        rows = members[edit][len(members[edit]) - len(anchors) :]
        builder.add(rows[touched], edit, anchors[touched], weights[touched], changing)
    pushed = np.flatnonzero(builder.rows_of(tuple(pushing)) & builder.rows_of(tuple(others)))
    anchors = np.repeat(pushed[:, None], 4, axis=1)
    weights = np.zeros(anchors.shape)
    weights[:, 0] = 1.0
    builder.add(pushed, -1, anchors, weights, tuple(others), tuple(pushing))
    return builder.finish(frozenset(pushing))


def banded_followers(scene: Gaussians, gdfs: Sequence[Gdf], followers: Followers) -> Rows:
    """Return the indices of the following added rows that have higher SH bands at any strength. [B]"""
    has_bands = (scene.shN != 0).flatten(1).any(dim=1).numpy()
    for gdf in gdfs:
        bases = gdf.field.attributes.get("shN")
        if gdf.anchors is not None and bases is not None:
            moves = (bases.end_offset != 0).any(dim=1) | (bases.residual_basis != 0).any(dim=2).any(dim=0)
            has_bands[gdf.region.members[moves].numpy()] = True
    return np.flatnonzero(has_bands[followers.rows] & (followers.edits >= 0))


class _Builder:
    """Collector of the rows and states of `Followers`."""

    def __init__(self, members: Sequence[Rows], count: int) -> None:
        self._members = members
        self._count = count
        self._parts: list[tuple[Rows, int, Rows, NDArray[np.float64], Rows]] = []
        self._states: list[tuple[Rows, tuple[int, ...]]] = []
        self._state_count = 0

    def rows_of(self, edits: tuple[int, ...]) -> NDArray[np.bool_]:
        """Return the rows that some edits change. [N]"""
        mask = np.zeros(self._count, bool)
        for edit in edits:
            mask[self._members[edit]] = True
        return mask

    def add(
        self,
        rows: Rows,
        edit: int,
        anchors: Rows,
        weights: NDArray[np.float64],
        changing: tuple[int, ...],
        own: tuple[int, ...] | None = None,
    ) -> None:
        """Add rows that follow the changes that some edits make to their anchors.

        Args:
            rows: [F]
            edit: index of the edit that adds them, or -1
            anchors, weights: rows of the scene and their weights. [F,4]
            changing: edits that move the anchors
            own: edits whose change of the rows themselves is carried along; None for added rows
        """
        if not len(rows):
            return
        own_states = np.full(len(rows), -1)
        if own is not None:
            own_states = self._state_count + np.arange(len(rows))
            self._push(rows, own)
        needed, index = np.unique(anchors, return_inverse=True)
        states = self._state_count + index.reshape(anchors.shape)
        self._push(needed, changing)
        self._parts.append((rows, edit, states, weights, own_states))

    def _push(self, rows: Rows, edits: tuple[int, ...]) -> None:
        self._states.append((rows, edits))
        self._state_count += len(rows)

    def finish(self, pushing: frozenset[int]) -> Followers | None:
        """Return the collected rows; None without any."""
        if not self._parts:
            return None
        changed = []
        for edit, members in enumerate(self._members):
            states = [np.zeros(0, np.int64)]
            index = [np.zeros(0, np.int64)]
            first = 0
            for rows, edits in self._states:
                if edit in edits and len(members):
                    at = np.searchsorted(members, rows).clip(max=len(members) - 1)
                    found = np.flatnonzero(members[at] == rows)
                    states.append(first + found)
                    index.append(at[found])
                first += len(rows)
            changed.append((np.concatenate(states), np.concatenate(index)))
        parts = list(zip(*self._parts, strict=True))
        following, edits, anchors, weights, own = parts
        return Followers(
            np.concatenate(following),
            np.concatenate([np.full(len(part), edit) for part, edit in zip(following, edits, strict=True)]),
            np.concatenate(anchors),
            np.concatenate(weights),
            np.concatenate(own),
            np.concatenate([part for part, _ in self._states]),
            tuple(changed),
            pushing,
        )


def state_scene(
    scene: Gaussians, gdfs: Sequence[Gdf], followers: Followers, names: Sequence[str] = FOLLOWED
) -> tuple[Gaussians, list[Gdf]]:
    """Return the states as a scene of their own, and the edits restricted to it and to some attributes.

    Args:
        scene: the extended scene
        gdfs: its edits
        followers: see `find_followers`
        names: the attributes

    Returns:
        E Gaussians, one per state, and the edits, of which some have no members.
    """
    states = scene[torch.from_numpy(followers.state_rows)]
    scene_print = fingerprint(states)
    parts = []
    for gdf, (members, index) in zip(gdfs, followers.changed, strict=True):
        at = torch.from_numpy(index)
        attributes = {name: bases.take(at) for name, bases in gdf.field.attributes.items() if name in names}
        score = torch.zeros(len(states))
        score[members] = 1.0
        region = Region(gdf.region.name, torch.from_numpy(members), score)
        channels = gdf.field.channels if "shN" in names else BASE_CHANNELS
        form = gdf.field.origin
        grade = _part_of_grade(form, at) if "sh0" in names and isinstance(form, GradeForm) else None
        kind = "separable" if grade is None else "grade"
        field = BakedField(kind, gdf.field.knots, attributes, channels, origin=grade)
        pushes = None
        if gdf.anchors is not None:
            pushes = replace(
                free_anchors(0), pushes=gdf.anchors.pushes, leaves_paint=gdf.anchors.leaves_paint
            )
        parts.append(Gdf(gdf.name, region, field, scene_print, anchors=pushes))
    return states, parts


def _part_of_grade(form: GradeForm, members: Tensor) -> GradeForm:
    """Return a grade of some of its members."""
    mask = None if form.mask is None else form.mask[members]
    return replace(form, residual=form.residual[:, members], mask=mask)


def pack_shapes(gaussians: Gaussians, rows: Tensor | slice = slice(None)) -> Tensor:
    """Return the followed attributes of some rows. [F,11] float32"""
    parts = [getattr(gaussians, name)[rows].float() for name in FOLLOWED]
    return torch.cat([part if part.ndim > 1 else part[:, None] for part in parts], dim=1)


def unpack_shapes(shapes: Tensor) -> dict[str, Tensor]:
    """Return the followed attributes by name; the inverse of `pack_shapes`. [F,11]"""
    logits = shapes[:, _LOGIT]
    return {
        "means": shapes[:, _MEANS],
        "log_scales": shapes[:, _LOG_SCALES],
        "quats": shapes[:, _QUATS],
        "logit_opacities": logits[:, 0],
    }


def carry_rows(own: Tensor, before: Tensor, after: Tensor, weights: Tensor) -> Tensor:
    """Return rows that follow their anchors, see the module docstring; colors are not among the columns.

    Args:
        own: the rows under their own edit, packed by `pack_shapes`. [F,11]
        before, after: anchors in the original and under the other edits. [F,4,11]
        weights: weights of the anchors, sum 1. [F,4] float64

    Returns:
        [F,11] float32. Columns of geometry, and of opacity, keep their bits if those of all anchors do.
    """
    weighs = weights > 0
    share = weights[..., None]
    differs = (before != after) & weighs[..., None]
    moves = differs[..., _GEOMETRY].flatten(1).any(dim=1)
    fades = differs[..., _LOGIT].flatten(1).any(dim=1)
    row, old, new = own.double(), before.double(), after.double()
    turn = _mean_turn(old[..., _QUATS], new[..., _QUATS], share)
    log_scale = (share * (new - old)[..., _LOG_SCALES]).sum(dim=1).mean(dim=1, keepdim=True)
    pivot = (share * old[..., _MEANS]).sum(dim=1)
    target = (share * new[..., _MEANS]).sum(dim=1)
    arm = rotate_vectors(row[:, _MEANS] - pivot, turn) * log_scale.exp()
    logits = row[:, _LOGIT]
    visible, remaining = ((share * _visible_opacity(each[..., _LOGIT])).sum(dim=1) for each in (old, new))
    ratio = torch.where(visible > 0.0, remaining / visible.clamp_min(_MIN_OPACITY), 1.0)
    opacity = (logits.sigmoid() * ratio).clamp_min(_MIN_OPACITY)
    faded = torch.where(ratio < 1.0, opacity.log() - torch.log1p(-opacity), logits)
    geometry = torch.cat(
        [target + arm, row[:, _LOG_SCALES] + log_scale, multiply_quats(turn, row[:, _QUATS])], 1
    )
    return torch.cat(
        [
            torch.where(moves[:, None], geometry.float(), own[:, _GEOMETRY]),
            torch.where(fades[:, None], faded.float(), own[:, _LOGIT]),
        ],
        dim=1,
    )


def turn_bands(bands: Tensor, turns: Tensor, moves: Tensor) -> Tensor:
    """Return the higher SH bands of rows that turn with their anchors.

    Args:
        bands: the rows' bands under their own edit. [F,K,3]
        turns: mean turns of their anchors, unit quaternions. [F,4]
        moves: rows with an anchor that moves; others keep all bits. [F] bool

    Returns:
        [F,K,3] float32
    """
    rows = moves & (bands != 0).flatten(1).any(dim=1)
    own = bands[rows].double()
    turned = bands.clone()
    turned[rows] = (own + rotation_change(own, turns[rows])).float()
    return turned


def anchor_turns(before: Tensor, after: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean turn of anchors, and whether the geometry of any differs; arguments as in `carry_rows`.

    Returns:
        [F,4] float64 and [F] bool.
    """
    differs = (before != after) & (weights > 0)[..., None]
    moves = differs[..., _GEOMETRY].flatten(1).any(dim=1)
    return _mean_turn(before[..., _QUATS].double(), after[..., _QUATS].double(), weights[..., None]), moves


def carry_pushed(own: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Return pushed rows that follow their own row under the other edits.

    Args:
        own: the rows under paint alone. [F,11]
        before, after: the rows in the original and under the other edits. [F,11]

    Returns:
        [F,11] float32. Where one of the two changes nothing, these are the rows under the other.
    """
    weights = torch.tensor([[1.0, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(len(own), 4)
    carried = carry_rows(own, before[:, None].expand(-1, 4, -1), after[:, None].expand(-1, 4, -1), weights)
    parts = []
    for columns in (_GEOMETRY, _LOGIT):
        is_pushed = (own[:, columns] != before[:, columns]).any(dim=1, keepdim=True)
        is_moved = (after[:, columns] != before[:, columns]).any(dim=1, keepdim=True)
        both = torch.where(is_pushed, carried[:, columns], after[:, columns])
        parts.append(torch.where(is_moved, both, own[:, columns]))
    return torch.cat(parts, dim=1)


def _visible_opacity(logits: Tensor) -> Tensor:
    """Return the opacity above the least that is drawn, 0 to 1."""
    return (logits.sigmoid() - _MIN_DRAWN_OPACITY).clamp_min(0.0)


def _mean_turn(old: Tensor, new: Tensor, share: Tensor) -> Tensor:
    """Return the weighted mean of rotations as unit quaternions. [F,4,4], [F,4,4], [F,4,1] -> [F,4]"""
    conjugate = normalize_quats(old) * old.new_tensor([1.0, -1.0, -1.0, -1.0])
    turns = multiply_quats(normalize_quats(new).flatten(0, 1), conjugate.flatten(0, 1)).reshape(old.shape)
    return mean_quats(turns, share)


def mean_quats(turns: Tensor, share: Tensor) -> Tensor:
    """Return the weighted mean of unit quaternions. [F,4,4], [F,4,1] -> [F,4]"""
    # q and −q are the same rotation
    heaviest = turns[:, :1]
    aligned = torch.where((turns * heaviest).sum(dim=2, keepdim=True) < 0, -turns, turns)
    return normalize_quats((share * aligned).sum(dim=1))
