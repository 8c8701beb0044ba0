"""Timeline in the window by mouse and keyboard, and the films made from it."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui
from PIL import Image

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.io.atomic import temporary_subfolder
from tests.helpers.full_disk import files_up_to
from tests.helpers.ui_rig import STEP_S, Rig, bear, center, first_view, rig
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.panel import panel, timeline_bar
from viewer.pictures import film
from viewer.state import timeline
from viewer.state.view_state import Keyframe, Timeline, ViewState
from viewer.ui import overlay

pytestmark = pytest.mark.gl
WINDOW = (1024, 640)
SMALL = ("--size", "64x48", "--engine", "cpu")


def keyed(view: ViewState | None = None, length: int = 40) -> ViewState:
    """Return a view whose timeline turns the scarf green and orbits by 60° in its first half."""
    view = view or first_view(bear(), 0.0, 0.3)
    animation = timeline.with_key(Timeline(length=length), 0, view)
    there = replace(view, camera=replace(view.camera, azimuth=view.camera.azimuth + 60.0))
    layers = (replace(view.layers[0], strength=1.0), view.layers[1])
    animation = timeline.with_key(animation, length // 2, replace(there, layers=layers))
    return replace(
        view, timeline=timeline.set_easing(animation, timeline.keys_at(animation, length // 2), "linear")
    )


@pytest.fixture
def hand(tmp_path: Path) -> Iterator[Rig]:
    with rig(keyed(), WINDOW, pictures=tmp_path) as opened:
        opened.key("T")
        yield opened


def at(hand: Rig, frame: float) -> tuple[float, float]:
    """Return the window position of a frame on the ruler."""
    box = hand.box("ruler")
    shown = hand.main_view.work.view.timeline
    x = timeline_bar.place(shown, frame, box.left + 8.0, box.right - box.left - 16.0)
    return x, center(box)[1]


def frames_of(hand: Rig) -> list[int]:
    return [key.frame for key in hand.main_view.work.view.timeline.keys]


def test_dragging_the_playhead_updates_the_view_without_undo_entries(hand: Rig) -> None:
    before = hand.picture()
    hand.drag(at(hand, 5), at(hand, 20))
    assert hand.main_view.work.player.frame == 20
    assert hand.strengths == [1.0, 0.3]
    assert np.abs(hand.picture().astype(int) - before).max() > 50
    assert hand.main_view.work.past.past == ()


def test_dragging_a_key_moves_it_with_the_playhead_as_one_entry(hand: Rig) -> None:
    hand.drag(at(hand, 20), at(hand, 31))
    assert frames_of(hand) == [0, 31]
    assert hand.main_view.work.player.frame == 31
    assert len(hand.main_view.work.past.past) == 1
    hand.key("Ctrl+Z")
    assert frames_of(hand) == [0, 20]


def test_click_on_a_key_moves_the_playhead_and_delete_removes_it(hand: Rig) -> None:
    hand.drag(at(hand, 20.4), at(hand, 20.4))
    assert (hand.main_view.work.player.frame, frames_of(hand)) == (20, [0, 20])
    hand.key("Delete")
    assert frames_of(hand) == [0]
    hand.key("Ctrl+Z")
    assert frames_of(hand) == [0, 20]


def test_k_after_a_slider_drag_sets_a_key_and_two_undos_revert_both(hand: Rig) -> None:
    hand.key(".")
    hand.drag(hand.slider(1, 0.3), hand.slider(1, 0.9))
    hand.key("K")
    assert frames_of(hand) == [0, 1, 20]
    assert dict(hand.main_view.work.view.timeline.keys[1].strengths)[1] == pytest.approx(0.9, abs=0.01)
    hand.key("Ctrl+Z")
    assert frames_of(hand) == [0, 20]
    hand.key("Ctrl+Z")
    assert hand.strengths[1] == 0.3


def test_space_plays_at_the_film_rate_pauses_and_then_idles(hand: Rig) -> None:
    hand.key("Space")
    started = hand.main_view.work.player.frame
    hand.frame(30)
    assert hand.main_view.work.player.frame - started == pytest.approx(30 * STEP_S * 24, abs=1)
    waits = hand.main_view.next_frame_delay()
    assert waits is not None
    assert 0.0 < waits <= 1 / 24, "it sleeps until the next frame of the film, not less"
    hand.key("Space")
    paused = hand.main_view.work.player.frame
    drawn = hand.main_view.canvas.pictures_drawn
    hand.frame(60)
    assert (hand.main_view.work.player.frame, hand.main_view.canvas.pictures_drawn) == (paused, drawn)
    assert hand.main_view.next_frame_delay() is None
    assert hand.main_view.work.past.past == ()


def test_no_splats_are_drawn_between_two_film_frames(hand: Rig) -> None:
    hand.key("Space")
    drawn = hand.main_view.canvas.pictures_drawn
    frame = hand.main_view.work.player.frame
    hand.frame(60)
    assert hand.main_view.canvas.pictures_drawn - drawn <= (hand.main_view.work.player.frame - frame) % 41 + 1


def test_comma_and_period_step_and_with_shift_jump_between_keys(hand: Rig) -> None:
    seen = []
    for chord in (".", ".", ",", "Shift+.", "Shift+.", "Shift+,"):
        hand.key(chord)
        seen.append(hand.main_view.work.player.frame)
    assert seen == [1, 2, 1, 20, 40, 20]


def test_buttons_of_the_bar_work(hand: Rig) -> None:
    hand.drag(at(hand, 30), at(hand, 30))
    for button, expected in (("key", [0, 20, 30]), ("drop_key", [0, 20])):
        hand.click(*hand.at(button))
        assert frames_of(hand) == expected
    hand.click(*hand.at("play"))
    assert hand.main_view.work.player.playing
    hand.key("Space")
    hand.click(*hand.at("easing"))
    assert hand.main_view.work.view.timeline.keys[0].easing != keyed().timeline.keys[0].easing or (
        hand.main_view.work.view.timeline.keys[1].easing != "linear"
    )
    hand.click(*hand.at("ping_pong"))
    assert hand.main_view.work.view.timeline.ping_pong
    x, y = hand.at("length")
    hand.drag((x, y), (x + 40.0, y))
    assert hand.main_view.work.view.timeline.length > 40


def row(hand: Rig, number: int, frame: float) -> tuple[float, float]:
    """Return the window position of a frame in a row; row 0 is the camera, then the layers in panel order."""
    tall = timeline_bar.TRACK_PX
    top = WINDOW[1] - timeline_bar.height(hand.main_view.work, overlay.Area(724, 640), hand.main_view.ui)
    return at(hand, frame)[0], top + timeline_bar.HEIGHT_PX - 6.0 + tall * (number + 0.5)


def test_key_of_a_row_is_dragged_copied_and_deleted_alone(hand: Rig) -> None:
    hand.key("Alt+T")
    before = hand.main_view.work.view.timeline

    def frames() -> dict[int, list[int]]:
        keys = sorted(timeline.split_keys(hand.main_view.work.view.timeline))
        return {r: [f for other, f in keys if other == r] for r, _ in keys}

    assert frames() == {-1: [0, 20], 0: [0, 20], 1: [0, 20]}
    hand.drag(row(hand, 2, 20), row(hand, 2, 30))  # the scarf is the lower layer
    assert frames() == {-1: [0, 20], 0: [0, 30], 1: [0, 20]}
    hand.modifier(imgui.Key.mod_ctrl)
    hand.drag(row(hand, 0, 20), row(hand, 0, 35))
    hand.modifier(imgui.Key.mod_ctrl, down=False)
    assert frames() == {-1: [0, 20, 35], 0: [0, 30], 1: [0, 20]}
    assert len(hand.main_view.work.past.past) == 2
    hand.key("Delete")
    assert frames() == {-1: [0, 20], 0: [0, 30], 1: [0, 20]}
    hand.drag(row(hand, 1, 20), row(hand, 1, 20))
    hand.key("Ctrl+C")
    hand.drag(at(hand, 8), at(hand, 8))
    hand.key("Ctrl+V")
    assert frames()[1] == [0, 8, 20]
    for _ in range(4):
        hand.key("Ctrl+Z")
    assert hand.main_view.work.view.timeline == before


def test_auto_key_keys_only_the_dragged_slider(hand: Rig) -> None:
    hand.drag(at(hand, 30), at(hand, 30))
    hand.key("Ctrl+Alt+K")
    hand.drag(hand.slider(1, hand.strengths[1]), hand.slider(1, 0.75))
    keys = timeline.split_keys(hand.main_view.work.view.timeline)
    assert [key for key in keys if key[1] == 30] == [(1, 30)]
    assert keys[1, 30].strengths[0][1] == hand.strengths[1] > 0.6


def test_bar_and_film_agree_on_the_number_of_frames(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    real = imgui.drag_int
    shown = {}
    monkeypatch.setattr(imgui, "drag_int", lambda *a: shown.update({a[0]: a[1]}) or real(*a))
    hand.frame()
    assert shown["##length"] == len(list(timeline.film_frames(hand.main_view.work.view.timeline))) == 41


def test_drag_on_the_bar_does_not_orbit_the_camera(hand: Rig) -> None:
    camera = hand.main_view.work.view.camera
    hand.drag((300.0, WINDOW[1] - 4.0), (380.0, WINDOW[1] - 4.0))
    assert hand.main_view.work.view.camera == camera


def test_hiding_the_interface_hides_the_bar(hand: Rig) -> None:
    hand.key("F12")
    shown = hand.image()[-40:, :100]
    with rig(keyed(), WINDOW) as bare:
        bare.key("F12")
        assert np.array_equal(shown, bare.image()[-40:, :100])


def save_session(path: Path, view: ViewState) -> None:
    """Save a session of the bear, with scene and edits beside it."""
    scene, *gdfs = bear().save(path.parent)
    session.save(path, WindowSession(document.load(scene, gdfs), view))


def test_render_writes_the_frames_that_the_window_showed(hand: Rig, tmp_path: Path) -> None:
    view = hand.main_view.work.view
    save_session(tmp_path / "film.session.json", view)
    command = ("render", str(tmp_path / "film.session.json"), "--timeline", *SMALL)
    assert main([*command, "-o", str(tmp_path / "shown")]) == 0
    assert main([*command, "-o", str(tmp_path / "again")]) == 0
    names = sorted(path.name for path in (tmp_path / "shown").iterdir())
    assert names == [f"frame_{i:04d}.png" for i in range(41)]
    shown = tmp_path / "shown"
    again = tmp_path / "again"
    assert all((shown / n).read_bytes() == (again / n).read_bytes() for n in names)
    for frame in (0, 13, 20):
        state = timeline.state_at(view.timeline, frame, view)
        expected = film.to_pixels(hand.main_view.engine.image(state, (64, 48)))
        found = np.asarray(Image.open(shown / f"frame_{frame:04d}.png"))
        assert np.abs(found.astype(int) - expected).max() <= 1


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Run `progdf render` on a film of the scarf in four frames with a still camera."""
    monkeypatch.chdir(tmp_path)
    keys = (Keyframe(0, ((0, 0.0),)), Keyframe(3, ((0, 1.0),), easing="linear"))
    view = first_view(bear(), 0.0, 0.0)
    save_session(Path("film.session.json"), replace(view, timeline=Timeline(keys, 3, fps=24)))
    given = ("render", "film.session.json", "--timeline", *SMALL)
    return lambda *arguments: main([*given, *arguments])


