"""Application object: a window, its main view, its event loop, and the files dropped on it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

from imgui_bundle import imgui

from progdf.gdf.file import Gdf
from progdf.rasterize.first_start import compile_rasterizer, needs_kernels
from progdf.terminal import escape_text
from progdf.threads import one_thread
from viewer.files import exports, user_files
from viewer.files.document import Document, DocumentStore, LiveLayers
from viewer.files.session import WindowSession
from viewer.render.engine import ViewEngine, draw_once, draws_with
from viewer.state import workspace
from viewer.state.commands import Action, Plain, argument
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import ViewState
from viewer.ui.splash import TITLE, Splash
from viewer.ui.window import Window, interruptible

from .main_view import MainView
from .messages import ErrorReporter, attempt
from .parts.assembly import make_parts

_Made = TypeVar("_Made")

RETRY_S = 1.0
"""Seconds until the next poll of a part whose last poll raised an error."""


Opened = tuple[WindowSession, Path | None]
"""Scene with its edits and initial view, and the session's file."""


@one_thread()
def run(splash: Splash, opens: Callable[[], Opened], draw: str = "auto") -> int:
    """Run the window until it is closed; show the splash while files are read.

    Args:
        splash: the window
        opens: reads the scene to show, in another thread
        draw: renderer, see `ViewEngine`

    Returns:
        The exit status, 0.

    Raises:
        ProgdfError: see `opens`.
    """
    with interruptible(), ThreadPoolExecutor(2) as workers:
        if needs_kernels("draw"):
            counted = "Compiling kernels …"

            def report(done: int, total: int) -> None:
                nonlocal counted
                counted = f"Compiling kernels {done} of {total} …"

            splash.wait(workers.submit(compile_rasterizer, "draw", report), lambda: counted)
        draws = workers.submit(draw_once) if draws_with(splash.context, draw) == "cpu" else None
        opened, session = splash.wait(workers.submit(opens), "Opening …")
        if draws is not None:
            splash.wait(draws, "Preparing to draw …")
        app = App(Window(splash), opened.document, opened.view, session, draw=draw)
        try:
            app.main_view.restart(opened.view, opened.snapshots)
            with app.errors.guard():
                app.parts.file_actions.bind_keys()
            if opened.warning:
                app.main_view.messages.show(opened.warning, error=True)
            app.parts.file_actions.offer_autosave()
            app.loop()
        finally:
            app.close()
    return 0


