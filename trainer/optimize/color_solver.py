"""Solver for edits that change only colors: one color map for the region, and a residual for single members.

The map is a least-squares fit over all views (`trainer.optimize.color_views`). The remainder is a residual of
the members' lowest SH bands, found by conjugate gradients that respect the clamps. The preconditioner is
block-Jacobi: each member has its own block of bands and weights, as in tomography. A member that covers a
hundredth of a pixel, or is visible from one side only, therefore converges as fast as any other. A member
that is not visible in any view follows the map.

The size of the model (degree of the map; no residual, or one of DC, of two bands or of three) is chosen at
full strength on held-out views: the smallest model that no larger one improves by at least 5 %. The held-out
views also decide when a strength has had enough steps.

A small number of pictures (`trainer.optimize.ties`) leaves most members undetermined. Then:

- neighbors on one surface have similar residuals;
- members that are almost hidden in every picture are not solved for unless they are large in two of them;
- the distance over which a residual spreads before it fades into the map is chosen on held-out tiles of the
  pictures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor
from torch.nn.functional import pad

from progdf.field.baked import MONOMIALS, identity_map
from progdf.field.grade import map_colors, member_bands
from progdf.metrics.image import LEVEL, decibels, round_to_8_bits
from progdf.sh import C0
from progdf.system.equality import equal_fields
from progdf.threads import one_thread
from trainer.options import Quality
from trainer.quality import QUALITIES, QualityLimits

from . import color_tensors
from .color_kernels import add_curvature, add_gradients, apply_blocks, inner_product, invert_blocks
from .color_model import TIED_RIDGES
from .color_model import Model as Model
from .color_tensors import Scalar, add_scaled, at_least_zero, divide, map_views, read_number
from .color_views import (
    MAX_ERROR_SHARE,
    ColorEvaluator,
    ColorView,
    MapFit,
    add_bands,
    camera_centers,
    fit_maps,
    improve_mask,
    iterate_views,
    mask_of_members,
    shade,
    view_blocks,
)
from .ties import Ties

VIEW_STEPS_PER_ITERATION = 8
"""Number of single-view optimizer steps that one iteration over all views replaces."""

MIN_GAIN_SHARE = 0.01
"""Minimum share of the held-out error that `GAIN_WINDOW_STEPS` steps must remove, or the steps end."""

BANDS = (1, 4, 9)
"""Numbers of SH functions to try for the residual.

