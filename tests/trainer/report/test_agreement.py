"""Agreement of edited views, measured before training."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import pytest
import torch
from torch import Tensor

from progdf.rasterize import render
from tests.helpers.trained import WHITE, Small, small
from trainer.editors import EDITORS, make_editor
from trainer.options import EditorOptions
from trainer.report.agreement import Agreement, fit_colors, measure_agreement, view_change
from trainer.views.setup import TrainingSetup
from trainer.views.view import crop, render_colors


@cache
def setup() -> TrainingSetup:
    case = body()
    return TrainingSetup(case.scene, case.region, case.views[:-3], case.views[-3:], WHITE)


def body() -> Small:
    """Return the body with 12 views; the last three stand between the others."""
    case = small("body", count=12, image_size=96)
    others = [view for i, view in enumerate(case.views) if i % 4]
    return replace(case, views=(*others, *case.views[::4]))


def judged(pictures: list[Tensor]) -> Agreement:
    count = len(setup().train)
    return measure_agreement(setup(), pictures[:count], pictures[count:])


def edited(spec: str) -> list[Tensor]:
    case = body()
    editor = make_editor(EditorOptions(spec), case.scene, case.region, case.views)
    return [editor.edit(view, 1.0) for view in case.views]


def stripes_of_its_own(period: float, seed: int) -> list[Tensor]:
    """Return every view with stripes in its own random direction."""
    rng = torch.Generator().manual_seed(seed)
    pictures = []
    for view in body().views:
        angle = math.pi * float(torch.rand((), generator=rng))
        phase = float(torch.rand((), generator=rng))
        y, x = torch.meshgrid(
            torch.arange(view.mask.shape[0]), torch.arange(view.mask.shape[1]), indexing="ij"
        )
        striped = ((x * math.cos(angle) + y * math.sin(angle)) / period + phase) % 1 < 0.5
        pictures.append(
            view.blend(torch.where(striped[..., None], torch.tensor([0.1, 0.6, 0.2]), view.inside))
        )
    return pictures


@pytest.mark.parametrize("spec", ["recolor:#3060d0", "stripes:#20a040", "night"])
def test_edits_consistent_across_views_agree(spec: str) -> None:
    found = judged(edited(spec))
    assert found.agree
    assert found.unexplained < 0.15
    assert found.psnr > 22


@pytest.mark.parametrize("period", [9, 18, 36])
def test_stripes_painted_differently_in_every_view_disagree(period: float) -> None:
    found = judged(stripes_of_its_own(period, seed=1))
    assert not found.agree
    assert found.unexplained > 0.45


def test_another_hue_in_every_view_disagrees() -> None:
    rng = torch.Generator().manual_seed(2)
    pictures = []
    for view in body().views:
        hue = torch.rand(3, generator=rng)
        pictures.append(view.blend(torch.lerp(view.inside, hue.expand_as(view.inside), 0.6)))
    assert not judged(pictures).agree


def test_invisible_differences_are_no_disagreement() -> None:
    rng = torch.Generator().manual_seed(3)
    pictures = [
        view.blend((view.inside + 0.02 * torch.randn(3, generator=rng)).clamp(0, 1)) for view in body().views
    ]
    found = judged(pictures)
    assert found.psnr > 28
    assert found.agree


def test_colors_that_members_can_have_are_explained() -> None:
    case = body()
    rng = torch.Generator().manual_seed(4)
    changed = case.scene.sh0.clone()
    changed[case.region.members] += 0.3 * torch.randn(len(case.region.members), 3, generator=rng)
    scene = case.scene.__class__(**{**case.scene.__dict__, "sh0": changed})
    pictures = [render(scene, view.camera, WHITE).image.clamp(0, 1) for view in case.views]
    found = judged(pictures)
    assert found.unexplained < 0.35, "noise in every Gaussian is the hardest that one scene can show"
    assert found.agree


def test_summary_line_has_decibels_share_and_remedy() -> None:
    alone = "one held-out view alone"
    line = Agreement(psnr=12.34, unexplained=0.61, unexplained_fine=0.8).line(EDITORS["style"].remedy, alone)
    assert line.startswith("the edited views disagree: no 3D scene shows all of them, best possible 12.3 dB")
    assert f"dB on {alone}" in line
    assert "61% of the change, 80% of its fine part; use a calmer style" in line
    assert "\n" not in line
    agreed = Agreement(psnr=25.0, unexplained=0.1).line(EDITORS["style"].remedy, alone)
    assert agreed.startswith(f"the edited views agree: on {alone} the best colors reach 25.0 dB")


def test_measuring_twice_gives_the_same_figures() -> None:
    pictures = edited("recolor:#3060d0")
    assert judged(pictures) == judged(pictures)


def test_smooth_color_change_is_explained() -> None:
    case = body()
    change = torch.zeros(len(case.scene), 3)
    change[case.region.members] = 0.3 * case.scene.means[case.region.members, 1:2]
    pictures = [v.image + render_colors(case.scene, change, v.camera, torch.zeros(3)) for v in case.views]
    assert judged(pictures).unexplained < 0.04, "without conjugate directions it is .055"


@dataclass(frozen=True)
class LinearSight:
    """View whose picture is a known matrix [P,M] times the colors."""

    matrix: Tensor
    change: Tensor

    def render(self, colors: Tensor) -> Tensor:
        return self.matrix @ colors

    def gather(self, picture: Tensor, members: int) -> Tensor:
        return self.matrix.T @ picture


def test_fit_is_the_damped_least_squares_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("trainer.report.agreement.DAMPING", 0.2)
    rng = torch.Generator().manual_seed(5)
    changes = [
        LinearSight(torch.randn(9, 5, generator=rng), torch.randn(9, 3, generator=rng)) for _ in range(2)
    ]
    A = torch.cat([s.matrix for s in changes])
    b = torch.cat([s.change for s in changes])
    slope = A.T @ b
    damping = 0.2 * (A @ slope).square().sum() / slope.square().sum()
    expected = torch.linalg.solve(A.T @ A + damping * torch.eye(5), slope)
    found = fit_colors(changes, 5)  # type: ignore[arg-type]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_decibels_count_the_residual_where_held_out_views_change() -> None:
    count = len(setup().train)
    pictures = [view.image for view in body().views]
    for view, i in zip(setup().held_out, range(count, len(pictures)), strict=True):
        pictures[i] = view.image + 0.1 * (view.mask < 0.01)[..., None]  # all around the region
    found = judged(pictures)
    assert found.unexplained == pytest.approx(1.0)
    changed = sum(float(crop(v.mask < 0.01, v.box).sum()) for v in setup().held_out)
    counted = sum(float(crop((v.mask < 0.01) | (v.mask > 0.05), v.box).sum()) for v in setup().held_out)
    assert found.psnr == pytest.approx(20 + 10 * math.log10(counted / changed), abs=0.1)


def test_unchanged_views_agree_without_residual() -> None:
    found = judged([view.image for view in body().views])
    assert found == Agreement(99.0, 0.0)
    assert found.figures() == {
        "psnr_best": 99.0,
        "unexplained": 0.0,
        "unexplained_fine": 0.0,
        "contrast": 1.0,
        "agree": True,
    }


def test_half_size_box_keeps_odd_pixels_at_their_position() -> None:
    view = replace(body().views[0], box=(11, 20, 61, 75))
    x, y = torch.meshgrid(torch.arange(96.0), torch.arange(96.0), indexing="xy")
    ramp = torch.stack([0.1 + x / 200, 0.1 + y / 200, torch.full_like(x, 0.2)], dim=2)
    found = view_change(setup(), view, view.image + ramp)
    halved = torch.nn.functional.avg_pool2d(ramp.permute(2, 0, 1)[None], 2)[0].permute(1, 2, 0)
    torch.testing.assert_close(found.change, halved[10:38, 5:31], atol=1e-5, rtol=0)
    assert found.scene.box == (5, 10, 31, 38)
