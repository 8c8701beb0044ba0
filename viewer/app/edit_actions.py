"""Edits of the window's stack by their files: one is added, duplicated, or takes another's place. Strays."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from progdf.errors import ProgdfError
from progdf.formats.load_report import group_digits
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, load_gdf
from progdf.metrics.image import NO_DIFFERENCE
from progdf.scene.strays import Strays, clean, find_strays, picture_difference
from progdf.torch_threads import all_threads
from viewer.state import selection
from viewer.state.layers import add_layer, duplicate_layer, replace_edit
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
        view = add_layer(self._app.main_view.work.view, self._open(gdf, path), gdf.name)
        self._apply(view, len(view.layers) - 1)

    def duplicate(self, index: int) -> None:
        """A copy of a layer above it, with an edit of its own: the timeline and undo tell edits apart."""
        document, view = self._app.document, self._app.main_view.work.view
        gdf = view.layers[index].gdf
        path = document.gdf_paths[gdf] if gdf < len(document.gdf_paths) else None
        self._apply(duplicate_layer(view, index, self._open(document.gdfs[gdf], path)), index + 1)

    def replace(self, index: int, path: Path) -> None:
        """Another edit in a layer's place.

        Raises:
            ProgdfError: as for `add`.
        """
        gdf = self._load(path)
        view = self._app.main_view.work.view
        self._apply(replace_edit(view, index, self._open(gdf, path), gdf.name), index)

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


class StrayActions:
    """Hides what a capture left where nothing is, when it is asked to. `close` it with the window.

    Args:
        app: the window
    """

    def __init__(self, app: Application) -> None:
        self._app = app
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="strays")
        self._search: Future[tuple[Strays, float]] | None = None
        self._scene: Gaussians | None = None  # that is searched

    def handle(self, request: str) -> bool:
        """Begin to look for strays, which takes seconds; False where something else is asked for."""
        if request != "hide_strays":
            return False
        if self._search is None:
            self._scene = self._app.document.scene
            self._search = self._worker.submit(_search, self._scene)
            self._app.main_view.show_message("Looking for strays …")
        return True

    def poll(self) -> float | None:
        """Hide what was found; seconds until the next look, None for ever."""
        if self._search is None:
            return None
        if not self._search.done():
            return _POLL_S
        search, self._search = self._search, None
        if self._scene is self._app.document.scene:  # else another one was opened meanwhile
            self._hide(*search.result())
        return None

    def close(self) -> None:
        """Nobody waits for what is still looked for."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _hide(self, strays: Strays, db: float) -> None:
        main_view, count = self._app.main_view, len(self._app.document.scene)
        if not len(strays.rows):
            main_view.show_message("There are no strays")
            return
        view, mask = main_view.work.view, np.zeros(count, bool)
        mask[strays.rows] = True
        main_view.change(replace(view, selection=selection.hide(view.selection, mask)))
        change = "no pixel differs" if db >= NO_DIFFERENCE else f"{db:.1f} dB to the pictures before"
        main_view.show_message(
            f"Hid {group_digits(len(strays.rows))} strays ({strays.describe()}): {change}; Alt+H shows them"
        )


def _search(scene: Gaussians) -> tuple[Strays, float]:
    strays = find_strays(scene)
    return strays, picture_difference(scene, clean(scene, strays))[0] if len(strays.rows) else NO_DIFFERENCE


_POLL_S = 0.1
