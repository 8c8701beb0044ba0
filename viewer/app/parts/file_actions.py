"""File actions of the window: opening by content, the session, its autosave, recent files.

Every failure becomes one line in the window, and the work stays unchanged.
"""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from progdf.io.bundle import BUNDLE, unpack_bundle
from progdf.io.picture_files import ENDINGS
from viewer.app.messages import (
    LOG,
    Messages,
    Requests,
    WaitFor,
    attempt,
    error_details,
    failure_line,
    log_error,
)
from viewer.app.parts.edits import EditActions
from viewer.app.parts.pictures import PictureActions
from viewer.camera.view_camera import ViewCamera, first_camera
from viewer.files import document, region_files, session
from viewer.files.session import Claim, SessionAutosave, WindowSession, session_file
from viewer.files.user_files import keys_file, parse_path, read_keys, read_recent, remember_recent, write_keys
from viewer.panel import dialogs
from viewer.state import workspace
from viewer.state.commands import Action, Plain, Rename, WithText
from viewer.state.selection import equal_region
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import ViewState, on_another_scene
from viewer.state.workspace import Dialog, Store, with_transient
from viewer.ui.keys import COMMANDS, bind

OpenDocument = Callable[[document.Document, ViewState, tuple[SliderSnapshot, ...]], None]
"""Function that replaces the open scene by another, with its view and snapshots."""


