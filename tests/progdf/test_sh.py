"""Tests of rotating higher SH bands with their Gaussians."""

from __future__ import annotations

import pytest
import torch

from progdf.quaternions import multiply_quats, normalize_quats, rotate_vectors
from progdf.sh import half_turn, rotation_change, shade
from tests.helpers.draws import Draws

COUNT = 200


def turns(seed: int = 0) -> torch.Tensor:
    return normalize_quats(Draws(seed).normal(COUNT, 4))


def bands(degree: int) -> torch.Tensor:
    return 0.3 * Draws(1).normal(COUNT, (degree + 1) ** 2 - 1, 3)


def rotate_bands(shN: torch.Tensor, quats: torch.Tensor) -> torch.Tensor:
    return shN + rotation_change(shN, quats)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_bands_show_the_same_colors_along_rotated_directions(degree: int) -> None:
    quats = turns()
    shN = bands(degree)
    sh0 = 2.0 * torch.ones(COUNT, 1, 3)  # prevents clamping at 0
    directions = torch.nn.functional.normalize(Draws(2).normal(COUNT, 3), dim=1)
    before = shade(degree, directions.double(), torch.cat([sh0, shN], dim=1).double())
    turned = rotate_vectors(directions.double(), quats.double())
    after = shade(degree, turned, torch.cat([sh0, rotate_bands(shN, quats)], dim=1).double())
    torch.testing.assert_close(after, before, rtol=0.0, atol=1e-6)


def test_two_rotations_equal_their_product() -> None:
    first = turns(3)
    second = turns(4)
    shN = bands(3)
    rotated = rotate_bands(rotate_bands(shN, first), second)
    torch.testing.assert_close(rotated, rotate_bands(shN, multiply_quats(second, first)), rtol=0.0, atol=2e-6)


def test_identity_changes_nothing_and_band_4_is_never_rotated() -> None:
    rest = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(COUNT, 4)
    assert not bool(rotation_change(bands(3), rest).any())
    change = rotation_change(0.3 * Draws(1).normal(COUNT, 24, 3), turns())
    assert bool(change[:, :15].any())
    assert not bool(change[:, 15:].any())


def test_parts_rotate_their_members() -> None:
    part = torch.arange(COUNT) % 3
    expected = rotation_change(bands(2), turns()[:3][part])
    assert torch.equal(rotation_change(bands(2), turns()[:3], part), expected)


def test_half_turn_about_x_changes_only_signs() -> None:
    half = torch.tensor([[0.0, 1.0, 0.0, 0.0]]).expand(COUNT, 4)
    torch.testing.assert_close(
        half_turn(bands(3), (1.0, -1.0, -1.0)), rotate_bands(bands(3), half), rtol=0.0, atol=1e-6
    )
    assert torch.equal(half_turn(bands(3), (1.0, -1.0, -1.0)).abs(), bands(3).abs())
