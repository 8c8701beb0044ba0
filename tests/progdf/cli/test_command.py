"""Tests of the progdf command: errors for wrong input, signals, and internal errors."""

from __future__ import annotations

import errno
import os
import runpy
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import progdf
from progdf import wait_passively
from progdf.__main__ import COMMANDS, main
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.io.atomic import atomic_write
from progdf.rasterize.cpu import jit
from tests.helpers.paths import ROOT
from tests.helpers.scenes import random_gaussians
from trainer.options import ShowRegionOptions, WriteViewsOptions, check_ranges


def stderr_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    status = main(list(arguments))
    captured = capsys.readouterr()
    assert status == 2, captured
    assert captured.err.startswith("progdf: ")
    assert captured.err.count("\n") == 1, captured.err
    return captured.err


def test_progdf_without_a_command_lists_all_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in COMMANDS)


def test_help_does_not_import_torch() -> None:
    code = "import sys; from progdf.__main__ import main; main(['--help']); print('torch' in sys.modules)"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "False"


def test_every_public_name_exists() -> None:
    assert all(hasattr(progdf, name) for name in progdf.__all__)
    assert not hasattr(progdf, "undo_everything")


def test_unknown_command_error_names_the_known_ones(capsys: pytest.CaptureFixture[str]) -> None:
    assert "train" in stderr_of(capsys, "trian")


