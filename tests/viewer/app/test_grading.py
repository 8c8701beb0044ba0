"""Live grade of the form in the window: its histogram, and looks saved from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.null_app import null_app
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.files import user_files
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.forms import SELECTION, with_settings

pytestmark = pytest.mark.gl


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    """Return a window with the form of a grade of the scarf."""
    with null_app(opened_document(folder), first_view(bear()), folder) as app:
        mask = np.zeros(app.main_view.facts.count, bool)
        mask[bear().demo.members("scarf")] = True
        work = app.main_view.work
        view = replace(work.view, selection=selection.select(work.view.selection, mask))
        form = with_settings(work.form, "grade:temperature=0.4,contrast=0.2")
        assert form is not None
        form = replace(form, region=SELECTION)
        app.store.replace(replace(work, view=view, form=form, form_open=True))
        yield app


def note(app: App) -> str:
    app.parts.preview._grading.update()
    return app.main_view.work.transient.scope.note


def test_emptied_selection_ends_the_measuring_of_colors(app: App) -> None:
    assert note(app) == "", "the colors are measured"
    view = app.main_view.work.view
    app.store.change(replace(view, selection=selection.select_none(view.selection)))
    assert note(app) == "The region is empty: select something"
    app.store.change(view)
    assert note(app) == ""


def test_look_without_a_name_is_named_after_its_effects(
    app: App, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(user_files, "looks_folder", lambda: tmp_path / "looks")
    app.handle(Plain("save_look"))
    assert [path.name for path in (tmp_path / "looks").iterdir()] == ["Warm, high contrast.cube"]
    message = app.main_view.work.message
    assert message is not None
    assert message.text.startswith("Saved the look “Warm, high contrast” as ")
    form = replace(app.main_view.work.form, name="evening")
    app.store.replace(replace(app.main_view.work, form=form))
    app.handle(Plain("save_look"))
    assert (tmp_path / "looks" / "evening.cube").is_file()


def test_paste_from_an_empty_clipboard_says_so(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(imgui, "get_clipboard_text", lambda: "")
    app.handle(Plain("paste_edit"))
    message = app.main_view.work.message
    assert message is not None
    assert message.text == "the clipboard is empty; copy some settings first"
