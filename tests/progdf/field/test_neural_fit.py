"""Tests of training a neural field: deterministic, converging and resumable."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.field import NeuralSettings, bake_network
from progdf.field.neural_fit import NeuralFit, rendered_importance, train_network
from tests.helpers.edits import curved_trajectory
from tests.helpers.networks import MEMBERS, SHORT, fit_neural, members, rows, scene, smooth_trajectory


def test_network_is_determined_by_its_seed() -> None:
    strengths, offsets = curved_trajectory(MEMBERS)
    found = [fit_neural(strengths, offsets, rows(), replace(SHORT, seed=seed)) for seed in (0, 0, 1)]
    same = [
        torch.equal(found[0].tensors[name], other.tensors[name])
        for other in found[1:]
        for name in ("control",)
    ]
    assert same == [True, False]
    assert all(torch.equal(tensor, found[1].tensors[name]) for name, tensor in found[0].tensors.items())
    assert torch.equal(found[0].codes, found[1].codes)


def test_training_converges_to_the_trajectory() -> None:
    strengths, offsets = smooth_trajectory(scene().means[members()])
    errors = []
    for steps in (1, 300):
        given = NeuralSettings(inputs="position", steps=steps, batch=128)
        field = fit_neural(strengths, offsets, rows(), given).bind(rows())
        middle = field.offsets(float(strengths[4])) - offsets[4]
        errors.append(float(middle.square().mean() / offsets[4].square().mean()))
    assert errors[1] < 0.02 < 0.5 < errors[0]  # 0.0005 when written


def test_code_distinguishes_members_at_the_same_position() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    same_place = rows().clone()
    same_place[:] = same_place[0]
    errors = []
    for code in (0, 4):
        given = NeuralSettings(inputs="position", steps=400, batch=128, code=code)
        field = fit_neural(strengths, offsets, same_place, given).bind(same_place)
        errors.append(float((field.offsets(0.5) - offsets[4]).square().sum() / offsets[4].square().sum()))
    assert errors[1] < 0.2 * errors[0]


def test_visible_members_are_fitted_first() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    same_place = rows()[:1].expand(MEMBERS, -1).clone()
    visibility = torch.full((MEMBERS,), 1e-6)
    visibility[7] = 1.0
    given = NeuralSettings(inputs="position", steps=200, batch=128)
    field = fit_neural(strengths, offsets, same_place, given, visibility).bind(same_place)
    wrong = (field.offsets(0.5) - offsets[4]).square().sum(dim=1)
    assert int(wrong.argmin()) == 7


class Watched:
    """Image loss that compares offsets and records its arguments."""

    views = 3

    def __init__(self) -> None:
        self.asked: list[tuple[Tensor, Tensor, int]] = []

    def __call__(self, found: Tensor, recorded: Tensor, view: int) -> Tensor:
        self.asked.append((found, recorded, view))
        return (found - recorded).abs().mean()


def test_image_loss_uses_random_snapshots_and_never_between_two() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    pictures = Watched()
    fit = NeuralFit(rows(), offsets.shape[2], ("sh0",), SHORT)
    fit.scale_to(offsets)
    train_network(fit, strengths, offsets, 60, pictures)
    assert len(pictures.asked) == 60, "in every step"
    drawn = {
        next(i for i, snapshot in enumerate(offsets) if torch.equal(snapshot, recorded))
        for _, recorded, _ in pictures.asked
    }
    assert drawn == set(range(1, len(offsets))), "each of them, but not the original"
    assert {view for *_, view in pictures.asked} == {0, 1, 2}
    assert all(found.shape == (MEMBERS, 14) for found, *_ in pictures.asked), "of all members"


def test_image_loss_replaces_the_offset_loss() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    fit = NeuralFit(rows(), 14, ("sh0",), SHORT)
    pictures = Watched()
    fit.scale_to(offsets)
    loss = fit.step(strengths, offsets, pictures=pictures)
    found, recorded, _ = pictures.asked[0]
    assert loss == pytest.approx(float((found - recorded).detach().abs().mean()))


def test_exceptional_picture_moves_the_network_little() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))

    class Scaled(Watched):
        factor = 1.0

        def __call__(self, found: Tensor, recorded: Tensor, view: int) -> Tensor:
            return self.factor * super().__call__(found, recorded, view)

    def change(factor: float) -> float:
        """Return how far ten ordinary steps move the network after one step with a scaled loss."""
        fit = NeuralFit(rows(), offsets.shape[2], ("sh0",), SHORT)
        fit.scale_to(offsets)
        pictures = Scaled()
        train_network(fit, strengths, offsets, 60, pictures)
        before = fit.field().bind(rows()).offsets(0.5)
        for step in range(11):
            pictures.factor = factor if step == 0 else 1.0
            fit.step(strengths, offsets, pictures=pictures)
        return float((fit.field().bind(rows()).offsets(0.5) - before).abs().max())

    assert change(1e4) < 2.0 * change(1.0)


@pytest.mark.parametrize("count", [0, 1])
def test_fit_works_with_at_most_one_member(count: int) -> None:
    strengths, offsets = curved_trajectory(max(count, 1))
    field = fit_neural(strengths, offsets[:, :1], rows()[:1], SHORT)
    assert torch.equal(bake_network(field, rows()[:1]).offsets(1.0), offsets[-1])
    empty = NeuralFit(rows()[:0], 14, ("sh0",), SHORT)
    assert empty.step(strengths, offsets[:, :0]) == 0.0


def test_saved_fit_continues_to_the_same_bits() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))

    def new() -> NeuralFit:
        return NeuralFit(rows(), 14, ("sh0",), SHORT)

    whole = new()
    first = new()
    second = new()
    for fit in (whole, first):
        fit.scale_to(offsets)
    for _ in range(6):
        whole.step(strengths, offsets)
    for _ in range(3):
        first.step(strengths, offsets)
    saved = {name: tensor.clone() for name, tensor in first.capture_state().items()}
    first.step(strengths, offsets)  # does not change the saved state
    second.restore(saved)
    for _ in range(3):
        second.step(strengths, offsets)
    assert whole.capture_state().keys() == second.capture_state().keys()
    assert all(
        torch.equal(tensor, second.capture_state()[name]) for name, tensor in whole.capture_state().items()
    )


def test_growing_trajectory_keeps_the_output_of_the_network() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("sh0",))
    fit = NeuralFit(rows(), 14, ("sh0",), replace(SHORT, inputs="position"))
    fit.scale_to(0.1 * offsets)
    train_network(fit, strengths, 0.1 * offsets, 20)
    before = fit.field().bind(rows()).offsets(0.5)
    fit.scale_to(offsets)
    after = fit.field().bind(rows()).offsets(0.5)
    assert torch.allclose(before, after, atol=2e-3 * float(before.abs().max()))  # half precision


def test_fit_adopts_the_outputs_of_attributes_that_still_move() -> None:
    strengths, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    given = replace(SHORT, inputs="position")
    first = NeuralFit(rows(), 14 + 9, ("means", "sh0", "shN"), given)
    wide = torch.cat([offsets, offsets[:, :, :9]], dim=2)
    first.scale_to(wide)
    train_network(first, strengths, wide, 20)
    second = NeuralFit(rows(), 14, ("sh0",), given)
    second.adopt(first.shape, first.capture_state())
    second.scale_to(offsets)
    expected = first.field().bind(rows()).offsets(0.5)[:, 11:14]
    found = second.field().bind(rows()).offsets(0.5)[:, 11:14]
    assert torch.allclose(found, expected, atol=2e-3 * float(expected.abs().max()))


def test_importance_is_the_rendered_change() -> None:
    _, offsets = curved_trajectory(30, moving=("means", "sh0"))
    found = rendered_importance(offsets, lambda moved: moved[:, 11:14])
    assert found["sh0"] > 0.999
    assert sum(found.values()) == pytest.approx(1.0)
