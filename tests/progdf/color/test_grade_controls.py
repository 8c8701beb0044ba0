"""Controls of a grade: neutral values, order of tones, hues, invalid colors, text, and .cube tables."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.color.grade import GRADE_RANGES, ColorGrade, format_grade, grade_fully, parse_grade
from progdf.color.oklab import hue_of, oklab_to_srgb, srgb_to_oklab
from progdf.color.palette import shift_palette
from progdf.color.tone import WHEELS, Wheel
from progdf.field.baked import lattice_colors
from progdf.field.grade import look_up
from progdf.formats.cube import SIDE, read_cube, write_cube

TONES = ("exposure", "contrast", "highlights", "shadows", "whites", "blacks")
HUE_KEEPING = (*TONES, "vibrance", "saturation")
LEVEL = 1 / 255
EVERYTHING = (
    "exposure=0.40,contrast=0.20,highlights=-0.50,shadows=0.30,whites=0.10,blacks=-0.10,temperature=0.20,tint=-0.10,"
    "vibrance=0.30,saturation=-0.10,balance=0.30,wheel_shadows=250.0:0.30:-0.10,wheel_highlights=70.0:0.20:0.00,"
    "#7eae44=#4474ae~1.50/0.30:0.20,#b97a30,curve=0.30:0.25+0.70:0.78,curve_blue=0.50:0.45"
)


def graded(rgb: Tensor, **values: float) -> Tensor:
    return grade_fully(rgb, ColorGrade(values))


def grid(side: int = 17) -> Tensor:
    return lattice_colors(side).float()


def test_neutral_grade_returns_the_colors_bit_for_bit() -> None:
    rgb = torch.rand(999, 3, generator=torch.Generator().manual_seed(0))
    assert torch.equal(graded(rgb), rgb)
    assert torch.equal(graded(rgb, exposure=0.0, balance=1.0), rgb)
    for name in GRADE_RANGES:
        assert (graded(rgb, **{name: 1e-4}) - rgb).abs().max() < 2e-3, name


@pytest.mark.parametrize("name", TONES)
def test_tone_sliders_keep_lightness_in_order(name: str) -> None:
    gray = torch.linspace(0, 1, 2001)[:, None].expand(-1, 3)
    low, high, _ = GRADE_RANGES[name]
    earlier = None
    for value in torch.linspace(low, high, 21).tolist():
        lightness = srgb_to_oklab(graded(gray, **{name: value}).double())[:, 0]
        assert (lightness.diff() > -1e-5).all(), "brighter colors stay brighter"
        if earlier is not None and name != "contrast":
            assert (lightness - earlier > -1e-4).all(), "a higher value never darkens"
        earlier = lightness


@pytest.mark.parametrize("name", HUE_KEEPING)
def test_sliders_of_light_and_chroma_keep_the_hue(name: str) -> None:
    rgb = grid()
    before = srgb_to_oklab(rgb)
    for end in GRADE_RANGES[name][:2]:
        after = srgb_to_oklab(graded(rgb, **{name: end}))
        colored = (before[:, 1:].norm(dim=1) > 0.02) & (after[:, 1:].norm(dim=1) > 0.02)
        turn = torch.remainder(hue_of(after) - hue_of(before) + torch.pi, 2 * torch.pi) - torch.pi
        assert not bool((turn[colored].abs() > 0.06).any()), "radians; the gamut's tolerance"


@pytest.mark.parametrize(
    "text",
    [
        *(f"{name}={end}" for name, ends in GRADE_RANGES.items() for end in ends[:2] if name != "balance"),
        *(f"wheel_{zone}=30:1:{light},balance={-light}" for zone in WHEELS for light in (1, -1)),
    ],
)
def test_no_control_breaks_the_hue_between_similar_colors(text: str) -> None:
    side = 33
    before = srgb_to_oklab(grid(side)).reshape(side, side, side, 3)
    after = srgb_to_oklab(grade_fully(grid(side), parse_grade(text))).reshape(before.shape)
    for axis in range(3):
        first, second = after.narrow(axis, 0, side - 1)[..., 1:], after.narrow(axis, 1, side - 1)[..., 1:]
        cross = first[..., 0] * second[..., 1] - first[..., 1] * second[..., 0]
        chroma = torch.maximum(first.norm(dim=-1), second.norm(dim=-1)).clamp_min(1e-6)
        # distance of one color from the hue line of the other; exposure scales it by up to 2^(5/3)
        bound = 4.0 * before.diff(dim=axis).norm(dim=-1) + 0.01
        assert (cross.abs() / chroma <= bound).all()


def test_wheels_keep_lightness_in_order_at_their_limits() -> None:
    gray = torch.linspace(0, 1, 1001)[:, None].expand(-1, 3)
    for balance in (-1.0, 0.0, 1.0):
        for up in (1.0, -1.0):
            wheels = (Wheel(light=up), Wheel(light=-up), Wheel(light=up))
            edited = grade_fully(gray, ColorGrade({"balance": balance}, wheels=wheels))
            assert (srgb_to_oklab(edited.double())[:, 0].diff() > -1e-5).all()


def test_any_input_gives_displayable_colors() -> None:
    odd = torch.tensor(
        [[torch.nan, 0.2, 0.3], [torch.inf, -torch.inf, 0.5], [-3.0, 7.0, 0.0], [1e30, -1e30, 0.0]]
    )
    for text in [
        EVERYTHING,
        *(f"{n}={e}" for n, ends in GRADE_RANGES.items() for e in ends[:2] if n != "balance"),
    ]:
        edited = grade_fully(torch.cat([odd, grid(9)]), parse_grade(text))
        assert edited.isfinite().all(), text
        assert 0 <= edited.min() <= edited.max() <= 1, text


def test_each_control_has_its_named_effect() -> None:
    gray = torch.full((1, 3), 0.5)
    some = 0.2 + 0.6 * torch.rand(500, 3, generator=torch.Generator().manual_seed(1))
    linear = ((0.5 + 0.055) / 1.055) ** 2.4
    brighter = ((graded(gray, exposure=0.5) + 0.055) / 1.055) ** 2.4
    assert torch.allclose(brighter, torch.full((1, 3), linear * 2**0.5), rtol=2e-3)
    red, green, blue = graded(gray, temperature=1.0)[0]
    assert red > green > blue
    red, green, blue = graded(gray, tint=1.0)[0]
    assert min(red, blue) > green
    assert graded(some, saturation=-1.0).std(dim=1).max() < 1e-3
    middle = torch.full((1, 3), 0.4613)  # 18 % of the light
    assert torch.allclose(graded(middle, contrast=0.8), middle, atol=2e-3)
    steps = torch.tensor([0.0, 0.15, 0.5, 0.75, 1.0])[:, None].expand(-1, 3)
    lifted = (graded(steps, shadows=1.0) - steps)[:, 0]
    assert lifted[1] > 0.1
    assert lifted[[0, 3, 4]].abs().max() < 1e-3, "shadows leave black and bright tones"
    recovered = (graded(steps, highlights=-1.0) - steps)[:, 0]
    assert recovered[3] < -0.1
    assert recovered[[0, 1, 4]].abs().max() < 1e-3, "highlights leave white and dark tones"
    assert graded(steps, whites=-1.0)[4, 0] < 0.8
    assert graded(steps, blacks=1.0)[0, 0] > 0.02
    pale, strong = oklab_to_srgb(torch.tensor([[0.6, 0.03, 0.0], [0.6, 0.18, 0.0]]))
    chroma = srgb_to_oklab(graded(torch.stack([pale, strong]), vibrance=0.5))[:, 1]
    assert chroma[0] / 0.03 > 1.3 > 1.2 > chroma[1] / 0.18


def test_range_of_a_color_moves_its_border_and_keeps_sources() -> None:
    sources = srgb_to_oklab(torch.tensor([[0.2, 0.4, 0.8], [0.8, 0.4, 0.2]]))
    targets = sources + torch.tensor([[0.1, 0.0, 0.0], [0.0, 0.0, 0.0]])
    between = torch.lerp(sources[0], sources[1], 0.5)[None]
    shift = [
        float((shift_palette(between, sources, targets, ranges=(r, 1.0)) - between)[0, 0])
        for r in (0.5, 1, 2)
    ]
    assert shift[0] < shift[1] < shift[2]
    for reach in (0.25, 4.0):
        moved = shift_palette(sources, sources, targets, ranges=(reach, 1.0))
        assert torch.allclose(moved, targets, atol=1e-4)


def test_grade_text_round_trips() -> None:
    assert format_grade(parse_grade(EVERYTHING)) == EVERYTHING


@pytest.mark.parametrize(
    "text",
    ["exposure=0.5,highlights=-0.6,temperature=0.3", "shadows=0.5,vibrance=0.5", "wheel_shadows=250:0.5:0"],
)
def test_cube_round_trip_stays_within_one_level(text: str, tmp_path: Path) -> None:
    grade = parse_grade(text)
    table = grade_fully(lattice_colors(SIDE).float(), grade)
    write_cube(tmp_path / "a.cube", table, "a")
    read = read_cube(tmp_path / "a.cube")
    assert (read - table).abs().max() < LEVEL, "at the table's points"
    muted = 0.1 + 0.8 * torch.rand(20_000, 1, generator=torch.Generator().manual_seed(2))
    rgb = (muted + 0.12 * torch.randn(20_000, 3, generator=torch.Generator().manual_seed(3))).clamp(
        0.02, 0.98
    )
    error = (look_up(rgb.T, read).T - grade_fully(rgb, grade)).abs()
    assert error.mean() < 0.3 * LEVEL, "between its points"
