"""Tests of neural fields: exact start and end, outputs only for moved attributes, valid layouts."""

from __future__ import annotations

import pytest
import torch

from progdf.field.neural import NeuralShape, hard_bin, offsets_of_answer
from progdf.gaussians import attribute_slices
from tests.helpers.edits import curved_trajectory
from tests.helpers.networks import FORMS, MEMBERS, network, rows


@pytest.mark.parametrize("form", FORMS)
def test_network_is_exactly_zero_at_zero(form: str) -> None:
    assert not bool(network(form).bind(rows()).offsets(0.0).any())


@pytest.mark.parametrize("form", FORMS)
def test_network_output_of_any_size_moves_nothing_at_zero(form: str) -> None:
    shape = network(form).shape
    wild = torch.full((5, 6), 1e6)
    assert not bool(offsets_of_answer(shape, torch.zeros(5), wild, wild).any())


@pytest.mark.parametrize("form", ["own", "position"])
def test_interpolated_bins_have_no_jumps(form: str) -> None:
    field = network(form).bind(rows())
    whole = float((field.offsets(1.0) - field.offsets(0.0)).abs().max())
    for edge in torch.arange(11) / 10:
        step = field.offsets(float(edge) + 1e-4) - field.offsets(max(0.0, float(edge) - 1e-4))
        assert float(step.abs().max()) < 0.02 * whole


def test_hard_bins_are_constant_and_jump() -> None:
    field = network("position, hard bins").bind(rows())
    assert torch.equal(field.offsets(0.31), field.offsets(0.39))
    assert torch.equal(field.offsets(1e-6), field.offsets(0.199))  # the paper's s = 0 and 0.1 share a bin
    assert float((field.offsets(0.401) - field.offsets(0.399)).abs().max()) > 1e-3


def test_hard_bins_are_gracos_clamp() -> None:
    tenths = torch.arange(11) / 10
    assert hard_bin(tenths).tolist() == [0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert hard_bin(tenths + 0.05).tolist() == [0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert hard_bin(torch.tensor([-1.0, 0.999999, 2.0])).tolist() == [0, 8, 9], "the last is s = 1 alone"


def test_network_that_stores_the_end_meets_it_exactly() -> None:
    _, offsets = curved_trajectory(MEMBERS, moving=("means", "sh0"))
    assert torch.equal(network().bind(rows()).offsets(1.0), offsets[-1])


def test_only_moved_attributes_have_outputs() -> None:
    shape = network().shape
    assert shape.attributes == ("means", "sh0")
    assert network().tensors["heads.weight"].shape[0] == 6
    packed = network().bind(rows()).offsets(0.5)
    still = [columns for name, columns in attribute_slices(14).items() if name not in shape.attributes]
    assert not any(bool(packed[:, columns].any()) for columns in still)


def test_invalid_layouts_are_refused() -> None:
    for changed in (
        {"width": 0},
        {"layers": 65},
        {"attributes": ()},
        {"attributes": ("sh0", "means")},
        {"code": -1},
    ):
        with pytest.raises(ValueError, match=r"expected|are not a subset of"):
            NeuralShape(**{"width": 8, "layers": 2, "attributes": ("sh0",), "channels": 14} | changed)
