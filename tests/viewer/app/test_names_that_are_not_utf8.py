"""File names that are not UTF-8 are shown with escapes and cause no crash."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from progdf.formats.ply import save_ply
from tests.helpers.null_app import null_app, press
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.files import document as documents
from viewer.files import user_files

pytestmark = pytest.mark.gl


@pytest.fixture
def opened(tmp_path: Path) -> Iterator[application.App]:
    path = tmp_path / os.fsdecode(b"b\xe4r.ply")
    try:
        save_ply(path, bear().scene)
    except OSError:
        pytest.skip("this file system wants names in UTF-8")
    with null_app(documents.load(path), first_view(bear()), tmp_path) as app:
        yield app


def test_title_and_recent_files_show_such_a_name(opened: application.App, tmp_path: Path) -> None:
    assert opened.documents.get().title == "b\\udce4r.ply"
    press(opened, "Ctrl+O")
    assert (
        opened.main_view.work.transient.recent == (opened.documents.get().path,) == user_files.read_recent()
    )


def test_saving_a_session_explains_that_it_cannot_name_the_file(opened: application.App) -> None:
    press(opened, "Ctrl+S")
    dialog = opened.main_view.work.dialog
    assert dialog is not None
    assert dialog.text.endswith("b\udce4r.session.json"), "the path stays the file's own"
    press(opened, "Enter")
    dialog = opened.main_view.work.dialog
    assert dialog is not None
    assert "it is not UTF-8; rename it" in dialog.error


def test_message_with_such_a_name_is_shown(opened: application.App, tmp_path: Path) -> None:
    opened.parts.file_actions.open(tmp_path / os.fsdecode(b"no\xff.gdf"))
    opened.draw()
    message = opened.main_view.work.message
    assert message is not None
    assert "no\\udcff.gdf" in message.text
