"""Manual edits: a selection is removed, moved or copied, each as a layer with a slider; strays are hidden."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.gdf.file import save_gdf
from progdf.io.atomic import make_folder
from progdf.metrics.image import NO_DIFFERENCE
from progdf.region import Region, from_mask
from progdf.scene.strays import Strays, clean, find_strays, picture_difference
from progdf.terminal import group_digits
from progdf.tidy import Step, similarity, tidy
from viewer.jobs.training import edits_folder, free_path
from viewer.state import selection
from viewer.state.transient import Gizmo
from viewer.state.view_state import LayerState
from viewer.state.workspace import with_transient
from viewer.ui.keys import shortcut

from .application import Application, Requests
from .file_actions import EditActions
from .handles import gizmo_step

_NAMES = {"remove": "removed", "transform": "moved", "duplicate": "copy"}
_INSTRUCTIONS = {"remove": "remove", "transform": "move", "duplicate": "copy"}


class TidyActions:
    """Layers that remove, move or copy the selection.

    Args:
        app: the window
    """

    def __init__(self, app: Application) -> None:
        self._app = app
        self._store = app.store
        self._edits = EditActions(app)
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
        main_view = self._app.main_view
        scene = self._app.document.original
        self._folder = edits_folder(self._app.document.file)
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
        main_view.wake()

    def _steps(self) -> list[Step]:
        gizmo = self._store.get().transient.gizmo
        if not isinstance(gizmo, Gizmo) or self._region is None:
            return []
        return [Step(gizmo.does, self._region, similarity(*gizmo_step(gizmo)))]

    def _place(self, _: None) -> None:
        """Show the moved selection at the position of the handles."""
        if steps := self._steps():
            document = self._app.document
            gdf = tidy(document.original, steps, _NAMES[steps[0].does])
            live = (LayerState(len(document.edits), gdf.name, 1.0),)
            self._app.show(document, (gdf,), live)

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
            self._app.show(self._app.document)

    def _end(self) -> None:
        self._region = None
        self._set_gizmo(None)
        self._app.main_view.wake()

    def _set_gizmo(self, gizmo: Gizmo | None) -> None:
        self._store.replace(with_transient(self._store.get(), gizmo=gizmo))

    def _add(self, does: str, steps: Sequence[Step]) -> None:
        """Write the edit and add it as a layer on top."""
        document = self._app.document
        make_folder(self._folder)
        name = document.free_name(_NAMES[does])
        path = free_path(self._folder, name, ".gdf")
        gdf = tidy(document.original, steps, name, _INSTRUCTIONS[does])
        save_gdf(path, gdf)
        self._edits.add(path, name, deselect=True)


class StrayActions:
    """Search for strays, which are then hidden, on request. `close` it with the window.

    Strays are Gaussians that a capture leaves outside the scene's surfaces.

    Args:
        app: the window
    """

    def __init__(self, app: Application) -> None:
        self._app = app
        self._store = app.store
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="strays")
        self._search: Future[tuple[Strays, float]] | None = None
        self._scene: Gaussians | None = None  # the scene being searched

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about strays, by name."""
        return {"hide_strays": self._begin}

    def _begin(self, _: None) -> None:
        """Start the search for strays, which takes seconds."""
        if self._search is None:
            self._scene = self._app.document.original
            self._search = self._worker.submit(_search, self._scene)
            self._app.main_view.show_message("Looking for strays …")

    def poll(self) -> float | None:
        """Hide the strays found; return the seconds until the next poll, None for never."""
        if self._search is None:
            return None
        if not self._search.done():
            return _POLL_S
        search = self._search
        self._search = None
        if self._scene is self._app.document.original:  # else another scene was opened meanwhile
            self._hide(*search.result())
        return None

    def close(self) -> None:
        """Cancel a search that is still running."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _hide(self, strays: Strays, db: float) -> None:
        main_view = self._app.main_view
        count = len(self._app.document.scene)
        if not len(strays.rows):
            main_view.show_message("No strays found")
            return
        view = self._store.get().view
        mask = np.zeros(count, bool)
        mask[strays.rows] = True
        main_view.change(replace(view, selection=selection.hide(view.selection, mask)))
        change = "no pixel differs" if db >= NO_DIFFERENCE else f"{db:.1f} dB to the earlier pictures"
        hid = f"Hid {group_digits(len(strays.rows))} strays ({strays.describe()})"
        main_view.show_message(f"{hid}: {change}; {shortcut('show_all')} shows them")


def _search(scene: Gaussians) -> tuple[Strays, float]:
    strays = find_strays(scene)
    return strays, picture_difference(scene, clean(scene, strays))[0] if len(strays.rows) else NO_DIFFERENCE


_POLL_S = 0.1
