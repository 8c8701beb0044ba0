"""Check box of a removal in the window: its hole is filled, the filling stopped, and the fill taken away."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from progdf.region import from_mask
from progdf.tidy import Step, leave_paint, tidy
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view
from tests.viewer.app.test_studio import Trainer, request, turn
from viewer.app import app as application
from viewer.jobs import job_queue, training
from viewer.state import selection
from viewer.state.commands import OnItem, Plain
from viewer.state.facts import layer_rows

pytestmark = pytest.mark.gl
ROWS = [3, 7, 11]


@pytest.fixture
def window(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[application.App]:
    """Return a window in which a selection was just removed."""
    folder = bear_files(tmp_path)
    monkeypatch.setattr(job_queue, "Child", Trainer)
    Trainer.ended = None
    Trainer.line = ""
    document = replace(opened_document(folder), edits=(), gdf_paths=())
    Trainer.edit = tmp_path / "filled.gdf"
    save_gdf(Trainer.edit, filled())
    with null_app(document, first_view(bear()), folder) as app:
        mask = np.zeros(len(document.original), bool)
        mask[ROWS] = True
        view = app.main_view.work.view
        view = replace(view, selection=selection.select(view.selection, mask))
        app.main_view.store.replace(replace(app.main_view.work, view=view))
        request(app, Plain("remove_selected"))
        yield app


def filled() -> Gdf:
    """Return the removal as `progdf train` makes it: with added rows and a report."""
    scene = bear().scene
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[ROWS] = True
    gdf = tidy(scene, [Step("remove", from_mask("gone", mask))], "removed filled", "remove", scene[:4])
    return replace(gdf, report={"removal": {}})


def shown(app: application.App) -> Gdf:
    (layer,) = app.main_view.work.view.layers
    return app.documents.get().edits[layer.gdf]


def test_hole_is_filled_by_a_run_and_the_removal_stays_until_then(window: application.App) -> None:
    (row,) = window.main_view.facts.rows
    assert row.hole == "open"
    request(window, OnItem("fill_hole", 0))
    assert "--editor=remove" in Trainer.said
    region = next(word for word in Trainer.said if word.startswith("--region=file:"))
    assert np.load(region.removeprefix("--region=file:")).tolist() == ROWS
    (job,) = window.main_view.work.jobs
    assert job.name == "Fill the hole of “removed”"
    assert (job.status, job.fills) == ("running", window.main_view.work.view.layers[0].gdf)
    assert shown(window).added is None, "the unfilled removal is shown until the fill is there"
    Trainer.ended = 0
    turn(window)
    assert window.main_view.work.jobs == ()
    assert shown(window).added is not None
    row = window.main_view.facts.rows[window.main_view.work.view.layers[0].gdf]
    assert row.hole == "filled"


def test_fill_can_be_undone_and_taken_away(window: application.App) -> None:
    request(window, OnItem("fill_hole", 0))
    Trainer.ended = 0
    turn(window)
    press(window, "Ctrl+Z")
    assert shown(window).added is None
    press(window, "Ctrl+Shift+Z")
    assert shown(window).added is not None
    request(window, OnItem("fill_hole", 0))
    assert shown(window).added is None


def test_second_press_stops_the_filling(window: application.App) -> None:
    request(window, OnItem("fill_hole", 0))
    request(window, OnItem("fill_hole", 0))
    turn(window)
    assert window.main_view.work.jobs == ()
    assert window.parts.jobs.queue.jobs == ()
    assert shown(window).added is None


def test_removed_layer_gets_no_fill(window: application.App) -> None:
    request(window, OnItem("fill_hole", 0))
    press(window, "Ctrl+Z")
    assert window.main_view.work.view.layers == ()
    Trainer.ended = 0
    turn(window)
    assert window.main_view.work.view.layers == ()


def test_filled_removal_without_its_first_file_explains(window: application.App) -> None:
    request(window, OnItem("fill_hole", 0))
    Trainer.ended = 0
    turn(window)
    folder = training.edits_folder(window.documents.get().file)
    (folder / "removed.gdf").unlink()
    with pytest.raises(ProgdfError, match="without the fill has no file"):
        window.parts.jobs.requests["fill_hole"](0)
    assert load_gdf(folder / "removed filled" / "removed filled.gdf", bear().scene).added is not None


def test_only_removals_have_a_hole() -> None:
    scene = bear().scene
    region = from_mask("a", torch.arange(len(scene)) < 9)
    removed = tidy(scene, [Step("remove", region)], "a", "remove")
    keeps_paint = tidy(scene, [Step("remove", region)], "a", "remove", leaves_paint=True)
    other = tidy(scene, [Step("remove", region)], "a", "recolor:#ff0000")
    rows = layer_rows(scene, [removed, filled(), keeps_paint, other])
    assert [row.hole for row in rows] == ["open", "filled", "open", ""]
    assert 5.0 < rows[0].fill_seconds < 60.0


def test_filled_removal_leaves_paint_where_the_removal_did(window: application.App) -> None:
    (layer,) = window.main_view.work.view.layers
    document = window.documents.get()
    painted = leave_paint(document.edits[layer.gdf])
    window.documents.replace(replace(document, edits=(painted,)))
    request(window, OnItem("fill_hole", 0))
    Trainer.ended = 0
    turn(window)
    filled_edit = shown(window)
    assert filled_edit.added is not None
    assert filled_edit.anchors is not None
    assert filled_edit.anchors.leaves_paint
