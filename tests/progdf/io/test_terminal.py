"""Tests of names with terminal control characters, which are printed as escapes."""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.gdf.file import save_gdf
from progdf.io.cameras import save_cameras
from progdf.terminal import PrintableFormatter, escape_text
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.ply_files import scene_of, table_of, with_extra, write
from tests.helpers.scenes import front_camera, random_gaussians
from trainer.store.progress import RunLog

EVIL = "a\x1b]0;owned\x07\x1b[2J\r\u202e\x9b"


def harmless(text: str) -> bool:
    return all(line.isprintable() for line in text.splitlines()) and "\r" not in text


def test_unprintable_characters_become_escapes() -> None:
    assert escape_text(EVIL) == r"a\x1b]0;owned\x07\x1b[2J\r\u202e\x9b"
    assert escape_text("two\nlines") == r"two\nlines"
    assert escape_text("caf\udce9") == r"caf\udce9", "a file name that is no UTF-8"
    assert escape_text("Größe 12 345 × “…” 界") == "Größe 12 345 × “…” 界"


def test_error_has_one_line_for_any_name() -> None:
    message = str(ProgdfError(f"camera {EVIL}\nis broken; export it again"))
    assert message.endswith("is broken; export it again")
    assert message.isprintable()


def test_info_escapes_names_of_a_ply(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    evil = EVIL.replace("\r", "").encode("ascii", "ignore").decode().replace(" ", "")
    path = write(tmp_path / "scene.ply", with_extra("label", "u1", 5)(table_of(scene_of(0))))
    path.write_bytes(path.read_bytes().replace(b"label", evil.encode()))
    assert main(["info", str(path)]) == 0
    output = capsys.readouterr().out
    assert r"\x1b]0;owned" in output
    assert harmless(output)


def test_info_escapes_names_of_edits_sessions_and_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = {
        "progdf_session": 1,
        "scene": {"file": EVIL, "sha256": ""},
        "view": {"layers": [{"name": EVIL}]},
    }
    (tmp_path / "a.json").write_text(json.dumps(session))
    save_cameras(tmp_path / f"{EVIL}.json", [replace(front_camera(), name=EVIL)])
    scene = random_gaussians(60)
    save_gdf(tmp_path / "a.gdf", edit_of(scene, some_rows(scene, 9), curved_field(9), name=EVIL))
    for path in (tmp_path / "a.json", tmp_path / "a.gdf", tmp_path / f"{EVIL}.json"):
        assert main(["info", str(path)]) == 0
        assert harmless(capsys.readouterr().out)


def test_error_line_and_warning_are_escaped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(tmp_path / f"{EVIL}\nb.ply")]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert harmless(message)
    record = logging.LogRecord("progdf", logging.WARNING, "", 0, "%s is odd", (EVIL,), None)
    assert harmless(PrintableFormatter().format(record))


def test_log_of_a_run_is_escaped(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = RunLog(tmp_path / "log.txt")
    log.say(EVIL)
    log.close()
    assert harmless((tmp_path / "log.txt").read_text())
    assert harmless(capsys.readouterr().err)
