"""Real window: `progdf view` under Xvfb, driven by xdotool."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.viewer.display import display, missing_tools
from progdf.__main__ import main
from tests.helpers.paths import ROOT
from tests.helpers.ui_rig import SLIDER_INSET, TRACK, bear
from viewer.camera.view_camera import first_camera, to_camera
from viewer.files.session import open_session
from viewer.panel import card, panel
from viewer.ui.keys import KEYS, NAMES
from viewer.ui.splash import SIZE

PATIENCE_S = 120.0  # generous for a busy machine; waiting ends as soon as the condition holds
WIDTH, HEIGHT = SIZE


@dataclass
class Desktop:
    """`progdf view` on its own virtual display."""

    process: subprocess.Popen[str]
    environment: dict[str, str]
    folder: Path
    window: str = ""

    def xdotool(self, *arguments: object) -> str:
        command = ["xdotool", *(str(argument) for argument in arguments)]
        run = subprocess.run(
            command, env=self.environment, capture_output=True, text=True, timeout=PATIENCE_S
        )
        return run.stdout.strip()

    def until(self, what: str, happened: Callable[[], object]) -> None:
        end = time.monotonic() + PATIENCE_S
        while not happened():
            assert not self.process.poll(), f"the window closed: {self.process.communicate()}"
            assert time.monotonic() < end, f"waited in vain for {what}"
            time.sleep(0.05)

    def open(self) -> None:
        def found() -> str:
            self.window = self.xdotool("search", "--onlyvisible", "--name", ". ProGDF Studio").split("\n")[0]
            return self.window

        self.until("the window", found)
        self.xdotool("windowfocus", self.window)

    def point(self, x: float, y: float) -> None:
        self.xdotool("mousemove", "--window", self.window, round(x), round(y))

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: int = 1) -> None:
        self.grip(start, end, button)
        self.xdotool("mouseup", button)

    def grip(self, start: tuple[float, float], end: tuple[float, float], button: int = 1) -> None:
        """Press and drag without releasing the button."""
        self.point(*start)
        self.xdotool("mousedown", button)
        for share in (0.3, 0.6, 1.0):
            self.point(*(a + share * (b - a) for a, b in zip(start, end, strict=True)))

    def shot(self, keys: str = "shift+F2") -> np.ndarray:
        """Return the window's own screenshot after all earlier input is handled. [H,W,3]"""
        path = self.folder / f"bear_{len(list(self.folder.glob('bear_*.png'))) + 1:03d}.png"
        self.xdotool("key", keys)
        self.until(path.name, path.exists)
        return np.asarray(Image.open(path)).astype(int)

    def rest(self) -> np.ndarray:
        """Return a screenshot once the picture is sharp; on a slow machine it is coarse during a drag."""
        shots = [self.shot()]

        def same() -> bool:
            shots.append(self.shot())
            return changed(*shots[-2:]) == 0

        self.until("a picture at rest", same)
        return shots[-1]

    def turns(self) -> int:
        """Return the number of turns of the window's loop that handled events or drew frames."""
        return int.from_bytes((self.folder / "turns").read_bytes(), "little")

    def until_idle(self, what: str) -> None:
        """Wait until the window's loop makes no turn for one second."""

        def idle() -> bool:
            before = self.turns()
            time.sleep(1.0)
            return self.turns() == before

        self.until(what, idle)


@pytest.fixture
def screen() -> Iterator[str]:
    """Start a virtual display; yield its name."""
    if missing := missing_tools():
        pytest.skip(f"{missing} is not installed")
    with display(WIDTH + 100, HEIGHT + 100) as name:
        yield name


@pytest.fixture
def desktop(screen: str, tmp_path: Path) -> Iterator[Desktop]:
    paths = bear().save(tmp_path)
    environment = os.environ | {"DISPLAY": screen, "NUMBA_NUM_THREADS": "2"}
    environment.pop("WAYLAND_DISPLAY", None)
    process = subprocess.Popen(
        [
            sys.executable,
            str(ROOT / "tests" / "helpers" / "counted_view.py"),
            str(tmp_path / "turns"),
            *map(str, paths),
            "--set",
            "scarf=0.5",
        ],
        env=environment,
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    opened = Desktop(process, environment, tmp_path)
    try:
        opened.open()
        yield opened
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE_S)


def slider(layer: int, strength: float) -> tuple[float, float]:
    """Return the window position of a strength; the last of two layers is on top."""
    x = WIDTH - panel.WIDTH_PX + SLIDER_INSET + strength * (panel.WIDTH_PX - 2 * SLIDER_INSET)
    return x, TRACK + card.CARD_PX * (1 - layer)


def changed(before: np.ndarray, after: np.ndarray, height: int = HEIGHT - 60) -> int:
    """Count visibly different pixels of the picture, by default without the line at its bottom."""
    part = np.s_[:height, : WIDTH - round(panel.WIDTH_PX)]
    return int((np.abs(before[part] - after[part]).max(axis=-1) > 12).sum())


