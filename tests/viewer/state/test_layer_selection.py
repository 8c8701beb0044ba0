"""Several layers at once: selected, dimmed in proportion, reset, copied, moved and grouped."""

from __future__ import annotations

from dataclasses import replace

import pytest

from viewer.camera.view_camera import Bounds
from viewer.state import layer_selection, layers, workspace
from viewer.state.actions import perform
from viewer.state.commands import Action, OnItem, Plain, PressLayer, Rename, WithText, WithValue
from viewer.state.facts import LayerRow
from viewer.state.view_state import LayerGroup, LayerState, ViewState
from viewer.state.workspace import SceneFacts, Workspace

NAMES = "abcdef"
FACTS = SceneFacts("bear.ply", 100, Bounds(), [LayerRow(10, (0.5, 0.5, 0.5), (0.0, 1.0), "", Bounds())] * 6)


def six(*strengths: float) -> Workspace:
    """Return a workspace with layers a (bottom) to f (top, focused)."""
    known = (*strengths, *[0.5] * (len(NAMES) - len(strengths)))
    rows = tuple(LayerState(i, name, known[i]) for i, name in enumerate(NAMES))
    return workspace.new_workspace(ViewState(layers=rows))


def act(work: Workspace, *actions: Action) -> Workspace:
    """Perform the actions, each as its own undo step."""
    for action in actions:
        work = workspace.record_undo(perform(work, action, FACTS))
    return work


def press(work: Workspace, how: str, name: str) -> Workspace:
    index = [layer.name for layer in work.view.layers].index(name)
    return act(work, PressLayer(str(how), index, (5, 4, 3, 2, 1, 0)))


def selected(work: Workspace) -> str:
    return "".join(work.view.layers[i].name for i in layer_selection.selected_layers(work))


def strengths(work: Workspace) -> list[float]:
    return [layer.strength for layer in work.view.layers]


def order(work: Workspace) -> str:
    return "".join(layer.name for layer in work.view.layers)


def groups(work: Workspace) -> list[str]:
    return [layer.group for layer in work.view.layers]


def test_presses_select_a_layer_toggle_or_extend_the_range() -> None:
    work = press(six(), "range", "c")
    assert selected(work) == "cdef"
    assert work.focus == 5, "the range begins there, also of the next one"
    assert selected(press(work, "range", "d")) == "def"
    work = press(work, "toggle", "d")
    assert selected(work) == "cef"
    assert selected(press(work, "keep", "c")) == "cef", "a slider of a selected card is moved alone"
    assert selected(press(work, "keep", "a")) == "a"
    work = press(work, "toggle", "f")
    assert (selected(work), work.view.layers[work.focus or 0].name) == ("ce", "e")
    assert selected(press(work, "one", "e")) == "e"
    assert selected(act(six(), Plain("select_layers"))) == NAMES
    assert selected(act(work, Plain("unfocus"))) == "e", "Esc leaves the others first"
    assert selected(act(work, Plain("unfocus"), Plain("unfocus"))) == ""


def test_master_slider_keeps_proportions_through_zero() -> None:
    work = press(six(0.0, 0.0, 0.0, 0.2, 0.4, 0.8), "range", "d")
    entries = len(work.past.past)
    before = work.view
    moved = work
    for strength in (0.4, 0.0, 0.6):
        moved = perform(moved, WithValue("master", strength), FACTS)
    assert strengths(moved) == pytest.approx([0.0, 0.0, 0.0, 0.15, 0.3, 0.6])
    moved = workspace.record_undo(moved)
    assert len(moved.past.past) == entries + 1
    assert act(moved, Plain("undo")).view == before
    locked = replace(work.view.layers[5], locked=True)
    held = workspace.record_undo(
        replace(work, view=replace(work.view, layers=(*work.view.layers[:5], locked)))
    )
    assert strengths(act(held, WithValue("master", 1)))[3:] == [0.5, 1.0, 0.8], (
        "a locked one neither moves nor counts"
    )
    assert strengths(act(press(six(0, 0), "toggle", "a"), WithValue("master", 0.25)))[0] == pytest.approx(0.0)
    bottom = press(press(six(0, 0), "one", "a"), "toggle", "b")
    assert strengths(act(bottom, WithValue("master", 0.25)))[:2] == [0.25, 0.25], "from 0 all rise together"
    assert strengths(act(work, WithValue("nudge", 0.1)))[3:] == pytest.approx([0.225, 0.45, 0.9])


