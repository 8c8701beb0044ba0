"""Edits of colors alone: one map of color for the region, and what single members need beside it.

The map is a least squares over all views (`trainer.optimize.color_views`). What it cannot say is a residual
of the members' lowest bands, by conjugate gradients that know the clamps, each member preconditioned by its
own block of bands and weights, as in tomography: one that is a hundredth of a pixel, or seen from one side,
gets its answer as another does. A member that no view shows follows the map.

How much of this a region gets (degree of the map; no residual, one of DC, of two bands or of three) is
decided on views that are not solved for, at the full strength: the least of which more would take away less
than a twentieth of the error. They also say when a strength has had enough steps.

A handful of pictures (`trainer.optimize.ties`) leaves most members undecided. There neighbors on one surface
have residuals alike, what hardly shines through others is not asked where one picture alone shows it, and how
far a residual travels before it fades into the map is decided on squares of the pictures that are not solved
for.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor
from torch.nn.functional import pad

from progdf.field.baked import MONOMIALS, identity_map
from progdf.field.grade import map_colors, member_bands
from progdf.metrics.image import LEVEL, decibels
from progdf.sh import C0
from progdf.threads import map_threads, one_thread

from .color_views import (
    MORE_PAYS,
    ColorView,
    Judge,
    MapFit,
    add_colors,
    add_pulls,
    fit_maps,
    improve_mask,
    iterate_views,
    mask_of_members,
)
from .ties import Ties

STEPS_OF_OTHERS = 8
"""Steps of an optimizer that looks at one view at a time which one iteration over all views stands for."""

SETTLED = 0.01
"""Share of the error in views not solved for that `LOOKS` steps take away at least, for another to follow."""

BANDS = (1, 4, 9)
"""SH functions of a residual that are tried, each where the one before it was better than less."""

_RIDGE = 0.002  # of a typical member's weight: holds the residual of what hardly shows at 0
_TIES = 0.001  # of a typical member's weight: ties neighbors, where views are few
_TRUSTED = 0.1  # of the same: a member of less is rather as its neighbors are
_HOLDS = (1e-8, 1e-5, 1e-3)  # ridges tried there: a residual goes around all, some way, to its neighbors
_SHOWS = 0.5  # pixels of a member in each of two pictures, from which on these say what it is
_SHARES = (1.0, 0.5, 0.2)  # of a step, where the whole of it would run into clamps

LOOKS = 3
"""Steps over which that is taken: a single one may gain nothing in other views."""


@dataclass(frozen=True)
class Model:
    """How much of an edit of colors is modelled."""

    degree: int  # of the map; 0: none
    hold: float  # of the residual at 0, as a share of a typical member's weight
    residual: Tensor  # of the finished edit: b of 0, 1, 4 or 9 functions. [M,b,3]
    mask: Tensor | None  # see `GradeForm.mask`
    error: float  # mean square, of the finished edit in views not solved for: what is finer is not chased
    tried: Sequence[tuple[str, float]]  # what was tried, and its error on views not solved for, dB
    steps: int  # that all of this took
    most_bands: int  # see `choose_model`; of few pictures 1
    begun: Mapping[float, Tensor] = field(default_factory=dict)  # strength → a residual to begin with there

    @property
    def bands(self) -> int:
        """How many bands the residual has."""
        return self.residual.shape[1]

    @property
    def functions(self) -> float:
        """How many of these a member has, on average."""
        return float(self.residual.any(dim=2).float().sum(dim=1).mean()) if self.bands else 0.0

    def figures(self) -> dict[str, Any]:
        """As report.json has it."""
        return {
            "degree": self.degree,
            "mask": self.mask is not None,
            "sh_functions": self.bands,
            "functions_per_gaussian": round(self.functions, 2),
            "tried_psnr": {name: round(error, 2) for name, error in self.tried},
        }

    @property
    def line(self) -> str:
        """What was chosen and over what, for the log."""
        functions = f"{self.bands} SH function{'s' * (self.bands > 1)}"
        if self.bands > 1 and self.functions < self.bands:
            functions += f", {self.functions:.1f} of them a Gaussian"
        residual = f"and a residual of {functions}" if self.bands else "alone"
        over = ", ".join(f"{name} {error:.1f}" for name, error in self.tried)
        of_color = f"a map of color of degree {self.degree}" if self.degree else "no map"
        of_color += "" if self.mask is None else ", a mask of it"
        rule = "what leaves least" if self.hold in _HOLDS else "the least within a twentieth"
        return f"{of_color} {residual}, {rule}; dB: {over}"


@dataclass(frozen=True)
class _Attempt:
    """What a model leaves in what was not solved for."""

    name: str
    error: float
    solver: Solver  # with the mask
    degree: int
    offsets: Tensor  # what its map adds. [M,B,3]
    residual: Tensor  # [M,b,3]
    hold: float  # see `Model.hold`
    mask_hold: float = 0.0  # how strongly what no picture shows of its mask is held; 0: no mask

    @property
    def bands(self) -> int:
        """See `Model.bands`."""
        return self.residual.shape[1]

    @property
    def change(self) -> Tensor:
        """What map and residual add. [M,B,3]"""
        return add_bands(self.offsets, self.residual)


@dataclass(frozen=True)
class _Pull:
    """What the views say at some residual."""

    descent: Tensor  # against the gradient of half the error. [M,b,3]
    error: float  # squared, with what holds the residual
    drawn: Tensor  # members' channels that a clamp lets through, of each view. [V,M,3] bool
    passed: Sequence[Tensor]  # pixels' of which it does, of each view. [P,3] bool


@dataclass(frozen=True)
class Solver:
    """All training views of a run."""

    views: Sequence[ColorView]  # see `ColorView`
    original: Tensor  # raw member rows, packed. [M,C]
    # bound of the curvature among each member's lowest bands: Σ w·m over the pixels, m its own weight, times
    # the products of the basis. [M,b,b]
    weights: Tensor
    maps: MapFit
    share: Tensor  # how much of a map each member takes, 0..1. [M]
    ties: Ties | None  # None where views are many
    asked: Tensor  # which members' functions are solved for. [M,b] bool
    held: csr_matrix  # ties among these, as strong as they are to be. [M,M]

    @cached_property
    def sh(self) -> Tensor:
        """The members' own. [M,B,3]"""
        return member_bands(self.original)

    def fit_map(self, degree: int, targets: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """The map that comes nearest to these pictures, of degree 0 the identity, and what the members take
        of it. [K,3], [M,B,3]"""
        table = self.maps.solve(degree, targets) if degree else identity_map(1)
        return table, self.map_offsets(degree, table)

    def map_offsets(self, degree: int, table: Tensor) -> Tensor:
        """What the members take of a map. [K,3] -> [M,B,3]"""
        return self.share[:, None, None] * (map_colors(self.sh, table, max(1, degree)) - self.sh)

    def with_mask(self, share: Tensor) -> Solver:
        """The same with a mask. [M] 0..1"""
        return replace(self, maps=fit_maps(self.views, share), share=share)

    def guess_mask(self, change: Tensor, spreads: bool, hold: float) -> Solver:
        """The same with the mask that the members' changes ask for.

        Args:
            change: a guess. [M,B,3]
            spreads: whether what no picture shows takes as much of the map as most, else none
            hold: how strongly it is held to that, see `_HOLDS`
        """
        weights = self.weights[:, 0, 0]
        share = mask_of_members(self.sh[:, 0] * C0 + 0.5, change[:, 0] * C0, weights)
        if self.ties is not None:
            mean = weights @ share / weights.sum() * spreads
            say = self.asked[:, 0] * weights / (_TRUSTED * self.typical)
            share = mean + self.ties.spread((share - mean)[:, None, None], say, hold / _TIES)[:, 0, 0]
        return self.with_mask(share.clamp(0.0, 1.0))

    def improve_mask(self, targets: Sequence[Tensor]) -> Solver:
        """The same with the mask that these pictures of the views ask for, in 255ths."""
        full = map_colors(self.sh, self.maps.solve(1, targets), 1) - self.sh
        share = torch.where(self.asked[:, 0], improve_mask(self.views, full, self.share, targets), self.share)
        return self.with_mask((share * 255.0).round() / 255.0)

    def only(self, residual: Tensor) -> Solver:
        """The same for residuals that are 0 beyond DC where this one is. [M,b,3]"""
        asked = self.asked.clone()
        asked[:, 1 : residual.shape[1]] &= residual[:, 1:].any(dim=2)
        return replace(self, asked=asked)

    def halve(self, residuals: Sequence[Tensor]) -> list[Tensor]:
        """Residuals without the half of what they have beyond DC that adds least to the pictures. [M,b,3]"""
        size = torch.stack([one[:, 1:].square().sum(dim=2) for one in residuals]).sum(dim=0)
        adds = size * self.weights.diagonal(dim1=1, dim2=2)[:, 1 : 1 + size.shape[1]]
        kept = adds > adds[adds > 0.0].median()
        return [torch.cat([one[:, :1], one[:, 1:] * kept[..., None]], dim=1) for one in residuals]

    @one_thread()  # sums of members are added in an order that depends on the number of threads
    def residual(
        self,
        mapped: Tensor,
        start: Tensor,
        targets: Sequence[Tensor],
        steps: int,
        judge: Judge | None = None,
        floor: float = 0.0,
        hold: float = _RIDGE,
        tell: Callable[[], None] = lambda: None,
    ) -> tuple[Tensor, int]:
        """What the members' lowest bands need beside the map: preconditioned conjugate gradients (Polak and
        Ribière) that look at every step anew what the clamps pass; and the steps that were taken.

        Args:
            mapped: what the map adds. [M,B,3]
            start: a guess. [M,b,3]
            targets: pictures of the views
            steps: most steps
            judge: the best in its views is kept, and steps end when they gain little there, see `SETTLED`, or
                what is left does not show; None takes all
            floor: error in these views that counts as none, see `Model.error`; one of `LEVEL` always does
            hold: see `Model.hold`
            tell: called after each step
        """
        ridge = hold * self.typical
        targets = [view.pick(target) for view, target in zip(self.views, targets, strict=True)]
        look = None if judge is None else lambda now: judge.error(add_bands(mapped, now))
        asked = self.asked[:, : start.shape[1], None]
        residual, first = self._descend(mapped, start * asked, targets, ridge, steps, tell, look, floor)
        if self.ties is None:
            return residual, first
        weights = self.asked[:, 0] * self.weights[:, 0, 0] / (_TRUSTED * self.typical)
        around = self.ties.spread(residual, weights, hold / _TIES)
        residual, more = self._descend(mapped, around * asked, targets, ridge, steps, tell, look, floor)
        return torch.where(asked, residual, around), first + more

    def _descend(
        self,
        mapped: Tensor,
        start: Tensor,
        targets: Sequence[Tensor],
        ridge: float,
        steps: int,
        tell: Callable[[], None],
        look: Callable[[Tensor], float] | None,
        floor: float,
    ) -> tuple[Tensor, int]:
        """See `residual`; `look`: the judge's error."""
        count = start.shape[1]
        held = torch.from_numpy(self.held.diagonal()) + max(ridge, 1e-30)
        asked = self.asked[:, :count, None] & self.asked[:, None, :count]
        curvature = self.weights[:, :count, :count] * asked + held[:, None, None] * torch.eye(count)
        inverse = torch.linalg.inv(curvature.double()).float() * asked
        now = start
        pull = self._pull(mapped, start, targets, ridge)
        conditioned = along = inverse @ pull.descent
        best = now
        taken = 0
        looks = [math.inf] * (LOOKS - 1) + [math.inf if look is None else look(now)]
        while taken < steps:
            length = _inner(pull.descent, along) / max(self._curvature(pull, along, ridge), 1e-30)
            for share in _SHARES:
                ahead = now + share * length * along
                next_pull = self._pull(mapped, ahead, targets, ridge)
                if next_pull.error < pull.error:
                    break
            else:
                if along is conditioned:
                    break
                along = conditioned  # the direction was of other clamps: begin again
                continue
            last = conditioned
            power = _inner(pull.descent, conditioned)
            now = ahead
            pull = next_pull
            taken = taken + 1
            if look is not None:
                error = look(now)
                best = now if error < min(looks) else best
                looks.append(error)
                settled = looks[-1 - LOOKS] - error <= SETTLED * max(error, floor, LEVEL)
                if settled or error <= LEVEL:
                    break
            conditioned = inverse @ pull.descent
            turn = (_inner(pull.descent, conditioned) - _inner(pull.descent, last)) / power
            along = conditioned + max(0.0, turn) * along
            tell()
        return (now if look is None else best), taken

    @property
    def typical(self) -> float:
        """The mean weight of the members that are asked."""
        return float(self.weights[self.asked[:, 0], 0, 0].mean())

    def _hold(self, x: Tensor, ridge: float) -> Tensor:
        """The gradient of half of what a residual costs beside the pixels. [M,b,3] -> [M,b,3]"""
        return ridge * x + torch.from_numpy(self.held @ x.flatten(1).numpy()).view_as(x)

    def _pull(self, mapped: Tensor, residual: Tensor, targets: Sequence[Tensor], ridge: float) -> _Pull:
        """See `_Pull`."""
        offsets = add_bands(mapped, residual)
        drawn = torch.empty(len(self.views), len(residual), 3, dtype=torch.bool)

        def look(index: int) -> tuple[Tensor, Tensor, float]:
            colors = self.views[index].colors(offsets)
            pull, passed, squared = self.views[index].pull(colors, targets[index])
            np.logical_or(colors.numpy() > 0.0, pull.numpy() > 0.0, out=drawn[index].numpy())
            return passed, pull.mul_(drawn[index]), squared

        descent = -self._hold(residual, ridge)
        all_passed = list[Tensor]()
        error = _inner(residual, self._hold(residual, ridge))
        looks = iterate_views(look, range(len(self.views)))
        for view, (passed, pull, squared) in zip(self.views, looks, strict=True):
            add_pulls(view.basis.numpy(), pull.numpy(), descent.numpy())
            error += squared
            all_passed.append(passed)
        return _Pull(descent, error, drawn, all_passed)

    def _curvature(self, pull: _Pull, along: Tensor, ridge: float) -> float:
        """Of half the squared error in a direction, where the clamps stay as they are. [M,b,3]"""

        def look(index: int) -> float:
            view = self.views[index]
            colors = np.zeros(pull.drawn.shape[1:], np.float32)
            add_colors(view.basis.numpy(), along.numpy(), colors)
            picture = view.map.picture(torch.from_numpy(colors * pull.drawn[index].numpy()))
            return float((picture * pull.passed[index]).square().sum())

        return sum(map_threads(look, range(len(self.views)))) + _inner(along, self._hold(along, ridge))


def make_solver(views: Sequence[ColorView], original: Tensor, ties: Ties | None = None) -> Solver:
    """The views, prepared. `original`: raw member rows [M,14+]; `ties`: where the views are few."""
    ones, weights = original.new_ones(len(original), 3), torch.zeros(())
    weighed = iterate_views(lambda view: view.map.gradient(view.map.picture(ones) * view.counts)[:, 0], views)
    for view, weight in zip(views, weighed, strict=True):
        bands = view.basis[:, : BANDS[-1]]
        weights = weights + (weight[:, None] * bands)[:, :, None] * bands[:, None]
    asked = torch.ones(len(original), weights.shape[1], dtype=torch.bool)
    held = csr_matrix((len(original), len(original)), dtype=np.float32)
    if ties is not None:
        shown = torch.stack(map_threads(lambda view: view.map.gradient(view.counts * ones[:1])[:, 0], views))
        twice = (shown > _SHOWS).sum(dim=0) > 1
        some = (ties.clear | twice) & (weights[:, 0, 0] > 0.0)
        held = ties.of(some) * np.float32(_TIES * float(weights[some, 0, 0].mean()))
        asked = some[:, None].expand_as(asked)
    share = original.new_ones(len(original))
    return Solver(views, original, weights, fit_maps(views, share), share, ties, asked, held)


def split_solver(solver: Solver, targets: Sequence[Tensor]) -> tuple[Solver, Judge]:
    """A trial for `choose_model` where no view is held out: some squares of all views, and the others."""
    some, others = zip(*(view.halves() for view in solver.views), strict=True)
    return make_solver(some, solver.original, solver.ties), Judge(others, targets)


@dataclass
class _Trials:
    """What is tried, on views or pixels that the solver does not know."""

    solver: Solver
    judge: Judge
    targets: Sequence[Tensor]  # the finished edit in the solver's views
    most_steps: int  # of conjugate gradients for a residual
    few: bool  # whether views are few
    residuals: Sequence[tuple[str, int, float]]  # that are tried: name, functions and hold
    tried: list[_Attempt] = field(default_factory=list)
    steps: int = 0  # that all of these took

    def start(self, degree: int, solver: Solver) -> _Attempt:
        """A map alone, not judged."""
        offsets = solver.fit_map(degree, self.targets)[1]
        name = f"map of degree {degree}" if degree else "no map"
        return _Attempt(name, math.inf, solver, degree, offsets, offsets[:, :0], _RIDGE)

    def attempt(self, base: _Attempt, name: str, bands: int, hold: float) -> _Attempt:
        """With a residual that begins where that of `base` ended."""
        residual = pad(base.residual[:, :bands], (0, 0, 0, max(0, bands - base.bands)))
        if bands:
            residual, taken = base.solver.residual(
                base.offsets, residual, self.targets, self.most_steps, self.judge, hold=hold
            )
            self.steps += taken
        made = replace(base, name=name, residual=residual, hold=hold)
        self.tried.append(replace(made, error=self.judge.error(made.change)))
        return self.tried[-1]

    def try_masks(self, best: _Attempt, alone: float) -> _Attempt:
        """The best with a mask, where one pays: residual for residual beside what there is without.

        Of a few pictures a mask goes all around what they do not show, or to its neighbors, whatever its
        residual does there.

        `alone`: what maps alone leave
        """
        without = {one.bands: one.error for one in sorted(self.tried, key=lambda one: -one.error)}
        enough = alone * (without.get(1, alone) / alone) ** (1 / 3)  # what one of the three bytes of DC does
        # a mask asks what a residual that goes all around says of each member
        tried = [best]
        guess = (self.tried[-len(_HOLDS)] if self.few else best).change
        for hold in (_HOLDS[0], _HOLDS[-1]) if self.few else (_RIDGE,):
            solver = best.solver.guess_mask(guess, best.degree > 0, hold)
            if min(self.judge.error(self.start(degree, solver).offsets) for degree in MONOMIALS) >= enough:
                continue
            solver = solver.improve_mask(self.targets)
            bases = [replace(self.start(degree, solver), mask_hold=hold) for degree in MONOMIALS]
            masked = [self.attempt(base, f"a mask of degree {base.degree}", 0, best.hold) for base in bases]
            base = bases[_least(masked, lambda one: one.degree).degree - 1]
            base = replace(base, residual=(guess - base.offsets)[:, :1])
            tried += [] if self.few else masked  # of a few pictures no mask alone
            for name, bands, held in self.residuals:
                base = self.attempt(base, f"with a mask and {name}", bands, held)
                tried.append(base)
                if not self.few and not LEVEL < base.error < MORE_PAYS * without.get(bands, 0.0):
                    break
        # by the bytes of a member, of one basis: degrees take none
        size = (lambda one: one.error) if self.few else (lambda one: 3 * one.bands + (one.mask_hold > 0.0))
        return _least(tried, size, LEVEL)


def choose_model(
    solver: Solver,
    trial: tuple[Solver, Judge],
    targets: Sequence[Tensor],
    steps: int,
    most_bands: int,
) -> tuple[Solver, Model]:
    """The smallest model of which a larger one would take away less than a twentieth of the error that shows;
    and the solver with its mask.

    Of a few pictures there is always a residual, or what single members got would not be in the edit; how far
    it travels, with a mask and without, is what leaves least; if all leave as much, to its neighbors.

    Args:
        solver: the views
        trial: a solver to try it with, and views or pixels that it does not know; see `split_solver`
        targets: the finished edit in the solver's views
        steps: most steps of conjugate gradients for a residual
        most_bands: SH functions that a residual may have: 1, 4 or 9
    """
    few = solver.ties is not None
    most_bands = min(most_bands, 1 if few else solver.sh.shape[1])
    sizes = [(f"a residual of {bands}", bands, _RIDGE) for bands in BANDS if bands <= most_bands]
    held = [(f"a residual held by {hold:g}", 1, hold) for hold in _HOLDS]
    tries = _Trials(*trial, targets, steps, few, held if few else sizes)
    bases = {degree: tries.start(degree, tries.solver) for degree in (0, *MONOMIALS)}
    missed = {degree: tries.judge.mean(base.offsets, 1.0) for degree, base in bases.items()}
    # of what no picture shows a map is a guess: where it is the worse one for most that is shown, for less
    # than about half of that is painted, there is none
    degrees = (0,) if few and missed[0] <= min(missed.values()) else MONOMIALS
    by_degree = [tries.attempt(bases[degree], bases[degree].name, 0, _RIDGE) for degree in degrees]
    best = last = _least(by_degree, lambda one: one.degree)
    for name, bands, hold in tries.residuals:
        last = tries.attempt(last, f"with {name}", bands, hold)
        if last.error >= best.error and not few:
            break
        if max(last.error, LEVEL) < MORE_PAYS * best.error:
            best = last
    if few:
        best = min(tries.tried[-len(held) :], key=lambda one: (one.error, -one.hold))
    if best.bands and (few or best.bands > 1 or best.error > LEVEL):
        alone = min(tries.judge.error(bases[degree].offsets) for degree in MONOMIALS)
        best = tries.try_masks(best, alone)
    chosen = best.solver
    residual = best.residual
    if few:  # what no picture shows follows the map, masked or not
        chosen, residual = _solve_whole(solver, best, targets, steps, degrees != (0,))
    mask = (chosen.share * 255.0).round().to(torch.uint8) if best.mask_hold else None
    tried = [(one.name, decibels(one.error)) for one in tries.tried]
    return chosen, Model(best.degree, best.hold, residual, mask, best.error, tried, tries.steps, most_bands)


def solve_again(
    model: Model, solver: Solver, targets: Sequence[Tensor], judge: Judge
) -> tuple[Solver, Model]:
    """The model, solved for from other views, in as many steps: these, with its mask, and what comes of it.

    Args:
        model: what the finished edit called for
        solver: the views
        targets: the finished edit in these
        judge: views not solved for
    """
    solver = solver if model.mask is None else solver.with_mask(model.mask.float() / 255.0)
    mapped = solver.fit_map(model.degree, targets)[1]
    residual = torch.zeros_like(model.residual)
    if model.bands:
        residual, _ = solver.residual(mapped, residual, targets, model.steps, judge, hold=model.hold)
    return solver, replace(model, residual=residual, error=judge.error(add_bands(mapped, residual)))


def _solve_whole(
    solver: Solver, best: _Attempt, targets: Sequence[Tensor], steps: int, spreads: bool
) -> tuple[Solver, Tensor]:
    """What the trial solved for a part of the pixels, with all of them: the solver with its mask, and the
    residual. [M,1,3]"""
    if best.mask_hold:
        solver = solver.guess_mask(best.change, spreads, best.mask_hold).improve_mask(targets)
    made = solver.fit_map(best.degree, targets)[1]
    begin = (best.change - made)[:, :1] if best.mask_hold else torch.zeros_like(best.residual)
    judge = Judge(solver.views, targets)
    return solver, solver.residual(made, begin, targets, steps, judge, best.error, best.hold)[0]


def _least(attempts: Sequence[_Attempt], size: Callable[[_Attempt], float], floor: float = 0.0) -> _Attempt:
    """The smallest within a twentieth of the least error, or of an error that does not show."""
    least = max(floor, min(one.error for one in attempts))
    return min((one for one in attempts if MORE_PAYS * one.error <= least), key=size)


def _inner(a: Tensor, b: Tensor) -> float:
    return float((a * b).double().sum())


def add_bands(offsets: Tensor, residual: Tensor) -> Tensor:
    """Offsets with a residual of their lowest bands added. [M,B,3], [M,b,3] -> [M,B,3]"""
    total = offsets.clone()
    total[:, : residual.shape[1]] += residual
    return total


def iterations(steps: int) -> int:
    """Most steps of conjugate gradients for `--steps` of one view each."""
    return max(1, round(steps / STEPS_OF_OTHERS))
