"""Double clicks are timed by the arrival of the presses, however long a frame takes."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from pathlib import Path

import pytest
from imgui_bundle import imgui

from tests.helpers.null_app import null_app
from tests.helpers.ui_rig import TRACK, Rig, bear, first_view
from viewer.app import app as application
from viewer.files.document import Document
from viewer.panel import panel
from viewer.ui.window import DoubleClicks

pytestmark = pytest.mark.gl


def click_twice(hand: Rig, gap: float, frame: float, unheard: float = 0.0) -> None:
    """Click the upper slider's handle twice, `gap` seconds apart, in frames of `frame` seconds."""
    clicks = DoubleClicks()
    hand.move(*hand.slider(1, 0.5))
    for press in range(2):
        clicks.note_press(press * gap, unheard, imgui.get_current_context().input_events_next_event_id)
        for down in (True, False):
            hand.io.add_mouse_button_event(0, down)
        for _ in range(3):
            clicks.apply()
            hand.main_view.frame(hand.screen, frame)


@pytest.mark.parametrize("frame", [1 / 60, 0.12, 0.5])
def test_quick_presses_reset_the_slider_even_in_slow_frames(hand: Rig, frame: float) -> None:
    click_twice(hand, 0.06, frame)
    assert hand.strengths == [0.5, 0.0]


@pytest.mark.parametrize("frame", [1 / 60, 0.12])
def test_two_slow_clicks_stay_two_clicks(hand: Rig, frame: float) -> None:
    click_twice(hand, 0.45, frame)
    assert hand.strengths == [0.5, 0.5]


def test_press_time_allows_for_the_length_of_a_long_frame(hand: Rig) -> None:
    click_twice(hand, 0.45, 0.4, unheard=0.4)
    assert hand.strengths == [0.5, 0.0]


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[application.App]:
    stack = bear()
    with null_app(
        Document("bear.ply", stack.scene, stack.gdfs), first_view(stack, 0.5, 0.5), tmp_path
    ) as app:
        yield app


def test_window_records_the_arrival_time_of_a_press(opened: application.App) -> None:
    from viewer.ui.window import glfw

    handle = ctypes.cast(opened.window.handle, ctypes.c_void_p).value or 0
    glfw.set_cursor_pos(opened.window.handle, 900 - panel.WIDTH_PX / 2, TRACK)  # the upper slider's handle
    for _ in range(3):
        opened.draw()
    for action in (1, 0, 1, 0):
        imgui.backends.glfw_mouse_button_callback(handle, 0, action, 0)
    for _ in range(6):
        opened.last -= 0.4  # duration of a frame, seconds
        opened.draw()
    assert [layer.strength for layer in opened.main_view.work.view.layers] == [0.5, 0.0]