Each is tried only if the one before it was an improvement.
"""

# share of a typical member's weight; pulls the residual of hardly visible members to 0
_RESIDUAL_RIDGE = 0.002
_TIE_WEIGHT = 0.001  # share of a typical member's weight; ties neighbors if there are few views
_TRUSTED_WEIGHT = 0.1  # share of the same weight; a member with less follows its neighbors
_DETERMINED_PX = 0.5  # pixels; a member this large in two pictures is determined by them
_STEP_FRACTIONS = (1.0, 0.5, 0.2)  # fractions of a step to try if the full step runs into clamps

GAIN_WINDOW_STEPS = 3
"""Number of steps over which the gain is measured. A single step may gain nothing in held-out views."""


@dataclass(frozen=True)
class _Candidate:
    """One candidate model with its error on held-out views or pixels."""

    __eq__ = equal_fields

    name: str
    error: float
    solver: Solver  # solver, with the mask if any
    degree: int
    offsets: Tensor  # change by the map. [M,B,3]
    residual: Tensor  # [M,b,3]
    hold: float  # see `Model.hold`
    mask_hold: float = 0.0  # ridge of the mask for members not visible in any picture; 0: no mask

    @property
    def bands(self) -> int:
        """See `Model.bands`."""
        return self.residual.shape[1]

    @property
    def change(self) -> Tensor:
        """Change by map and residual. [M,B,3]"""
        return add_bands(self.offsets, self.residual)


@dataclass(frozen=True)
class _Gradient:
    """Gradient and error of the training views at one residual."""

    __eq__ = equal_fields

    descent: Tensor  # negative gradient of half the squared error. [M,b,3]
    error: float  # squared error, including the ridge and the ties
    drawn: Tensor  # members' channels that the clamps let through, per view. [V,M,3] bool
    passed: Sequence[Tensor]  # pixels' channels that the clamps let through, per view. [P,3] bool


@dataclass(frozen=True)
class Solver:
    """Least-squares solver over all training views of a run."""

    __eq__ = equal_fields

    views: Sequence[ColorView]  # training views
    original: Tensor  # raw member rows, packed. [M,C]
    # Upper bound of the curvature among each member's lowest bands: the sum over pixels of the member's
    # weight times the total weight of all members, times the products of its basis values. [M,b,b]
    weights: Tensor
    maps: MapFit
    share: Tensor  # each member's share of the map (the mask), 0..1. [M]
    ties: Ties | None  # None if there are many views
    asked: Tensor  # functions of the members to solve for. [M,b] bool
    held: csr_matrix  # ties among these members, scaled to their final strength. [M,M]

    @cached_property
    def sh(self) -> Tensor:
        """SH coefficients of the original members. [M,B,3]"""
        return member_bands(self.original)

    def fit_map(self, degree: int, targets: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the map of a degree that fits these pictures best, and the change of the members by it.

        Degree 0 is the identity. -> [K,3], [M,B,3]
        """
        table = self.maps.solve(degree, targets) if degree else identity_map(1)
        return table, self.map_offsets(degree, table)

    def map_offsets(self, degree: int, table: Tensor) -> Tensor:
        """Return the change of the members by a map, scaled by the mask. [K,3] -> [M,B,3]"""
        table = table.to(self.sh)
        return self.share[:, None, None] * (map_colors(self.sh, table, max(1, degree)) - self.sh)

    def with_mask(self, share: Tensor) -> Solver:
        """Return the solver with a mask. [M] 0..1"""
        return replace(self, maps=fit_maps(self.views, share), share=share)

    def guess_mask(self, change: Tensor, spreads: bool, hold: float) -> Solver:
        """Return the solver with a mask estimated from the members' changes.

        Args:
            change: estimated change. [M,B,3]
            spreads: members not visible in any picture take the mean share of the map (True) or none
                (False)
            hold: ridge towards that share, see `TIED_RIDGES`
        """
        weights = self.weights[:, 0, 0]
        share = mask_of_members(self.sh[:, 0] * C0 + 0.5, change[:, 0] * C0, weights)
        if self.ties is not None:
            mean = weights @ share / weights.sum() * spreads
            confidence = self.asked[:, 0] * weights / (_TRUSTED_WEIGHT * self.typical)
            share = (
                mean
                + self.ties.spread((share - mean)[:, None, None], confidence, hold / _TIE_WEIGHT)[:, 0, 0]
            )
            share = self.ties.limit(share)
        return self.with_mask(share.clamp(0.0, 1.0))

    def improve_mask(self, targets: Sequence[Tensor]) -> Solver:
        """Return the solver with the mask that fits these pictures of the views best, in steps of 1/255."""
        full = map_colors(self.sh, self.maps.solve(1, targets), 1) - self.sh
        share = torch.where(self.asked[:, 0], improve_mask(self.views, full, self.share, targets), self.share)
        return self.with_mask(round_to_8_bits(share))

    def only(self, residual: Tensor) -> Solver:
        """Return the solver for residuals that stay 0 beyond DC where this one is 0. [M,b,3]"""
        free = self.asked.clone()
        free[:, 1 : residual.shape[1]] &= residual[:, 1:].any(dim=2)
        return replace(self, asked=free)

    def halve(self, residuals: Sequence[Tensor]) -> list[Tensor]:
        """Return residuals without the half of the functions beyond DC that contributes least. [M,b,3]"""
        power = torch.stack([one[:, 1:].square().sum(dim=2) for one in residuals]).sum(dim=0)
        contribution = power * self.weights.diagonal(dim1=1, dim2=2)[:, 1 : 1 + power.shape[1]]
        retained = contribution > contribution[contribution > 0.0].median()
        return [torch.cat([one[:, :1], one[:, 1:] * retained[..., None]], dim=1) for one in residuals]

    @one_thread()  # sums of members are added in an order that depends on the number of threads
    def residual(
        self,
        mapped: Tensor,
        start: Tensor,
        targets: Sequence[Tensor],
        steps: int,
        judge: ColorEvaluator | None = None,
        floor: float = 0.0,
        hold: float = _RESIDUAL_RIDGE,
        tell: Callable[[], None] = lambda: None,
    ) -> tuple[Tensor, int]:
        """Solve for the residual of the members' lowest bands. Return it and the number of steps.

        The method is preconditioned conjugate gradients (Polak and Ribière). Every step evaluates the clamps
        again.

        Args:
            mapped: change by the map. [M,B,3]
            start: initial residual. [M,b,3]
            targets: pictures of the views
            steps: maximum number of steps
            judge: evaluator on held-out views; the best residual there is returned, and steps end when they
                gain little there (see `MIN_GAIN_SHARE`) or the remaining error is invisible. None: take all
                steps
            floor: held-out error below which no gain is sought, see `Model.error`; at least `LEVEL`
            hold: see `Model.hold`
            tell: called after each step
        """
        ridge = hold * self.typical
        targets = [view.pick(target) for view, target in zip(self.views, targets, strict=True)]
        held_out_error = None if judge is None else lambda now: judge.error(add_bands(mapped, now))
        free = self.asked[:, : start.shape[1], None]
        residual, taken = self._descend(
            mapped, start * free, targets, ridge, steps, tell, held_out_error, floor
        )
        if self.ties is None:
            return residual, taken
        weights = self.asked[:, 0] * self.weights[:, 0, 0] / (_TRUSTED_WEIGHT * self.typical)
        spread = self.ties.spread(residual, weights, hold / _TIE_WEIGHT)
        residual, further = self._descend(
            mapped, spread * free, targets, ridge, steps, tell, held_out_error, floor
        )
        return torch.where(free, residual, self.ties.limit(spread)), taken + further

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
        """Run conjugate gradients (see `residual`). `look` returns the held-out error of a residual."""
        count = start.shape[1]
        precondition = self._preconditioner(count, max(ridge, 1e-30))

        current = start
        gradient = self._gradient(mapped, start, targets, ridge)
        preconditioned = direction = precondition(gradient.descent)
        best = current
        taken = 0
        errors = [math.inf] * GAIN_WINDOW_STEPS
        if look is not None:
            errors[-1] = look(current)
        while taken < steps:
            decrease = _inner_product(gradient.descent, direction)
            step_length = divide(decrease, self._curvature(gradient, direction, ridge))
            for fraction in _STEP_FRACTIONS:
                candidate = add_scaled(current, direction, fraction * step_length)
                next_gradient = self._gradient(mapped, candidate, targets, ridge)
                if next_gradient.error < gradient.error:
                    break
            else:
                if direction is preconditioned:
                    break
                direction = preconditioned  # the direction was found under other clamps: restart
                continue
            previous = preconditioned
            power = _inner_product(gradient.descent, preconditioned)
            current = candidate
            gradient = next_gradient
            taken = taken + 1
            if look is not None:
                error = look(current)
                best = current if error < min(errors) else best
                errors.append(error)
                settled = errors[-1 - GAIN_WINDOW_STEPS] - error <= MIN_GAIN_SHARE * max(error, floor, LEVEL)
                if settled or error <= LEVEL:
                    break
            preconditioned = precondition(gradient.descent)
            beta = (
                _inner_product(gradient.descent, preconditioned) - _inner_product(gradient.descent, previous)
            ) / power
            direction = add_scaled(preconditioned, direction, at_least_zero(beta))
            tell()
        return (current if look is None else best), taken

    def _preconditioner(self, count: int, ridge: float) -> Callable[[Tensor], Tensor]:
        """Return the product with the inverse blocks of the members' lowest `count` functions."""
        asked = self.asked[:, :count].contiguous()
        if not asked.is_cpu:
            diagonal = self.weights.new_full((len(asked),), ridge)
            blocks = color_tensors.invert_blocks(self.weights, asked, diagonal)
            return blocks.matmul
        inverse = invert_blocks(self.weights.numpy(), asked.numpy(), self.held.diagonal() + np.float32(ridge))

        def precondition(descent: Tensor) -> Tensor:
            preconditioned = torch.empty_like(descent)
            apply_blocks(inverse, descent.numpy(), preconditioned.numpy())
            return preconditioned

        return precondition

    @property
    def typical(self) -> float:
        """Mean weight of the members that are solved for."""
        return float(self.weights[self.asked[:, 0], 0, 0].mean())

    def _regularize(self, x: Tensor, ridge: float) -> Tensor:
        """Return the gradient of half the regularization of a residual. [M,b,3] -> [M,b,3]"""
        if not self.held.nnz:
            return ridge * x
        return ridge * x + torch.from_numpy(self.held @ x.flatten(1).numpy()).view_as(x)

    def _gradient(
        self, mapped: Tensor, residual: Tensor, targets: Sequence[Tensor], ridge: float
    ) -> _Gradient:
        """Return the gradient and the error at a residual."""
        sh = add_bands(self.sh + mapped, residual)
        means = self.views[0].members.means
        drawn = torch.empty(len(self.views), len(residual), 3, dtype=torch.bool, device=means.device)
        descent = self._regularize(residual, ridge).neg_()
        all_passed = list[Tensor]()
        error = -_inner_product(residual, descent)
        for block in view_blocks(list(zip(self.views, targets, drawn, strict=True))):
            views = [view for view, _, _ in block]
            items = list(zip(block, shade(views, sh), strict=True))
            looks = map_views(
                lambda item: item[0][0].pull_drawn(item[1], *item[0][1:]), items, residual.device
            )
            negative, passed, squared = zip(*looks, strict=True)
            all_passed += passed
            error += sum(squared)
            centers = camera_centers(views)
            by_color = torch.stack(negative)
            if means.is_cpu:
                add_gradients(means.numpy(), centers.numpy(), by_color.numpy(), descent.numpy())
            else:
                color_tensors.add_gradients(means, centers, by_color, descent)
        return _Gradient(descent, read_number(error), drawn, all_passed)

    def _curvature(self, pull: _Gradient, along: Tensor, ridge: float) -> Scalar:
        """Return the curvature of half the squared error along a direction [M,b,3], with fixed clamps."""
        curvature: Scalar = 0.0
        clamps = list(zip(self.views, pull.drawn, pull.passed, strict=True))
        for block in view_blocks(clamps):
            changes = shade([view for view, _, _ in block], along, 0.0, -math.inf)
            items = list(zip(block, changes, strict=True))
            curvature += sum(
                map_views(lambda item: item[0][0].power(item[1], *item[0][1:]), items, along.device)
            )
        return curvature + _inner_product(along, self._regularize(along, ridge))


