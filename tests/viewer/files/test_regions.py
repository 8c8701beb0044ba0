"""Region files: saved, renamed, rewritten, and read by progdf."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from progdf.errors import ProgdfError
from progdf.scene.regions import parse_region
from tests.helpers.null_app import null_app
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.files import region_files, session
from viewer.files.session import WindowSession
from viewer.state import selection
from viewer.state.commands import Plain, Rename, WithText
from viewer.state.forms import SELECTION, NewEdit
from viewer.state.selection import SelectionState

TOTAL = 1500
MASK = np.arange(TOTAL) % 7 == 0


@pytest.fixture
def chosen() -> SelectionState:
    return selection.select(SelectionState(), MASK)


def test_saved_region_can_be_trained_by_progdf(chosen: SelectionState, tmp_path: Path) -> None:
    kept = region_files.keep_region(chosen, "jacket", tmp_path, TOTAL)
    assert [(region.name, region.count) for region in kept.regions] == [("jacket", MASK.sum())]
    found = parse_region(f"file:{tmp_path}/jacket.region.npy", bear().scene)
    assert found.members.tolist() == np.flatnonzero(MASK).tolist()
    assert kept.members == chosen.members, "it stays selected"


def test_new_region_never_replaces_a_file(chosen: SelectionState, tmp_path: Path) -> None:
    (tmp_path / "jacket.region.npy").write_bytes(b"somebody else's")
    once = region_files.keep_region(chosen, "jacket", tmp_path, TOTAL)
    kept = region_files.keep_region(selection.select(once, ~MASK), "jacket", tmp_path, TOTAL)
    assert [region.name for region in kept.regions] == ["jacket-2", "jacket-3"]
    assert (tmp_path / "jacket.region.npy").read_bytes() == b"somebody else's"


def test_equal_regions_are_one(chosen: SelectionState, tmp_path: Path) -> None:
    once = region_files.keep_region(chosen, "jacket", tmp_path, TOTAL)
    assert region_files.keep_region(once, "coat", tmp_path, TOTAL) == once
    of_edit = selection.add_region(chosen, "blue", tmp_path / "blue.region.npy", edit="blue")
    kept = region_files.keep_region(of_edit, "coat", tmp_path, TOTAL)
    assert [(region.name, region.edit, region.path.name) for region in kept.regions] == [
        ("coat", "", "coat.region.npy")
    ]
    found = parse_region(f"file:{kept.regions[0].path}", bear().scene)
    assert found.members.tolist() == np.flatnonzero(MASK).tolist()


def test_renaming_a_region_moves_its_file_and_undo_restores_it(
    chosen: SelectionState, tmp_path: Path
) -> None:
    kept = region_files.keep_region(chosen, "jacket", tmp_path, TOTAL)
    renamed = region_files.rename_region(kept, 0, "coat", TOTAL)
    assert [path.name for path in tmp_path.iterdir()] == ["coat.region.npy"]
    assert (renamed.regions[0].name, renamed.regions[0].path) == ("coat", tmp_path / "coat.region.npy")
    assert region_files.rename_region(renamed, 0, "coat", TOTAL) == renamed
    assert region_files.region_file(kept.regions[0], TOTAL).exists(), "the state before knows what was in it"
    assert np.load(kept.regions[0].path).tolist() == np.flatnonzero(MASK).tolist()


def test_saving_a_region_needs_a_selection_and_a_folder(chosen: SelectionState, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="nothing is selected"):
        region_files.keep_region(SelectionState(), "jacket", tmp_path, TOTAL)
    with pytest.raises(ProgdfError, match="does not exist"):
        region_files.keep_region(chosen, "jacket", tmp_path / "gone", TOTAL)


def foreign_session(folder: Path, *paths: str) -> Path:
    """Write a session of a third party whose regions claim these files."""
    state = selection.select(SelectionState(), MASK)
    for i in range(len(paths)):
        state = selection.add_region(state, f"r{i}", folder / f"r{i}.region.npy")
    view = replace(first_view(bear()), selection=state)
    session.save(folder / "work.session.json", WindowSession(opened_document(folder), view))
    table = json.loads((folder / "work.session.json").read_text())
    for region, path in zip(table["view"]["selection"]["regions"], paths, strict=True):
        region["path"] = path
    (folder / "work.session.json").write_text(json.dumps(table))
    return folder / "work.session.json"


def contents(folder: Path) -> dict[str, bytes | None]:
    """Return all files below a folder by relative path; None for folders and links."""
    return {
        str(path.relative_to(folder)): None if path.is_symlink() or not path.is_file() else path.read_bytes()
        for path in sorted(folder.rglob("*"))
    }


FOREIGN = (
    "../victim.txt",
    "../victim.region.npy",
    "../new.region.npy",
    "../new.txt",
    "edits/../../victim.region.npy",
    "out/victim.region.npy",  # a link to the folder above
    "out/new.region.npy",
    "link.region.npy",  # a link to the victim
    "dangling.region.npy",
    "bear.edits/x.region.npy",  # also a link out of the folder
    "folder.region.npy",
    "gone/new.region.npy",
    "notes.txt",
    "",
    "a\0.region.npy",
    "n" * 300 + ".region.npy",
    "/".join("n" * 200 for _ in range(30)) + ".region.npy",
    "{outside}/victim.region.npy",
    "{outside}/victim.txt",
)


def test_third_party_session_changes_nothing_outside_its_folder(tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    folder = tmp_path / "outside" / "in"
    folder.mkdir(parents=True)
    bear_files(folder)
    (folder / "folder.region.npy").mkdir()
    for name in ("victim.txt", "victim.region.npy", "in/notes.txt"):
        (outside / name).write_bytes(b"mine")
    (folder / "out").symlink_to(outside)
    (folder / "bear.edits").symlink_to(outside)
    (folder / "link.region.npy").symlink_to(outside / "victim.region.npy")
    (folder / "dangling.region.npy").symlink_to(outside / "new.region.npy")
    paths = tuple(path.format(outside=outside) for path in FOREIGN)
    file = foreign_session(folder, *paths)
    before = contents(outside)
    opened = session.open_session(file)
    state = opened.view.selection
    assert f"region r0 (../victim.txt) and {len(paths) - 1} more, not a .region.npy file" in opened.warning
    for i, region in enumerate(state.regions):
        region_files.region_file(region, TOTAL)
        state = region_files.rename_region(state, i, f"renamed {i}", TOTAL)
    after = contents(outside)
    new_files = {name: after.pop(name) for name in set(after) - set(before)}
    assert after == before
    assert all(name.startswith("in/renamed ") and name.endswith(".region.npy") for name in new_files)
    assert len(new_files) == len(paths)


def test_region_files_in_the_session_folders_are_kept(tmp_path: Path) -> None:
    bear_files(tmp_path)
    (tmp_path / "bear.edits").mkdir()
    (tmp_path / "below").mkdir()
    names = ("a.region.npy", "bear.edits/b.region.npy", "below/c.region.npy")
    opened = session.open_session(foreign_session(tmp_path, *names))
    assert opened.warning == ""
    assert [region.path for region in opened.view.selection.regions] == [tmp_path / name for name in names]


def test_rename_keeps_a_file_with_other_rows(chosen: SelectionState, tmp_path: Path) -> None:
    kept = region_files.keep_region(chosen, "jacket", tmp_path, TOTAL)
    np.save(tmp_path / "jacket.region.npy", np.arange(3))
    region_files.rename_region(kept, 0, "coat", TOTAL)
    assert np.load(tmp_path / "jacket.region.npy").tolist() == [0, 1, 2]


@pytest.mark.gl
def test_window_reports_rejected_regions_and_saves_them_again(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    bear_files(folder)
    (tmp_path / "victim.txt").write_bytes(b"mine")
    file = foreign_session(folder, "../victim.txt")
    with null_app(opened_document(folder), first_view(bear()), tmp_path) as app:
        app.parts.file_actions.open(file)
        message = app.main_view.work.message
        assert message is not None
        assert "region r0 (../victim.txt), not a .region.npy file in the session's folder" in message.text
        app.handle(Plain("save"))
        assert (folder / "r0.region.npy").exists()
        (tmp_path / "elsewhere").mkdir()
        app.parts.file_actions.save(tmp_path / "elsewhere" / "moved")
        assert (tmp_path / "elsewhere" / "r0.region.npy").exists(), "a session that is saved has its regions"
        assert session.open_session(tmp_path / "elsewhere" / "moved.session.json").warning == ""
    assert (tmp_path / "victim.txt").read_bytes() == b"mine"


@pytest.mark.gl
def test_window_saves_a_region_beside_the_scene_and_in_the_session(tmp_path: Path) -> None:
    document = opened_document(bear_files(tmp_path))
    view = first_view(bear(), 0.5, 0.5)
    view = replace(view, selection=selection.select(SelectionState(), MASK))
    with null_app(document, view, tmp_path) as app:
        app.handle(WithText("save_region", " jacket "))
        app.handle(Rename("rename_region", 0, "coat"))
        work = app.main_view.work
        assert [region.name for region in work.view.selection.regions] == ["coat"]
        assert (tmp_path / "coat.region.npy").exists()
        assert app.parts.file_actions.has_unsaved
        (tmp_path / "coat.region.npy").unlink()
        app.parts.file_actions.save(tmp_path / "work")
        assert (tmp_path / "coat.region.npy").exists(), "a session that is saved has its regions"
        app.parts.file_actions.open(tmp_path / "work.session.json")
        assert app.main_view.work.view.selection == work.view.selection


def test_empty_selection_is_no_region(tmp_path: Path) -> None:
    one = selection.select(SelectionState(), np.arange(20) == 3)
    for state in (SelectionState(), selection.select(one, np.zeros(20, bool))):
        with pytest.raises(ProgdfError, match="the region is empty"):
            region_files.region_option(NewEdit(region=SELECTION), tmp_path, state, 20)
    assert not list(tmp_path.iterdir())
    assert region_files.region_option(NewEdit(region=SELECTION), tmp_path, one, 20)
