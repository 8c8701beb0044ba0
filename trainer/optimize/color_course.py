"""Trajectory of a color edit: the strengths to solve for, added until their interpolation is accurate."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

from progdf.field.grade import band_offsets, member_bands
from progdf.metrics.image import LEVEL, decibels

from .color_model import Model
from .color_solver import BANDS, GAIN_WINDOW_STEPS, Solver
from .color_views import MAX_ERROR_SHARE, ColorEvaluator, add_bands
from .pgs import OnStep, ParameterSnapshot, PgsState, TargetStage
from .retime import smooth_weights

STEPS = "steps"
"""Key in a recording's means: number of conjugate gradient steps."""

_MIN_INTERVAL = 1 / 16  # smallest interval between strengths; it is not subdivided further

Target = tuple[TargetStage, ColorEvaluator]
"""Pictures at one strength, and an evaluator on held-out views that decides when they are matched."""


@dataclass
class StrengthSchedule:
    """Strengths to solve for."""

    targets: list[Target]  # in solving order, without the finished edit
    finished: Target
    # evaluator at any other strength; None: no strength can be added
    look: Callable[[float], ColorEvaluator] | None = None
    # makes targets at further strengths
    ask: Callable[[Sequence[float]], Sequence[Target]] | None = None

    def extend(self, known: Mapping[float, tuple[Tensor, float]]) -> bool:
        """Add a strength in the middle of every interval where it pays. Return False if none is added.

        A strength pays if it reduces the error of the whole trajectory (geometric mean over the strengths) by
        at least 5 %. The current error is that of the interpolation in the middle (`smooth_course`). The
        expected error of a solution there is the square of the mean of the root errors at both ends.

        Args:
            known: strength → solution [M,B,3] and its error; includes strengths 0 and 1
        """
        if self.look is None or self.ask is None:
            return False
        strengths = sorted(known)
        offsets = torch.stack([known[s][0] for s in strengths])
        added = list[float]()
        errors = [max(known[s][1], LEVEL) for s in strengths]
        places, weights = smooth_weights(strengths, offsets)
        for i, (begin, end) in enumerate(pairwise(strengths)):
            if end - begin <= _MIN_INTERVAL:
                continue
            smooth = torch.tensordot(weights[2 * i + 1].float(), offsets, 1)
            error = max(self.look(float(places[2 * i + 1])).error(smooth), LEVEL)
            left_root = math.sqrt(errors[i]) if i > 0 else 0.0
            expected = (0.5 * left_root + 0.5 * math.sqrt(errors[i + 1])) ** 2
            if (end - begin) * math.log(error / max(expected, LEVEL)) > -math.log(MAX_ERROR_SHARE):
                added.append((begin + end) / 2)
        if added:
            self.targets += self.ask(added)
        return bool(added)

    def sort_recordings(
        self, made: Sequence[ParameterSnapshot]
    ) -> tuple[list[float], list[ParameterSnapshot]]:
        """Return all strengths, ascending, and the snapshots of `solve` in that order, renumbered."""
        pairs = zip([*(stage.strength for stage, _ in self.targets), 1.0], made, strict=True)
        strengths, recordings = zip(*sorted(pairs, key=lambda pair: pair[0]), strict=True)
        return list(strengths), [replace(snapshot, step=i + 1) for i, snapshot in enumerate(recordings)]


def thin_model(model: Model, solver: Solver, targets: Sequence[Target], steps: int, spare: float) -> Model:
    """Return the model with only those functions beyond DC that members need at the given strengths.

    If the finished edit has no visible error, the next larger number of functions is tried first, for the
    other strengths. Then the half of the functions that contributes least to the pictures is removed, and the
    remainder is solved again. This repeats while the error grows by at most `Model.limits.min_gain`, 5 % by
    default, or while the larger model costs too much beside the smaller one (`QualityLimits.is_too_dear`).

    Args:
        model: model of the finished edit
        solver: training views
        targets: some strengths with held-out evaluators, the finished edit last
        steps: maximum number of conjugate gradient steps
        spare: mean squared error that fewer functions may add beyond 5 %
    """
    more = (count for count in BANDS if model.bands < count <= model.most_bands)
    richer = next(more, 0) if model.error <= LEVEL else 0
    if not model.bands or max(model.bands, richer) < 2:
        return model
    mapped = [solver.fit_map(model.degree, stage.targets)[1] for stage, _ in targets]

    limits = model.limits

    def refine(starts: Sequence[Tensor], most: int) -> tuple[list[Tensor], float, tuple[float, float]]:
        """Return the residuals, the sum of their errors, and the size and PSNR of the finished edit.

        Residuals take at most `most` steps. The size is the mean number of functions per member.

        With `most` equal to `steps`, steps end as soon as they stop helping on the held-out views.
        """
        restricted = solver if most == steps else solver.only(starts[-1])
        refined = list[Tensor]()
        total = 0.0
        for (stage, judge), map_change, start in zip(targets, mapped, starts, strict=True):
            # otherwise it is solved already
            if start.shape[1] > model.bands or most < steps or stage.strength < 1.0:
                evaluator = None if most < steps else judge
                start, _ = restricted.residual(
                    map_change, start, stage.targets, most, evaluator, model.error, model.hold
                )
            refined.append(start)
            error = max(judge.error(add_bands(map_change, start)), LEVEL)
            total += error
        functions = float(refined[-1].any(dim=2).float().sum(dim=1).mean())
        return refined, total, (functions, decibels(error))

    best, min_error, size = refine([stage.strength * model.residual for stage, _ in targets], steps)
    tried = list(model.tried)
    suffix = ", also at other strengths" if len(targets) > 1 else ""
    if richer:
        padded = [pad(one, (0, 0, 0, richer - model.bands)) for one in best]
        refined, error, richer_size = refine(padded, steps)
        tried.append((f"with a residual of {richer}{suffix}", decibels(error / len(targets))))
        if error < limits.max_error_share * min_error:
            best = refined
            min_error = error
            size = richer_size
    thinner = best
    error = min_error
    thinner_size = size
    base = 0.0, decibels(model.map_error)
    while error * limits.max_error_share <= min_error + len(targets) * spare or limits.is_too_dear(
        base, thinner_size, size
    ):
        best = thinner
        size = thinner_size
        min_error = min(min_error, error)
        halved = solver.halve(best)
        if not bool(halved[-1][:, 1:].any()):
            break
        thinner, error, thinner_size = refine(halved, min(GAIN_WINDOW_STEPS, steps - 1))
        tried.append((f"{thinner_size[0]:.1f} of these per Gaussian{suffix}", decibels(error / len(targets))))
    starts_by_strength = {stage.strength: one for (stage, _), one in zip(targets, best, strict=True)}
    return replace(model, residual=best[-1], begun=starts_by_strength, tried=tried)


