"""The list of bindings: whole, readable at the smallest window, and never under a message."""

from __future__ import annotations

import sys

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import Rig, rig
from viewer.app import interface
from viewer.ui.context import SMALL_PX
from viewer.ui.keys import KEYS

SMALLEST = (1024, 640)


def test_every_key_that_has_a_help_text_is_listed_once_under_a_topic() -> None:
    listed = [does for topic in interface.topics() for _, does in topic.rows]
    assert sorted(listed) == sorted(
        [does for _, does in interface.MOUSE_HELP] + [key.help for key in KEYS if key.help]
    )
    assert all(topic.rows for topic in interface.topics())


@pytest.mark.parametrize("count", [1, 2, 3, 9])
def test_columns_keep_all_topics_in_their_order_and_none_is_longer_than_need_be(count: int) -> None:
    topics = interface.topics()
    found = interface.columns(topics, count)
    assert len(found) <= count
    assert tuple(topic for column in found for topic in column) == topics
    longest = max(sum(topic.height for topic in column) for column in found)
    assert longest <= sum(topic.height for topic in topics) / count + max(t.height for t in topics)


def shown(hand: Rig) -> imgui.internal.Window:
    return imgui.internal.find_window_by_name("bindings")


@pytest.mark.gl
@pytest.mark.parametrize(
    ("points", "density", "scale"), [(SMALLEST, 1.0, 1.0), (SMALLEST, 2.0, 1.0), ((2048, 1280), 1.0, 2.0)]
)
def test_the_whole_list_is_readable_in_the_smallest_window(
    points: tuple[int, int], density: float, scale: float
) -> None:
    with rig(None, points, density, scale) as hand:
        hand.key("F1")
        hand.frame(2)
        topics_window = shown(hand)
        assert topics_window.scroll_max.y == 0.0
        assert topics_window.scroll_max.x == 0.0
        assert topics_window.pos.y >= 0.0
        assert topics_window.pos.y + topics_window.size.y <= points[1]
        assert fits_its_columns(hand)


def fits_its_columns(hand: Rig) -> bool:
    """Whether no line is longer than its column."""
    imgui.new_frame()
    imgui.push_font(hand.main_view.ui.fonts.regular, SMALL_PX)
    room = (interface.COLUMN_PX - 8.0) * hand.main_view.ui.scale
    fits = all(
        max(imgui.calc_text_size(chord).x for topic in column for chord, _ in topic.rows)
        + 14.0 * hand.main_view.ui.scale
        + max(imgui.calc_text_size(does).x for topic in column for _, does in topic.rows)
        <= room
        for column in interface.columns(interface.topics(), 3)
    )
    imgui.pop_font()
    imgui.end_frame()
    return fits


@pytest.mark.gl
@pytest.mark.parametrize("times", [1, 4, 16])
def test_a_message_stands_below_the_list_also_where_it_takes_several_lines(times: int) -> None:
    with rig(None, SMALLEST) as hand:
        hand.key("F1")
        hand.main_view.show_message("a line that is long enough to be wrapped " * times)
        hand.frame(3)
        topics_window, message = shown(hand), imgui.internal.find_window_by_name("message")
        assert topics_window.pos.y + topics_window.size.y <= message.pos.y
        assert times > 4 or topics_window.scroll_max.y == 0.0


@pytest.mark.gl
def test_in_a_window_that_is_too_small_the_list_scrolls_to_its_end() -> None:
    with rig(None, (640, 400)) as hand:
        hand.key("F1")
        hand.frame(2)
        before = hand.main_view.work.view.camera
        assert shown(hand).scroll_max.y > 0.0
        for _ in range(40):
            hand.wheel(320.0, 200.0, -2.0)
        assert shown(hand).scroll.y == shown(hand).scroll_max.y
        assert hand.main_view.work.view.camera == before, "the wheel over it zooms nothing"


def test_on_a_mac_command_does_what_control_does_and_the_list_says_so(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from viewer.ui import window

    assert window.chord("S", window.glfw.MOD_SUPER) == "S"
    assert not any("Cmd" in row for topic in interface.topics() for row in topic.rows)
    monkeypatch.setattr(sys, "platform", "darwin")
    both = window.glfw.MOD_SUPER | window.glfw.MOD_SHIFT
    assert window.chord("S", both) == window.chord("S", window.glfw.MOD_CONTROL | window.glfw.MOD_SHIFT)
    assert window.chord("S", both) == "Ctrl+Shift+S"
    assert any("Cmd" in row for topic in interface.topics() for row in topic.rows)


def test_the_window_asks_for_the_only_context_that_a_mac_gives() -> None:
    from viewer.ui import window

    asked, glfw = dict(window._HINTS), window.glfw
    assert (asked[glfw.CONTEXT_VERSION_MAJOR], asked[glfw.CONTEXT_VERSION_MINOR]) == (3, 3)
    assert asked[glfw.OPENGL_PROFILE] == glfw.OPENGL_CORE_PROFILE
    assert asked[glfw.OPENGL_FORWARD_COMPAT]