def _inner_product(a: Tensor, b: Tensor) -> Scalar:
    """Return Σ a · b of two float32 tensors of one shape, summed in float64 on their device."""
    return inner_product(a, b) if a.is_cpu else color_tensors.inner_product(a, b)


def make_solver(views: Sequence[ColorView], original: Tensor, ties: Ties | None = None) -> Solver:
    """Prepare a solver for the views.

    Args:
        views: training views
        original: raw member rows. [M,14+]
        ties: ties between neighbors, if there are few views
    """
    ones = original.new_ones(len(original), 3)
    device = original.device
    bands = min(BANDS[-1], views[0].members.sh.shape[1]) if ties is None else 1  # see `choose_model`
    weights = original.new_zeros(len(original), bands, bands, dtype=torch.float32)
    weighed = iterate_views(lambda view: view.map.gradient(view.map.picture(ones) * view.counts)[:, 0], views)
    for view, weight in zip(views, weighed, strict=True):
        if weights.is_cpu:
            add_curvature(view.basis.numpy(), weight.contiguous().numpy(), weights.numpy())
        else:
            color_tensors.add_curvature(view.basis, weight, weights)
    free = torch.ones(len(original), weights.shape[1], dtype=torch.bool, device=device)
    scaled_ties = csr_matrix((len(original), len(original)), dtype=np.float32)
    if ties is not None:
        visible_px = torch.stack(
            map_views(lambda view: view.map.gradient(view.counts * ones[:1])[:, 0], views, device)
        )
        is_determined = (visible_px > _DETERMINED_PX).sum(dim=0) > 1
        solved = (ties.clear | is_determined) & (weights[:, 0, 0] > 0.0)
        scaled_ties = ties.of(solved) * np.float32(_TIE_WEIGHT * float(weights[solved, 0, 0].mean()))
        free = solved[:, None].expand_as(free)
    share = original.new_ones(len(original))
    share = share if ties is None else ties.limit(share)
    return Solver(views, original, weights, fit_maps(views, share), share, ties, free, scaled_ties)