def test_hide_lock_reset_and_delete_apply_to_all_selected_layers() -> None:
    work = press(six(), "range", "d")
    assert [layer.enabled for layer in act(work, Plain("hide")).view.layers] == [True] * 3 + [False] * 3
    assert [layer.locked for layer in act(work, Plain("lock")).view.layers] == [False] * 3 + [True] * 3
    assert strengths(act(work, Plain("reset"))) == [0.5] * 3 + [0.0] * 3
    assert strengths(act(work, Plain("lock"), Plain("reset_all"))) == [0.0] * 3 + [0.5] * 3
    gone = act(work, Plain("remove"))
    assert (order(gone), gone.focus) == ("abc", 2)
    assert order(act(work, OnItem("remove", 0))) == "bcdef", "a layer outside of the selection goes alone"


def test_group_gathers_hides_dims_and_dissolves_its_layers() -> None:
    work = act(press(press(six(), "one", "b"), "toggle", "e"), Plain("group"))
    assert (order(work), groups(work)) == ("acdbef", ["", "", "", "Group", "Group", ""])
    assert selected(work) == "be"
    dimmed = replace(work, view=replace(work.view, groups=(LayerGroup("Group", strength=0.5),)))
    assert [l.strength for l in layers.visible_layers(dimmed.view)] == [0.5, 0.5, 0.5, 0.25, 0.25, 0.5]
    loose = act(dimmed, Plain("ungroup"))
    assert strengths(loose) == [0.5, 0.5, 0.5, 0.25, 0.25, 0.5]
    assert (groups(loose), loose.view.groups) == ([""] * 6, ())
    off = replace(work, view=replace(work.view, groups=(LayerGroup("Group", enabled=False),)))
    assert [l.name for l in layers.visible_layers(off.view)] == ["a", "c", "d", "f"]
    assert not layers.is_visible(off.view, off.view.layers[3])
    named = act(work, Rename("rename_group", 0, " warm  light "))
    assert groups(named)[3:5] == ["warm light"] * 2
    two = act(press(press(named, "one", "a"), "toggle", "c"), Plain("group"))
    assert act(two, Rename("rename_group", 1, "warm light")).view.groups == two.view.groups, (
        "no two of one name"
    )
    assert groups(act(press(named, "one", "a"), WithText("group", "warm light"))) == [
        "",
        "",
        *["warm light"] * 3,
        "",
    ]
    assert act(named, OnItem("remove", 4), OnItem("remove", 3)).view.groups == ()
    assert [
        work.view.layers[i].name for i in layer_selection.filter_layers(work.view, ["red"] * 6, "GROUP Red")
    ] == [
        "b",
        "e",
    ]


def test_moved_layer_joins_the_surrounding_group() -> None:
    work = act(press(press(six(), "one", "c"), "toggle", "d"), Plain("group"))
    joined = act(press(work, "one", "b"), WithValue("move", -1))
    assert (order(joined), groups(joined)) == ("acbdef", ["", "Group", "Group", "Group", "", ""])
    left = act(press(work, "one", "d"), WithValue("move", -1))
    assert (order(left), groups(left)) == ("abcedf", ["", "", "Group", "", "", ""])
    up = act(act(work, WithText("select_layers", "Group")), WithValue("move", -1))
    assert (order(up), groups(up)) == ("abecdf", ["", "", "", "Group", "Group", ""])
    assert order(act(up, WithValue("move", -1), WithValue("move", -1))) == "abefcd", (
        "the end stops all of them"
    )
    two = act(press(press(work, "one", "e"), "toggle", "f"), Plain("group"))
    down = act(two, WithValue("move", 1))
    assert (order(down), groups(down)[2:]) == ("abefcd", ["Group 2"] * 2 + ["Group"] * 2), "over all of it"
    assert groups(act(press(two, "one", "d"), WithValue("move", 1), WithValue("move", 1))) == [
        "",
        "",
        "",
        "Group",
        *["Group 2"] * 2,
    ]


def test_compact_rows_are_automatic_and_can_be_toggled() -> None:
    work = six()
    assert act(work, Plain("cards")).view.cards == "compact"
    assert act(work, Plain("cards"), Plain("cards")).view.cards == "auto"
    full = replace(work, cards_fit=False)
    assert act(full, Plain("cards")).view.cards == "full"
    assert act(full, Plain("cards"), Plain("cards")).view.cards == "auto"
