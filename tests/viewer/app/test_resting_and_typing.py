"""Tooltips of a resting mouse, and fast typing that loses no letter."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.app import canvas as pace
from viewer.ui.keys import Keys, Press, next_event_id

pytestmark = pytest.mark.gl


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.5, 0.5), (700, 640)) as opened:
        yield opened


def tooltip_is_open() -> bool:
    windows = imgui.get_current_context().windows
    tips = [window for window in windows if window.name.startswith("##Tooltip")]
    return any(window.active and not window.hidden for window in tips)


@pytest.mark.parametrize("item", ["undo", "timeline", "help", "name"])
def test_tooltip_opens_after_rest_and_then_nothing_is_drawn(hand: Rig, item: str) -> None:
    hand.move(*hand.at(item))
    hand.settle()
    assert not tooltip_is_open()
    hand.rest()
    assert tooltip_is_open()
    assert hand.main_view.next_frame_delay() is None


def test_other_frames_do_not_prevent_the_tooltip(hand: Rig) -> None:
    hand.move(*hand.at("undo"))
    hand.settle()
    hand.frame(5)  # for example a picture that sharpens or a message that disappears
    hand.rest()
    assert tooltip_is_open()


def test_rest_takes_a_bounded_number_of_frames() -> None:
    pacer = pace.FramePacer()
    frames = 0
    while (wait := pacer.next_frame_delay(())) is not None:
        pacer.step(max(wait, 1 / 60))
        frames += 1
    assert frames == 2 * pace.SETTLE_FRAMES + 1


def type_fast(hand: Rig, text: str, *keys: tuple[imgui.Key, str]) -> None:
    """Type a text and keys between two frames, as in a slow frame, then settle."""
    for letter in text:
        hand.io.add_key_event(getattr(imgui.Key, f"_{letter}", imgui.Key.period), True)
        hand.io.add_input_characters_utf8(letter)
        hand.io.add_key_event(getattr(imgui.Key, f"_{letter}", imgui.Key.period), False)
    pressed = []
    for key, chord in keys:
        pressed.append(Press(chord, event_id=next_event_id()))
        hand.io.add_key_event(key, True)
        hand.io.add_key_event(key, False)
    hand.main_view.wake()
    hand.frame(keys=Keys(tuple(pressed)))
    hand.settle()


def test_value_typed_within_one_frame_is_complete_before_enter(hand: Rig) -> None:
    hand.modifier(imgui.Key.mod_ctrl)
    hand.click(*hand.slider(0, 0.2))
    hand.modifier(imgui.Key.mod_ctrl, False)
    type_fast(hand, "0.1122", (imgui.Key.enter, "Enter"))
    assert hand.strengths[0] == pytest.approx(0.1122)
    assert hand.main_view.work.renaming is None, "this Enter was the field's"


def test_text_typed_right_after_the_click_is_kept(hand: Rig) -> None:
    hand.move(*hand.slider(0, 0.2))
    hand.io.add_key_event(imgui.Key.mod_ctrl, True)
    for down in (True, False):
        hand.io.add_mouse_button_event(0, down)
    hand.io.add_key_event(imgui.Key.mod_ctrl, False)
    type_fast(hand, "0.75", (imgui.Key.enter, "Enter"))
    assert hand.strengths[0] == 0.75


def test_keys_wait_while_a_text_field_opens(hand: Rig) -> None:
    hand.main_view.wake()
    hand.frame(keys=Keys((Press("Enter"), Press("B"))))
    assert hand.main_view.opening
    hand.settle()
    assert hand.main_view.work.renaming is not None
    assert not hand.main_view.work.view.brush.active, "the letter belongs to the name"
    hand.rest()
    assert hand.main_view.next_frame_delay() is None, "an open field alone draws nothing"


def test_escape_closes_the_list_of_keys_first(hand: Rig) -> None:
    hand.key("F1")
    hand.key("Escape")
    assert not hand.main_view.work.help
    assert hand.main_view.work.focus is not None
    hand.key("Escape")
    assert hand.main_view.work.focus is None


def test_escape_deactivates_the_tool_before_unfocusing(hand: Rig) -> None:
    for key, held in (("B", lambda view: view.brush.active), ("R", lambda view: view.select.tool)):
        hand.key(key)
        assert held(hand.main_view.work.view)
        hand.key("Escape")
        assert not held(hand.main_view.work.view)
        assert hand.main_view.work.focus is not None
    hand.key("Escape")
    assert hand.main_view.work.focus is None


def test_selected_segment_keeps_its_color_while_hovered(hand: Rig) -> None:
    y = 334.0  # Orbit of Orbit | Fly
    hand.move(200.0, 300.0)
    hand.settle()
    x = 700 - 300 + 12 + 82 + 20
    before = hand.image()[int(y) - 8, int(x)]
    hand.move(x, y)
    hand.settle()
    assert hand.io.want_capture_mouse
    assert (hand.image()[int(y) - 8, int(x)] == before).all()
