"""Regions as files: kept, renamed, written again, and what progdf reads of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from progdf.errors import ProgdfError
from progdf.scene.region_spec import parse_region
from tests.helpers.null_app import null_app
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.files import regions
from viewer.state import selection
from viewer.state.selection import SelectionState

TOTAL = 1500
MASK = np.arange(TOTAL) % 7 == 0


@pytest.fixture
def chosen() -> SelectionState:
    return selection.select(SelectionState(), MASK)


def test_a_region_that_is_kept_is_one_that_progdf_trains(chosen: SelectionState, tmp_path: Path) -> None:
    kept = regions.keep(chosen, "jacket", tmp_path, TOTAL)
    assert [(region.name, region.count) for region in kept.regions] == [("jacket", MASK.sum())]
    found = parse_region(f"file:{tmp_path}/jacket.region.npy", bear().scene)
    assert found.members.tolist() == np.flatnonzero(MASK).tolist()
    assert kept.members == chosen.members, "it stays selected"


def test_no_region_takes_the_place_of_another_file(chosen: SelectionState, tmp_path: Path) -> None:
    (tmp_path / "jacket.region.npy").write_bytes(b"somebody else's")
    kept = regions.keep(regions.keep(chosen, "jacket", tmp_path, TOTAL), "jacket", tmp_path, TOTAL)
    assert [region.name for region in kept.regions] == ["jacket-2", "jacket-3"]
    assert (tmp_path / "jacket.region.npy").read_bytes() == b"somebody else's"


def test_a_renamed_region_takes_its_file_along_and_is_written_again_after_undo(
    chosen: SelectionState, tmp_path: Path
) -> None:
    kept = regions.keep(chosen, "jacket", tmp_path, TOTAL)
    renamed = regions.rename(kept, 0, "coat", TOTAL)
    assert [path.name for path in tmp_path.iterdir()] == ["coat.region.npy"]
    assert (renamed.regions[0].name, renamed.regions[0].path) == ("coat", tmp_path / "coat.region.npy")
    assert regions.rename(renamed, 0, "coat", TOTAL) == renamed
    assert regions.region_file(kept.regions[0], TOTAL).exists(), "the state before knows what was in it"
    assert np.load(kept.regions[0].path).tolist() == np.flatnonzero(MASK).tolist()


def test_nothing_selected_and_no_folder_are_one_line(chosen: SelectionState, tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="nothing is selected"):
        regions.keep(SelectionState(), "jacket", tmp_path, TOTAL)
    with pytest.raises(ProgdfError, match="does not exist"):
        regions.keep(chosen, "jacket", tmp_path / "gone", TOTAL)


@pytest.mark.gl
def test_the_window_keeps_a_region_beside_the_scene_and_in_the_session(tmp_path: Path) -> None:
    document = opened_document(bear_files(tmp_path))
    view = first_view(bear(), 0.5, 0.5)
    view = replace(view, selection=selection.select(SelectionState(), MASK))
    with null_app(document, view, tmp_path) as app:
        app.file_actions.handle("save_region: jacket ")
        app.file_actions.handle("rename_region:0:coat")
        work = app.main_view.work
        assert [region.name for region in work.view.selection.regions] == ["coat"]
        assert (tmp_path / "coat.region.npy").exists()
        assert app.file_actions.has_unsaved
        (tmp_path / "coat.region.npy").unlink()
        app.file_actions.save(tmp_path / "work")
        assert (tmp_path / "coat.region.npy").exists(), "a session that is saved has its regions"
        app.file_actions.open(tmp_path / "work.session.json")
        assert app.main_view.work.view.selection == work.view.selection
