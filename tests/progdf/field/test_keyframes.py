"""Tests of keyframe fields: snapshots at even strengths, and all of them."""

from __future__ import annotations

import pytest
import torch

from progdf.field import fit_keyframes
from tests.helpers.edits import at_snapshots, curved_trajectory


def test_keeping_all_snapshots_is_exact() -> None:
    strengths, offsets = curved_trajectory(30)
    field = fit_keyframes(strengths, offsets, 9)
    assert torch.equal(at_snapshots(field, strengths), offsets)


def test_two_keyframes_are_a_straight_path_of_fourteen_floats() -> None:
    strengths, offsets = curved_trajectory(30)
    field = fit_keyframes(strengths, offsets, 2)
    assert field.bytes_per_member == 14 * 4
    assert torch.allclose(field.offsets(0.3), 0.3 * offsets[-1])


def test_slider_gets_the_requested_ticks() -> None:
    assert fit_keyframes(*curved_trajectory(3), 3, recorded=(0.0, 0.4, 1.0)).recorded == (0.0, 0.4, 1.0)
    assert fit_keyframes(*curved_trajectory(3, snapshots=3), 2).recorded == (0.0, 0.5, 1.0)


def test_half_precision_field_is_exact_in_half_the_bytes() -> None:
    strengths, offsets = curved_trajectory(30)
    offsets[1:-1] = offsets[1:-1].half().float()  # as in recordings, whose end is in full precision
    field = fit_keyframes(strengths, offsets, 9)
    assert torch.equal(at_snapshots(field, strengths), offsets)
    assert field.bytes_per_member == 14 * (4 + 7 * 2)


def test_values_beyond_half_precision_are_kept_in_full() -> None:
    strengths, offsets = curved_trajectory(30)
    assert torch.equal(at_snapshots(fit_keyframes(strengths, offsets, 9), strengths), offsets)
    large = offsets * 1e6
    assert torch.equal(at_snapshots(fit_keyframes(strengths, large, 9), strengths), large)


def test_fewer_than_two_keyframes_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        fit_keyframes(*curved_trajectory(3), 1)
