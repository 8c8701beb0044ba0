"""Files of the window: opened and dropped ones by their content, the session, its autosave, recent files.

Everything that goes wrong here is one line in the window; the work stays as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from viewer.camera.view_camera import first_camera
from viewer.files import autosave as autosaves
from viewer.files import document as documents
from viewer.files import recent, regions, session
from viewer.files.autosave import SessionAutosave
from viewer.files.session import WindowSession
from viewer.files.typed_paths import parse_path, session_file
from viewer.state import workspace
from viewer.state.view_state import on_another_scene
from viewer.state.workspace import Dialog
from viewer.ui import native_dialogs

from . import view_actions
from .application import Application, error_details, failure_line, log_error
from .edit_actions import EditActions


class FileActions:
    """Opens, saves and asks, for one window.

    Args:
        app: the window
        path: the session's file, None before it has one
        memory: folder of the list of recent files; the user's own if None
    """

    def __init__(self, app: Application, path: Path | None = None, memory: Path | None = None) -> None:
        self._app, self.path, self._memory = app, path, memory
        self.session_autosave = SessionAutosave()
        self._put_off: set[Path] = set()  # autosaves that were found and are to be decided about later
        self._browser = native_dialogs.Browser()
        self._edits = EditActions(app)
        opened = app.document
        app.main_view.recent = self._remember(*(file for file in (opened.path, path) if file is not None))

    def handle(self, request: str) -> None:
        """One request of `workspace.REQUESTS` that is about files, or "quit"."""
        name, _, argument = request.partition(":")
        if name in ("save", "save_as"):
            self._save_where(argument, ask=name == "save_as")
        elif name in ("save_to", "overwrite"):
            asked = self._app.main_view.work.dialog
            self._save_to(argument, asked.then if asked else "", overwrite=name == "overwrite")
        elif name == "open":
            self._app.main_view.ask(Dialog("open"))
        elif name == "browse":
            self._browse()
        elif name == "open_file":
            self._report_errors(lambda: self.open(parse_path(argument)))
        elif name == "camera":
            self._report_errors(lambda: view_actions.keep_camera(self._app, self.path))
        elif name == "discard":
            self._report_errors(self._discard)
        elif name == "restore_autosave":
            self.open(Path(argument))
        elif name == "discard_autosave":
            self._report_errors(lambda: self._discard_autosave(Path(argument)))
        elif name == "duplicate":
            self._report_errors(lambda: self._edits.duplicate(self._edits.layer(argument)))
        elif name == "replace":
            self._app.main_view.ask(Dialog("replace", then=argument))
        elif name == "replace_by":
            index, _, path = argument.partition(":")
            self._report_errors(lambda: self._edits.replace(self._edits.layer(index), parse_path(path)))
        elif name == "save_region":
            self._report_errors(lambda: self._keep_region(argument))
        elif name == "rename_region":
            self._report_errors(lambda: self._rename_region(*argument.split(":", 1)))
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
        return native_dialogs.POLL_S if self._browser.on_screen else None

    @property
    def has_unsaved(self) -> bool:
        """Whether something would be lost that a session could keep."""
        return self._app.document.path is not None and workspace.has_unsaved(self._app.main_view.work)

    def open(self, path: Path) -> None:
        """A file by what it is: scenes and sessions replace all, an edit comes on top, a camera is taken, a
        changed picture goes into the form of a new edit."""

        def open_kind() -> None:
            picture = path.suffix.lower() in view_actions.PICTURES
            self._open(path, "picture" if picture else kind_of(path))

        self._report_errors(open_kind)

    def save(self, path: Path) -> None:
        """Save the session there from now on.

        Raises:
            ProgdfError: see `session.save`.
            OSError: it cannot be written.
        """
        path = session_file(path)
        if path != self.path and path.is_file() and kind_of(path) != "session":
            raise ProgdfError(f"{path} is not a session; choose another name")
        self._claim_regions(path)
        self._write(path)
        for region in self._app.main_view.work.view.selection.regions:
            regions.region_file(region, len(self._app.document.scene))
        self.session_autosave.drop()
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
            self.session_autosave.stop()
            return None
        kept = workspace.worth_saving(self._app.main_view.work)
        try:
            wait = self.session_autosave.wait(now, kept, self._autosave_base, self._write)
        except (ProgdfError, OSError) as error:
            self._app.main_view.show_message(f"Autosave failed: {error}", error=True)
            return None
        return wait or None

    def keep_work(self) -> str:
        """Write unsaved work beside the session at once; a line that tells what became of it."""
        try:
            if not self.has_unsaved:
                return "nothing was unsaved"
            kept = workspace.worth_saving(self._app.main_view.work)
            path = self.session_autosave.write(kept, self._autosave_base, self._write)
            return f"unsaved work is kept in {path}"
        except Exception as error:  # what is wrong may be the work itself
            log_error(error_details(error), self._memory)
            return f"unsaved work could not be kept ({error}); save it under another name"

    def on_close(self) -> None:
        """The window closes, and nothing is lost: the autosave has done its work."""
        self.session_autosave.drop()

    def release(self) -> None:
        """Take away what of the desktop's is still on screen."""
        self._browser.close()

    def _open(self, path: Path, kind: str) -> None:
        if self._app.main_view.at_start and kind in ("picture", "cameras", "timeline", "gdf"):
            raise ProgdfError(f"{path.name} belongs to a scene; open that first")
        if kind == "picture":
            view_actions.edit_picture(self._app.main_view, path)
            return
        if kind == "cameras":
            view_actions.look_through(self._app.main_view, path)
            return
        if kind == "timeline":
            view_actions.open_timeline(self._app.main_view, path)
            return
        if kind == "gdf":
            self._edits.add(path)
        elif self.has_unsaved:
            self._app.main_view.ask(self._closing_question(f"open_file:{path}"))
            return
        elif kind == "session":
            self._open_session(path)
        else:
            self._open_scene(path)
        self._app.main_view.recent = self._remember(path)

    def _open_session(self, path: Path) -> None:
        opened, main_view = session.open_session(path, self._memory), self._app.main_view
        self._app.open_document(opened.document, opened.view, opened.snapshots)
        self.session_autosave.drop()
        if opened.warning:
            main_view.show_message(opened.warning, error=True)
        saved = autosaves.session_of(path)
        if saved is None:
            self.path = path
            self.offer_autosave()
            return
        main_view.work = replace(main_view.work, saved=None)
        discarded = autosaves.is_discarded(path)
        # what was never saved, or was discarded, never takes the place of a session unasked
        self.path = saved if saved.is_file() and not discarded else None
        if not discarded:
            self.session_autosave.continue_from(path)
            main_view.show_message(f"Restored the unsaved work of {saved.name}")

    def offer_autosave(self) -> None:
        """Ask what becomes of work that was left unsaved the last time, of the latest first."""
        if self._app.document.path is None:
            return
        found = autosaves.find_autosaves(self._session_name(), numbered=self.path is None)
        left = [path for path in found if path != self.session_autosave.path and path not in self._put_off]
        if left:
            self._put_off.add(left[0])  # if it is not decided now
            self._app.main_view.ask(Dialog("restore", str(left[0])))

    def _discard(self) -> None:
        """Unsaved work is given up; its autosave stays under another name."""
        self._app.main_view.work = workspace.mark_saved(self._app.main_view.work)
        self.session_autosave.discard()

    def _discard_autosave(self, path: Path) -> None:
        aside = autosaves.put_aside(path)
        self._app.main_view.show_message(f"Discarded; a copy is kept in {aside.name}")
        self.offer_autosave()

    def _open_scene(self, path: Path) -> None:
        opened = documents.load(path)
        camera = first_camera(opened.scene, up=opened.found_up.direction)
        self._app.open_document(opened, on_another_scene(self._app.main_view.work.view, camera))
        self.session_autosave.drop()
        self.path = None
        self.offer_autosave()

    def _keep_region(self, name: str) -> None:
        main_view, opened = self._app.main_view, self._app.document
        if self.path is None and opened.path is None:
            raise ProgdfError(f"{opened.title} was not opened from a file; save the scene first")
        folder = (self.path or opened.path or Path()).resolve().parent
        view, total = main_view.work.view, len(opened.scene)
        kept = regions.keep(view.selection, name, folder, total)
        main_view.change(replace(view, selection=kept))
        main_view.show_message(
            f"Saved {kept.regions[-1].path}; train it with --region file:{kept.regions[-1].path.name}"
        )

    def _rename_region(self, index: str, name: str) -> None:
        view, total = self._app.main_view.work.view, len(self._app.document.scene)
        renamed = regions.rename(view.selection, int(index), name, total)
        self._app.main_view.change(replace(view, selection=renamed))

    def _claim_regions(self, path: Path) -> None:
        """Regions whose files a session there would not be given back get new ones beside it."""
        main_view, scene = self._app.main_view, self._app.document.path
        view = main_view.work.view
        if scene is not None and view.selection.regions:
            folders = regions.region_folders(path, scene, self._memory)
            main_view.change(replace(view, selection=regions.claim(view.selection, folders)))

    def _write(self, path: Path) -> None:
        session.save(path, self._session())

    def _session(self) -> WindowSession:
        work = self._app.main_view.work
        return WindowSession(self._app.document, work.view, work.snapshots)

    def _save_where(self, then: str, ask: bool) -> None:
        if self.path is None or ask:
            self._app.main_view.ask(Dialog("save", str(self._autosave_base()), then))
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

        if error := failure_line(save):
            main_view.ask(Dialog("save", path, then, error=error))

    def _browse(self) -> None:
        """The desktop's own dialog beside the question that is open."""
        main_view = self._app.main_view
        if main_view.work.dialog is not None:
            near = self.path or self._app.document.path or Path("file")
            main_view.ask(self._browser.open(main_view.work.dialog, near))

    def _leave(self) -> None:
        if self.has_unsaved:
            self._app.main_view.ask(self._closing_question("quit"))
        else:
            self._app.leave()

    def _closing_question(self, then: str) -> Dialog:
        return Dialog("leave", str(self._autosave_base()), then)

    def _report_errors(self, act: Callable[[], None]) -> None:
        """Do it; what goes wrong is a line in the window."""
        if error := failure_line(act):
            self._app.main_view.show_message(error, error=True)

    def _session_name(self) -> Path:
        """The session's file, or what it is called where it never had one."""
        return self.path or session.default_path(self._app.document)

    def _autosave_base(self) -> Path:
        """The session's file; where it never had one, a name that nothing has."""
        return self.path or autosaves.free_session(self._session_name(), self.session_autosave.path)

    def _remember(self, *paths: Path) -> tuple[Path, ...]:
        if not paths:
            return recent.read(self._memory)
        return recent.remember(paths, self._memory)
