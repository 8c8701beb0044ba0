"""The application: a window, the main view in it, its loop, and the files dropped on it."""

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
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import LayerState, ViewState
from viewer.ui.keys import bind
from viewer.ui.splash import TITLE, Splash
from viewer.ui.window import Window, interruptible

from .application import LOG, attempt, error_details, error_line, log_error
from .file_actions import FileActions
from .main_view import MainView
from .studio.deliver import DeliverActions
from .studio.preview import PreviewActions
from .studio.start import StartActions, UpActions
from .studio.training import JobActions
from .tidy import StrayActions, TidyActions

_Made = TypeVar("_Made")

SAY_AGAIN_S = 10.0
"""Until what still fails in each frame is said again."""
RETRY_S = 1.0
"""Until the next look at what raised at the last one."""


Opened = tuple[WindowSession, Path | None]
"""The scene, its edits and what to show first, and the session's file."""


@one_thread()
def run(splash: Splash, opens: Callable[[], Opened], draw: str = "auto") -> int:
    """Stay in the window until it is asked to close; where reading takes its time, the splash says so.

    Args:
        splash: the window
        opens: reads what to show, in another thread
        draw: what draws, see `ViewEngine`

    Returns:
        The exit status, 0.

    Raises:
        ProgdfError: as `opens`.
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
    """A small picture, for which the kernels are loaded, or compiled the first time on a machine."""
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)
    quats, none = torch.eye(4)[:1].expand(8, 4), corners[:, None, :][:, :0]
    scene = Gaussians(corners, quats, corners - 2.0, corners[:, 0], corners, none)
    ViewEngine(None, scene).image(ViewState(camera=first_camera(scene)), (32, 24))


class App:
    """One window with its main view and engine; `file_actions` sees to its files."""

    def __init__(
        self,
        window: Window,
        document: Document,
        state: ViewState,
        session: Path | None = None,
        draw: str = "auto",
    ) -> None:
        self.window, self.document = window, document
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
        studio = self.jobs, self.deliver, self.start, self.preview
        by_part = [part.requests for part in (self.file_actions, *studio, self.strays, self.tidy)]
        self.requests = {name: act for acts in by_part for name, act in acts.items()}
        self.requests["full_screen"] = lambda _: window.toggle_full_screen()
        self.requests["quit"] = lambda _: None if self.jobs.holds_window() else self.file_actions.leave()
        self.is_closed = False
        self._waits = False  # a splash is shown
        self._title = ""
        self._layout = user_files.read_layout()
        self.main_view.work = replace(self.main_view.work, layout=self._layout)
        self._failures: dict[str, tuple[int, float]] = {}  # by place: in which frame last, and when said
        self.main_view.report = self.report
        self.dropped: list[Path] = []
        self.failure: BaseException | None = None
        self.last = time.perf_counter()
        window.listen(self.main_view.wake, self._queue_dropped, self._redraw)

    def close(self) -> None:
        with ExitStack() as parts:  # each is closed, whatever another one raises
            for close in (self.engine.release, self.main_view.close, imgui.backends.glfw_shutdown):
                parts.callback(close)
            parts.callback(self.main_view.ui.make_current)
            parts.callback(self.file_actions.release)
            for part in (self.jobs, self.strays, self.preview, self.start):
                parts.callback(part.close)
            self._keep_picture()

    def bind_keys(self) -> None:
        """The keys that the person gave to commands; what is wrong with them is a line, and in the log."""
        bind({})
        with self._guard():
            if problems := bind(user_files.read_keys()):
                where, more = user_files.keys_file(), len(problems) - 1
                log_error("\n".join([f"{where}:", *problems]))
                text = f"{where.name}: {problems[0]}" + (f", and {more} more in {LOG}" if more else "")
                self.main_view.show_message(text, error=True)

    def report(self, error: Exception) -> None:
        """What a part of the loop raised becomes a message; a mistake of ours is logged too, and what is
        unsaved into its recovery file at once."""
        where = repr(
            (type(error), [(at.filename, at.lineno) for at in traceback.extract_tb(error.__traceback__)])
        )
        frame, now = self.main_view.frames, time.perf_counter()
        before, told_at = self._failures.get(where, (-2, 0.0))
        goes_on = frame - before <= 1 and now - told_at < SAY_AGAIN_S
        self._failures[where] = frame, told_at if goes_on else now
        if goes_on:
            return  # what fails in each frame asks for no further one
        line, details = error_line(error), ""
        if not line:
            details = error_details(error)
            if before < 0:
                log_error(details)
            what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            line = f"Internal error ({what[:200]}); {self.file_actions.keep_work()}"
        self.main_view.show_message(line, True, details)

    @contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self.report(error)

    def loop(self) -> None:
        """Draw while something changes, sleep while nothing does."""
        while not self.is_closed:
            waits = [wait for wait in self._wait_times() if wait is not None]
            with self._guard():
                if not self.main_view.opening:  # else events wait in the window system, and no letter is lost
                    self.window.wait(min(waits, default=None))
            if self.failure is not None:
                raise self.failure
            for path in self.take_dropped():
                with self._guard():
                    self.open(path)
            if self.window.closing and not self.is_closed:
                self.window.stay_open()
                self.main_view.request("quit")
            with self._guard():
                if self.main_view.is_due():
                    self.draw()
        with self._guard():
            self.file_actions.on_close()

    def draw(self) -> None:
        """One frame of the latest state; nothing while the window is minimized."""
        if 0 in self.window.pixels:
            self.main_view.rest()
            return
        now = time.perf_counter()
        seconds, self.last = now - self.last, now
        self.main_view.ui.make_current()
        self.main_view.ui.set_scale(self.window.ui_scale * self.main_view.work.layout.zoom)
        self.window.new_frame()
        screen = self.context.screen
        self.main_view.frame(screen, seconds, self.window.take_keys())
        self.window.point(self.main_view.pointed.at)
        self.window.present()
        self._rename()
        for request in self.main_view.take_requests():
            self.handle(request)

    def handle(self, request: str) -> None:
        """Do what only the window can, of `requests`."""
        name, _, argument = request.partition(":")
        with self._guard():
            attempt(self.main_view, lambda: self.requests[name](argument))

    def _wait_times(self) -> tuple[float | None, ...]:
        """How long the next look at each part may take, seconds; None is for ever."""
        # first: what was chosen, or trained, wakes the main view
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
        paths, self.dropped = self.dropped, []
        return paths

    def open(self, path: Path) -> None:
        """A dropped or chosen file, by what it is."""
        self.file_actions.open(path)

    def wait_for(self, work: Callable[[], _Made], text: str) -> _Made:
        """What it makes in another thread; meanwhile the window says so.

        Raises:
            Exception: what `work` raises.
        """

        def listen() -> None:
            self.window.wait(0.0)
            self.main_view.ui.make_current()
            self.window.new_frame()
            imgui.backends.opengl3_new_frame()
            imgui.new_frame()  # what is typed and clicked at the splash is nobody's
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
        """Draw the same scene with other edits from now on; the state is the caller's to change.

        Args:
            live: what is being trained of its edits
            layers: that show them on top
        """
        facts = self.main_view.facts if document is self.document else document.facts()
        engine = self._engine(document, live)
        self.engine.release()
        self.document, self.engine = document, engine
        self.main_view.set_engine(engine, facts, layers)

    def open_document(
        self, document: Document, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()
    ) -> None:
        """Another scene takes the place of the open one, and what belonged to that one goes with it.

        What is trained or written for it goes on in the background. Where anything fails, all is as it was.
        """
        facts, engine = document.facts(), self._engine(document)
        self._keep_picture()
        self.engine.release()
        self.document, self.engine = document, engine
        self.main_view.set_engine(engine, facts)
        self.main_view.restart(view, snapshots)
        self.main_view.pictures = exports.folder_of(document.path)
        for part in (self.jobs, self.preview, self.up, self.tidy):
            part.leave_scene()

    def _keep_picture(self) -> None:
        """For the start page, of what is on screen."""
        view = self.main_view.work.view
        self.start.keep_picture(self.engine, view, self.document.path, self.file_actions.path)

    def _rename(self) -> None:
        """The title bar says what is open, and with a dot that there are unsaved changes; a new layout is
        remembered."""
        path, main_view = self.file_actions.path, self.main_view
        name = escape_text(path.name.removesuffix(".session.json")) if path else ""
        if name != main_view.work.session:
            main_view.work = replace(main_view.work, session=name)
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
        """Close the window, without a question."""
        self.window.ask_to_close()
        self.is_closed = True


def _window_title(name: str, unsaved: bool = False) -> str:
    return f"{workspace.UNSAVED * unsaved}{name} – {TITLE}" if name else TITLE
