"""Scenes of the window: added, placed, hidden, edited, removed and saved; undo covers all of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.formats.ply import load_ply, save_ply
from progdf.gdf.file import fingerprint, read_gdf
from progdf.gdf.placed import Placement
from tests.helpers.null_app import null_app, press
from tests.helpers.scenes import random_gaussians
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.files import session
from viewer.jobs.preview_process import RegionSample
from viewer.state import selection
from viewer.state.commands import OnItem, Plain, WithText
from viewer.state.forms import SELECTION, with_settings
from viewer.state.transient import Gizmo
from viewer.state.view_state import SceneState
from viewer.state.workspace import with_transient

pytestmark = pytest.mark.gl
COUNT = 60


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    """Yield a window with the bear and a second scene."""
    save_ply(folder / "cloud.ply", random_gaussians(COUNT, 3))
    with null_app(opened_document(folder), first_view(bear(), 0.5, 0.5), folder) as app:
        app.parts.scene_list.drop(folder / "cloud.ply")
        question = app.store.get().question
        assert question is not None
        assert [label for label, _ in question.buttons] == ["Add to this view", "Open instead"]
        app.handle(WithText("add_file", str(folder / "cloud.ply")))
        app.draw()
        yield app


def scenes(app: App) -> list[tuple[str, bool]]:
    return [(state.name, state.visible) for state in app.store.get().view.scenes]


def opacities(app: App) -> torch.Tensor:
    app.parts.scene_list.poll()
    return app.engine.gaussians(app.store.get().view).opacities


def cloud(app: App) -> torch.Tensor:
    """Return the centers of the second scene in the picture."""
    app.parts.scene_list.poll()
    first = len(bear().scene)
    return app.engine.gaussians(app.store.get().view).means[first : first + COUNT].clone()


def test_scene_is_added_hidden_and_shown_with_undo(app: App) -> None:
    first = len(bear().scene)
    assert scenes(app) == [("bear.ply", True), ("cloud.ply", True)]
    before = opacities(app).clone()
    app.handle(OnItem("show_scene", 1))
    assert not opacities(app)[first : first + COUNT].any()
    app.handle(OnItem("show_scene", 1))
    assert torch.equal(opacities(app), before)
    app.handle(OnItem("show_scene", 0))
    assert not opacities(app)[:first].any()
    press(app, "Ctrl+Z", "Ctrl+Z", "Ctrl+Z", "Ctrl+Z")
    assert app.store.get().view.scenes == ()
    assert torch.equal(opacities(app)[:first], before[:first])
    assert not opacities(app)[first : first + COUNT].any()
    press(app, "Ctrl+Y")
    assert torch.equal(opacities(app), before)


def test_grade_of_the_second_scene_leaves_the_first_unchanged(app: App) -> None:
    first = len(bear().scene)
    total = first + COUNT
    work = app.store.get()
    mask = np.arange(total) >= first
    view = replace(work.view, selection=selection.select(work.view.selection, mask))
    form = with_settings(work.form, "grade:exposure=1")
    assert form is not None
    form = replace(form, region=SELECTION)
    app.store.replace(replace(work, view=view, form=form, form_open=True))
    grading = app.parts.preview._grading
    grading.update()
    blank = np.zeros((4, 4, 3), np.float32)
    own_rows = np.arange(COUNT)  # the preview process has the second scene alone
    sample = RegionSample(own_rows, blank[0], blank[0, :, 0], blank, blank, blank[..., 0])
    grading.take(sample, (), grading.region_key())
    grading.update()
    assert app.engine.live is not None
    assert app.engine.live.rows.tolist() == list(range(first, total))


def test_moved_scene_is_placed_without_a_layer(app: App) -> None:
    before = cloud(app)
    layers = app.store.get().view.layers
    app.handle(OnItem("move_scene", 1))
    app.draw()
    gizmo = app.store.get().transient.gizmo
    assert isinstance(gizmo, Gizmo)
    matrix = np.eye(4)
    matrix[:3, 3] = 0.5, 0.25, -0.125
    app.store.replace(with_transient(app.store.get(), gizmo=replace(gizmo, matrix=matrix)))
    press(app, "Enter")
    assert app.store.get().view.layers == layers
    assert app.store.get().view.scenes[1].placement.shift == pytest.approx((0.5, 0.25, -0.125))
    moved = cloud(app)
    assert torch.allclose(moved - before, torch.tensor([0.5, 0.25, -0.125]), atol=1e-5)
    press(app, "Ctrl+Z")
    assert torch.equal(cloud(app), before)


def test_scene_cannot_be_placed_where_positions_are_coarse(app: App) -> None:
    app.handle(OnItem("move_scene", 1))
    app.draw()
    gizmo = app.store.get().transient.gizmo
    assert isinstance(gizmo, Gizmo)
    matrix = np.eye(4)
    matrix[0, 3] = 1e8
    app.store.replace(with_transient(app.store.get(), gizmo=replace(gizmo, matrix=matrix)))
    press(app, "Enter")
    message = app.store.get().message
    assert message is not None
    assert "place it nearer" in message.text
    assert app.store.get().view.scenes[1].placement == Placement()


def test_edit_of_a_scene_is_bound_to_its_file_and_follows_it(app: App, folder: Path) -> None:
    state = app.store.get().view.scenes[1]
    placed = replace(state.placement, shift=(2.0, 0.0, 0.0), turn=(0.0, 1.0, 0.0))
    view = app.store.get().view
    app.store.change(replace(view, scenes=(view.scenes[0], replace(state, placement=placed))))
    app.parts.scene_list.poll()
    mask = np.zeros(app.main_view.facts.count, bool)
    mask[len(bear().scene) :][: COUNT // 2] = True
    view = app.store.get().view
    app.store.change(replace(view, selection=selection.select(view.selection, mask)))
    press(app, "Alt+Delete")
    app.parts.maker.wait()
    opened = app.documents.get()
    assert opened.owners[-1] == 1
    assert read_gdf(opened.gdf_paths[-1]).scene == fingerprint(load_ply(folder / "cloud.ply"))
    first = len(bear().scene)
    assert float(opacities(app)[first : first + COUNT // 2].max()) < 1 / 255
    assert float(opacities(app)[first + COUNT // 2 : first + COUNT].min()) > 1 / 255
    both = mask.copy()
    both[0] = True
    view = app.store.get().view
    app.store.change(replace(view, selection=selection.select(view.selection, both)))
    press(app, "Alt+Delete")
    message = app.store.get().message
    assert message is not None
    assert "belongs to one scene" in message.text
    app.parts.file_actions.save(folder / "two.session.json")
    again = session.open_session(folder / "two.session.json")
    assert again.document.owners[-1] == 1
    assert again.view.scenes[1].placement == placed


def test_removed_scene_takes_its_layers_and_returns_with_undo(app: App) -> None:
    layers = app.store.get().view.layers
    app.handle(OnItem("remove_scene", 0))
    app.draw()
    assert app.store.get().view.layers == ()
    assert [state.scene for state in app.store.get().view.scenes] == [1]
    assert app.documents.get().title == "cloud.ply"
    app.handle(OnItem("remove_scene", 0))
    message = app.store.get().message
    assert message is not None
    assert "only scene" in message.text
    press(app, "Ctrl+Z")
    app.parts.scene_list.poll()
    assert app.store.get().view.layers == layers
    assert app.documents.get().path is not None
    assert app.documents.get().title != "cloud.ply"
    assert isinstance(app.store.get().view.scenes[0], SceneState)
    app.main_view.messages.request(Plain("add_scene"))
    app.draw()
    dialog = app.store.get().dialog
    assert dialog is not None
    assert dialog.kind == "add_scene"
