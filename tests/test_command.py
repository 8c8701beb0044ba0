"""The front door: what a person sees who types something wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from progdf.__main__ import COMMANDS, main


def stderr_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    status = main(list(arguments))
    captured = capsys.readouterr()
    assert status == 2, captured
    assert captured.err.startswith("progdf: ")
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


def test_without_a_command_it_lists_them_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in COMMANDS)


def test_an_unknown_command_is_one_line_that_names_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert "train" in stderr_of(capsys, "trian")


@pytest.mark.parametrize("command", ["check", "info", "render", "export", "train", "fit", "view"])
def test_a_missing_file_is_one_line_and_exit_2(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    missing = str(tmp_path / "nowhere.ply")
    more = {
        "render": ["--orbit", "0,10", "-o", str(tmp_path / "a.png")],
        "export": ["-o", str(tmp_path / "a.ply")],
        "train": ["--out", str(tmp_path / "run"), "--region", "all", "--editor", "recolor:#3060d0"],
    }
    assert "nowhere.ply" in stderr_of(capsys, command, missing, *more.get(command, []))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_explains_itself(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        raise SystemExit(main([command, "--help"]))
    assert stop.value.code in (0, None)
    assert "usage" in capsys.readouterr().out.lower()
