"""Parts that fade as wholes: found from pictures, carried exactly, and told from parts that move."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.gaussians import attribute_slices, pack, unpack
from progdf.similarity import Parts, make_parts
from tests.helpers.trained import WHITE, Small, small
from trainer.evaluate.suite.analytic_edits import AnalyticEdit, fade_edit, scale_edit
from trainer.motion.fade import FadePlacement
from trainer.motion.parts import connected_parts
from trainer.optimize.groups import Groups, group_path, group_stage, restore_groups
from trainer.views.crops import CropScene, crop_scene, render_all


def some_parts() -> tuple[Small, Tensor, Parts]:
    """Return a bear with its arms as the region, their packed rows, and the arms as two parts."""
    case = small("arms")
    rows = pack(case.scene[case.region.members], with_shN=True)
    return case, rows, make_parts(rows, connected_parts(rows[:, :3]))


def boxes(case: Small) -> list[CropScene]:
    return [crop_scene(case.scene, case.region.members, v.camera, v.box, WHITE) for v in case.views]


def opacities(rows: Tensor) -> Tensor:
    """Return the opacities of packed rows. [M,C] -> [M]"""
    return rows[:, attribute_slices(rows.shape[1])["logit_opacities"]].sigmoid()[:, 0]


def edited(case: Small, rows: Tensor, crops: list[CropScene], edit: AnalyticEdit, s: float) -> list[Tensor]:
    """Return the boxes at one strength of an edit."""
    part = edit.change(unpack(rows, rows.new_zeros(0)), s)
    return render_all(crops, pack(part, with_shN=True))


@pytest.mark.parametrize("seed", range(3))
def test_fading_parts_are_found_at_every_strength(seed: int) -> None:
    case, rows, parts = some_parts()
    crops = boxes(case)
    left = torch.rand(2, generator=torch.Generator().manual_seed(seed)).round(decimals=1)
    strengths = (0.3, 1.0)
    shares = [torch.lerp(torch.ones(2), left, s) for s in strengths]
    nothing = torch.zeros_like(rows)
    targets = [render_all(crops, rows + FadePlacement(parts, share).carry(rows, nothing)) for share in shares]
    found = group_stage(rows, crops, targets, steps=12, strengths=strengths)
    assert len(found.fades) == 2
    for fade, share in zip(found.fades, shares, strict=True):
        assert torch.allclose(fade.share, share, atol=0.03)
    kept = restore_groups(rows, found.capture_state())
    assert all(torch.equal(a.share, b.share) for a, b in zip(kept.fades, found.fades, strict=True))


def test_removed_parts_are_not_moved_out_of_sight() -> None:
    case, rows, _ = some_parts()
    crops = boxes(case)
    found = group_stage(rows, crops, [edited(case, rows, crops, fade_edit(), 1.0)], steps=12)
    assert float(found.fades[0].share.max()) < 0.02
    assert not any(bool(values.any()) for motion in found.motions for values in vars(motion).values())
    assert "of its opacity is left" in found.lines()[0]


def test_grown_parts_do_not_fade() -> None:
    case, rows, parts = some_parts()
    crops = boxes(case)
    targets = edited(case, rows, crops, scale_edit(1.4, parts.centers), 1.0)
    assert group_stage(rows, crops, [targets], steps=12).fades == ()


def test_faded_offsets_can_be_carried_back() -> None:
    _, rows, parts = some_parts()
    offsets = 0.1 * torch.randn(rows.shape, generator=torch.Generator().manual_seed(1))
    for share in ([0.0, 1.0], [0.4, 0.9]):
        placed = FadePlacement(parts, torch.tensor(share))
        there = placed.carry(rows, offsets)
        assert torch.allclose(placed.carry_back(rows, there), offsets, atol=1e-5)
        kept = parts.part == 1
        if share[1] == 1.0:
            assert torch.equal(there[kept], offsets[kept])
    columns = torch.ones(rows.shape[1], dtype=torch.bool)
    columns[attribute_slices(rows.shape[1])["logit_opacities"]] = False
    assert torch.equal(there[:, columns], offsets[:, columns])


def test_opacity_of_a_path_is_linear_between_its_exact_ends() -> None:
    _, rows, parts = some_parts()
    placed = [FadePlacement(parts, torch.tensor(share)) for share in ([0.6, 1.0], [0.2, 0.5])]
    ends = [one.carry(rows, torch.zeros_like(rows)) for one in placed]
    groups = Groups(parts, (parts.rest_motion(),) * 2, fades=tuple(placed))
    path = group_path(rows, groups, ends, [10, 20], 8)
    begin = torch.ones(2)
    for stage, one in enumerate(placed):
        for i, snapshot in enumerate(path[4 * stage : 4 * stage + 4], start=1):
            expected = torch.lerp(begin, one.share, i / 4)[parts.part] * opacities(rows)
            assert torch.allclose(opacities(rows + snapshot.offsets.float()), expected, atol=2e-3)
        begin = one.share
    assert torch.equal(path[3].offsets, ends[0].half())
    assert torch.equal(path[7].offsets, ends[1].half())


def test_full_fade_stays_finite_and_is_not_drawn() -> None:
    case, rows, parts = some_parts()
    clear = replace(unpack(rows, rows.new_zeros(0)), logit_opacities=torch.full((len(rows),), -12.0))
    for members in (rows, pack(clear, with_shN=True)):  # opaque, and clearer than the least opacity
        gone = members + FadePlacement(parts, torch.zeros(2)).carry(members, torch.zeros_like(members))
        assert bool(gone.isfinite().all())
        assert float(opacities(gone).max()) < 1 / 255
        assert bool((opacities(gone) <= opacities(members)).all())
    crops = boxes(case)
    background = render_all(crops, pack(clear, with_shN=True))
    for drawn, expected in zip(render_all(crops, gone), background, strict=True):
        assert torch.equal(drawn, expected)
