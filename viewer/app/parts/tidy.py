"""Manual edits: a selection is removed, moved or copied, each as a layer with a slider."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from progdf.errors import ProgdfError
from progdf.gdf.file import save_gdf
from progdf.io.atomic import make_folder
from progdf.region import Region, from_mask
from progdf.tidy import Step, similarity, tidy
from viewer.app.handles import gizmo_step
from viewer.app.messages import Requests
from viewer.app.parts.edits import EditActions
from viewer.files.document import DocumentStore
from viewer.jobs.training import edits_folder, free_path
from viewer.state import selection
from viewer.state.transient import Gizmo
from viewer.state.view_state import LayerState
from viewer.state.workspace import Store, with_transient

_NAMES = {"remove": "removed", "transform": "moved", "duplicate": "copy"}
_INSTRUCTIONS = {"remove": "remove", "transform": "move", "duplicate": "copy"}


class TidyActions:
    """Layers that remove, move or copy the selection.

    Args:
        store: state of the window
        documents: the open document
        edits: adds the finished edit as a layer
    """

    def __init__(self, *, store: Store, documents: DocumentStore, edits: EditActions) -> None:
        self._store = store
        self._documents = documents
        self._edits = edits
        self._region: Region | None = None  # the region being moved
        self._folder = Path()  # folder of new edits

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about the selection and the handles that move it, by name."""
        return {
            "remove_selected": lambda _: self._begin("remove"),
            "move_selected": lambda _: self._begin("transform"),
            "duplicate_selected": lambda _: self._begin("duplicate"),
            "place": self._place,
            "keep_placed": self._keep,
            "put_back": self._put_back,
        }

    def leave_scene(self) -> None:
        """Drop the handles when another scene opens."""
        self._region = None
        self._set_gizmo(None)

    def _begin(self, does: str) -> None:
        scene = self._documents.get().original
        self._folder = edits_folder(self._documents.get().file)
        mask = selection.unpack(self._store.get().view.selection.members, len(scene))
        if not mask.any():
            raise ProgdfError("nothing is selected; select a part of the scene first")
        region = from_mask("selection", torch.from_numpy(mask.copy()))
        if does == "remove":
            self._add(does, [Step("remove", region)])
            return
        center = scene.means[region.members].double().mean(dim=0)
        kind: Literal["transform", "duplicate"] = "duplicate" if does == "duplicate" else "transform"
        self._region = region
        at = (float(center[0]), float(center[1]), float(center[2]))
        self._set_gizmo(Gizmo(kind, at, np.eye(4)))
        self._store.wake()

    def _steps(self) -> list[Step]:
        gizmo = self._store.get().transient.gizmo
        if not isinstance(gizmo, Gizmo) or self._region is None:
            return []
        return [Step(gizmo.does, self._region, similarity(*gizmo_step(gizmo)))]

    def _place(self, _: None) -> None:
        """Show the moved selection at the position of the handles."""
        if steps := self._steps():
            document = self._documents.get()
            gdf = tidy(document.original, steps, _NAMES[steps[0].does])
            live = (LayerState(len(document.edits), gdf.name, 1.0),)
            self._documents.replace(document, (gdf,), live)

    def _keep(self, _: None) -> None:
        gizmo = self._store.get().transient.gizmo
        steps = self._steps()
        if isinstance(gizmo, Gizmo) and steps and (gizmo.does == "duplicate" or gizmo.is_moved):
            self._add(steps[0].does, steps)
        self._end()

    def _put_back(self, _: None) -> None:
        moved = self._region is not None
        self._end()
        if moved:
            self._documents.replace(self._documents.get())

    def _end(self) -> None:
        self._region = None
        self._set_gizmo(None)
        self._store.wake()

    def _set_gizmo(self, gizmo: Gizmo | None) -> None:
        self._store.replace(with_transient(self._store.get(), gizmo=gizmo))

    def _add(self, does: str, steps: Sequence[Step]) -> None:
        """Write the edit and add it as a layer on top."""
        document = self._documents.get()
        make_folder(self._folder)
        name = document.free_name(_NAMES[does])
        path = free_path(self._folder, name, ".gdf")
        gdf = tidy(document.original, steps, name, _INSTRUCTIONS[does], cameras=())
        save_gdf(path, gdf)
        self._edits.add(path, name, deselect=True)
