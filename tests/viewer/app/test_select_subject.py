"""Select subject, the hint and the dots of scribbles, and the question of Refine, in the window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.app.select_tool import guessed_rows, next_step
from viewer.camera.views import look_at_view
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.workspace import with_camera

pytestmark = pytest.mark.gl
ON_HEAD = ((200.0, 180.0), (220.0, 185.0))
ON_LAWN = ((60.0, 520.0), (120.0, 530.0))


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(first_view(bear(), 0.0, 0.0), (700, 640)) as opened:
        yield opened


def selected(hand: Rig) -> np.ndarray:
    return selection.unpack(hand.main_view.work.view.selection.members, len(bear().scene))


def test_key_selects_the_object_in_the_middle_as_one_undo_step(hand: Rig) -> None:
    hand.key("Shift+J")
    height = bear().scene.means[:, 1].numpy()
    assert selected(hand)[height > 1.0].mean() > 0.95
    assert selected(hand)[height < -0.1].mean() < 0.05
    assert len(hand.main_view.work.past.past) == 1
    hand.key("Ctrl+Z")
    assert not selected(hand).any()


def test_view_without_an_object_gives_a_message(hand: Rig) -> None:
    work = hand.main_view.work
    x, y, z = work.view.camera.pivot
    hand.main_view.store.replace(with_camera(work, replace(work.view.camera, pivot=(x + 90.0, y, z))))
    hand.key("Shift+J")
    message = hand.main_view.work.message
    assert message is not None
    assert "no subject" in message.text
    assert not selected(hand).any()


def test_scribble_names_the_next_stroke_and_hides_dots_from_behind(hand: Rig) -> None:
    hand.key("Shift+U")
    assert next_step(hand.main_view.work) == ""
    hand.drag(*ON_HEAD)
    assert "background" in next_step(hand.main_view.work)
    hand.modifier(imgui.Key.mod_ctrl)
    hand.drag(*ON_LAWN)
    hand.modifier(imgui.Key.mod_ctrl, False)
    assert "a guess" in next_step(hand.main_view.work)
    pointer = hand.main_view._pointer()
    strokes = hand.main_view.work.transient.tool.strokes[-1]
    in_front = len(pointer.visible_dots((strokes.on, strokes.beside))[0])
    work = hand.main_view.work
    hand.main_view.store.replace(with_camera(work, look_at_view(work.view.camera, "back")))
    hand.frame(2)
    pointer = hand.main_view._pointer()
    assert len(pointer.visible_dots((strokes.on, strokes.beside))[0]) < in_front


def test_scribble_marks_the_unseen_back_as_a_guess(hand: Rig) -> None:
    hand.key("Shift+U")
    hand.drag(*ON_HEAD)
    hand.modifier(imgui.Key.mod_ctrl)
    hand.drag(*ON_LAWN)
    hand.modifier(imgui.Key.mod_ctrl, False)
    work = hand.main_view.work
    front = selection.unpack(guessed_rows(work), len(bear().scene))
    assert 0.1 < front.sum() / selected(hand).sum() < 0.9
    assert not (front & ~selected(hand)).any()
    # a stroke from behind confirms the back
    hand.main_view.store.replace(with_camera(work, look_at_view(work.view.camera, "back")))
    hand.frame(2)
    hand.drag(*ON_HEAD)
    both = selection.unpack(guessed_rows(hand.main_view.work), len(bear().scene))
    assert both.sum() < 0.3 * front.sum()


def test_refine_asks_before_it_doubles_a_selection(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    hand.key("Shift+J")
    few = selected(hand).copy()
    everything = np.ones_like(few)
    monkeypatch.setitem(selection.CHANGES_BY_NEIGHBORS, "select_refine", lambda near, mask: everything)
    monkeypatch.setitem(selection.CHANGES_BY_NEIGHBORS, "refine_anyway", lambda near, mask: everything)
    few[np.flatnonzero(few)[10:]] = False
    work = hand.main_view.work
    smaller = selection.select(work.view.selection, few)
    hand.main_view.store.replace(replace(work, view=replace(work.view, selection=smaller)))
    hand.main_view._perform(Plain("select_refine"))
    question = hand.main_view.work.question
    assert (selected(hand) == few).all()
    assert question is not None
    assert question.buttons == (("Enlarge", Plain("refine_anyway")),)
    hand.main_view._perform(question.buttons[0][1])
    assert selected(hand).all()
