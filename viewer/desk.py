"""Files of the window: opened and dropped ones by their content, the session, its autosave, recent files.

Everything that goes wrong here is one line in the window; the work stays as it was.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from progdf.camera_files import load_cameras
from progdf.checkpoint import load_gdf
from progdf.errors import ProgdfError
from progdf.info import kind_of
from progdf.session_file import SUFFIX

from . import document as documents
from . import native, recent, saved_files, session, timeline_file, workspace
from .document import Document
from .playback import Player
from .session import Session
from .stage import Stage
from .state import LayerState, Timeline
from .threads import all_threads
from .turntable import first_camera, from_camera, to_camera
from .upright import up_of
from .workspace import Dialog

AUTOSAVE_S = 20.0
"""Seconds from a change to its autosave."""


class Shown(Protocol):
    """What the desk needs of the application."""

    document: Document
    stage: Stage

    def show(self, document: Document) -> None:
        """Draw another document from now on."""

    def leave(self) -> None:
        """Close the window, without a question."""


@dataclass(frozen=True)
class _Due:
    """An autosave to come: when, in seconds of the caller's clock, and of what."""

    at: float
    kept: object


class Desk:
    """Opens, saves and asks, for one window.

    Args:
        app: the window
        path: the session's file, None before it has one
        memory: folder of the list of recent files; the user's own if None
    """

    def __init__(self, app: Shown, path: Path | None = None, memory: Path | None = None) -> None:
        self._app, self.path, self._memory = app, path, memory
        self._due: _Due | None = None
        self._autosaved: object = None  # what the autosave file holds
        self._browser = native.Browser()
        opened = app.document
        files = (*opened.gdf_paths, *((opened.path,) if opened.path else ()), *((path,) if path else ()))
        app.stage.recent = self._remember(*files)

    def serve(self, request: str) -> None:
        """One request of `workspace.REQUESTS` that is about files, or "quit"."""
        name, _, argument = request.partition(":")
        if name in ("save", "save_as"):
            self._save_where(argument, ask=name == "save_as")
        elif name == "save_to":
            asked = self._app.stage.work.dialog
            self._save_to(argument, asked.then if asked else "")
        elif name == "open":
            self._app.stage.ask(Dialog("open"))
        elif name == "browse":
            self._browse()
        elif name == "open_file":
            self.open(_typed(argument))
        elif name == "camera":
            self._told(self._keep_camera)
        elif name == "discard":
            self._app.stage.work = workspace.as_saved(self._app.stage.work)
        elif name == "quit":
            self._leave()

    def choosing(self) -> float | None:
        """Look whether a file was chosen in the desktop's own dialog, and take it.

        Returns:
            Seconds until it has to be called again; None if no such dialog is on screen.
        """
        stage = self._app.stage
        looked = self._browser.looked(stage.work.dialog)
        if looked is not None and looked != stage.work.dialog:
            stage.ask(looked)
        return native.POLL_S if self._browser.on_screen else None

    @property
    def unsaved(self) -> bool:
        """Whether something would be lost that a session could keep."""
        return self._app.document.path is not None and workspace.unsaved(self._app.stage.work)

    def open(self, path: Path) -> None:
        """A file by what it is: scenes and sessions replace all, an edit comes on top, a camera is taken."""
        self._told(lambda: self._open(path, kind_of(path)))

    def save(self, path: Path) -> None:
        """Save the session there from now on.

        Raises:
            ProgdfError: see `session.save`.
            OSError: it cannot be written.
        """
        path = path if path.suffix == ".json" else path.with_name(path.name + SUFFIX)
        if path != self.path and path.is_file() and kind_of(path) != "session":
            raise ProgdfError(f"{path} is another file, no session; choose another name")
        session.save(path, self._session())
        self._drop_autosave()
        self.path = path
        stage = self._app.stage
        stage.work = workspace.as_saved(stage.work)
        stage.recent = self._remember(path)
        stage.tell(f"Saved {path.resolve()}")

    def autosave(self, now: float) -> float | None:
        """Write unsaved work beside the session once it is old enough.

        Args:
            now: seconds of any clock that does not go back

        Returns:
            Seconds until it has to be called again; None if nothing waits.
        """
        kept = workspace.worth_saving(self._app.stage.work)
        if not self.unsaved or kept == self._autosaved:
            self._due = None
            return None
        if self._due is None:
            self._due = _Due(now + AUTOSAVE_S, kept)
        if now < self._due.at:
            return self._due.at - now
        self._due, self._autosaved = None, kept
        try:
            session.save(self._autosave_path(), self._session())
        except (ProgdfError, OSError) as error:
            self._app.stage.tell(f"there is no autosave: {error}", error=True)
        return None

    def closed(self) -> None:
        """The window closes, and nothing is lost: the autosave has done its work."""
        self._drop_autosave()

    def release(self) -> None:
        """Take away what of the desktop's is still on screen."""
        self._browser.close()

    def _open(self, path: Path, kind: str) -> None:
        if kind == "cameras":
            self._look_through(path)
            return
        if kind == "timeline":
            self._take_timeline(path)
            return
        if kind == "gdf":
            self._add_edit(path)
        elif self.unsaved:
            self._app.stage.ask(self._leaving(f"open_file:{path}"))
            return
        elif kind == "session":
            self._open_session(path)
        else:
            self._open_scene(path)
        self._app.stage.recent = self._remember(path)

    def _take_timeline(self, path: Path) -> None:
        """Its keys take the place of those there are; undo brings them back."""
        stage = self._app.stage
        view = stage.work.view
        stage.change(replace(view, timeline=timeline_file.load(path, view.layers)))
        stage.work = replace(stage.work, player=Player(shown=True))
        stage.tell(f"Opened {path.name}; Space plays it")

    def _open_session(self, path: Path) -> None:
        opened = session.open_session(path)
        self._drop_autosave()
        self._app.show(opened.document)
        stage = self._app.stage
        stage.restart(opened.view, opened.snapshots)
        name = path.name.removesuffix(session.AUTOSAVE + SUFFIX)
        if name != path.name:  # an autosave is unsaved work of the session beside it
            self.path = path.with_name(name + SUFFIX)
            stage.work = replace(stage.work, saved=None)
            return
        self.path = path
        self.mention_autosave()

    def mention_autosave(self) -> None:
        """Say so where work was left unsaved the last time."""
        left = self._autosave_path()
        if self._app.document.path is not None and left.is_file():
            self._app.stage.tell(f"Unsaved work was kept in {left.name}; Ctrl+O opens it")

    def _open_scene(self, path: Path) -> None:
        opened = documents.load(path)
        self._drop_autosave()
        self._app.show(opened)
        self.path = None
        stage = self._app.stage
        camera = first_camera(opened.scene, up=up_of(opened.scene, path=path))
        stage.restart(replace(stage.work.view, camera=camera, layers=(), timeline=Timeline()))

    def _add_edit(self, path: Path) -> None:
        """On top, at full strength, so that one sees what came; undo takes it off again."""
        opened = self._app.document
        with all_threads():
            gdf = load_gdf(path, opened.scene)
        layer = LayerState(len(opened.gdfs), opened.free_name(gdf.name), strength=1.0)
        paths = (*opened.gdf_paths, path) if len(opened.gdf_paths) == len(opened.gdfs) else ()
        gdfs = (*opened.gdfs, replace(gdf, name=layer.name))
        self._app.show(replace(opened, gdfs=gdfs, gdf_paths=paths))
        stage = self._app.stage
        stage.change(replace(stage.work.view, layers=(*stage.work.view.layers, layer)))

    def _look_through(self, path: Path) -> None:
        stage = self._app.stage
        stage.work = workspace.with_camera(
            stage.work, from_camera(stage.work.view.camera, load_cameras(path)[0], stage.facts.bounds)
        )
        stage.tell(f"Looking through the first camera of {path.name}")

    def _keep_camera(self) -> None:
        """Add the view on screen to the cameras kept beside the session or the scene."""
        stage = self._app.stage
        place = self.path or self._app.document.path or stage.pictures / self._app.document.title
        path, count = saved_files.camera(place, to_camera(stage.work.view.camera, *stage.picture_size))
        stage.tell(f"Kept as camera {count} of {path.resolve()}; progdf train … --cameras {path.name}")

    def _session(self) -> Session:
        work = self._app.stage.work
        return Session(self._app.document, work.view, work.snapshots)

    def _save_where(self, then: str, ask: bool) -> None:
        if self.path is None or ask:
            path = self.path or session.default_path(self._app.document)
            self._app.stage.ask(Dialog("save", str(path), then))
            return
        self._save_to(str(self.path), then)

    def _save_to(self, path: str, then: str) -> None:
        """Save there, then do what was put off; where that fails, ask for another place and say why."""
        stage = self._app.stage
        error = _failure(lambda: self.save(_typed(path)))
        if error:
            stage.ask(Dialog("save", path, then, error=error))
            return
        stage.work = replace(stage.work, dialog=None)
        if then:
            stage.request(then)

    def _browse(self) -> None:
        """The desktop's own dialog beside the question that is open."""
        stage = self._app.stage
        if stage.work.dialog is not None:
            near = self.path or self._app.document.path or Path("file")
            stage.ask(self._browser.begun(stage.work.dialog, near))

    def _leave(self) -> None:
        if self.unsaved:
            self._app.stage.ask(self._leaving("quit"))
        else:
            self._app.leave()

    def _leaving(self, then: str) -> Dialog:
        return Dialog("leave", str(self.path or session.default_path(self._app.document)), then)

    def _told(self, act: Callable[[], None]) -> None:
        """Do it; what goes wrong is a line in the window."""
        if error := _failure(act):
            self._app.stage.tell(error, error=True)

    def _autosave_path(self) -> Path:
        return session.autosave_path(self.path, self._app.document)

    def _drop_autosave(self) -> None:
        """Take away what this window has autosaved."""
        if self._autosaved is not None:
            self._autosave_path().unlink(missing_ok=True)
        self._autosaved, self._due = None, None

    def _remember(self, *paths: Path) -> tuple[Path, ...]:
        if not paths:
            return recent.read(self._memory)
        return recent.remember(paths, self._memory)


def _typed(path: str) -> Path:
    """A path as a person types it; the home of an unknown user is a name like any other, and missing."""
    return Path(os.path.expanduser(path))  # pathlib's raises there


def _failure(act: Callable[[], None]) -> str:
    """Do it; what went wrong, in one line, "" for nothing."""
    try:
        act()
    except ProgdfError as error:
        return " ".join(str(error).split())
    except OSError as error:
        return f"{error.filename or 'the file'} cannot be read or written: {error.strerror}"
    return ""
