"""Property tests of new paint in the same light: hue, chroma and lightness relation, for any source."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from progdf.color import edits as color
from progdf.color import grade as grading
from progdf.color.oklab import srgb_to_oklab
from progdf.color.palette import bend_lightness, with_highlights
from progdf.color.shading import (
    JND,
    Shading,
    measure_shading,
    nearest_lightness,
    paint_lightness,
    relight,
    weighted_quantiles,
)
from tests.helpers.draws import Draws

TARGETS = [color.parse_color(c) for c in ("#e07b1a", "#1c3fa8", "#f4b8c8", "#000000", "#ffffff", "#2f8f3a")]
BASES = ("#000000", "#0c0c0e", "#3a3836", "#808080", "#d8d0c0", "#f4f4f4", "#ffffff", "#b01818", "#2a5a8a")


def surface(base: str, spread: float, seed: int, level: float = 1.0) -> Tensor:
    """Return colors of one surface in light of different strengths around a level. [2000,3]"""
    light = (1.0 + spread * Draws(seed).normal(2000, 1)).clamp(0.2, 2.0)
    return (level * color.parse_color(base) * light).clamp(0, 1)


def edited(rgb: Tensor, target: Tensor, edit: str) -> Tensor:
    source = color.measure_color(rgb)
    if edit == "recolor":
        return color.recolor_fully(rgb, target, source)
    grade = grading.ColorGrade(palette=((source.color, target),))
    return grading.grade_fully(rgb, grading.measure_grade(grade, rgb, torch.ones(len(rgb))))


@pytest.mark.parametrize("edit", ["recolor", "grade"])
@pytest.mark.parametrize("base", BASES)
def test_any_source_gets_the_chosen_hue_and_chroma(base: str, edit: str) -> None:
    for seed, spread in enumerate((0.02, 0.1, 0.2)):
        rgb = surface(base, spread, seed)
        for target in TARGETS:
            middle = srgb_to_oklab(edited(rgb, target, edit))[:, 1:].median(dim=0).values
            assert (middle - srgb_to_oklab(target)[1:]).norm() <= JND


@pytest.mark.parametrize("base", BASES[1:])
def test_any_source_keeps_its_shading(base: str) -> None:
    for seed, (spread, level) in enumerate(((0.05, 0.85), (0.15, 0.65))):
        rgb = surface(base, spread, seed, level)
        before = srgb_to_oklab(rgb)[:, 0]
        order = before.argsort()
        for target in TARGETS:
            after = srgb_to_oklab(edited(rgb, target, "recolor"))[:, 0]
            assert (after[order].diff() > -2e-3).all(), "lighter stays lighter"
            assert torch.corrcoef(torch.stack([before, after]))[0, 1] >= 0.95


def test_brightest_white_takes_the_color() -> None:
    """The lightest pixels of a white surface are no highlights, so no white core remains."""
    rgb = torch.linspace(0.7, 1.0, 500)[:, None].expand(-1, 3)
    for edit in ("recolor", "grade"):
        brightest = srgb_to_oklab(edited(rgb, TARGETS[0], edit)[-1])
        chroma = srgb_to_oklab(TARGETS[0])[1:].norm()
        assert brightest[1:].norm() > 0.75 * chroma


def test_white_in_warm_and_cool_light_is_one_surface() -> None:
    """The colored light of the scene does not split a white cloth into a recolored and a pale part."""
    light = torch.linspace(0.75, 1.0, 200)[:, None]
    warm = light * color.parse_color("#f8eedd")
    cool = light * color.parse_color("#f0f2f8")
    grade = grading.ColorGrade(palette=((color.parse_color("#f8eedd"), TARGETS[0]),))
    rgb = torch.cat([warm, cool])
    lab = srgb_to_oklab(grading.grade_fully(rgb, grading.measure_grade(grade, rgb, torch.ones(400))))
    chroma = lab[:, 1:].norm(dim=1)
    assert chroma[200:].median() > 0.65 * chroma[:200].median()


@pytest.mark.parametrize("target", TARGETS)
def test_changed_white_swatch_has_one_hue_in_warm_and_cool_light(target: torch.Tensor) -> None:
    light = torch.linspace(0.8, 1.0, 200)[:, None]
    warm = light * color.parse_color("#e9d5b6")
    cool = light * color.parse_color("#ebe9e9")
    dots = light * color.parse_color("#373336")
    swatch = color.parse_color("#dac5ab")
    dark = color.parse_color("#373336")
    grade = grading.ColorGrade(palette=((swatch, target), (dark, dark)))
    rgb = torch.cat([warm, cool, dots])
    lab = srgb_to_oklab(grading.grade_fully(rgb, grading.measure_grade(grade, rgb, torch.ones(600))))
    goal = srgb_to_oklab(target)[1:]
    ray = goal / goal.norm().clamp_min(1e-6)
    for half in (lab[:200, 1:], lab[200:400, 1:]):
        aside = half - (half @ ray)[:, None] * ray
        assert aside.norm(dim=1).median() < JND
    unchanged = grading.ColorGrade(palette=((swatch, swatch), (dark, dark)))
    same = grading.grade_fully(rgb, grading.measure_grade(unchanged, rgb, torch.ones(600)))
    assert torch.allclose(same, rgb, atol=1e-5), "colored light stays on an unchanged swatch"


def test_highlights_of_a_dark_surface_stay_white() -> None:
    dark = surface("#202022", 0.1, 1)
    rgb = torch.cat([dark, torch.tensor([[1.0, 1.0, 1.0], [0.98, 0.98, 0.98]])])
    for edit in ("recolor", "grade"):
        lab = srgb_to_oklab(edited(rgb, TARGETS[1], edit))
        assert lab[-1, 0] > 0.9
        assert lab[-1, 1:].norm() < 0.1
        assert lab[:2000, 1:].norm(dim=1).min() > 0.05, "the surface is blue up to its highlights"


@pytest.mark.parametrize("target", ["#a8a010", "#18a0b0", "#e07b1a", "#f4b8c8"])
def test_pale_patch_of_a_dark_surface_stays_pale(target: str) -> None:
    fur = surface("#7e5834", 0.12, 5)
    patch = surface("#e8d2a0", 0.03, 6)[:120]
    paint = color.parse_color(target)
    edited = srgb_to_oklab(color.recolor_fully(torch.cat([fur, patch]), paint, color.measure_color(fur)))
    pale = edited[len(fur) :]
    assert float(pale[:, 0].amax()) < 0.99, "it is not white, as the patch was not"
    assert float(pale[:, 0].median()) > float(edited[: len(fur), 0].median()) + 0.05
    assert float(pale[:, 1:].norm(dim=1).median()) > 0.2 * float(srgb_to_oklab(paint)[1:].norm()), "a tint"


@pytest.mark.parametrize("shading", [Shading(0.93, 0.99, 0.8), Shading(0.2, 0.35), Shading(0.6, 0.9, 0.3)])
def test_relit_lightness_is_continuous_and_rises(shading: Shading) -> None:
    ramp = torch.linspace(0, 1, 2001).double()
    for target in TARGETS:
        relit = relight(ramp, shading, srgb_to_oklab(target).double())
        assert (relit.lightness.diff() >= -1e-9).all()
        assert relit.lightness.diff().max() < 0.02
        chroma = relit.chroma * srgb_to_oklab(target)[1:].norm()
        assert chroma.diff().abs().max() < 0.02
        assert relit.lightness.min() >= 0
        assert relit.lightness.max() <= 1


def test_paint_of_the_same_color_changes_nothing() -> None:
    for base in BASES[1:-3]:
        rgb = surface(base, 0.1, 4)
        source = color.measure_color(rgb).color
        grade = grading.ColorGrade(palette=((source, source),))
        grade = grading.measure_grade(grade, rgb, torch.ones(len(rgb)))
        assert (grading.grade_fully(rgb, grade) - rgb).abs().max() < 2e-3


def test_black_and_white_paint_leave_room_for_shading() -> None:
    shading = Shading(0.6, 0.9, 0.3)
    assert 0.9 < paint_lightness(shading, 1.0) < 1.0
    assert 0.1 < paint_lightness(shading, 0.0) < 0.2
    assert paint_lightness(Shading(0.05), 0.0) == pytest.approx(0.05), "not lighter than the surface"
    assert paint_lightness(shading, 0.5) == 0.5


def test_highlight_threshold_is_measured() -> None:
    draws = Draws(2)
    body = (0.4 + 0.03 * draws.normal(5000)).float()
    glossy = torch.cat([body, torch.linspace(0.6, 1.0, 60)])
    assert measure_shading(glossy, torch.ones(len(glossy))).highlight < 0.56
    even = torch.linspace(0.6, 1.0, 5000)
    assert measure_shading(even, torch.ones(5000)).highlight == pytest.approx(1.0)
    assert measure_shading(even, torch.zeros(5000)) == Shading(0.5)


def test_weighted_quantiles_follow_the_weights() -> None:
    values = torch.tensor([3.0, 1.0, 2.0])
    assert weighted_quantiles(values, torch.tensor([1.0, 1.0, 8.0]), (0.05, 0.5, 0.95)) == [1.0, 2.0, 3.0]


def test_tint_of_white_moves_to_the_nearest_lightness_in_gamut() -> None:
    ab = 0.7 * srgb_to_oklab(TARGETS[1])[1:]
    assert nearest_lightness(0.45, ab) == 0.45
    lower = nearest_lightness(0.97, ab)
    assert 0.5 < lower < 0.9
    white = surface("#f4f4f4", 0.03, 1)
    lab = srgb_to_oklab(color.tint_fully(white, TARGETS[1], color.measure_color(white)))
    assert (lab[:, 1:].median(dim=0).values - ab).norm() <= JND


def test_curve_of_white_bends_its_brightest_parts() -> None:
    curve = ((0.95, 0.6),)
    ends = bend_lightness(torch.tensor([0.95, 1.0]), with_highlights(curve))
    assert ends[0] == pytest.approx(0.6, abs=1e-3)
    assert ends[1] < 0.75
    assert with_highlights(()) == ()
    assert with_highlights(((0.5, 0.3), (1.0, 0.9))) == ((0.5, 0.3), (1.0, 0.9))
