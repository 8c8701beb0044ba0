"""Child processes for commands: imported code, priority and termination."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from progdf.system.processes import NICENESS
from trainer.run import demo
from viewer.jobs.child import Child

MODULES = ("numpy", "threading", "torch", "signal", "json", "progdf", "trainer")
"""Modules in a downloaded folder. A package `viewer` lies beside them."""
WAITING = """
import signal, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)  # as `progdf view &` in a script has it
import progdf.__main__, viewer.jobs.child
progdf.__main__.main = lambda arguments: print("began", flush=True) or time.sleep(600)
viewer.jobs.child.main()
"""


@pytest.fixture
def child(tmp_path: Path) -> Iterator[Callable[..., Child]]:
    """Yield a function that starts children; kill them after the test."""
    started: list[Child] = []

    def start(*arguments: str, talks: bool = False) -> Child:
        started.append(Child(arguments, tmp_path / "child.log", talks))
        return started[-1]

    yield start
    for found in started:
        found.kill()
        found.close()


@pytest.fixture
def stranger(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a downloaded folder whose modules create the returned file when they run."""
    folder = tmp_path / "downloaded"
    (folder / "viewer" / "jobs").mkdir(parents=True)
    code = f"import os\nos.close(os.open({str(tmp_path / 'ran')!r}, os.O_CREAT | os.O_WRONLY))\n"
    modules = [folder / f"{name}.py" for name in MODULES]
    inits = [folder / "viewer" / "__init__.py", folder / "viewer" / "jobs" / "__init__.py"]
    for path in (*modules, *inits, folder / "viewer" / "jobs" / "child.py"):
        path.write_text(code)
    monkeypatch.chdir(folder)
    return tmp_path / "ran"


def test_child_process_runs_no_code_from_the_current_folder(
    child: Callable[..., Child], stranger: Path
) -> None:
    started = child("info", "no.ply")  # imports numpy and torch, then exits
    assert started._process.wait() == 2
    assert started.error().startswith("no.ply does not exist")
    assert not stranger.exists()


def test_demo_window_runs_no_code_from_the_current_folder(
    stranger: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "PYTHONSAFEPATH"):
        monkeypatch.delenv(name, raising=False)
    assert demo._open_window(["view", "no.ply"]) == 2
    assert not stranger.exists()


def test_modules_in_the_current_folder_run_without_safe_path(stranger: Path) -> None:
    subprocess.run([sys.executable, "-c", "import numpy"], check=False)
    assert stranger.exists()


@pytest.mark.skipif(sys.platform != "linux", reason="asks for the scheduling policy")
def test_child_priority_is_lowered_only_for_background_work(child: Callable[..., Child]) -> None:
    started = child("preview", "no.ply")
    mine = os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getpriority(os.PRIO_PROCESS, started.pid) == min(mine + NICENESS, 19)
    assert os.sched_getscheduler(started.pid) == os.SCHED_OTHER, "SCHED_IDLE gets nothing on a busy machine"
    talking = child("preview", "no.ply", talks=True)
    assert os.getpriority(os.PRIO_PROCESS, talking.pid) == mine, "somebody waits for it"


def test_child_stops_if_the_window_ignores_interrupts() -> None:
    words = [sys.executable, "-P", "-c", WAITING, "train"]
    process = subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"began\n"
    process.communicate()  # closes its standard input
    assert process.returncode in (1, 130, -signal.SIGINT)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGSTOP")
def test_child_that_waits_for_pictures_is_not_killed(
    child: Callable[..., Child], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("viewer.jobs.child.GRACE_S", 0.0)
    patient = child("preview", "no.ply", talks=True)
    os.kill(patient.pid, signal.SIGSTOP)  # it cannot end, as if a server made a picture
    patient.stop(1000.0)
    assert patient.status is None
    patient.close()
    assert patient.status is None, "it ends by itself after the window"
    hurried = child("preview", "no.ply", talks=True)
    os.kill(hurried.pid, signal.SIGSTOP)
    hurried.stop(0.0)
    hurried.close()
    assert hurried.status == -signal.SIGKILL


def test_child_starts_and_is_killed_without_process_groups(
    child: Callable[..., Child], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("killpg", "setpriority", "getpriority", "nice", "sched_setscheduler"):
        monkeypatch.delattr(os, name, raising=False)
    started = child("preview", "no.ply", talks=True)
    assert started.status is None
    started.kill()
    started.close()
    assert started.status is not None