@pytest.mark.parametrize("command", ["info", "render", "export", "train", "fit", "view"])
def test_missing_file_is_reported_in_one_line_with_exit_2(
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


def test_full_disk_error_suggests_freeing_space(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(argv: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("progdf.cli.info.main", full)
    assert "free some space" in stderr_of(capsys, "info", "scene.ply")


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert "usage" in capsys.readouterr().out.lower()


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_unknown_option_is_reported_in_one_line(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    message = stderr_of(capsys, command, "--no-such-option")
    assert f"see progdf {command} --help" in message


NO_PRESET = (
    "invalid choice 'tables' for argument '--preset'. Expected one of ('default', 'paper'); "
    "see progdf train --help"
)


def test_invalid_choice_error_lists_the_valid_ones(capsys: pytest.CaptureFixture[str]) -> None:
    message = stderr_of(capsys, "train", "scene.ply", "--preset", "tables")
    assert message == f"progdf: {NO_PRESET}\n"


def test_option_errors_are_reported_in_one_line_on_an_ascii_terminal() -> None:
    command = [sys.executable, "-m", "progdf", "train", "scene.ply", "--preset", "tables"]
    env = {**os.environ, "PYTHONIOENCODING": "ascii"}
    refused = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert (refused.returncode, refused.stderr) == (2, f"progdf: {NO_PRESET}\n")


@pytest.mark.parametrize("threads", ["-1", "99999"])
def test_thread_count_out_of_range_is_refused(
    threads: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert "--threads must be between 0 and 1024" in stderr_of(
        capsys, "fit", str(tmp_path), "--threads", threads
    )


def test_limits_in_errors_are_written_for_people() -> None:
    with pytest.raises(ProgdfError, match=r"^--price must be between 0 and 1 000 000, got -1$"):
        check_ranges(("--price", -1, 0, 1e6))
    with pytest.raises(ProgdfError, match=r"^--share must be between 0.5 and 1, got 2$"):
        check_ranges(("--share", 2, 0.5, 1.0))


@pytest.mark.parametrize("psnr", ["nan", "inf", "0", "-3", "99.1", "1e99"])
def test_unmeasurable_target_psnr_is_refused(
    psnr: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert "--target-psnr must be above 0" in stderr_of(capsys, "fit", str(tmp_path), "--target-psnr", psnr)
    out = ("--out", str(tmp_path / "run"), "--region", "all", "--editor", "night", "--target-psnr", psnr)
    assert "--target-psnr must be above 0" in stderr_of(capsys, "train", str(tmp_path / "scene.ply"), *out)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("option", "number"),
    [
        ("--seed", "-1"),
        ("--seed", "9" * 20),
        ("--steps", "9" * 20),
        ("--steps", "-1"),
    ],
)
def test_out_of_range_numbers_stop_a_run_before_it_starts(
    option: str, number: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    save_ply(tmp_path / "scene.ply", random_gaussians(20))
    words = ("--out", str(tmp_path / "run"), "--region", "all", "--editor", "instruct:make it blue")
    message = stderr_of(capsys, "train", str(tmp_path / "scene.ply"), *words, option, number)
    assert message.startswith(f"progdf: {option} must be between ")
    assert message.strip().endswith(f"got {number}")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "editor", ["recolor:#30", "tint:", "stripes:red", "darken:nan", "style:99", "folder:nope"]
)
def test_invalid_editor_is_refused_before_a_folder_is_created(
    editor: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    run = tmp_path / "run"
    save_ply(tmp_path / "scene.ply", random_gaussians(20))
    stderr_of(
        capsys, "train", str(tmp_path / "scene.ply"), "--out", str(run), "--region", "all", "--editor", editor
    )
    assert not run.exists()


def test_internal_error_prints_one_line_and_writes_a_crash_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def wrong(argv: object) -> None:
        raise IndexError("list index\nout of range")

    monkeypatch.setattr("progdf.cli.info.main", wrong)
    monkeypatch.setattr("progdf.__main__.state_folder", lambda: tmp_path / "progdf")
    assert main(["info", "scene.ply"]) == 70
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert message.startswith("progdf: internal error in progdf (IndexError: list index out of range); ")
    details = (tmp_path / "progdf" / "crash.txt").read_text()
    assert str(tmp_path / "progdf" / "crash.txt") in message
    assert "Traceback" in details
    assert "in wrong" in details


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        RuntimeError(
            "[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes"
        ),
        RuntimeError("DefaultCPUAllocator: not enough memory: you tried to allocate 9 bytes."),
    ],
)
def test_out_of_memory_is_reported_in_one_line(
    error: Exception, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def large(argv: object) -> None:
        raise error

    monkeypatch.setattr("progdf.cli.info.main", large)
    assert "out of memory; " in stderr_of(capsys, "info", "scene.ply")


@pytest.mark.usefixtures("default_signals")
@pytest.mark.parametrize("command", ["info", "view"])
@pytest.mark.parametrize("number", ["SIGTERM", "SIGHUP"])
def test_signal_that_ends_a_command_removes_its_temporary_files(
    command: str,
    number: str,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def writing(argv: object) -> None:
        with atomic_write(tmp_path / "a.txt") as temporary_file:
            temporary_file.write_text("half")
            os.kill(os.getpid(), getattr(signal, number))

    monkeypatch.setattr("progdf.cli.info.main", writing)
    monkeypatch.setattr("viewer.commands.view.main", writing)
    assert main([command, "scene.ply"]) == 130
    assert capsys.readouterr().err == "progdf: interrupted\n"
    assert not list(tmp_path.iterdir())
    assert signal.getsignal(getattr(signal, number)) == signal.SIG_DFL


def test_removed_current_folder_is_reported_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert stderr_of(capsys, "info", "/scene.ply") == (
        "progdf: the current folder was removed; change to one that exists\n"
    )


def test_unusable_numba_settings_are_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    # the module alone, as its package loads torch
    code = f"import runpy; runpy.run_path({jit.__file__!r})"
    settings = {"NUMBA_NUM_THREADS": "0"}
    words = [sys.executable, "-c", code]
    ran = subprocess.run(words, capture_output=True, text=True, env=os.environ | settings, cwd=ROOT)
    assert ran.stderr.splitlines()[-1].startswith(
        "progdf.errors.ProgdfError: numba cannot be loaded (ValueError"
    )
    monkeypatch.setattr(jit.config, "DISABLE_JIT", 1)
    with pytest.raises(ProgdfError, match="unset NUMBA_DISABLE_JIT"):
        runpy.run_path(str(jit.__file__))


@pytest.mark.parametrize(
    ("words", "writer"),
    [
        (["views", "scene.ply", "--out"], "trainer.regions.command.write"),
        (["region", "scene.ply", "all", "-o"], "trainer.regions.command.show"),
    ],
)
def test_control_characters_of_arguments_are_escaped(
    words: list[str], writer: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def wrote(options: WriteViewsOptions | ShowRegionOptions) -> list[str]:
        return [f"wrote {options.out}"]

    monkeypatch.setattr(writer, wrote)
    assert main([*words, "a\x1b[2J\n.png"]) == 0
    assert capsys.readouterr().out == "wrote a\\x1b[2J\\n.png\n"


def test_ignored_signal_stays_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("progdf.cli.info.main", lambda argv: os.kill(os.getpid(), signal.SIGHUP))
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        assert main(["info", "scene.ply"]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_child_of_a_test_handles_signals() -> None:
    code = "import signal as s; print([s.getsignal(n) for n in (s.SIGINT, s.SIGHUP, s.SIGTERM)])"
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "SIG_IGN" not in child.stdout


@pytest.mark.slow
def test_tests_pass_if_signals_are_inherited_ignored() -> None:
    command = [sys.executable, "-m", "pytest", "-n", "0", __file__, "-k", "SIGHUP or child_of_a_test"]
    env = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    shell = ["sh", "-c", "trap '' INT HUP; exec \"$@\"", "sh"]
    ran = subprocess.run([*shell, *command], cwd=ROOT, env=env, capture_output=True, text=True)
    assert "3 passed" in ran.stdout, ran.stdout


@pytest.mark.parametrize(
    "name",
    [
        *("a\x1b[2J", "a\nb", "a\\b", "a/b", ".a", "n" * 252, "\N{CJK UNIFIED IDEOGRAPH-4E16}" * 90),
        *("CON", "nul.x", "a:b", "com1 .y", "a.", "a ", "what?"),
    ],
)
def test_invalid_edit_name_is_refused_before_a_folder_is_created(
    name: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    out = ("--out", str(tmp_path / "run"), "--region", "all", "--editor", "night", "--name", name)
    assert "--name" in stderr_of(capsys, "train", str(tmp_path / "scene.ply"), *out)
    assert not list(tmp_path.iterdir())


STREAMS = "import sys; from progdf.__main__ import main; sys.exit(main(sys.argv[1:]))"


@pytest.mark.parametrize(
    ("shell", "status"),
    [
        ('"$0" -c "$1" --help >&-', 0),
        ('"$0" -c "$1" --help <&- >&- 2>&-', 0),
        ('"$0" -c "$1" nowhere 2>&-', 2),
        ('"$0" -c "$1" --help > /dev/full', 2),
        ('LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 "$0" -c "$1" --help', 0),
        ('LC_ALL=C PYTHONUTF8=0 PYTHONCOERCECLOCALE=0 "$0" -c "$1" $(printf "\\351")', 2),
    ],
)
def test_closed_full_or_ascii_streams_do_not_crash_a_command(shell: str, status: int) -> None:
    ran = subprocess.run(["sh", "-c", shell, sys.executable, STREAMS], capture_output=True)
    assert ran.returncode == status, ran
    assert b"Traceback" not in ran.stderr
    assert ran.stderr.count(b"\n") <= 1


def test_idle_threads_sleep_unless_the_user_chose() -> None:
    unset = dict[str, str]()
    wait_passively(unset)
    assert unset == {"OMP_WAIT_POLICY": "PASSIVE"}
    for chosen in ({"OMP_WAIT_POLICY": "active"}, {"GOMP_SPINCOUNT": "100"}, {"KMP_BLOCKTIME": "200"}):
        kept = dict(chosen)
        wait_passively(kept)
        assert kept == chosen


@pytest.mark.parametrize(
    ("imports", "policy"), [("import progdf", "PASSIVE"), ("import torch, progdf", "None")]
)
def test_import_sets_the_wait_policy_only_before_torch(imports: str, policy: str) -> None:
    program = f"import os; {imports}; print(os.environ.get('OMP_WAIT_POLICY'))"
    environment = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == policy
