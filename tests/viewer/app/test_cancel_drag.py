"""Escape or a right click during a drag reverts that drag only and leaves no undo entry."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import HEAD, Rig, bear, first_view, rig
from viewer.panel.timeline_bar import HEIGHT_PX, ROW_PX
from viewer.state.view_state import Brush, Keyframe, SelectTool, Timeline

pytestmark = pytest.mark.gl
POINTS = (700, 640)
LEFT = POINTS[0] - 300.0
TIMELINE = round(HEIGHT_PX + ROW_PX)
TOLERANCE = 62.0
CallOff = Callable[[Rig], None]


def by_escape(hand: Rig) -> None:
    hand.key("Escape")


def by_escape_that_imgui_hears_too(hand: Rig) -> None:
    """Press Escape as in the window, where imgui also releases the active item."""
    hand.io.add_key_event(imgui.Key.escape, True)
    hand.key("Escape")
    hand.io.add_key_event(imgui.Key.escape, False)


def by_right_click(hand: Rig) -> None:
    hand.press(1)
    hand.release(1)


WAYS = (by_escape, by_escape_that_imgui_hears_too, by_right_click)
ways = pytest.mark.parametrize("call_off", WAYS)


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(replace(first_view(bear(), 0.5, 0.5), unfolded=(0,)), POINTS) as opened:
        opened.key("2")  # the lower layer, the scarf
        yield opened


def dragged_and_called_off(
    hand: Rig, call_off: CallOff, start: tuple[float, float], *way: tuple[float, float]
) -> None:
    """Cancel a drag halfway, keep moving and release the button at the end."""
    hand.move(*start)
    before = hand.picture()
    work = hand.main_view.work
    hand.press()
    for place in way:
        hand.move(*place)
    call_off(hand)
    assert hand.main_view.work.view == work.view
    hand.move(*way[0])
    hand.move(*way[-1])
    hand.release()
    assert hand.main_view.work.view == work.view
    assert hand.main_view.work.past == work.past
    assert hand.main_view.work.focus == work.focus
    hand.move(*start)
    assert (hand.picture() == before)[:-TIMELINE].all(), "the playhead stays where it was brought"


@ways
def test_canceled_slider_drag_restores_the_strength(hand: Rig, call_off: CallOff) -> None:
    start = hand.slider(0, 0.5)
    end = hand.slider(0, 0.9)
    dragged_and_called_off(hand, call_off, start, end)
    dragged_and_called_off(hand, call_off, hand.slider(0, 0.2), end)
    hand.drag(start, end)
    assert hand.strengths[0] == pytest.approx(0.9, abs=0.01)
    assert len(hand.main_view.work.past.past) == 1


def test_canceled_gain_drag_restores_the_gain(hand: Rig) -> None:
    y = gain_row(hand)
    hand.pause(0.7)  # a press soon after the last would be a double click, which resets
    hand.drag((LEFT + 218, y), (LEFT + 150, y))
    color = hand.main_view.work.view.layers[0].gains.color
    assert 0.0 < color < 1.0
    before = hand.main_view.work
    for call_off in WAYS:
        hand.pause(0.7)
        hand.move(LEFT + 150, y)
        hand.press()
        hand.move(LEFT + 180, y)
        assert hand.main_view.work.view.layers[0].gains.color != color
        call_off(hand)
        hand.move(LEFT + 120, y)
        hand.release()
        assert hand.main_view.work.view == before.view
        assert hand.main_view.work.past == before.past


def gain_row(hand: Rig) -> float:
    """Return the y of the slider for the color gain of the first layer."""
    for y in range(400, 200, -12):
        before = hand.main_view.work
        hand.drag((LEFT + 218, y), (LEFT + 150, y))
        moved = hand.main_view.work.view.layers[0].gains.color != 1.0
        hand.main_view.restart(before.view)
        hand.settle()
        if moved:
            return float(y)
    raise AssertionError("there is no gain to drag")


@ways
def test_canceled_layer_drag_keeps_the_layer_order(hand: Rig, call_off: CallOff) -> None:
    hand.key("1")  # the card at the top
    dragged_and_called_off(
        hand, call_off, (LEFT + 100, HEAD), (LEFT + 100, HEAD + 60), (LEFT + 100, HEAD + 400)
    )


@ways
def test_canceled_stroke_is_reverted_and_the_next_one_paints(hand: Rig, call_off: CallOff) -> None:
    brush = Brush(active=True, radius=60.0, softness=0.5)
    hand.main_view.restart(replace(hand.main_view.work.view, brush=brush))
    hand.settle()
    hand.key("2")
    dragged_and_called_off(hand, call_off, (180, 330), (200, 330), (230, 340))
    hand.drag((180, 330), (230, 340))
    assert hand.main_view.work.view.layers[0].paint
    assert len(hand.main_view.work.past.past) == 1


def test_canceled_key_drag_restores_the_key(hand: Rig) -> None:
    keys = (Keyframe(0, ((0, 0.5), (1, 0.5))), Keyframe(36, ((0, 0.5), (1, 0.5))))
    hand.main_view.restart(replace(hand.main_view.work.view, timeline=Timeline(keys)))
    hand.key("T")
    y = POINTS[1] - ROW_PX - HEIGHT_PX / 2
    at = next(x for x in range(240, 400, 10) if grips_key(hand, float(x), y))
    for call_off in WAYS:
        dragged_and_called_off(hand, call_off, (at, y), (at + 40.0, y), (at + 60.0, y))


def grips_key(hand: Rig, x: float, y: float) -> bool:
    """Return True if a drag from this position moves the second key."""
    before = hand.main_view.work
    hand.drag((x, y), (x + 40.0, y))
    moved = hand.main_view.work.view.timeline.keys[1].frame != 36
    hand.main_view.store.replace(before)
    hand.settle()
    return moved


@ways
def test_canceled_divider_drag_restores_the_divider(hand: Rig, call_off: CallOff) -> None:
    hand.key("Shift+Y")
    hand.drag((0.5 * LEFT, 300), (0.3 * LEFT, 300))
    dragged_and_called_off(hand, call_off, (0.3 * LEFT, 300), (0.6 * LEFT, 300), (0.8 * LEFT, 310))
    hand.drag((0.3 * LEFT, 300), (0.7 * LEFT, 300))
    assert hand.main_view.work.view.compare.divider == pytest.approx(0.7), "it can be gripped again"


def test_escape_without_a_drag_or_during_orbit_unfocuses_the_layer(hand: Rig) -> None:
    hand.move(100, 200)
    hand.press()
    hand.move(160, 220)
    camera = hand.main_view.work.view.camera
    hand.key("Escape")
    assert hand.main_view.work.focus is None
    hand.move(200, 240)
    assert hand.main_view.work.view.camera != camera, "the camera is still in the hand"
    hand.release()
    hand.key("1")
    hand.key("Escape")
    assert hand.main_view.work.focus is None


@ways
def test_canceled_tolerance_drag_restores_the_selection(hand: Rig, call_off: CallOff) -> None:
    hand.key("J")
    hand.click(170.0, 320.0)
    hand.frame(2)
    dragged_and_called_off(hand, call_off, (90.0, TOLERANCE), (140.0, TOLERANCE))
    hand.pause(0.5)  # avoids a double click
    hand.drag((90.0, TOLERANCE), (140.0, TOLERANCE))
    assert hand.main_view.work.view.select.tolerance > SelectTool.tolerance, "what was called off was a drag"
