"""Undo and redo of view settings, and the names of history entries."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from progdf.compose.layers import Gains
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from tests.viewer.app.test_keys_of_lists_and_form import strike
from viewer.camera.view_camera import eye, with_up
from viewer.state import history, layers, selection, snapshots, workspace
from viewer.state.view_state import Keyframe, LayerState, Timeline, ViewState
from viewer.state.workspace import Workspace, new_workspace

TILTED = (0.6, 0.64, 0.48)
LAYERS = (LayerState(0, "scarf", 0.5), LayerState(1, "ears", 0.5))
PLAIN = ViewState(layers=LAYERS)


def with_look(view: ViewState) -> ViewState:
    camera = replace(with_up(view.camera, TILTED), fov_y=70.0)
    return replace(view, camera=camera, background=(0.0, 0.5, 1.0))


def undone(work: Workspace) -> Workspace:
    past = history.undo(work.past)
    return replace(work, past=past, view=history.apply_present(work.view, past))


def recorded(work: Workspace, view: ViewState) -> Workspace:
    return workspace.record_undo(replace(work, view=view))


def test_view_settings_are_undone_without_moving_the_camera() -> None:
    work = recorded(new_workspace(PLAIN), with_look(PLAIN))
    work = workspace.with_camera(work, replace(work.view.camera, azimuth=100.0, distance=9.0))
    back = undone(work)
    assert history.look_of(back.view) == history.look_of(PLAIN)
    assert eye(back.view.camera) == pytest.approx(eye(work.view.camera))
    assert workspace.record_undo(back) is back, "an undo is no entry"
    again = history.redo(back.past)
    assert history.look_of(history.apply_present(back.view, again)) == history.look_of(work.view)
    assert again.present.look == history.look_of(work.view)


def test_camera_move_is_no_undo_entry_and_survives_other_undos() -> None:
    work = recorded(new_workspace(PLAIN), layers.change_layer(PLAIN, 0, lambda l: replace(l, strength=1.0)))
    work = workspace.with_camera(work, replace(with_up(work.view.camera, TILTED), fov_y=20.0))
    assert workspace.record_undo(work) is work
    back = undone(work)
    assert back.view.layers == LAYERS
    assert (back.view.camera.up, back.view.camera.fov_y) == (TILTED, 20.0)
    film = Timeline(
        (Keyframe(0, camera=work.view.camera), Keyframe(9, camera=replace(work.view.camera, fov_y=90.0)))
    )
    playing = recorded(work, replace(work.view, timeline=film))
    playing = replace(playing, player=replace(playing.player, playing=True))
    after = workspace.advance(playing, 0.2)
    assert after.view.camera.fov_y != playing.view.camera.fov_y
    assert len(workspace.record_undo(after).past.past) == len(playing.past.past)


def test_setting_changed_while_the_camera_moves_is_an_entry() -> None:
    work = new_workspace(PLAIN)
    sliding = replace(work, view=replace(work.view, camera=replace(work.view.camera, fov_y=70.0)))
    flown = workspace.with_camera(sliding, replace(sliding.view.camera, distance=3.0))
    back = undone(workspace.record_undo(flown))
    assert (back.view.camera.fov_y, back.view.camera.distance) == (PLAIN.camera.fov_y, 3.0)
    assert history.look_of(workspace.cancel_drag(flown).view) == history.look_of(PLAIN)


def layer(**changes: object) -> Callable[[ViewState], ViewState]:
    return lambda view: layers.change_layer(view, 1, lambda old: replace(old, **changes))  # type: ignore[arg-type]


def selected(view: ViewState) -> ViewState:
    return replace(view, selection=selection.select(view.selection, np.arange(9) < 4))


CHANGES: dict[str, Callable[[ViewState], ViewState]] = {
    "up axis": lambda view: replace(view, camera=with_up(view.camera, TILTED)),
    "field of view": lambda view: replace(view, camera=replace(view.camera, fov_y=70.0)),
    "background": lambda view: replace(view, background=(0.0, 0.0, 0.0)),
    "comparison": lambda view: replace(view, compare=replace(view.compare, mode="split")),
    "ground grid": lambda view: replace(view, grid=True),
    "axes": lambda view: replace(view, axes=False),
    "safe frame": lambda view: replace(view, safe_frame="16:9"),
    "dynamic resolution": lambda view: replace(view, dynamic_resolution="off"),
    "strength of ears": layer(strength=0.7),
    "strength of 2 layers": lambda v: replace(
        v, layers=tuple(replace(one, strength=0.1) for one in v.layers)
    ),
    "gains of ears": layer(gains=Gains(0.5, 1.0, 1.0)),
    "blend rule of ears": layer(blend="over"),
    "visibility of ears": layer(enabled=False),
    "lock of ears": layer(locked=True),
    "name of gold": layer(name="gold"),
    "delete scarf": lambda view: replace(view, layers=view.layers[1:]),
    "add hand": lambda view: replace(view, layers=(*view.layers, LayerState(2, "hand"))),
    "replace hand": lambda view: replace(view, layers=(view.layers[0], LayerState(2, "hand"))),
    "layer order": lambda view: replace(view, layers=view.layers[::-1]),
    "selection": selected,
    "hidden splats": lambda view: replace(
        view, selection=selection.hide(selected(view).selection, np.arange(9) < 3)
    ),
    "blend rule": lambda view: replace(view, blend="over"),
    "timeline": lambda view: replace(view, timeline=Timeline((Keyframe(0),))),
}


@pytest.mark.parametrize("words", CHANGES)
def test_undo_and_redo_name_their_entry(words: str) -> None:
    work = recorded(new_workspace(PLAIN), CHANGES[words](PLAIN))
    assert (history.next_undo(work.past), history.next_redo(work.past)) == (words, "")
    back = undone(work)
    assert (history.edit_of(back.view), history.look_of(back.view)) == (
        history.edit_of(PLAIN),
        history.look_of(PLAIN),
    )
    assert (history.next_undo(back.past), history.next_redo(back.past)) == ("", words)


def test_any_history_entry_can_be_restored_until_the_next_edit() -> None:
    work = new_workspace(PLAIN)
    changes = ("ground grid", "strength of ears", "safe frame", "blend rule")
    for words in changes:
        work = recorded(work, CHANGES[words](work.view))
    last = work.view
    listed = [history.describe_entry(work.past, i) for i in range(len(history.entries(work.past)))]
    assert listed == ["as opened", *changes]
    for index in (1, 4, 0, 3, 3, 4):
        past = history.go_to(work.past, index)
        work = replace(work, past=past, view=history.apply_present(work.view, past))
        assert work.view.grid == (index > 0)
        assert work.view.layers[1].strength == (0.7 if index > 1 else 0.5)
        assert len(history.entries(past)) == 5
        assert workspace.record_undo(work) == work, "to go there is no change"
    assert work.view == last
    for index in (-1, 5):
        assert history.go_to(work.past, index) is work.past


def test_repeated_view_changes_merge_into_at_most_one_entry() -> None:
    work = recorded(new_workspace(PLAIN), CHANGES["ground grid"](PLAIN))
    for mode in ("split", "beside", "difference"):
        work = recorded(work, replace(work.view, compare=replace(work.view.compare, mode=mode)))
    assert len(work.past.past) == 2
    assert undone(work).view == replace(PLAIN, grid=True)
    work = recorded(work, replace(PLAIN, grid=True))
    assert history.next_undo(work.past) == "ground grid"


@pytest.mark.gl
def test_undo_that_ends_a_snapshot_comparison_keeps_the_redo_entries() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (900, 640)) as hand:
        for chord in ("F5", "Shift+Left", "F5", "Shift+F5", "Ctrl+Z", "Ctrl+Z"):
            hand.key(chord)
        hand.key("Ctrl+Shift+Z")
        hand.key("Shift+F5")
        assert hand.main_view.work.view.compare.against == "snapshots"
        hand.key("Shift+Left")
        assert hand.main_view.work.view.compare.mode == "off"
        hand.key("Ctrl+Z")
        hand.frame(3)
        assert history.next_redo(hand.main_view.work.past) == "strength of ears"


@pytest.mark.gl
def test_history_entry_is_opened_by_mouse_and_keys() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (900, 640)) as hand:
        for chord in ("Shift+Left", "H", "Shift+G"):
            strike(hand, chord)
        strike(hand, "Ctrl+Alt+Z")
        for chord in ("Up", "Up", "Enter"):
            strike(hand, chord)
        layers = hand.main_view.work.view.layers
        assert (layers[1].strength, layers[1].enabled, hand.main_view.work.view.grid) == (0.4, True, False)
        assert hand.main_view.work.message is not None
        assert hand.main_view.work.message.text == "Back to: strength of ears"
        assert hand.main_view.work.history is False, "it stays, to go on from"
        strike(hand, "Escape")
        assert hand.main_view.work.history is None
        hand.click(686.0, 618.0)
        assert hand.main_view.work.history is False
        hand.click(680.0, 566.0)
        assert hand.main_view.work.view.grid
        assert not hand.main_view.work.view.layers[1].enabled


def test_snapshot_entry_has_a_name() -> None:
    work = new_workspace(PLAIN)
    work = workspace.record_undo(replace(work, snapshots=snapshots.take((), PLAIN)))
    assert history.next_undo(work.past) == "snapshots"


@pytest.mark.gl
def test_undo_of_the_up_axis_keeps_layers_and_shows_a_message() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (900, 640)) as hand:
        hand.key("Shift+Left")
        before = hand.main_view.work.view
        hand.main_view.store.replace(
            replace(hand.main_view.work, view=replace(before, camera=with_up(before.camera, TILTED)))
        )
        hand.frame()
        hand.key("Ctrl+Z")
        after = hand.main_view.work
        assert (after.view.camera.up, after.view.layers) == (before.camera.up, before.layers)
        assert said(hand) == "Undid: up axis"
        hand.rest(1.5)
        assert said(hand) == "Undid: up axis"
        hand.rest(1.0)
        assert said(hand) == ""
        hand.key("Ctrl+Shift+Z")
        assert said(hand) == "Redid: up axis"


def said(hand: Rig) -> str:
    message = hand.main_view.work.message
    return message.text if message else ""
