"""Tests of the sample on which the packing of a large color edit is chosen."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor

import trainer.fit.fit
from progdf.field.baked import GradeForm, identity_map
from progdf.field.grade import map_colors, member_bands
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, pack
from tests.helpers.trained import WHITE, Small, small
from trainer.fit.evaluate import Evaluator, make_evaluator, sample_members
from trainer.fit.fit import field_evaluator, fit_grades
from trainer.options import FieldOptions
from trainer.views.crops import crop_scene


def rows_of(case: Small) -> Tensor:
    return pack(case.scene[case.region.members], with_shN=True)


def recolored(case: Small) -> Trajectory:
    """Return two recordings of a map with a residual per member."""
    generator = torch.Generator().manual_seed(1)
    rows = rows_of(case)
    table = identity_map(1)
    table[1:4] = table[1:4] * 0.4
    table[0] = torch.tensor([0.1, 0.2, 0.4])
    sh = member_bands(rows)
    end = torch.zeros_like(rows)
    end[:, BASE_CHANNELS - 3 :] = (map_colors(sh, table, 1) - sh).flatten(1)
    end[:, BASE_CHANNELS - 3 : BASE_CHANNELS] += 0.3 * torch.randn(len(rows), 3, generator=generator)
    offsets = torch.stack([torch.zeros_like(end), end]).half()
    ends = torch.tensor([0.0, 1.0])
    return Trajectory(ends, offsets, end, torch.arange(2), (1,), (1.0,), table[None], 1)


def evaluator_of(case: Small, trajectory: Trajectory) -> Evaluator:
    """Return an evaluator whose edited pictures are a little brighter than the edit."""
    views = case.views
    channels = trajectory.end.shape[1]
    rows = rows_of(case) + trajectory.end
    edited = []
    for view in views:
        box = (0, 0, view.camera.width, view.camera.height)
        whole = crop_scene(case.scene, case.region.members, view.camera, box, WHITE, still=True)
        edited.append((whole.render(rows) + 0.02).clamp(0.0, 1.0))
    return make_evaluator(case.scene, case.region, views, {1.0: edited}, WHITE, channels, still=True)


def test_sample_shows_the_same_pixels_as_all_members() -> None:
    case = small("body", count=3)
    trajectory = recolored(case)
    evaluator = evaluator_of(case, trajectory)
    members, sampled = sample_members(evaluator, 3 * len(case.region) // 4)
    assert 0 < len(members) <= 3 * len(case.region) // 4
    everything = evaluator.pictures(trajectory.end)
    some = sampled.pictures(trajectory.end[members])
    for whole, part, pixels in zip(everything, some, sampled.pixels, strict=True):
        torch.testing.assert_close(part[pixels], whole[pixels], atol=2e-6, rtol=0)
    assert sum(int(pixels.sum()) for pixels in sampled.pixels) > 0


def test_small_region_is_not_sampled() -> None:
    case = small(count=2)
    evaluator = evaluator_of(case, recolored(case))
    members, sampled = sample_members(evaluator, len(case.region))
    assert torch.equal(members, torch.arange(len(case.region)))
    assert sampled is evaluator


def test_sampled_grade_meets_the_limit_on_all_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    case = small("body", count=4)
    trajectory = recolored(case)
    choosing, reporting = evaluator_of(case, trajectory).halves()
    fit = partial(
        fit_grades,
        trajectory,
        rows_of(case),
        choosing,
        reporting,
        torch.ones(len(case.region)),
        FieldOptions(),
    )
    whole = fit()
    monkeypatch.setattr(
        trainer.fit.fit, "sample_members", partial(sample_members, budget=3 * len(case.region) // 4)
    )
    sampled = fit()
    assert sampled.choice.met
    field = sampled.choice.best.field
    assert field.members == len(case.region)
    excess, to_editor = field_evaluator(trajectory, choosing, FieldOptions()).added_excess(field)
    assert excess <= 1.0
    assert sampled.choice.best.to_editor == pytest.approx(to_editor, abs=1e-3)
    forms = [one.choice.best.field.origin for one in (whole, sampled)]
    assert all(isinstance(form, GradeForm) for form in forms)
    assert sampled.choice.best.field.bytes_per_member < 1.5 * whole.choice.best.field.bytes_per_member


@pytest.mark.parametrize("with_shN", [True, False])
def test_still_colors_match_the_differentiable_colors(with_shN: bool) -> None:
    case = small(count=1)
    view = case.views[0]
    still = crop_scene(case.scene, case.region.members, view.camera, view.box, WHITE, still=True)
    rows = pack(case.scene[case.region.members], with_shN=with_shN)
    rows[:, BASE_CHANNELS - 3 :] -= torch.linspace(0.0, 3.0, len(rows))[:, None]
    fast = still.render(rows)
    plain = still.render(rows.clone().requires_grad_())
    assert plain.requires_grad
    torch.testing.assert_close(fast, plain.detach(), atol=2e-6, rtol=0)
