"""Bundles NAME.progdf.zip hold a session and all of its files: `export`, `view` and the window."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.io.bundle import unpack_bundle, write_bundle
from tests.helpers.null_app import null_app
from tests.helpers.sessions import bear_files, full_view, opened_document, saved_session
from tests.helpers.ui_rig import bear
from viewer.camera.view_camera import first_camera
from viewer.files import session
from viewer.files.document import empty
from viewer.state import selection
from viewer.state.selection import SelectionState
from viewer.state.view_state import ViewState


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    """Export the bear's session as a bundle into an otherwise empty folder."""
    (tmp_path / "here").mkdir()
    (tmp_path / "there").mkdir()
    saved = saved_session(bear_files(tmp_path / "here"))
    path = tmp_path / "there" / "bear.progdf.zip"
    assert main(["export", str(saved), "-o", str(path)]) == 0
    return path


def test_bundle_unpacks_to_its_session_in_its_own_folder(bundle: Path, tmp_path: Path) -> None:
    (saved,) = (tmp_path / "here").glob("*.session.json")
    before = session.open_session(saved)
    after = session.open_session(unpack_bundle(bundle))
    assert (after.view, after.snapshots) == (before.view, before.snapshots)
    names = {path.name for path in bundle.parent.iterdir()}
    assert names == {"bear.progdf", "bear.progdf.zip"}
    again = unpack_bundle(bundle)
    assert again.parent == bundle.parent / "bear.progdf", "what was unpacked is opened, not unpacked again"


def test_scene_with_edits_exports_as_a_bundle(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = bear_files(tmp_path)
    words = [
        str(folder / "bear.ply"),
        *map(str, sorted((folder / "edits").glob("*.gdf"))),
        "--set",
        "ears=0.3",
    ]
    assert main(["export", *words, "-o", str(tmp_path / "a.progdf.zip")]) == 0
    assert "4 files; open it with progdf view" in capsys.readouterr().out
    assert (
        main(["render", str(tmp_path / "a.progdf.zip"), "--size", "32x32", "-o", str(tmp_path / "a.png")])
        == 0
    )
    opened = session.open_session(unpack_bundle(tmp_path / "a.progdf.zip"))
    assert {layer.name: layer.strength for layer in opened.view.layers}["ears"] == 0.3
    assert opened.view.camera == first_camera(bear().scene)


def test_bundle_contains_its_regions(tmp_path: Path) -> None:
    folder = bear_files(tmp_path)
    third = selection.select(SelectionState(), np.arange(len(bear().scene)) % 3 == 0)
    kept = selection.add_region(third, "third", folder / "edits" / "third.region.npy")
    document = opened_document(folder)
    saved = session.WindowSession(document, replace(full_view(), selection=kept))
    session.save(folder / "work.session.json", saved)
    write_bundle(tmp_path / "a.progdf.zip", folder / "work.session.json")
    opened = session.open_session(unpack_bundle(tmp_path / "a.progdf.zip"))
    assert opened.warning == ""
    (region,) = opened.view.selection.regions
    assert region.path == tmp_path / "a.progdf" / "third.region.npy"
    assert region.members == kept.regions[0].members


def test_files_with_the_same_name_get_numbers(tmp_path: Path) -> None:
    folder = bear_files(tmp_path)
    saved = saved_session(folder)
    for path, other in zip(sorted((folder / "edits").glob("*.gdf")), ("a", "b"), strict=True):
        (folder / other).mkdir()
        path.rename(folder / other / "Edit.gdf")
        saved.write_text(saved.read_text().replace(f"edits/{path.name}", f"{other}/Edit.gdf"))
    assert write_bundle(tmp_path / "a.progdf.zip", saved) == 4
    with zipfile.ZipFile(tmp_path / "a.progdf.zip") as archive:
        assert {"Edit.gdf", "Edit-2.gdf", "bear.ply"} < set(archive.namelist())


def test_window_opens_a_bundle(bundle: Path) -> None:
    with null_app(empty(), ViewState(), bundle.parent) as app:
        app.parts.file_actions.open(bundle)
        assert [layer.name for layer in app.main_view.work.view.layers] == ["ears → gold", "scarf"]


def rewritten(path: Path, change: Callable[[dict[str, bytes]], None]) -> Path:
    """Rewrite the bundle with changed files."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    change(files)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize(
    "name", ["../evil.ply", "/tmp/evil.ply", "a/evil.ply", "..", "a\\evil.ply", "C:evil", ".x"]
)
def test_bundle_writes_nothing_outside_its_folder(bundle: Path, name: str) -> None:
    rewritten(bundle, lambda files: files.update({name: b"evil"}))
    with pytest.raises(ProgdfError, match="which is not a plain file"):
        unpack_bundle(bundle)
    assert [path.name for path in bundle.parent.iterdir()] == ["bear.progdf.zip"]
    assert not list(bundle.parents[1].rglob("*evil*"))


def test_invalid_bundle_is_one_line_and_leaves_nothing(bundle: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = bundle.read_bytes()
    for content, said in (
        (b"", "is not a bundle"),
        (whole[: len(whole) // 2], "is damaged"),
        (whole[:2000] + bytes(500) + whole[2500:], "is damaged"),
    ):
        bundle.write_bytes(content)
        with pytest.raises(ProgdfError, match=said) as caught:
            unpack_bundle(bundle)
        assert "\n" not in str(caught.value)
        assert [path.name for path in bundle.parent.iterdir()] == ["bear.progdf.zip"]
    bundle.write_bytes(whole)
    rewritten(bundle, lambda files: files.update({"b.session.json": b"{}"}))
    with pytest.raises(ProgdfError, match="it holds 2 sessions"):
        unpack_bundle(bundle)
    monkeypatch.setattr("progdf.io.bundle.MAX_EXPANSION", 1)
    rewritten(bundle, lambda files: files.update({"b.session.json": bytes(3 << 20)}))
    rewritten(bundle, lambda files: files.update({"zeros.ply": files.pop("b.session.json")}))
    with pytest.raises(ProgdfError, match="unpacks to more than 1 times its size"):
        unpack_bundle(bundle)


def test_modified_file_in_a_bundle_is_refused_by_name(bundle: Path) -> None:
    rewritten(bundle, lambda files: files.update({"bear.ply": files["bear.ply"] + b" "}))
    with pytest.raises(ProgdfError, match=r"was saved with another version of bear\.ply"):
        session.open_session(unpack_bundle(bundle))


def test_unpacking_leaves_a_foreign_folder_unchanged(bundle: Path) -> None:
    (bundle.parent / "bear.progdf").mkdir()
    (bundle.parent / "bear.progdf" / "mine.txt").write_text("mine")
    with pytest.raises(ProgdfError, match=r"was not unpacked from bear\.progdf\.zip"):
        unpack_bundle(bundle)
    assert (bundle.parent / "bear.progdf" / "mine.txt").read_text() == "mine"
