"""Files of somebody else never start a program and never send a picture when they are opened."""

from __future__ import annotations

import socket
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from progdf.__main__ import main
from progdf.gdf.file import load_gdf, save_gdf
from progdf.io.bundle import write_bundle
from tests.helpers.sessions import bear_files, saved_session, spoilt
from trainer import cli

HOSTILE = (
    "command:touch {input} {output}",
    'api:"send it"',
    "comfy:workflow.json",
)


@pytest.fixture
def attempts(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return a list that names each program started and each connection opened."""
    made: list[str] = []

    def start(self: object, words: object, *more: object, **options: object) -> None:
        made.append(f"started {words}")
        raise OSError("no program starts here")

    def connect(self: object, address: object) -> None:
        made.append(f"connected to {address}")
        raise OSError("nothing is sent from here")

    monkeypatch.setattr(subprocess.Popen, "__init__", start)
    monkeypatch.setattr(socket.socket, "connect", connect)
    monkeypatch.setenv("OPENAI_API_KEY", "sk-secret")
    return made


def hostile_session(folder: Path, editor: str) -> Path:
    """Save a session whose edits claim to be made by a hostile editor."""
    bear_files(folder)
    for path in (folder / "edits").glob("*.gdf"):
        options = {"editor": {"editor": editor, "api_url": "http://127.0.0.1:9/v1", "yes": True}}
        report = {"plan": options}
        save_gdf(path, replace(load_gdf(path), instruction=editor, options=options, report=report))
    return saved_session(folder)


@pytest.mark.parametrize("editor", HOSTILE)
def test_opened_edits_and_sessions_run_and_send_nothing(
    editor: str, tmp_path: Path, attempts: list[str]
) -> None:
    session = hostile_session(tmp_path, editor)
    picture = ["--draw", "cpu", "--size", "40x30", "-o", str(tmp_path / "a.png")]
    edit = next((tmp_path / "edits").glob("*.gdf"))
    assert main(["render", str(tmp_path / "bear.ply"), str(edit), *picture]) == 0
    assert main(["info", str(edit)]) == 0
    assert main(["render", "--session", str(session), *picture]) == 0
    bundle = tmp_path / "sent.progdf.zip"
    write_bundle(bundle, session)
    assert main(["render", str(bundle), *picture]) == 0
    assert not attempts


def test_session_with_an_editor_of_its_own_is_refused(
    tmp_path: Path, attempts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    session = spoilt(hostile_session(tmp_path, HOSTILE[0]), "editor", value=HOSTILE[0])
    code = main(["render", "--session", str(session), "--draw", "cpu", "-o", str(tmp_path / "a.png")])
    assert code == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not attempts


@pytest.mark.parametrize(
    "options",
    [
        f"editor = {HOSTILE[0]!r}",
        f'editor = {HOSTILE[1]!r}\napi_url = "http://127.0.0.1:9/v1"\nmodel = "m"\nyes = true',
        f'editor = {HOSTILE[2]!r}\napi_url = "http://127.0.0.1:9"\nyes = true',
    ],
)
def test_catalogue_with_a_hostile_editor_is_refused(
    options: str, tmp_path: Path, attempts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    bear_files(tmp_path)
    catalogue = tmp_path / "catalogue.toml"
    catalogue.write_text(
        '[[scenes]]\npath = "bear.ply"\n[[scenes.edits]]\nname = "dark"\nregion = "all"\n' + options,
        encoding="utf-8",
    )
    assert cli.batch([str(catalogue), "--out", str(tmp_path / "runs"), "--workers", "1"]) == 2
    assert "--allow-commands" in capsys.readouterr().err
    assert not attempts
    assert not (tmp_path / "runs").exists()
