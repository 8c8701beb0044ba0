"""Path of an edit of which only the end is known."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from progdf.color.oklab import oklab_to_srgb, srgb_to_oklab
from progdf.field.baked import identity_map
from progdf.field.trajectory import Trajectory
from progdf.gaussians import attribute_slices
from progdf.sh import C0
from trainer.fit.color_path import KNOTS, find_end_path, fit_colors_map

COUNT = 200
SH0 = attribute_slices(14)["sh0"]
OPACITY = attribute_slices(14)["logit_opacities"]


def lab_colors(hue: float, chroma: float) -> Tensor:
    """Return sRGB colors of one hue with varied lightness. [COUNT,3]"""
    lightness = torch.linspace(0.45, 0.75, COUNT)
    angle = torch.tensor(hue)
    lab = torch.stack([lightness, *(chroma * f(angle).expand(COUNT) for f in (torch.cos, torch.sin))], dim=1)
    return oklab_to_srgb(lab).clamp(0, 1)


def line_between(before: Tensor, after: Tensor, maps: Tensor | None = None) -> tuple[Trajectory, Tensor]:
    """Return the straight recording between two colorings, and the rows before."""
    rows = torch.zeros(COUNT, 14)
    rows[:, SH0] = (before - 0.5) / C0
    end = torch.zeros(COUNT, 14)
    end[:, SH0] = (after - before) / C0
    offsets = torch.stack([torch.zeros_like(end), end]).half()
    line = Trajectory(torch.tensor([0.0, 1.0]), offsets, end, torch.tensor([0, 9]), (1,), (1.0,), maps)
    return line, rows


def chroma(rows: Tensor) -> float:
    """Return the mean chroma of the base colors in OKLab."""
    return float(srgb_to_oklab((rows[:, SH0] * C0 + 0.5).clamp(0, 1))[:, 1:].norm(dim=1).mean())


@pytest.mark.parametrize("with_map", [False, True])
def test_nearly_opposite_hues_do_not_pass_through_gray(with_map: bool) -> None:
    before = lab_colors(0.0, 0.12)
    after = lab_colors(2.7, 0.12)
    maps = fit_colors_map(before, after, torch.ones(COUNT), 2)[None] if with_map else None
    line, rows = line_between(before, after, maps)
    path = find_end_path(line, rows, torch.ones(COUNT))
    found = path.trajectory
    assert len(found) == KNOTS
    assert torch.equal(found.end, line.end)
    assert not found.offsets[0].any()
    assert chroma(rows + line.at(0.5)) < 0.05
    assert chroma(rows + found.at(0.5)) > chroma(rows + line.at(0.5)) + 0.02
    assert "bowed in OKLab" in path.reason
    if with_map:
        assert found.maps is not None
        assert torch.equal(found.map_course[1][0], identity_map(2))
        assert torch.equal(found.map_course[1][-1], maps[0])  # type: ignore[index]


def test_change_of_lightness_alone_stays_straight() -> None:
    gray = torch.linspace(0.2, 0.8, COUNT)[:, None].expand(COUNT, 3)
    line, rows = line_between(gray, gray + 0.02)
    path = find_end_path(line, rows, torch.ones(COUNT))
    assert path.trajectory is line
    assert path.reason.startswith("no picture in between: straight")


def test_residual_of_a_map_fades_in_evenly() -> None:
    before = lab_colors(0.0, 0.12)
    after = lab_colors(2.7, 0.12)
    table = fit_colors_map(before, after, torch.ones(COUNT), 2)[None]
    noise = 0.05 * torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(2))
    plain = find_end_path(*line_between(before, after, table), torch.ones(COUNT)).trajectory
    noisy = find_end_path(*line_between(before, after + noise, table), torch.ones(COUNT)).trajectory
    for i, s in enumerate(plain.s):
        added = (noisy.node(i) - plain.node(i))[:, SH0]
        assert torch.allclose(added, float(s) * noise / C0, atol=4e-3)


def test_vanishing_gaussians_fade_evenly() -> None:
    gray = torch.full((COUNT, 3), 0.5)
    line, rows = line_between(gray, gray)
    rows[:, OPACITY] = 3.0
    line.end[:, OPACITY] = -11.0
    found = find_end_path(line, rows, torch.ones(COUNT))
    assert found.fades
    for s in (0.25, 0.5, 0.75):
        opacity = (rows + found.trajectory.at(s))[:, OPACITY].sigmoid()
        assert torch.allclose(opacity, torch.tensor(3.0).sigmoid() * (1 - s), atol=0.01)
    assert "fade evenly" in found.reason
