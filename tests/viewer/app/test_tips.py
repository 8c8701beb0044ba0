"""Tooltips of every control: beside its panel, bar or list, gone after a key, and once for sliders."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.ui import widgets
from viewer.ui.tips import Box, place, show_tip

pytestmark = pytest.mark.gl
SIZES = {"1280x800": ((1280, 800), 1.0), "800x600": ((800, 600), 1.0), "scale 2": ((1600, 1200), 2.0)}
STATES = ("", "Ctrl+N", "G T", "B", "L")
"""Keys that open the form, the gains and the timeline, and the bars of tools."""


@dataclass(frozen=True)
class Control:
    """Control with a tooltip, and the window that contains it."""

    box: Box
    window: Box


def controls(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> list[Control]:
    """Return the visible controls with tooltips of one frame."""
    found: list[Control] = []

    def record(text: str) -> bool:
        low, high = imgui.get_item_rect_min(), imgui.get_item_rect_max()
        root = imgui.internal.get_current_window().root_window
        corner = root.pos
        window = Box(corner.x, corner.y, corner.x + root.size.x, corner.y + root.size.y)
        if imgui.is_item_visible():
            found.append(Control(Box(low.x, low.y, high.x, high.y), window))
        return show_tip(text)

    monkeypatch.setattr(widgets, "show_tip", record)
    hand.frame()
    monkeypatch.undo()
    return found


def open_tip() -> Box | None:
    """Return the box of the open tooltip, None without one."""
    windows = imgui.get_current_context().windows
    for window in windows:
        if window.name.startswith("##Tooltip") and window.active and not window.hidden:
            corner = window.pos
            return Box(corner.x, corner.y, corner.x + window.size.x, corner.y + window.size.y)
    return None


def rest_on(hand: Rig, box: Box) -> Box | None:
    """Rest the mouse on the middle of a control; return the box of its tooltip."""
    hand.main_view.ui.known_tips.clear()
    hand.move((box.left + box.right) / 2, (box.top + box.bottom) / 2)
    for _ in range(3):
        hand.pause(0.4)
    hand.frame(2)
    return open_tip()


def check(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> int:
    """Check the tooltip of every visible control; return their number."""
    tested = 0
    for control in controls(hand, monkeypatch):
        tip = rest_on(hand, control.box)
        if tip is None:  # another control lies over it
            continue
        tested += 1
        assert not tip.overlaps(control.window), control
        assert min(tip.left, tip.top) >= 0.0
        assert tip.right <= hand.points[0]
        assert tip.bottom <= hand.points[1]
    return tested


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_tips_cover_no_list(size: str, monkeypatch: pytest.MonkeyPatch) -> None:
    points, scale = SIZES[size]
    tested = 0
    with rig(replace(first_view(bear(), 0.5, 0.5), axes=True), points, scale=scale) as hand:
        first = hand.main_view.work
        for state in STATES:
            hand.main_view.store.replace(first)
            hand.frame(2)
            for chord in state.split():
                hand.key(chord)
            tested += check(hand, monkeypatch)
    assert tested > 80


@pytest.mark.slow
def test_tips_cover_no_open_menu(monkeypatch: pytest.MonkeyPatch) -> None:
    menus = 0
    with rig(replace(first_view(bear(), 0.5, 0.5), axes=True), (1000, 700)) as hand:
        first = hand.main_view.work
        for state in ("", "Ctrl+N"):
            hand.main_view.store.replace(first)
            hand.frame(2)
            if state:
                hand.key(state)
            start = hand.main_view.work
            for control in controls(hand, monkeypatch):
                hand.main_view.store.replace(start)
                hand.frame(2)
                hand.click(
                    (control.box.left + control.box.right) / 2, (control.box.top + control.box.bottom) / 2
                )
                hand.frame(3)
                if imgui.get_current_context().open_popup_stack:
                    menus += 1
                    check(hand, monkeypatch)
                    imgui.internal.close_popups_over_window(
                        imgui.internal.find_window_by_name("panel"), False
                    )
                    hand.frame(2)
    assert menus >= 5


def test_key_hides_the_tip_until_the_mouse_moves(hand: Rig) -> None:
    hand.move(*hand.slider(0, 0.5))
    hand.rest()
    assert open_tip() is not None
    hand.io.add_key_event(imgui.Key.a, True)
    hand.event()
    hand.rest()
    assert open_tip() is None


def test_slider_explains_itself_once(hand: Rig) -> None:
    hand.move(*hand.slider(0, 0.5))
    hand.rest()
    assert open_tip() is not None
    for layer in (1, 0):
        hand.move(*hand.slider(layer, 0.5))
        hand.rest()
        assert open_tip() is None


def test_tip_without_room_covers_only_the_list() -> None:
    item = Box(100.0, 100.0, 200.0, 120.0)
    everywhere = Box(0.0, 0.0, 400.0, 300.0)
    left, top = place(item, [everywhere], (90.0, 40.0), (400.0, 300.0), 8.0)
    assert not Box(left, top, left + 90.0, top + 40.0).overlaps(item)
