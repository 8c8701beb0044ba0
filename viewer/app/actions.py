"""Files of the window: opened and dropped ones by their content, the session, its autosave, recent files.

Everything that goes wrong here is one line in the window; the work stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.cameras import load_cameras
from viewer.camera.up_axis import up_of
from viewer.camera.view_camera import first_camera, from_camera, to_camera
from viewer.files import autosave as autosaves
from viewer.files import document as documents
from viewer.files import exports as saved_files
from viewer.files import recent, session, timeline_file
from viewer.files.autosave import Autosave
from viewer.files.document import Document
from viewer.files.session import Session
from viewer.files.typed_paths import session_file, typed
from viewer.render.threads import all_threads
from viewer.state import layers as stack
from viewer.state import workspace
from viewer.state.playback import Player
from viewer.state.view_state import Timeline, ViewState
from viewer.state.workspace import Dialog

from . import native_dialogs as native
from .main_view import Stage


class Shown(Protocol):
    """What the desk needs of the application."""

    document: Document
    stage: Stage

    def show(self, document: Document) -> None:
        """Draw another document from now on."""

    def leave(self) -> None:
        """Close the window, without a question."""


class Desk:
    """Opens, saves and asks, for one window.

    Args:
        app: the window
        path: the session's file, None before it has one
        memory: folder of the list of recent files; the user's own if None
    """

    def __init__(self, app: Shown, path: Path | None = None, memory: Path | None = None) -> None:
        self._app, self.path, self._memory = app, path, memory
        self._autosave = Autosave()
        self._put_off: set[Path] = set()  # autosaves that were found and are to be decided about later
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
        elif name == "overwrite":
            asked = self._app.stage.work.dialog
            self._save_to(argument, asked.then if asked else "", overwrite=True)
        elif name == "open":
            self._app.stage.ask(Dialog("open"))
        elif name == "browse":
            self._browse()
        elif name == "open_file":
            self._told(lambda: self.open(typed(argument)))
        elif name == "camera":
            self._told(self._keep_camera)
        elif name == "discard":
            self._told(self._discard)
        elif name == "restore_autosave":
            self.open(Path(argument))
        elif name == "discard_autosave":
            self._told(lambda: self._discard_autosave(Path(argument)))
        elif name == "duplicate":
            self._told(lambda: self._duplicate(self._layer(argument)))
        elif name == "replace":
            self._app.stage.ask(Dialog("replace", then=argument))
        elif name == "replace_by":
            index, _, path = argument.partition(":")
            self._told(lambda: self._replace(self._layer(index), typed(path)))
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
        path = session_file(path)
        if path != self.path and path.is_file() and kind_of(path) != "session":
            raise ProgdfError(f"{path} is not a session; choose another name")
        self._write(path)
        self._autosave.drop()
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
        if not self.unsaved:
            self._autosave.stop()
            return None
        kept, before = workspace.worth_saving(self._app.stage.work), self._autosave.path
        try:
            wait = self._autosave.wait(now, kept, self._beside, self._write)
        except (ProgdfError, OSError) as error:
            self._app.stage.tell(f"Autosave failed: {error}", error=True)
            return None
        if self._autosave.path is not None and self._autosave.path != before:
            self._app.stage.recent = self._remember(self._autosave.path)
        return wait or None

    def closed(self) -> None:
        """The window closes, and nothing is lost: the autosave has done its work."""
        self._autosave.drop()

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
        stage.tell(f"Opened {path.name}; press Space to play it")

    def _open_session(self, path: Path) -> None:
        opened = session.open_session(path)
        self._autosave.drop()
        self._app.show(opened.document)
        stage = self._app.stage
        stage.restart(opened.view, opened.snapshots)
        beside = autosaves.session_of(path)
        if beside is None:
            self.path = path
            self.offer_autosave()
            return
        stage.work = replace(stage.work, saved=None)
        discarded = autosaves.is_discarded(path)
        # what was never saved, or was discarded, never takes the place of a session unasked
        self.path = beside if beside.is_file() and not discarded else None
        if not discarded:
            self._autosave.goes_on(path)
            stage.tell(f"Restored the unsaved work of {beside.name}")

    def offer_autosave(self) -> None:
        """Ask what becomes of work that was left unsaved the last time, of the latest first."""
        if self._app.document.path is None:
            return
        found = autosaves.left(self._named(), numbered=self.path is None)
        left = [path for path in found if path != self._autosave.path and path not in self._put_off]
        if left:
            self._put_off.add(left[0])  # if it is not decided now
            self._app.stage.recent = self._remember(*reversed(left))
            self._app.stage.ask(Dialog("restore", str(left[0])))

    def _discard(self) -> None:
        """Unsaved work is given up; its autosave stays under another name."""
        self._app.stage.work = workspace.as_saved(self._app.stage.work)
        aside = self._autosave.discard()
        if aside is not None:
            self._app.stage.recent = self._remember(aside)

    def _discard_autosave(self, path: Path) -> None:
        aside = autosaves.put_aside(path)
        self._app.stage.recent = self._remember(aside)
        self._app.stage.tell(f"Discarded; a copy is kept in {aside.name}")
        self.offer_autosave()

    def _open_scene(self, path: Path) -> None:
        opened = documents.load(path)
        self._autosave.drop()
        self._app.show(opened)
        self.path = None
        stage = self._app.stage
        camera = first_camera(opened.scene, up=up_of(opened.scene, path=path))
        stage.restart(replace(stage.work.view, camera=camera, layers=(), timeline=Timeline()))
        self.offer_autosave()

    def _add_edit(self, path: Path) -> None:
        """On top, at full strength, so that one sees what came; undo takes it off again."""
        gdf = self._loaded(path)
        view = self._app.stage.work.view
        view = stack.added(view, self._with_edit(gdf, path), gdf.name)
        self._changed(view, len(view.layers) - 1)

    def _duplicate(self, index: int) -> None:
        """A copy of a layer above it, with an edit of its own: the timeline and undo tell edits apart."""
        opened, view = self._app.document, self._app.stage.work.view
        gdf = view.layers[index].gdf
        path = opened.gdf_paths[gdf] if gdf < len(opened.gdf_paths) else None
        self._changed(stack.duplicated(view, index, self._with_edit(opened.gdfs[gdf], path)), index + 1)

    def _replace(self, index: int, path: Path) -> None:
        """Another edit in a layer's place; undo brings the first one back."""
        gdf = self._loaded(path)
        view = self._app.stage.work.view
        self._changed(stack.replaced(view, index, self._with_edit(gdf, path), gdf.name), index)
        self._app.stage.recent = self._remember(path)

    def _loaded(self, path: Path) -> Gdf:
        with all_threads():
            return load_gdf(path, self._app.document.scene)

    def _with_edit(self, gdf: Gdf, path: Path | None) -> int:
        """Have one more edit open; its index."""
        opened = self._app.document
        own = replace(gdf, name=opened.free_name(gdf.name))
        known = path is not None and len(opened.gdf_paths) == len(opened.gdfs)
        paths = (*opened.gdf_paths, path) if known and path is not None else ()
        self._app.show(replace(opened, gdfs=(*opened.gdfs, own), gdf_paths=paths))
        return len(opened.gdfs)

    def _changed(self, view: ViewState, focus: int) -> None:
        """A change of the stack, which undo takes back, and the layer that it is about."""
        stage = self._app.stage
        stage.change(view)
        stage.work = replace(stage.work, focus=focus)

    def _layer(self, index: str) -> int:
        """The layer that a request is about: the focused one where none is named."""
        work = self._app.stage.work
        found = int(index) if index else work.focus
        if found is None or not 0 <= found < len(work.view.layers):
            raise ProgdfError("no layer is selected; click one first")
        return found

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
        stage.tell(
            f"Saved as camera {count} in {path.resolve()}; use it with progdf train … --cameras {path.name}"
        )

    def _write(self, path: Path) -> None:
        session.save(path, self._session())

    def _session(self) -> Session:
        work = self._app.stage.work
        return Session(self._app.document, work.view, work.snapshots)

    def _save_where(self, then: str, ask: bool) -> None:
        if self.path is None or ask:
            self._app.stage.ask(Dialog("save", str(self._beside()), then))
            return
        self._save_to(str(self.path), then)

    def _save_to(self, path: str, then: str, overwrite: bool = False) -> None:
        """Save there, then do what was put off; where that fails, ask for another place and say why.

        A file that is not this session's own is replaced only where the person says so.
        """
        stage = self._app.stage

        def save() -> None:
            file = session_file(typed(path))
            if not overwrite and file != self.path and file.is_file() and kind_of(file) == "session":
                stage.ask(Dialog("overwrite", str(file), then))
                return
            self.save(file)
            stage.work = replace(stage.work, dialog=None)
            if then:
                stage.request(then)

        if error := _failure(save):
            stage.ask(Dialog("save", path, then, error=error))

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
        return Dialog("leave", str(self._beside()), then)

    def _told(self, act: Callable[[], None]) -> None:
        """Do it; what goes wrong is a line in the window."""
        if error := _failure(act):
            self._app.stage.tell(error, error=True)

    def _named(self) -> Path:
        """The session's file, or what it is called where it never had one."""
        return self.path or session.default_path(self._app.document)

    def _beside(self) -> Path:
        """The session's file; where it never had one, a name that nothing has."""
        return self.path or autosaves.free_session(self._named(), self._autosave.path)

    def _remember(self, *paths: Path) -> tuple[Path, ...]:
        if not paths:
            return recent.read(self._memory)
        return recent.remember(paths, self._memory)


def _failure(act: Callable[[], None]) -> str:
    """Do it; what went wrong, in one line, "" for nothing."""
    try:
        act()
    except ProgdfError as error:
        return " ".join(str(error).split())
    except OSError as error:
        return f"{error.filename or 'the file'} cannot be read or written: {error.strerror}"
    return ""
