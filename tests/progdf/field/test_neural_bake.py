"""Tests of baked networks: exact ends, a recorded error, and the missing end offset spread over the path."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from progdf.field import bake_network
from progdf.field.bake import bake_form, bake_nodes
from progdf.field.baked import BakePlan, NeuralForm
from progdf.field.choose import FieldEvaluator, sample_strengths
from tests.helpers.edits import curved_trajectory
from tests.helpers.networks import FORMS, MEMBERS, baked, network, rows


@pytest.mark.parametrize("form", FORMS)
def test_ends_of_a_baked_network_are_exact(form: str) -> None:
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    assert not bool(baked(form).offsets(0.0).any())
    assert torch.equal(baked(form).offsets(1.0), offsets[-1])


@pytest.mark.parametrize("form", ["own", "own, hard bins"])
def test_recorded_bake_error_is_correct_and_small(form: str) -> None:
    field = baked(form)
    bound = network(form).bind(rows())
    strengths = sample_strengths()
    wrong = sum(float((field.offsets(float(s)) - bound.offsets(float(s))).square().sum()) for s in strengths)
    whole = sum(float(bound.offsets(float(s)).square().sum()) for s in strengths)
    assert field.origin is not None
    assert field.origin.error is not None
    assert field.origin.error["rms"] == pytest.approx((wrong / whole) ** 0.5, rel=1e-3)
    assert field.origin.error["rms"] < 0.02


def test_missing_end_offset_is_spread_over_the_path() -> None:
    form = network("position")
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    missing = float((form.bind(rows()).offsets(1.0) - offsets[-1]).norm())
    field = baked("position")
    last = float((field.offsets(1.0) - field.offsets(0.99)).norm())
    assert last < 0.2 * missing


def test_correction_follows_the_recorded_errors_if_known() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    evaluator = FieldEvaluator(strengths, offsets, lambda moved: moved[:, 11:14])
    follows = FieldEvaluator.curve
    known = bake_network(network("position"), rows(), lambda s: _at(strengths, offsets, s))
    assert sum(follows(evaluator, known)) >= sum(follows(evaluator, baked("position"))) - 1e-6


def _at(strengths: Tensor, offsets: Tensor, s: float) -> Tensor:
    place = s * (len(strengths) - 1)
    left = min(int(place), len(strengths) - 2)
    return torch.lerp(offsets[left], offsets[left + 1], place - left)


def test_hard_bins_are_baked_as_steps() -> None:
    field = baked("position, hard bins")
    nodes = bake_nodes(10, hard=True)
    assert bool((nodes[1:] > nodes[:-1]).all())
    assert torch.allclose(field.offsets(0.41), field.offsets(0.49), atol=1e-6)
    jump = float((field.offsets(0.4001) - field.offsets(0.3999)).abs().max())
    assert jump > 10 * float((field.offsets(0.3999) - field.offsets(0.31)).abs().max())


def test_baking_refuses_another_number_of_members() -> None:
    form = baked().origin
    assert isinstance(form, NeuralForm)
    with pytest.raises(ValueError, match="expected 40"):
        bake_form(form, rows()[:39])


def test_looser_tolerance_gives_fewer_bases() -> None:
    tight, loose = (bake_network(network(), rows(), tolerance=given).origin for given in (1e-3, 0.3))
    assert tight is not None
    assert loose is not None
    assert sum(loose.plan.ranks.values()) < sum(tight.plan.ranks.values())


def test_bake_error_excludes_the_error_of_the_network() -> None:
    form = baked("position").origin  # misses the end by much, as members are distinguished by position only
    assert form is not None
    assert form.error is not None
    assert form.error["rms"] < 0.02


@pytest.mark.parametrize("count", [1, 258])
def test_plan_of_too_few_or_too_many_nodes_is_refused(count: int) -> None:
    with pytest.raises(ValueError, match="expected 2 to 257"):
        BakePlan(torch.linspace(0, 1, count), {}, {})
