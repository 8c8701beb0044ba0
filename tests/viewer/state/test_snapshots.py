"""Snapshots: added, restored, renamed, reordered and deleted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.divided import beside_line
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.app import app as application
from viewer.state import snapshots, workspace
from viewer.state.actions import perform
from viewer.state.commands import Action, ChooseSnapshot, MoveSnapshot, OnItem, Plain, Rename, WithValue

# y of a snapshot card whose x is 874, and of items in its menu
CARD = 316.0
RENAME = 332.0
DELETE = 436.0


def test_snapshots_can_be_restored_as_one_undo_entry() -> None:
    work = workspace.new_workspace(first_view(bear(), 0.5, 0.5))
    facts = application.Document("bear.ply", bear().scene, bear().gdfs).facts()

    def act(work: workspace.Workspace, action: Action) -> workspace.Workspace:
        return workspace.record_undo(perform(work, action, facts))

    work = act(work, Plain("snapshot"))
    assert act(work, Plain("snapshot")).snapshots == work.snapshots, "the same twice is once"
    work = act(work, WithValue("nudge", 0.25))
    work = act(work, Plain("snapshot"))
    assert [s.name for s in snapshots.with_original(work.snapshots, work.view)] == ["original", "1", "2"]
    entries = len(work.past.past)
    back = act(work, OnItem("restore", 1))
    assert [layer.strength for layer in back.view.layers] == [0.5, 0.5]
    assert back.view.blend == work.view.blend
    assert len(back.past.past) == entries + 1
    assert act(back, Plain("undo")).view == work.view
    assert [layer.strength for layer in act(work, OnItem("restore", 0)).view.layers] == [0.0, 0.0]
    deleted = act(work, OnItem("forget", 1))
    assert [s.name for s in deleted.snapshots] == ["2"]
    assert act(deleted, Plain("undo")).snapshots == work.snapshots
    assert act(act(deleted, Plain("undo")), Plain("redo")).snapshots == deleted.snapshots
    named = act(work, Rename("name_snapshot", 2, " warm  light "))
    assert [s.name for s in named.snapshots] == ["1", "warm light"]
    assert act(named, Plain("undo")).snapshots == work.snapshots


def test_restoring_a_snapshot_sets_later_edits_to_zero() -> None:
    view = first_view(bear(), 0.5, 0.5)
    kept = snapshots.take((), replace(view, layers=view.layers[:1]))
    back = snapshots.restore(view, kept[0])
    assert [(layer.name, layer.strength) for layer in back.layers] == [("scarf", 0.5), ("ears", 0.0)]


def test_snapshots_are_reordered_and_renamed_with_their_pair() -> None:
    work = workspace.new_workspace(first_view(bear(), 0.5, 0.5))
    facts = application.Document("bear.ply", bear().scene, bear().gdfs).facts()
    take = Plain("snapshot")
    nudge = WithValue("nudge", 0.1)
    for action in (take, nudge, take, nudge, take, ChooseSnapshot("a", "1")):
        work = workspace.record_undo(perform(work, action, facts))
    moved = workspace.record_undo(perform(work, MoveSnapshot(3, 1), facts))
    assert [kept.name for kept in moved.snapshots] == ["3", "1", "2"]
    assert [kept.name for kept in perform(moved, Plain("undo"), facts).snapshots] == ["1", "2", "3"]
    assert [kept.name for kept in perform(moved, MoveSnapshot(1, 0), facts).snapshots] == ["3", "1", "2"]
    named = perform(moved, Rename("name_snapshot", 2, "dusk"), facts)
    assert named.view.pair.a == "dusk"
    assert perform(named, Rename("name_snapshot", 3, "original"), facts).snapshots[2].name == "original-2"
    gone = perform(named, OnItem("forget", 2), facts)
    assert snapshots.pair_of(snapshots.with_original(gone.snapshots, gone.view), gone.view.pair) == (1, 2)


@pytest.mark.gl
def test_click_on_a_thumbnail_restores_and_its_menu_deletes() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (1024, 640)) as hand:
        first = hand.picture()
        for chord in ("F5", "Shift+Left", "Shift+Left", "F5"):
            hand.key(chord)
        hand.rest()
        assert hand.main_view.next_frame_delay() is None, "the small pictures are there"
        entries = len(hand.main_view.work.past.past)
        drawn = hand.image()[291:341, 745:1005]
        assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 500, "pictures, not empty cards"
        hand.move(874.0, CARD)
        hand.press()
        hand.release()
        assert hand.strengths == [0.5, 0.5]
        assert np.array_equal(hand.picture(), first)
        assert len(hand.main_view.work.past.past) == entries + 1
        hand.press(1)
        hand.release(1)
        assert [kept.name for kept in hand.main_view.work.snapshots] == ["1", "2"], "only a menu opens"
        hand.click(904.0, DELETE)
        assert [kept.name for kept in hand.main_view.work.snapshots] == ["2"]
        hand.key("Ctrl+Z")
        assert [kept.name for kept in hand.main_view.work.snapshots] == ["1", "2"]
        hand.move(874.0, CARD)
        hand.press(1)
        hand.release(1)
        hand.click(904.0, RENAME)
        hand.frame(2)
        hand.io.add_input_characters_utf8("dusk")
        hand.settle()
        hand.modifier(imgui.Key.enter)
        hand.settle()
        assert [kept.name for kept in hand.main_view.work.snapshots] == ["dusk", "2"]


@pytest.mark.gl
def test_two_snapshots_are_compared_until_the_next_edit() -> None:
    with rig(first_view(bear(), 1.0, 0.0), (1024, 640)) as hand:
        hand.key("Shift+F5")
        assert hand.main_view.work.view.compare.mode == "off"
        message = hand.main_view.work.message
        assert message is not None
        assert message.text == "There is no snapshot to compare; F5 adds one"
        warm = hand.picture()
        hand.key("F5")
        hand.key("2")
        for chord in (*["Shift+Left"] * 10, "1", *["Shift+Right"] * 10, "F5"):
            hand.key(chord)
        assert hand.strengths == [0.0, 1.0]
        gold = hand.picture()
        hand.key("1")
        hand.key("Shift+Left")
        hand.key("Shift+F5")
        seen = hand.picture()
        middle = round(0.5 * 724)
        assert np.array_equal(*(beside_line(p, middle)[0] for p in (seen, warm)))
        assert np.array_equal(*(beside_line(p, middle)[1] for p in (seen, gold)))
        message = hand.main_view.canvas.comparer.labels(hand.main_view.work.view)
        assert message.left == "1"
        assert message.right == "2"
        hand.key("Shift+Left")
        assert hand.main_view.work.view.compare.mode == "off", "one sees what one does"
        hand.move(968.0, CARD)
        hand.press(1)
        hand.release(1)
        hand.click(990.0, 394.0)  # moves it left
        assert [kept.name for kept in hand.main_view.work.snapshots] == ["2", "1"]
        assert hand.strengths == [0.0, 0.8], "and not gone back to"
