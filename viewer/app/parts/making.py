"""Layers of manual edits, made in another thread one at a time, with progress and a button that cancels."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import wait as wait_for
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from progdf.errors import ProgdfError
from progdf.gdf.file import load_gdf, save_gdf
from progdf.io.atomic import make_folder
from progdf.threads import StoppedError, stopped_by
from viewer.app.messages import Messages, Requests, WorkSign
from viewer.app.parts.edits import EditActions
from viewer.files.document import DocumentStore
from viewer.jobs.training import edits_folder, free_path
from viewer.state.commands import Plain
from viewer.state.transient import Pull
from viewer.state.workspace import Store

_POLL_S = 0.25  # seconds between two looks at the progress
PATIENCE_S = 0.1
"""Time that the window waits for a layer, so that a small one appears at once."""


class Progress(Protocol):
    """Function that reports the finished share of a computation, 0 to 1.

    Raises:
        StoppedError: the computation is canceled.
    """

    def __call__(self, share: float) -> None: ...


@dataclass
class _Making:
    """Layer in the making."""

    name: str
    path: Path
    done: Callable[[bool], None]
    stop: threading.Event = field(default_factory=threading.Event)
    share: float | None = None  # finished share; None: not known
    future: Future[None] = field(default_factory=Future)

    def advance(self, share: float) -> None:
        """Report progress, see `Progress`."""
        self.share = share
        if self.stop.is_set():
            raise StoppedError


class LayerMaker:
    """Layers that another thread makes.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        edits: adds a finished layer
        wake: ends the window's wait for events; callable from any thread
        patience_s: time that `begin` waits for the layer, seconds
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        edits: EditActions,
        wake: Callable[[], None],
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._edits = edits
        self._wake = wake
        self.patience_s = patience_s
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="layer")
        self._making: _Making | None = None
        self._sign = WorkSign(messages)

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about layers in the making, by name."""
        return {"stop_making": lambda _: self._cancel()}

    @property
    def is_busy(self) -> bool:
        """True while a layer is made."""
        return self._making is not None

    def check_free(self) -> None:
        """Raise an error while another layer is made.

        Raises:
            ProgdfError: a layer is in the making.
        """
        if self._making is not None:
            raise ProgdfError(
                f"“{self._making.name}” is still being made; wait until it is ready, or cancel it"
            )

    def begin(
        self,
        kind: str,
        make: Callable[[str, Path, Progress], None],
        done: Callable[[bool], None],
        worker: ThreadPoolExecutor | None = None,
    ) -> None:
        """Begin to make a layer.

        Args:
            kind: name of the layer, unless another one has it
            make: writes the edit; receives its name, its file and a function for its progress
            done: called in the window's thread just before the layer is added, with True, or with False after
                a failure or a cancellation
            worker: thread of `make`; None: a thread of the maker

        Raises:
            ProgdfError: a layer is in the making, or its folder cannot be written.
        """
        self.check_free()
        document = self._documents.get()
        folder = edits_folder(document.file)
        make_folder(folder)
        name = document.free_name(kind)
        making = _Making(name, free_path(folder, name, ".gdf"), done)

        def run() -> None:
            with stopped_by(making.stop):
                make(name, making.path, making.advance)
                if document.files:  # the edit was made on the merged scenes
                    gdf, _ = document.own(load_gdf(making.path, document.original))
                    save_gdf(making.path, gdf)

        making.future = (worker or self._worker).submit(run)
        making.future.add_done_callback(lambda _: self._wake())
        self._making = making
        wait_for([making.future], self.patience_s)
        self.poll()

    def poll(self) -> float | None:
        """Add a finished layer, or show the progress."""
        making = self._making
        if making is None:
            return None
        if making.future.done():
            self._making = None
            self._sign.end()
            self._finish(making)
            return None
        self._report(making)
        return _POLL_S

    def _report(self, making: _Making) -> None:
        """Show the progress."""
        if making.stop.is_set():
            self._sign.show(f"Canceling “{making.name}” …")
            return
        share = "" if making.share is None else f" {100.0 * making.share:.0f} %"
        self._sign.show(f"Making “{making.name}” …{share}", Plain("stop_making"))

    def wait(self) -> None:
        """Wait for the layer in the making, and add it."""
        if self._making is not None:
            wait_for([self._making.future])
            self.poll()

    def leave_scene(self) -> None:
        """Cancel the layer in the making, as another scene opens."""
        if self._making is not None:
            self._making.stop.set()
            self._sign.end()
        self._making = None

    def close(self) -> None:
        """Cancel the layer in the making and stop the thread."""
        self.leave_scene()
        self._worker.shutdown(wait=False, cancel_futures=True)

    def _cancel(self) -> None:
        if self._making is not None:
            self._making.stop.set()
            self._making.future.cancel()

    def _finish(self, making: _Making) -> None:
        is_canceled = making.stop.is_set() or making.future.cancelled()
        if is_canceled or making.future.exception() is not None:
            making.done(False)
            if is_canceled:
                making.path.unlink(missing_ok=True)
                self._messages.show(f"“{making.name}” was canceled")
                return
            making.future.result()  # raises its error
        making.done(True)
        pulls = isinstance(self._store.get().transient.gizmo, Pull)  # the selection limits what it moves
        self._edits.add(making.path, making.name, deselect=not pulls)
        self._messages.show(f"“{making.name}” is ready")
