"""Select subject, the hint and the dots of scribbles, and the question of Refine, in the window."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import wait as wait_for
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import MAKING_S, opened_document
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.app.app import App
from viewer.app.parts import scene_checks
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


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    view = first_view(bear(), 0.0, 0.0)
    with null_app(opened_document(folder), view, folder) as opened:
        opened.parts.searches.patience_s = MAKING_S
        yield opened


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Return an event that lets the search for the subject go on."""
    opened = threading.Event()
    find = scene_checks.find_subject

    def wait(*arguments: Any) -> Any:
        opened.wait()
        return find(*arguments)

    monkeypatch.setattr(scene_checks, "find_subject", wait)
    yield opened
    opened.set()


def begin_slowly(app: App) -> None:
    app.parts.searches.patience_s = 0.0
    press(app, "Shift+J")


def in_window(app: App) -> np.ndarray:
    return selection.unpack(app.main_view.work.view.selection.members, len(bear().scene))


def test_key_selects_the_object_in_the_middle_as_one_undo_step(app: App) -> None:
    press(app, "Shift+J")
    height = bear().scene.means[:, 1].numpy()
    assert in_window(app)[height > 1.0].mean() > 0.95
    assert in_window(app)[height < -0.1].mean() < 0.05
    assert len(app.main_view.work.past.past) == 1
    assert app.main_view.work.message is None
    press(app, "Ctrl+Z")
    assert not in_window(app).any()


def test_view_without_an_object_gives_a_message(app: App) -> None:
    work = app.main_view.work
    x, y, z = work.view.camera.pivot
    app.store.replace(with_camera(work, replace(work.view.camera, pivot=(x + 90.0, y, z))))
    press(app, "Shift+J")
    message = app.main_view.work.message
    assert message is not None
    assert "no subject" in message.text
    assert not in_window(app).any()


def test_search_for_the_subject_shows_a_sign_of_work(app: App, gate: threading.Event) -> None:
    begin_slowly(app)
    message = app.main_view.work.message
    assert message is not None
    assert message.text == "Selecting the subject …"
    assert message.button == ("Cancel", Plain("stop_search"))
    assert not in_window(app).any()
    gate.set()
    finish(app)
    assert in_window(app).any()
    assert app.main_view.work.message is None


def finish(app: App) -> None:
    search = app.parts.searches._search
    assert search is not None
    wait_for([search.found])
    app.parts.searches.poll()
    app.draw()


def test_escape_cancels_the_search_for_the_subject(app: App, gate: threading.Event) -> None:
    press(app, "L")
    begin_slowly(app)
    press(app, "Escape")
    assert app.main_view.work.message is None
    assert app.main_view.work.view.select.tool == "lasso", "Escape ends one thing at a time"
    gate.set()
    assert app.parts.searches.poll() is None
    assert not in_window(app).any()


def test_later_search_replaces_the_running_one(app: App, gate: threading.Event) -> None:
    begin_slowly(app)
    first = app.parts.searches._search
    assert first is not None
    press(app, "Shift+J")
    assert first.stop.is_set()
    gate.set()
    finish(app)
    assert in_window(app).any()


def test_scribble_names_the_next_stroke_and_hides_dots_from_behind(hand: Rig) -> None:
    hand.key("Shift+U")
    assert next_step(hand.main_view.work) == ""
    hand.drag(*ON_HEAD)
    assert "background" in next_step(hand.main_view.work)
    hand.modifier(imgui.Key.mod_ctrl)
    hand.drag(*ON_LAWN)
    hand.modifier(imgui.Key.mod_ctrl, False)
    assert "a guess" in next_step(hand.main_view.work)
    pointer = hand.main_view.pointer()
    strokes = hand.main_view.work.transient.tool.strokes[-1]
    in_front = len(pointer.visible_dots((strokes.on, strokes.beside))[0])
    work = hand.main_view.work
    hand.main_view.store.replace(with_camera(work, look_at_view(work.view.camera, "back")))
    hand.frame(2)
    pointer = hand.main_view.pointer()
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
    few = bear().scene.means[:, 1].numpy() > 1.0
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
