"""Runs of `progdf train` as processes that are killed or interrupted while a server edits their views."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from tests.helpers.comfy_server import comfy_server, edit
from tests.helpers.image_server import Refusal, image_server, swap_colors
from tests.helpers.trained import write_bear

KEY = "sk-secret-of-the-test"
WORKFLOW = Path(__file__).parents[3] / "docs" / "workflows" / "qwen-image-edit.json"
SETTINGS = ["--kind=color", "--views=5", "--image-size=48", "--steps=40", "--threads=1", "--edit-size=64"]

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL"),
]


@dataclass
class Watched:
    """Server that calls a function before each of its answers."""

    options: list[str]
    calls: list[object]
    before: Callable[[int], Refusal | None] = lambda number: None
    lock: threading.Lock = field(default_factory=threading.Lock)


@contextmanager
def api_server() -> Iterator[Watched]:
    watched = Watched([], [])
    with image_server(lambda call, number: watched.before(number) or swap_colors(call.pictures[0])) as server:
        watched.calls = server.calls  # type: ignore[assignment]
        watched.options = ["--editor", 'api:"turn it into marble"', "--model", "m", "--api-url", server.url]
        yield watched


@contextmanager
def workflow_server() -> Iterator[Watched]:
    watched = Watched([], [])
    with comfy_server(lambda job, number: watched.before(number) or edit(job)) as server:
        watched.calls = server.jobs  # type: ignore[assignment]
        watched.options = ["--editor", f"comfy:{WORKFLOW}", "--api-url", server.url, "--stages", "2"]
        yield watched


SERVERS = pytest.mark.parametrize("open_server", [api_server, workflow_server])
Opener = Callable[[], AbstractContextManager[Watched]]


def start(folder: Path, options: list[str], *more: str) -> subprocess.Popen[str]:
    folder.mkdir(exist_ok=True)
    scene = folder.parent
    region = f"labels:{scene / 'labels.npy'}:1"
    words = ["train", str(scene / "scene.ply"), "-o", str(folder / "run"), "--region", region, *options]
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "progdf", *words, *SETTINGS, *more],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={**os.environ, "OPENAI_API_KEY": KEY},
    )


def finish(process: subprocess.Popen[str]) -> str:
    output = process.communicate(timeout=300)[0]
    assert process.returncode == 0, output
    assert KEY not in output
    return output


def check_secrecy(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert len(files) > 10
    assert not [path for path in files if KEY.encode() in path.read_bytes()]


@SERVERS
def test_killed_run_resumes_to_the_same_bytes(open_server: Opener, tmp_path: Path) -> None:
    pytest.importorskip("openai")
    write_bear(tmp_path)
    with open_server() as server:
        seen: list[bytes] = []
        whole = start(tmp_path / "whole", server.options, "--edit-workers", "2")

        def look(number: int) -> None:
            if Path(f"/proc/{whole.pid}/cmdline").exists():
                seen.append(Path(f"/proc/{whole.pid}/cmdline").read_bytes())

        server.before = look
        finish(whole)
        total = len(server.calls)
        assert not any(KEY.encode() in words for words in seen)
        server.calls.clear()
        for kill_at in (1, total // 2, total - 1):
            process = start(tmp_path / "killed", server.options, "--edit-workers", "2", "--resume")
            begun = len(server.calls)

            def kill(
                number: int, process: subprocess.Popen[str] = process, at: int = kill_at + begun
            ) -> None:
                if number == at:
                    process.kill()

            server.before = kill
            process.communicate(timeout=300)
        server.before = lambda number: None
        finish(start(tmp_path / "killed", server.options, "--edit-workers", "2", "--resume"))
        lost = len(server.calls) - total
        assert lost <= 3 * 2, "only pictures that were being made are made again"
    names = ("trajectory.safetensors", "run.gdf")
    for name in names:
        expected = (tmp_path / "whole" / "run" / name).read_bytes()
        assert (tmp_path / "killed" / "run" / name).read_bytes() == expected, name
    check_secrecy(tmp_path)


@SERVERS
def test_interrupted_run_keeps_pictures_that_are_being_made(open_server: Opener, tmp_path: Path) -> None:
    pytest.importorskip("openai")
    write_bear(tmp_path)
    begun = threading.Event()
    release = threading.Event()
    with open_server() as server:

        def hold(number: int) -> None:
            if number >= 2:
                begun.set()
                release.wait(60)

        server.before = hold
        process = start(tmp_path / "run", server.options, "--edit-workers", "2")
        assert begun.wait(120)
        process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        lines = []
        for line in process.stdout:
            lines.append(line)
            if "press Ctrl-C again" in line:
                break
        else:
            pytest.fail(f"no line says that the run waits: {lines}")
        release.set()
        process.wait(60)
        assert process.returncode == 130
        made = len(server.calls)
    pictures = list((tmp_path / "run" / "run" / "views" / "painted").rglob("*.png"))
    assert len(pictures) == made


def test_interruption_ends_waits_for_a_busy_server(tmp_path: Path) -> None:
    pytest.importorskip("openai")
    write_bear(tmp_path)
    begun = threading.Event()
    with api_server() as server:

        def busy(number: int) -> Refusal:
            begun.set()
            return Refusal(429, "rate_limit_exceeded", "slow down", {"Retry-After": "100"})

        server.before = busy
        process = start(tmp_path / "run", server.options)
        assert begun.wait(120)
        assert process.stdout is not None
        assert any("The server asks to wait 2 min" in line for line in process.stdout)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)
        assert process.returncode == 130
        assert len(server.calls) == 1
