"""Session files restore the window's state and reject everything else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
import pytest
from PIL import Image

from progdf.__main__ import main
from progdf.cli.info import kind_of
from progdf.compose.layer_paint import encode
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.io.json_values import to_json
from progdf.io.session import SessionFile, read_session, sha256
from tests.helpers.sessions import full_view, opened_document, spoilt
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.camera.view_camera import eye, from_camera, to_camera
from viewer.files import session
from viewer.files.session import WindowSession
from viewer.state import selection
from viewer.state.selection import SelectionState
from viewer.state.view_state import Comparison, SnapshotPair


def test_session_restores_exactly_what_was_saved(saved: Path) -> None:
    again = session.open_session(saved)
    assert again.view == full_view()
    assert [kept.edit.blend for kept in again.snapshots] == ["sum"]
    assert [gdf.name for gdf in again.document.gdfs] == ["scarf", "ears"]


def test_session_is_readable_and_moves_with_its_folder(saved: Path, tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    "place",
    ["C:\\\\scenes\\\\", "D:/scenes/", "\\\\\\\\server\\\\share\\\\", "//server/share/", "/home/somebody/"],
)
def test_session_of_another_system_finds_its_files_beside_it(saved: Path, place: str) -> None:
    text = saved.read_text("utf-8")
    saved.write_text(text.replace('"bear.ply"', f'"{place}bear.ply"'), "utf-8")
    assert session.open_session(saved).document.path == saved.parent / "bear.ply"
    (saved.parent / "bear.ply").write_bytes(b"another")
    with pytest.raises(ProgdfError, match="was saved with another version of bear"):
        session.open_session(saved)


def test_paths_in_files_have_forward_slashes_on_any_system() -> None:
    assert to_json({"path": PureWindowsPath("edits\\red.region.npy")}) == {"path": "edits/red.region.npy"}


def test_regions_are_restored_after_the_folder_moved(folder: Path, tmp_path: Path) -> None:
    mask = np.arange(len(bear().scene)) % 3 == 0
    chosen = selection.select(SelectionState(), mask)
    kept = selection.add_region(chosen, "third", folder / "third.region.npy")
    view = replace(full_view(), selection=kept)
    session.save(folder / "work.session.json", WindowSession(opened_document(folder), view))
    assert str(tmp_path) not in (folder / "work.session.json").read_text()
    elsewhere = tmp_path.with_name(tmp_path.name + "_moved")
    tmp_path.rename(elsewhere)
    moved = elsewhere / folder.relative_to(tmp_path)
    again = session.open_session(moved / "work.session.json").view.selection
    elsewhere.rename(tmp_path)
    assert again.members == kept.members
    assert [region.path for region in again.regions] == [moved / "third.region.npy"]


def test_session_older_than_groups_opens_without_groups(saved: Path) -> None:
    table = json.loads(saved.read_text())
    for state in (table["view"], *(kept["edit"] for kept in table["snapshots"])):
        for key in ("groups", "pair", "collapsed", "cards"):
            state.pop(key, None)
        for layer in state["layers"]:
            del layer["group"]
    saved.write_text(json.dumps(table))
    again = session.open_session(saved).view
    assert (again.groups, again.pair, [layer.group for layer in again.layers]) == (
        (),
        SnapshotPair(),
        ["", ""],
    )


def test_session_older_than_the_gain_of_texture_looks_the_same(saved: Path) -> None:
    table = json.loads(saved.read_text())
    for layer in table["view"]["layers"]:
        del layer["gains"]["texture"]
        layer["gains"]["color"] = 0.25
    saved.write_text(json.dumps(table))
    layers = session.open_session(saved).view.layers
    assert [layer.gains.texture for layer in layers] == [0.25] * len(layers)


def test_session_older_than_selections_opens_without_a_selection(saved: Path) -> None:
    table = json.loads(saved.read_text())
    for state in (table["view"], *(kept["edit"] for kept in table["snapshots"])):
        del state["selection"]
    del table["view"]["select"]
    saved.write_text(json.dumps(table))
    assert session.open_session(saved).view == full_view()


BROKEN: list[tuple[tuple[str | int, ...], Any, str]] = [
    (("progdf_session",), 2, "version 2"),
    (("progdf_session",), "one", "version"),
    (("macros",), ["import os"], "macros"),
    (("scene",), "bear.ply", "scene"),
    (("scene", "file"), "gone.ply", "does not exist"),
    (("scene", "file"), "g" * 5000, "does not exist"),
    (("scene", "file"), ".", "is not a regular file"),
    (("scene", "file"), "", "scene"),
    (("scene", "file"), "a\0b", "scene"),
    (("scene", "sha256"), "0" * 64, "another version of bear.ply"),
    (("edits", 1, "sha256"), "0" * 64, "another version of ears.gdf"),
    (("edits",), [], "layers[0].gdf is 1, but there are 0 edits"),
    (("view",), [], "expected"),
    (("view", "blur"), 3, "view.blur is unknown"),
    (("view", "camera", "distance"), 0.0, "view.camera.distance"),
    (("view", "camera", "distance"), 1e400, "Infinity"),
    (("view", "camera", "mode"), "walk\n", "mode is 'walk\\n', expected one of (orbit|fly)"),
    (("view", "camera", "up"), [0.0, 1.0], "view.camera.up"),
    (("view", "selection", "members"), "AAAA", "select it again"),
    (("view", "selection", "count"), -1, "view.selection.count"),
    (("view", "layers", 0, "strength"), 3.0, "view.layers[0].strength is 3.0, expected float <= 1.2"),
    (("view", "layers", 0, "strength"), "1", "strength"),
    (("view", "layers", 0, "enabled"), 1, "enabled"),
    (("view", "layers", 0, "gains", "color"), -1.0, "gains"),
    (("view", "layers", 0, "paint"), "AAAA", "paint"),
    (("view", "layers", 0, "paint"), encode(np.zeros(3, np.float32)), "do not fit its"),
    (("view", "brush", "mode"), "spray", "spray"),
    (("view", "brush", "radius"), 0.0, "radius"),
    (("view", "blend"), "multiply", "multiply"),
    (("view", "compare", "mode"), "blink", "blink"),
    (("view", "compare", "amplify"), 1e9, "amplify"),
    (("view", "timeline", "keys", 0, "easing"), "bouncy", "easing"),
    (("view", "timeline", "length"), -5, "length"),
    (("view", "timeline", "keys", 0, "frame"), 99_999, "outside 0 to the length"),
    (("view", "timeline", "keys"), [{"frame": 1, "strengths": [[0, 1.0]]}] * 2, "two keys of one row at one"),
    (("view", "timeline", "keys", 0, "camera", "up"), [0.0, 0.0, 0.0], "up axis without a direction"),
    (("view", "timeline", "keys", 0, "camera", "distance"), -1.0, "distance"),
    (("snapshots", 0, "edit", "blend"), "none", "none"),
    (("snapshots",), {"a": 1}, "expected"),
]


@pytest.mark.parametrize(("keys", "value", "about"), BROKEN)
def test_damaged_session_is_refused_in_one_line(
    saved: Path, keys: tuple[str | int, ...], value: Any, about: str
) -> None:
    with pytest.raises(ProgdfError) as refused:
        session.open_session(spoilt(saved, *keys, value=value))
    message = str(refused.value)
    assert about in message
    assert "\n" not in message
    assert "; " in message


@pytest.mark.parametrize(
    "content",
    [b"{", b"[1]", b"{}", b"\xff\xfe", b'{"progdf_session": 1, "progdf_session": 1}', b"[" * 99_999],
)
def test_file_that_is_no_session_is_refused_in_one_line(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "odd.session.json").write_bytes(content)
    with pytest.raises(ProgdfError) as refused:
        read_session(tmp_path / "odd.session.json", SessionFile)
    assert "\n" not in str(refused.value)


def test_changed_scene_is_refused_by_name(saved: Path) -> None:
    save_ply(saved.parent / "bear.ply", bear().scene[:-1])
    with pytest.raises(ProgdfError, match=r"saved with another version of bear\.ply"):
        session.open_session(saved)


def test_missing_fields_of_an_older_session_get_defaults(saved: Path) -> None:
    table = json.loads(saved.read_text())
    del table["view"]["compare"], table["view"]["camera"]["fov_y"], table["snapshots"]
    saved.write_text(json.dumps(table))
    again = session.open_session(saved)
    assert again.view.compare == Comparison()
    assert again.view.camera.fov_y == 45.0
    assert again.snapshots == ()


def test_failed_save_keeps_the_old_session(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    broken = replace(full_view(), background=(float("nan"), 0.0, 0.0))
    with pytest.raises(ValueError, match="JSON"):
        session.save(saved, WindowSession(opened_document(saved.parent), broken))
    assert saved.read_bytes() == before
    assert not list(saved.parent.glob(".*"))


def test_info_lists_the_contents_of_a_session(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kind_of(saved) == "session"
    (saved.parent / "edits" / "ears.gdf").unlink()
    assert main(["info", str(saved)]) == 0
    output = capsys.readouterr().out
    assert "bear.ply (unchanged)" in output
    assert "ears.gdf (missing)" in output
    assert "ears → gold" in output
    assert "snapshots: 1" in output


def test_render_draws_a_session_like_the_window(saved: Path, tmp_path: Path) -> None:
    view = replace(full_view(), compare=Comparison())
    session.save(saved, WindowSession(opened_document(saved.parent), view))
    out = tmp_path / "a.png"
    size = ("--size", "64x48", "--engine", "cpu")
    assert main(["render", "--session", str(saved), *size, "-o", str(out)]) == 0
    from viewer.render.engine import ViewEngine

    engine = ViewEngine(None, bear().scene, bear().gdfs)
    expected = np.round(engine.image(view, (64, 48)).clip(0, 1) * 255)
    assert np.abs(np.asarray(Image.open(out)).astype(int) - expected).max() <= 1
    moved = replace(view, layers=(replace(view.layers[0], strength=0.0), view.layers[1]))
    assert main(["render", "--session", str(saved), "--set", "ears=0", *size, "-o", str(out)]) == 0
    expected = np.round(engine.image(moved, (64, 48)).clip(0, 1) * 255)
    assert np.abs(np.asarray(Image.open(out)).astype(int) - expected).max() <= 1


def test_render_compares_two_snapshots_of_a_session(
    saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.png"
    view = replace(full_view(), compare=Comparison("split", 0.5, against="snapshots"))
    session.save(saved, replace(session.open_session(saved), view=view))
    assert main(["render", str(saved), "--size", "64x48", "--engine", "cpu", "-o", str(out)]) == 0
    assert "PSNR of snapshot 1 against original" in capsys.readouterr().out


def test_session_without_layers_renders_the_original(saved: Path, tmp_path: Path) -> None:
    path = spoilt(saved, "view", "layers", value=[])
    out = tmp_path / "a.png"
    size = ("--size", "32x24", "--engine", "cpu")
    assert main(["render", "--session", str(path), *size, "-o", str(out)]) == 0
    assert out.is_file()


def test_option_that_the_session_defines_is_refused(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", "--session", str(saved), "--overshoot", "-o", "a.png"]) == 2
    assert "--overshoot was given" in capsys.readouterr().err


def test_pinhole_camera_converts_to_the_window_camera() -> None:
    view = first_view(bear()).camera
    seen = to_camera(view, 320, 240)
    again = from_camera(view, seen, application.Document("b", bear().scene).facts().bounds)
    assert eye(again) == pytest.approx(eye(view), abs=1e-4)
    assert again.fov_y == pytest.approx(view.fov_y, abs=1e-3)
