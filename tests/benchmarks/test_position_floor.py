"""What a Gaussian's place tells of its movement."""

from __future__ import annotations

import torch

from benchmarks.position_floor import position_floor
from progdf.field.evaluate import FieldEvaluator
from tests.helpers.edits import curved_trajectory
from tests.helpers.networks import smooth_trajectory


def test_a_smooth_edit_is_told_by_the_neighbors_and_a_random_one_is_not() -> None:
    places = torch.randn(800, 3, generator=torch.Generator().manual_seed(0))
    strengths, smooth = smooth_trajectory(places)
    _, random = curved_trajectory(800, moving=("sh0",))
    assert position_floor(strengths, smooth, places).unpredictable["sh0"] < 0.2
    assert position_floor(strengths, random, places).unpredictable["sh0"] > 0.9


def test_the_floor_in_pictures_is_that_of_the_neighbors() -> None:
    places = torch.arange(6.0)[:, None].expand(6, 3) ** 2
    strengths = torch.tensor([0.0, 1.0])
    offsets = torch.zeros(2, 6, 14)
    offsets[1, :, 11] = torch.tensor([1.0, 1.1, 2.0, 2.1, 5.0, 5.1])
    judge = FieldEvaluator(strengths, offsets, lambda moved: moved[:, 11:14] / 10)
    found = position_floor(strengths, offsets, places, judge=judge)
    assert found.neighbors in (1, 2, 4)
    assert found.psnr_worst < found.psnr_mean < 60.0


def test_a_lone_member_has_no_neighbors() -> None:
    strengths, offsets = curved_trajectory(1)
    assert position_floor(strengths, offsets, torch.zeros(1, 3)).unpredictable["means"] == 1.0


def test_movement_that_does_not_show_is_not_counted() -> None:
    places = torch.randn(400, 3, generator=torch.Generator().manual_seed(0))
    strengths, offsets = smooth_trajectory(places)
    hidden = places[:, 0] > 0
    noise = torch.randn(400, 3, generator=torch.Generator().manual_seed(1))
    offsets[1:, hidden, 11:14] += noise[hidden]
    evenly = position_floor(strengths, offsets, places).unpredictable["sh0"]
    shown = position_floor(strengths, offsets, places, (~hidden).float()).unpredictable["sh0"]
    assert shown < 0.5 * evenly


def test_as_many_neighbors_are_asked_as_tell_most() -> None:
    pairs = torch.arange(20.0).repeat_interleave(2)
    places = torch.stack([pairs * 10 + torch.tensor([0.0, 0.1]).repeat(20)] * 3, dim=1)
    moved = torch.randn(20, 14, generator=torch.Generator().manual_seed(3)).repeat_interleave(2, dim=0)
    found = position_floor(torch.tensor([0.0, 1.0]), torch.stack([torch.zeros(40, 14), moved]), places)
    assert found.neighbors == 1
    assert max(found.unpredictable.values()) < 1e-6


def test_members_that_move_together_are_predicted_between_snapshots_too() -> None:
    strengths = torch.tensor([0.0, 1.0])
    offsets = strengths[:, None, None].expand(2, 9, 14).clone()
    judge = FieldEvaluator(strengths, offsets, lambda moved: moved[:, 11:14])
    assert position_floor(strengths, offsets, torch.rand(9, 3), judge=judge).psnr_worst == 99.0
