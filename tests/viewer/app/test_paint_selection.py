"""Selections of a painted object: its paint is selected, removed, moved and copied with it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from progdf.compose.layer_paint import layer_of
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import UNSEEN_LOGIT, load_gdf
from progdf.rasterize import render
from tests.helpers.painted_box import PaintedBox, painted_box, six_cameras
from tests.helpers.sessions import layer_maker
from viewer.app.messages import Messages
from viewer.app.parts.tidy import TidyActions
from viewer.camera.view_camera import ViewCamera
from viewer.files import region_files
from viewer.files.document import Document, DocumentStore
from viewer.state import actions, selection
from viewer.state.commands import OnItem, Plain, SelectRegion
from viewer.state.layers import visible_layers
from viewer.state.transient import Gizmo
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import Store, new_workspace, with_transient

Mask = NDArray[np.bool_]


@dataclass
class Desk:
    """State of a window with a painted box."""

    box: PaintedBox
    store: Store
    documents: DocumentStore
    tidy: TidyActions

    @property
    def view(self) -> ViewState:
        return self.store.get().view

    @property
    def selected(self) -> Mask:
        return selection.unpack(self.view.selection.members, len(self.documents.get().scene))

    @property
    def box_mask(self) -> Mask:
        mask = np.zeros(len(self.documents.get().scene), bool)
        mask[self.box.box.members] = True
        return mask

    @property
    def paint_mask(self) -> Mask:
        return np.arange(len(self.documents.get().scene)) >= len(self.box.scene)

    def select(self, mask: Mask) -> None:
        self.store.change(replace(self.view, selection=selection.select(self.view.selection, mask)))

    def perform(self, *commands: Plain | SelectRegion | OnItem) -> None:
        for command in commands:
            work = actions.perform(self.store.get(), command, self.documents.get().facts())
            self.store.change(work.view)

    def composed(self) -> Gaussians:
        document = self.documents.get()
        layers = [
            layer_of(document.gdfs[layer.gdf], layer.strength, layer.gains, layer.paint)
            for layer in visible_layers(self.view)
        ]
        return compose_layers(document.scene, layers, self.view.blend)

    def keep_at(self, *shift: float) -> None:
        """Move the handles and keep the result."""
        gizmo = self.store.get().transient.gizmo
        assert isinstance(gizmo, Gizmo)
        matrix = np.eye(4)
        matrix[:3, 3] = shift
        self.store.replace(with_transient(self.store.get(), gizmo=replace(gizmo, matrix=matrix)))
        self.tidy.requests["keep_placed"](None)


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    box = painted_box()
    document = Document("box.ply", box.scene, (box.paint,), tmp_path / "box.ply", (tmp_path / "logo.gdf",))
    store = Store(new_workspace(ViewState(ViewCamera(), (LayerState(0, "logo", 1.0),))), lambda: None)
    documents = DocumentStore(document, lambda *_: None)
    maker = layer_maker(store, documents, Messages(store, lambda: 0.0))
    return Desk(box, store, documents, TidyActions(store=store, documents=documents, maker=maker))


def test_selected_object_has_its_paint_with_and_without_it(desk: Desk) -> None:
    desk.select(desk.box_mask)
    desk.perform(Plain("select_with_paint"))
    assert (desk.selected == (desk.box_mask | desk.paint_mask)).all()
    assert desk.view.selection.count == len(desk.box.box) + int(desk.paint_mask.sum())
    desk.perform(Plain("select_without_paint"))
    assert (desk.selected == desk.box_mask).all()
    desk.perform(Plain("select_paint"))
    assert (desk.selected == desk.paint_mask).all()
    desk.select(~desk.box_mask & ~desk.paint_mask)
    before = desk.selected
    desk.perform(Plain("select_paint"), Plain("select_with_paint"))
    assert (desk.selected == before).all(), "the floor has no paint"


def test_paint_of_deleted_layers_is_not_selected(desk: Desk) -> None:
    desk.store.change(replace(desk.view, layers=()))
    desk.select(desk.box_mask)
    desk.perform(Plain("select_with_paint"))
    assert (desk.selected == desk.box_mask).all()


def test_part_of_an_object_has_the_paint_above_it(desk: Desk) -> None:
    left = desk.box_mask & (desk.documents.get().scene.means[:, 0] < 0.05).numpy()
    desk.select(left)
    desk.perform(Plain("select_with_paint"))
    x = desk.documents.get().scene.means[:, 0].numpy()
    painted = desk.selected & desk.paint_mask
    assert painted.any()
    assert float(x[painted].max()) <= 0.15
    assert (x[desk.paint_mask & ~painted] > -0.01).all()


def test_region_and_grown_selection_have_the_paint(desk: Desk, tmp_path: Path) -> None:
    desk.select(desk.box_mask)
    kept = region_files.keep_region(desk.view.selection, "box", tmp_path, len(desk.box.scene))
    desk.store.change(replace(desk.view, selection=kept))
    rows = np.load(tmp_path / "box.region.npy")
    assert (rows == desk.box.box.members.numpy()).all(), "an edit trains rows of the scene"
    desk.perform(Plain("select_none"), SelectRegion(0))
    assert (desk.selected == (desk.box_mask | desk.paint_mask)).all()
    desk.select(desk.box_mask & (np.arange(len(desk.box_mask)) % 2 == 0))
    desk.perform(Plain("select_grow"))
    assert desk.selected[desk.paint_mask].all()


def test_region_of_paint_alone_is_refused(desk: Desk, tmp_path: Path) -> None:
    desk.select(desk.paint_mask)
    with pytest.raises(ProgdfError, match="only paint is selected"):
        region_files.keep_region(desk.view.selection, "paint", tmp_path, len(desk.box.scene))


def test_hidden_object_hides_its_paint(desk: Desk) -> None:
    desk.select(desk.box_mask)
    desk.perform(Plain("select_with_paint"), Plain("hide_selected"))
    hidden = selection.unpack(desk.view.selection.hidden, len(desk.box_mask))
    assert (hidden == (desk.box_mask | desk.paint_mask)).all()


def test_removed_object_takes_its_paint_from_every_side(desk: Desk) -> None:
    desk.select(desk.box_mask | desk.paint_mask)
    desk.tidy.requests["remove_selected"](None)
    shown = desk.composed()
    kept = torch.from_numpy(~(desk.box_mask | desk.paint_mask))
    for camera in six_cameras():
        alone = render(shown[kept], camera, (0.2, 0.4, 0.9)).image
        assert torch.equal(render(shown, camera, (0.2, 0.4, 0.9)).image, alone)


def test_object_is_removed_without_its_paint(desk: Desk) -> None:
    desk.select(desk.box_mask)
    desk.tidy.requests["remove_selected"](None)
    drawn = (desk.composed().logit_opacities >= UNSEEN_LOGIT).numpy()
    assert not drawn[desk.box_mask].any()
    assert drawn[desk.paint_mask].all()
    document = desk.documents.get()
    loaded = load_gdf(document.gdf_paths[1], document.original)
    assert loaded.anchors is not None
    assert loaded.anchors.leaves_paint, "the file keeps this"


def test_removed_paint_is_erased_and_what_it_pushed_returns(desk: Desk) -> None:
    desk.select(desk.paint_mask)
    desk.tidy.requests["remove_selected"](None)
    shown = desk.composed()
    assert bool((shown.logit_opacities[torch.from_numpy(desk.paint_mask)] < UNSEEN_LOGIT).all())
    count = len(desk.box.scene)
    assert torch.equal(shown.means[:count], desk.box.scene.means)
    assert len(desk.view.layers) == 1, "no layer is added"
    assert not desk.view.selection.count
    assert len(desk.store.get().past.past) == 2, "the selection, and the removal"
    locked = replace(desk.view, layers=(replace(desk.view.layers[0], locked=True, paint=""),))
    desk.store.change(locked)
    desk.select(desk.paint_mask)
    with pytest.raises(ProgdfError, match="logo is locked"):
        desk.tidy.requests["remove_selected"](None)


def test_moved_object_takes_its_paint_or_leaves_it(desk: Desk) -> None:
    paint = torch.from_numpy(desk.paint_mask)
    before = desk.composed().means[paint]
    desk.select(desk.box_mask | desk.paint_mask)
    desk.tidy.requests["move_selected"](None)
    desk.keep_at(0.5, 0.25, 0.0)
    step = desk.composed().means[paint] - before
    torch.testing.assert_close(step, torch.tensor([0.5, 0.25, 0.0]).expand_as(step), atol=1e-3, rtol=0)
    desk.store.change(replace(desk.view, layers=desk.view.layers[:1]))
    desk.select(desk.box_mask)
    desk.tidy.requests["move_selected"](None)
    desk.keep_at(0.5, 0.25, 0.0)
    assert torch.equal(desk.composed().means[paint], before)
    desk.select(desk.paint_mask)
    with pytest.raises(ProgdfError, match="only paint is selected"):
        desk.tidy.requests["move_selected"](None)


@pytest.mark.parametrize(("box", "paint"), [(True, True), (True, False), (False, True)])
def test_copy_has_the_selected_paint(desk: Desk, box: bool, paint: bool) -> None:
    mask = (desk.box_mask & box) | (desk.paint_mask & paint)
    original = desk.composed()
    count = len(original)
    desk.select(mask)
    desk.tidy.requests["duplicate_selected"](None)
    desk.keep_at(0.0, 0.0, -3.0)
    copy = desk.composed()[count:]
    assert len(copy) == int(mask.sum())
    if not paint:
        original = desk.box.scene
        mask = mask[: len(original)]
    expected = original.means[torch.from_numpy(mask)] + torch.tensor([0.0, 0.0, -3.0])
    torch.testing.assert_close(copy.means, expected, atol=1e-5, rtol=0)
    assert bool((copy.logit_opacities > 5.0).all())


def test_copy_of_a_moved_object_is_at_its_new_place(desk: Desk) -> None:
    rows = np.flatnonzero(desk.box_mask[: len(desk.documents.get().original)])
    desk.select(desk.box_mask | desk.paint_mask)
    desk.tidy.requests["move_selected"](None)
    desk.keep_at(0.5, 0.0, 0.0)
    moved = desk.composed()
    desk.select(desk.box_mask | desk.paint_mask)
    desk.tidy.requests["duplicate_selected"](None)
    desk.keep_at(0.0, 0.0, -3.0)
    copy = desk.composed()[len(moved) :]
    expected = moved.means[torch.from_numpy(rows)] + torch.tensor([0.0, 0.0, -3.0])
    torch.testing.assert_close(copy.means[: len(rows)], expected, atol=1e-4, rtol=0)


def test_copy_without_visible_paint_has_none(desk: Desk) -> None:
    off = replace(desk.view.layers[0], enabled=False)
    desk.store.change(replace(desk.view, layers=(off,)))
    desk.select(desk.box_mask | desk.paint_mask)
    desk.tidy.requests["duplicate_selected"](None)
    desk.keep_at(0.0, 0.0, -3.0)
    added = desk.documents.get().edits[1].added
    assert added is not None
    assert len(added) == len(desk.box.box)


def copied_box(desk: Desk) -> Mask:
    """Copy the painted box to the side and return the rows of the copy."""
    desk.select(desk.box_mask | desk.paint_mask)
    desk.tidy.requests["duplicate_selected"](None)
    desk.keep_at(0.0, 0.0, -3.0)
    document = desk.documents.get()
    rows = document.gdfs[1].region.members.numpy()
    mask = np.zeros(len(document.scene), bool)
    mask[rows] = True
    return mask & (np.arange(len(mask)) >= len(document.original))


def test_copy_is_copied_and_removed(desk: Desk) -> None:
    copy = copied_box(desk)
    count = len(copy)
    desk.select(copy)
    desk.tidy.requests["duplicate_selected"](None)
    desk.keep_at(2.0, 0.0, 0.0)
    again = desk.composed()[count:]
    step = again.means - desk.composed().means[torch.from_numpy(np.flatnonzero(copy))]
    torch.testing.assert_close(step, torch.tensor([2.0, 0.0, 0.0]).expand_as(step), atol=1e-5, rtol=0)
    desk.select(np.append(copy, np.zeros(len(again), bool)))
    desk.tidy.requests["remove_selected"](None)
    drawn = (desk.composed().logit_opacities >= UNSEEN_LOGIT).numpy()
    assert not drawn[:count][copy].any()
    assert drawn[:count][~copy].all()
    assert drawn[count:].all(), "the second copy stays"


def test_copy_of_invisible_paint_alone_is_refused(desk: Desk) -> None:
    desk.store.change(replace(desk.view, layers=(replace(desk.view.layers[0], strength=0.0),)))
    desk.select(desk.paint_mask)
    with pytest.raises(ProgdfError, match="the layers hide everything that is selected"):
        desk.tidy.requests["duplicate_selected"](None)
    assert desk.store.get().transient.gizmo is None
