"""Tests of the sample on which the packing of a large color edit is chosen."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import Tensor

import trainer.fit.grades
from progdf.field.baked import GradeForm, identity_map
from progdf.field.grade import bake_grade, map_colors, member_bands
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, pack
from tests.helpers.trained import WHITE, Small, small
from trainer.fit.evaluate import Evaluator, make_evaluator, sample_members
from trainer.fit.fit import field_evaluator
from trainer.fit.grades import PackingScale, fit_grades, grade_packing
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
        trainer.fit.grades, "sample_members", partial(sample_members, budget=3 * len(case.region) // 4)
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


@pytest.mark.parametrize("target_psnr", [None, 40.0])
def test_weighed_packings_have_the_errors_of_drawn_ones(target_psnr: float | None) -> None:
    case = small("body", count=3)
    trajectory = recolored(case)
    views = evaluator_of(case, trajectory)
    judge = field_evaluator(trajectory, views, FieldOptions(target_psnr=target_psnr))
    packing = grade_packing(trajectory, rows_of(case), torch.ones(len(case.region)))
    scale = PackingScale(packing, views, judge)
    for rank, index in ((0, 0), (1, 0), (1, 20)):
        form = packing.fit(rank, index)
        weighed = scale.candidate(form)
        baked = bake_grade(form, packing.rows, packing.mapped.clone())
        drawn = judge.candidate(baked, form.label)
        assert weighed.excess == pytest.approx(drawn.excess, rel=0.05, abs=0.02)
        assert weighed.mean == pytest.approx(drawn.mean, abs=0.3)
        assert weighed.field.bytes_per_member == drawn.field.bytes_per_member
        if target_psnr is None:
            assert weighed.to_editor == pytest.approx(drawn.to_editor, abs=0.02)


def test_unbaked_grade_has_the_offsets_of_the_baked_one() -> None:
    case = small("body", count=2)
    packing = grade_packing(recolored(case), rows_of(case), torch.ones(len(case.region)))
    form = packing.fit(1, 8)
    baked = bake_grade(form, packing.rows, packing.mapped.clone())
    for s in (0.0, 0.4, 1.0):
        torch.testing.assert_close(
            packing.plain_field(form).offsets(s), baked.offsets(s), atol=1e-5, rtol=1e-5
        )


def test_packing_of_some_members_is_a_part_of_the_whole() -> None:
    case = small("body", count=2)
    packing = grade_packing(recolored(case), rows_of(case), torch.ones(len(case.region)))
    members = torch.arange(0, len(case.region), 3)
    part = packing.take(members).fit(1, 4)
    whole = packing.fit(1, 4)
    assert torch.equal(part.residual, whole.residual[:, members])


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


def test_change_of_bands_is_the_linear_part_of_a_picture() -> None:
    case = small(count=1)
    view = case.views[0]
    still = crop_scene(case.scene, case.region.members, view.camera, view.box, WHITE, still=True)
    rows = rows_of(case)
    bands = member_bands(rows)
    generator = torch.Generator().manual_seed(3)
    change = 1e-3 * torch.randn(bands[:, :4].shape, generator=generator)
    moved = rows.clone()
    moved[:, BASE_CHANNELS - 3 : BASE_CHANNELS + 9] += change.flatten(1)
    brighter = torch.zeros_like(rows)
    brighter[:, BASE_CHANNELS - 3 : BASE_CHANNELS] = 3.0  # above the limit at black
    weights = still._linear[0]
    difference = still.still_colors(moved + brighter) - still.still_colors(rows + brighter)
    torch.testing.assert_close(still.change(change), weights.picture(difference), atol=2e-6, rtol=0)
