"""Removing, moving and copying a selection by hand; each becomes a layer with a slider."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from progdf.compose.layer_paint import layer_of
from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.formats.ply import load_ply
from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.region import whole_scene
from progdf.similarity import affine_motion
from progdf.tidy import Step, tidy
from tests.helpers.edits import bits
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import bear, first_view
from viewer.app.app import App
from viewer.commands.export import export
from viewer.files import session
from viewer.files.session import WindowSession
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.transient import Gizmo
from viewer.state.workspace import with_transient

pytestmark = pytest.mark.gl


@pytest.fixture
def app(folder: Path) -> Iterator[App]:
    with null_app(opened_document(folder), first_view(bear(), 0.5, 0.5), folder) as app:
        mask = np.zeros(app.main_view.facts.count, bool)
        mask[bear().demo.members("scarf")] = True
        view = app.main_view.work.view
        app.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
        yield app


def top(app: App) -> int:
    return app.main_view.work.view.layers[-1].gdf


def shown(app: App) -> torch.Tensor:
    return app.engine.gaussians(app.main_view.work.view).opacities


def test_removed_selection_is_a_layer_that_undo_restores(app: App, folder: Path) -> None:
    members = bear().demo.members("scarf")
    count = len(bear().scene)
    press(app, "Alt+Delete")
    layer = app.main_view.work.view.layers[-1]
    assert (layer.name, layer.strength) == ("removed", 1.0)
    assert not app.main_view.work.view.selection.count
    assert float(shown(app)[members].max()) < 1 / 255
    press(app, "Ctrl+Z")
    assert "removed" not in [layer.name for layer in app.main_view.work.view.layers]
    assert len(shown(app)) == count
    assert app.main_view.work.view.selection.count == len(members)


def test_moved_selection_follows_the_gizmo_and_can_be_canceled(app: App) -> None:
    press(app, "Alt+M")
    gizmo = app.main_view.work.transient.gizmo
    assert gizmo is not None
    matrix = np.eye(4)
    matrix[:3, 3] = 0.5, 0.25, -0.125
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=replace(gizmo, matrix=matrix)))
    app.main_view.messages.request(Plain("place"))
    app.draw()
    app.draw()
    assert [layer.name for layer in app.main_view.work.transient.live] == ["moved"]
    press(app, "Escape")
    assert app.main_view.work.transient.gizmo is None
    assert not app.main_view.work.transient.live
    press(app, "R", "Alt+M")  # Enter keeps the result also while a selection tool is active
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=replace(gizmo, matrix=matrix)))
    press(app, "Enter")
    assert app.main_view.work.renaming is None
    members = bear().demo.members("scarf")
    means = app.engine.gaussians(app.main_view.work.view).means[members] - bear().scene.means[members]
    assert torch.allclose(means, torch.tensor(matrix[:3, 3]).float(), atol=1e-4)
    press(app, "Ctrl+A", "Alt+M", "Enter")
    assert app.main_view.work.view.layers[-1].name == "moved", (
        "nothing was moved, so there is no second layer"
    )


@pytest.mark.parametrize("stretch", [1.0, 1.7])
def test_dragged_move_under_layers_is_composed_in_place_and_exact(app: App, stretch: float) -> None:
    view = app.main_view.work.view
    strong = replace(view, layers=tuple(replace(layer, strength=0.7) for layer in view.layers))
    app.main_view.store.change(strong)
    press(app, "Ctrl+A", "Alt+M")
    gizmo = app.main_view.work.transient.gizmo
    assert isinstance(gizmo, Gizmo)
    engines = []
    for angle in (0.2, 0.5):
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_rotvec((0.0, angle, 0.1)).as_matrix() @ np.diag((1.0, stretch, 1.0))
        matrix[:3, 3] = angle, 0.25, -0.125
        app.main_view.store.replace(
            with_transient(app.main_view.work, gizmo=replace(gizmo, matrix=matrix, shown=matrix))
        )
        app.main_view.messages.request(Plain("place"))
        app.draw()
        app.draw()
        engines.append(app.engine)
    assert engines[0] is engines[1], "only the moved Gaussians are composed again"
    region = whole_scene(bear().scene)
    center = torch.tensor(gizmo.center, dtype=torch.float64)
    motion = affine_motion(torch.tensor(matrix[:3, :3]), torch.tensor(matrix[:3, 3]), center)
    moved = tidy(app.documents.get().original, [Step("transform", region, motion)], "moved", only_end=True)
    document = app.documents.get()
    layers = [layer_of(document.gdfs[l.gdf], l.strength, l.gains, l.paint, l.blend) for l in strong.layers]
    expected = compose_layers(document.scene, [*layers, Layer(moved)], strong.blend)
    drawn = app.engine.gaussians(app.main_view._displayed_view())
    torch.testing.assert_close(drawn.means, expected.means, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(_covariances(drawn), _covariances(expected), rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(drawn.sh, expected.sh, rtol=1e-4, atol=1e-4)


def _covariances(scene: Gaussians) -> torch.Tensor:
    axes = rotation_matrices(scene.unit_quats) * scene.scales[:, None, :]
    return axes @ axes.mT


def test_copy_has_rows_that_are_counted_selected_saved_and_exported(
    app: App, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    members = bear().demo.members("scarf")
    scene = bear().scene
    press(app, "Alt+D", "Enter")
    facts = app.main_view.facts
    assert (facts.count, facts.added) == (len(scene) + len(members), len(members))
    assert facts.rows[top(app)].added == len(members)
    view = app.main_view.work.view
    view = replace(view, selection=selection.hide(view.selection, np.ones(facts.count, bool)))
    app.main_view.store.change(view)
    app.draw()
    path = folder / "work.session.json"
    session.save(path, WindowSession(app.documents.get(), view))
    again = session.open_session(path)
    assert again.view.selection == view.selection
    assert again.view.layers == view.layers
    without = replace(view, layers=view.layers[:-1])
    session.save(path, WindowSession(app.documents.get(), without))
    kept = session.open_session(path)
    assert len(kept.document.scene) == len(scene)
    assert selection.unpack(kept.view.selection.hidden, len(scene)).all()
    copy = app.documents.get().gdf_paths[-1]
    for strength, count in (("0", len(scene)), ("1", len(scene) + len(members))):
        out = folder / f"out{strength}.ply"
        words = [f"--set={app.documents.get().edits[-1].name}={strength}", f"-o={out}"]
        export([str(folder / "bear.ply"), str(copy), *words])
        assert len(load_ply(out)) == count
    assert bits(load_ply(folder / "out0.ply")) == bits(load_ply(folder / "bear.ply"))


def test_copy_has_the_colors_that_layers_give_it(app: App) -> None:
    ears = app.documents.get().gdfs[1].region.members
    mask = np.zeros(app.main_view.facts.count, bool)
    mask[ears.numpy()] = True
    view = app.main_view.work.view
    app.main_view.store.change(replace(view, selection=selection.select(view.selection, mask)))
    seen = app.engine.gaussians(view)
    press(app, "Alt+D", "Enter")
    copy = app.engine.gaussians(app.main_view.work.view)[
        torch.arange(len(bear().scene), len(seen) + len(ears))
    ]
    assert not torch.equal(seen.sh0[ears], bear().scene.sh0[ears])
    torch.testing.assert_close(copy.sh0, seen.sh0[ears], atol=1e-5, rtol=0)


def test_tidy_actions_need_a_selection(app: App) -> None:
    press(app, "Ctrl+Shift+A", "Alt+Delete")
    message = app.main_view.work.message
    assert message is not None
    assert message.error
    assert "nothing is selected" in message.text
    assert len(app.main_view.work.view.layers) == 2
