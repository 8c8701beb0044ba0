"""Session files: what the window held comes back, and nothing else does."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from null_app import null_app, press
from PIL import Image
from ui_rig import bear, first_view, rig

from progdf.__main__ import main
from progdf.camera_files import save_cameras
from progdf.errors import ProgdfError
from progdf.info import kind_of
from progdf.layers import Gains
from progdf.ply import save_ply
from progdf.session_file import read_session, sha256
from viewer import app as application
from viewer import desk, document, paint, plain, recent, session, snapshots, workspace
from viewer.session import Session
from viewer.state import Comparison, Keyframe, Timeline, ViewState
from viewer.turntable import eye, from_camera, to_camera


def full_view() -> ViewState:
    """A view in which nothing is as it is by default."""
    view = first_view(bear(), 0.25, 0.75)
    ears = bear().gdfs[1].region
    painted = paint.encoded(np.linspace(0, 1, len(ears)))
    layers = (
        replace(view.layers[1], name="ears → gold", gains=Gains(0.5, 0.25, 0.125), solo=True, paint=painted),
        replace(view.layers[0], enabled=False),
    )
    camera = replace(view.camera, azimuth=33.5, mode="fly")
    film = Timeline((Keyframe(3, ((0, 0.5),), camera, "linear"),), length=30)
    compare = Comparison("split", 0.3, 8.0)
    return replace(view, layers=layers, camera=camera, blend="over", compare=compare, timeline=film)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "edits").mkdir()
    scene, *edits = bear().save(tmp_path)
    for edit in edits:
        edit.rename(tmp_path / "edits" / edit.name)
    assert scene.name == "bear.ply"
    return tmp_path


def opened_document(folder: Path) -> document.Document:
    return document.load(folder / "bear.ply", [folder / "edits" / f"{g.name}.gdf" for g in bear().gdfs])


@pytest.fixture
def saved(folder: Path) -> Path:
    view = full_view()
    kept = snapshots.taken((), replace(view, blend="sum"))
    session.save(folder / "work.session.json", Session(opened_document(folder), view, kept))
    return folder / "work.session.json"


def test_a_session_brings_back_exactly_what_was_saved(saved: Path) -> None:
    again = session.open_session(saved)
    assert again.view == full_view()
    assert [kept.edit.blend for kept in again.snapshots] == ["sum"]
    assert [gdf.name for gdf in again.document.gdfs] == ["scarf", "ears"]


def test_a_session_can_be_read_by_people_and_moves_with_its_folder(saved: Path, tmp_path: Path) -> None:
    table = json.loads(saved.read_text())
    assert next(iter(table)) == "progdf_session"
    assert table["scene"] == {"file": "bear.ply", "sha256": sha256(saved.parent / "bear.ply")}
    assert [edit["file"] for edit in table["edits"]] == ["edits/scarf.gdf", "edits/ears.gdf"]
    assert '"up": [0.0, 1.0, 0.0]' in saved.read_text()
    assert str(tmp_path) not in saved.read_text()
    elsewhere = tmp_path.with_name(tmp_path.name + "_moved")
    tmp_path.rename(elsewhere)
    assert session.open_session(elsewhere / saved.name).view == full_view()
    elsewhere.rename(tmp_path)


def spoilt(path: Path, *keys: str | int, value: Any = None, **more: Any) -> Path:
    """The session with another value at a place, under another name."""
    table = json.loads(path.read_text())
    place = table
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    other = path.with_name("spoilt.session.json")
    other.write_text(json.dumps(table))
    return other


BROKEN: list[tuple[tuple[str | int, ...], Any, str]] = [
    (("progdf_session",), 2, "version 2"),
    (("progdf_session",), "one", "version"),
    (("macros",), ["import os"], "macros"),
    (("scene",), "bear.ply", "scene"),
    (("scene", "file"), "gone.ply", "not there"),
    (("scene", "sha256"), "0" * 64, "another bear.ply"),
    (("edits", 1, "sha256"), "0" * 64, "another ears.gdf"),
    (("edits",), [], "layers[0].gdf is 1 of 0"),
    (("view",), [], "wrong form"),
    (("view", "blur"), 3, "view.blur is unknown"),
    (("view", "camera", "distance"), 0.0, "view.camera.distance"),
    (("view", "camera", "distance"), 1e400, "Infinity"),
    (("view", "camera", "mode"), "walk", "walk"),
    (("view", "camera", "up"), [0.0, 1.0], "view.camera.up"),
    (("view", "layers", 0, "strength"), 3.0, "strength"),
    (("view", "layers", 0, "strength"), "1", "strength"),
    (("view", "layers", 0, "enabled"), 1, "enabled"),
    (("view", "layers", 0, "gains", "colour"), -1.0, "gains"),
    (("view", "layers", 0, "paint"), "AAAA", "paint"),
    (("view", "brush", "mode"), "spray", "spray"),
    (("view", "brush", "radius"), 0.0, "radius"),
    (("view", "blend"), "multiply", "multiply"),
    (("view", "compare", "mode"), "blink", "blink"),
    (("view", "compare", "amplify"), 1e9, "amplify"),
    (("view", "timeline", "keys", 0, "easing"), "bouncy", "easing"),
    (("view", "timeline", "length"), -5, "length"),
    (("view", "timeline", "keys", 0, "camera", "distance"), -1.0, "distance"),
    (("snapshots", 0, "edit", "blend"), "none", "none"),
    (("snapshots",), {"a": 1}, "wrong form"),
]


@pytest.mark.parametrize(("keys", "value", "about"), BROKEN)
def test_what_no_window_wrote_is_refused_in_one_line(
    saved: Path, keys: tuple[str | int, ...], value: Any, about: str
) -> None:
    with pytest.raises(ProgdfError) as refused:
        session.open_session(spoilt(saved, *keys, value=value))
    told = str(refused.value)
    assert about in told
    assert "\n" not in told
    assert "; " in told


@pytest.mark.parametrize(
    "content",
    [b"{", b"[1]", b"{}", b"\xff\xfe", b'{"progdf_session": 1, "progdf_session": 1}', b"[" * 99_999],
)
def test_what_is_no_session_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "odd.session.json").write_bytes(content)
    with pytest.raises(ProgdfError) as refused:
        read_session(tmp_path / "odd.session.json")
    assert "\n" not in str(refused.value)


def test_a_scene_that_changed_since_is_refused_by_name(saved: Path) -> None:
    save_ply(saved.parent / "bear.ply", bear().scene[:-1])
    with pytest.raises(ProgdfError, match=r"saved with another bear\.ply"):
        session.open_session(saved)


def test_what_an_older_file_does_not_hold_has_its_default(saved: Path) -> None:
    table = json.loads(saved.read_text())
    del table["view"]["compare"], table["view"]["camera"]["fov_y"], table["snapshots"]
    saved.write_text(json.dumps(table))
    again = session.open_session(saved)
    assert again.view.compare == Comparison()
    assert again.view.camera.fov_y == 45.0
    assert again.snapshots == ()


def test_arrays_come_back_bit_for_bit() -> None:
    for array in (np.linspace(0, 1, 7, dtype=np.float32), np.zeros((0, 3), np.uint8)):
        packed = json.loads(json.dumps(plain.plain(array)))
        again = plain.restored(np.ndarray, packed)
        assert again.dtype == array.dtype
        assert np.array_equal(again, array)
    with pytest.raises(plain.NotPlainError):
        plain.restored(np.ndarray, {"dtype": "O", "shape": [1], "zlib": ""})
    with pytest.raises(plain.NotPlainError):
        plain.restored(np.ndarray, {"dtype": "<f4", "shape": [1 << 40], "zlib": ""})


def test_a_save_that_fails_leaves_the_old_session(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    broken = replace(full_view(), background=(float("nan"), 0.0, 0.0))
    with pytest.raises(ValueError, match="JSON"):
        session.save(saved, Session(opened_document(saved.parent), broken))
    assert saved.read_bytes() == before
    assert not list(saved.parent.glob(".*"))


def test_info_tells_what_a_session_holds(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kind_of(saved) == "session"
    (saved.parent / "edits" / "ears.gdf").unlink()
    assert main(["info", str(saved)]) == 0
    told = capsys.readouterr().out
    assert "bear.ply (as it was saved)" in told
    assert "ears.gdf (missing)" in told
    assert "ears → gold" in told
    assert "snapshots: 1" in told


def test_render_draws_a_session_as_the_window_showed_it(saved: Path, tmp_path: Path) -> None:
    view = replace(full_view(), compare=Comparison())
    session.save(saved, Session(opened_document(saved.parent), view))
    out, size = tmp_path / "a.png", ("--size", "64x48", "--engine", "cpu")
    assert main(["render", "--session", str(saved), *size, "-o", str(out)]) == 0
    from viewer.engine import Engine

    engine = Engine(None, bear().scene, bear().gdfs)
    expected = np.round(engine.image(view, (64, 48)).clip(0, 1) * 255)
    assert np.abs(np.asarray(Image.open(out)).astype(int) - expected).max() <= 1
    moved = replace(view, layers=(replace(view.layers[0], strength=0.0), view.layers[1]))
    assert main(["render", "--session", str(saved), "--set", "ears=0", *size, "-o", str(out)]) == 0
    expected = np.round(engine.image(moved, (64, 48)).clip(0, 1) * 255)
    assert np.abs(np.asarray(Image.open(out)).astype(int) - expected).max() <= 1


def test_an_option_that_a_session_says_itself_is_refused(
    saved: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["render", "--session", str(saved), "--blend", "sum", "-o", "a.png"]) == 2
    assert "--blend was given" in capsys.readouterr().err


def test_snapshots_are_one_undo_entry_to_go_back_to_and_begin_with_the_original() -> None:
    work = workspace.opened(first_view(bear(), 0.5, 0.5))
    facts = application.Document("bear.ply", bear().scene, bear().gdfs).facts()

    def act(work: workspace.Workspace, action: str) -> workspace.Workspace:
        return workspace.settled(workspace.perform(work, action, facts))

    work = act(work, "snapshot")
    assert act(work, "snapshot").snapshots == work.snapshots, "the same twice is once"
    work = act(work, "nudge:0.25")
    work = act(work, "snapshot")
    assert [s.name for s in snapshots.shown(work.snapshots, work.view)] == ["original", "1", "2"]
    entries = len(work.past.past)
    back = act(work, "restore:1")
    assert [layer.strength for layer in back.view.layers] == [0.5, 0.5]
    assert back.view.blend == work.view.blend
    assert len(back.past.past) == entries + 1
    assert act(back, "undo").view == work.view
    assert [layer.strength for layer in act(work, "restore:0").view.layers] == [0.0, 0.0]
    assert [s.name for s in act(work, "forget:1").snapshots] == ["2"]


def test_going_back_keeps_edits_that_were_opened_since_at_zero() -> None:
    view = first_view(bear(), 0.5, 0.5)
    kept = snapshots.taken((), replace(view, layers=view.layers[:1]))
    back = snapshots.back_to(view, kept[0])
    assert [(layer.name, layer.strength) for layer in back.layers] == [("scarf", 0.5), ("ears", 0.0)]


def test_recent_files_are_remembered_the_last_one_first(tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.ply", "b.gdf", "c.ply")]
    for file in files:
        file.touch()
    recent.remember(files[:2], tmp_path / "memory")
    assert recent.remember([files[2], files[0]], tmp_path / "memory") == (files[0], files[2], files[1])
    files[2].unlink()
    assert recent.read(tmp_path / "memory") == (files[0], files[1])
    (tmp_path / "blocked").touch()
    assert recent.remember([files[0]], tmp_path / "blocked") == (files[0],), "no place for it is no error"


@pytest.fixture
def window(folder: Path, saved: Path) -> Iterator[application.App]:
    """The application with files."""
    with null_app(opened_document(folder), first_view(bear(), 0.5, 0.5), folder) as app:
        yield app


def message(app: application.App) -> str:
    return app.stage.work.message.text if app.stage.work.message else ""


@pytest.mark.gl
def test_ctrl_s_asks_where_once_and_then_saves_there(window: application.App, folder: Path) -> None:
    press(window, "Ctrl+S")
    asked = window.stage.work.dialog
    assert asked is not None
    assert asked.text == str(folder / "bear.session.json")
    press(window, "Enter")
    assert window.stage.work.dialog is None
    assert (folder / "bear.session.json").is_file()
    assert "Saved" in message(window)
    press(window, "Shift+Left")
    assert window.desk.unsaved
    press(window, "Ctrl+S")
    assert not window.desk.unsaved
    again = session.open_session(folder / "bear.session.json")
    assert again.view.layers == window.stage.work.view.layers


@pytest.mark.gl
def test_keys_do_nothing_behind_a_question_and_escape_takes_it_away(window: application.App) -> None:
    press(window, "Ctrl+O", "V", "Shift+Left")
    assert window.stage.work.view.camera.mode == "orbit"
    assert window.stage.work.view.layers[0].strength == 0.5
    press(window, "Escape")
    assert window.stage.work.dialog is None
    press(window, "V")
    assert window.stage.work.view.camera.mode == "fly"


@pytest.mark.gl
def test_a_path_typed_into_the_field_is_opened(window: application.App, saved: Path) -> None:
    from imgui_bundle import imgui

    press(window, "Ctrl+O")
    imgui.get_io().add_input_characters_utf8(str(saved))
    for _ in range(3):
        window.draw()
    press(window, "Enter")
    assert window.stage.work.view == full_view()
    assert window.desk.path == saved
    assert [s.name for s in window.stage.work.snapshots] == ["1"]


@pytest.mark.gl
def test_quitting_asks_only_when_something_would_be_lost(window: application.App, folder: Path) -> None:
    press(window, "Ctrl+Q")
    assert window._left
    window._left = False
    press(window, "Shift+Left", "Ctrl+Q")
    asked = window.stage.work.dialog
    assert asked is not None
    assert asked.kind == "leave"
    press(window, "Escape")
    assert not window._left
    press(window, "Ctrl+Q", "S", "Enter")  # save, under the name that is offered
    assert (folder / "bear.session.json").is_file()
    assert window._left


@pytest.mark.gl
def test_discarding_leaves_and_writes_nothing(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left", "Ctrl+Q", "D")
    assert window._left
    assert not (folder / "bear.session.json").exists()


@pytest.mark.gl
def test_unsaved_work_is_autosaved_beside_and_taken_away_once_saved(
    window: application.App, folder: Path
) -> None:
    assert window.desk.autosave(0.0) is None, "nothing to lose"
    press(window, "Shift+Left")
    waits = window.desk.autosave(10.0)
    assert waits == desk.AUTOSAVE_S
    beside = folder / "bear.autosave.session.json"
    assert not beside.exists()
    assert window.desk.autosave(10.0 + desk.AUTOSAVE_S) is None
    assert session.open_session(beside).view.layers == window.stage.work.view.layers
    assert window.desk.autosave(99.0) is None, "the same again is not written again"
    window.desk.save(folder / "bear.session.json")
    assert not beside.exists()


@pytest.mark.gl
def test_an_autosave_opens_as_unsaved_work_of_its_session(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left")
    window.desk.autosave(0.0)
    window.desk.autosave(desk.AUTOSAVE_S)
    beside = folder / "bear.autosave.session.json"
    kept = beside.read_bytes()
    window.desk.serve("discard")
    window.desk.save(folder / "bear.session.json")
    beside.write_bytes(kept)
    window.open(folder / "bear.session.json")
    assert "Unsaved work was kept in bear.autosave.session.json" in message(window)
    window.open(beside)
    assert window.desk.path == folder / "bear.session.json"
    assert window.desk.unsaved


@pytest.mark.gl
def test_files_are_told_apart_by_content_however_they_are_called(
    window: application.App, folder: Path, saved: Path
) -> None:
    saved.rename(folder / "session.txt")
    window.open(folder / "session.txt")
    assert window.stage.work.view == full_view(), message(window)
    (folder / "edits" / "scarf.gdf").rename(folder / "scarf.bin")
    window.open(folder / "scarf.bin")
    assert [layer.name for layer in window.stage.work.view.layers][-1] == "scarf-2", message(window)
    window.desk.serve("discard")
    (folder / "bear.ply").rename(folder / "scene.dat")
    window.open(folder / "scene.dat")
    assert window.stage.facts.title == "scene.dat", message(window)


@pytest.mark.gl
def test_a_dropped_camera_file_is_looked_through(window: application.App, folder: Path) -> None:
    camera = bear().demo.cameras[2]
    save_cameras(folder / "cameras.json", [camera])
    window.open(folder / "cameras.json")
    shown = to_camera(window.stage.work.view.camera, camera.width, camera.height)
    assert np.abs(shown.viewmat.numpy() - camera.viewmat.numpy()).max() < 1e-4
    assert np.abs(shown.K.numpy() - camera.K.numpy()).max() < 1e-2


@pytest.mark.gl
def test_a_scene_dropped_on_unsaved_work_asks_first(window: application.App, folder: Path) -> None:
    save_ply(folder / "half.ply", bear().scene[:700])
    press(window, "Shift+Left")
    window.open(folder / "half.ply")
    window.draw()
    assert window.stage.facts.title == "bear.ply"
    press(window, "D")
    assert window.stage.facts.title == "half.ply"
    assert window.stage.work.dialog is None
    assert window.stage.recent[0] == folder / "half.ply"


@pytest.mark.gl
def test_a_session_for_another_scene_changes_nothing_and_is_one_line(
    window: application.App, folder: Path, saved: Path
) -> None:
    before = window.stage.work.view
    window.open(spoilt(saved, "scene", "sha256", value="0" * 64))
    assert window.stage.work.view == before
    assert "saved with another bear.ply" in message(window)


@pytest.mark.gl
def test_saving_never_writes_over_another_kind_of_file(window: application.App, folder: Path) -> None:
    save_cameras(folder / "cameras.json", list(bear().demo.cameras[:1]))
    before = (folder / "cameras.json").read_bytes()
    window.desk.serve(f"save_to:{folder / 'cameras.json'}")
    assert (folder / "cameras.json").read_bytes() == before
    assert "no session" in message(window)


@pytest.mark.gl
def test_a_click_on_a_small_picture_goes_back_to_its_snapshot_and_a_right_click_forgets_it() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (1024, 640)) as hand:
        first = hand.picture()
        for chord in ("F3", "Shift+Left", "Shift+Left", "F3"):
            hand.key(chord)
        hand.wheel(900.0, 400.0, -100.0)
        hand.frame(5)
        assert hand.stage.patience() is None, "the small pictures are there"
        entries, drawn = len(hand.stage.work.past.past), hand.image()[515:565, 745:1005]
        assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 500, "pictures, not empty cards"
        hand.move(874.0, 540.0)
        hand.press()
        hand.release()
        assert hand.strengths == [0.5, 0.5]
        assert np.array_equal(hand.picture(), first)
        assert len(hand.stage.work.past.past) == entries + 1
        hand.press(1)
        hand.release(1)
        assert [kept.name for kept in hand.stage.work.snapshots] == ["2"]


def test_a_pinhole_camera_becomes_the_windows_camera() -> None:
    view = first_view(bear()).camera
    seen = to_camera(view, 320, 240)
    again = from_camera(view, seen, application.Document("b", bear().scene).facts().bounds)
    assert eye(again) == pytest.approx(eye(view), abs=1e-4)
    assert again.fov_y == pytest.approx(view.fov_y, abs=1e-3)


def test_what_draws_without_a_window_needs_no_interface_library() -> None:
    code = "import sys, viewer.cli; print([m for m in sys.modules if 'imgui' in m or m == 'glfw'])"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"
