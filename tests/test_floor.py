"""What a Gaussian's place tells of its movement."""

from __future__ import annotations

import torch
from edits import curved_trajectory
from networks import smooth_trajectory

from progdf.field import position_floor
from progdf.field.judge import FieldJudge


def test_a_smooth_edit_is_told_by_the_neighbours_and_a_random_one_is_not() -> None:
    places = torch.randn(800, 3, generator=torch.Generator().manual_seed(0))
    strengths, smooth = smooth_trajectory(places)
    _, random = curved_trajectory(800, moving=("sh0",))
    assert position_floor(strengths, smooth, places).unpredictable["sh0"] < 0.2
    assert position_floor(strengths, random, places).unpredictable["sh0"] > 0.9


def test_the_floor_in_pictures_is_that_of_the_neighbours() -> None:
    places = torch.arange(6.0)[:, None].expand(6, 3) ** 2
    strengths = torch.tensor([0.0, 1.0])
    offsets = torch.zeros(2, 6, 14)
    offsets[1, :, 11] = torch.tensor([1.0, 1.1, 2.0, 2.1, 5.0, 5.1])
    judge = FieldJudge(strengths, offsets, lambda moved: moved[:, 11:14] / 10)
    found = position_floor(strengths, offsets, places, judge=judge)
    assert found.neighbours in (1, 2, 4)
    assert found.psnr_worst < found.psnr_mean < 60.0


def test_a_lone_member_has_no_neighbours() -> None:
    strengths, offsets = curved_trajectory(1)
    assert position_floor(strengths, offsets, torch.zeros(1, 3)).unpredictable["means"] == 1.0
