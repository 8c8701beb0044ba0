"""Test of parts of the window, built without a window from their collaborators."""

from __future__ import annotations

from dataclasses import dataclass, field
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.sessions import layer_maker
from tests.helpers.ui_rig import bear, first_view
from viewer.app.messages import Messages
from viewer.app.parts.deliver import DeliverActions
from viewer.app.parts.tidy import TidyActions
from viewer.files.document import Document, DocumentStore, LiveLayers
from viewer.jobs.job_queue import JobQueue
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.transient import Gizmo
from viewer.state.workspace import Store, Workspace, new_workspace


@dataclass
class Desk:
    """Collaborators of a part, with a record of the drawn documents."""

    store: Store
    messages: Messages
    documents: DocumentStore
    drawn: list[tuple[Document, LiveLayers]] = field(default_factory=list)
    frames: int = 0  # requested frames

    @property
    def work(self) -> Workspace:
        return self.store.get()


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    """Return the collaborators of an open bear with a file."""
    opened = Document("bear.ply", bear().scene, path=tmp_path / "bear.ply")
    made: Desk

    def wake() -> None:
        made.frames += 1

    store = Store(new_workspace(first_view(bear())), wake)
    documents = DocumentStore(opened, lambda document, _, layers: made.drawn.append((document, layers)))
    made = Desk(store, Messages(store, lambda: 2.0), documents)
    return made


def test_removed_selection_becomes_a_layer(desk: Desk, tmp_path: Path) -> None:
    maker = layer_maker(desk.store, desk.documents, desk.messages)
    part = TidyActions(store=desk.store, documents=desk.documents, maker=maker)
    select(desk)
    part.requests["remove_selected"](None)
    assert [layer.name for layer in desk.work.view.layers] == ["removed"]
    assert [document.gdf_paths for document, _ in desk.drawn] == [desk.documents.get().gdf_paths]
    assert desk.documents.get().gdf_paths[0].is_relative_to(tmp_path)
    assert len(desk.work.past.past) == 2, "the selection, and the layer"
    assert desk.frames


def test_moved_selection_is_drawn_as_a_live_layer(desk: Desk) -> None:
    maker = layer_maker(desk.store, desk.documents, desk.messages)
    part = TidyActions(store=desk.store, documents=desk.documents, maker=maker)
    select(desk)
    part.requests["move_selected"](None)
    gizmo = desk.work.transient.gizmo
    assert isinstance(gizmo, Gizmo)
    assert gizmo.does == "transform"
    part.requests["place"](None)
    assert [[layer.name for layer in layers] for _, layers in desk.drawn] == [["moved"]]
    assert not desk.documents.get().edits, "a live edit is no edit of the document"
    part.leave_scene()
    assert desk.work.transient.gizmo is None


def test_delivery_asks_for_a_path_in_the_folder_of_the_scene(desk: Desk, tmp_path: Path) -> None:
    queue = JobQueue()
    part = DeliverActions(store=desk.store, documents=desk.documents, messages=desk.messages, queue=queue)
    part.requests["export"](None)
    assert desk.work.dialog is not None
    assert desk.work.dialog.text == str(tmp_path / "bear_edited.ply")
    queue.close()


def test_messages_and_requests_are_part_of_the_state(desk: Desk) -> None:
    desk.messages.show("done")
    assert desk.work.message is not None
    assert (desk.work.message.text, desk.work.message.until > 2.0) == ("done", True)
    desk.messages.request(Plain("save"))
    assert desk.work.requests == (Plain("save"),)
    assert desk.frames == 2


def test_document_stays_if_it_cannot_be_drawn(desk: Desk) -> None:
    def fails(*_: object) -> None:
        raise MemoryError

    before = desk.documents.get()
    documents = DocumentStore(before, fails)
    with pytest.raises(MemoryError):
        documents.replace(changed(before, title="other"))
    assert documents.get() is before


def select(desk: Desk) -> None:
    """Select a third of the scene."""
    view = desk.work.view
    mask = np.arange(len(bear().scene)) % 3 == 0
    desk.store.change(changed(view, selection=selection.select(view.selection, mask)))
