"""Selections as values: packed, hidden, saved as regions, undone and stored."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from progdf.errors import ProgdfError
from progdf.scene.neighbors import Neighborhood
from progdf.scene.regions import read_step
from tests.helpers.ui_rig import bear, first_view
from viewer.camera.view_camera import Bounds
from viewer.state import selection, workspace
from viewer.state.actions import perform
from viewer.state.commands import Plain
from viewer.state.selection import EMPTY_MASK, SelectionState
from viewer.state.workspace import SceneFacts, Workspace

TOTAL = 1003


def every(step: int) -> np.ndarray:
    return np.arange(TOTAL) % step == 0


def selecting(work: Workspace, mask: np.ndarray) -> Workspace:
    chosen = selection.select(work.view.selection, mask)
    return workspace.record_undo(replace(work, view=replace(work.view, selection=chosen)))


def test_packed_mask_round_trips() -> None:
    rng = np.random.default_rng(3)
    for share in (0.0, 0.01, 0.5, 1.0):
        mask = rng.random(TOTAL) < share
        assert (selection.unpack(selection.pack(mask), TOTAL) == mask).all()
    assert selection.pack(np.zeros(TOTAL, bool)) == EMPTY_MASK


def test_refine_button_matches_the_refine_step_of_a_region() -> None:
    scene = bear().scene
    near = Neighborhood(scene)
    facts = SceneFacts("bear.ply", len(scene), Bounds(), (), neighborhood=lambda: near)
    rough = scene.means[:, 1].numpy() > 0.3
    work = selecting(workspace.new_workspace(first_view(bear())), rough)
    refined = perform(work, Plain("select_refine"), facts).view.selection
    mask = selection.unpack(refined.members, len(scene))
    assert np.array_equal(mask, read_step("refine")(near, rough))
    assert refined.count == mask.sum() != rough.sum()


@pytest.mark.parametrize("members", [b"not packed", selection.pack(every(3))[:-9]])
def test_mask_of_another_size_is_refused(members: bytes) -> None:
    with pytest.raises(ProgdfError, match="select it again"):
        selection.unpack(members, TOTAL)


@pytest.mark.parametrize("total", [0, 1, 8, 9, 1000, 1999])
def test_mask_adapts_to_added_and_removed_rows(total: int) -> None:
    rng = np.random.default_rng(3)
    mask = rng.random(1000) < 0.5
    kept = np.flatnonzero(rng.random(1000) < 0.3)
    expected = np.zeros(total, bool)
    expected[:1000] = mask[:total]
    assert np.array_equal(selection.unpack(selection.pack(mask), total), expected)
    state = SelectionState(members=selection.pack(mask), count=int(mask.sum()))
    remaining = selection.take_rows(state, 1000, kept)
    assert np.array_equal(selection.unpack(remaining.members, len(kept)), mask[kept])
    assert remaining.count == mask[kept].sum()


@pytest.mark.parametrize("total", [8, 1009, 2000])
def test_stored_mask_must_fit_its_scene(total: int) -> None:
    state = SelectionState(members=selection.pack(every(2)))
    selection.check(state, TOTAL)
    with pytest.raises(ProgdfError, match="does not fit"):
        selection.check(state, total)


def test_hidden_splats_cannot_be_selected_until_all_are_shown() -> None:
    state = selection.select(SelectionState(), every(2))
    assert state.count == 502
    hidden = selection.hide(state, every(2))
    assert hidden.count == 0
    assert selection.select(hidden, every(1)).count == 501
    assert selection.select(selection.show_all(hidden), every(1)).count == TOTAL


def test_isolate_hides_all_but_the_selection() -> None:
    state = selection.select(SelectionState(), every(4))
    alone = selection.isolate(state, TOTAL)
    assert (selection.unpack(alone.hidden, TOTAL) == ~every(4)).all()
    assert alone.members == state.members
    assert selection.isolate(SelectionState(), TOTAL) == SelectionState()


def test_selection_is_one_undo_entry_but_no_unsaved_change() -> None:
    work = workspace.new_workspace(first_view(bear(), 0.5, 0.5))
    facts = SceneFacts("bear.ply", TOTAL, None, ())  # type: ignore[arg-type]
    once = selecting(work, every(5))
    twice = selecting(once, every(7))
    assert len(twice.past.past) == 2
    assert not workspace.has_unsaved(twice)
    assert perform(twice, Plain("undo"), facts).view.selection == once.view.selection
    assert perform(perform(twice, Plain("undo"), facts), Plain("redo"), facts).view == twice.view
    kept = selection.add_region(twice.view.selection, "jacket", Path("jacket.region.npy"))
    assert workspace.has_unsaved(replace(twice, view=replace(twice.view, selection=kept)))


def test_region_names_are_unique_and_valid_file_names() -> None:
    state = selection.add_region(SelectionState(), "jacket", Path("jacket.region.npy"))
    assert selection.free_name(state, " Jacket ") == "Jacket-2"
    assert selection.free_name(state, "a/b\\c:d\n e") == "a_b_c_d e"
    assert selection.free_name(state, "../..") == "_"
    assert selection.free_name(state, "") == "region"
    assert selection.free_name(state, "con") == "region con"
    assert selection.free_name(state, "a" * 59 + ". b") == "a" * 59