class FileActions:
    """File dialogs, opening and saving for one window.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        edits: adds opened edits as layers
        pictures: opens pictures and cameras
        open_document: replaces the open scene by another
        wait_for: runs work in another thread while the window shows a text
        leave: closes the window without a question
        path: the session's file; None before it has one
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: document.DocumentStore,
        messages: Messages,
        edits: EditActions,
        pictures: PictureActions,
        open_document: OpenDocument,
        wait_for: WaitFor,
        leave: Callable[[], None],
        path: Path | None = None,
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._edits = edits
        self._pictures = pictures
        self._open_document = open_document
        self._wait_for = wait_for
        self._leave = leave
        self.path = path
        self.session_autosave = SessionAutosave()
        self._claim = Claim()
        self._put_off: set[Path] = set()  # autosaves that the user decides about later
        self._browser = dialogs.Browser()
        opened = documents.get()
        self._remember(*(file for file in (opened.path, path) if file is not None))

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about files, by name.

        `save_to`, `overwrite`, `open_file`, `restore_autosave` and `discard_autosave` name a file.
        `duplicate` and `replace` take a layer's index, or use the focused layer. `browse` shows the system
        file dialog next to the open dialog.
        """
        ask = self._messages.ask
        edits = self._edits
        return {
            "save": lambda then: self._save_where(then, ask=False),
            "save_as": lambda then: self._save_where(then, ask=True),
            "save_to": self._save_to,
            "overwrite": lambda path: self._save_to(path, overwrite=True),
            "open": lambda _: ask(Dialog("open")),
            "decal": lambda _: ask(Dialog("open", notice="A picture to place on a surface")),
            "browse": self._browse,
            "open_file": self._open_typed,
            "camera": lambda _: self._pictures.keep_camera(self.path),
            "discard": self._discard,
            "restore_autosave": lambda path: self.open(Path(path)),
            "discard_autosave": self._discard_autosave,
            "duplicate": lambda index: edits.duplicate(edits.layer(index)),
            "replace": lambda index: ask(Dialog("replace", item=index)),
            "replace_by": lambda action: edits.replace(action.index, action.path),
            "save_region": self._keep_region,
            "rename_region": self._rename_region,
            "keys_file": self._open_keys,
        }

    def bind_keys(self) -> None:
        """Bind the keys that the user assigned to commands; show and log errors."""
        bind({})
        attempt(self._messages, self._bind_user_keys)

    def _bind_user_keys(self) -> None:
        if problems := bind(read_keys()):
            where = keys_file()
            more = len(problems) - 1
            log_error("\n".join([f"{where}:", *problems]))
            text = f"{where.name}: {problems[0]}" + (f", and {more} more in {LOG}" if more else "")
            self._messages.show(text, error=True)

    def _open_keys(self, _: None) -> None:
        """Open the file of key bindings in its default program; create it with all keys if it is missing."""
        keys = {name: command.keys.split() for name, command in COMMANDS.items()}
        path = write_keys(keys)
        webbrowser.open(path.as_uri())
        self._messages.show(f"Keys are read from {path} when the window opens")

    def poll_dialog(self) -> float | None:
        """Poll the system file dialog, and take a chosen file.

        Returns:
            Seconds until the next call; None if no system dialog is open.
        """
        dialog = self._browser.poll(self._store.get().dialog)
        if dialog is not None and dialog != self._store.get().dialog:
            self._messages.ask(dialog)
        return dialogs.POLL_S if self._browser.on_screen else None

    @property
    def has_unsaved(self) -> bool:
        """True if there are unsaved changes that a session can store."""
        return self._documents.get().path is not None and workspace.has_unsaved(self._store.get())

    def open(self, path: Path) -> None:
        """Open a file according to its content.

        Scenes and sessions replace everything, an edit becomes the top layer, a camera moves the view, and an
        edited picture goes into the form of a new edit.
        """
        attempt(self._messages, lambda: self._open_any(path))

    def _open_typed(self, path: str) -> None:
        """Open a file; after a failure, its path stays in an open dialog, with the reason."""
        dialog = self._store.get().dialog
        if dialog is None or dialog.kind != "open":
            self.open(parse_path(path))
            return
        self._store.replace(replace(self._store.get(), dialog=None))
        if error := failure_line(lambda: self._open_any(parse_path(path))):
            self._messages.ask(replace(dialog, text=path, error=error))

    def save(self, path: Path) -> None:
        """Save the session to `path`, which becomes its file.

        Raises:
            ProgdfError: see `session.save`.
            OSError: it cannot be written.
        """
        path = session_file(path)
        if path != self.path and path.is_file() and kind_of(path) != "session":
            raise ProgdfError(f"{path} is not a session; choose another name")
        self._claim_regions(path)
        self._write(path)
        for region in self._store.get().view.selection.regions:
            region_files.region_file(
                region, len(self._documents.get().original), self._documents.get().counts
            )
        self.session_autosave.drop()
        self._claim.take(path)
        self.path = path
        self._store.replace(workspace.mark_saved(self._store.get()))
        self._remember(path)
        self._messages.show(f"Saved {path.resolve()}")

    def autosave(self, now: float) -> float | None:
        """Write unsaved work next to the session once it is old enough.

        Args:
            now: seconds of any monotonic clock

        Returns:
            Seconds until the next call; None if nothing waits.
        """
        if not self.has_unsaved:
            self.session_autosave.stop()
            return None
        unsaved = workspace.saved_state(self._store.get())
        try:
            wait = self.session_autosave.wait(now, unsaved, self._autosave_base, self._write)
        except (ProgdfError, OSError) as error:
            self._messages.show(f"Autosave failed: {error}", error=True)
            return None
        return wait or None

    def keep_work(self) -> str:
        """Write unsaved work next to the session at once; return a line that reports the result."""
        try:
            if not self.has_unsaved:
                return "there was no unsaved work"
            unsaved = workspace.saved_state(self._store.get())
            path = self.session_autosave.write(unsaved, self._autosave_base, self._write)
            return f"unsaved work is kept in {path}"
        except Exception as error:  # the work itself may be invalid
            log_error(error_details(error))
            return f"unsaved work could not be kept ({error}); save it under another name"

    def on_close(self) -> None:
        """Remove the autosave when the window closes, as no work is unsaved."""
        self.session_autosave.drop()

    def release(self) -> None:
        """Close the system file dialog, if it is still open, and release the open files."""
        self._browser.close()
        self._claim.release()
        self.session_autosave.release()

    def _open_any(self, path: Path) -> None:
        file = unpack_bundle(path) if path.name.endswith(BUNDLE) else path
        picture = file.suffix.lower() in ENDINGS
        self._open(file, "picture" if picture else kind_of(file))

    def _open(self, path: Path, kind: str) -> None:
        if self._documents.get().is_empty and kind in ("picture", "cameras", "gdf"):
            raise ProgdfError(f"{path.name} belongs to a scene; open that first")
        if kind == "picture":
            self._pictures.open(path)
            return
        if kind == "cameras":
            self._pictures.look_through(path)
            return
        if kind == "gdf":
            try:
                self._edits.add(path)
            except ProgdfError as error:
                if "made for another scene" not in str(error):
                    raise
                line = f"{path.name} was made for another scene"
                self._messages.offer(line, ("Rebind…", WithText("rebind", str(path))), error=True)
                return
        elif self.has_unsaved:
            self._messages.ask(self._closing_question(WithText("open_file", str(path))))
            return
        elif kind == "session":
            self._open_session(path)
        else:
            self._open_scene(path)
        self._remember(path)

    def _open_session(self, path: Path) -> None:
        opened = self._wait_for(lambda: session.open_session(path), f"Opening {path.name} …")
        self._open_document(opened.document, opened.view, opened.snapshots)
        self.session_autosave.drop()
        if opened.warning:
            self._messages.show(opened.warning, error=True)
        saved = session.session_of(path)
        if saved is None:
            self.path = path
            self.offer_autosave()
            return
        self._store.replace(replace(self._store.get(), saved=None))
        discarded = session.is_discarded(path)
        # work that was never saved, or was discarded, never replaces a session without a question
        self.path = saved if saved.is_file() and not discarded else None
        if not discarded:
            self.session_autosave.continue_from(path)
            self._messages.show(f"Restored the unsaved work of {saved.name}")

    def offer_autosave(self) -> None:
        """Ask about the latest autosave of a window that is gone, if there is any.

        A message reports that another window has the same session open.
        """
        if self._documents.get().path is None:
            return
        name = self._session_name()
        if not self._claim.take(name):
            self._messages.show(f"{session.stem(name)} is open in another window")
        own = (self.session_autosave.path, *self._put_off)
        paths = session.find_autosaves(name, numbered=self.path is None)
        new = [path for path in paths if path not in own and not session.is_claimed(path)]
        if new:
            self._put_off.add(new[0])  # in case the user does not decide now
            self._messages.ask(Dialog("restore", str(new[0])))

    def _discard(self, _: None) -> None:
        """Discard unsaved work; its autosave stays under another name."""
        self._store.replace(workspace.mark_saved(self._store.get()))
        self.session_autosave.discard()

    def _discard_autosave(self, path: str) -> None:
        aside = session.put_aside(Path(path))
        self._messages.show(f"Discarded; a copy is kept in {aside.name}")
        self.offer_autosave()

    def _open_scene(self, path: Path) -> None:
        def load() -> tuple[document.Document, ViewCamera]:
            opened = document.load(path)
            up = opened.detected_up.direction
            return opened, first_camera(opened.scene, up=up, stored=opened.stored_camera)

        opened, camera = self._wait_for(load, f"Opening {path.name} …")
        view = on_another_scene(self._store.get().view, camera)
        if self.path is not None:  # the background of a session, such as an example, ends with it
            view = replace(view, background=ViewState.background)
        self._open_document(opened, view, ())
        self.session_autosave.drop()
        self.path = None
        self.offer_autosave()

    def _keep_region(self, name: str) -> None:
        opened = self._documents.get()
        if self.path is None and opened.path is None:
            raise ProgdfError(f"{opened.title} was not opened from a file; save the scene first")
        folder = (self.path or opened.path or Path()).resolve().parent
        view = self._store.get().view
        total = len(opened.original)
        selection = region_files.keep_region(view.selection, name, folder, total, opened.counts)
        self._store.change(replace(view, selection=selection))
        index = equal_region(selection, selection.members, total)
        kept_name = selection.regions[-1 if index is None else index].name
        line = f"Region '{kept_name}' saved"
        if selection == view.selection:
            line = f"The selection is already saved as the region '{kept_name}'"
        self._messages.show(line, button=("New edit", Plain("new_edit")))

    def _rename_region(self, action: Rename) -> None:
        view = self._store.get().view
        opened = self._documents.get()
        total = len(opened.original)
        renamed = region_files.rename_region(view.selection, action.index, action.text, total, opened.counts)
        self._store.change(replace(view, selection=renamed))

    def _claim_regions(self, path: Path) -> None:
        """Assign new files next to a session at `path` to regions whose files it could not load."""
        scene = self._documents.get().path
        view = self._store.get().view
        if scene is not None and view.selection.regions:
            folders = region_files.region_folders(path, scene)
            self._store.change(replace(view, selection=region_files.claim_regions(view.selection, folders)))

    def _write(self, path: Path) -> None:
        session.save(path, self._session())

    def _session(self) -> WindowSession:
        work = self._store.get()
        return WindowSession(self._documents.get(), work.view, work.snapshots)

    def _save_where(self, then: Action | None, ask: bool) -> None:
        if self.path is None or ask:
            self._messages.ask(Dialog("save", str(self._autosave_base()), then))
            return
        self._save_to(str(self.path), then)

    def _save_to(self, path: str, then: Action | None = None, overwrite: bool = False) -> None:
        """Save to `path`, then perform the postponed request. On failure, ask for another path and show the
        error.

        A file that is not this session's own is replaced only after confirmation.

        Args:
            then: the postponed request; None takes that of the open dialog
            overwrite: the user has confirmed the replacement
        """
        dialog = self._store.get().dialog
        if then is None:
            then = dialog.then if dialog else None

        def save() -> None:
            file = session_file(parse_path(path))
            if not overwrite and file != self.path and file.is_file() and kind_of(file) == "session":
                self._messages.ask(Dialog("overwrite", str(file), then))
                return
            self.save(file)
            self._store.replace(replace(self._store.get(), dialog=None))
            if then is not None:
                self._messages.request(then)

        if error := failure_line(save):
            self._messages.ask(Dialog("save", path, then, error=error))

    def _browse(self, _: None) -> None:
        """Open the system file dialog next to the open dialog."""
        dialog = self._store.get().dialog
        if dialog is not None:
            near = self.path or self._documents.get().path or Path("file")
            self._messages.ask(self._browser.open(dialog, near))

    def leave(self) -> None:
        """Close the window, after a question if there are unsaved changes."""
        if self.has_unsaved:
            self._messages.ask(self._closing_question(Plain("quit")))
        else:
            self._leave()

    def _closing_question(self, then: Action) -> Dialog:
        return Dialog("leave", str(self._autosave_base()), then)

    def _session_name(self) -> Path:
        """Return the session's file, or its default name if it has none."""
        return self.path or session.default_path(self._documents.get())

    def _autosave_base(self) -> Path:
        """Return the session's file, or an unused name if it has none."""
        return self.path or session.free_session(self._session_name(), self.session_autosave.path)

    def _remember(self, *paths: Path) -> None:
        """Add files to the recent ones."""
        recent = remember_recent(paths) if paths else read_recent()
        self._store.replace(with_transient(self._store.get(), recent=recent))
