"""One SVD for all that moves: the baseline that separable fields are measured against."""

from __future__ import annotations

import pytest
import torch

from benchmarks.field_forms import fit_joint
from progdf.gaussians import attribute_slices
from tests.helpers.edits import at_snapshots, curved_trajectory


def test_joint_factors_of_every_rank_are_a_recording_again() -> None:
    offsets = torch.randn(6, 20, 14, generator=torch.Generator().manual_seed(1)).cumsum(dim=0)
    offsets -= offsets[:1].clone()
    strengths = torch.linspace(0, 1, 6)
    few, full = (fit_joint(strengths, offsets, rank) for rank in (1, 4))
    errors = [max(float((f.offsets(i / 5) - offsets[i]).abs().max()) for i in range(6)) for f in (few, full)]
    assert errors[1] < 0.05 < errors[0]
    assert torch.equal(few.offsets(1.0), offsets[-1])
    shared = [bases.coefficients[:, 1:] for bases in few.attributes.values()]
    assert all(torch.equal(shared[0], other) for other in shared)


def test_a_way_that_only_changes_its_pace_needs_no_basis_beside_the_end() -> None:
    strengths, offsets = curved_trajectory(20)
    paced = strengths[:, None, None] ** 2 * offsets[-1]
    assert torch.allclose(at_snapshots(fit_joint(strengths, paced, 0), strengths), paced, atol=1e-6)


def test_weights_turn_the_joint_bases_to_what_shows() -> None:
    """Half of the members wave on their way, twice as far as the others bend: one basis has to choose."""
    strengths, offsets = curved_trajectory(40)
    offsets[:, 20:] += 2 * torch.sin(2 * torch.pi * strengths)[:, None, None] * offsets[-1, 20:]
    weights = torch.ones(40)
    weights[20:] = 1e-4
    fields = [fit_joint(strengths, offsets, 1, given) for given in (None, weights)]
    evenly, weighted = ((at_snapshots(f, strengths) - offsets)[:, :20].square().mean() for f in fields)
    assert float(weighted) < 0.5 * float(evenly)


def test_the_size_of_one_attribute_says_nothing_about_the_others() -> None:
    strengths, offsets = curved_trajectory(20)
    columns = attribute_slices(14)["means"]
    large = offsets.clone()
    large[:, :, columns] *= 1000
    one, other = (at_snapshots(fit_joint(strengths, given, 1), strengths) for given in (offsets, large))
    other[:, :, columns] /= 1000
    assert torch.allclose(one, other, atol=1e-3)


def test_a_negative_rank_is_refused() -> None:
    with pytest.raises(ValueError, match="rank is -1, expected 0 or more"):
        fit_joint(*curved_trajectory(3), -1)
