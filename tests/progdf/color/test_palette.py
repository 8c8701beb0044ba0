"""Tests of the main colors of a region, and of hand-made color maps: palette and lightness curve."""

from __future__ import annotations

import pytest
import torch

from progdf.color import edits as color
from progdf.color import grade as grading
from progdf.color.oklab import srgb_to_oklab
from progdf.color.palette import COLORS, bend_lightness, find_palette, shift_palette
from tests.helpers.draws import Draws

LAWN, BEAR, SCARF, STONE = (color.parse_color(c) for c in ("#7eae44", "#b97a30", "#c01830", "#a09a90"))


def scene(counts: dict[int, torch.Tensor]) -> torch.Tensor:
    """Return the given number of colors around each key color. [N,3]"""
    draws = Draws(5)
    return torch.cat([c + 0.02 * draws.normal(n, 3).float() for n, c in counts.items()]).clamp(0, 1)


def test_palette_starts_with_large_colors_and_keeps_a_distinct_small_one() -> None:
    rgb = scene({6000: LAWN, 3000: BEAR, 1000: STONE, 150: SCARF})
    found = find_palette(rgb, torch.ones(len(rgb)))
    assert len(found) <= COLORS
    for place, expected in enumerate((LAWN, BEAR, STONE)):
        assert (found[place] - expected).abs().max() < 0.04
    assert (found - SCARF).abs().amax(dim=1).min() < 0.05
    assert len(find_palette(rgb, torch.zeros(len(rgb)))) == 0
    assert len(find_palette(LAWN.expand(50, 3), torch.ones(50))) == 1


def test_distinct_scarf_is_a_main_color_beside_similar_greens() -> None:
    pale = color.parse_color("#a4c860")
    dark = color.parse_color("#201810")
    rgb = scene({30_000: LAWN, 29_000: pale, 9000: BEAR, 8000: STONE, 7000: dark, 1000: SCARF})
    found = find_palette(rgb, torch.ones(len(rgb)))
    assert (found - SCARF).abs().amax(dim=1).min() < 0.1


def test_invisible_colors_are_not_in_the_palette() -> None:
    rgb = torch.stack([LAWN, SCARF])
    weights = torch.tensor([1.0, 0.0])
    assert torch.allclose(find_palette(rgb, weights), LAWN[None], atol=1e-5)


def test_palette_maps_sources_to_targets_and_holds_the_others() -> None:
    blue = color.parse_color("#3060d0")
    grade = grading.ColorGrade(palette=((LAWN, blue), (BEAR, BEAR), (STONE, STONE)))
    edited = grading.grade_fully(torch.stack([LAWN, BEAR, STONE]), grade)
    assert torch.allclose(edited, torch.stack([blue, BEAR, STONE]), atol=2e-3)
    lawn = scene({500: LAWN})
    assert (grading.grade_fully(lawn, grade).mean(dim=0) - blue).abs().max() < 0.06
    ends = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert torch.allclose(grading.grade_fully(ends, grade), ends, atol=5e-3)


def test_each_color_moves_fully_with_its_nearest_palette_color() -> None:
    blue = color.parse_color("#3060d0")
    lab = srgb_to_oklab(torch.stack([LAWN, BEAR, STONE, blue, color.parse_color("#a8d860")]))
    targets = torch.stack([lab[3], lab[1], lab[2]])
    lime = shift_palette(lab[4:], lab[:3], targets)[0]
    light = lab[4, 0] / lab[0, 0]
    assert torch.allclose(lime - lab[4], light * (lab[3] - lab[0]), atol=0.02)


def test_single_palette_color_moves_near_colors_and_leaves_far_ones() -> None:
    lab = srgb_to_oklab(torch.stack([SCARF, LAWN, STONE]))
    target = srgb_to_oklab(torch.tensor([[0.2, 0.3, 0.9]]))
    shifted = shift_palette(lab, lab[:1], target)
    assert torch.allclose(shifted[0], target[0], atol=1e-5)
    assert (shifted[1:] - lab[1:]).abs().max() < 0.02


