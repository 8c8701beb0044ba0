"""Tests of remapping the slider of a field: the same states at new strengths, without extra bytes."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from progdf.field import BakedField, fit_separable
from progdf.field.baked import SliderRemap, identity_remap, remap_slider

CHANNELS = 14


def bent(nodes: int = 9) -> BakedField:
    """Return a field of three members that bends at every node."""
    random = torch.Generator().manual_seed(3)
    strengths = torch.linspace(0, 1, nodes)
    offsets = torch.randn(nodes, 3, CHANNELS, generator=random) * strengths[:, None, None]
    return fit_separable(strengths, offsets, {"means": 3, "sh0": 2})


def late() -> SliderRemap:
    """Return a remap that slows the first part of the slider."""
    old = torch.linspace(0, 1, 21, dtype=torch.float64)
    return SliderRemap(old, old.sqrt())


@settings(max_examples=40, deadline=None)
@given(st.floats(0.0, 1.0))
def test_remapped_field_shows_the_old_state_at_the_new_strength(s: float) -> None:
    field = bent()
    remap = late()
    expected = field.offsets(s)
    found = remap_slider(field, remap).offsets(remap.at(s))
    assert float((found - expected).abs().max()) < 2e-2 * float(field.offsets(1.0).abs().max())


def test_both_ends_of_a_remapped_field_keep_their_bits() -> None:
    field = bent()
    found = remap_slider(field, late())
    assert torch.equal(found.offsets(1.0), field.offsets(1.0))
    assert not bool(found.offsets(0.0).any())


def test_remap_adds_no_bytes_per_member_and_moves_the_ticks() -> None:
    field = replace(bent(), recorded=(0.0, 0.25, 1.0))
    found = remap_slider(field, late())
    assert found.bytes_per_member == field.bytes_per_member
    assert found.recorded == pytest.approx((0.0, 0.5, 1.0))


def test_identity_remap_changes_nothing() -> None:
    field = bent()
    found = remap_slider(field, identity_remap())
    assert torch.equal(found.knots, field.knots)
    assert all(torch.equal(found.offsets(s), field.offsets(s)) for s in (0.1, 0.33, 0.9))


def test_nodes_pushed_together_by_a_steep_remap_still_ascend() -> None:
    knots = torch.tensor([0.0, 0.4, 0.6, 1.0], dtype=torch.float64)
    steep = torch.tensor([0.0, 0.5, 0.5 + 1e-9, 1.0], dtype=torch.float64)
    found = remap_slider(bent(65), SliderRemap(knots, steep))
    assert bool((found.knots.diff() > 0).all())
    assert torch.equal(found.offsets(1.0), bent(65).offsets(1.0))


@pytest.mark.parametrize("knots", [[0.0, 0.5, 0.5, 1.0], [0.1, 1.0], [0.0, 0.9], [0.0, 0.6, 0.4, 1.0]])
def test_knots_not_ascending_from_0_to_1_are_refused(knots: list[float]) -> None:
    with pytest.raises(ValueError, match="ascend from 0 to 1"):
        SliderRemap(torch.tensor(knots), torch.tensor(knots))
