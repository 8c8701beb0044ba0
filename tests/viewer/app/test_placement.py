"""The window fits on the screen of any monitor at any scale."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import pytest

from benchmarks.viewer.display import display, missing_tools
from tests.helpers.null_app import null_platform
from tests.helpers.paths import ROOT
from viewer.ui.placement import Box, Frame, fit_box, work_areas
from viewer.ui.splash import MINIMUM_SIZE_PX, SIZE, glfw

HD = Box(0, 0, 1280, 720)
BESIDE = Box(1280, 0, 1920, 1080)
TITLED = Frame(left=1, top=30, right=1, bottom=1)


@pytest.mark.parametrize("scale", [1.5, 2.0, 3.0])
def test_scaled_window_fits_a_small_screen(scale: float) -> None:
    window = Box(0, 0, round(1280 * scale), round(800 * scale))
    assert fit_box(window, Frame(), [HD]) == HD
    assert fit_box(window, TITLED, [HD]) == Box(1, 30, 1278, 689)


def test_window_that_fits_is_unchanged() -> None:
    window = Box(100, 40, 800, 600)
    assert fit_box(window, TITLED, [HD]) == window


def test_desktop_panel_stays_free() -> None:
    area = Box(60, 32, 1220, 688)
    assert fit_box(Box(0, 0, 2560, 1600), TITLED, [area]) == Box(61, 62, 1218, 657)


def test_window_stays_on_its_monitor() -> None:
    assert fit_box(Box(1300, 100, 2560, 1600), Frame(), [HD, BESIDE]) == BESIDE
    assert fit_box(Box(1000, 100, 600, 400), Frame(), [HD, BESIDE]) == Box(1280, 100, 600, 400)


def test_position_on_a_missing_monitor_moves_to_the_primary_one() -> None:
    assert fit_box(Box(1500, 200, 1000, 700), TITLED, [HD]) == Box(279, 30, 1000, 689)
    assert fit_box(Box(-3000, -900, 500, 300), Frame(), [HD]) == Box(0, 0, 500, 300)


def test_monitor_left_of_the_primary_one_has_negative_positions() -> None:
    left = Box(-1920, 0, 1920, 1080)
    assert fit_box(Box(-1000, 500, 1280, 800), Frame(), [HD, left]) == Box(-1280, 280, 1280, 800)


def test_window_is_unchanged_without_a_work_area() -> None:
    window = Box(7, 8, 2560, 1600)
    assert fit_box(window, TITLED, []) == window


def test_monitor_without_a_work_area_is_used_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    with null_platform():
        whole = glfw.get_video_mode(glfw.get_primary_monitor()).size
        monkeypatch.setattr(glfw, "get_monitor_workarea", lambda monitor: (0, 0, 0, 0))
        assert work_areas() == [Box(0, 0, whole.width, whole.height)]
        monkeypatch.setattr(glfw, "get_monitors", list)
        assert work_areas() == []
    glfw.terminate()


OPENED = """
import sys
from viewer.ui.splash import Splash, glfw
from viewer.ui.window import Window
window = Window(Splash("test", (int(sys.argv[1]), int(sys.argv[2]))))
glfw.poll_events()
visible = glfw.get_window_attrib(window.handle, glfw.VISIBLE)
print(*glfw.get_window_pos(window.handle), *window.pixels, visible)
window.toggle_full_screen()
window.toggle_full_screen()
glfw.poll_events()
print(*glfw.get_window_size(window.handle), round(window.ui_scale, 2))
"""


@pytest.fixture(scope="module")
def small_screen() -> Iterator[str]:
    """Start a virtual display of 600x450 pixels; yield its name."""
    if missing := missing_tools():
        pytest.skip(f"{missing} is not installed")
    with display(600, 450) as name:
        yield name


@pytest.mark.slow
@pytest.mark.window
@pytest.mark.gl
def test_real_window_is_no_larger_than_the_screen(small_screen: str) -> None:
    environment = os.environ | {"DISPLAY": small_screen}
    environment.pop("WAYLAND_DISPLAY", None)
    command = [sys.executable, "-c", OPENED, *map(str, SIZE)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=ROOT, timeout=120.0)
    assert ran.stdout.splitlines() == ["0 0 600 450 1", f"600 450 {600 / MINIMUM_SIZE_PX[0]:.2f}"], ran.stderr