def test_gif_keeps_the_average_frame_rate(run: Callable[..., int]) -> None:
    assert run("--orbit", "20,15", "-o", "film.gif") == 0
    with Image.open("film.gif") as animation:
        durations = []
        for frame in range(getattr(animation, "n_frames", 1)):
            animation.seek(frame)
            durations.append(animation.info["duration"])
    assert sum(durations) == 170, "four times 1/24 s, in hundredths"


def test_mp4_has_every_frame_at_its_size(run: Callable[..., int]) -> None:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        pytest.skip("the extra video is not installed")
    import imageio_ffmpeg

    assert run("-o", "film.mp4") == 0
    assert imageio_ffmpeg.count_frames_and_secs("film.mp4")[0] == 4
    reader = imageio_ffmpeg.read_frames("film.mp4")
    facts = next(reader)
    pictures = [np.frombuffer(frame, np.uint8).reshape(48, 64, 3) for frame in reader]
    assert (facts["size"], facts["fps"]) == ((64, 48), 24.0)
    assert run("-o", "frames") == 0
    for i, picture in enumerate(pictures):
        expected = np.asarray(Image.open(f"frames/frame_{i:04d}.png")).astype(float)
        assert np.abs(picture - expected).mean() < 8.0, "the same pictures, as well as H.264 keeps them"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("-o", "film.png"), "film.png cannot hold a film"),
        (("-o", "taken"), "taken exists and is not an empty folder"),
        (("-o", "none/frames"), "does not exist"),
        (("-o", "/proc/frames"), "/proc/frames cannot be written ("),
        (("-o", "dangling"), "dangling exists and is not an empty folder"),
        (("-o", "x.gif", "--sweep", "scarf"), "cannot be combined"),
    ],
)
def test_failed_film_is_one_line_and_leaves_no_file(
    arguments: tuple[str, ...], told: str, run: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    Path("taken").mkdir()
    Path("taken/notes.txt").write_text("mine")
    Path("dangling").symlink_to("nowhere")
    before = sorted(Path().iterdir())
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert sorted(Path().iterdir()) == before


def test_film_with_camera_keys_rejects_camera_options(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_session(tmp_path / "moving.session.json", keyed())
    command = ("render", str(tmp_path / "moving.session.json"), "--timeline", "--orbit", "0,0")
    assert main([*command, "-o", str(tmp_path / "x.gif")]) == 2
    assert "--timeline moves the camera; leave out --camera, --orbit" in capsys.readouterr().err


def test_empty_folder_is_filled_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder behind a link and the current folder cannot be moved aside and replaced."""
    frames = [np.zeros((4, 4, 3), np.uint8)] * 2
    for folder in ("linked", "here"):
        (tmp_path / folder).mkdir()
    (tmp_path / "link").symlink_to("linked")
    monkeypatch.chdir(tmp_path / "here")
    for given, filled in ((tmp_path / "link", "linked"), (Path(), "here")):
        film.write_sequence(given, frames)
        names = sorted(path.name for path in (tmp_path / filled).iterdir())
        assert names == ["frame_0000.png", "frame_0001.png"]
    assert (tmp_path / "link").is_symlink()


def test_frames_of_a_killed_export_are_cleaned_up(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    folder = tmp_path / "frames"
    folder.mkdir()
    mine = temporary_subfolder(folder)
    left = mine.rename(mine.with_name(mine.name.replace(f"-{os.getpid()}-", f"-{gone.pid}-")))
    (left / "frame_0000.png").touch()
    film.write_sequence(folder, [np.zeros((4, 4, 3), np.uint8)])
    assert [path.name for path in folder.iterdir()] == ["frame_0000.png"]


@pytest.mark.parametrize("there", [False, True])
def test_failing_frames_leave_nothing(tmp_path: Path, there: bool) -> None:
    folder = tmp_path / "frames"
    if there:
        folder.mkdir()

    def torn() -> Iterator[film.Pixels]:
        yield np.zeros((4, 4, 3), np.uint8)
        raise ProgdfError("no more")

    with pytest.raises(ProgdfError):
        film.write_sequence(folder, torn())
    assert list(tmp_path.rglob("*")) == [folder] * there


def test_full_disk_is_one_line_and_leaves_no_folder(tmp_path: Path) -> None:
    with files_up_to(20), pytest.raises(ProgdfError, match=r"frames cannot be written \("):
        film.write_sequence(tmp_path / "frames", [np.zeros((4, 4, 3), np.uint8)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("software_gpu")
def test_screenshot_of_the_timeline(screenshot: Callable[[str, np.ndarray], None]) -> None:
    with rig(keyed(), WINDOW) as hand:
        hand.key("T")
        hand.drag(at(hand, 5), at(hand, 12))
        hand.move(500.0, 300.0)
        hand.frame(3)
        screenshot("ui_timeline", hand.image()[-240:, : WINDOW[0] - round(panel.WIDTH_PX)])