def split_solver(solver: Solver, targets: Sequence[Tensor]) -> tuple[Solver, ColorEvaluator]:
    """Return a trial for `choose_model` that holds out half of the tiles of every view."""
    fitted, held_out = zip(*(view.halves() for view in solver.views), strict=True)
    return make_solver(fitted, solver.original, solver.ties), ColorEvaluator(held_out, targets)


@dataclass
class _ModelSearch:
    """Search for the best model, evaluated on views or pixels that the solver does not use."""

    solver: Solver
    judge: ColorEvaluator
    targets: Sequence[Tensor]  # finished edit in the solver's views
    most_steps: int  # maximum number of conjugate gradient steps per residual
    few: bool  # True if there are few views
    limits: QualityLimits  # steps to larger models
    residuals: Sequence[tuple[str, int, float]]  # residuals to try: name, number of functions and ridge
    tried: list[_Candidate] = field(default_factory=list)
    steps: int = 0  # steps of all candidates

    def start(self, degree: int, solver: Solver) -> _Candidate:
        """Return a candidate with a map alone, not evaluated."""
        offsets = solver.fit_map(degree, self.targets)[1]
        name = f"map of degree {degree}" if degree else "no map"
        return _Candidate(name, math.inf, solver, degree, offsets, offsets[:, :0], _RESIDUAL_RIDGE)

    def attempt(self, base: _Candidate, name: str, bands: int, hold: float) -> _Candidate:
        """Return a candidate with a residual that starts from the residual of `base`."""
        residual = pad(base.residual[:, :bands], (0, 0, 0, max(0, bands - base.bands)))
        if bands:
            residual, taken = base.solver.residual(
                base.offsets, residual, self.targets, self.most_steps, self.judge, hold=hold
            )
            self.steps += taken
        candidate = replace(base, name=name, residual=residual, hold=hold)
        self.tried.append(replace(candidate, error=self.judge.error(candidate.change)))
        return self.tried[-1]

    def try_masks(self, best: _Candidate, alone: float) -> _Candidate:
        """Return the best candidate, with a mask if one pays against the same residual without a mask.

        With few pictures, the mask is spread to all members that are not visible, or to neighbors only,
        independent of the spread of the residual.

        Args:
            best: best candidate without a mask
            alone: error of the best map alone
        """
        errors_without_mask = {one.bands: one.error for one in sorted(self.tried, key=lambda one: -one.error)}
        # a mask costs one byte and DC three, so a mask must bring a third of DC's gain (as a ratio)
        max_error = alone * (errors_without_mask.get(1, alone) / alone) ** (1 / 3)
        tried = [best]
        mask_holds: tuple[float, ...] = (_RESIDUAL_RIDGE,)
        guess = best.change
        if self.few:  # estimate the mask from the residual that spreads everywhere
            mask_holds = (TIED_RIDGES[0], TIED_RIDGES[-1])
            guess = self.tried[-len(TIED_RIDGES)].change
        for hold in mask_holds:
            solver = best.solver.guess_mask(guess, best.degree > 0, hold)
            if min(self.judge.error(self.start(degree, solver).offsets) for degree in MONOMIALS) >= max_error:
                continue
            solver = solver.improve_mask(self.targets)
            bases = [replace(self.start(degree, solver), mask_hold=hold) for degree in MONOMIALS]
            masked = [self.attempt(base, f"a mask of degree {base.degree}", 0, best.hold) for base in bases]
            base = bases[_smallest(masked, lambda one: one.degree).degree - 1]
            base = replace(base, residual=(guess - base.offsets)[:, :1])
            if not self.few:  # with few pictures a mask needs a residual
                tried += masked
            for name, bands, held in self.residuals:
                base = self.attempt(base, f"with a mask and {name}", bands, held)
                tried.append(base)
                max_error = self.limits.max_error_share * errors_without_mask.get(bands, 0.0)
                if not self.few and not LEVEL < base.error < max_error:
                    break
        # size in bytes of a member, with one basis; the degree of the map costs none
        size = (lambda one: one.error) if self.few else (lambda one: 3 * one.bands + (one.mask_hold > 0.0))
        min_error = max(LEVEL, min(one.error for one in tried))
        return min((one for one in tried if self.limits.max_error_share * one.error <= min_error), key=size)


