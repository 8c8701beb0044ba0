"""Whole window by keys alone: its parts in turn, their controls, and the way back to the picture."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from tests.viewer.app.test_keys_of_lists_and_form import list_is_open, strike, type_text
from viewer.state.commands import WithText
from viewer.state.forms import DeliverOptions
from viewer.state.workspace import PLACES, Dialog, start_tour

pytestmark = pytest.mark.gl


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.5, 0.5), (1000, 700)) as opened:
        yield opened


def focused() -> int:
    """Return the id of the item with a visible keyboard focus, 0 for none."""
    context = imgui.get_current_context()
    return context.nav_id if context.nav_cursor_visible and context.nav_window is not None else 0


def reach(hand: Rig, label: str, most: int = 40) -> None:
    """Press Tab until the panel item whose id ends with `label` has the focus."""
    panel = imgui.internal.find_window_by_name("panel")
    windows = [w for w in imgui.get_current_context().windows if w.name.startswith("panel") and w.was_active]
    wanted = {window.get_id(label) for window in (panel, *windows)}
    for _ in range(most):
        if focused() in wanted:
            return
        strike(hand, "Tab")
    raise AssertionError(f"no Tab leads to {label}")


def test_f6_cycles_through_all_visible_parts_and_the_picture(hand: Rig) -> None:
    shown = [name for name in PLACES if name not in ("options", "timeline", "tour")]
    for chord, names in (("F6", [*shown, ""]), ("Shift+F6", [*shown[::-1], ""])):
        for name in names:
            strike(hand, chord)
            assert hand.main_view.work.keyboard == name
            assert bool(focused()) or not name, "one sees where it is"
    strike(hand, "J")
    strike(hand, "T")
    hand.main_view.store.replace(start_tour(hand.main_view.work))
    hand.settle()
    for name in (*PLACES, ""):
        strike(hand, "F6")
        assert hand.main_view.work.keyboard == name


def test_tab_moves_within_a_part_where_only_ctrl_shortcuts_work(
    hand: Rig,
) -> None:
    strike(hand, "Tab")
    before = hand.main_view.work
    seen = set()
    for _ in range(20):
        strike(hand, "Tab")
        seen.add(focused())
    assert len(seen) >= 15
    for chord in ("H", "R", "G", "Space", "Delete", "Left"):
        if chord != "Space":
            strike(hand, chord)
    assert hand.main_view.work.view == before.view
    strike(hand, "Ctrl+A")
    assert hand.main_view.work.view.selection.count == 1500
    strike(hand, "Escape")
    assert hand.main_view.work.keyboard == ""
    strike(hand, "H")
    assert not hand.main_view.work.view.layers[1].enabled, "shortcuts are back"


def test_click_returns_the_keyboard_to_the_picture(hand: Rig) -> None:
    strike(hand, "Tab")
    hand.click(300.0, 600.0)
    assert hand.main_view.work.keyboard == ""
    before = hand.strengths[-1]
    strike(hand, "1")
    strike(hand, "Left")
    assert hand.strengths[-1] == pytest.approx(before - 0.01)


def test_focused_slider_takes_arrows_and_enter_types_a_value(hand: Rig) -> None:
    strike(hand, "Alt+G")  # compact rows, where other controls lie beside the slider
    strike(hand, "Tab")
    reach(hand, "##strength")
    at = focused()
    for chord in ("Right", "Right", "Left", "Right"):
        strike(hand, chord)
    assert hand.strengths == pytest.approx([0.5, 0.52])
    assert focused() == at, "they lead nowhere else"
    strike(hand, "Enter")
    type_text(hand, "0.25")
    strike(hand, "Enter")
    assert hand.strengths == pytest.approx([0.5, 0.25])
    strike(hand, "Enter")
    type_text(hand, "0.9")
    strike(hand, "Escape")
    assert hand.strengths == pytest.approx([0.5, 0.25]), "it ends the typing, and no more"
    assert hand.main_view.work.keyboard == "panel"
    strike(hand, "Up")
    assert focused() not in (0, at)


def test_panel_menus_open_and_close_by_keys(hand: Rig) -> None:
    strike(hand, "Tab")
    reach(hand, "main menu")
    strike(hand, "Enter")
    assert list_is_open()
    strike(hand, "Down")
    strike(hand, "Escape")
    assert not list_is_open()
    assert hand.main_view.work.keyboard == "panel"


def test_flood_tool_picks_the_middle_of_the_picture_by_enter(hand: Rig) -> None:
    for chord in (
        "F6",
        "F6",
        "Down",
        "Down",
        "Down",
        "Down",
        "Down",
        "Down",
        "Down",
        "Down",
        "Enter",
        "Escape",
    ):
        strike(hand, chord)
    work = hand.main_view.work
    assert (work.keyboard, work.view.select.tool) == ("", "flood")
    assert not work.view.selection.count
    strike(hand, "Enter")
    picked = hand.main_view.work.view.selection
    assert 0 < picked.count < 1500
    assert hand.main_view.work.renaming is None
    strike(hand, "Ctrl+Z")
    hand.click((1000 - 300) / 2, 350.0)
    assert hand.main_view.work.view.selection.members == picked.members, "as a click there"


def test_question_is_answered_by_tab_and_enter(hand: Rig) -> None:
    options = DeliverOptions(640, 480)
    for chords, width in ((("Enter",), 640), ((*["Tab"] * 8, "Enter"), 853)):  # the eighth is 16:9
        hand.main_view.messages.ask(Dialog("render_picture", "view.png", options=options))
        hand.settle()
        for chord in chords:
            strike(hand, chord)
        dialog = hand.main_view.work.dialog
        assert dialog is not None
        assert dialog.options is not None
        assert (dialog.options.width, dialog.options.height) == (width, 480)
        assert hand.main_view.take_requests() == (WithText("deliver", "render_picture"),) * (width == 640)
        strike(hand, "Escape")


def test_camera_jumps_with_reduced_motion(hand: Rig) -> None:
    for on in (False, True):
        work = hand.main_view.work
        hand.main_view.store.replace(
            replace(work, layout=replace(work.layout, reduced_motion=on), glide=None)
        )
        hand.main_view._perform(WithText("look", "top") if on else WithText("look", "right"))
        assert (hand.main_view.work.glide is None) == on
        hand.settle()
