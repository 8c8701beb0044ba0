"""Keyframe fields: where they are kept, lines and curves through them, and every recording kept."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pytest
import torch

from progdf.field import fit_keyframes, fit_lossless
from progdf.field.baked import REST_TYPES
from progdf.field.keyframes import bending_snapshots, even_snapshots
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


@pytest.mark.parametrize("rest_type", REST_TYPES)
def test_a_curve_through_keyframes_meets_them_and_both_ends(rest_type: torch.dtype) -> None:
    strengths, offsets = curved_trajectory(30)
    field = fit_keyframes(strengths, offsets, 5, rest_type=rest_type, between="cubic")
    assert not bool(field.offsets(0.0).any())
    assert torch.equal(field.offsets(1.0), offsets[-1])
    tolerance = 1e-5 if rest_type == torch.float32 else 0.02
    assert torch.allclose(at_snapshots(field, strengths)[::2], offsets[::2], atol=tolerance)


def test_a_curve_follows_a_bend_closer_than_lines_at_the_same_bytes() -> None:
    strengths, offsets = curved_trajectory(30, snapshots=33)
    line, curve = (fit_keyframes(strengths, offsets, 5, between=b) for b in ("linear", "cubic"))
    error = [float((at_snapshots(f, strengths) - offsets).square().mean()) for f in (line, curve)]
    assert line.bytes_per_member == curve.bytes_per_member
    assert error[1] < 0.25 * error[0]


def test_a_curve_through_a_straight_way_is_straight() -> None:
    strengths, offsets = curved_trajectory(10)
    straight = strengths[:, None, None] * offsets[-1]
    field = fit_keyframes(strengths, straight, 4, between="cubic")
    assert torch.allclose(at_snapshots(field, strengths), straight, atol=1e-5)


def test_a_curve_through_keyframes_of_a_parabola_is_the_parabola() -> None:
    strengths = torch.linspace(0, 1, 17)
    offsets = strengths[:, None, None] ** 2 * torch.randn(5, 14, generator=torch.Generator().manual_seed(2))
    field = fit_keyframes(strengths, offsets, 4, kept=torch.tensor([0, 3, 10, 16]), between="cubic")
    assert torch.allclose(at_snapshots(field, strengths), offsets, atol=1e-5)


def test_int8_keyframes_spend_their_levels_on_the_bend() -> None:
    strengths, bend = curved_trajectory(30)
    straight = 1000 * strengths[:, None, None]
    field = fit_keyframes(strengths, straight + bend, 9, rest_type=torch.int8)
    error = (at_snapshots(field, strengths) - straight - bend).abs().max()
    assert float(error) < 2 * float(bend.abs().max()) / 127


def test_the_slider_gets_the_ticks_that_it_is_told() -> None:
    assert fit_keyframes(*curved_trajectory(3), 3, recorded=(0.0, 0.4, 1.0)).recorded == (0.0, 0.4, 1.0)
    assert fit_keyframes(*curved_trajectory(3, snapshots=3), 2).recorded == (0.0, 0.5, 1.0)


def test_keyframes_lie_where_the_way_bends() -> None:
    strengths = torch.linspace(0, 1, 21)
    way = torch.where(strengths < 0.15, strengths / 0.15, torch.ones(21))[:, None]  # a corner at 0.15
    assert bending_snapshots(strengths, (way @ way.T).double(), 3).tolist() == [0, 3, 20]
    assert even_snapshots(strengths, 3).tolist() == [0, 10, 20]


def test_no_other_keyframes_miss_less_at_worst() -> None:
    rng = torch.Generator().manual_seed(5)
    rows = torch.randn(9, 6, generator=rng).cumsum(dim=0)
    strengths = torch.linspace(0, 1, 9)
    gram = (rows @ rows.T).double()

    def worst(kept: Sequence[int]) -> float:
        found = np.stack([np.interp(strengths, strengths[list(kept)], rows[list(kept), i]) for i in range(6)])
        return float((torch.from_numpy(found.T) - rows).square().sum(dim=1).max())

    ours = bending_snapshots(strengths, gram, 4).tolist()
    best = min(worst([0, a, b, 8]) for a, b in combinations(range(1, 8), 2))
    assert worst(ours) == pytest.approx(best, rel=1e-4)


@pytest.mark.parametrize("count", [2, 3, 9, 40])
def test_as_many_keyframes_as_are_asked_for_are_kept_if_there_are(count: int) -> None:
    strengths, offsets = curved_trajectory(5)
    rows = offsets.flatten(1)
    kept = bending_snapshots(strengths, (rows @ rows.T).double(), count)
    assert len(kept) == min(count, 9)
    assert kept[[0, -1]].tolist() == [0, 8]


def test_a_lossless_field_is_the_recording_in_half_the_bytes() -> None:
    strengths, offsets = curved_trajectory(30)
    offsets[1:-1] = offsets[1:-1].half().float()  # as recordings are; the end is in full precision
    field = fit_lossless(strengths, offsets)
    assert torch.equal(at_snapshots(field, strengths), offsets)
    assert field.bytes_per_member == 14 * (4 + 7 * 2)


def test_a_lossless_field_of_numbers_that_halves_cannot_hold_keeps_them_whole() -> None:
    strengths, offsets = curved_trajectory(30)
    assert torch.equal(at_snapshots(fit_lossless(strengths, offsets), strengths), offsets)
    large = offsets * 1e6
    assert torch.equal(at_snapshots(fit_lossless(strengths, large), strengths), large)


@pytest.mark.parametrize("kept", [[0, 4], [1, 8], [0, 5, 5, 8], [0]])
def test_keyframes_without_both_ends_or_out_of_order_are_refused(kept: list[int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        fit_keyframes(*curved_trajectory(3), 3, kept=torch.tensor(kept))


def test_fewer_than_two_keyframes_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 2"):
        fit_keyframes(*curved_trajectory(3), 1)
