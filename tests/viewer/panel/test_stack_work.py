"""Long stacks in the panel: compact rows, several selected layers, groups and search."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imgui_bundle import imgui

from progdf.compose.composer import Composer
from tests.helpers.count import Count
from tests.helpers.stacks import EDITS, many_edits
from tests.helpers.ui_rig import Rig, bear, rig
from viewer.panel import panel
from viewer.panel.slider import RADIUS_PX
from viewer.state import layer_selection
from viewer.state.view_state import LayerGroup

pytestmark = pytest.mark.gl
SIZE = (1024, 800)
LEFT = SIZE[0] - panel.WIDTH_PX
# center of the first compact row, and the distance between rows
TOP = 130.0
STEP = 27.0
NAME = LEFT + 90.0


def track(hand: Rig, name: str, strength: float) -> float:
    """Return the x of a strength on the first slider of this imgui id."""
    box = hand.box(name)
    return box.left + RADIUS_PX + strength * (box.right - box.left - 2 * RADIUS_PX)


def row(layer: int, count: int = len(EDITS)) -> float:
    return TOP + STEP * (count - 1 - layer)


def click_with(hand: Rig, key: imgui.Key, x: float, y: float) -> None:
    hand.modifier(key)
    hand.click(x, y)
    hand.modifier(key, False)


def type_text(hand: Rig, text: str, end: imgui.Key) -> None:
    hand.frame(2)
    hand.io.add_input_characters_utf8(text)
    hand.settle()
    hand.modifier(end)
    hand.modifier(end, False)
    hand.settle()


def selected(hand: Rig) -> list[str]:
    work = hand.main_view.work
    return [work.view.layers[i].name for i in layer_selection.selected_layers(work)]


def order(hand: Rig) -> list[str]:
    return [layer.name for layer in hand.main_view.work.view.layers]


def test_strengths_of_twenty_compact_rows_move_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stack, view = many_edits(bear())
    with rig(view, SIZE, stack=stack) as hand:
        assert not hand.main_view.work.cards_fit
        hand.click(track(hand, "##strength", 0.25), row(0))
        assert hand.strengths[0] == pytest.approx(0.25, abs=0.01), "the last row is in reach"
        hand.click(*hand.at("about layers"))
        hand.click(*hand.at("##Add"))
        assert hand.main_view.work.view.blend == "sum", "and so is the blend rule"
        hand.click(NAME, row(0))
        click_with(hand, imgui.Key.mod_shift, NAME, row(19))
        assert len(selected(hand)) == 20
        entries = len(hand.main_view.work.past.past)
        hand.click(NAME - 25.0, row(2))
        assert selected(hand) == [order(hand)[2]], "a click on one of them selects it alone"
        hand.click(NAME, row(0))
        click_with(hand, imgui.Key.mod_shift, NAME, row(19))
        _, y = hand.at("##master")
        start = (track(hand, "##master", 0.5), y)
        composed = Count(monkeypatch, Composer, "update")
        drawn = hand.main_view.canvas.pictures_drawn
        hand.move(*start)
        hand.press()
        for share in (0.45, 0.3, 0.6, 0.8):
            hand.move(track(hand, "##master", share), y)
        hand.release()
        assert hand.strengths == pytest.approx([0.4, *[0.8] * 19], abs=0.02), "in proportion"
        assert composed.calls == 4, "once per change"
        assert hand.main_view.canvas.pictures_drawn == drawn + 4
        assert len(hand.main_view.work.past.past) == entries + 1
        hand.key("Ctrl+Z")
        assert hand.strengths == pytest.approx([0.25, *[0.5] * 19], abs=0.01)
        hand.key("Escape")
        hand.key("Alt+G")
        assert hand.main_view.work.view.cards == "full"
        hand.key("Alt+G")
        click_with(hand, imgui.Key.mod_ctrl, NAME, row(3))
        assert selected(hand) == [EDITS[0], EDITS[3]]
        hand.click(track(hand, "##strength", 0.7), row(3))
        assert len(selected(hand)) == 2, "a slider moves alone and leaves the selection"
        assert hand.strengths[3] == pytest.approx(0.7, abs=0.01)
        entries = len(hand.main_view.work.past.past)
        names = order(hand)
        hand.drag((NAME, row(3)), (NAME, row(18) + 0.6 * STEP))
        assert order(hand)[-4:] == [EDITS[0], EDITS[3], EDITS[18], EDITS[19]], "all that are selected"
        assert selected(hand) == [EDITS[0], EDITS[3]]
        assert len(hand.main_view.work.past.past) == entries + 1
        hand.key("Ctrl+Z")
        assert order(hand) == names
        hand.pause(0.5)  # avoids a double click
        hand.click(NAME, row(3))
        assert selected(hand) == [EDITS[3]], "a click, unlike a drag, leaves the others"
        hand.click(NAME, row(5))
        assert selected(hand) == [EDITS[5]]
        hand.key("Ctrl+G")
        hand.click(NAME, row(0) + STEP)
        click_with(hand, imgui.Key.mod_ctrl, NAME, row(1) + STEP)
        hand.click(track(hand, "##strength", 0.9), hand.at("##strength", -1)[1])
        assert hand.strengths[0] == pytest.approx(0.9, abs=0.01), "the bar hides no row that is selected"


def test_search_finds_names_and_regions_and_reset_covers_selection() -> None:
    stack, view = many_edits(bear(), 12)
    with rig(view, SIZE, stack=stack) as hand:
        hand.click(track(hand, "##strength", 0.9), row(11, 12))
        hand.key("Ctrl+F")
        type_text(hand, "TANK", imgui.Key.enter)
        assert hand.main_view.work.search == "TANK"
        for y in (TOP, TOP + STEP):
            click_with(hand, imgui.Key.mod_ctrl, NAME, y)
        click_with(hand, imgui.Key.mod_ctrl, NAME, row(0, 1))
        assert "tank flames" not in selected(hand)
        click_with(hand, imgui.Key.mod_ctrl, NAME, row(0, 1))
        assert selected(hand) == ["tank chrome", "tank flames", EDITS[11]]
        assert hand.strengths[9:11] == [0.5, 0.5]
        hand.key("Ctrl+F")
        type_text(hand, "scarf", imgui.Key.enter)
        hand.key("Ctrl+Alt+A")
        hand.key("Ctrl+R")
        assert hand.strengths[9:11] == [0.0, 0.0], "also what the search does not show, as all means all"


def test_group_is_created_folded_dimmed_and_dissolved_in_the_panel() -> None:
    stack, view = many_edits(bear(), 12)
    with rig(view, SIZE, stack=stack) as hand:
        hand.click(NAME, row(11, 12))
        click_with(hand, imgui.Key.mod_shift, NAME, row(9, 12))
        bright = hand.picture()
        hand.key("Ctrl+G")
        assert hand.main_view.work.view.groups == (LayerGroup("Group"),)
        assert np.array_equal(hand.picture(), bright), "a group changes nothing by itself"
        hand.click(track(hand, "##factor", 0.5), TOP)
        assert hand.main_view.work.view.groups[0].strength == pytest.approx(0.5, abs=0.03)
        assert not np.array_equal(hand.picture(), bright)
        hand.click(LEFT + 20.0, TOP)
        assert hand.main_view.work.view.collapsed == ("Group",)
        hand.click(NAME, TOP + STEP)
        assert selected(hand) == [EDITS[8]], "the next row is the one below the group"
        hand.click(NAME, TOP)
        assert selected(hand) == list(EDITS[9:12])
        entries = len(hand.main_view.work.past.past)
        hand.pause(0.5)  # avoids a double click
        hand.drag((NAME, TOP), (NAME, TOP + 2 * STEP + 10.0))
        assert order(hand)[7:] == [*EDITS[9:12], *EDITS[7:9]]
        assert {layer.group for layer in hand.main_view.work.view.layers[7:10]} == {"Group"}
        assert len(hand.main_view.work.past.past) == entries + 1
        hand.key("Ctrl+Z")
        assert order(hand) == list(EDITS[:12])
        hand.frame(30)
        hand.double_click(NAME, TOP)
        type_text(hand, "tank", imgui.Key.enter)
        assert hand.main_view.work.view.groups[0].name == "tank"
        hand.key("Ctrl+Shift+G")
        assert hand.main_view.work.view.groups == ()
        assert hand.strengths[11] == pytest.approx(0.25, abs=0.02)
        for _ in range(4):
            hand.key("Ctrl+Z")
        hand.move(5.0, 5.0)  # away from the name, which shows its region while hovered
        hand.rest()  # until the undo message has disappeared
        assert np.array_equal(hand.picture(), bright)


def test_member_of_the_last_group_is_dragged_to_its_end_or_below() -> None:
    stack, view = many_edits(bear(), 12)
    members = {i: replace(layer, group="ends") for i, layer in enumerate(view.layers[:3])}
    grouped = replace(view, layers=(*members.values(), *view.layers[3:]), groups=(LayerGroup("ends"),))
    with rig(grouped, SIZE, stack=stack) as hand:
        # the group's own row lies above them
        second = TOP + STEP * 11
        last = TOP + STEP * 12
        hand.drag((NAME, second), (NAME, last + 0.5 * STEP))
        assert order(hand)[:3] == [EDITS[1], EDITS[0], EDITS[2]]
        assert all(layer.group for layer in hand.main_view.work.view.layers[:3]), "to the group's end"
        hand.pause(0.5)
        hand.drag((NAME, last), (NAME, last + 1.5 * STEP))
        assert order(hand)[:3] == [EDITS[1], EDITS[0], EDITS[2]]
        assert [layer.group for layer in hand.main_view.work.view.layers[:3]] == ["", "ends", "ends"]
        assert len(hand.main_view.work.past.past) == 2
