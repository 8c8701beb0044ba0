"""Cameras and pictures from files: they move the view, become a decal, or go into the form of a new edit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import moderngl

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.cameras import load_cameras
from progdf.io.picture_camera import edits_in_picture, find_picture_camera
from viewer.app.handles import is_decal, load_decal
from viewer.app.messages import Messages
from viewer.camera.view_camera import from_camera, to_camera
from viewer.files import exports
from viewer.files.document import DocumentStore
from viewer.state.forms import with_picture
from viewer.state.workspace import Store, with_camera, with_transient
from viewer.ui.keys import shortcut


class PictureActions:
    """Cameras and pictures that are opened, and cameras that are saved.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        context: the GL context of decals
        picture_size: returns width and height of the picture on screen, in pixels
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        context: moderngl.Context,
        picture_size: Callable[[], tuple[int, int]],
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._context = context
        self._picture_size = picture_size

    def look_through(self, path: Path) -> None:
        """Move the view to the first camera of a file.

        Raises:
            ProgdfError: the file holds no camera.
        """
        self._take_camera(load_cameras(path, self._documents.get().scene.origin)[0])
        self._messages.show(f"View set to the first camera of {path.name}")

    def open(self, path: Path) -> None:
        """Place a picture with transparency as a decal; edit the scene by any other picture.

        Raises:
            ProgdfError: see `edit_picture`.
        """
        if is_decal(path) and self._documents.get().path is not None:
            decal = load_decal(self._context, path)
            self._store.replace(with_transient(self._store.get(), gizmo=decal))
            self._store.wake()
        else:
            self.edit_picture(path)

    def edit_picture(self, path: Path) -> None:
        """Put an edited picture into the form of a new edit, and move the view to its camera.

        Raises:
            ProgdfError: it is not a picture, its camera is not found, or it was taken with edits on.
        """
        camera = find_picture_camera(path, origin=self._documents.get().scene.origin)
        if edits := edits_in_picture(path):
            raise ProgdfError(
                f"{path.name} shows edits ({edits}); take a view without edits with {shortcut('take_view')}"
            )
        self._take_camera(camera)
        work = self._store.get()
        form = with_picture(work.form, path, work.form_open)
        self._store.replace(replace(work, form=form, form_open=True))

    def keep_camera(self, session: Path | None) -> None:
        """Add the view on screen to the cameras stored next to the session, or next to the scene.

        Raises:
            ProgdfError: see `exports.camera`.
        """
        document = self._documents.get()
        beside = session or document.path or exports.folder_of(None) / document.title
        camera = to_camera(self._store.get().view.camera, *self._picture_size())
        path, count = exports.camera(beside, camera, document.scene.origin)
        self._messages.show(f"Saved as camera {count} in {path.resolve()}")

    def _take_camera(self, camera: Camera) -> None:
        work = self._store.get()
        view_camera = from_camera(work.view.camera, camera, self._documents.get().bounds)
        self._store.replace(with_camera(work, view_camera))
