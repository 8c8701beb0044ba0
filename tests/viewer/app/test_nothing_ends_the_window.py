"""No exception ends the window: it continues, reports the error and keeps unsaved work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from imgui_bundle import imgui

from progdf.errors import ProgdfError
from progdf.io.atomic import state_folder
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.app import interface, messages, mouse
from viewer.app.messages import LOG
from viewer.files import exports, session
from viewer.panel import card, cards, snapshot_cards, timeline_bar, tools
from viewer.state import actions, selection, timeline
from viewer.state.commands import Plain
from viewer.state.workspace import Message
from viewer.ui import key_list, overlay

pytestmark = pytest.mark.gl

ACTIONS = (
    *actions.ACTIONS,
    *timeline.ACTIONS,
    *actions.OF_EDITS,
    *selection.CHANGES,
    "frame",
    "home",
    "paint_fill",
    "next_slider",
)
DRAWN = {
    "a card": (cards, "draw_card"),
    "the head of a card": (card, "_number"),
    "the tools": (tools, "draw_toolbar"),
    "the snapshots": (snapshot_cards, "draw"),
    "the timeline": (timeline_bar, "draw"),
    "the mouse": (mouse, "_drag"),
    "the axes": (overlay, "draw_axes"),
    "the keys": (key_list, "_column"),
}
"""Parts of a frame, each with the function that is replaced by one that raises."""


class BrokenError(Exception):
    """An error in our own code."""


def raises(error: Exception) -> Callable[..., Any]:
    def act(*_: object, **__: object) -> Any:
        raise error.with_traceback(None)

    return act


@pytest.fixture
def window(tmp_path: Path) -> Iterator[application.App]:
    folder = bear_files(tmp_path)
    with null_app(opened_document(folder), first_view(bear(), 0.5, 0.5), folder) as app:
        yield app


def turns(app: application.App, count: int = 3) -> list[float | None]:
    """Run `count` turns of the window's loop, each with new input; return the wait times."""
    waits: list[float | None] = []

    def wait(seconds: float | None) -> None:
        waits.append(seconds)
        app.is_closed = len(waits) >= count
        app.main_view.wake()

    app.window.wait = wait  # type: ignore[method-assign]
    app.is_closed = False
    app.loop()
    app.is_closed = False
    return waits


def message(app: application.App) -> Message:
    assert app.main_view.work.message is not None, "nothing is said"
    return app.main_view.work.message


def log(folder: Path) -> str:
    return (state_folder() / LOG).read_text()


