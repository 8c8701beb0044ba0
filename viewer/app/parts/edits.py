"""Changes of the layer stack from files: edits are added, finished, duplicated and replaced."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf, fingerprint, load_gdf, read_gdf
from progdf.region import Region, from_mask
from progdf.threads import all_threads
from viewer.app.messages import Messages
from viewer.files import scenes
from viewer.files.document import Document, DocumentStore
from viewer.files.user_files import parse_path
from viewer.state import selection
from viewer.state.facts import describe_loaded
from viewer.state.layers import add_layer, change_layer, duplicate_layer, replace_edit
from viewer.state.view_state import ViewState
from viewer.state.workspace import Store, focus_layer


class EditActions:
    """Changes of the layer stack that can be undone.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
    """

    def __init__(self, *, store: Store, documents: DocumentStore, messages: Messages) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages

    def add(self, path: Path, name: str = "", strength: float = 1.0, deselect: bool = False) -> None:
        """Add an edit on top, see `add_layer`.

        A grade of another scene, or of none, is applied to the selection, or everywhere if nothing is
        selected.

        Args:
            name: name of the layer, "" for the edit's name

        Raises:
            ProgdfError: the file is missing or broken, or it is not a grade and was made for another scene.
        """
        before = self._store.get().view
        document = self._documents.get()
        gdf, scene = self._load(path, lambda: self._region_for_grade(document))
        gdf = replace(gdf, name=name or gdf.name)
        if deselect:
            before = replace(before, selection=selection.select_none(before.selection))
        view = add_layer(before, self._open(gdf, path, scene), gdf.name, strength)
        self._apply(view, len(view.layers) - 1)

    def finish(self, draft: Path, path: Path) -> bool:
        """Replace a draft by its trained edit in every layer and history entry; return True if a layer uses
        it.

        The state does not change: strength, gains, paint, order, selection and undo history stay.

        Raises:
            ProgdfError: see `add`.
        """
        document = self._documents.get()
        view = self._store.get().view
        drafts = [i for i, known in enumerate(document.gdf_paths) if known == draft]
        if not drafts:
            return False
        owner = document.owner(drafts[0])
        gdf, _ = self._load(path, lambda: (document.edits[drafts[0]].region, owner), owner)
        gdfs = list(document.edits)
        paths = list(document.gdf_paths)
        for i in drafts:
            if not torch.equal(gdf.region.members, gdfs[i].region.members):
                return False
            gdfs[i] = replace(gdf, name=gdfs[i].name)
            paths[i] = path
        self._documents.replace(replace(document, edits=tuple(gdfs), gdf_paths=tuple(paths)))
        return any(layer.gdf in drafts for layer in view.layers)

    def duplicate(self, index: int) -> None:
        """Add a copy of a layer above it, with its own edit, as the timeline and undo distinguish edits."""
        document = self._documents.get()
        view = self._store.get().view
        gdf = view.layers[index].gdf
        path = document.gdf_paths[gdf] if gdf < len(document.gdf_paths) else None
        copy = self._open(document.edits[gdf], path, document.owner(gdf))
        self._apply(duplicate_layer(view, index, copy), index + 1)

    def replace(self, layer: int | None, path: str) -> None:
        """Replace a layer's edit; a grade of another scene, or of none, takes the layer's region.

        Raises:
            ProgdfError: see `add`.
        """
        view = self._store.get().view
        index = self.layer(layer)
        file = parse_path(path)
        document = self._documents.get()
        edit = view.layers[index].gdf
        gdf, scene = self._load(file, lambda: (document.edits[edit].region, document.owner(edit)))
        self._apply(replace_edit(view, index, self._open(gdf, file, scene), gdf.name), index)

    def replace_file(self, old: Path, new: Path) -> bool:
        """Replace the edit of the layer that uses a file by that of another; return True if there is one.

        Painted strengths of the layer stay if both edits have the same members.

        Raises:
            ProgdfError: see `add`.
        """
        document = self._documents.get()
        paths = document.gdf_paths
        view = self._store.get().view
        for index, layer in enumerate(view.layers):
            if layer.gdf < len(paths) and paths[layer.gdf].resolve() == old.resolve():
                before = document.edits[layer.gdf]
                owner = document.owner(layer.gdf)
                gdf, _ = self._load(new, lambda: (before.region, owner), owner)  # noqa: B023
                changed = replace_edit(view, index, self._open(gdf, new, owner), gdf.name)
                same = torch.equal(gdf.region.members, before.region.members)
                if same and gdf.members == before.members:
                    changed = change_layer(changed, index, partial(replace, paint=layer.paint))
                self._apply(changed, index)
                return True
        return False

    def layer(self, index: int | None) -> int:
        """Return the layer of a request: the given index, or the focused layer for None.

        Raises:
            ProgdfError: there is no such layer.
        """
        work = self._store.get()
        chosen = work.focus if index is None else index
        if chosen is None or not 0 <= chosen < len(work.view.layers):
            raise ProgdfError("no layer is selected; click one first")
        return chosen

    def _region_for_grade(self, document: Document) -> tuple[Region, int]:
        """Return the region to which a grade of another scene is applied, and the scene that holds it."""
        state = self._store.get().view.selection
        mask = torch.from_numpy(selection.unpack(state.members, len(document.original)).copy())
        scene = document.scene_with(mask.nonzero()[:, 0])
        rows = scenes.rows_of(document.scene_files, scene)
        if state.count:
            return from_mask("selection", mask[rows]), scene
        return from_mask("all", torch.ones(rows.stop - rows.start, dtype=torch.bool)), scene

    def _load(
        self, path: Path, choose: Callable[[], tuple[Region, int]], scene: int | None = None
    ) -> tuple[Gdf, int]:
        """Load an edit of one of the scenes, or a grade of another scene applied to a region.

        Args:
            path: its file
            choose: returns the region for a grade of another scene, and the scene that holds it
            scene: the scene of the edit; None: found by its fingerprint, the chosen one first
        """
        document = self._documents.get()
        stored = read_gdf(path)
        known = [
            i for i, file in enumerate(document.scene_files) if stored.scene == fingerprint(file.gaussians)
        ]
        region = None
        if scene is None and known:
            scene = self._choose_scene(document, known)
        elif scene not in known and stored.field.kind == "grade":
            region, scene = choose()
        file = document.scene_files[scene or 0]
        with all_threads():
            gdf = load_gdf(path, file.gaussians, place=lambda _: region)
        if note := describe_loaded(gdf):
            self._messages.show(note)
        return gdf, scene or 0

    def _choose_scene(self, document: Document, known: Sequence[int]) -> int:
        """Return the scene of an edit that fits equal ones: that of the selection, or a visible one."""
        state = self._store.get().view.selection
        selected = selection.unpack(state.members, len(document.original))
        for scene in known:
            if len(known) > 1 and selected[scenes.rows_of(document.scene_files, scene)].any():
                return scene
        visible = [state.scene for state in document.states if state.visible and state.scene in known]
        return visible[0] if visible else known[0]

    def _open(self, gdf: Gdf, path: Path | None, scene: int) -> int:
        """Open one more edit of a scene and return its index."""
        document = self._documents.get()
        renamed = replace(gdf, name=document.free_name(gdf.name))
        has_paths = path is not None and len(document.gdf_paths) == len(document.edits)
        paths = (*document.gdf_paths, path) if has_paths and path is not None else ()
        owners = (*(document.owner(i) for i in range(len(document.edits))), scene)
        self._documents.replace(
            replace(document, edits=(*document.edits, renamed), gdf_paths=paths, owners=owners)
        )
        return len(document.edits)

    def _apply(self, view: ViewState, focus: int) -> None:
        """Set the changed stack and focus one layer."""
        self._store.change(view)
        self._store.replace(focus_layer(self._store.get(), focus))
