"""The course of an edit of colors: the strengths that are solved for, as many as it calls for."""

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

from .color_solver import BANDS, LOOKS, Model, Solver, add_bands
from .color_views import MORE_PAYS, Judge
from .pgs import OnStep, ParameterSnapshot, PgsState, TargetStage
from .retime import smooth_weights

STEPS = "steps"
"""Of a recording's means: the steps that it took."""

_FINEST = 1 / 16  # of the way between two strengths: there are none in between

Target = tuple[TargetStage, Judge]
"""A strength's pictures, and views not solved for that say when these are met."""


@dataclass
class Course:
    """The strengths that are solved for."""

    targets: list[Target]  # in this order, the finished edit after them
    finished: Target
    look: Callable[[float], Judge] | None = None  # any other; None: there are none
    ask: Callable[[Sequence[float]], Sequence[Target]] | None = None

    def extend(self, known: Mapping[float, tuple[Tensor, float]]) -> bool:
        """Ask for those that would each take a twentieth from the error of the whole way (its geometric mean
        over what is to be seen): in the middle of what is asked for, `smooth_course` misses by so much more
        than a solution would, whose differences lie half way between those of its neighbors. False: none.

        Args:
            known: strength → what is solved for there, its offset [M,B,3], and what that misses; 0 and 1 too
        """
        if self.look is None or self.ask is None:
            return False
        at = sorted(known)
        offsets = torch.stack([known[s][0] for s in at])
        asked = list[float]()
        missed = [max(known[s][1], LEVEL) for s in at]
        places, weights = smooth_weights(at, offsets)
        for i, (begin, end) in enumerate(pairwise(at)):
            if end - begin <= _FINEST:
                continue
            smooth = torch.tensordot(weights[2 * i + 1].float(), offsets, 1)
            error = max(self.look(float(places[2 * i + 1])).error(smooth), LEVEL)
            expected = (0.5 * math.sqrt(missed[i]) * (i > 0) + 0.5 * math.sqrt(missed[i + 1])) ** 2
            if (end - begin) * math.log(error / max(expected, LEVEL)) > -math.log(MORE_PAYS):
                asked.append((begin + end) / 2)
        self.targets += self.ask(asked) if asked else ()
        return bool(asked)

    def sort_recordings(
        self, made: Sequence[ParameterSnapshot]
    ) -> tuple[list[float], list[ParameterSnapshot]]:
        """All strengths, ascending, and what `solve` yielded of each, counted anew."""
        pairs = zip([*(stage.strength for stage, _ in self.targets), 1.0], made, strict=True)
        strengths, recordings = zip(*sorted(pairs, key=lambda pair: pair[0]), strict=True)
        return list(strengths), [replace(one, step=i + 1) for i, one in enumerate(recordings)]


def thin_model(model: Model, solver: Solver, targets: Sequence[Target], steps: int, spare: float) -> Model:
    """The model with the functions beyond DC that members need at these strengths, and only those.

    Where the end shows no error, another band is tried for the way. Then each time the half goes that adds
    least to the pictures, and what is left is solved for anew.

    Args:
        model: what the finished edit called for
        solver: the views
        targets: some strengths, the finished edit the last, each with views not solved for
        steps: most steps of conjugate gradients
        spare: mean squared error that fewer functions may add beside a twentieth
    """
    more = (count for count in BANDS if model.bands < count <= model.most_bands)
    richer = next(more, 0) if model.error <= LEVEL else 0
    if not model.bands or max(model.bands, richer) < 2:
        return model
    mapped = [solver.fit_map(model.degree, stage.targets)[1] for stage, _ in targets]

    def refine(starts: Sequence[Tensor], most: int) -> tuple[list[Tensor], float]:
        """The residuals after so many steps, as long as these help where that is all, and what they leave."""
        by = solver if most == steps else solver.only(starts[-1])
        found = list[Tensor]()
        left = 0.0
        for (stage, judge), made, start in zip(targets, mapped, starts, strict=True):
            if start.shape[1] > model.bands or most < steps or stage.strength < 1.0:  # else it is solved for
                asked = None if most < steps else judge
                start, _ = by.residual(made, start, stage.targets, most, asked, model.error, model.hold)
            found.append(start)
            left += max(judge.error(add_bands(made, start)), LEVEL)
        return found, left

    best, least = refine([stage.strength * model.residual for stage, _ in targets], steps)
    tried = list(model.tried)
    on_the_way = ", on the way too" if len(targets) > 1 else ""
    if richer:
        found, error = refine([pad(one, (0, 0, 0, richer - model.bands)) for one in best], steps)
        tried.append((f"with a residual of {richer}{on_the_way}", decibels(error / len(targets))))
        best, least = (found, error) if error < MORE_PAYS * least else (best, least)
    thinner = best
    error = least
    while error * MORE_PAYS <= least + len(targets) * spare:
        best = thinner
        least = min(least, error)
        if not bool((halved := solver.halve(best))[-1][:, 1:].any()):
            break
        thinner, error = refine(halved, min(LOOKS, steps - 1))
        left = float(thinner[-1].any(dim=2).float().sum(dim=1).mean())
        tried.append((f"{left:.1f} of these a Gaussian{on_the_way}", decibels(error / len(targets))))
    begun = {stage.strength: one for (stage, _), one in zip(targets, best, strict=True)}
    return replace(model, residual=best[-1], begun=begun, tried=tried)


