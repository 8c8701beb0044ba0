"""Native file dialogs of the desktop, replaced by a scripted program."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from progdf.formats.scene_file import FORMATS
from tests.helpers.null_app import null_app, press
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.app.app import App
from viewer.files import document, session
from viewer.panel import dialogs
from viewer.state.commands import Plain
from viewer.state.workspace import Dialog

pytestmark = [
    pytest.mark.gl,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="others have dialogs of their own"),
]


@dataclass(frozen=True)
class Desktop:
    """Application with a stub of the desktop's dialog program."""

    app: App
    folder: Path

    def answers(self, script: str) -> None:
        """Set the shell script that `zenity` runs from now on; "$@" are its arguments."""
        program = self.folder / "bin" / "zenity"
        program.write_text(f'#!/bin/sh\necho "$@" > "{self.folder}/asked"\n{script}\n')
        program.chmod(0o755)

    @property
    def asked(self) -> str:
        return (self.folder / "asked").read_text()

    def until_answered(self) -> None:
        """Run the window's loop while the dialog is open; no wait exceeds the polling interval."""
        end = time.monotonic() + 60.0
        while self.app.parts.file_actions.poll_dialog() is not None:
            assert time.monotonic() < end
            time.sleep(0.01)
            self.app.draw()
        for _ in range(4):
            self.app.draw()


def test_every_scene_format_can_be_chosen() -> None:
    patterns = dialogs._OPEN[1].split()
    for ending in FORMATS:
        assert f"*.{ending}" in patterns


@pytest.fixture
def desktop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desktop]:
    (tmp_path / "bin").mkdir()
    (tmp_path / "work").mkdir()
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setenv("XDG_CURRENT_DESKTOP", "GNOME")
    scene, *gdfs = bear().save(tmp_path / "work")
    with null_app(document.load(scene, gdfs[:1]), first_view(bear(), 0.5), tmp_path / "work") as app:
        opened = Desktop(app, tmp_path)
        opened.answers("exit 1")
        yield opened


def question(desktop: Desktop) -> Dialog:
    dialog = desktop.app.main_view.work.dialog
    assert dialog is not None
    return dialog


def test_file_chosen_in_the_native_dialog_is_opened(desktop: Desktop) -> None:
    ears = desktop.folder / "work" / "ears.gdf"
    desktop.answers(f'echo "{ears}"')
    press(desktop.app, "Ctrl+O", "Ctrl+B")
    desktop.until_answered()
    assert desktop.app.main_view.work.dialog is None
    assert [gdf.name for gdf in desktop.app.documents.get().gdfs] == ["scarf", "ears"]
    assert "--file-selection" in desktop.asked
    assert str(desktop.folder / "work") in desktop.asked, "it begins beside the scene"


def test_path_chosen_in_the_native_dialog_is_saved_to(desktop: Desktop) -> None:
    there = desktop.folder / "work" / "chosen.session.json"
    desktop.answers(f'echo "{there}"')
    press(desktop.app, "Shift+Left", "Ctrl+S", "Ctrl+B")
    desktop.until_answered()
    assert "--save" in desktop.asked
    assert session.open_session(there).view.layers == desktop.app.main_view.work.view.layers
    assert not desktop.app.parts.file_actions.has_unsaved


def test_canceled_native_dialog_keeps_the_typed_path(desktop: Desktop) -> None:
    press(desktop.app, "Ctrl+S")
    typed = question(desktop).text
    press(desktop.app, "Ctrl+B")
    desktop.until_answered()
    assert question(desktop) == Dialog("save", typed)
    press(desktop.app, "Enter")
    assert Path(typed).is_file(), "the path field still does its work"


def test_window_stays_responsive_and_escape_closes_the_dialog(
    desktop: Desktop,
) -> None:
    desktop.answers(f'echo $$ > "{desktop.folder}/pid"\nexec sleep 600')
    press(desktop.app, "Ctrl+O", "Ctrl+B")
    frames = desktop.app.main_view.frames
    pid = desktop.folder / "pid"
    while not (pid.is_file() and pid.read_text().strip()):
        assert desktop.app.parts.file_actions.poll_dialog() == dialogs.POLL_S
        time.sleep(0.01)
    assert question(desktop).choosing
    press(desktop.app, "Ctrl+B")
    assert desktop.app.main_view.frames > frames, "nothing waits for the person"
    press(desktop.app, "Escape")
    assert desktop.app.main_view.work.dialog is None
    assert desktop.app.parts.file_actions.poll_dialog() is None
    assert not alive(int(pid.read_text()))


def test_closing_the_window_closes_the_native_dialog(desktop: Desktop) -> None:
    desktop.answers(f'echo $$ > "{desktop.folder}/pid"\nexec sleep 600')
    press(desktop.app, "Ctrl+O", "Ctrl+B")
    pid = desktop.folder / "pid"
    while not (pid.is_file() and pid.read_text().strip()):
        time.sleep(0.01)
    desktop.app.parts.file_actions.release()
    assert not alive(int(pid.read_text()))


def alive(pid: int) -> bool:
    """Return True while a process runs; zombies count as ended."""
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return False
        if state == "Z":
            return False
        time.sleep(0.01)
    return True


def test_missing_dialog_program_is_explained_beside_the_path_field(
    desktop: Desktop, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(desktop.folder / "nothing"))
    press(desktop.app, "Ctrl+S", "Ctrl+B")
    assert question(desktop).notice == dialogs.obstacle()
    assert "; type the path" in dialogs.obstacle()
    assert "\n" not in dialogs.obstacle()
    assert not question(desktop).choosing
    assert desktop.app.parts.file_actions.poll_dialog() is None
    path = Path(question(desktop).text)
    press(desktop.app, "Enter")
    assert path.is_file()


@pytest.mark.parametrize("kind", ["open", "save"])
def test_browse_button_requests_the_native_dialog(kind: str) -> None:
    with rig(points=(900, 640)) as hand:
        hand.main_view.messages.ask(Dialog(kind, "/tmp/x"))
        hand.settle()
        x = (900 - 300) / 2 + 260 - 16 - 18
        for y in range(60, 320, 8):
            hand.click(x, float(y))
            if Plain("browse") in hand.main_view.work.requests:
                break
        assert Plain("browse") in hand.main_view.work.requests
        assert hand.main_view.work.dialog is not None, "the question stays"
