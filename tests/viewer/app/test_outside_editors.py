"""Programs and servers in the window: a confirmation, a test on this view, and the order of the training."""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.helpers.comfy_server import comfy_server
from tests.helpers.image_server import image_server
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from tests.viewer.app.test_studio import Trainer, request, turn
from viewer.app import app as application
from viewer.files import user_files
from viewer.jobs import job_queue
from viewer.state.commands import Plain
from viewer.state.forms import EDITORS, NewEdit, OutsideSettings

pytestmark = pytest.mark.gl

WORKFLOW = Path(__file__).parents[3] / "docs" / "workflows" / "flux2-klein-edit.json"
PATIENCE_S = 120.0


@pytest.fixture
def window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[application.App]:
    folder = bear_files(tmp_path)
    monkeypatch.setattr(job_queue, "Child", Trainer)
    Trainer.ended = None
    Trainer.line = ""
    document = replace(opened_document(folder), edits=(), gdf_paths=())
    with null_app(document, first_view(bear()), folder) as app:
        yield app


def fill(app: application.App, kind: str, **changes: object) -> None:
    press(app, "Ctrl+N")
    work = app.main_view.work
    index = next(i for i, choice in enumerate(EDITORS) if choice.kind == kind)
    app.main_view.store.replace(
        replace(work, form=replace(work.form, editor=index, **changes))  # type: ignore[arg-type]
    )
    turn(app)


def until(app: application.App, happened: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not happened():
        assert time.monotonic() < end, app.main_view.work.transient.preview
        turn(app)
        time.sleep(0.02)


def check_course(app: application.App, sent: Callable[[], int], action: str) -> None:
    """Test the form's editor, deny it, allow it, and train."""
    request(app, Plain("test_editor"))
    dialog = app.main_view.work.dialog
    assert dialog is not None
    assert (dialog.kind, action in dialog.text) == ("allow", True)
    press(app, "Enter")  # Cancel is the key of a hasty hand
    assert app.main_view.work.dialog is None
    for _ in range(5):
        turn(app)
    assert sent() == 0
    request(app, Plain("train"))
    assert app.main_view.work.dialog is not None
    press(app, "Escape")
    assert not app.parts.jobs.queue.jobs
    request(app, Plain("test_editor"))
    press(app, "A")
    until(app, lambda: app.main_view.work.transient.cover)
    assert sent() >= 1
    before = sent()
    request(app, Plain("train"))
    assert app.main_view.work.dialog is None, "it is allowed by now"
    (job,) = app.parts.jobs.queue.jobs
    assert job.status == "running"
    assert sent() == before


def test_server_edits_this_view_after_a_confirmation(window: application.App) -> None:
    pytest.importorskip("openai")
    with image_server() as server:
        outside = OutsideSettings(server.url, "marble-1", price="0.04")
        fill(window, "api", sentence="turn it into marble", outside=outside)
        assert "127.0.0.1" in window.main_view.work.form.outside_note
        check_course(window, lambda: len(server.calls), server.url)
    assert f"--api-url={server.url}" in Trainer.said
    assert "--model=marble-1" in Trainer.said
    assert "--yes" in Trainer.said
    assert any(word.startswith("--anchor=") for word in Trainer.said), "training follows the picture"
    assert user_files.read_outside() == outside


def test_workflow_edits_this_view_after_a_confirmation(window: application.App) -> None:
    with comfy_server() as server:
        outside = OutsideSettings(comfy=server.url, workflow=str(WORKFLOW))
        fill(window, "comfy", sentence="turn it into gold", outside=outside)
        check_course(window, lambda: len(server.jobs), server.url)
        assert server.jobs[0].values["prompt"] == "turn it into gold"
    assert "--prompt=turn it into gold" in Trainer.said


def test_program_runs_only_after_a_confirmation(window: application.App, tmp_path: Path) -> None:
    code = tmp_path / "edit.py"
    code.write_text(
        "import sys\nfrom PIL import Image\nopen(__file__ + '.calls', 'a').write('x')\n"
        "Image.open(sys.argv[1]).convert('L').convert('RGB').save(sys.argv[2])\n",
        encoding="utf-8",
    )
    program = f"{shlex.quote(sys.executable)} {shlex.quote(str(code))} {{input}} {{output}}"
    calls = code.with_name("edit.py.calls")
    fill(window, "command", outside=OutsideSettings(program=program))
    check_course(window, lambda: len(calls.read_bytes()) if calls.exists() else 0, program)
    assert f"--editor=command:{program}" in Trainer.said


def test_unfinished_preview_of_another_editor_leaves_the_test_button_enabled(window: application.App) -> None:
    fill(window, "recolor")
    until(window, lambda: window.main_view.work.transient.preview.busy)
    fill(window, "command", outside=OutsideSettings(program="convert {input} {output}"))
    assert not window.main_view.work.transient.preview.busy


def test_settings_of_servers_stay_when_another_scene_opens(window: application.App) -> None:
    outside = OutsideSettings(comfy="http://127.0.0.1:8188", workflow=str(WORKFLOW))
    fill(window, "comfy", outside=outside)
    window.main_view.restart(first_view(bear()))
    assert window.main_view.work.form == NewEdit(outside=outside)


def test_dead_server_is_reported_in_the_form(window: application.App) -> None:
    pytest.importorskip("openai")
    with comfy_server() as server:
        url = server.url
    fill(window, "comfy", outside=OutsideSettings(comfy=url, workflow=str(WORKFLOW)))
    request(window, Plain("test_editor"))
    press(window, "A")
    until(window, lambda: window.main_view.work.transient.preview.failed)
    assert "cannot be reached" in window.main_view.work.transient.preview.text