def choose_model(
    solver: Solver,
    trial: tuple[Solver, ColorEvaluator],
    targets: Sequence[Tensor],
    steps: int,
    most_bands: int,
    quality: Quality = "balanced",
) -> tuple[Solver, Model]:
    """Return the solver and the smallest model that no larger one improves by a share of the visible
    error, 5 % by default.

    With few pictures there is always a residual, because changes of single members would otherwise be lost.
    The spread of the residual, with a mask and without, is the one with the smallest error at any quality. If
    all are equal, the residual spreads to neighbors only.

    Args:
        solver: training views
        trial: solver to try models with, and held-out views or pixels; see `split_solver`
        targets: finished edit in the solver's views
        steps: maximum number of conjugate gradient steps per residual
        most_bands: maximum number of SH functions of a residual: 1, 4 or 9
        quality: see `QualityLimits`
    """
    limits = QUALITIES[quality]
    few = solver.ties is not None
    most_bands = min(most_bands, 1 if few else solver.sh.shape[1])
    sizes = [(f"a residual of {bands}", bands, _RESIDUAL_RIDGE) for bands in BANDS if bands <= most_bands]
    tied_residuals = [(f"a residual held by {hold:g}", 1, hold) for hold in TIED_RIDGES]
    search = _ModelSearch(*trial, targets, steps, few, limits, tied_residuals if few else sizes)
    bases = {degree: search.start(degree, search.solver) for degree in (0, *MONOMIALS)}
    mean_errors = {degree: search.judge.mean(base.offsets, 1.0) for degree, base in bases.items()}
    # A map is a guess for members that no picture shows. There is no map if it makes most visible members
    # worse, which happens if less than about half of the region is painted.
    degrees = (0,) if few and mean_errors[0] <= min(mean_errors.values()) else MONOMIALS
    by_degree = [search.attempt(bases[degree], bases[degree].name, 0, _RESIDUAL_RIDGE) for degree in degrees]
    best = last = _smallest(by_degree, lambda one: one.degree)
    # where a residual cannot gain enough above one level of 8 bits, none is solved for
    can_gain = few or limits.max_error_share * best.error > LEVEL
    for name, bands, hold in search.residuals if can_gain else ():
        last = search.attempt(last, f"with {name}", bands, hold)
        if last.error >= best.error and not few:
            break
        if max(last.error, LEVEL) < limits.max_error_share * best.error:
            best = last
    if few:
        best = min(search.tried[-len(tied_residuals) :], key=lambda one: (one.error, -one.hold))
    if best.bands and (few or best.bands > 1 or best.error > LEVEL):
        alone = min(search.judge.error(bases[degree].offsets) for degree in MONOMIALS)
        best = search.try_masks(best, alone)
    chosen = best.solver
    residual = best.residual
    if solver.ties is not None and solver.ties.reach is not None and best.degree:
        best = replace(best, mask_hold=TIED_RIDGES[0])
    if few:  # members that no picture shows follow the map, masked or not
        chosen, residual = _solve_whole(solver, best, targets, steps, degrees != (0,))
    model = Model(
        degree=best.degree,
        hold=best.hold,
        residual=residual,
        mask=(chosen.share * 255.0).round().to(torch.uint8) if best.mask_hold else None,
        error=best.error,
        tried=[(one.name, decibels(one.error)) for one in search.tried],
        steps=search.steps,
        most_bands=most_bands,
        map_error=min(one.error for one in by_degree),
        limits=limits,
    )
    return chosen, model


