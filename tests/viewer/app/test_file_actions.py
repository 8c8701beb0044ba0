"""File actions of the window: questions, saving, opening, dropped files and recent files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui

from progdf.formats.ply import save_ply
from progdf.io.atomic import state_folder
from progdf.io.cameras import load_cameras, save_cameras
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import full_view, opened_document, spoilt
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.camera.view_camera import to_camera
from viewer.files import exports, session
from viewer.files.user_files import read_recent, remember_recent
from viewer.state import workspace
from viewer.state.commands import Plain, ReplaceEdit, WithText
from viewer.state.workspace import Dialog


@pytest.fixture
def window(folder: Path, saved: Path) -> Iterator[application.App]:
    """Yield the application with the bear's files."""
    with null_app(opened_document(folder), first_view(bear(), 0.5, 0.5), folder) as app:
        yield app


def message(app: application.App) -> str:
    return app.main_view.work.message.text if app.main_view.work.message else ""


def question(app: application.App) -> Dialog:
    assert app.main_view.work.dialog is not None
    return app.main_view.work.dialog


def test_recent_files_are_the_last_twelve_scenes_and_sessions(tmp_path: Path) -> None:
    files = [tmp_path / f"{i}.{kind}" for i, kind in enumerate(["ply", "session.json", "spz"] * 5)]
    others = [tmp_path / name for name in ("e.gdf", "1.autosave.session.json", "1.discarded-2.session.json")]
    for file in (*files, *others):
        file.touch()
    state_folder().mkdir(parents=True)
    (state_folder() / "recent.txt").write_text("".join(f"{file}\n" for file in others))  # of an older version
    assert read_recent() == ()
    for file in (*files, *others):
        remember_recent([file])
    assert read_recent() == tuple(files[:-13:-1])


def test_recent_files_are_listed_newest_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [tmp_path / name for name in ("a.ply", "b.session.json", "c.ply")]
    for file in files:
        file.touch()
    remember_recent(files[:2])
    assert remember_recent([files[2], files[0]]) == (
        files[0],
        files[2],
        files[1],
    )
    files[2].unlink()
    assert read_recent() == (files[0], files[1])
    (tmp_path / "blocked").touch()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "blocked"))
    assert remember_recent([files[0]]) == (files[0],), "no place for it is no error"


@pytest.mark.gl
def test_ctrl_s_asks_for_a_path_once_and_then_saves_there(window: application.App, folder: Path) -> None:
    press(window, "Ctrl+S")
    assert question(window).text == str(folder / "bear.session.json")
    press(window, "Enter")
    assert window.main_view.work.dialog is None
    assert (folder / "bear.session.json").is_file()
    assert "Saved" in message(window)
    press(window, "Shift+Left")
    assert window.parts.file_actions.has_unsaved
    press(window, "Ctrl+S")
    assert not window.parts.file_actions.has_unsaved
    again = session.open_session(folder / "bear.session.json")
    assert again.view.layers == window.main_view.work.view.layers


@pytest.mark.gl
def test_keys_do_nothing_behind_a_question_and_escape_closes_it(window: application.App) -> None:
    press(window, "Ctrl+O", "V", "Shift+Left")
    assert window.main_view.work.view.camera.mode == "orbit"
    assert window.main_view.work.view.layers[0].strength == 0.5
    press(window, "Escape")
    assert window.main_view.work.dialog is None
    press(window, "V")
    assert window.main_view.work.view.camera.mode == "fly"


@pytest.mark.gl
def test_typed_path_is_opened(window: application.App, saved: Path) -> None:
    press(window, "Ctrl+O")
    imgui.get_io().add_input_characters_utf8(str(saved))
    for _ in range(3):
        window.draw()
    press(window, "Enter")
    assert window.main_view.work.view == full_view()
    assert window.parts.file_actions.path == saved
    assert [s.name for s in window.main_view.work.snapshots] == ["1"]


@pytest.mark.gl
def test_wrong_path_stays_in_the_open_dialog(window: application.App, saved: Path) -> None:
    window.handle(Plain("open"))
    window.handle(WithText("open_file", "/nowhere/at all.ply"))
    assert question(window).text == "/nowhere/at all.ply"
    assert "at all.ply" in question(window).error
    window.handle(WithText("open_file", str(saved)))
    assert window.main_view.work.dialog is None
    assert window.parts.file_actions.path == saved