def test_palette_map_has_no_steps() -> None:
    sources = srgb_to_oklab(torch.stack([LAWN, BEAR, STONE, SCARF]))
    targets = sources.clone()
    targets[0] = torch.tensor([0.5, 0.0, -0.15])
    line = torch.lerp(sources[0], sources[1], torch.linspace(0, 1, 2001)[:, None])
    steps = (shift_palette(line, sources, targets) - line).diff(dim=0).norm(dim=1)
    assert steps.max() < 12 * (targets[0] - sources[0]).norm() / 2000


@pytest.mark.parametrize("curve", [((0.25, 0.1), (0.75, 0.9)), ((0.5, 0.3),), ((0.0, 0.2), (1.0, 0.7))])
def test_lightness_curve_passes_its_points_and_stays_in_range(
    curve: tuple[tuple[float, float], ...],
) -> None:
    at = torch.tensor([x for x, _ in curve])
    assert torch.allclose(bend_lightness(at, curve), torch.tensor([y for _, y in curve]), atol=1e-3)
    bent = bend_lightness(torch.linspace(0, 1, 500), curve)
    assert (bent.diff() >= -1e-6).all()
    assert torch.allclose(bend_lightness(torch.linspace(0, 1, 9), ()), torch.linspace(0, 1, 9), atol=1e-6)


def test_lightness_curve_keeps_the_hue() -> None:
    grade = grading.ColorGrade(curve=((0.5, 0.35),))
    rgb = torch.stack([LAWN, BEAR])
    before = srgb_to_oklab(rgb)
    after = srgb_to_oklab(grading.grade_fully(rgb, grade))
    assert (after[:, 0] < before[:, 0] - 0.05).all()
    hues = [torch.atan2(lab[:, 2], lab[:, 1]) for lab in (before, after)]
    assert torch.allclose(*hues, atol=0.02)


def test_palette_and_curve_grade_is_exact_at_strength_0() -> None:
    grade = grading.ColorGrade(palette=((LAWN, SCARF),), curve=((0.5, 0.3),))
    rgb = scene({50: LAWN})
    assert torch.equal(grading.grade_course(rgb, grade)(0.0), rgb)


def test_curve_of_one_color_bends_only_nearby_colors() -> None:
    held = tuple((c, c) for c in (LAWN, BEAR, STONE))
    colors = torch.stack([LAWN, BEAR, STONE])
    lightness = srgb_to_oklab(LAWN)[0].item()
    darker = grading.ColorGrade(palette=held, palette_curves=(((lightness, lightness - 0.2),), (), ()))
    edited = srgb_to_oklab(grading.grade_fully(colors, darker))
    before = srgb_to_oklab(colors)
    assert edited[0, 0].item() == pytest.approx(lightness - 0.2, abs=5e-3)
    assert torch.allclose(edited[1:], before[1:], atol=2e-3)
    assert torch.allclose(edited[0, 1:] / edited[0, 0], before[0, 1:] / before[0, 0], atol=5e-3), (
        "in less light"
    )
    assert torch.equal(grading.grade_course(colors, darker)(0.0), colors), "exact at strength 0"
    assert not darker.is_neutral
    straight = grading.ColorGrade(palette=held, palette_curves=(((0.5, 0.5),), (), ()))
    assert straight.is_neutral
    assert torch.allclose(grading.grade_fully(colors, straight), colors, atol=2e-3)


def test_measured_grade_keeps_its_parsed_curves() -> None:
    parsed = grading.parse_grade("#7eae44=#4474ae/0.3:0.2,curve=0.5:0.4")
    measured = grading.measure_grade(parsed, scene({500: LAWN}), torch.ones(500))
    assert measured.palette_curves == parsed.palette_curves == (((0.3, 0.2),),)
    assert measured.curve == parsed.curve == ((0.5, 0.4),)
    assert len(measured.palette_shadings) == 1


def test_curve_of_one_color_has_no_steps() -> None:
    bent = grading.ColorGrade(
        palette=((LAWN, BEAR), (STONE, STONE)), palette_curves=(((0.4, 0.6), (0.8, 0.7)), ((0.5, 0.3),))
    )
    ramp = torch.lerp(LAWN, STONE, torch.linspace(0, 1, 2001)[:, None])
    steps = grading.grade_fully(ramp, bent).diff(dim=0).abs()
    assert steps.max() < 30 * ramp.diff(dim=0).abs().max()
