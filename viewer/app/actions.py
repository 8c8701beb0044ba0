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
from viewer.files.autosave import SessionAutosave
from viewer.files.document import Document
from viewer.files.session import WindowSession
from viewer.files.typed_paths import parse_path, session_file
from viewer.render.threads import all_threads
from viewer.state import layers as stack
from viewer.state import workspace
from viewer.state.playback import Player
from viewer.state.view_state import Timeline, ViewState
from viewer.state.workspace import Dialog

from . import native_dialogs as native
from .main_view import MainView


class Application(Protocol):
    """What the file actions needs of the application."""

    document: Document
    main_view: MainView

    def show(self, document: Document) -> None:
        """Draw another document from now on."""

    def leave(self) -> None:
        """Close the window, without a question."""


class FileActions:
    """Opens, saves and asks, for one window.

    Args:
        app: the window
        path: the session's file, None before it has one
        memory: folder of the list of recent files; the user's own if None
    """

    def __init__(self, app: Application, path: Path | None = None, memory: Path | None = None) -> None:
        self._app, self.path, self._memory = app, path, memory
        self._autosave = SessionAutosave()
        self._put_off: set[Path] = set()  # autosaves that were found and are to be decided about later
        self._browser = native.Browser()
        opened = app.document
        files = (*opened.gdf_paths, *((opened.path,) if opened.path else ()), *((path,) if path else ()))
        app.main_view.recent = self._remember(*files)

    def handle(self, request: str) -> None:
        """One request of `workspace.REQUESTS` that is about files, or "quit"."""
        name, _, argument = request.partition(":")
        if name in ("save", "save_as"):
            self._save_where(argument, ask=name == "save_as")
        elif name == "save_to":
            asked = self._app.main_view.work.dialog
            self._save_to(argument, asked.then if asked else "")
        elif name == "overwrite":
            asked = self._app.main_view.work.dialog
            self._save_to(argument, asked.then if asked else "", overwrite=True)
        elif name == "open":
            self._app.main_view.ask(Dialog("open"))
        elif name == "browse":
            self._browse()
        elif name == "open_file":
            self._report_errors(lambda: self.open(parse_path(argument)))
        elif name == "camera":
            self._report_errors(self._keep_camera)
        elif name == "discard":
            self._report_errors(self._discard)
        elif name == "restore_autosave":
            self.open(Path(argument))
        elif name == "discard_autosave":
            self._report_errors(lambda: self._discard_autosave(Path(argument)))
        elif name == "duplicate":
            self._report_errors(lambda: self._duplicate(self._layer(argument)))
        elif name == "replace":
            self._app.main_view.ask(Dialog("replace", then=argument))
        elif name == "replace_by":
            index, _, path = argument.partition(":")
            self._report_errors(lambda: self._replace(self._layer(index), parse_path(path)))
        elif name == "quit":
            self._leave()

    def poll_dialog(self) -> float | None:
        """Look whether a file was chosen in the desktop's own dialog, and take it.

        Returns:
            Seconds until it has to be called again; None if no such dialog is on screen.
        """
        main_view = self._app.main_view
        asked = self._browser.poll(main_view.work.dialog)
        if asked is not None and asked != main_view.work.dialog:
            main_view.ask(asked)
        return native.POLL_S if self._browser.on_screen else None

    @property
    def has_unsaved(self) -> bool:
        """Whether something would be lost that a session could keep."""
        return self._app.document.path is not None and workspace.has_unsaved(self._app.main_view.work)

    def open(self, path: Path) -> None:
        """A file by what it is: scenes and sessions replace all, an edit comes on top, a camera is taken."""
        self._report_errors(lambda: self._open(path, kind_of(path)))

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
        main_view = self._app.main_view
        main_view.work = workspace.mark_saved(main_view.work)
        main_view.recent = self._remember(path)
        main_view.show_message(f"Saved {path.resolve()}")

    def autosave(self, now: float) -> float | None:
        """Write unsaved work beside the session once it is old enough.

        Args:
            now: seconds of any clock that does not go back

        Returns:
            Seconds until it has to be called again; None if nothing waits.
        """
        if not self.has_unsaved:
            self._autosave.stop()
            return None
        kept, before = workspace.worth_saving(self._app.main_view.work), self._autosave.path
        try:
            wait = self._autosave.wait(now, kept, self._beside, self._write)
        except (ProgdfError, OSError) as error:
            self._app.main_view.show_message(f"Autosave failed: {error}", error=True)
            return None
        if self._autosave.path is not None and self._autosave.path != before:
            self._app.main_view.recent = self._remember(self._autosave.path)
        return wait or None

    def on_close(self) -> None:
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
        elif self.has_unsaved:
            self._app.main_view.ask(self._leaving(f"open_file:{path}"))
            return
        elif kind == "session":
            self._open_session(path)
        else:
            self._open_scene(path)
        self._app.main_view.recent = self._remember(path)

    def _take_timeline(self, path: Path) -> None:
        """Its keys take the place of those there are; undo brings them back."""
        main_view = self._app.main_view
        view = main_view.work.view
        main_view.change(replace(view, timeline=timeline_file.load(path, view.layers)))
        main_view.work = replace(main_view.work, player=Player(shown=True))
        main_view.show_message(f"Opened {path.name}; press Space to play it")

    def _open_session(self, path: Path) -> None:
        opened = session.open_session(path)
        self._autosave.drop()
        self._app.show(opened.document)
        main_view = self._app.main_view
        main_view.restart(opened.view, opened.snapshots)
        beside = autosaves.session_of(path)
        if beside is None:
            self.path = path
            self.offer_autosave()
            return
        main_view.work = replace(main_view.work, saved=None)
        discarded = autosaves.is_discarded(path)
        # what was never saved, or was discarded, never takes the place of a session unasked
        self.path = beside if beside.is_file() and not discarded else None
        if not discarded:
            self._autosave.goes_on(path)
            main_view.show_message(f"Restored the unsaved work of {beside.name}")

    def offer_autosave(self) -> None:
        """Ask what becomes of work that was left unsaved the last time, of the latest first."""
        if self._app.document.path is None:
            return
        found = autosaves.find_autosaves(self._session_name(), numbered=self.path is None)
        left = [path for path in found if path != self._autosave.path and path not in self._put_off]
        if left:
            self._put_off.add(left[0])  # if it is not decided now
            self._app.main_view.recent = self._remember(*reversed(left))
            self._app.main_view.ask(Dialog("restore", str(left[0])))

    def _discard(self) -> None:
        """Unsaved work is given up; its autosave stays under another name."""
        self._app.main_view.work = workspace.mark_saved(self._app.main_view.work)
        aside = self._autosave.discard()
        if aside is not None:
            self._app.main_view.recent = self._remember(aside)

    def _discard_autosave(self, path: Path) -> None:
        aside = autosaves.put_aside(path)
        self._app.main_view.recent = self._remember(aside)
        self._app.main_view.show_message(f"Discarded; a copy is kept in {aside.name}")
        self.offer_autosave()

    def _open_scene(self, path: Path) -> None:
        opened = documents.load(path)
        self._autosave.drop()
        self._app.show(opened)
        self.path = None
        main_view = self._app.main_view
        camera = first_camera(opened.scene, up=up_of(opened.scene, path=path))
        main_view.restart(replace(main_view.work.view, camera=camera, layers=(), timeline=Timeline()))
        self.offer_autosave()

    def _add_edit(self, path: Path) -> None:
        """On top, at full strength, so that one sees what came; undo takes it off again."""
        gdf = self._load_edit(path)
        view = self._app.main_view.work.view
        view = stack.add_layer(view, self._with_edit(gdf, path), gdf.name)
        self._apply(view, len(view.layers) - 1)

    def _duplicate(self, index: int) -> None:
        """A copy of a layer above it, with an edit of its own: the timeline and undo tell edits apart."""
        opened, view = self._app.document, self._app.main_view.work.view
        gdf = view.layers[index].gdf
        path = opened.gdf_paths[gdf] if gdf < len(opened.gdf_paths) else None
        self._apply(stack.duplicate_layer(view, index, self._with_edit(opened.gdfs[gdf], path)), index + 1)

    def _replace(self, index: int, path: Path) -> None:
        """Another edit in a layer's place; undo brings the first one back."""
        gdf = self._load_edit(path)
        view = self._app.main_view.work.view
        self._apply(stack.replace_edit(view, index, self._with_edit(gdf, path), gdf.name), index)
        self._app.main_view.recent = self._remember(path)

    def _load_edit(self, path: Path) -> Gdf:
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

    def _apply(self, view: ViewState, focus: int) -> None:
        """A change of the stack, which undo takes back, and the layer that it is about."""
        main_view = self._app.main_view
        main_view.change(view)
        main_view.work = replace(main_view.work, focus=focus)

    def _layer(self, index: str) -> int:
        """The layer that a request is about: the focused one where none is named."""
        work = self._app.main_view.work
        found = int(index) if index else work.focus
        if found is None or not 0 <= found < len(work.view.layers):
            raise ProgdfError("no layer is selected; click one first")
        return found

    def _look_through(self, path: Path) -> None:
        main_view = self._app.main_view
        main_view.work = workspace.with_camera(
            main_view.work,
            from_camera(main_view.work.view.camera, load_cameras(path)[0], main_view.facts.bounds),
        )
        main_view.show_message(f"Looking through the first camera of {path.name}")

    def _keep_camera(self) -> None:
        """Add the view on screen to the cameras kept beside the session or the scene."""
        main_view = self._app.main_view
        place = self.path or self._app.document.path or main_view.pictures / self._app.document.title
        path, count = saved_files.camera(
            place, to_camera(main_view.work.view.camera, *main_view.picture_size)
        )
        main_view.show_message(
            f"Saved as camera {count} in {path.resolve()}; use it with progdf train … --cameras {path.name}"
        )

    def _write(self, path: Path) -> None:
        session.save(path, self._session())

    def _session(self) -> WindowSession:
        work = self._app.main_view.work
        return WindowSession(self._app.document, work.view, work.snapshots)

    def _save_where(self, then: str, ask: bool) -> None:
        if self.path is None or ask:
            self._app.main_view.ask(Dialog("save", str(self._beside()), then))
            return
        self._save_to(str(self.path), then)

    def _save_to(self, path: str, then: str, overwrite: bool = False) -> None:
        """Save there, then do what was put off; where that fails, ask for another place and say why.

        A file that is not this session's own is replaced only where the person says so.
        """
        main_view = self._app.main_view

        def save() -> None:
            file = session_file(parse_path(path))
            if not overwrite and file != self.path and file.is_file() and kind_of(file) == "session":
                main_view.ask(Dialog("overwrite", str(file), then))
                return
            self.save(file)
            main_view.work = replace(main_view.work, dialog=None)
            if then:
                main_view.request(then)

        if error := _failure(save):
            main_view.ask(Dialog("save", path, then, error=error))

    def _browse(self) -> None:
        """The desktop's own dialog beside the question that is open."""
        main_view = self._app.main_view
        if main_view.work.dialog is not None:
            near = self.path or self._app.document.path or Path("file")
            main_view.ask(self._browser.open(main_view.work.dialog, near))

    def _leave(self) -> None:
        if self.has_unsaved:
            self._app.main_view.ask(self._leaving("quit"))
        else:
            self._app.leave()

    def _leaving(self, then: str) -> Dialog:
        return Dialog("leave", str(self._beside()), then)

    def _report_errors(self, act: Callable[[], None]) -> None:
        """Do it; what goes wrong is a line in the window."""
        if error := _failure(act):
            self._app.main_view.show_message(error, error=True)

    def _session_name(self) -> Path:
        """The session's file, or what it is called where it never had one."""
        return self.path or session.default_path(self._app.document)

    def _beside(self) -> Path:
        """The session's file; where it never had one, a name that nothing has."""
        return self.path or autosaves.free_session(self._session_name(), self._autosave.path)

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