def test_failing_action_does_not_end_the_window(
    window: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ACTIONS:
        before = window.main_view.work.view
        with monkeypatch.context() as broken:
            broken.setattr(interface, "perform", raises(BrokenError(f"in {name}")))
            window.main_view.frames += 2  # separates this failure from the previous one
            window.main_view._perform(Plain(name))
        assert message(window).text.startswith(f"Internal error (BrokenError: in {name});")
        assert window.main_view.work.view == before
    assert log(tmp_path).count("Traceback") == 1, "all at the same place"


def test_failing_request_does_not_end_the_window(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    window.requests = dict.fromkeys(window.requests, raises(BrokenError("in a request")))
    monkeypatch.setattr(window.main_view, "_save", raises(BrokenError("in a request")))
    for request in (*window.requests, *exports.REQUESTS):
        window.main_view.store.replace(replace(window.main_view.work, message=None))
        window.main_view.messages.request(Plain(request))
        turns(window, 2)
        assert "BrokenError: in a request" in message(window).text, request


@pytest.mark.slow
@pytest.mark.parametrize("part", DRAWN)
def test_failing_part_of_a_frame_leaves_the_others_unchanged(
    window: application.App, part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    press(window, "F5", "K", "Shift+Left", "F1")
    monkeypatch.setattr(*DRAWN[part], raises(BrokenError(part)))
    imgui.get_io().add_mouse_pos_event(200.0, 200.0)
    turns(window)
    assert f"BrokenError: {part}" in message(window).text
    assert message(window).details.count(part) >= 1
    assert log(tmp_path).count("Traceback") == 1, "once, however often it fails"
    window.main_view.store.replace(replace(window.main_view.work, message=None))
    turns(window)
    assert window.main_view.work.message is None, "its cross takes the message away"
    monkeypatch.setattr(messages, "REPEAT_MESSAGE_S", 0.0)
    turns(window, 2)
    assert f"BrokenError: {part}" in message(window).text, "and after a while it is said again"
    monkeypatch.setattr(messages, "REPEAT_MESSAGE_S", 10.0)
    drawn = window.main_view.frames
    while (wait := window.main_view.next_frame_delay()) == 0.0:
        window.draw()
        assert window.main_view.frames - drawn < 50, f"a window at rest rests: {wait}"
    strength = window.main_view.work.view.layers[-1].strength
    press(window, "F1", "Left")
    assert window.main_view.work.view.layers[-1].strength < strength, "keys do what they did"
    monkeypatch.undo()
    window.main_view.store.replace(replace(window.main_view.work, message=None))
    turns(window)
    assert window.main_view.work.message is None, "imgui is as it was"


def test_failing_picture_keeps_the_panel_and_undo(
    window: application.App, monkeypatch: pytest.MonkeyPatch
) -> None:
    press(window, "Shift+Left")
    monkeypatch.setattr(snapshot_cards, "draw", raises(BrokenError("no snapshots either")))
    monkeypatch.setattr(window.main_view.canvas, "draw", raises(BrokenError("no picture")))
    monkeypatch.setattr(window.main_view.canvas, "awaits_picture", raises(BrokenError("no picture")))
    turns(window)
    assert "BrokenError: no picture" in message(window).text
    drawn = window.main_view.frames
    while window.main_view.next_frame_delay() == 0.0:
        window.draw()
        assert window.main_view.frames - drawn < 50, "a window at rest rests"
    press(window, "Ctrl+Z")
    assert window.main_view.work.view.layers[-1].strength == 0.5


@pytest.mark.parametrize("part", ["jobs", "preview", "start", "up"])
def test_failing_job_is_polled_again(
    window: application.App, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(getattr(window.parts, part), "poll", raises(BrokenError("a job")))
    waits = turns(window)
    assert "BrokenError: a job" in message(window).text
    assert all(wait is not None and wait <= application.RETRY_S for wait in waits)


def test_user_error_is_one_line_without_a_log(
    window: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, line in (
        (ProgdfError("bear.ply is gone;\nopen it again"), "bear.ply is gone; open it again"),
        (
            OSError(28, "No space left on device", "a.ply"),
            "a.ply cannot be read or written: No space left on device",
        ),
    ):
        monkeypatch.setattr(window.parts.jobs, "poll", raises(error))
        turns(window)
        assert (message(window).text, message(window).details) == (line, "")
    assert not (state_folder() / LOG).exists()


def test_error_saves_unsaved_work_and_details_can_be_copied(
    window: application.App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    press(window, "Shift+Left")
    window.main_view.report(BrokenError("at last"))
    kept = tmp_path / "bear.autosave.session.json"
    assert session.open_session(kept).view.layers == window.main_view.work.view.layers
    assert message(window).text == f"Internal error (BrokenError: at last); unsaved work is kept in {kept}"
    copied: list[str] = []
    monkeypatch.setattr(imgui, "set_clipboard_text", copied.append)
    monkeypatch.setattr(interface.overlay, "message", lambda *_: ("copy", 600.0))
    details = message(window).details
    window.draw()
    assert copied == [details]
    assert "BrokenError: at last" in details
    assert message(window).text.startswith("Copied")


def test_failed_emergency_save_is_reported(window: application.App, monkeypatch: pytest.MonkeyPatch) -> None:
    press(window, "Shift+Left")
    monkeypatch.setattr(session, "save", raises(OSError(28, "No space left on device")))
    window.main_view.report(BrokenError("at last"))
    assert "unsaved work could not be kept" in message(window).text
