"""Assembly of the window's parts: each receives exactly the collaborators that it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from viewer.app.main_view import MainView
from viewer.app.messages import Requests, WaitFor
from viewer.files import exports
from viewer.files.document import DocumentStore
from viewer.ui.window import wake_window

from .deliver import DeliverActions
from .edits import EditActions
from .file_actions import FileActions, OpenDocument
from .making import LayerMaker
from .painting import PaintingActions
from .pictures import PictureActions
from .preview import PreviewActions
from .pulling import PullActions
from .scene_checks import SearchActions, UpActions
from .scene_list import SceneListActions
from .start import StartActions
from .tidy import TidyActions
from .training import JobActions


@dataclass(frozen=True)
class WindowParts:
    """Parts of one window."""

    file_actions: FileActions
    pictures: PictureActions
    preview: PreviewActions
    jobs: JobActions
    deliver: DeliverActions
    start: StartActions
    scene_list: SceneListActions
    up: UpActions
    searches: SearchActions
    maker: LayerMaker
    tidy: TidyActions
    painting: PaintingActions
    pulling: PullActions

    @property
    def requests(self) -> Requests:
        """Handlers of the requests of all parts, by name."""
        parts = (
            self.file_actions,
            self.pictures,
            self.jobs,
            self.deliver,
            self.start,
            self.preview,
            self.scene_list,
            self.searches,
            self.maker,
            self.tidy,
            self.painting,
            self.pulling,
        )
        return {name: act for part in parts for name, act in part.requests.items()}

    @property
    def polls(self) -> tuple[Callable[[], float | None], ...]:
        """Functions that poll a part and return the seconds until the next poll, None for never."""
        parts = (
            self.jobs,
            self.painting,
            self.pictures,
            self.preview,
            self.start,
            self.searches,
            self.pulling,
        )
        return (
            self.scene_list.poll,
            self.maker.poll,
            *(part.poll for part in parts),
            self.file_actions.poll_dialog,
            lambda: self.up.poll(self.file_actions.path),
        )

    @property
    def closers(self) -> tuple[Callable[[], None], ...]:
        """Functions that free the resources of a part, in the order of their calls."""
        parts = (self.start, self.preview, self.searches, self.jobs, self.maker, self.pulling)
        return (*(part.close for part in parts), self.file_actions.release)

    def leave_scene(self) -> None:
        """Reset the state of the old scene after another one was opened."""
        for part in (self.jobs, self.preview, self.up, self.maker, self.tidy, self.pulling):
            part.leave_scene()


def make_parts(
    *,
    main_view: MainView,
    documents: DocumentStore,
    open_document: OpenDocument,
    wait_for: WaitFor,
    leave: Callable[[], None],
    session: Path | None,
) -> WindowParts:
    """Return the parts of a window.

    Args:
        main_view: the window's content, whose state the parts share
        documents: the open document
        open_document: replaces the open scene by another
        wait_for: runs work in another thread while the window shows a text
        leave: closes the window without a question
        session: the session's file; None before it has one
    """
    store = main_view.store
    messages = main_view.messages

    edits = EditActions(store=store, documents=documents, messages=messages)
    pictures = PictureActions(
        store=store,
        documents=documents,
        messages=messages,
        context=main_view.context,
        picture_size=lambda: main_view.picture_size,
        original=main_view.original_picture,
        wait_for=wait_for,
    )
    main_view.remember = pictures.remember
    main_view.layers_of = lambda view: exports.picture_layers(documents.get(), view)
    file_actions = FileActions(
        store=store,
        documents=documents,
        messages=messages,
        edits=edits,
        pictures=pictures,
        open_document=open_document,
        wait_for=wait_for,
        leave=leave,
        path=session,
    )
    preview = PreviewActions(
        store=store,
        documents=documents,
        messages=messages,
        context=main_view.context,
        picture_size=lambda: main_view.picture_size,
        save_edited=main_view.save_edited,
        engine=lambda: main_view.engine,
    )
    jobs = JobActions(
        store=store,
        documents=documents,
        messages=messages,
        edits=edits,
        open_file=file_actions.open,
        decal_place=main_view.decal_place,
        draft=preview.draft,
        anchor=preview.anchor,
        follow=preview.follow_anchor,
        leave_ghost=preview.leave_ghost,
        look_behind=preview.look_behind,
    )
    start = StartActions(
        store=store,
        documents=documents,
        messages=messages,
        edits=edits,
        open_file=file_actions.open,
        context=main_view.context,
        queue=jobs.queue,
    )
    scene_list = SceneListActions(
        store=store, documents=documents, messages=messages, wait_for=wait_for, open_file=file_actions.open
    )
    maker, tidy, pulling, searches = _manual_edits(main_view, documents, edits, scene_list)
    return WindowParts(
        file_actions=file_actions,
        pictures=pictures,
        preview=preview,
        jobs=jobs,
        deliver=DeliverActions(store=store, documents=documents, messages=messages, queue=jobs.queue),
        start=start,
        scene_list=scene_list,
        up=UpActions(store=store, documents=documents, messages=messages),
        searches=searches,
        maker=maker,
        tidy=tidy,
        painting=PaintingActions(store=store, documents=documents, messages=messages, queue=jobs.queue),
        pulling=pulling,
    )


def _manual_edits(
    main_view: MainView, documents: DocumentStore, edits: EditActions, scene_list: SceneListActions
) -> tuple[LayerMaker, TidyActions, PullActions, SearchActions]:
    """Return the parts that edit the selection by hand, and that find its Gaussians."""
    store = main_view.store
    messages = main_view.messages
    maker = LayerMaker(store=store, documents=documents, messages=messages, edits=edits, wake=wake_window)
    tidy = TidyActions(
        store=store,
        documents=documents,
        maker=maker,
        engine=lambda: main_view.engine,
        place_scene=scene_list.place,
    )
    pulling = PullActions(
        store=store, documents=documents, maker=maker, engine=lambda: main_view.engine, wake=wake_window
    )
    searches = SearchActions(
        store=store, documents=documents, messages=messages, pointer=main_view.pointer, wake=wake_window
    )
    return maker, tidy, pulling, searches
