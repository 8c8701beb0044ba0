"""Keyframe fields: snapshots at even strengths, and all of them."""

from __future__ import annotations

import pytest
import torch

from progdf.field import fit_keyframes
from tests.helpers.edits import at_snapshots, curved_trajectory


def test_all_snapshots_kept_are_met_exactly() -> None:
    strengths, offsets = curved_trajectory(30)
    field = fit_keyframes(strengths, offsets, 9)
    assert torch.equal(at_snapshots(field, strengths), offsets)


def test_two_keyframes_are_the_straight_way_at_fourteen_floats() -> None:
    strengths, offsets = curved_trajectory(30)
    field = fit_keyframes(strengths, offsets, 2)
    assert field.bytes_per_member == 14 * 4
    assert torch.allclose(field.offsets(0.3), 0.3 * offsets[-1])


def test_the_slider_gets_the_ticks_that_it_is_told() -> None:
    assert fit_keyframes(*curved_trajectory(3), 3, recorded=(0.0, 0.4, 1.0)).recorded == (0.0, 0.4, 1.0)
    assert fit_keyframes(*curved_trajectory(3, snapshots=3), 2).recorded == (0.0, 0.5, 1.0)


def test_a_field_of_halves_is_the_recording_in_half_the_bytes() -> None:
    strengths, offsets = curved_trajectory(30)
    offsets[1:-1] = offsets[1:-1].half().float()  # as recordings are; the end is in full precision
    field = fit_keyframes(strengths, offsets, 9)
    assert torch.equal(at_snapshots(field, strengths), offsets)
    assert field.bytes_per_member == 14 * (4 + 7 * 2)


def test_a_field_of_numbers_that_halves_cannot_hold_keeps_them_whole() -> None:
    strengths, offsets = curved_trajectory(30)
    assert torch.equal(at_snapshots(fit_keyframes(strengths, offsets, 9), strengths), offsets)
    large = offsets * 1e6
    assert torch.equal(at_snapshots(fit_keyframes(strengths, large, 9), strengths), large)


def test_fewer_than_two_keyframes_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        fit_keyframes(*curved_trajectory(3), 1)
