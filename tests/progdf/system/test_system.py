"""Tests of the code that differs between systems, simulated by the name and the missing calls of each."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write
from progdf.system import desktop, files, processes
from tests.helpers.paths import ROOT
from viewer.ui import key_list, splash

SYSTEMS = ("linux", "win32", "darwin")
WINDOWS_ONLY = {"BELOW_NORMAL_PRIORITY_CLASS": 0x4000, "CREATE_NEW_PROCESS_GROUP": 0x200}


@pytest.fixture(params=SYSTEMS)
def system(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the name of a system that the code runs on for this test."""
    name: str = request.param
    monkeypatch.setattr(sys, "platform", name)
    if name == "win32":
        for constant, value in WINDOWS_ONLY.items():
            monkeypatch.setattr(subprocess, constant, value, raising=False)
        for call in ("killpg", "getpriority", "setpriority", "getuid"):
            monkeypatch.delattr(os, call)
    return name


def test_display_is_asked_for_on_linux_only(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert desktop.has_display() == (system != "linux")
    assert ("ssh -X" in desktop.display_remedy()) == (system == "linux")
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-1")
    assert ("xwayland" in desktop.display_remedy()) == (system == "linux")
    monkeypatch.setenv("DISPLAY", ":1")
    assert desktop.has_display()
    assert desktop.display_remedy() == ""


def test_file_dialogs_need_a_program_on_linux_only(system: str) -> None:
    assert desktop.has_file_dialog(["no-such-program"]) == (system != "linux")
    assert desktop.has_file_dialog([sys.executable])


def test_fonts_are_searched_where_each_system_has_them(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WINDIR", "C:/Windows")
    monkeypatch.setenv("LOCALAPPDATA", "C:/Users/a/AppData/Local")
    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    found = [path.as_posix() for path in desktop.font_folders()]
    expected = {"linux": "/usr/share/fonts", "win32": "C:/Windows/Fonts", "darwin": "/System/Library/Fonts"}
    assert expected[system] in found
    own = {"linux": "~/.local/share/fonts", "darwin": "~/Library/Fonts"}
    assert own.get(system, "C:/Users/a/AppData/Local/Microsoft/Windows/Fonts") in found


def test_pictures_open_in_the_default_program(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[str, ...]] = []
    monkeypatch.setattr(os, "startfile", lambda *words: started.append(words), raising=False)
    monkeypatch.setattr(subprocess, "Popen", lambda words, **_: started.append(tuple(words)))
    assert desktop.open_in_program(Path("a.png"))
    expected = {"linux": ("xdg-open", "a.png"), "darwin": ("open", "a.png"), "win32": (Path("a.png"), "edit")}
    assert started == [expected[system]]


def test_missing_launcher_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise FileNotFoundError

    monkeypatch.setattr(subprocess, "Popen", refuse)
    assert not desktop.open_in_program(Path("a.png"))


def test_window_library_and_command_key_of_each_system(system: str) -> None:
    names = {"linux": "libglfw.so.3", "win32": "glfw3.dll", "darwin": "libglfw.3.dylib"}
    assert desktop.glfw_library_name() == names[system]
    assert any("Cmd" in row for topic in key_list.topics() for row in topic.rows) == (system == "darwin")


def test_window_requests_the_gl_context_that_macs_support() -> None:
    hints = dict(splash._HINTS)
    glfw = splash.glfw
    assert (hints[glfw.CONTEXT_VERSION_MAJOR], hints[glfw.CONTEXT_VERSION_MINOR]) == (3, 3)
    assert hints[glfw.OPENGL_PROFILE] == glfw.OPENGL_CORE_PROFILE
    assert hints[glfw.OPENGL_FORWARD_COMPAT]


def test_no_line_width_is_set_as_macs_draw_one_pixel_only() -> None:
    sources = [path for path in (ROOT / "viewer").rglob("*.py") if ".line_width" in path.read_text("utf-8")]
    assert not sources


def test_children_head_their_own_group(system: str) -> None:
    if system == "win32":
        assert processes.child_options(low_priority=False) == {"creationflags": 0x200}
        assert processes.child_options(low_priority=True) == {"creationflags": 0x4200}
    else:
        assert processes.child_options(low_priority=True) == {"process_group": 0}


def test_groups_are_killed_as_each_system_can(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    monkeypatch.setattr(subprocess, "run", lambda words, **_: calls.append(words))
    if system != "win32":
        monkeypatch.setattr(os, "killpg", lambda *words: calls.append(words))
    running: Any = SimpleNamespace(pid=7, poll=lambda: None)
    processes.kill_group(running)
    ended: Any = SimpleNamespace(pid=8, poll=lambda: 0)
    processes.kill_group(ended)
    assert calls == [["taskkill", "/T", "/F", "/PID", "7"] if system == "win32" else (7, signal.SIGKILL)]


def test_priority_is_lowered_as_each_system_can(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[Any, ...]] = []
    if system == "win32":
        set_class = SimpleNamespace(SetPriorityClass=lambda _, value: calls.append((value,)))
        monkeypatch.setattr(ctypes, "windll", SimpleNamespace(kernel32=set_class), raising=False)
    else:
        monkeypatch.setattr(os, "getpriority", lambda *_: 0)
        monkeypatch.setattr(os, "setpriority", lambda *words: calls.append(words))
    processes.lower_priority()
    assert {call[-1] for call in calls} == {0x4000 if system == "win32" else processes.NICENESS}
    assert len(calls) == 1 or system == "linux", "Linux keeps a niceness per thread"


def test_no_signal_is_sent_to_test_a_process_on_windows(system: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[int] = []

    def kill(process: int, number: int) -> None:
        sent.append(number)
        if process == 2:
            raise ProcessLookupError
        if process == 3:
            raise PermissionError

    monkeypatch.setattr(os, "kill", kill)
    assert [processes.is_running(number) for number in (1, 2, 3)] == (
        [None] * 3 if system == "win32" else [True, False, True]
    )
    assert sent == ([] if system == "win32" else [0, 0, 0])


def test_memory_is_zero_where_the_system_does_not_tell(system: str) -> None:
    assert (processes.peak_mb() > 0.0) == (system != "win32")
    assert (processes.resident_bytes() > 0) == (system == "linux")
    assert (processes.c_library() is not None) == (system == "linux")


def test_files_are_owned_and_flushed_on_each_system(system: str, tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"a")
    tmp_path.chmod(0o700)
    assert files.is_owned(path)
    assert files.is_private(tmp_path)
    tmp_path.chmod(0o777)
    assert files.is_private(tmp_path) == (system == "win32")
    files.flush_to_disk(path)


@pytest.mark.parametrize("times", [1, 3, 100])
def test_file_opened_elsewhere_is_replaced_once_it_is_closed(
    times: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.txt"
    real = os.replace
    calls = 0

    def replace(source: Path, target: Path) -> None:
        nonlocal calls
        calls += 1
        if calls <= times:
            error = PermissionError(13, "The process cannot access the file", str(target))
            error.winerror = 32  # type: ignore[attr-defined]
            raise error
        real(source, target)

    path.write_text("old", encoding="utf-8")
    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr("progdf.system.files._RETRY_DELAYS_S", (0.0,) * 5)
    try:
        with atomic_write(path) as temporary_file:
            temporary_file.write_text("new", encoding="utf-8")
    except (PermissionError, ProgdfError):
        assert times == 100
    assert path.read_text("utf-8") == ("old" if times == 100 else "new")
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]
