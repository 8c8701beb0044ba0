"""Fast, in-place version of `compose_layers` for dragging sliders, with the same results.

It rewrites members only. Bases stay in their stored type (int8): a new slider value reads about 84 bytes per
member and writes its 14 numbers. The only allocation that grows with the scene is a buffer for the sums of
one attribute.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.field.baked import Segment, find_segment
from progdf.field.stored_bases import StoredBases
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.motions import PartMotions
from progdf.gdf.texture import ColorSplit, Split, color_split
from progdf.threads import run_chunks

from .added import extend
from .compose_kernel import add_offsets, keep_larger, write_rows
from .follow import FOLLOWED, changes_shape, find_followers
from .follow_kernel import Shapes
from .layers import (
    DEFAULT_BLEND,
    KINDS,
    ORDERED,
    Change,
    Effects,
    Layer,
    changed_edits,
    check_numbers,
    check_weights,
    color_factors,
    disc_changes,
    effects_of,
    is_averaged_alone,
    needs_split,
    rule_of,
)
from .overlap import ARRANGED, find_paint
from .paint_order import PaintOrder
from .parents.carrier import Carrier
from .parents.rows import is_move, still
from .reference import Coverage, changed_rows, coverage
from .states import Surface

Floats = NDArray[np.float32]
Rows = NDArray[np.int64]

CHUNK = 16_384
"""Rows per task of a thread: few enough for the L2 cache, and enough to be worth a thread."""

_NO_ROWS = np.zeros(0, np.int64)
_NO_VALUES = np.zeros(0, np.float32)  # stands for weights that are all 1, and for coverage that is all 0


class _Members(NamedTuple):
    """Rows, and the members of each edit among them."""

    rows: Rows  # ascending. [U]
    parts: Mapping[int, tuple[Rows, Rows]]  # by edit: its members among the rows, and their positions. [m]


class _Plan(NamedTuple):
    """Rows and members to rewrite when some edits change."""

    rows: Rows  # all rows that may change, ascending. [U]
    colors: _Members  # members of the changed edits
    shapes: _Members  # those whose shape is written, without pushed rows if they are most of them
    followers: Rows = _NO_ROWS  # indices of the following rows, see `Followers`. [F]
    added: Rows = _NO_ROWS  # indices of the added rows among them whose own shape is written. [G]
    banded: Rows = _NO_ROWS  # indices of following rows with higher SH bands that may change. [B]
    recolored: Rows = _NO_ROWS  # those of them that the changed edits change
    painted: Rows = _NO_ROWS  # indices of the rows of paint among the members, see `PaintRows`. [K]
    arranged: Rows = _NO_ROWS  # indices of all rows of paint that may change. [L]


class _LayerSlice(NamedTuple):
    """Members of a layer in a range of rows."""

    layer: Layer
    edit: int
    segment: Segment  # segment of the knots that holds the strength
    members: Rows  # member indices of the edit. [m]
    at: Rows  # positions of the members in the range. [m]
    weights: Floats  # weights of all members of the edit; empty if all are 1. [M] or [0]


class Composer:
    """One scene under a changing stack of edits.

    Args:
        scene: the original, float32, which is never modified
        gdfs: every edit that may appear in the stack; their added rows come after the scene's own
        covers: `coverage`, or its values from another scene
        split: `color_split`, or its values from another scene

    Raises:
        ProgdfError: an edit was made for another scene.
    """

    def __init__(
        self, scene: Gaussians, gdfs: Sequence[Gdf], covers: Coverage = coverage, split: Split = color_split
    ) -> None:
        scene, extended = extend(scene, gdfs)
        self._scene = scene
        self._given = tuple(gdfs)  # kept alive, so that no other edit gets the same id
        moves = extended
        extended = tuple(still(gdf) for gdf in moves)
        self._gdfs = extended
        forms = gdfs, moves, extended
        self._index = {id(gdf): i for edits in forms for i, gdf in enumerate(edits)}
        self._coverage: dict[int, Mapping[str, Tensor]] = {}
        self._split = split
        self._splits: dict[int, ColorSplit | None] = {}
        self._color_bases: dict[tuple[int, str], StoredBases] = {}
        self._repainted = frozenset[int]()  # edits whose discs have other colors than trained
        self._members = [gdf.region.members.numpy() for gdf in extended]
        fields = [gdf.field.attributes for gdf in extended]
        self._bases = [{name: StoredBases.of(bases) for name, bases in field.items()} for field in fields]
        self._leaves_paint = [gdf.anchors is not None and gdf.anchors.leaves_paint for gdf in extended]
        moving = {name for bases in self._bases for name in bases}
        self._covers = covers
        known = self._coverage_of, self._split_of
        followers = find_followers(extended, len(scene))
        self._surface = None
        if followers is not None:
            self._surface = Surface(scene, extended, followers, known, Composer)
            moving.update(FOLLOWED)
            moving.update(("shN",) if len(self._surface.banded) else ())
        paint = find_paint(scene, extended)
        self._paint = None
        if paint is not None:
            self._paint = PaintOrder(scene, extended, paint, known, Composer)
            moving.update(ARRANGED)
        moving.update("sh0" for gdf in extended if gdf.paints)  # gains change the colors of discs
        before = {name: getattr(scene, name).detach().float() for name in ATTRIBUTES if name in moving}
        after: dict[str, Any] = {name: values.clone() for name, values in before.items()}
        self.gaussians = replace(scene, **after)
        """Scene under the layers of the last update. The next update writes to its tensors in place."""
        width = {name: math.prod(values.shape[1:]) for name, values in before.items()}
        self._before = {name: values.reshape(-1, width[name]).numpy() for name, values in before.items()}
        self._after = {name: values.view(-1, width[name]).numpy() for name, values in after.items()}
        self._carrier = None
        if any(is_move(gdf) for gdf in moves):
            self._carrier = Carrier(scene, moves)
            self.gaussians = replace(self.gaussians, **self._carrier.tensors)
        self._meets: dict[tuple[int, int], bool] = {}
        self._effects = Effects()
        self._plans: dict[frozenset[int], _Plan] = {}
        self._checked: list[tuple[torch.Tensor, int]] = []  # weights and their versions
        self._touched: set[int] = set()  # edits whose offsets were written in place

    def touch(self, gdf: Gdf, motions: PartMotions | None = None) -> None:
        """Let the next update read the offsets of an edit again, after they were written in place.

        The offsets are float32, as an edit in progress has them.

        Args:
            gdf: the edit
            motions: its motions from now on, if it was given with motions; None keeps them
        """
        edit = self._edit_of(gdf)
        self._touched.add(edit)
        if motions is not None and self._carrier is not None:
            self._carrier.set_motions(edit, motions)
        if self._surface is not None:
            self._surface.touch(edit, self._gdfs[edit])

    def update(self, layers: Sequence[Layer], blend: str = DEFAULT_BLEND) -> Change:
        """Set `gaussians` to the scene under `layers`, equal to `compose_layers(scene, layers, blend)`.

        Args:
            layers: the stack, lowest first. Every gdf is an object that was given to the constructor. Changed
                weights are detected if they are a new tensor or were written in place by torch
            blend: one of `BLENDS`

        Returns:
            Rows and attributes that may have changed; no rows if nothing has.

        Raises:
            ProgdfError: a strength is not a number, the blend rule is unknown.
            ValueError: weights do not fit, or an edit was not given to the constructor.
        """
        check_numbers(layers, blend)
        edits = [(self._edit_of(layer.gdf), layer) for layer in layers if layer.active]
        stack = [(edit, replace(layer, gdf=self._gdfs[edit])) for edit, layer in edits]
        self._check_weights([layer for _, layer in stack])
        before = self._effects
        self._effects = effects_of(stack, blend)
        changed = changed_edits(before, self._effects) | (self._touched & {edit for edit, _ in stack})
        self._touched.clear()
        if not changed:
            return Change(np.zeros(0, np.int64), (), 0.0)
        change = self._compose(stack, blend, changed)
        if self._carrier is None:
            return change
        return self._carrier.carry(change, changed, stack, self._after)

    def _compose(self, stack: Sequence[tuple[int, Layer]], blend: str, changed: frozenset[int]) -> Change:
        """Compose the stack without its moves."""
        plan = self._plan(changed)
        # weights are summed by kind of change, so that a change reaches all attributes of its kinds
        kinds = {KINDS[name] for edit in changed for name in self._bases[edit]}
        if any(self._leaves_paint[edit] for edit in changed):  # Gaussians return from below their paint
            kinds = set(KINDS.values())
        moving = {name for edit in plan.colors.parts for name in self._bases[edit] if KINDS[name] in kinds}
        repainted = frozenset(edit for edit, layer in stack if layer.gdf.paints and needs_split(layer))
        if changed & (repainted | self._repainted):
            moving.add("sh0")
        self._repainted = repainted
        names = tuple(name for name in self._before if name in moving)
        arranged = () if self._paint is None else self._paint.names(changed, plan.arranged)
        moving.update(arranged)
        surface = self._surface
        if surface is None or not (len(plan.followers) or len(plan.banded)):
            self._release(plan.painted, arranged)
            moved = self._write(stack, blend, plan.colors, names)
            moved += self._arrange(stack, blend, plan, names, arranged)
            return Change(plan.rows, tuple(name for name in self._before if name in moving), moved)
        shapes = self.shapes()
        surface.release(shapes, plan.added)
        self._release(plan.painted, arranged)
        if plan.shapes is plan.colors:
            moved = self._write(stack, blend, plan.colors, names)
        else:
            colors = tuple(name for name in names if name not in FOLLOWED)
            shaped = tuple(name for name in names if name in FOLLOWED)
            self._write(stack, blend, plan.colors, colors)
            moved = self._write(stack, blend, plan.shapes, shaped)
        moved += self._arrange(stack, blend, plan, names, arranged)
        carried = surface.carry(shapes, plan.followers, plan.added, stack, blend)
        moving.update(FOLLOWED)
        if len(plan.banded):
            recolored = plan.recolored if "shN" in moving else plan.recolored[:0]
            surface.turn(self._after["shN"], plan.banded, recolored)
            moving.add("shN")
        names = tuple(name for name in self._before if name in moving)
        return Change(plan.rows, names, max(moved, carried))

    def _release(self, painted: Rows, arranged: Collection[str]) -> None:
        """Write centers of paint as they are without the order of layers, ahead of `_write`.

        Args:
            painted: see `_Plan`. [K]
            arranged: attributes that `_arrange` will write
        """
        if self._paint is not None and "means" in arranged:
            self._paint.release(self._after["means"], painted)

    def _arrange(
        self,
        stack: Sequence[tuple[int, Layer]],
        blend: str,
        plan: _Plan,
        written: Collection[str],
        arranged: Collection[str],
    ) -> float:
        """Put the rows of paint into the order of layers; return the largest change of a row's height.

        Args:
            stack: active layers with the index of their edit, lowest first
            blend: one of `BLENDS`
            plan: the rows
            written: attributes that `_write` has written
            arranged: attributes to write
        """
        if self._paint is None or not arranged:
            return 0.0
        index = plan.painted, plan.arranged
        return self._paint.arrange(self._after, stack, blend, index, (written, arranged))

    def shapes(self) -> Shapes:
        """Return the followed attributes of `gaussians`, which are updated in place. [N,c] each"""
        means, log_scales, quats, logits = (
            self._after[name]
            if name in self._after
            else getattr(self.gaussians, name).float().reshape(len(self._scene), -1).numpy()
            for name in FOLLOWED
        )
        return means, log_scales, quats, logits

    def _write(
        self, stack: Sequence[tuple[int, Layer]], blend: str, members: _Members, names: Sequence[str]
    ) -> float:
        """Write rows before they follow their anchors; return the largest movement of a center."""
        rows = members.rows
        if not len(rows) or not names:
            return 0.0
        active = [layer for _, layer in stack]
        if self._maps_others(stack, blend) or is_averaged_alone(active, blend):
            return self._write_plainly(active, blend, rows, names)
        parts = [self._part(members, edit, layer) for edit, layer in stack if edit in members.parts]
        for edit in {part.edit for part in parts if needs_split(part.layer)}:
            self._split_of(edit)  # ahead of the threads
        count = 1 + len(rows) // CHUNK
        cuts = [len(rows) * part // count for part in range(count + 1)]
        moves = run_chunks(
            lambda chunk: self._rewrite(rows, parts, names, blend, cuts[chunk], cuts[chunk + 1]), count
        )
        if "sh0" in names:
            self._color_discs(stack, members)
        return math.sqrt(max(moves))

    def _color_discs(self, stack: Sequence[tuple[int, Layer]], members: _Members) -> None:
        """Change the colors of painted discs by the gains of their layers, see `disc_changes`."""
        splits = [self._split_of(edit) if needs_split(layer) else None for edit, layer in stack]
        for gdf, change in disc_changes([layer for _, layer in stack], splits):
            index, at = members.parts[self._index[id(gdf)]]
            first = len(gdf.region) - len(change)
            is_disc = index >= first
            self._after["sh0"][members.rows[at[is_disc]]] += change.numpy()[index[is_disc] - first]

    def _maps_others(self, stack: Sequence[tuple[int, Layer]], blend: str) -> bool:
        """Return whether a grade lies over Gaussians of a lower layer and maps their colors."""
        return any(
            self._meet(edit, below)
            for index, (edit, layer) in enumerate(stack)
            for below, _ in stack[:index]
            if layer.gdf.field.kind == "grade" and rule_of(layer, blend) == "adjust"
        )

    def _meet(self, edit: int, other: int) -> bool:
        """Return whether two edits share a Gaussian."""
        pair = min(edit, other), max(edit, other)
        if pair not in self._meets:
            members = self._members[edit], self._members[other]
            self._meets[pair] = len(np.intersect1d(*members, assume_unique=True)) > 0
        return self._meets[pair]

    def _write_plainly(self, layers: Sequence[Layer], blend: str, rows: Rows, names: Sequence[str]) -> float:
        """Write rows with the reference implementation; return the largest movement of a center.

        Other rows are left as they are, because they may follow their anchors or lie in the order of paint.
        """
        covers = {id(gdf): self._coverage_of(edit) for edit, gdf in enumerate(self._gdfs)}
        at, new = changed_rows(
            self._scene,
            layers,
            blend,
            lambda _, gdf: covers[id(gdf)],
            lambda _, gdf: self._split_of(self._index[id(gdf)]),
        )
        changed = at.numpy()
        is_written = np.isin(changed, rows, assume_unique=True)
        written = changed[is_written]
        largest = 0.0
        for name in names:
            before = self._after[name][rows]
            self._after[name][rows] = self._before[name][rows]
            if name in new:
                values = new[name].float().reshape(len(at), -1).numpy()
                self._after[name][written] = values[is_written]
            if name == "means":
                steps = np.square(self._after[name][rows] - before).sum(axis=1)
                largest = math.sqrt(float(steps.max(initial=0.0)))
        return largest

    def _rewrite(
        self,
        rows: Rows,
        parts: Sequence[_LayerSlice],
        names: Sequence[str],
        blend: str,
        first: int,
        last: int,
    ) -> float:
        """Write attributes of `rows[first:last]`; return the largest squared movement of a center."""
        rows = rows[first:last]
        parts = [_between(part, first, last) for part in parts]
        averaged = any(rule_of(part.layer, blend) == "normalized" for part in parts)  # then all of them are
        kinds = {KINDS[name] for name in names} if averaged else ()
        weight_sums = {kind: _weight_sum(parts, kind, len(rows)) for kind in kinds}
        largest = 0.0
        for name in names:
            after = self._after[name]
            total = np.full((len(rows), after.shape[1]), -0.0, np.float32)  # −0 + x keeps the bits of x
            pushing = []
            for part in parts:
                bases = self._bases[part.edit].get(name)
                factors = color_factors(part.layer, name, self._splits.get(part.edit))
                if bases is None or factors == (0.0, 0.0):
                    continue
                if KINDS[name] in part.layer.pushed_kinds:
                    pushing.append(part)
                    continue
                covered = _NO_VALUES
                if rule_of(part.layer, blend) in ORDERED:
                    covered = self._coverage_of(part.edit)[KINDS[name]].numpy()
                gain = min(abs(part.layer.gain(name)), 1.0)
                hidden = np.float32(part.layer.clamped_strength) * np.float32(gain)
                self._add(total, part, name, factors, hidden, covered)
            weight_sum = weight_sums.get(KINDS[name], _NO_VALUES)
            if pushing:
                kept = _kept_pushes(parts, len(rows))
                total = self._add_pushes(total, pushing, name, weight_sum, kept)
                weight_sum = _NO_VALUES
            moved = write_rows(after, self._before[name], rows, total, weight_sum, name == "means")
            largest = max(largest, moved)
        return largest

    def _add(
        self,
        total: Floats,
        part: _LayerSlice,
        name: str,
        gains: tuple[float, float],
        hidden: np.float32,
        covered: Floats,
    ) -> None:
        """Add a layer's offsets of one attribute, and their color part, to the sums.

        `gains`: see `color_factors`; the other arguments are those of `add_offsets`.
        """
        bases = [self._bases[part.edit][name], self._color_part(part.edit, name) if gains[1] else None]
        for each, gain in zip(bases, gains, strict=True):
            if each is None:
                continue
            used, factors = each.factors(part.segment)
            selection = part.at, part.members, part.weights
            stored = (each.end, each.residual)
            add_offsets(total, selection, stored, used, factors, np.float32(gain), hidden, covered)
            hidden = np.float32(0.0)
            covered = _NO_VALUES

    def _color_part(self, edit: int, name: str) -> StoredBases | None:
        """Return the bases of an edit's color apart from its texture; None if this attribute has none."""
        split = self._splits.get(edit)
        parts = {} if split is None or split.color is None else split.color.attributes
        if name in parts and (edit, name) not in self._color_bases:
            self._color_bases[edit, name] = StoredBases.of(parts[name])
        return self._color_bases.get((edit, name))

    def _add_pushes(
        self, total: Floats, parts: Sequence[_LayerSlice], name: str, weight_sum: Floats, kept: Floats
    ) -> Floats:
        """Return the blended sums and the largest change by paint. [U,c]

        Args:
            total: sums of the other layers; overwritten. [U,c]
            parts: members of layers that push them, lowest layer first
            name: attribute
            weight_sum: divisors of the sums; [0] if all are 1. [U]
            kept: share of the changes by paint that remains, 0 to 1. [U]; [0] if all of them remain
        """
        if len(weight_sum):
            total /= weight_sum[:, None]
        largest = np.full(total.shape, -0.0, np.float32)
        is_direct = len(parts) == 1 and not len(kept)  # a single push is the largest one
        for part in parts:
            push = total if is_direct else np.full(total.shape, -0.0, np.float32)
            factors = color_factors(part.layer, name, self._splits.get(part.edit))
            self._add(push, part, name, factors, np.float32(0.0), _NO_VALUES)
            if not is_direct:
                keep_larger(largest, push)
        if len(kept):
            largest *= kept[:, None]
        if not is_direct:
            total += largest
        return total

    def _part(self, members: _Members, edit: int, layer: Layer) -> _LayerSlice:
        weights = _NO_VALUES if layer.weights is None else layer.weights.detach().float().numpy()
        segment = find_segment(layer.gdf.field.knots, layer.strength)
        return _LayerSlice(layer, edit, segment, *members.parts[edit], weights)

    def _plan(self, changed: frozenset[int]) -> _Plan:
        """Return the members of the changed edits, and the members of other edits in the same rows."""
        if changed not in self._plans:
            if len(self._plans) >= 32:  # only a few are in use during a drag
                self._plans.clear()
            chosen = [self._members[edit] for edit in changed]
            members = self._members_in(chosen[0] if len(chosen) == 1 else np.unique(np.concatenate(chosen)))
            plan = _Plan(members.rows, members, members)
            if self._paint is not None:
                plan = _plan_paint(self._paint, plan, changed)
            if self._surface is not None:
                plan = self._plan_followers(self._surface, plan, changed)
            self._plans[changed] = plan
        return self._plans[changed]

    def _members_in(self, rows: Rows) -> _Members:
        """Return rows with the members of every edit among them."""
        parts = {}
        for edit, members in enumerate(self._members):
            _, members_at, at = np.intersect1d(members, rows, assume_unique=True, return_indices=True)
            if len(members_at):
                parts[edit] = np.ascontiguousarray(members_at), np.ascontiguousarray(at)
        return _Members(rows, parts)

    def _plan_followers(self, surface: Surface, plan: _Plan, changed: frozenset[int]) -> _Plan:
        """Return the plan extended by the rows that follow the changed edits."""
        followers = surface.followers
        dependents = [rows for edit in changed if len(rows := surface.dependents(edit))]
        rows = np.unique(np.concatenate([plan.rows, *dependents])) if dependents else plan.rows
        index = np.flatnonzero(np.isin(followers.rows, rows))
        banded = index[np.isin(index, surface.banded)]
        recolored = banded[np.isin(followers.rows[banded], plan.colors.rows)]
        if not any(changes_shape(self._gdfs[edit]) for edit in changed):
            index = index[:0]
        pushed = followers.rows[index[followers.edits[index] < 0]]
        shapes = plan.colors
        # leaving out a few rows would only break the runs of consecutive members
        if 2 * len(pushed) > len(shapes.rows):
            shapes = self._members_in(shapes.rows[~np.isin(shapes.rows, pushed)])
        rewritten = changed if self._paint is None else self._paint.partners(changed)
        written = np.isin(followers.edits[index], list(rewritten)) & np.isin(followers.rows[index], plan.rows)
        added = index[written]
        return plan._replace(
            rows=rows, shapes=shapes, followers=index, added=added, banded=banded, recolored=recolored
        )

    def _coverage_of(self, edit: int) -> Mapping[str, Tensor]:
        if edit not in self._coverage:
            self._coverage[edit] = self._covers(self._scene, self._gdfs[edit])
        return self._coverage[edit]

    def _split_of(self, edit: int) -> ColorSplit | None:
        """Return `color_split` of an edit. It is computed when a layer's gains first divide its color."""
        if edit not in self._splits:
            self._splits[edit] = self._split(self._scene, self._gdfs[edit])
        return self._splits[edit]

    def _check_weights(self, layers: Sequence[Layer]) -> None:
        """Check weights that are new or were modified, see `check_weights`."""
        checked = [(layer.weights, layer.weights._version) for layer in layers if layer.weights is not None]
        for layer in layers:
            is_checked = any(w is layer.weights and version == w._version for w, version in self._checked)
            if not is_checked:
                check_weights(layer)
        self._checked = checked

    def _edit_of(self, gdf: Gdf) -> int:
        try:
            return self._index[id(gdf)]
        except KeyError:
            raise ValueError(
                f"{gdf.name} is not one of the composer's edits; give it to Composer first"
            ) from None