def solve(
    solver: Solver,
    model: Model,
    course: StrengthSchedule,
    made: Sequence[ParameterSnapshot],
    state: PgsState,
    on_step: OnStep,
    steps: int,
) -> Iterator[ParameterSnapshot]:
    """Solve for the strengths of a schedule and yield a snapshot with its map for each.

    The schedule is extended as needed. Every solution starts from the interpolation of its neighbors.

    Args:
        solver: training views
        model: size of the model
        course: strengths, changed in place
        made: snapshots yielded so far, one per target up to `state.stage`, in any precision; the caller
            appends
        state: state to continue from, changed in place; one step is one stage
        on_step: progress callback; the state is consistent, and may be saved, only during this call
        steps: maximum number of conjugate gradient steps per stage

    Raises:
        FloatingPointError: the loss or the solution is not finite; the state is that of the previous stage.
    """
    finished = ColorEvaluator(solver.views, course.finished[0].targets)
    judge = course.finished[1]
    _, mapped = solver.fit_map(model.degree, course.finished[0].targets)
    end = add_bands(mapped, model.residual)
    residuals = {0.0: torch.zeros_like(model.residual), **model.begun, 1.0: model.residual}
    known = {0.0: (torch.zeros_like(end), 0.0), 1.0: (end, judge.error(end))}

    def learn(index: int) -> None:
        """Store the solution and the error of a target."""
        stage, judge = course.targets[index]
        table = made[index].table
        assert table is not None
        offsets = member_bands(made[index].offsets.to(solver.original))
        if model.bands:
            residuals[stage.strength] = (offsets - solver.map_offsets(model.degree, table))[:, : model.bands]
        known[stage.strength] = offsets, judge.error(offsets)

    def solve_target(target: Target) -> ParameterSnapshot:
        stage, judge = target
        table, mapped = solver.fit_map(model.degree, stage.targets)
        offsets = mapped
        means = dict[str, float]()
        if model.bands:
            below = max(s for s in residuals if s < stage.strength)
            above = min(s for s in residuals if s >= stage.strength)
            share = (stage.strength - below) / (above - below)
            start = torch.lerp(residuals[below], residuals[above], share)
            report = partial(on_step, state.step, state.running)
            residual, taken = solver.residual(
                mapped, start, stage.targets, steps, judge, model.error, model.hold, report
            )
            offsets = add_bands(mapped, residual)
            means[STEPS] = taken
        own = ColorEvaluator(solver.views, stage.targets)
        remaining, error = finished.mean_and_error(offsets, own)
        if not math.isfinite(remaining) or not bool(offsets.isfinite().all()):
            raise FloatingPointError(f"the loss is {remaining} at step {state.step}")
        moved = band_offsets(offsets, solver.original.shape[1])
        for rows in (state.moved, state.average):
            rows.detach().copy_(moved)
        state.step = state.step + 1
        state.stage = state.stage + 1
        state.running = remaining
        means |= {"l2": error, "left": remaining}
        return ParameterSnapshot(state.step, True, moved, means, table)

    for index in range(min(state.stage, len(course.targets))):
        learn(index)
    while state.stage <= len(course.targets):
        is_finished = state.stage == len(course.targets) and not course.extend(known)
        yield solve_target(course.finished if is_finished else course.targets[state.stage])
        if not is_finished:
            learn(state.stage - 1)
        on_step(state.step, state.running)
