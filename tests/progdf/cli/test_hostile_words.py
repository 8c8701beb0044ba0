"""Tests of command lines that are not UTF-8 or very long, of full outputs and of low memory."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from progdf.__main__ import COMMANDS, main
from progdf.errors import ProgdfError, is_out_of_memory
from progdf.formats.ply import save_ply
from progdf.io.bundle import unpack_bundle
from progdf.terminal import elide, shorten
from tests.helpers.scenes import random_gaussians
from tests.helpers.sessions import bear_files, saved_session

NO_TEXT = "a\udcffb"
LONG = "x" * 3000
PROGRAM = "import sys; from progdf.__main__ import main; sys.exit(main(sys.argv[1:]))"
posix = pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")


def line_of(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """Return the single line of a refused command line."""
    assert main(list(words)) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1, message
    return message


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    save_ply(Path("scene.ply"), random_gaussians(20))
    return "scene.ply"


def entries() -> list[str]:
    return sorted(os.listdir("."))


RUN = ("--out", "run", "--views", "3", "--image-size", "32")


@pytest.mark.parametrize(
    ("region", "editor"),
    [(f"file:{NO_TEXT}.npy", "night"), ("all", f"instruct:{NO_TEXT}"), (f"text:{NO_TEXT}", "night")],
)
def test_run_with_options_that_are_not_utf8_is_not_started(
    scene: str, region: str, editor: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = entries()
    message = line_of(capsys, "train", scene, "--region", region, "--editor", editor, *RUN)
    assert "is not UTF-8" in message
    assert entries() == before


def test_run_of_a_scene_with_a_name_that_is_not_utf8_is_not_started(
    scene: str, capsys: pytest.CaptureFixture[str]
) -> None:
    os.rename(scene, f"{NO_TEXT}.ply")
    before = entries()
    message = line_of(capsys, "train", f"{NO_TEXT}.ply", "--region", "all", "--editor", "night", *RUN)
    assert "the record of --scene cannot hold" in message
    assert entries() == before


@pytest.mark.parametrize(
    "words",
    [
        ("--delete", "all", "-o", f"{NO_TEXT}.gdf"),
        ("--delete", f"file:{NO_TEXT}.npy", "-o", "a.gdf"),
        ("--move", f"file:{NO_TEXT}.npy:1,2,3", "-o", "a.gdf"),
    ],
)
def test_edit_that_would_record_invalid_text_is_not_written(
    scene: str, words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(f"{NO_TEXT}.npy", np.arange(5))
    before = entries()
    assert "an edit cannot hold" in line_of(capsys, "edit", scene, *words)
    assert entries() == before


@pytest.mark.parametrize("name", [NO_TEXT, "a\nb", "a\x1b[2Jb", "a:b", ".a", "con"])
def test_bundle_of_any_name_opens_again(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    session = saved_session(bear_files(tmp_path))
    path = tmp_path / f"{name}.progdf.zip"
    assert main(["export", str(session), "-o", str(path)]) == 0, capsys.readouterr().err
    opened = unpack_bundle(path)
    assert opened.is_file()
    assert opened.name.endswith(".session.json")


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_nul_in_an_argument_is_reported_in_one_line(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert "holds a NUL" in line_of(capsys, command, "a\0b")


def test_text_that_is_not_utf8_is_no_internal_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("progdf.cli.info.main", lambda argv: NO_TEXT.encode())
    assert r"'a\udcffb' is not UTF-8" in line_of(capsys, "info", "a")


@pytest.mark.parametrize("value", [LONG, "1," * 1500, "x/" * 1500, "x y " * 750])
@pytest.mark.parametrize(
    "words",
    [
        ("VALUE",),
        ("info", "VALUE"),
        ("info", "scene.ply", "--up", "VALUE"),
        ("render", "scene.ply", "-o", "VALUE"),
        ("render", "scene.ply", "-o", "a.png", "--size", "VALUE"),
        ("export", "scene.ply", "-o", "VALUE.ply"),
        ("train", "scene.ply", "--region", "all", "--editor", "VALUE", "--out", "run"),
        ("train", "scene.ply", "--region", "all", "--editor", "recolor:VALUE", "--out", "run"),
        ("train", "scene.ply", "--region", "all", "--editor", "night", "--out", "VALUE"),
        ("views", "scene.ply", "--views", "3", "--image-size", "32", "--out", "VALUE"),
        ("batch", "VALUE", "--out", "b"),
    ],
)
def test_long_values_are_elided(
    scene: str, words: tuple[str, ...], value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = entries()
    message = line_of(capsys, *(word.replace("VALUE", value) for word in words))
    assert len(message) < 1300
    assert entries() == before


def test_error_elides_each_value_and_keeps_the_remedy() -> None:
    message = str(ProgdfError(f"'{LONG}' and {LONG}: no such thing; write {'y' * 80} or 'z'"))
    short = shorten(LONG)
    assert message == f"'{short}' and {short}: no such thing; write {'y' * 80} or 'z'"
    assert len(short) == 80


def test_existing_path_is_not_elided(tmp_path: Path) -> None:
    deep = tmp_path / ("d" * 200) / ("e" * 200)
    deep.mkdir(parents=True)
    for path in (deep, deep / "absent.ply"):
        assert elide(f"{path} cannot be read; check it") == f"{path} cannot be read; check it"
    assert "…" in elide(f"{deep / 'no' / 'absent.ply'} cannot be read")


@pytest.mark.slow
@posix
@pytest.mark.parametrize(
    ("shell", "status"),
    [
        ('"$0" -c "$1" info "$2" > /dev/full', 2),
        ('"$0" -c "$1" info "$2" >&-', 0),
        ('"$0" -c "$1" train --help > /dev/full', 2),
        ('"$0" -c "$1" nowhere 2> /dev/full', 2),
        ('"$0" -c "$1" info nowhere 2> /dev/full > /dev/full', 2),
        ('set -o pipefail; "$0" -c "$1" train --help | true', 0),
    ],
)
def test_full_output_is_reported_in_one_line(scene: str, shell: str, status: int) -> None:
    words = ["bash", "-c", shell, sys.executable, PROGRAM, scene]
    buffered = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    ran = subprocess.run(words, capture_output=True, text=True, env=buffered)
    assert ran.returncode == status, ran
    expected = 1 if status and "2>" not in shell else 0
    assert ran.stderr.count("\n") == expected, ran.stderr
    assert "Traceback" not in ran.stderr
    if expected:
        assert "No space left on device" in ran.stderr


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("libtorch_cpu.so: failed to map segment from shared object"),
        OSError("libllvmlite.so: failed to map segment from shared object"),
        RuntimeError("can't start new thread"),
    ],
)
def test_out_of_memory_is_recognized_behind_other_errors(error: Exception) -> None:
    assert is_out_of_memory(error)
    outer = ValueError("a")
    outer.__cause__ = error
    assert is_out_of_memory(outer)
    hidden = ValueError("a")
    hidden.__context__ = error
    assert is_out_of_memory(hidden)
    hidden.__suppress_context__ = True
    assert not is_out_of_memory(hidden)
    assert not is_out_of_memory(ImportError("no module named x"))


@posix
def test_low_address_space_is_reported_in_one_line(scene: str) -> None:
    words = ["bash", "-c", 'ulimit -v 400000; "$0" -c "$1" info "$2"', sys.executable, PROGRAM, scene]
    ran = subprocess.run(words, capture_output=True, text=True)
    assert (ran.returncode, ran.stderr.count("\n")) == (2, 1), ran
    assert "out of memory" in ran.stderr


@posix
def test_unwritable_home_folder_does_no_harm(scene: str, tmp_path: Path) -> None:
    (tmp_path / "home").write_text("no folder")
    homes = {"HOME": str(tmp_path / "home"), "TMPDIR": str(tmp_path / "absent")}
    environment = {name: value for name, value in os.environ.items() if not name.startswith("XDG_")} | homes
    words = [sys.executable, "-c", PROGRAM, "info", scene]
    ran = subprocess.run(words, capture_output=True, text=True, env=environment)
    assert (ran.returncode, ran.stderr) == (0, "")
