"""Coefficients refined by pictures: never worse where they were looked at, and no byte more."""

from __future__ import annotations

import pytest
import torch

from progdf.field import BakedField, FieldJudge, choose_field, fit_separable
from progdf.field.refine import refined
from progdf.field.rendered import Render
from progdf.gaussians import ATTRIBUTES
from tests.helpers.edits import curved_trajectory, linear_pictures

ONE = dict.fromkeys(ATTRIBUTES, 1)


def errors(field: BakedField, offsets: torch.Tensor, render: Render) -> torch.Tensor:
    """Mean squared error of the pictures at the nodes. [T]"""
    found = [render(field.offsets(float(s))) - render(o) for s, o in zip(field.nodes, offsets, strict=True)]
    return torch.stack([picture.double().square().mean() for picture in found])


def test_refining_lowers_the_error_of_pictures_at_every_snapshot() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    render = linear_pictures(60, 14)
    field = fit_separable(strengths, offsets, ONE)
    before, after = errors(field, offsets, render), errors(refined(field, offsets, render), offsets, render)
    assert bool((after <= before).all())
    assert float(after.sum()) < 0.8 * float(before.sum())


def test_refining_finds_the_coefficients_that_are_best_for_the_pictures() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=9)
    render = linear_pictures(60, 14)
    field = refined(fit_separable(strengths, offsets, ONE), offsets, render)
    again = refined(field, offsets, render)
    assert torch.allclose(errors(field, offsets, render), errors(again, offsets, render), rtol=1e-2)


def test_refining_costs_no_byte_and_leaves_bases_and_ends_as_they_are() -> None:
    strengths, offsets = curved_trajectory(60)
    field = fit_separable(strengths, offsets, ONE)
    found = refined(field, offsets, linear_pictures(60, 14))
    assert found.bytes_per_member == field.bytes_per_member
    assert not bool(found.offsets(0.0).any())
    assert torch.equal(found.offsets(1.0), offsets[-1])
    for name, bases in field.attributes.items():
        assert torch.equal(found.attributes[name].rest, bases.rest)


def test_what_no_picture_shows_is_left_as_it_was() -> None:
    strengths, offsets = curved_trajectory(30)
    field = fit_separable(strengths, offsets, ONE)
    found = refined(field, offsets, lambda moved: torch.zeros(5, 3))
    for name, bases in field.attributes.items():
        assert torch.equal(found.attributes[name].coefficients, bases.coefficients)


def test_a_step_that_makes_pictures_worse_is_not_taken() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=9)
    shown = linear_pictures(60, 14)

    def saturated(moved: torch.Tensor) -> torch.Tensor:
        return (3000 * shown(moved)).atan()  # far from linear: slopes lead beyond the mark

    field = fit_separable(strengths, offsets, {})
    after = errors(refined(field, offsets, saturated), offsets, saturated)
    assert bool((after <= errors(field, offsets, saturated) * (1 + 1e-6)).all())


def test_a_field_that_moves_nothing_stays_one() -> None:
    strengths, offsets = torch.linspace(0, 1, 5), torch.zeros(5, 9, 14)
    field = fit_separable(strengths, offsets, {})
    assert refined(field, offsets, linear_pictures(9, 14)) is field


def test_nodes_that_are_not_the_snapshots_are_refused() -> None:
    strengths, offsets = curved_trajectory(5)
    with pytest.raises(ValueError, match="9 nodes for 5 snapshots"):
        refined(fit_separable(strengths, offsets, ONE), offsets[:5], linear_pictures(5, 14))


def test_the_choice_keeps_the_refined_field_only_where_it_is_better() -> None:
    strengths, offsets = curved_trajectory(60, snapshots=17)
    look, other = linear_pictures(60, 14), linear_pictures(60, 14, seed=3)
    plain = choose_field(strengths, offsets, look, target=torch.inf, budget=65.0)
    better = choose_field(strengths, offsets, look, target=torch.inf, budget=65.0, refine=True)
    assert better.best.label == f"{plain.best.label}, refined"
    assert better.best.worst > plain.best.worst
    judge = FieldJudge(strengths, offsets, other)
    unseen = choose_field(strengths, offsets, look, target=torch.inf, budget=65.0, judge=judge, refine=True)
    assert unseen.best.worst == max(c.worst for c in unseen.tried if c.field.bytes_per_member <= 65)