def solve(
    solver: Solver,
    model: Model,
    course: Course,
    made: Sequence[ParameterSnapshot],
    state: PgsState,
    on_step: OnStep,
    steps: int,
) -> Iterator[ParameterSnapshot]:
    """Solve for the strengths of a course, which grows as is needed, and yield each one's end, with its map.

    Each begins between the solutions of its neighbors.

    Args:
        solver: the views
        model: how much is modelled
        course: strengths, changed in place
        made: what was yielded, one for each target up to `state.stage`; kept by who calls, in any precision
        state: where to go on from, changed in place; a step is a stage
        on_step: progress; here, and only here, the state is whole and may be saved
        steps: most steps of conjugate gradients of a stage

    Raises:
        FloatingPointError: the loss or where it leads is not finite; the state is that of the stage before.
    """
    finished = Judge(solver.views, course.finished[0].targets)
    judge = course.finished[1]
    _, mapped = solver.fit_map(model.degree, course.finished[0].targets)
    end = add_bands(mapped, model.residual)
    residuals = {0.0: torch.zeros_like(model.residual), **model.begun, 1.0: model.residual}
    known = {0.0: (torch.zeros_like(end), 0.0), 1.0: (end, judge.error(end))}

    def learn(index: int) -> None:
        """What was yielded of a target is known."""
        (stage, judge), table = course.targets[index], made[index].table
        assert table is not None
        offsets = member_bands(made[index].offsets.float())
        residuals[stage.strength] = (offsets - solver.map_offsets(model.degree, table))[:, : model.bands]
        known[stage.strength] = offsets, judge.error(offsets)

    def solve_target(target: Target) -> ParameterSnapshot:
        stage, judge = target
        table, mapped = solver.fit_map(model.degree, stage.targets)
        offsets = mapped
        means = dict[str, float]()
        if model.bands:
            left = max(s for s in residuals if s < stage.strength)
            right = min(s for s in residuals if s >= stage.strength)
            share = (stage.strength - left) / (right - left)
            start = torch.lerp(residuals[left], residuals[right], share)
            told = partial(on_step, state.step, state.running)
            residual, taken = solver.residual(
                mapped, start, stage.targets, steps, judge, model.error, model.hold, told
            )
            offsets = add_bands(mapped, residual)
            means[STEPS] = taken
        left_over = finished.mean(offsets, 1.0)
        if not math.isfinite(left_over) or not bool(offsets.isfinite().all()):
            raise FloatingPointError(f"the loss is {left_over} at step {state.step}")
        moved = band_offsets(offsets, solver.original.shape[1])
        for rows in (state.moved, state.average):
            rows.detach().copy_(moved)
        state.step = state.step + 1
        state.stage = state.stage + 1
        state.running = left_over
        means |= {"l2": Judge(solver.views, stage.targets).error(offsets), "left": left_over}
        return ParameterSnapshot(state.step, True, moved, means, table)

    for index in range(min(state.stage, len(course.targets))):
        learn(index)
    while state.stage <= len(course.targets):
        ends = state.stage == len(course.targets) and not course.extend(known)
        yield solve_target(course.finished if ends else course.targets[state.stage])
        if not ends:
            learn(state.stage - 1)
        on_step(state.step, state.running)