@pytest.mark.gl
def test_background_of_a_session_ends_with_it(window: application.App, folder: Path, saved: Path) -> None:
    window.parts.file_actions.open(saved)
    assert window.main_view.work.view.background != (1.0, 1.0, 1.0)
    window.parts.file_actions.open(folder / "bear.ply")
    assert window.main_view.work.view.background == (1.0, 1.0, 1.0)


@pytest.mark.gl
def test_quitting_asks_only_with_unsaved_changes(window: application.App, folder: Path) -> None:
    press(window, "Ctrl+Q")
    assert window.is_closed
    window.is_closed = False
    press(window, "Shift+Left", "Ctrl+Q")
    assert question(window).kind == "leave"
    press(window, "Escape")
    assert not window.is_closed
    press(window, "Ctrl+Q", "S", "Enter")  # save under the suggested name
    assert (folder / "bear.session.json").is_file()
    assert window.is_closed


@pytest.mark.gl
def test_discarding_closes_and_writes_nothing(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left", "Ctrl+Q", "D")
    assert window.is_closed
    assert not (folder / "bear.session.json").exists()


@pytest.mark.gl
def test_unsaved_work_is_autosaved_until_it_is_saved(window: application.App, folder: Path) -> None:
    assert window.parts.file_actions.autosave(0.0) is None, "nothing to lose"
    press(window, "Shift+Left")
    waits = window.parts.file_actions.autosave(10.0)
    assert waits == session.AUTOSAVE_S
    beside = folder / "bear.autosave.session.json"
    assert not beside.exists()
    assert window.parts.file_actions.autosave(10.0 + session.AUTOSAVE_S) is None
    assert session.open_session(beside).view.layers == window.main_view.work.view.layers
    assert window.parts.file_actions.autosave(99.0) is None, "the same again is not written again"
    window.parts.file_actions.save(folder / "bear.session.json")
    assert not beside.exists()


@pytest.mark.gl
def test_autosave_opens_as_unsaved_work_of_its_session(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left")
    beside = left_over(window, folder)
    window.parts.file_actions.save(folder / "bear.session.json")
    window.parts.file_actions.open(folder / "bear.session.json")
    assert question(window) == Dialog("restore", str(beside))
    press(window, "R")
    assert window.parts.file_actions.path == folder / "bear.session.json"
    assert window.parts.file_actions.has_unsaved
    assert window.main_view.work.view.layers[-1].strength == pytest.approx(0.4)
    press(window, "Ctrl+S")
    assert not beside.exists(), "saved, it has done its work"


def left_over(window: application.App, folder: Path) -> Path:
    """Leave an autosave of the present work as after a crash, unknown to the window."""
    window.parts.file_actions.autosave(0.0)
    window.parts.file_actions.autosave(session.AUTOSAVE_S)
    beside = folder / "bear.autosave.session.json"
    kept = beside.read_bytes()
    window.handle(Plain("discard"))
    for discarded in folder.glob("*.discarded*"):
        discarded.unlink()
    beside.write_bytes(kept)
    return beside


@pytest.mark.gl
def test_work_of_a_running_window_is_not_offered(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left")
    beside = left_over(window, folder)
    other = session.Claim()
    assert other.take(beside)
    window.parts.file_actions.offer_autosave()
    assert window.main_view.work.dialog is None
    other.release()  # as the system does for a window that crashes
    window.parts.file_actions.offer_autosave()
    assert question(window).kind == "restore"


@pytest.mark.gl
def test_second_window_on_a_scene_names_the_first(window: application.App, folder: Path) -> None:
    window.parts.file_actions.release()
    other = session.Claim()
    assert other.take(folder / "bear.session.json")
    window.parts.file_actions.open(folder / "bear.ply")
    assert message(window) == "bear is open in another window"
    other.release()


@pytest.mark.gl
def test_new_autosave_never_replaces_a_leftover_autosave(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left")
    beside = left_over(window, folder)
    kept = beside.read_bytes()
    window.parts.file_actions.offer_autosave()
    assert question(window).kind == "restore"
    assert beside not in window.main_view.work.transient.recent
    press(window, "Escape", "Shift+Left")
    window.parts.file_actions.autosave(100.0)
    window.parts.file_actions.autosave(100.0 + session.AUTOSAVE_S)
    assert beside.read_bytes() == kept
    own = [path for path in folder.glob("*.autosave*") if path != beside]
    assert [session.open_session(path).view.layers for path in own] == [window.main_view.work.view.layers]
    window.parts.file_actions.offer_autosave()
    assert window.main_view.work.dialog is None, "it asks once"
    press(window, "Ctrl+Q", "D")
    assert not own[0].exists()
    assert beside.read_bytes() == kept


@pytest.mark.gl
def test_last_three_discarded_works_are_kept_as_files(window: application.App, folder: Path) -> None:
    strengths = []
    for _ in range(session.MAX_DISCARDED + 2):
        press(window, "Shift+Left")
        left_over_now = folder / "bear.autosave.session.json"
        window.parts.file_actions.autosave(0.0)
        window.parts.file_actions.autosave(session.AUTOSAVE_S)
        strengths.append(window.main_view.work.view.layers[-1].strength)
        window.parts.file_actions.offer_autosave()
        assert window.main_view.work.dialog is None, "its own autosave is nothing that was left"
        window.handle(WithText("discard_autosave", str(left_over_now)))
        window.parts.file_actions.session_autosave = session.SessionAutosave()
    kept = sorted(folder.glob("bear.discarded*"), key=lambda path: path.stat().st_mtime_ns)
    assert len(kept) == session.MAX_DISCARDED
    found = [session.open_session(path).view.layers[-1].strength for path in kept]
    assert sorted(found) == sorted(strengths[-session.MAX_DISCARDED :])
    window.handle(Plain("discard"))
    window.parts.file_actions.open(kept[-1])
    assert window.parts.file_actions.path is None, "saving it asks where"
    assert window.parts.file_actions.has_unsaved


@pytest.mark.gl
def test_unnamed_work_is_not_saved_over_an_existing_session(window: application.App, folder: Path) -> None:
    window.parts.file_actions.save(folder / "bear.session.json")
    yesterday = (folder / "bear.session.json").read_bytes()
    window.parts.file_actions.path = None  # the next day, starting from the scene
    press(window, "Shift+Left", "Ctrl+S")
    assert question(window).text == str(folder / "bear-2.session.json")
    press(window, "Enter")
    assert (folder / "bear-2.session.json").is_file()
    assert (folder / "bear.session.json").read_bytes() == yesterday


@pytest.mark.gl
def test_existing_session_is_overwritten_only_after_a_question(
    window: application.App, folder: Path, saved: Path
) -> None:
    yesterday = saved.read_bytes()
    press(window, "Shift+Left")
    for answer in ("Escape", "Enter"):  # Cancel; Rename…, which opens the save question again
        window.handle(WithText("save_to", str(saved)))
        assert question(window).kind == "overwrite"
        press(window, answer)
    assert question(window).kind == "save"
    assert question(window).text == str(saved)
    by_hand(window, text="another name")
    assert question(window).text == "another name", "the field has the keyboard"
    assert saved.read_bytes() == yesterday
    window.handle(WithText("overwrite", str(saved)))
    assert window.main_view.work.dialog is None
    assert session.open_session(saved).view.layers == window.main_view.work.view.layers
    press(window, "Shift+Left", "Ctrl+S")
    assert window.main_view.work.dialog is None, "its own file is replaced without a question"


@pytest.mark.gl
def test_title_shows_unsaved_changes(window: application.App, folder: Path) -> None:
    titles: list[str] = []
    window.window.rename = titles.append  # type: ignore[method-assign]
    press(window, "Shift+Left")
    assert titles == ["• bear.ply – ProGDF Studio"]
    press(window, "Ctrl+Z")
    assert titles[1:] == ["bear.ply – ProGDF Studio"]


@pytest.mark.gl
def test_duplicated_replaced_and_deleted_layers_are_saved(window: application.App, folder: Path) -> None:
    def layers() -> list[tuple[str, int]]:
        return [(layer.name, layer.gdf) for layer in window.main_view.work.view.layers]

    press(window, "2", "Ctrl+D")  # the lower layer
    assert layers() == [("scarf", 0), ("scarf-2", 2), ("ears", 1)]
    assert window.main_view.work.focus == 1
    assert window.main_view.work.view.layers[1].strength == 0.5
    window.handle(ReplaceEdit(1, str(folder / "edits" / "ears.gdf")))
    assert layers() == [("scarf", 0), ("ears-2", 3), ("ears", 1)]
    assert window.main_view.work.view.layers[1].strength == 0.5
    press(window, "Ctrl+Z")
    assert layers() == [("scarf", 0), ("scarf-2", 2), ("ears", 1)]
    press(window, "Ctrl+Shift+Z", "3", "Ctrl+Delete")
    assert layers() == [("ears-2", 3), ("ears", 1)]
    shown = window.engine.gaussians(window.main_view.work.view).means.clone()
    window.parts.file_actions.save(folder / "two")
    (folder / "edits" / "scarf.gdf").unlink()
    again = session.open_session(folder / "two.session.json")
    assert [(layer.name, layer.gdf) for layer in again.view.layers] == [("ears-2", 1), ("ears", 0)]
    assert len(again.document.gdfs) == 2
    window.parts.file_actions.open(folder / "two.session.json")
    assert torch.equal(window.engine.gaussians(window.main_view.work.view).means, shown)


@pytest.mark.gl
def test_replacing_by_a_scene_file_changes_nothing(
    window: application.App, folder: Path, tmp_path: Path
) -> None:
    before = window.main_view.work.view
    window.handle(ReplaceEdit(0, str(folder / "bear.ply")))
    assert window.main_view.work.view == before
    assert "\n" not in message(window)
    assert window.main_view.work.message is not None
    assert window.main_view.work.message.error


@pytest.mark.gl
def test_files_are_recognized_by_content_not_by_name(
    window: application.App, folder: Path, saved: Path
) -> None:
    saved.rename(folder / "session.txt")
    window.parts.file_actions.open(folder / "session.txt")
    assert window.main_view.work.view == full_view(), message(window)
    (folder / "edits" / "scarf.gdf").rename(folder / "scarf.bin")
    window.parts.file_actions.open(folder / "scarf.bin")
    assert [layer.name for layer in window.main_view.work.view.layers][-1] == "scarf-2", message(window)
    window.handle(Plain("discard"))
    (folder / "bear.ply").rename(folder / "scene.dat")
    window.parts.file_actions.open(folder / "scene.dat")
    assert window.main_view.facts.title == "scene.dat", message(window)


@pytest.mark.gl
def test_dropped_camera_file_sets_the_view(window: application.App, folder: Path) -> None:
    camera = bear().demo.cameras[2]
    save_cameras(folder / "cameras.json", [camera])
    window.parts.file_actions.open(folder / "cameras.json")
    shown = to_camera(window.main_view.work.view.camera, camera.width, camera.height)
    assert np.abs(shown.viewmat.numpy() - camera.viewmat.numpy()).max() < 1e-4
    assert np.abs(shown.K.numpy() - camera.K.numpy()).max() < 1e-2


@pytest.mark.gl
def test_scene_dropped_on_unsaved_work_asks_first(window: application.App, folder: Path) -> None:
    save_ply(folder / "half.ply", bear().scene[:700])
    press(window, "Shift+Left")
    window.parts.file_actions.open(folder / "half.ply")
    window.draw()
    assert window.main_view.facts.title == "bear.ply"
    press(window, "D")
    assert window.main_view.facts.title == "half.ply"
    assert window.main_view.work.dialog is None
    assert window.main_view.work.transient.recent[0] == folder / "half.ply"


@pytest.mark.gl
def test_session_of_another_scene_changes_nothing(window: application.App, folder: Path, saved: Path) -> None:
    before = window.main_view.work.view
    window.parts.file_actions.open(spoilt(saved, "scene", "sha256", value="0" * 64))
    assert window.main_view.work.view == before
    assert "saved with another version of bear.ply" in message(window)


@pytest.mark.gl
def test_saving_never_overwrites_another_kind_of_file(window: application.App, folder: Path) -> None:
    save_cameras(folder / "cameras.json", list(bear().demo.cameras[:1]))
    before = (folder / "cameras.json").read_bytes()
    window.handle(WithText("save_to", str(folder / "cameras.json")))
    assert (folder / "cameras.json").read_bytes() == before
    assert "is not a session" in question(window).error


def by_hand(window: application.App, *keys: imgui.Key, text: str = "") -> None:
    """Send keys to the path field, then a text."""
    window.main_view.ui.make_current()
    io = imgui.get_io()
    for key in keys:
        for down in (True, False):
            io.add_key_event(key, down)
            window.draw()
    io.add_input_characters_utf8(text)
    window.main_view.wake()
    for _ in range(4):
        window.draw()


@pytest.mark.gl
def test_failed_save_asks_again_with_the_typed_path(window: application.App, folder: Path) -> None:
    press(window, "Shift+Left", "Ctrl+S")
    typed = str(folder / "gone" / "bear.session.json")
    by_hand(window, text=typed)
    by_hand(window, imgui.Key.enter)  # makes the field release the keyboard
    press(window, "Enter")
    dialog = question(window)
    before = window.main_view.work.view
    assert dialog.text == typed
    assert "gone does not exist" in dialog.error
    assert window.parts.file_actions.has_unsaved
    press(window, "V", "Shift+Left")
    assert window.main_view.work.view == before, "keys are no shortcuts meanwhile"
    by_hand(window, *[imgui.Key.end] * 2, *[imgui.Key.backspace] * len(".session.json"), text="-2")
    assert question(window).text == str(folder / "gone" / "bear-2")
    (folder / "gone").mkdir()
    press(window, "Enter")
    assert window.main_view.work.dialog is None
    assert (folder / "gone" / "bear-2.session.json").is_file()
    press(window, "V")
    assert window.main_view.work.view.camera.mode == "fly"


@pytest.mark.gl
def test_quit_waits_until_the_save_succeeds(window: application.App, folder: Path) -> None:
    (folder / "kept").mkdir()
    window.parts.file_actions.save(folder / "kept" / "bear")
    (folder / "kept").rename(folder / "away")
    press(window, "Shift+Left", "Ctrl+Q", "S")
    assert "kept does not exist" in question(window).error
    assert question(window).text == str(folder / "kept" / "bear.session.json")
    press(window, "Enter")
    assert not window.is_closed
    (folder / "away").rename(folder / "kept")
    press(window, "Enter")
    assert window.is_closed
    assert not window.parts.file_actions.has_unsaved


@pytest.mark.gl
def test_home_of_an_unknown_user_does_not_exist(window: application.App) -> None:
    window.handle(WithText("save_to", "~nobody-here/bear"))
    assert "~nobody-here does not exist" in question(window).error
    window.handle(WithText("open_file", "~nobody-here/bear.ply"))
    assert "~nobody-here/bear.ply" in message(window)


@pytest.mark.gl
@pytest.mark.parametrize("name", ["x" * 300, "/".join(["x" * 200] * 30), "a\0b", "\x1b[2J\n"])
def test_impossible_path_is_one_line(window: application.App, name: str) -> None:
    for request in (WithText("open_file", name), ReplaceEdit(0, name)):
        window.handle(request)
        assert message(window)
        assert "\x1b" not in message(window)
        window.draw()
    for path in (f"no folder/{name}", "/"):
        window.handle(WithText("save_to", str(path)))
        assert question(window).error
        window.draw()


def test_f4_saves_each_view_as_a_camera_beside_the_session(window: application.App, folder: Path) -> None:
    assert window.documents.get().path is not None
    kept = folder / f"{window.documents.get().path.stem}.cameras.json"
    for azimuth in (10.0, 70.0):
        camera = replace(window.main_view.work.view.camera, azimuth=azimuth)
        window.main_view.store.replace(workspace.with_camera(window.main_view.work, camera))
        press(window, "F4")
        assert kept.name in message(window)
    found = load_cameras(kept)
    assert [camera.name for camera in found] == ["view_000", "view_001"]
    shown = to_camera(window.main_view.work.view.camera, *window.main_view.picture_size)
    assert torch.equal(found[1].viewmat, shown.viewmat)
    assert torch.equal(found[1].K, shown.K)
    assert not torch.equal(found[0].viewmat, found[1].viewmat)


def test_f4_does_not_overwrite_a_foreign_camera_file(window: application.App, folder: Path) -> None:
    assert window.documents.get().path is not None
    theirs = folder / f"{window.documents.get().path.stem}.cameras.json"
    theirs.write_text("[]")
    press(window, "F4")
    assert theirs.read_text() == "[]"
    assert "was not made with F4" in message(window)


@pytest.mark.gl
def test_pictures_are_never_saved_to_the_current_folder(
    window: application.App,
    folder: Path,
    tmp_path_factory: pytest.TempPathFactory,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    here = tmp_path_factory.mktemp("here")
    own = tmp_path_factory.mktemp("own") / "Pictures"
    monkeypatch.chdir(here)
    monkeypatch.setattr(exports, "pictures_folder", lambda: own)
    press(window, "F2", "Ctrl+F2", "Shift+F2")
    assert len([*folder.glob("bear_*.png")]) == 3
    locked = tmp_path_factory.mktemp("locked")
    save_ply(locked / "half.ply", bear().scene[:700])
    locked.chmod(0o555)
    window.parts.file_actions.open(locked / "half.ply")
    press(window, "F2", "Ctrl+F2", "Ctrl+E")
    names = sorted(path.name for path in own.iterdir())
    assert names == ["half_001.png", "half_002.camera.json", "half_002.png"]
    assert question(window).text == str(own / "half_edited.ply")
    assert [*here.iterdir()] == []
    locked.chmod(0o755)
