"""Application object: a window, its main view, its event loop, and the files dropped on it."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import torch
from imgui_bundle import imgui

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.terminal import escape_text
from progdf.threads import one_thread
from viewer.camera.view_camera import first_camera
from viewer.files import exports, user_files
from viewer.files.document import Document
from viewer.files.session import WindowSession
from viewer.render.engine import ViewEngine, draws_with
from viewer.state import workspace
from viewer.state.commands import Action, Plain, argument
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import LayerState, ViewState
from viewer.ui.keys import bind
from viewer.ui.splash import TITLE, Splash
from viewer.ui.window import Window, interruptible

from .application import LOG, attempt, error_details, error_line, log_error
from .deliver import DeliverActions
from .file_actions import FileActions
from .main_view import MainView
from .preview import PreviewActions
from .start import StartActions, UpActions
from .tidy import StrayActions, TidyActions
from .training import JobActions

_Made = TypeVar("_Made")

REPEAT_MESSAGE_S = 10.0
"""Seconds until an error that repeats in every frame is shown again."""
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
        draws = workers.submit(_draw_once) if draws_with(splash.context, draw) == "cpu" else None
        opened, session = splash.wait(workers.submit(opens), "Opening …")
        if draws is not None:
            splash.wait(draws, "Preparing to draw …")
        app = App(Window(splash), opened.document, opened.view, session, draw=draw)
        try:
            app.main_view.restart(opened.view, opened.snapshots)
            app.bind_keys()
            if opened.warning:
                app.main_view.show_message(opened.warning, error=True)
            app.file_actions.offer_autosave()
            app.loop()
        finally:
            app.close()
    return 0


def _draw_once() -> None:
    """Draw a small picture, which loads the kernels, or compiles them the first time on a machine."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    quats = torch.eye(4)[:1].expand(8, 4)
    none = corners[:, None, :][:, :0]
    scene = Gaussians(corners, quats, corners - 2.0, corners[:, 0], corners, none)
    ViewEngine(None, scene).image(ViewState(camera=first_camera(scene)), (32, 24))


