"""Mouse and keys on the main view without a window: drags, clicks, wheel, chords and held keys."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import TRACK, Rig, bear, first_view, rig
from viewer.camera.view_camera import axes, eye, fit_subject
from viewer.panel import panel
from viewer.state.view_state import LayerState
from viewer.ui.context import PALETTE, PANEL_PADDING_PX
from viewer.ui.keys import Keys, Press

pytestmark = pytest.mark.gl
VIEW = (170.0, 270.0)  # the middle of the picture


def test_orbit_within_one_slow_frame_turns_the_camera(hand: Rig) -> None:
    before = hand.main_view.work.view.camera
    hand.move(*VIEW)
    hand.io.add_mouse_button_event(0, True)
    hand.io.add_mouse_pos_event(VIEW[0] + 50, VIEW[1])
    hand.io.add_mouse_button_event(0, False)
    hand.frame(4)
    assert hand.main_view.work.view.camera.azimuth == pytest.approx(before.azimuth - 15.0)


def test_chords_within_one_slow_frame_run_in_order(hand: Rig) -> None:
    hand.drag(hand.slider(0, 0.5), hand.slider(0, 0.8))
    hand.frame(keys=Keys((Press("Ctrl+Z"), Press("1"), Press("Right"))))
    assert hand.strengths == pytest.approx([0.5, 0.51])


def test_drag_from_the_picture_continues_over_the_panel(hand: Rig) -> None:
    azimuth = hand.main_view.work.view.camera.azimuth
    hand.drag((300.0, TRACK), (500.0, TRACK))
    assert hand.strengths == [0.5, 0.5]
    assert hand.main_view.work.view.camera.azimuth == pytest.approx(azimuth - 60.0)


def test_drag_from_a_slider_does_not_orbit_the_camera(hand: Rig) -> None:
    before = hand.main_view.work.view.camera
    hand.drag(hand.slider(1, 0.5), VIEW)
    assert hand.main_view.work.view.camera == before
    assert hand.strengths == [0.5, 0.0]


@pytest.mark.parametrize(
    ("button", "modifier", "kept"),
    [
        (2, None, "pivot"),
        (2, imgui.Key.mod_shift, "angles"),
        (2, imgui.Key.mod_ctrl, "pivot"),
        (1, None, "angles"),
    ],
    ids=["middle orbits", "Shift+middle pans", "Ctrl+middle dollies", "right pans"],
)
def test_middle_and_right_drags_match_the_bindings(
    hand: Rig, button: int, modifier: imgui.Key | None, kept: str
) -> None:
    before = hand.main_view.work.view.camera
    if modifier is not None:
        hand.modifier(modifier)
    hand.drag(VIEW, (VIEW[0] + 30, VIEW[1] + 30), button)
    after = hand.main_view.work.view.camera
    assert after != before
    if kept == "pivot":
        assert after.pivot == before.pivot
        assert (after.distance != before.distance) == (modifier is not None)
    else:
        assert (after.azimuth, after.elevation, after.distance) == (
            before.azimuth,
            before.elevation,
            before.distance,
        )


def test_right_drag_looks_around_while_flying(hand: Rig) -> None:
    hand.key("V")
    before = hand.main_view.work.view.camera
    hand.drag(VIEW, (VIEW[0] + 30, VIEW[1]), button=1)
    after = hand.main_view.work.view.camera
    assert eye(after) == pytest.approx(eye(before))
    assert after.pivot != before.pivot


def test_wheel_zooms_over_the_picture_and_scrolls_the_panel(hand: Rig) -> None:
    distance = hand.main_view.work.view.camera.distance
    hand.wheel(500.0, 300.0, 2.0)
    assert hand.main_view.work.view.camera.distance == distance
    hand.wheel(*VIEW, 2.0)
    assert hand.main_view.work.view.camera.distance < distance


def test_double_click_on_the_bear_sets_the_pivot_on_its_surface(hand: Rig) -> None:
    before = hand.main_view.work.view.camera
    hand.double_click(170.0, 150.0)
    after = hand.main_view.work.view.camera
    assert after.pivot != before.pivot
    assert eye(after) == pytest.approx(eye(before), abs=1e-6)
    assert np.linalg.norm(after.pivot) < 2.0, "on the bear, not behind it"


def test_double_click_on_the_background_keeps_the_pivot(hand: Rig) -> None:
    before = hand.main_view.work.view.camera
    hand.double_click(20.0, 20.0)
    assert hand.main_view.work.view.camera == before


def test_backslash_toggles_between_original_and_edit() -> None:
    with rig(first_view(bear(), 0.0, 0.0)) as untouched:
        original = untouched.picture()
    with rig() as hand:
        edited = hand.picture()
        words = hand.image()[:60]
        hand.key("\\")
        assert not np.array_equal(hand.image()[:60], words), "the word Original is lit"
        assert np.array_equal(hand.picture(), original)
        hand.key("\\")
        assert np.array_equal(hand.picture(), edited)
        assert hand.main_view.work.past.past == ()


@pytest.mark.parametrize(
    ("chord", "change"),
    [
        ("Right", 0.01),
        ("Down", -0.01),
        ("Shift+Left", -0.1),
        ("Ctrl+Up", 0.001),
    ],
)
def test_arrows_step_the_focused_strength(hand: Rig, chord: str, change: float) -> None:
    hand.key("1")  # the top card, which is the last layer
    hand.key(chord)
    assert hand.strengths == pytest.approx([0.5, 0.5 + change], abs=1e-9)
    assert len(hand.main_view.work.past.past) == 1


def test_held_arrow_repeats_and_is_one_undo_entry(hand: Rig) -> None:
    for again in (False, True, True, True):
        hand.frame(keys=Keys((Press("Right", again),), held=frozenset({"Right"})))
        hand.frame(keys=Keys(held=frozenset({"Right"})))
    assert hand.main_view.work.past.past == ()
    hand.frame()
    assert hand.strengths[1] == pytest.approx(0.54)
    assert len(hand.main_view.work.past.past) == 1


def test_held_letter_does_not_toggle_repeatedly(hand: Rig) -> None:
    for again in (False, True):
        hand.frame(keys=Keys((Press("V", again),), held=frozenset({"V"})))
    assert hand.main_view.work.view.camera.mode == "fly"


def test_number_keys_focus_layers_and_with_shift_hide_them(hand: Rig) -> None:
    hand.key("1")
    assert hand.main_view.work.focus == 1, "the numbers go down the list, and the last layer is at its top"
    hand.key("Shift+2")
    assert [layer.enabled for layer in hand.main_view.work.view.layers] == [False, True]
    hand.key("9")
    assert hand.main_view.work.focus == 1, "there is no ninth layer"
    hand.key("H")
    assert [layer.enabled for layer in hand.main_view.work.view.layers] == [False, False]


def test_layer_focused_by_key_is_scrolled_into_view() -> None:
    layers = tuple(LayerState(i % 2, f"layer {i}", 0.5) for i in range(9))
    with rig(replace(first_view(bear()), layers=layers, cards="full")) as hand:
        hand.key("9")
        hand.frame(5)
        accent = np.round(np.array(PALETTE.accent[:3]) * 255)
        left = round(hand.points[0] - panel.WIDTH_PX + PANEL_PADDING_PX[0]) + 1
        edge = np.abs(hand.image()[60:480, left] - accent).max(axis=-1) <= 2
        assert edge.sum() > 50, "the whole card of the focused layer is in sight"
        hand.key("Shift+9")
        assert not hand.main_view.work.view.layers[0].enabled


def test_text_field_takes_all_keys(hand: Rig) -> None:
    hand.modifier(imgui.Key.mod_ctrl)
    hand.move(*hand.slider(0, 0.2))
    hand.press()
    hand.release()
    hand.modifier(imgui.Key.mod_ctrl, False)
    assert hand.io.want_text_input
    before = hand.main_view.work.view.camera
    hand.key("V")
    hand.frame(5, keys=Keys(fly=frozenset("W")))
    assert hand.main_view.work.view.camera == before


def test_f_frames_the_focused_layer_or_the_whole_scene(hand: Rig) -> None:
    home = hand.main_view.work.view.camera
    hand.key("F")
    framed = hand.main_view.work.view.camera
    hand.key("Escape")
    hand.key("F")
    whole = hand.main_view.work.view.camera
    assert whole == fit_subject(home, bear().scene, 340 / 540)
    assert framed.distance < 0.9 * whole.distance
    assert axes(framed) == axes(home)
    hand.drag(VIEW, (VIEW[0] + 30, VIEW[1]))
    hand.key("Shift+F")
    assert hand.main_view.work.view.camera == home


def test_w_flies_ahead_and_s_flies_back(hand: Rig) -> None:
    home = hand.main_view.work.view.camera
    hand.frame(10, keys=Keys(fly=frozenset("W")))
    patience = hand.main_view.next_frame_delay()
    ahead = hand.main_view.work.view.camera
    assert np.dot(np.subtract(eye(ahead), eye(home)), axes(home).back) < 0
    assert patience == 0.0, "frames go on while a key is held"
    hand.frame(10, keys=Keys(fly=frozenset("S")))
    assert eye(hand.main_view.work.view.camera) == pytest.approx(eye(home))
