"""Checks of the open scene: strays are hidden on request, and a guessed up axis is reported."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from progdf.gaussians import Gaussians
from progdf.metrics.image import NO_DIFFERENCE
from progdf.scene import up_axis
from progdf.scene.strays import Strays, clean, find_strays, picture_difference
from progdf.terminal import group_digits
from viewer.app.messages import Messages, Requests
from viewer.camera.view_camera import Vec3
from viewer.files.document import DocumentStore
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.workspace import Store
from viewer.ui.keys import shortcut

_POLL_S = 0.1
_UP_BUTTONS = (("Flip", Plain("flip_up")), ("Choose…", Plain("view_settings")))


class StrayActions:
    """Search for strays, which are then hidden, on request. `close` it with the window.

    Strays are Gaussians that a capture leaves outside the scene's surfaces.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
    """

    def __init__(self, *, store: Store, documents: DocumentStore, messages: Messages) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
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
            self._scene = self._documents.get().original
            self._search = self._worker.submit(_search, self._scene)
            self._messages.show("Looking for strays …")

    def poll(self) -> float | None:
        """Hide the strays found; return the seconds until the next poll, None for never."""
        if self._search is None:
            return None
        if not self._search.done():
            return _POLL_S
        search = self._search
        self._search = None
        if self._scene is self._documents.get().original:  # else another scene was opened meanwhile
            self._hide(*search.result())
        return None

    def close(self) -> None:
        """Cancel a search that is still running."""
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _hide(self, strays: Strays, db: float) -> None:
        count = len(self._documents.get().scene)
        if not len(strays.rows):
            self._messages.show("No strays found")
            return
        view = self._store.get().view
        mask = np.zeros(count, bool)
        mask[strays.rows] = True
        self._store.change(replace(view, selection=selection.hide(view.selection, mask)))
        change = "no pixel differs" if db >= NO_DIFFERENCE else f"{db:.1f} dB to the earlier pictures"
        hid = f"Hid {group_digits(len(strays.rows))} strays ({strays.describe()})"
        self._messages.show(f"{hid}: {change}; {shortcut('show_all')} shows them")


def _search(scene: Gaussians) -> tuple[Strays, float]:
    strays = find_strays(scene)
    return strays, picture_difference(scene, clean(scene, strays))[0] if len(strays.rows) else NO_DIFFERENCE


class UpActions:
    """Notice of a guessed up axis, and storage of the axis that the user sets.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
    """

    def __init__(self, *, store: Store, documents: DocumentStore, messages: Messages) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._looked = False  # the scene has been checked
        self._up: Vec3 | None = None  # the user's up axis at the last poll

    def poll(self, session: Path | None) -> None:
        """Check the open scene and its up axis.

        Args:
            session: the open session, which stores the up axis
        """
        document = self._documents.get()
        # The axis set by the user, also by undo; a film, a picture or a snapshot may move the camera.
        up = self._store.get().past.present.look.up
        before = self._up
        self._up = up
        if document.path is None:
            return
        if self._looked and up != before:
            up_axis.remember_chosen_up(document.scene, up)
        guess = not (self._looked or session or document.detected_up.certain)
        work = self._store.get()
        if guess and up == document.detected_up.direction and work.question is None:
            name = up_axis.direction_name(torch.tensor(up)).upper().replace("-", "−")
            self._messages.offer(f"Guessed {name} as up", *_UP_BUTTONS)
        elif self._looked and up != before and work.question and work.question.buttons == _UP_BUTTONS:
            self._store.replace(replace(work, question=None))  # the new axis answers it
        self._looked = True

    def leave_scene(self) -> None:
        """Check the next scene anew."""
        self._looked = False