def brightness(shot: np.ndarray) -> float:
    """Return the mean level of the picture, 0 to 255."""
    return float(shot[:, : WIDTH - round(panel.WIDTH_PX)].mean())


@pytest.mark.window
@pytest.mark.gl
def test_real_mouse_drag_changes_the_picture_and_idle_costs_nothing(
    desktop: Desktop,
) -> None:
    first = desktop.rest()
    assert first.shape == (HEIGHT, WIDTH, 3)
    desktop.drag(slider(0, 0.5), slider(0, 1.0))
    desktop.until("the edit", lambda: changed(first, desktop.shot()) > 200)
    desktop.xdotool("key", "ctrl+z")
    desktop.point(400, 400)  # away from the tooltip
    assert changed(first, desktop.rest()) == 0
    desktop.until_idle("a window that draws nothing when nothing changes")
    # orbit, fly and resize as well
    desktop.drag((400, 400), (480, 380))
    desktop.until("the turn", lambda: changed(first, desktop.shot()) > 1000)
    orbited = desktop.rest()
    desktop.xdotool("keydown", "ctrl", "keydown", "a", "keyup", "ctrl")  # Ctrl is released first
    desktop.until("the tint of all that is selected", lambda: changed(orbited, desktop.shot()) > 1000)
    desktop.rest()
    desktop.xdotool("key", "ctrl+z")
    assert changed(orbited, desktop.rest()) == 0, "what is left of Ctrl+A does not fly"
    desktop.xdotool("keyup", "a")
    desktop.xdotool("keydown", "w")
    desktop.until("the flight", lambda: changed(orbited, desktop.shot("F2")) > 1000)
    desktop.xdotool("keyup", "w")
    desktop.xdotool("windowsize", "--sync", desktop.window, 900, 650)
    # the window may learn its size after the next key
    shapes = (desktop.shot("F2").shape for _ in range(5))
    assert (650, 900 - panel.WIDTH_PX, 3) in shapes
    desktop.xdotool("key", "ctrl+q")
    assert desktop.process.wait(timeout=PATIENCE_S) == 0
    assert desktop.process.communicate() == ("", "")


@pytest.mark.window
@pytest.mark.gl
@pytest.mark.slow
def test_real_window_is_unchanged_after_it_was_minimized(desktop: Desktop) -> None:
    first = desktop.rest()
    desktop.xdotool("windowunmap", "--sync", desktop.window)  # minimizing unmaps the window
    desktop.until_idle("a window that draws nothing when nobody can see it")
    desktop.xdotool("windowmap", "--sync", desktop.window)
    desktop.xdotool("windowfocus", "--sync", desktop.window)
    assert changed(first, desktop.rest()) == 0
    desktop.drag(slider(0, 0.5), slider(0, 1.0))
    desktop.until("the edit", lambda: changed(first, desktop.shot()) > 200)


@pytest.mark.slow
@pytest.mark.window
@pytest.mark.gl
def test_real_mouse_paints_undo_reverts_and_closing_saves(
    desktop: Desktop,
) -> None:
    desktop.point(*slider(0, 0.5))  # keeps the brush's ring away from the picture
    desktop.xdotool("key", "2")  # the lower card, the scarf
    clean = desktop.rest()
    desktop.xdotool("key", "b", "c")
    colors = desktop.rest()
    assert changed(clean, colors) > 200, "the weights are shown"
    x, y = scarf_on_screen()
    desktop.drag((x - 30, y), (x + 30, y))
    desktop.point(*slider(0, 0.5))
    desktop.until("the stroke", lambda: changed(colors, desktop.shot()) > 100)
    painted = desktop.rest()
    desktop.xdotool("key", "ctrl+z")
    assert changed(colors, desktop.rest()) == 0
    desktop.xdotool("key", "ctrl+shift+z")
    assert changed(painted, desktop.rest()) == 0
    desktop.xdotool("key", "b")
    assert changed(clean, desktop.shot()) > 50, "where it was erased the edit is gone"
    # closing with unsaved changes asks and saves
    bright = brightness(desktop.rest())
    desktop.xdotool("key", "shift+Left")
    desktop.xdotool("key", "ctrl+q")
    # the picture is dimmed behind a question
    desktop.until("the question", lambda: brightness(desktop.shot()) < 0.8 * bright)
    desktop.xdotool("key", "Escape")
    desktop.until("the picture", lambda: brightness(desktop.shot()) > 0.9 * bright)
    desktop.xdotool("key", "ctrl+q")
    desktop.until("the question", lambda: brightness(desktop.shot()) < 0.8 * bright)
    desktop.xdotool("key", "s")
    desktop.until("the field", lambda: not desktop.xdotool("key", "Return") and desktop.process.poll() == 0)
    assert desktop.process.wait(timeout=PATIENCE_S) == 0
    assert desktop.process.communicate() == ("", "")
    saved = open_session(desktop.folder / "bear.session.json")
    assert saved.view.layers[0].strength == pytest.approx(0.4)


