"""Snapshots: taken, gone back to, forgotten."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imgui_bundle import imgui

from progdf.compose.composer import Composer
from progdf.compose.layers import Gains
from tests.helpers.count import Count
from tests.helpers.divided import beside_line
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.app import app as application
from viewer.state import paint, snapshots, workspace
from viewer.state.actions import perform
from viewer.state.layers import visible_layers
from viewer.state.view_state import LayerGroup, SnapshotPair, ViewState

SLIDER = 291.0  # between A and B
CARD, RENAME, DELETE = 342.0, 358.0, 462.0  # a snapshot at 874, and in its menu


def test_snapshots_are_one_undo_entry_to_go_back_to_and_begin_with_the_original() -> None:
    work = workspace.new_workspace(first_view(bear(), 0.5, 0.5))
    facts = application.Document("bear.ply", bear().scene, bear().gdfs).facts()

    def act(work: workspace.Workspace, action: str) -> workspace.Workspace:
        return workspace.record_undo(perform(work, action, facts))

    work = act(work, "snapshot")
    assert act(work, "snapshot").snapshots == work.snapshots, "the same twice is once"
    work = act(work, "nudge:0.25")
    work = act(work, "snapshot")
    assert [s.name for s in snapshots.with_original(work.snapshots, work.view)] == ["original", "1", "2"]
    entries = len(work.past.past)
    back = act(work, "restore:1")
    assert [layer.strength for layer in back.view.layers] == [0.5, 0.5]
    assert back.view.blend == work.view.blend
    assert len(back.past.past) == entries + 1
    assert act(back, "undo").view == work.view
    assert [layer.strength for layer in act(work, "restore:0").view.layers] == [0.0, 0.0]
    deleted = act(work, "forget:1")
    assert [s.name for s in deleted.snapshots] == ["2"]
    assert act(deleted, "undo").snapshots == work.snapshots
    assert act(act(deleted, "undo"), "redo").snapshots == deleted.snapshots
    named = act(work, "name_snapshot:2: warm  light ")
    assert [s.name for s in named.snapshots] == ["1", "warm light"]
    assert act(named, "undo").snapshots == work.snapshots


def test_going_back_keeps_edits_that_were_opened_since_at_zero() -> None:
    view = first_view(bear(), 0.5, 0.5)
    kept = snapshots.take((), replace(view, layers=view.layers[:1]))
    back = snapshots.restore(view, kept[0])
    assert [(layer.name, layer.strength) for layer in back.layers] == [("scarf", 0.5), ("ears", 0.0)]


def two_snapshots() -> tuple[ViewState, tuple[snapshots.SliderSnapshot, ...]]:
    """A view whose scarf is in A alone; its ears stand at .2 in A and, painted, at 1 in B."""
    view = first_view(bear(), 0.8, 0.2)
    kept = snapshots.take((), replace(view, blend="sum"))
    scarf, ears = view.layers
    painted = paint.encode(np.zeros(len(bear().gdfs[1].region), np.float32))
    ears = replace(ears, strength=1.0, paint=painted, gains=Gains(geometry=0.5), group="warm")
    grouped = replace(
        view, layers=(replace(scarf, enabled=False), ears), groups=(LayerGroup("warm", strength=0.5),)
    )
    return view, snapshots.with_original(snapshots.take(kept, grouped), view)


def members(gdf: int) -> int:
    return len(bear().gdfs[gdf].region)


def test_a_blend_is_each_snapshot_at_its_end_and_straight_between_them() -> None:
    view, kept = two_snapshots()

    def at(share: float) -> ViewState:
        return snapshots.blend(view, kept, share, members)

    assert replace(at(0.0), pair=view.pair) == snapshots.restore(view, kept[1])
    assert replace(at(1.0), pair=view.pair) == snapshots.restore(view, kept[2])
    seen = {share: {l.name: l for l in visible_layers(at(share))} for share in (0.25, 0.75)}
    assert [seen[share]["scarf"].strength for share in seen] == pytest.approx([0.6, 0.2]), "fades"
    assert [seen[share]["ears"].strength for share in seen] == pytest.approx([0.275, 0.425])
    assert [seen[share]["ears"].gains.geometry for share in seen] == pytest.approx([0.875, 0.625])
    weights = [paint.decode(seen[share]["ears"].paint, members(1)) for share in seen]
    assert [float(w.mean()) for w in weights if w is not None] == pytest.approx([0.75, 0.25], abs=0.003)
    assert [at(share).blend for share in seen] == ["sum", "adjust"], "a rule changes half way"
    assert at(0.25).pair == SnapshotPair("1", "2", 0.25)
    assert snapshots.is_blend(at(0.25), kept, members)
    assert not snapshots.is_blend(replace(at(0.25), layers=view.layers), kept, members)


def test_a_blend_with_the_original_does_not_depend_on_how_one_came_there() -> None:
    view, kept = two_snapshots()
    view = snapshots.choose(view, "a", "original")
    straight = snapshots.blend(view, kept, 0.25, members)
    far = snapshots.blend(view, kept, 0.75, members)
    kept = snapshots.with_original(kept[1:], far)
    assert snapshots.blend(far, kept, 0.25, members) == straight
    assert [l.strength for l in visible_layers(straight)] == pytest.approx([0.125])
    assert [l.strength for l in snapshots.blend(far, kept, 0.0, members).layers] == [0.0, 0.0]


def test_snapshots_change_places_and_names_and_the_pair_goes_with_them() -> None:
    work = workspace.new_workspace(first_view(bear(), 0.5, 0.5))
    facts = application.Document("bear.ply", bear().scene, bear().gdfs).facts()
    for action in ("snapshot", "nudge:0.1", "snapshot", "nudge:0.1", "snapshot", "choose_snapshot:a:1"):
        work = workspace.record_undo(perform(work, action, facts))
    moved = workspace.record_undo(perform(work, "move_snapshot:3:1", facts))
    assert [kept.name for kept in moved.snapshots] == ["3", "1", "2"]
    assert [kept.name for kept in perform(moved, "undo", facts).snapshots] == ["1", "2", "3"]
    assert [kept.name for kept in perform(moved, "move_snapshot:1:0", facts).snapshots] == ["3", "1", "2"]
    named = perform(moved, "name_snapshot:2:dusk", facts)
    assert named.view.pair.a == "dusk"
    assert perform(named, "name_snapshot:3:original", facts).snapshots[2].name == "original-2"
    gone = perform(named, "forget:2", facts)
    assert snapshots.pair_of(snapshots.with_original(gone.snapshots, gone.view), gone.view.pair) == (1, 2)


@pytest.mark.gl
def test_a_click_on_a_small_picture_goes_back_to_its_snapshot_and_its_menu_deletes_it() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (1024, 640)) as hand:
        first = hand.picture()
        for chord in ("F5", "Shift+Left", "Shift+Left", "F5"):
            hand.key(chord)
        hand.rest()
        assert hand.main_view.next_frame_delay() is None, "the small pictures are there"
        entries, drawn = len(hand.main_view.work.past.past), hand.image()[317:367, 745:1005]
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
def test_two_snapshots_are_compared_until_something_is_edited_and_blended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with rig(first_view(bear(), 1.0, 0.0), (1024, 640)) as hand:
        hand.key("Shift+F5")
        assert (
            "there is no snapshot" in hand.main_view.canvas.comparer.labels(hand.main_view.work.view).notice
        )
        hand.key("Shift+F5")
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
        seen, middle = hand.picture(), round(0.5 * 724)
        assert np.array_equal(*(beside_line(p, middle)[0] for p in (seen, warm)))
        assert np.array_equal(*(beside_line(p, middle)[1] for p in (seen, gold)))
        said = hand.main_view.canvas.comparer.labels(hand.main_view.work.view)
        assert said.left == "1"
        assert said.right.startswith("2 · PSNR")
        hand.key("Shift+Left")
        assert hand.main_view.work.view.compare.mode == "off", "one sees what one does"
        hand.rest()
        entries, drawn = len(hand.main_view.work.past.past), hand.main_view.canvas.pictures_drawn
        composed = Count(monkeypatch, Composer, "update")
        hand.move(743.0, SLIDER)
        hand.press()
        for x in (802.0, 860.0, 918.0, 976.0):
            hand.move(x, SLIDER)
        assert composed.calls == 4, "once per change"
        assert hand.main_view.canvas.pictures_drawn == drawn + 4
        assert hand.strengths == pytest.approx([0.0, 1.0])
        assert np.array_equal(hand.picture(), gold), "the end is the snapshot"
        hand.move(860.0, SLIDER)
        hand.release()
        assert hand.strengths == pytest.approx([0.5, 0.5], abs=0.01)
        assert len(hand.main_view.work.past.past) == entries + 1
        hand.key("Ctrl+Z")
        assert hand.strengths == [0.0, 0.8]
        assert hand.main_view.work.view.pair.share == 0.0
        hand.drag((968.0, CARD), (880.0, CARD + 5.0))
        assert [kept.name for kept in hand.main_view.work.snapshots] == ["2", "1"], "dragged before the other"
        assert hand.strengths == [0.0, 0.8], "and not gone back to"
