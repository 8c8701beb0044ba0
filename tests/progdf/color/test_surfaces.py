"""Property tests of surfaces: shades of one are one swatch, which a grade changes as a whole."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.color import edits as color
from progdf.color import grade as grading
from progdf.color.oklab import oklab_to_srgb, srgb_to_oklab
from progdf.color.palette import find_palette, find_shades
from progdf.color.surfaces import (
    EVEN_SEPARATION,
    best_division,
    find_surfaces,
    is_one_paint,
    lightness_borders,
)
from tests.helpers.draws import Draws

PAINTS = ("#ffffff", "#f4efe6", "#c8c4bc", "#808080", "#3c3a38", "#e07b1a", "#2a6a9a", "#7eae44")
ORANGE = color.parse_color("#e07b1a")
BLUE = color.parse_color("#1c3fa8")


def lit(paint: str, seed: int, count: int = 4000, darkest: float = 0.55) -> Tensor:
    """Return colors of one paint in evenly distributed lightness, with a little noise. [count,3]"""
    draws = Draws(seed)
    light = darkest + (1.0 - darkest) * draws.uniform(count, 1)
    lab = light * srgb_to_oklab(color.parse_color(paint)) + 0.003 * draws.normal(count, 3)
    return oklab_to_srgb(lab.float()).clamp(0, 1)


def printed(seed: int, ink: int, edge: int) -> Tensor:
    """Return colors of 3000 pixels of white paper, of black ink, and of edges that mix both. [N,3]"""
    draws = Draws(seed)
    paper = 0.92 + 0.03 * draws.normal(3000, 1)
    black = 0.12 + 0.03 * draws.normal(ink, 1)
    mixed = 0.12 + 0.8 * draws.uniform(edge, 1)
    return torch.cat([paper, black, mixed]).float().clamp(0, 1).expand(-1, 3)


def palette(rgb: Tensor) -> Tensor:
    return find_palette(rgb, torch.ones(len(rgb)))


@pytest.mark.parametrize("paint", PAINTS)
def test_shades_of_one_surface_are_one_swatch(paint: str) -> None:
    for seed in range(4):
        found = palette(lit(paint, seed))
        assert len(found) == 1
        assert is_one_paint(srgb_to_oklab(found[0]), srgb_to_oklab(color.parse_color(paint)))


@pytest.mark.parametrize(("ink", "edge"), [(2000, 0), (1500, 1200), (120, 0)])
def test_white_paper_and_black_ink_are_two_swatches(ink: int, edge: int) -> None:
    for seed in range(4):
        lightness = srgb_to_oklab(palette(printed(seed, ink, edge)))[:, 0]
        assert len(lightness) == 2
        assert lightness[0] > 0.85
        assert lightness[1] < 0.45


def test_overexposed_and_shaded_side_are_one_swatch() -> None:
    """Lightness of a white pot: more of its two sides than between them, but no gap."""
    draws = Draws(1)
    shaded = 0.7 + 0.08 * draws.normal(1200, 1)
    between = 0.65 + 0.33 * draws.uniform(2500, 1)
    clipped = 0.97 + 0.02 * draws.normal(800, 1)
    lightness = torch.cat([shaded, between, clipped]).clamp(0, 1)
    lab = torch.cat([lightness, torch.zeros(4500, 2)], dim=1).float()
    assert len(palette(oklab_to_srgb(lab))) == 1


def test_white_cloth_black_cloth_and_a_scarf_are_three_swatches() -> None:
    rgb = torch.cat(
        [lit("#ffffff", 1, 6000), lit("#242424", 2, 2000, darkest=0.8), lit("#c01830", 3, 400, darkest=0.9)]
    )
    found = palette(rgb)
    assert len(found) == 3
    assert int(((found.amax(dim=1) - found.amin(dim=1)) < 0.1).sum()) == 2


def test_surfaces_of_another_hue_stay_apart() -> None:
    fur, stone = "#806347", "#baa994"
    assert len(palette(torch.cat([lit(fur, 1, darkest=0.9), lit(stone, 2, darkest=0.7)]))) == 2
    assert not is_one_paint(*(srgb_to_oklab(color.parse_color(c)) for c in (fur, stone)))
    warm, cool = (srgb_to_oklab(color.parse_color(c)) for c in ("#f8eedd", "#f0f2f8"))
    assert is_one_paint(warm, cool)


def test_even_lightness_has_no_border_and_a_gap_has_one() -> None:
    ramp = torch.linspace(0, 1, 2001)
    division, explained = best_division(ramp, torch.ones(2001))
    assert division == pytest.approx(0.5, abs=1e-3)
    assert explained == pytest.approx(EVEN_SEPARATION, abs=1e-3)
    assert lightness_borders(0.4 + 0.6 * ramp, torch.ones(2001)) == []
    apart = torch.cat([0.2 + 0.1 * ramp, 0.7 + 0.2 * ramp])
    (border,) = lightness_borders(apart, torch.ones(len(apart)))
    assert 0.3 < border < 0.7
    assert best_division(ramp[:1], torch.ones(1))[1] == 0.0


def test_invisible_colors_have_no_surface() -> None:
    assert find_surfaces(lit("#ffffff", 1), torch.zeros(4000)) == []


@pytest.mark.parametrize("target", [ORANGE, BLUE])
@pytest.mark.parametrize("paint", ["#f4efe6", "#808080", "#7eae44"])
def test_changed_swatch_changes_all_its_shades_and_no_other(paint: str, target: Tensor) -> None:
    cloth = lit(paint, 1)
    skin = lit("#c08060", 2, 1500, darkest=0.9)
    rgb = torch.cat([cloth, skin])
    found = palette(rgb)
    assert len(found) == 2
    grade = grading.ColorGrade(palette=((found[0], target), (found[1], found[1])))
    edited = grading.grade_fully(rgb, grading.measure_grade(grade, rgb, torch.ones(len(rgb))))
    before = srgb_to_oklab(cloth)
    after = srgb_to_oklab(edited[: len(cloth)])
    goal = srgb_to_oklab(target)[1:]
    along = after[:, 1:] @ (goal / goal.norm())
    assert along.min() > 0.4 * goal.norm(), "no part keeps the old color"
    assert torch.corrcoef(torch.stack([before[:, 0], after[:, 0]]))[0, 1] > 0.95
    assert (edited[len(cloth) :] - skin).abs().mean() < 0.02


def test_sources_on_one_surface_share_its_shades() -> None:
    rgb = torch.cat([lit("#ffffff", 1, 6000, darkest=0.5), lit("#7eae44", 2, 1500, darkest=0.9)])
    weights = torch.ones(len(rgb))
    surface, lawn = find_surfaces(rgb, weights)
    assert len(surface.shades) >= 3
    swatches = torch.stack([surface.color, lawn.color])
    moved, none = find_shades(rgb, weights, swatches)
    assert len(moved) == len(surface.shades) - 1
    assert len(none) == 0
    both = torch.cat([swatches, moved[:1]])
    assert sum(map(len, find_shades(rgb, weights, both))) == len(moved) - 1
    assert [len(own) for own in find_shades(rgb, weights, swatches[:1])] == [0], "a single source"


def test_sources_and_shades_keep_exact_weights() -> None:
    """Held swatches stay exact, and each shade has the hue of its changed swatch."""
    rgb = torch.cat([lit("#ffffff", 1, 6000, darkest=0.5), lit("#7eae44", 2, 1500)])
    found = palette(rgb)
    grade = grading.ColorGrade(palette=((found[0], BLUE), (found[1], found[1])))
    measured = grading.measure_grade(grade, rgb, torch.ones(len(rgb)))
    assert torch.allclose(grading.grade_fully(found, measured), torch.stack([BLUE, found[1]]), atol=2e-3)
    shades = oklab_to_srgb(measured.palette_shades[0]).clamp(0, 1).float()
    apart = grading.grade_fully(shades, replace(measured, palette_shades=()))
    joined = grading.grade_fully(shades, measured)
    goal = srgb_to_oklab(BLUE)[1:]
    chroma = [(srgb_to_oklab(rgb)[:, 1:] @ (goal / goal.norm())).min() for rgb in (apart, joined)]
    assert chroma[1] >= chroma[0]
    assert torch.equal(grading.grade_course(rgb, measured)(0.0), rgb), "exact at strength 0"