def scarf_on_screen() -> tuple[float, float]:
    """Return the window position of the scarf's center in the first view."""
    stack = bear()
    size = (WIDTH - round(panel.WIDTH_PX), HEIGHT)
    camera = to_camera(first_camera(stack.scene), *size)
    middle = stack.scene.means[stack.gdfs[0].region.members].mean(0)
    x, y, z = (camera.viewmat[:3, :3] @ middle + camera.viewmat[:3, 3]).tolist()
    return float(camera.K[0, 0] * x / z + camera.K[0, 2]), float(camera.K[1, 1] * y / z + camera.K[1, 2])


@pytest.mark.window
@pytest.mark.gl
@pytest.mark.slow
def test_escape_cancels_a_drag_of_the_real_mouse(desktop: Desktop) -> None:
    first = desktop.rest()
    desktop.grip(slider(0, 0.5), slider(0, 1.0))
    desktop.until("the edit", lambda: changed(first, desktop.shot()) > 200)
    desktop.xdotool("key", "Escape")
    desktop.point(*slider(0, 0.2))
    desktop.xdotool("mouseup", 1)
    desktop.point(400, 400)  # away from the tooltip
    assert changed(first, desktop.rest()) == 0


@pytest.mark.window
@pytest.mark.gl
@pytest.mark.slow
def test_ctrl_c_in_the_terminal_closes_an_idle_window(desktop: Desktop) -> None:
    desktop.shot()
    desktop.until_idle("a window at rest")
    desktop.process.send_signal(signal.SIGINT)
    assert desktop.process.wait(timeout=PATIENCE_S) == 130
    assert desktop.process.communicate() == ("", "progdf: interrupted\n")


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux can be without a display")
def test_view_without_a_display_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE"):
        monkeypatch.delenv(name, raising=False)
    assert main(["view", str(bear().save(tmp_path)[0])]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith("progdf: no window")
    assert "progdf render" in error


def test_chords_are_named_like_the_bindings() -> None:
    from viewer.ui.window import KEY_NAMES, chord, glfw

    assert chord("Z", glfw.MOD_CONTROL | glfw.MOD_SHIFT) == "Ctrl+Shift+Z"
    assert chord("F2", 0) == "F2"
    assert {name.rpartition("+")[2] for name in KEYS} <= {*NAMES}
    assert {*NAMES} == {*KEY_NAMES.values()}, "what may be bound is what the window tells apart"


@pytest.mark.window
@pytest.mark.gl
@pytest.mark.slow
def test_fast_typing_on_the_real_keyboard_is_complete(desktop: Desktop) -> None:
    desktop.shot()
    desktop.xdotool("keydown", "ctrl")
    desktop.point(*slider(0, 0.2))
    desktop.xdotool("click", 1)
    desktop.xdotool("keyup", "ctrl")
    desktop.xdotool("type", "--delay", "10", "0.1122")
    desktop.xdotool("key", "Return")
    desktop.shot()
    desktop.xdotool("key", "ctrl+s", "Return")
    path = desktop.folder / "bear.session.json"
    desktop.until("the session", path.exists)
    assert open_session(path).view.layers[0].strength == pytest.approx(0.1122)


FIRST_FRAME = """
import sys
from pathlib import Path
from viewer.ui.splash import glfw
swap = glfw.swap_buffers

def first(window):
    loaded = {"torch", "numba", "imgui_bundle"} & {*sys.modules}
    print("glfw of", Path(glfw._glfw._name).parent.name, *loaded, file=sys.stderr)
    glfw.swap_buffers = swap
    swap(window)

glfw.swap_buffers = first
from progdf.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


def view_first(screen: str, *words: object) -> tuple[int, list[str]]:
    """Run `progdf view` in a new process; return its status and its error output.

    The first line names the copy of glfw and the slow imports that are loaded at the first frame.
    """
    command = [sys.executable, "-c", FIRST_FRAME, "view", *map(str, words)]
    environment = os.environ | {"DISPLAY": screen}
    for name in ("WAYLAND_DISPLAY", "PYGLFW_LIBRARY"):
        environment.pop(name, None)
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, cwd=ROOT, timeout=120.0)
    return ran.returncode, ran.stderr.splitlines()


@pytest.mark.slow
@pytest.mark.window
@pytest.mark.gl
def test_window_opens_before_slow_imports(screen: str, tmp_path: Path) -> None:
    scene, edit, *_ = bear().save(tmp_path)
    status, lines = view_first(screen, scene, edit, "--set", "hat=0.5")
    assert status == 2
    # no slow import is loaded, and there is only one copy of glfw, as two copies do not share windows
    assert lines[0] == "glfw of imgui_bundle"
    assert "there is no edit of that name" in lines[1], "then what only the files tell"
    assert len(lines) == 2
    status, lines = view_first(screen, scene, "--blend", "hat")
    assert (status, len(lines)) == (2, 1), "a wrong option opens no window"
