"""Tests of the path between a color and its edit: between both ends, never gray, alike for neighbors."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from progdf.color import edits as color
from progdf.color.edits import measure_color, parse_color
from progdf.color.oklab import ColorPath, bend_of, interpolate_colors, oklab_to_srgb, srgb_to_oklab
from tests.helpers.color_edits import recolor

PAIRS = {
    "skin to blue": ("#e0ac88", "#3060d0"),
    "brown to blue": ("#8b5a2b", "#3060d0"),
    "brown to sky": ("#8b5a2b", "#62b3ea"),  # 178 degrees apart; the shorter arc passes green
    "orange to blue": ("#ff8c1a", "#3060d0"),
    "red to green": ("#c02020", "#20a040"),
    "gray to red": ("#808080", "#c02020"),
    "pale pink to deep blue": ("#f0d0bc", "#101880"),
}
STRENGTHS = torch.linspace(0, 1, 21)
ORANGE = torch.tensor([0.85, 0.45, 0.10])
BLUE = torch.tensor([0.19, 0.38, 0.82])
CHROMA_OF_GRAY = 0.01
BIT = 2 / 255  # two channels closer than this are equal


@pytest.mark.parametrize("name", PAIRS)
def test_every_strength_lies_between_both_ends(name: str) -> None:
    start, end = (parse_color(text) for text in PAIRS[name])
    colors = recolor(start.expand(21, 3), end, STRENGTHS, source=measure_color(start))
    lab = srgb_to_oklab(colors)
    detour = ((lab - lab[0]).norm(dim=1) + (lab - lab[-1]).norm(dim=1)) / (lab[-1] - lab[0]).norm()
    assert float(detour.max()) <= 1.10
    chroma = lab[:, 1:].norm(dim=1)
    assert float(chroma.min()) >= 0.4 * min(float(chroma[0]), float(chroma[-1]))
    strongest = {int(colors[i].argmax()) for i in (0, 20) if float(chroma[i]) > CHROMA_OF_GRAY}
    assert {int(i) for i in colors[1:-1].argmax(dim=1)} <= strongest
    for a, b in ((0, 1), (1, 2), (0, 2)):
        above = colors[:, a] - colors[:, b]
        if min(float(above[0]), float(above[-1])) > BIT:
            assert float(above.min()) > -BIT
        if max(float(above[0]), float(above[-1])) < -BIT:
            assert float(above.max()) < BIT


@pytest.mark.parametrize("name", PAIRS)
def test_color_path_has_exact_ends_and_even_steps(name: str) -> None:
    start, end = (parse_color(text) for text in PAIRS[name])
    source = measure_color(start)
    colors = recolor(start.expand(21, 3), end, STRENGTHS, source=source)
    assert torch.equal(colors[0], start)
    assert torch.equal(colors[-1], color.recolor_fully(start.expand(21, 3), end, source)[-1])
    steps = srgb_to_oklab(colors).diff(dim=0).norm(dim=1)
    assert float(steps.max()) < 2.5 * float(steps.min())


def test_hue_path_follows_the_hue_circle_and_keeps_chroma() -> None:
    lab = srgb_to_oklab(recolor(ORANGE.expand(21, 3), BLUE, STRENGTHS, measure_color(ORANGE), path="hue"))
    hue = torch.rad2deg(torch.atan2(lab[10, 2], lab[10, 1]))
    assert 130 < float(hue) < 200, "over green"
    chroma = lab[:, 1:].norm(dim=1)
    # sRGB has no teal as saturated as these two
    assert float(chroma.min()) > 0.6 * float(torch.minimum(chroma[0], chroma[-1]))


def hues(lightness: float, chroma: float, count: int = 360) -> Tensor:
    """Return sRGB colors all around the hue circle. [count,3]"""
    angle = torch.linspace(0, 2 * math.pi, count + 1)[:-1]
    lab = torch.stack([torch.full_like(angle, lightness), chroma * angle.cos(), chroma * angle.sin()], dim=1)
    return oklab_to_srgb(lab).clamp(0, 1)


@pytest.mark.parametrize("path", ["bowed", "hue"])
@pytest.mark.parametrize("reference", ["#d9731a", "#8b5a2b", "#d9a012", "#20a040", "#808080"])
def test_neighboring_hues_stay_neighbors_along_the_path(reference: str, path: ColorPath) -> None:
    circle = hues(0.65, 0.11)
    for s in (0.25, 0.5, 0.75):
        recolored = recolor(circle, BLUE, s, measure_color(parse_color(reference)), path)
        apart = (recolored - recolored.roll(1, dims=0)).abs().amax(dim=1)
        # one degree of hue is up to 0.008 before the edit, and a few times that where two paths part
        assert float(apart.max()) < (0.03 if path == "bowed" else 0.07)


def test_region_around_the_opposite_hue_takes_one_direction() -> None:
    lab = srgb_to_oklab(BLUE)
    opposite = math.atan2(-float(lab[2]), -float(lab[1]))
    angle = opposite + torch.deg2rad(torch.linspace(-15, 15, 31))
    region = oklab_to_srgb(torch.stack([torch.full((31,), 0.65), 0.12 * angle.cos(), 0.12 * angle.sin()], 1))
    for reference in region[[7, 23]]:
        half = srgb_to_oklab(recolor(region, BLUE, 0.5, measure_color(reference)))
        hue = torch.atan2(half[:, 2], half[:, 1])
        assert float((hue - hue.mean()).abs().max()) < math.radians(30)
        assert float(hue.mean().abs()) < math.radians(60), "by way of rose, as green is nobody's half"


def test_near_gray_colors_stay_dull_during_a_hue_change() -> None:
    for s in (0.2, 0.4, 0.6, 0.8):
        warm, cool = recolor(
            torch.tensor([[0.70, 0.68, 0.66], [0.66, 0.68, 0.70]]), BLUE, s, measure_color(ORANGE)
        )
        assert float((warm - cool).abs().max()) < 0.06, "they were neighbors and stay so"


@pytest.mark.parametrize("s", [0.25, 0.5, 0.75])
@pytest.mark.parametrize("path", ["bowed", "hue"])
def test_hues_near_the_target_take_their_own_short_path(s: float, path: ColorPath) -> None:
    eyes = torch.tensor([[0.10, 0.70, 0.85], [0.15, 0.60, 0.95], [0.25, 0.45, 0.95]])  # cyan to blue
    recolored = recolor(eyes, BLUE, s, measure_color(ORANGE), path)
    assert bool((recolored[:, 2] > recolored[:, 0] + 0.2).all()), "no orange fleck on the way to blue"
    assert bool((recolored[:, 2] > recolored[:, 1]).all())


def test_straight_paths_are_straight_in_oklab_and_srgb() -> None:
    start = parse_color("#e0ac88").expand(21, 3)
    end = recolor(parse_color("#e0ac88").expand(21, 3), BLUE)
    lab, faded = (
        interpolate_colors(start, end, STRENGTHS, bend_of(start[0], BLUE, path))
        for path in ("straight", "srgb")
    )
    assert torch.allclose(faded, torch.lerp(start, end, STRENGTHS[:, None]))
    expected = torch.lerp(srgb_to_oklab(start), srgb_to_oklab(end), STRENGTHS[:, None])
    assert torch.allclose(srgb_to_oklab(lab), expected, atol=2e-3)
    assert float((lab - faded).abs().max()) > 0.02, "they are two ways"


def test_straight_and_bent_paths_have_equal_lightness() -> None:
    start = parse_color("#e0ac88").expand(21, 3)
    end = BLUE.expand(21, 3)
    lab = srgb_to_oklab(interpolate_colors(start, end, STRENGTHS, bend_of(start[0], BLUE)))
    expected = torch.lerp(srgb_to_oklab(start), srgb_to_oklab(end), STRENGTHS[:, None])
    # colors at the gamut boundary are known to 0.001
    assert torch.allclose(lab[:, 0], expected[:, 0], atol=2e-3)
