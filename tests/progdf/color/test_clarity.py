"""Clarity: local contrast per Gaussian."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from progdf.color.clarity import clarify, local_detail
from progdf.color.grade import ColorGrade, grade_fully
from progdf.color.oklab import hue_of, srgb_to_oklab
from progdf.gaussians import Gaussians
from progdf.sh import C0


def sheet(colors: torch.Tensor) -> Gaussians:
    """Return a flat sheet of Gaussians, 40 along each side."""
    steps = torch.linspace(-1.0, 1.0, 40)
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    count = x.numel()
    return Gaussians(
        torch.stack([x.flatten(), y.flatten(), torch.zeros(count)], dim=1),
        torch.eye(4)[:1].expand(count, 4).clone(),
        torch.full((count, 3), -3.7),
        torch.full((count,), 2.0),
        (colors - 0.5) / C0,
        torch.zeros(count, 0, 3),
    )


COLORS = 0.2 + 0.5 * torch.rand(1600, 3, generator=torch.Generator().manual_seed(0))
ROWS = torch.arange(1600)


def lightness(rgb: torch.Tensor) -> torch.Tensor:
    return srgb_to_oklab(rgb)[:, 0]


def test_clarity_at_0_returns_the_colors_bit_for_bit() -> None:
    detail = local_detail(sheet(COLORS), ROWS)
    assert torch.equal(clarify(COLORS, detail, 0.0), COLORS)
    flat = local_detail(sheet(torch.full_like(COLORS, 0.4)), ROWS)
    assert flat.abs().max() < 1e-6, "a single color has no detail"


@pytest.mark.parametrize("value", [-1.0, -0.5, 0.5, 1.0])
def test_clarity_scales_the_local_contrast_and_keeps_hues(value: float) -> None:
    scene = sheet(COLORS)
    detail = local_detail(scene, ROWS)
    edited = clarify(COLORS, detail, value)
    change = lightness(edited) - lightness(COLORS)
    assert torch.allclose(change, value * detail, atol=2e-3), "the gamut's tolerance"
    contrast = local_detail(sheet(edited), ROWS).std() / detail.std()
    assert contrast == pytest.approx(1.0 + value, abs=0.3)
    before = srgb_to_oklab(COLORS)
    after = srgb_to_oklab(edited)
    colored = (before[:, 1:].norm(dim=1) > 0.02) & (after[:, 1:].norm(dim=1) > 0.02)
    turn = torch.remainder(hue_of(after) - hue_of(before) + torch.pi, 2 * torch.pi) - torch.pi
    assert turn[colored].abs().max() < 0.06, "radians; the gamut's tolerance"


def test_large_gradients_have_little_detail() -> None:
    ramp = torch.linspace(0.2, 0.8, 1600)[:, None].expand(-1, 3)
    assert local_detail(sheet(ramp), ROWS).abs().mean() < 0.01
    assert local_detail(sheet(COLORS), ROWS).abs().mean() > 0.03


def test_broken_gaussians_have_finite_detail() -> None:
    scene = sheet(COLORS)
    means = scene.means.clone()
    means[3] = torch.nan
    means[4] = 1e30
    scales = scene.log_scales.clone()
    scales[5] = 80.0
    detail = local_detail(replace(scene, means=means, log_scales=scales), ROWS)
    assert detail.isfinite().all()
    assert (detail[100:] - local_detail(scene, ROWS)[100:]).abs().mean() < 0.02
    assert local_detail(scene, ROWS[:0]).shape == (0,)


def test_grade_applies_clarity_where_the_detail_is_known() -> None:
    detail = local_detail(sheet(COLORS), ROWS)
    grade = ColorGrade({"clarity": 0.5})
    assert not grade.is_neutral
    assert torch.allclose(grade_fully(COLORS, grade, detail), clarify(COLORS, detail, 0.5), atol=1e-3)
    assert torch.allclose(grade_fully(COLORS, grade), COLORS, atol=1e-3)
