"""Grade in the new-edit form, by mouse: palette, curve and color picker."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from imgui_bundle import imgui

from progdf.color.edits import parse_color
from tests.helpers.ui_rig import Rig, bear, center, first_view, rig
from viewer.panel import grade_form, panel
from viewer.state.forms import EDITORS, NewEdit, parse_curve

pytestmark = pytest.mark.gl
WINDOW = (1024, 800)
COLORS = ("#7eae44", "#b97a30", "#a09a90")
FORM = NewEdit(
    editor=next(i for i, editor in enumerate(EDITORS) if editor.kind == "grade"),
    palette=tuple((color, color) for color in COLORS),
    folded=("Looks", "Light", "Color", "Palette", "Wheels"),
)


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.0, 0.0), WINDOW) as opened:
        opened.main_view.store.replace(replace(opened.main_view.work, form=FORM, form_open=True))
        opened.frame(3)
        yield opened


def form(hand: Rig) -> NewEdit:
    return hand.main_view.work.form


def test_curve_points_are_added_dragged_and_removed_by_mouse(hand: Rig) -> None:
    box = hand.box("curve")

    def place(x: float, y: float) -> tuple[float, float]:
        return box.left + x * (box.right - box.left), box.bottom - y * (box.bottom - box.top)

    hand.drag(place(0.3, 0.3), place(0.3, 0.15))
    ((x, y),) = parse_curve(form(hand).curves[0])
    assert x == pytest.approx(0.3, abs=0.06)
    assert y == pytest.approx(0.15, abs=0.06)
    hand.drag(place(0.7, 0.7), place(0.1, 0.9))
    assert [round(b > a) for a, b in parse_curve(form(hand).curves[0])] == [0, 1]
    points = parse_curve(form(hand).curves[0])
    assert points[0][0] < points[1][0], "points never pass each other"
    hand.move(*place(x, y))
    for _ in range(2):
        hand.click(*place(x, y))
    assert len(parse_curve(form(hand).curves[0])) == 1


def test_curve_can_be_edited_by_keys_alone(hand: Rig) -> None:
    def strike(*names: str) -> list[tuple[float, float]]:
        for name in names:
            hand.modifier(getattr(imgui.Key, name))
            hand.modifier(getattr(imgui.Key, name), False)
        return parse_curve(form(hand).curves[0])

    hand.click(*hand.at("##text of Name"))  # below the curve
    hand.modifier(imgui.Key.mod_shift)
    strike("tab")
    hand.modifier(imgui.Key.mod_shift, False)
    assert strike("space") == [(0.5, 0.5)], "a point on the curve"
    assert strike("up_arrow", "up_arrow", "left_arrow") == [(0.49, 0.52)]
    ((x, y), _) = strike("space", "down_arrow")
    assert (x, y) == (0.49, 0.52), "behind the last one is another, which the arrows move now"
    assert strike("delete") == [(0.49, 0.52)]
    assert strike("space", "up_arrow") == [(0.49, 0.53)]


def test_swatch_opens_a_picker_and_right_click_resets_its_color(hand: Rig) -> None:
    moved = ((COLORS[0], "#3060d0"), *FORM.palette[1:])
    hand.main_view.store.replace(
        replace(
            hand.main_view.work,
            form=replace(form(hand), palette=moved, folded=("Looks", "Light", "Color", "Curve")),
        )
    )
    hand.frame(2)
    swatch = hand.at("##color 0")
    hand.move(*swatch)
    hand.press(1)
    hand.release(1)
    assert form(hand).palette == FORM.palette
    hand.click(*swatch)
    hand.frame(2)
    assert len(imgui.get_current_context().open_popup_stack) == 1


def test_picking_a_color_adds_it_to_the_palette_only(hand: Rig) -> None:
    before = hand.main_view.work
    hand.main_view.store.replace(replace(before, form=replace(FORM, picks=True)))
    hand.frame(2)
    x = (WINDOW[0] - panel.WIDTH_PX) / 2
    y = 0.33 * WINDOW[1]
    shown = hand.picture()[round(y), round(x)] / 255
    hand.click(x, y)
    hand.frame(2)
    picked = form(hand).palette[-1][0]
    assert abs(parse_color(picked).numpy() - shown).max() < 0.12, (
        "the pixel's color, as it has it from no side"
    )
    assert not form(hand).picks
    assert (hand.main_view.work.view, hand.main_view.work.focus) == (before.view, before.focus)


def test_wheel_follows_a_drag_and_a_double_click_resets_it(hand: Rig) -> None:
    opened = replace(FORM, folded=("Looks", "Light", "Color", "Palette", "Curve"))
    hand.main_view.store.replace(replace(hand.main_view.work, form=opened))
    hand.frame(2)
    box = hand.box("wheel shadows")
    x, y = center(box)
    hand.drag((x - 20.0, y), (x, y - 0.25 * (box.right - box.left)))
    shadows, midtones, _ = form(hand).wheels
    assert shadows.hue == pytest.approx(90.0, abs=15.0)
    assert 0.3 < shadows.amount < 0.9
    assert not midtones.amount
    assert "wheel_shadows=" in form(hand).spec
    for _ in range(2):
        hand.click(x, y)
    assert form(hand).spec == "grade"


def test_fast_drag_that_ends_within_a_frame_moves_the_point(hand: Rig) -> None:
    x, y = hand.at("curve")
    imgui.set_nav_cursor_visible(True)  # as after opening the form by keys
    hand.move(x, y)
    hand.press()
    ((_, before),) = parse_curve(form(hand).curves[0])
    hand.io.add_mouse_pos_event(x, y - 20.0)
    hand.io.add_mouse_button_event(0, False)
    hand.event()
    hand.settle()
    ((_, after),) = parse_curve(form(hand).curves[0])
    assert after == pytest.approx(before + 20.0 / grade_form.CURVE_PX, abs=0.02)
