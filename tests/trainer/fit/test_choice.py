"""Choice of the field by its worst picture."""

from __future__ import annotations

from torch import Tensor

from progdf.field import Candidate, FieldEvaluator, choose_field, fit_separable
from progdf.field.choose import pick_candidate
from tests.helpers.edits import curved_field, curved_trajectory, linear_pictures


def test_field_with_the_best_worst_picture_is_chosen() -> None:
    steady = Candidate(curved_field(3), (30.0, 31.0), "steady", 2.0)
    uneven = Candidate(curved_field(3), (20.0, 60.0), "good on the mean", 20.0)
    assert pick_candidate((uneven, steady), "reaches 33 dB").best is steady


def test_lossless_field_misses_a_path_that_differs_between_snapshots() -> None:
    strengths, offsets = curved_trajectory(20, snapshots=3)
    shown = linear_pictures(20, 14)
    evaluator = FieldEvaluator(strengths, offsets, shown, lambda s: s**4 * offsets[-1], target=80.0)
    chosen = choose_field(strengths, offsets, shown, kind="lossless", evaluator=evaluator)
    assert chosen.best.worst < 80.0
    assert not chosen.met


def test_ranks_are_chosen_by_parameters_if_pictures_mislead() -> None:
    strengths, offsets = curved_trajectory(40)
    shown = linear_pictures(40, 14)

    def nonlinear(moved: Tensor) -> Tensor:
        return (10 * shown(moved)).sin() / 2  # so nonlinear that effects do not add up

    evaluator = FieldEvaluator(strengths, offsets, nonlinear, target=98.0)
    found = choose_field(strengths, offsets, nonlinear, evaluator=evaluator).best
    ranks = {name: len(bases.residual_basis) for name, bases in found.field.attributes.items()}
    assert found.worst >= evaluator.candidate(fit_separable(strengths, offsets, ranks), "").worst