class App:
    """Window with its main view, its engine and its parts."""

    def __init__(
        self,
        window: Window,
        document: Document,
        state: ViewState,
        session: Path | None = None,
        draw: str = "auto",
    ) -> None:
        self.window = window
        self.context = window.context
        self._draw = draw
        self.engine = self._engine(document)
        self.documents = DocumentStore(document, self._show)
        self.main_view = MainView(
            self.context,
            self.engine,
            document.facts(),
            state,
            window.ui_scale,
            exports.folder_of(document.path),
        )
        self.store = self.main_view.store
        self.parts = make_parts(
            main_view=self.main_view,
            documents=self.documents,
            open_document=self.open_document,
            wait_for=self.wait_for,
            leave=self.leave,
            session=session,
        )
        self.main_view.follow_input = self.parts.pulling.follow
        self.errors = ErrorReporter(
            self.main_view.messages, lambda: self.main_view.frames, self.parts.file_actions.keep_work
        )
        self.requests = self.parts.requests
        self.requests["full_screen"] = lambda _: window.toggle_full_screen()
        self.requests["quit"] = lambda _: self._quit()
        self.is_closed = False
        self._waits = False  # a splash is visible
        self._title = ""
        self._layout = user_files.read_layout()
        form = replace(self.store.get().form, outside=user_files.read_outside())
        self.store.replace(replace(self.store.get(), layout=self._layout, form=form))
        self.main_view.report = self.errors.report
        self.dropped: list[Path] = []
        self.failure: BaseException | None = None
        self.last = time.perf_counter()
        window.listen(self.main_view.wake, self._queue_dropped, self._redraw)

    def close(self) -> None:
        with ExitStack() as closed:  # every part is closed, even if another one raises
            for close in (self.engine.release, self.main_view.close, imgui.backends.glfw_shutdown):
                closed.callback(close)
            closed.callback(self.main_view.ui.make_current)
            for close in reversed(self.parts.closers):
                closed.callback(close)
            self._keep_picture()

    def loop(self) -> None:
        """Draw frames while something changes; otherwise wait for events."""
        while not self.is_closed:
            waits = [wait for wait in self._wait_times() if wait is not None]
            with self.errors.guard():
                # while it opens, events stay in the window system's queue, and no typed letter is lost
                if not self.main_view.opening:
                    self.window.wait(min(waits, default=None))
            if self.failure is not None:
                raise self.failure
            for path in self.take_dropped():
                with self.errors.guard():
                    self.parts.scene_list.drop(path)
            if self.window.closing and not self.is_closed:
                self.window.stay_open()
                self.main_view.messages.request(Plain("quit"))
            with self.errors.guard():
                if self.main_view.is_due():
                    self.draw()
        with self.errors.guard():
            self.parts.file_actions.on_close()

    def draw(self) -> None:
        """Draw one frame of the latest state; do nothing while the window is minimized."""
        if 0 in self.window.pixels:
            self.main_view.rest()
            return
        now = time.perf_counter()
        seconds = now - self.last
        self.last = now
        self.main_view.ui.make_current()
        self.main_view.ui.set_scale(self.window.ui_scale * self.main_view.work.layout.zoom)
        self.window.new_frame()
        screen = self.context.screen
        self.main_view.frame(screen, seconds, self.window.take_keys())
        self.window.point(self.store.get().transient.pointer.at)
        self.window.present()
        self._rename()
        for request in self.main_view.take_requests():
            self.handle(request)

    def handle(self, request: Action) -> None:
        """Perform one of `requests`, which need the whole window."""
        with self.errors.guard():
            attempt(self.main_view.messages, lambda: self.requests[request.name](argument(request)))

    def _wait_times(self) -> tuple[float | None, ...]:
        """Return the seconds until each part must be polled again; None means never."""
        return (
            # first, because a chosen file or a finished training wakes the main view
            *(self._look(poll) for poll in self.parts.polls),
            self._look(self.main_view.next_frame_delay),
            self._look(lambda: self.parts.file_actions.autosave(time.perf_counter())),
        )

    def _look(self, poll: Callable[[], float | None]) -> float | None:
        with self.errors.guard():
            return poll()
        return RETRY_S

    def _redraw(self) -> None:
        if self._waits:
            return
        try:
            with self.errors.guard():
                self.draw()
        except BaseException as failure:  # glfw would only print it
            self.failure = failure

    def _queue_dropped(self, paths: Sequence[Path]) -> None:
        self.dropped += paths
        self.main_view.wake()

    def take_dropped(self) -> list[Path]:
        paths = self.dropped
        self.dropped = []
        return paths

    def wait_for(self, work: Callable[[], _Made], text: str) -> _Made:
        """Run `work` in another thread, show `text` in the window meanwhile, and return the result.

        Raises:
            Exception: any error of `work`.
        """

        def listen() -> None:
            self.window.wait(0.0)
            self.main_view.ui.make_current()
            self.window.new_frame()
            imgui.backends.opengl3_new_frame()
            imgui.new_frame()  # keys and clicks on the splash have no effect
            imgui.end_frame()

        self._waits = True
        try:
            with ThreadPoolExecutor(1) as worker:
                return self.window.splash.wait(worker.submit(work), text, listen)
        finally:
            self._waits = False
            self.window.take_keys()  # typed at the splash
            self.main_view.wake()

    def _show(self, document: Document, live: tuple[Gdf, ...], layers: LiveLayers) -> None:
        """Draw a document from now on; nothing changes if that fails."""
        is_known = document is self.documents.get()
        facts = self.main_view.facts if is_known else document.facts()
        engine = self._engine(document, live)
        self.engine.release()
        self.engine = engine
        self.main_view.set_engine(engine, facts, layers)

    def open_document(
        self, document: Document, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()
    ) -> None:
        """Replace the open scene by another, together with everything that depends on it.

        Training and exports of the old scene go on in the background. If anything fails, nothing changes.
        """
        self._keep_picture()
        self.documents.replace(document)
        self.main_view.restart(view, snapshots)
        self.main_view.pictures = exports.folder_of(document.path)
        self.parts.leave_scene()

    def _keep_picture(self) -> None:
        """Store a picture of the current view for the start page."""
        view = self.main_view.work.view
        session = self.parts.file_actions.path
        self.parts.start.keep_picture(self.engine, view, self.documents.get().path, session)

    def _rename(self) -> None:
        """Update the title bar and store a changed layout.

        The title names the open session or scene; a dot marks unsaved changes.
        """
        path = self.parts.file_actions.path
        main_view = self.main_view
        name = escape_text(path.name.removesuffix(".session.json")) if path else ""
        if name != main_view.work.session:
            self.store.replace(replace(main_view.work, session=name))
            main_view.wake()
        if main_view.work.layout != self._layout and not imgui.is_mouse_down(0):
            self._layout = main_view.work.layout
            user_files.keep_layout(self._layout)
        title = _window_title(name or self.documents.get().title, self.parts.file_actions.has_unsaved)
        if title != self._title:
            self.window.rename(title)
            self._title = title

    def _engine(self, document: Document, live: tuple[Gdf, ...] = ()) -> ViewEngine:
        shown = replace(document, live=live) if live else document
        return ViewEngine(self.context, shown.scene, shown.gdfs, self._draw)

    def _quit(self) -> None:
        """Close the window, after a question if jobs run or changes are unsaved."""
        if not self.parts.jobs.holds_window():
            self.parts.file_actions.leave()

    def leave(self) -> None:
        """Close the window without a question."""
        self.window.ask_to_close()
        self.is_closed = True


def _window_title(name: str, unsaved: bool = False) -> str:
    return f"{workspace.UNSAVED * unsaved}{name} – {TITLE}" if name else TITLE
