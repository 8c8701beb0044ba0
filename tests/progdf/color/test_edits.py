"""Tests of color edits: shading is preserved, and strength 0 is the input."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from progdf.color import edits as color
from progdf.color import grade as grading
from progdf.color.oklab import oklab_to_srgb, srgb_to_oklab
from progdf.errors import ProgdfError
from tests.helpers.color_edits import recolor, stripes, tint

ORANGE = torch.tensor([1.0, 0.55, 0.1])
BLUE = color.parse_color("#1133dd")


def _random(n: int = 500) -> Tensor:
    return torch.rand(n, 3, generator=torch.Generator().manual_seed(3))


def _polar(rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    lightness, a, b = srgb_to_oklab(rgb).unbind(-1)
    return lightness, torch.hypot(a, b), torch.rad2deg(torch.atan2(b, a))


def test_typical_color_is_independent_of_the_thread_count() -> None:
    rng = torch.Generator().manual_seed(1)
    found = list[Tensor]()
    rgb = torch.rand(1_000_000, 3, generator=rng)
    weights = torch.rand(1_000_000, generator=rng)
    before = torch.get_num_threads()
    for threads in (1, 2, 3, 4):
        torch.set_num_threads(threads)
        found.append(color.typical_color(rgb, weights))
    torch.set_num_threads(before)
    assert all(torch.equal(found[0], other) for other in found[1:])


def test_oklab_round_trip_returns_the_same_color() -> None:
    rgb = _random()
    # single precision through two cubes and a power of 2.4
    assert (oklab_to_srgb(srgb_to_oklab(rgb)) - rgb).abs().max() < 1e-4
    white = srgb_to_oklab(torch.ones(3))
    assert torch.allclose(white, torch.tensor([1.0, 0.0, 0.0]), atol=1e-4)


@pytest.mark.parametrize("edit", ["recolor", "tint", "darken", "night", "stripes", "grade"])
def test_strength_zero_is_the_input_bit_for_bit(edit: str) -> None:
    rgb = torch.cat([_random(), torch.tensor([[-0.3, 1.4, 0.5], [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])])
    assert torch.equal(_edited(edit, rgb, 0.0), rgb)


@pytest.mark.parametrize("edit", ["recolor", "tint", "darken", "night", "stripes", "grade"])
def test_small_steps_of_strength_are_small_steps_of_color(edit: str) -> None:
    rgb = torch.cat([_random(), torch.full((4, 3), 0.5), torch.tensor([[-0.3, 1.4, 0.5]])])
    steps = torch.stack([_edited(edit, rgb, float(s)) for s in torch.linspace(0, 1, 101)])
    largest = (steps[1:] - steps[:-1]).abs().amax(dim=(1, 2))
    # one hundredth of the path; its steepest part in sRGB has about ten times the mean slope
    assert largest.max() < 0.2


def _edited(edit: str, rgb: Tensor, strength: float) -> Tensor:
    if edit == "stripes":
        return stripes(rgb, torch.ones(len(rgb)), BLUE, strength)
    if edit == "darken":
        return color.darken(rgb, strength)
    if edit == "night":
        return color.night_course(rgb)(strength)
    if edit == "grade":
        return grading.grade_course(
            rgb, grading.ColorGrade({"exposure": 1.0, "temperature": 0.5, "blacks": -0.5})
        )(strength)
    return (recolor if edit == "recolor" else tint)(rgb, BLUE, strength)


def test_recolor_maps_the_reference_to_the_target() -> None:
    assert torch.allclose(recolor(ORANGE[None], BLUE)[0], BLUE, atol=2e-3)
    black = torch.full((1, 3), 0.03)
    assert torch.allclose(recolor(black, ORANGE)[0], ORANGE, atol=2e-3)


def test_recolor_keeps_the_order_of_lightness() -> None:
    shades = torch.linspace(0.1, 1.0, 30)[:, None] * ORANGE
    before = _polar(shades)[0]
    after = _polar(recolor(shades, BLUE, 1.0))[0]
    assert (before.diff() > 0).all()
    assert (after.diff() > 0).all()


def test_gray_takes_the_hue_of_the_target() -> None:
    gray = torch.full((1, 3), 0.5)
    for s in (0.2, 0.6, 1.0):
        hue = _polar(recolor(gray, BLUE, s))[2]
        assert torch.allclose(hue, _polar(BLUE[None])[2], atol=3.0)


def test_gray_target_keeps_the_source_hue_along_the_path() -> None:
    half = recolor(ORANGE[None], torch.full((3,), 0.6), 0.5)
    assert torch.allclose(_polar(half)[2], _polar(ORANGE[None])[2], atol=3.0)
    assert float(_polar(recolor(ORANGE[None], torch.full((3,), 0.6)))[1]) < 0.01


def test_edited_colors_are_displayable() -> None:
    for strength in (0.3, 1.0):
        for target in (BLUE, ORANGE, torch.ones(3), torch.zeros(3)):
            out = recolor(_random(), target, strength)
            assert out.isfinite().all()
            assert out.min() >= 0
            assert out.max() <= 1


def test_tint_keeps_lightness_inside_the_gamut() -> None:
    rgb = 0.2 + 0.6 * _random()
    before = _polar(rgb)[0]
    after = _polar(tint(rgb, BLUE))[0]
    is_dark = before < before.median()
    assert (after - before)[is_dark].abs().max() < 0.01
    assert (after[before.argsort()].diff() > -2e-3).all()
    dull = color.parse_color("#8a8590")
    assert (_polar(tint(rgb, dull))[0] - before).abs().max() < 0.01


def test_darkening_by_one_stop_halves_the_light() -> None:
    gray = torch.full((1, 3), 0.8)
    linear = ((0.8 + 0.055) / 1.055) ** 2.4
    darker = ((color.darken(gray, 1.0, stops=1.0) + 0.055) / 1.055) ** 2.4
    assert torch.allclose(darker, torch.full((1, 3), linear / 2), rtol=1e-3)


def test_strength_may_differ_per_pixel() -> None:
    image = _random(64).reshape(8, 8, 3)
    strength = torch.linspace(0, 1, 64).reshape(8, 8)
    source = color.measure_color(image)
    whole = recolor(image, BLUE, strength, source)
    pixel = recolor(image[3, 5], BLUE, float(strength[3, 5]), source)
    assert torch.allclose(whole[3, 5], pixel, atol=1e-5)


def test_stripes_are_a_function_of_position() -> None:
    along = torch.tensor([0.0, 0.25, 0.5, 1.0, 1.5])
    points = torch.stack([7 * along, 0.3 * along, along], dim=1)
    pattern = color.stripe_pattern(points, torch.tensor([0.0, 0.0, 3.0]), period=1.0)
    assert torch.allclose(pattern, torch.tensor([1.0, 0.5, 0.0, 1.0, 0.0]), atol=1e-5)


def test_typical_color_ignores_pixels_of_zero_weight() -> None:
    rgb = torch.stack([ORANGE, BLUE])
    assert torch.allclose(color.typical_color(rgb, torch.tensor([1.0, 0.0])), ORANGE, atol=1e-3)


def test_colors_are_parsed_from_hex() -> None:
    assert torch.equal(color.parse_color("#ff0033"), torch.tensor([1.0, 0.0, 0.2]))
    assert torch.equal(color.parse_color("f03"), color.parse_color("#ff0033"))


@pytest.mark.parametrize("text", ["", "#12", "gold", "#gggggg", "#1234567"])
def test_invalid_color_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ProgdfError, match="is not a color; write it as #rrggbb"):
        color.parse_color(text)
