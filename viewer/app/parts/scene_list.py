"""Scenes of the view: they are added, placed, shown, hidden and removed. All of it can be undone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from progdf.gaussians import Origin
from progdf.gdf.placed import Placement
from progdf.io.atomic import numbered_names
from progdf.io.bundle import BUNDLE
from progdf.io.picture_files import ENDINGS
from progdf.region import Region
from progdf.similarity import AffineMotion
from progdf.terminal import format_count
from viewer.app.messages import Messages, Requests, WaitFor, failure_line
from viewer.files import document, scenes
from viewer.files.document import DocumentStore
from viewer.files.user_files import parse_path
from viewer.state import selection
from viewer.state.commands import OnItem, Plain, Rename, WithText
from viewer.state.layers import LONGEST_NAME, remove_layer
from viewer.state.view_state import SceneState
from viewer.state.workspace import Dialog, Store, focus_layer


class SceneListActions:
    """List of the scenes of the view.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        wait_for: runs work in another thread while the window shows a text
        open_file: opens a file according to its content
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        wait_for: WaitFor,
        open_file: Callable[[Path], None],
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._wait_for = wait_for
        self._open = open_file

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about scenes, by name. All but `add_scene` and `add_file` name a row."""
        return {
            "add_scene": lambda _: self._messages.ask(Dialog("add_scene")),
            "add_file": self._add_typed,
            "show_scene": self._toggle,
            "select_scene": self._select,
            "move_scene": self._move,
            "reset_scene": self._reset,
            "rename_scene": self._rename,
            "remove_scene": self._remove,
        }

    def poll(self) -> float | None:
        """Arrange the scenes as the view lists them, for example after an undo."""
        opened = self._documents.get()
        arranged = opened.arrange(self._store.get().view.scenes)
        if arranged is not opened:
            self._documents.replace(arranged)
            self._store.wake()
        return None

    def drop(self, path: Path) -> None:
        """Open a dropped file; ask whether a scene replaces the open one or is added to the view."""
        if self._documents.get().path is None or not _is_scene(path):
            self._open(path)
            return
        add = ("Add to this view", WithText("add_file", str(path)))
        instead = ("Open instead", WithText("open_file", str(path)))
        self._messages.offer(f"{path.name} is a scene", add, instead)

    def add(self, path: Path) -> None:
        """Add a scene to the view, at the coordinates of its file.

        Raises:
            ProgdfError: the file is missing or damaged, or there are too many scenes.
        """
        opened = self._documents.get()
        if opened.is_empty:
            self._open(path)
            return
        if opened.path is None:
            raise ProgdfError(f"{opened.title} has no file yet; save the scene first")
        file = self._wait_for(lambda: document.load_file(path), f"Adding {path.name} …")
        view = self._store.get().view
        changed = scenes.add_state(view, opened.title, file.title, len(opened.scene_files), Placement())
        self._documents.replace(opened.with_scenes(file).arrange(changed.scenes))
        self._store.change(changed)
        note = ""
        if file.gaussians.antialiased != opened.original.antialiased:
            note = "; it was trained with another antialiasing filter, so its edges look different"
        name = changed.scenes[-1].name
        self._messages.show(
            f"Added {name}{note}", button=("Move", OnItem("move_scene", len(changed.scenes) - 1))
        )

    def place(self, region: Region, motion: AffineMotion) -> bool:
        """Place the scene whose Gaussians are exactly those of a region; return False if there is none.

        Raises:
            ProgdfError: see `Placement.then`, and `carry_edit`.
        """
        opened = self._documents.get()
        view = self._store.get().view
        if len(view.scenes) < 2:
            return False
        for index, state in enumerate(view.scenes):
            rows = scenes.rows_of(opened.files, state.scene)
            if len(region) == rows.stop - rows.start and int(region.members[0]) == rows.start:
                placement = state.placement.then(motion, self._origin)
                self._arrange(index, replace(state, placement=placement), deselect=True)
                self._messages.show(f"Placed {state.name}", button=("Undo", Plain("undo")))
                return True
        return False

    @property
    def _origin(self) -> Origin:
        return self._documents.get().original.origin

    def _arrange(self, index: int, state: SceneState, deselect: bool = False) -> None:
        """Set the state of a scene; if an edit does not allow it, nothing changes."""
        view = scenes.change_state(self._store.get().view, index, state)
        if deselect:
            view = replace(view, selection=selection.select_none(view.selection))
        arranged = self._documents.get().arrange(view.scenes)
        self._documents.replace(arranged)
        self._store.change(view)

    def _add_typed(self, path: str) -> None:
        """Add a file; after a failure, its path stays in an open dialog, with the reason."""
        dialog = self._store.get().dialog
        if dialog is None or dialog.kind != "add_scene":
            self.add(parse_path(path))
            return
        self._store.replace(replace(self._store.get(), dialog=None))
        if error := failure_line(lambda: self.add(parse_path(path))):
            self._messages.ask(replace(dialog, text=path, error=error))

    def _state(self, index: int) -> SceneState:
        states = self._store.get().view.scenes
        if not 0 <= index < len(states):
            raise ProgdfError("there is no such scene in the list")
        return states[index]

    def _toggle(self, index: int) -> None:
        state = self._state(index)
        self._arrange(index, replace(state, visible=not state.visible))

    def _reset(self, index: int) -> None:
        self._arrange(index, replace(self._state(index), placement=Placement()))

    def _rename(self, action: Rename) -> None:
        state = self._state(action.index)
        others = {other.name for other in self._store.get().view.scenes if other is not state}
        name = " ".join(action.text.split())[:LONGEST_NAME] or state.name
        free = next(name for name in numbered_names(name) if name not in others)
        self._arrange(action.index, replace(state, name=free))

    def _select(self, index: int) -> None:
        """Select the Gaussians of a scene and the paint on them."""
        state = self._state(index)
        if not state.visible:
            raise ProgdfError(f"{state.name} is hidden; show it to select it")
        opened = self._documents.get()
        view = self._store.get().view
        mask = np.zeros(len(opened.scene), bool)
        mask[scenes.rows_of(opened.files, state.scene)] = True
        for edit, gdf in enumerate(opened.gdfs):
            if opened.owner(edit) == state.scene:
                added = gdf.region.members[gdf.region.members >= len(opened.original)]
                mask[added.numpy()] = True
        self._store.change(replace(view, selection=selection.select(view.selection, mask)))

    def _move(self, index: int) -> None:
        """Show the handles that place a scene."""
        self._select(index)
        self._messages.request(Plain("move_selected"))

    def _remove(self, index: int) -> None:
        """Remove a scene and its layers from the view. Its file stays."""
        state = self._state(index)
        view = self._store.get().view
        if len(view.scenes) < 2:
            raise ProgdfError("this is the only scene of the view; open another one instead")
        opened = self._documents.get()
        own = [i for i, layer in enumerate(view.layers) if opened.owner(layer.gdf) == state.scene]
        for i in own:
            if view.layers[i].locked:
                raise ProgdfError(f"{view.layers[i].name} is locked; unlock it to remove its scene")
        for i in reversed(own):
            view = remove_layer(view, i)
        states = tuple(other for other in view.scenes if other is not state)
        view = replace(view, scenes=states, selection=selection.select_none(view.selection))
        self._documents.replace(opened.arrange(states))
        self._store.change(view)
        if view.layers:
            self._store.replace(focus_layer(self._store.get(), len(view.layers) - 1))
        else:
            self._store.replace(replace(self._store.get(), focus=None))
        layers = f" and its {format_count(len(own), 'layer')}" if own else ""
        self._messages.show(f"Removed {state.name}{layers}; its file stays", button=("Undo", Plain("undo")))


def _is_scene(path: Path) -> bool:
    """Return whether a file is a scene. One that cannot be read is none."""
    if path.name.endswith(BUNDLE) or path.suffix.lower() in ENDINGS:
        return False
    try:
        return kind_of(path) == "scene"
    except (ProgdfError, OSError):
        return False
