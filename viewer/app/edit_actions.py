"""Edits of the window's stack by their files: one is added, duplicated, or takes another's place."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf, load_gdf
from progdf.torch_threads import all_threads
from viewer.state import layers as stack
from viewer.state.view_state import ViewState
from viewer.state.workspace import focus_layer

from .application import Application


class EditActions:
    """Changes of the stack that undo takes back.

    Args:
        app: the window
    """

    def __init__(self, app: Application) -> None:
        self._app = app

    def add(self, path: Path) -> None:
        """An edit on top, at full strength, so that one sees what came.

        Raises:
            ProgdfError: the file is missing, broken, or was made for another scene.
        """
        gdf = self._load(path)
        view = stack.add_layer(self._app.main_view.work.view, self._open(gdf, path), gdf.name)
        self._apply(view, len(view.layers) - 1)

    def duplicate(self, index: int) -> None:
        """A copy of a layer above it, with an edit of its own: the timeline and undo tell edits apart."""
        document, view = self._app.document, self._app.main_view.work.view
        gdf = view.layers[index].gdf
        path = document.gdf_paths[gdf] if gdf < len(document.gdf_paths) else None
        self._apply(stack.duplicate_layer(view, index, self._open(document.gdfs[gdf], path)), index + 1)

    def replace(self, index: int, path: Path) -> None:
        """Another edit in a layer's place.

        Raises:
            ProgdfError: as for `add`.
        """
        gdf = self._load(path)
        view = self._app.main_view.work.view
        self._apply(stack.replace_edit(view, index, self._open(gdf, path), gdf.name), index)

    def layer(self, index: str) -> int:
        """The layer that a request is about: the focused one where none is named.

        Raises:
            ProgdfError: there is none.
        """
        work = self._app.main_view.work
        chosen = int(index) if index else work.focus
        if chosen is None or not 0 <= chosen < len(work.view.layers):
            raise ProgdfError("no layer is selected; click one first")
        return chosen

    def _load(self, path: Path) -> Gdf:
        with all_threads():
            return load_gdf(path, self._app.document.scene)

    def _open(self, gdf: Gdf, path: Path | None) -> int:
        """Have one more edit open; its index."""
        document = self._app.document
        own = replace(gdf, name=document.free_name(gdf.name))
        known = path is not None and len(document.gdf_paths) == len(document.gdfs)
        paths = (*document.gdf_paths, path) if known and path is not None else ()
        self._app.show(replace(document, gdfs=(*document.gdfs, own), gdf_paths=paths))
        return len(document.gdfs)

    def _apply(self, view: ViewState, focus: int) -> None:
        """The changed stack, and the layer that it is about."""
        main_view = self._app.main_view
        main_view.change(view)
        main_view.work = focus_layer(main_view.work, focus)