def _plan_paint(paint: PaintOrder, plan: _Plan, changed: frozenset[int]) -> _Plan:
    """Return the plan extended by the rows of paint that depend on the changed edits."""
    dependents = [found for edit in changed if len(found := paint.dependents(edit))]
    rows = np.unique(np.concatenate([plan.rows, *dependents])) if dependents else plan.rows
    painted = np.flatnonzero(np.isin(paint.paint.rows, plan.rows, assume_unique=True))
    arranged = np.flatnonzero(np.isin(paint.paint.rows, rows, assume_unique=True))
    return plan._replace(rows=rows, painted=painted, arranged=arranged)


def _between(part: _LayerSlice, first: int, last: int) -> _LayerSlice:
    """Return a part restricted to the rows from `first` to `last`, with positions relative to `first`."""
    begin, end = np.searchsorted(part.at, (first, last))
    if (first, begin, end) == (0, 0, len(part.at)):
        return part
    return part._replace(members=part.members[begin:end], at=part.at[begin:end] - first)


def _kept_pushes(parts: Sequence[_LayerSlice], count: int) -> Floats:
    """Return the share of the changes by paint that remains in each row. [U]; [0] if all of them remain

    `_kept_pushes` of `progdf.compose.reference` is the plain version.
    """
    leaving = [part for part in parts if part.layer.leaves_paint]
    if not leaving:
        return _NO_VALUES
    kept = np.ones(count, np.float32)
    for part in leaving:
        weights = part.weights[part.members] if len(part.weights) else np.float32(1.0)
        kept[part.at] *= np.float32(1.0) - weights * np.float32(part.layer.clamped_strength)
    return kept


def _weight_sum(parts: Sequence[_LayerSlice], kind: str, count: int) -> Floats:
    """Return max(1, Σ m s) over the layers with a kind of change; empty if it is 1 everywhere. [U]"""
    parts = [part for part in parts if kind in part.layer.blended_kinds]
    # slightly below 1, because float32 sums may round up to more than 1
    if sum(part.layer.clamped_strength for part in parts) <= 1 - 1e-6:
        return _NO_VALUES
    sums = np.zeros(count, np.float32)
    for part in parts:
        weights = part.weights[part.members] if len(part.weights) else np.float32(1.0)
        sums[part.at] += weights * np.float32(part.layer.clamped_strength)
    return np.maximum(sums, np.float32(1.0))
