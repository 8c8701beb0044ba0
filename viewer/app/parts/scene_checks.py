"""Checks of the open scene: strays are hidden, its subject is selected, and a guessed up axis is reported."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.metrics.image import NO_DIFFERENCE
from progdf.scene import up_axis
from progdf.scene.selection import Mask
from progdf.scene.strays import Strays, clean, find_strays, picture_difference
from progdf.terminal import group_digits
from progdf.threads import stopped_by
from viewer.app.messages import Messages, Requests, WorkSign
from viewer.app.select_tool import find_subject
from viewer.camera.view_camera import Vec3
from viewer.files.document import DocumentStore
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.workspace import Store
from viewer.ui.keys import shortcut
from viewer.ui.pointer import PointerContext

_POLL_S = 0.1
_UP_BUTTONS = (("Flip", Plain("flip_up")), ("Choose…", Plain("view_settings")))


PATIENCE_S = 0.1
"""Time that the window waits for a search, so that a quick one shows no message."""


@dataclass(frozen=True)
class _Search:
    """Search in progress."""

    original: Gaussians  # the scene being searched
    text: str  # message while it runs
    found: Future[Any]
    stop: threading.Event
    take: Callable[[Any], None]  # receives the result, in the window's thread


class SearchActions:
    """Searches in another thread, one at a time: for strays, which are then hidden, and for the subject of
    the view, which is then selected. `close` it with the window.

    Strays are Gaussians that a capture leaves outside the scene's surfaces.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        pointer: returns the picture on screen
        wake: ends the window's wait for events; callable from any thread
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        pointer: Callable[[], PointerContext],
        wake: Callable[[], None],
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._pointer = pointer
        self._wake = wake
        self.patience_s = PATIENCE_S
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="search")
        self._sign = WorkSign(messages)
        self._search: _Search | None = None

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about searches, by name."""
        return {
            "hide_strays": self._hide_strays,
            "select_subject": self._select_subject,
            "stop_search": lambda _: self._cancel(),
        }

    def _hide_strays(self, _: None) -> None:
        """Begin the search for strays, which takes seconds."""
        scene = self._documents.get().original
        self._begin("Looking for strays …", partial(_find_strays, scene), lambda found: self._hide(*found))

    def _select_subject(self, _: None) -> None:
        """Begin to select the object in the middle of the picture, which takes seconds in a large scene."""
        pointer = self._pointer()
        find = partial(
            find_subject,
            pointer.still_surface(),
            pointer.facts.neighborhood,
            self._store.get().view.camera.up,
        )
        self._begin("Selecting the subject …", find, self._take_subject)

    def _begin(self, text: str, find: Callable[[], object], take: Callable[[Any], None]) -> None:
        """Begin a search. It replaces one that is still running.

        Raises:
            ProgdfError: it has failed within `patience_s`.
        """
        self._cancel()
        stop = threading.Event()

        def run() -> object:
            with stopped_by(stop):
                return find()

        found = self._worker.submit(run)
        found.add_done_callback(lambda _: self._wake())
        self._search = _Search(self._documents.get().original, text, found, stop, take)
        wait_for([found], self.patience_s)
        self.poll()

    def poll(self) -> float | None:
        """Use the result of the search, or show that it runs; return the seconds until the next poll.

        Raises:
            ProgdfError: the search has failed.
        """
        search = self._search
        if search is None:
            return None
        if not search.found.done():
            self._sign.show(search.text, Plain("stop_search"))
            return _POLL_S
        self._search = None
        self._sign.end()
        if search.original is self._documents.get().original:  # else another scene was opened meanwhile
            search.take(search.found.result())
        return None

    def _cancel(self) -> None:
        """Drop the search; its thread ends at its next chunk of work."""
        if self._search is not None:
            self._search.stop.set()
            self._search.found.cancel()
            self._search = None
            self._sign.end()

    def close(self) -> None:
        """Cancel a search that is still running, and stop the thread."""
        self._cancel()
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

    def _take_subject(self, found: Mask) -> None:
        """Select the subject, with its paint."""
        view = self._store.get().view
        facts = self._pointer().facts
        if len(found) != facts.count:
            raise ProgdfError("a layer with new splats was added meanwhile; select the subject again")
        mask = found | facts.paint_on(view, found)
        self._store.change(replace(view, selection=selection.select(view.selection, mask)))


def _find_strays(scene: Gaussians) -> tuple[Strays, float]:
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