class App:
    """Window with its main view and engine. Its `file_actions` handle the files."""

    def __init__(
        self,
        window: Window,
        document: Document,
        state: ViewState,
        session: Path | None = None,
        draw: str = "auto",
    ) -> None:
        self.window = window
        self.document = document
        self.context = window.context
        self._draw = draw
        self.engine = self._engine(document)
        self.main_view = MainView(
            self.context,
            self.engine,
            document.facts(),
            state,
            window.ui_scale,
            exports.folder_of(document.path),
        )
        self.store = self.main_view.store
        self.file_actions = FileActions(self, session)
        self.jobs = JobActions(
            self,
            lambda form: self.preview.draft(form),
            lambda form: self.preview.anchor(form),
            lambda path: self.preview.follow_anchor(path),
        )
        self.deliver = DeliverActions(self, self.jobs.queue)
        self.start = StartActions(self, self.context, self.jobs.queue)
        self.up = UpActions(self)
        self.preview = PreviewActions(self, self.context, self.jobs.region_spec)
        self.strays = StrayActions(self)
        self.tidy = TidyActions(self)
        jobs = self.jobs, self.deliver, self.start, self.preview
        by_part = [part.requests for part in (self.file_actions, *jobs, self.strays, self.tidy)]
        self.requests = {name: act for acts in by_part for name, act in acts.items()}
        self.requests["full_screen"] = lambda _: window.toggle_full_screen()
        self.requests["quit"] = lambda _: None if self.jobs.holds_window() else self.file_actions.leave()
        self.is_closed = False
        self._waits = False  # a splash is visible
        self._title = ""
        self._layout = user_files.read_layout()
        self.store.replace(replace(self.store.get(), layout=self._layout))
        # by place: frame number of the last failure, time of its last message
        self._failures: dict[str, tuple[int, float]] = {}
        self.main_view.report = self.report
        self.dropped: list[Path] = []
        self.failure: BaseException | None = None
        self.last = time.perf_counter()
        window.listen(self.main_view.wake, self._queue_dropped, self._redraw)

    def close(self) -> None:
        with ExitStack() as parts:  # every part is closed, even if another one raises
            for close in (self.engine.release, self.main_view.close, imgui.backends.glfw_shutdown):
                parts.callback(close)
            parts.callback(self.main_view.ui.make_current)
            parts.callback(self.file_actions.release)
            for part in (self.jobs, self.strays, self.preview, self.start):
                parts.callback(part.close)
            self._keep_picture()

    def bind_keys(self) -> None:
        """Bind the keys that the user assigned to commands. Errors are shown in a message and logged."""
        bind({})
        with self._guard():
            if problems := bind(user_files.read_keys()):
                where = user_files.keys_file()
                more = len(problems) - 1
                log_error("\n".join([f"{where}:", *problems]))
                text = f"{where.name}: {problems[0]}" + (f", and {more} more in {LOG}" if more else "")
                self.main_view.show_message(text, error=True)

    def report(self, error: Exception) -> None:
        """Show an error raised by a part of the loop as a message.

        An internal error is also logged, and unsaved work is written to its recovery file at once.
        """
        where = repr(
            (type(error), [(at.filename, at.lineno) for at in traceback.extract_tb(error.__traceback__)])
        )
        frame = self.main_view.frames
        now = time.perf_counter()
        before, shown_at = self._failures.get(where, (-2, 0.0))
        repeats = frame - before <= 1 and now - shown_at < REPEAT_MESSAGE_S
        self._failures[where] = frame, shown_at if repeats else now
        if repeats:
            return  # an error that repeats in every frame requests no further frame
        line = error_line(error)
        details = ""
        if not line:
            details = error_details(error)
            if before < 0:
                log_error(details)
            summary = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            line = f"Internal error ({summary[:200]}); {self.file_actions.keep_work()}"
        self.main_view.show_message(line, True, details)

    @contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.report(error)

    def loop(self) -> None:
        """Draw frames while something changes; otherwise wait for events."""
        while not self.is_closed:
            waits = [wait for wait in self._wait_times() if wait is not None]
            with self._guard():
                # while it opens, events stay in the window system's queue, and no typed letter is lost
                if not self.main_view.opening:
                    self.window.wait(min(waits, default=None))
            if self.failure is not None:
                raise self.failure
            for path in self.take_dropped():
                with self._guard():
                    self.open(path)
            if self.window.closing and not self.is_closed:
                self.window.stay_open()
                self.main_view.request(Plain("quit"))
            with self._guard():
                if self.main_view.is_due():
                    self.draw()
        with self._guard():
            self.file_actions.on_close()

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
        with self._guard():
            attempt(self.main_view, lambda: self.requests[request.name](argument(request)))

    def _wait_times(self) -> tuple[float | None, ...]:
        """Return the seconds until each part must be polled again; None means never."""
        # first, because a chosen file or a finished training wakes the main view
        parts = (self.jobs, self.preview, self.start, self.strays)
        looks = [self._look(part.poll) for part in parts]
        return (
            self._look(self.file_actions.poll_dialog),
            *looks,
            self._look(lambda: self.up.poll(self.file_actions.path)),
            self._look(self.main_view.next_frame_delay),
            self._look(lambda: self.file_actions.autosave(time.perf_counter())),
        )

    def _look(self, poll: Callable[[], float | None]) -> float | None:
        with self._guard():
            return poll()
        return RETRY_S

    def _redraw(self) -> None:
        if self._waits:
            return
        try:
            with self._guard():
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

    def open(self, path: Path) -> None:
        """Open a dropped or chosen file according to its content."""
        self.file_actions.open(path)

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

    def show(
        self, document: Document, live: tuple[Gdf, ...] = (), layers: tuple[LayerState, ...] = ()
    ) -> None:
        """Draw the same scene with other edits from now on. The caller updates the state.

        Args:
            live: edits in training
            layers: layers that show these edits on top
        """
        facts = self.main_view.facts if document is self.document else document.facts()
        engine = self._engine(document, live)
        self.engine.release()
        self.document = document
        self.engine = engine
        self.main_view.set_engine(engine, facts, layers)

    def open_document(
        self, document: Document, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()
    ) -> None:
        """Replace the open scene by another, together with everything that depends on it.

        Training and exports of the old scene go on in the background. If anything fails, nothing changes.
        """
        facts = document.facts()
        engine = self._engine(document)
        self._keep_picture()
        self.engine.release()
        self.document = document
        self.engine = engine
        self.main_view.set_engine(engine, facts)
        self.main_view.restart(view, snapshots)
        self.main_view.pictures = exports.folder_of(document.path)
        for part in (self.jobs, self.preview, self.up, self.tidy):
            part.leave_scene()

    def _keep_picture(self) -> None:
        """Store a picture of the current view for the start page."""
        view = self.main_view.work.view
        self.start.keep_picture(self.engine, view, self.document.path, self.file_actions.path)

    def _rename(self) -> None:
        """Update the title bar and store a changed layout.

        The title names the open session or scene; a dot marks unsaved changes.
        """
        path = self.file_actions.path
        main_view = self.main_view
        name = escape_text(path.name.removesuffix(".session.json")) if path else ""
        if name != main_view.work.session:
            self.store.replace(replace(main_view.work, session=name))
            main_view.wake()
        if main_view.work.layout != self._layout and not imgui.is_mouse_down(0):
            self._layout = main_view.work.layout
            user_files.keep_layout(self._layout)
        title = _window_title(name or self.document.title, self.file_actions.has_unsaved)
        if title != self._title:
            self.window.rename(title)
            self._title = title

    def _engine(self, document: Document, live: tuple[Gdf, ...] = ()) -> ViewEngine:
        shown = replace(document, edits=(*document.edits, *live)) if live else document
        return ViewEngine(self.context, shown.scene, shown.gdfs, self._draw)

    def leave(self) -> None:
        """Close the window without a question."""
        self.window.ask_to_close()
        self.is_closed = True


def _window_title(name: str, unsaved: bool = False) -> str:
    return f"{workspace.UNSAVED * unsaved}{name} – {TITLE}" if name else TITLE