def solve_again(
    model: Model, solver: Solver, targets: Sequence[Tensor], judge: ColorEvaluator
) -> tuple[Solver, Model]:
    """Solve for a chosen model on other views with the same number of steps. Return the solver and the model.

    Args:
        model: model of the finished edit
        solver: training views
        targets: finished edit in these
        judge: evaluator on held-out views
    """
    solver = solver if model.mask is None else solver.with_mask(model.mask.float() / 255.0)
    mapped = solver.fit_map(model.degree, targets)[1]
    residual = torch.zeros_like(model.residual)
    if model.bands:
        residual, _ = solver.residual(mapped, residual, targets, model.steps, judge, hold=model.hold)
    return solver, replace(model, residual=residual, error=judge.error(add_bands(mapped, residual)))


def _solve_whole(
    solver: Solver, best: _Candidate, targets: Sequence[Tensor], steps: int, spreads: bool
) -> tuple[Solver, Tensor]:
    """Solve for a candidate with all pixels instead of the trial's part of them.

    Return the solver, with its mask if any, and the residual [M,1,3].
    """
    if best.mask_hold:
        solver = solver.guess_mask(best.change, spreads, best.mask_hold).improve_mask(targets)
    map_change = solver.fit_map(best.degree, targets)[1]
    start = (best.change - map_change)[:, :1] if best.mask_hold else torch.zeros_like(best.residual)
    judge = ColorEvaluator(solver.views, targets)
    return solver, solver.residual(map_change, start, targets, steps, judge, best.error, best.hold)[0]


def _smallest(attempts: Sequence[_Candidate], size: Callable[[_Candidate], float]) -> _Candidate:
    """Return the smallest candidate within 5 % of the smallest error."""
    min_error = min(one.error for one in attempts)
    return min((one for one in attempts if MAX_ERROR_SHARE * one.error <= min_error), key=size)


def iterations(steps: int) -> int:
    """Return the maximum number of conjugate gradient steps for `--steps` of one view each."""
    return max(1, round(steps / VIEW_STEPS_PER_ITERATION))
