"""One bar above the picture at a time, and none over another, in each tool and in small windows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui
from PIL import Image

from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.app.parts.pictures import DecalTextures
from viewer.state.commands import Plain
from viewer.state.forms import with_settings
from viewer.state.workspace import start_tour, with_question, with_transient
from viewer.ui.glfw_library import glfw

pytestmark = pytest.mark.gl
SIZES = {"1280x800": (1280, 800, 1.0), "800x600": (800, 600, 1.0), "scale 2": (1600, 1200, 2.0)}
PLATES = ("message", "question", "placing", "timeline", "tools", "options", "comparison", "view", "tour")
STATES = (
    *("B", "L", "P", "R", "J", "I", "Shift+M", "K", "Alt+M", "Ctrl+A", "Shift+P"),
    *("Ctrl+A Shift+P", "Ctrl+A R Shift+P", "Shift+P L", "Ctrl+A Alt+M", "Ctrl+A R Alt+M K"),
    *("decal", "decal R", "Ctrl+A decal", "decal K"),
)
"""Keys that bring up the bars of each tool, alone and over a selection."""

Box = tuple[float, float, float, float]


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    view = replace(first_view(bear(), 0.5, 0.5), axes=True)
    with null_app(opened_document(folder), view, folder) as app:
        yield app


def bars() -> dict[str, Box]:
    """Return the left, top, right and bottom of each bar on screen."""
    windows = imgui.get_current_context().windows
    shown = [window for window in windows if window.active and not window.hidden]
    return {
        window.name.split("##")[0]: (
            window.pos.x,
            window.pos.y,
            window.pos.x + window.size.x,
            window.pos.y + window.size.y,
        )
        for window in shown
        if window.name.split("##")[0] in PLATES
    }


def hold_decal(app: App, folder: Path) -> None:
    """Take a picture in hand, which follows the pointer in the middle of the bear."""
    pixels = np.zeros((40, 80, 4), np.uint8)
    pixels[10:30, 20:60] = 200, 30, 30, 255
    Image.fromarray(pixels).save(folder / "logo.png")
    decal = DecalTextures(app.main_view.context).load(folder / "logo.png")
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=decal))
    wide, tall = app.main_view.picture_size
    imgui.get_io().add_mouse_pos_event(wide / 2, tall / 2)
    rest(app)


def place_decal(app: App, folder: Path) -> None:
    """Take a picture in hand as if it had just been placed in the middle of the bear."""
    hold_decal(app, folder)
    press(app, "Enter")
    until_placed(app)


def until_placed(app: App) -> None:
    for _ in range(200):
        rest(app)
        if getattr(app.main_view.work.transient.gizmo, "placed", False):
            return
    pytest.fail("the decal is not placed")


def rest(app: App) -> None:
    for _ in range(3):
        app.main_view.wake()
        app.draw()


@pytest.mark.parametrize("size", SIZES)
def test_no_bar_covers_another(app: App, folder: Path, size: str) -> None:
    *points, zoom = SIZES[size]
    glfw.set_window_size(app.window.handle, *points)
    first = replace(app.main_view.work, layout=replace(app.main_view.work.layout, zoom=zoom))
    buttons = [("Flip", Plain("flip_up")), ("Choose…", Plain("view_settings"))]
    first = start_tour(with_question(first, "Guessed −Y as up", buttons))
    for state in STATES:
        app.main_view.store.replace(first)
        rest(app)
        for step in state.split():
            if step == "decal":
                place_decal(app, folder)
            else:
                press(app, step)
        rest(app)
        shown = bars()
        display = imgui.get_io().display_size
        assert (display.x, display.y) == tuple(points)
        assert {"tools", "question", "tour"} < set(shown), state
        assert len({"placing", "options"} & set(shown)) <= 1, state
        for name, (left, top, right, bottom) in shown.items():
            assert min(left, top) >= 0.0, (state, name)
            assert right <= points[0], (state, name)
            assert bottom <= points[1], (state, name)
        for (name, one), (other_name, other) in combinations(shown.items(), 2):
            is_beside = one[2] <= other[0] + 1 or other[2] <= one[0] + 1
            is_above = one[3] <= other[1] + 1 or other[3] <= one[1] + 1
            assert is_beside or is_above, (state, name, one, other_name, other)


@pytest.mark.parametrize("size", SIZES)
def test_no_bar_covers_the_instruction_for_a_decal(app: App, folder: Path, size: str) -> None:
    *points, zoom = SIZES[size]
    glfw.set_window_size(app.window.handle, *points)
    app.store.replace(replace(app.main_view.work, layout=replace(app.main_view.work.layout, zoom=zoom)))
    press(app, "Ctrl+A")
    rest(app)
    assert {"comparison", "options"} <= set(bars())
    hold_decal(app, folder)
    for tool in ("", "R", "U", "I", "B", "Alt+B", "K"):
        if tool:
            press(app, tool)
        rest(app)
        assert not {"comparison", "options"} & set(bars()), tool


def test_live_grade_has_a_comparison_without_a_layer(app: App) -> None:
    work = app.main_view.work
    form = with_settings(work.form, "grade:exposure=0.7")
    assert form is not None
    empty = replace(work, view=replace(work.view, layers=()), focus=None)
    app.store.replace(empty)
    rest(app)
    assert "comparison" not in bars()
    app.store.replace(replace(empty, form=form, form_open=True))
    rest(app)
    assert "comparison" in bars()
    app.store.replace(replace(empty, form=replace(form, preview=False), form_open=True))
    rest(app)
    assert "comparison" not in bars(), "nothing is shown to compare"
