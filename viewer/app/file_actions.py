"""File actions of the window: opening by content, the session, its autosave, recent files.

Every failure becomes one line in the window, and the work stays unchanged.
"""

from __future__ import annotations

import webbrowser
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from progdf.camera import Camera
from progdf.cli.info import kind_of
from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf, fingerprint, load_gdf
from progdf.io.bundle import BUNDLE, unpack_bundle
from progdf.io.cameras import load_cameras
from progdf.io.picture_camera import edits_in_picture, find_picture_camera
from progdf.io.picture_files import ENDINGS
from progdf.region import Region, from_mask
from progdf.threads import all_threads
from viewer.camera.view_camera import ViewCamera, first_camera, from_camera, to_camera
from viewer.files import document as documents
from viewer.files import exports, session
from viewer.files.document import Document
from viewer.files.session import SessionAutosave, WindowSession, session_file
from viewer.files.user_files import parse_path, read_recent, remember_recent, write_keys
from viewer.panel import dialogs
from viewer.state import selection, workspace
from viewer.state.commands import Action, Plain, Rename, WithText
from viewer.state.facts import describe_applied
from viewer.state.forms import with_picture
from viewer.state.layers import add_layer, duplicate_layer, replace_edit
from viewer.state.view_state import ViewState, on_another_scene
from viewer.state.workspace import Dialog, focus_layer, with_camera, with_transient
from viewer.ui.keys import COMMANDS, shortcut

from .application import Application, Requests, attempt, error_details, failure_line, log_error
from .handles import is_decal, load_decal
from .main_view import MainView


def look_through(main_view: MainView, path: Path) -> None:
    """Move the view to the first camera of a file.

    Raises:
        ProgdfError: the file holds no camera.
    """
    _take_camera(main_view, load_cameras(path, main_view.facts.origin)[0])
    main_view.show_message(f"View set to the first camera of {path.name}")


def edit_picture(main_view: MainView, path: Path) -> None:
    """Put an edited picture into the form of a new edit, and move the view to its camera.

    Raises:
        ProgdfError: it is not a picture, its camera is not found, or it was taken with edits on.
    """
    camera = find_picture_camera(path, origin=main_view.facts.origin)
    if edits := edits_in_picture(path):
        raise ProgdfError(
            f"{path.name} shows edits ({edits}); take a view without edits with {shortcut('take_view')}"
        )
    _take_camera(main_view, camera)
    work = main_view.work
    form = with_picture(work.form, path, work.form_open)
    main_view.store.replace(replace(work, form=form, form_open=True))


def _take_camera(main_view: MainView, camera: Camera) -> None:
    view_camera = from_camera(main_view.work.view.camera, camera, main_view.facts.bounds)
    main_view.store.replace(with_camera(main_view.work, view_camera))


def keep_camera(app: Application, session: Path | None) -> None:
    """Add the view on screen to the cameras stored next to the session, or next to the scene.

    Raises:
        ProgdfError: see `exports.camera`.
    """
    main_view = app.main_view
    beside = session or app.document.path or main_view.pictures / app.document.title
    camera = to_camera(main_view.work.view.camera, *main_view.picture_size)
    path, count = exports.camera(beside, camera, main_view.facts.origin)
    main_view.show_message(f"Saved as camera {count} in {path.resolve()}")


class EditActions:
    """Changes of the layer stack that can be undone.

    Args:
        app: the window
    """

    def __init__(self, app: Application) -> None:
        self._app = app
        self._store = app.store

    def add(self, path: Path, name: str = "", strength: float = 1.0, deselect: bool = False) -> None:
        """Add an edit on top, see `add_layer`.

        A grade of another scene, or of none, is applied to the selection, or everywhere if nothing is
        selected.

        Args:
            name: name of the layer, "" for the edit's name

        Raises:
            ProgdfError: the file is missing or broken, or it is not a grade and was made for another scene.
        """
        before = self._store.get().view
        scene = self._app.document.original
        selected = selection.unpack(before.selection.members, len(scene)).copy()
        where, mask = ("selection", selected) if selected.any() else ("all", np.ones(len(scene), bool))
        gdf = self._load(path, from_mask(where, torch.from_numpy(mask)))
        gdf = replace(gdf, name=name or gdf.name)
        if deselect:
            before = replace(before, selection=selection.select_none(before.selection))
        view = add_layer(before, self._open(gdf, path), gdf.name, strength)
        self._apply(view, len(view.layers) - 1)

    def finish(self, draft: Path, path: Path) -> bool:
        """Replace a draft by its trained edit in every layer and history entry; return True if a layer uses
        it.

        The state does not change: strength, gains, paint, order, selection and undo history stay.

        Raises:
            ProgdfError: see `add`.
        """
        document = self._app.document
        view = self._store.get().view
        drafts = [i for i, known in enumerate(document.gdf_paths) if known == draft]
        if not drafts:
            return False
        gdf = self._load(path, document.edits[drafts[0]].region)
        gdfs = list(document.edits)
        paths = list(document.gdf_paths)
        for i in drafts:
            if not torch.equal(gdf.region.members, gdfs[i].region.members):
                return False
            gdfs[i] = replace(gdf, name=gdfs[i].name)
            paths[i] = path
        self._app.show(replace(document, edits=tuple(gdfs), gdf_paths=tuple(paths)))
        return any(layer.gdf in drafts for layer in view.layers)

    def duplicate(self, index: int) -> None:
        """Add a copy of a layer above it, with its own edit, as the timeline and undo distinguish edits."""
        document = self._app.document
        view = self._store.get().view
        gdf = view.layers[index].gdf
        path = document.gdf_paths[gdf] if gdf < len(document.gdf_paths) else None
        self._apply(duplicate_layer(view, index, self._open(document.edits[gdf], path)), index + 1)

    def replace(self, layer: int | None, path: str) -> None:
        """Replace a layer's edit; a grade of another scene, or of none, takes the layer's region.

        Raises:
            ProgdfError: see `add`.
        """
        view = self._store.get().view
        index = self.layer(layer)
        file = parse_path(path)
        gdf = self._load(file, self._app.document.edits[view.layers[index].gdf].region)
        self._apply(replace_edit(view, index, self._open(gdf, file), gdf.name), index)

    def layer(self, index: int | None) -> int:
        """Return the layer of a request: the given index, or the focused layer for None.

        Raises:
            ProgdfError: there is no such layer.
        """
        work = self._store.get()
        chosen = work.focus if index is None else index
        if chosen is None or not 0 <= chosen < len(work.view.layers):
            raise ProgdfError("no layer is selected; click one first")
        return chosen

    def _load(self, path: Path, region: Region) -> Gdf:
        """Load an edit of the scene, or a grade of another scene applied to a region."""
        scene = self._app.document.original

        def place(stored: Gdf) -> Region | None:
            return region if stored.field.kind == "grade" and stored.scene != fingerprint(scene) else None

        with all_threads():
            gdf = load_gdf(path, scene, place=place)
        if note := describe_applied(gdf):
            self._app.main_view.show_message(note)
        return gdf

    def _open(self, gdf: Gdf, path: Path | None) -> int:
        """Open one more edit and return its index."""
        document = self._app.document
        renamed = replace(gdf, name=document.free_name(gdf.name))
        has_paths = path is not None and len(document.gdf_paths) == len(document.edits)
        paths = (*document.gdf_paths, path) if has_paths and path is not None else ()
        self._app.show(replace(document, edits=(*document.edits, renamed), gdf_paths=paths))
        return len(document.edits)

    def _apply(self, view: ViewState, focus: int) -> None:
        """Set the changed stack and focus one layer."""
        main_view = self._app.main_view
        main_view.change(view)
        self._store.replace(focus_layer(self._store.get(), focus))


class FileActions:
    """File dialogs, opening and saving for one window.

    Args:
        app: the window
        path: the session's file; None before it has one
    """

    def __init__(self, app: Application, path: Path | None = None) -> None:
        self._app = app
        self._store = app.store
        self.path = path
        self.session_autosave = SessionAutosave()
        self._put_off: set[Path] = set()  # autosaves that the user decides about later
        self._browser = dialogs.Browser()
        self._edits = EditActions(app)
        opened = app.document
        self._remember(*(file for file in (opened.path, path) if file is not None))

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about files, by name.

        `save_to`, `overwrite`, `open_file`, `restore_autosave` and `discard_autosave` name a file.
        `duplicate` and `replace` take a layer's index, or use the focused layer. `browse` shows the system
        file dialog next to the open dialog.
        """
        ask = self._app.main_view.ask
        edits = self._edits
        return {
            "save": lambda then: self._save_where(then, ask=False),
            "save_as": lambda then: self._save_where(then, ask=True),
            "save_to": self._save_to,
            "overwrite": lambda path: self._save_to(path, overwrite=True),
            "open": lambda _: ask(Dialog("open")),
            "decal": lambda _: ask(Dialog("open", notice="A picture to place on a surface")),
            "browse": self._browse,
            "open_file": lambda path: self.open(parse_path(path)),
            "camera": lambda _: keep_camera(self._app, self.path),
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

    def _open_keys(self, _: None) -> None:
        """Open the file of key bindings in its default program; create it with all keys if it is missing."""
        keys = {name: command.keys.split() for name, command in COMMANDS.items()}
        path = write_keys(keys)
        webbrowser.open(path.as_uri())
        self._app.main_view.show_message(f"Keys are read from {path} when the window opens")

    def poll_dialog(self) -> float | None:
        """Poll the system file dialog, and take a chosen file.

        Returns:
            Seconds until the next call; None if no system dialog is open.
        """
        main_view = self._app.main_view
        dialog = self._browser.poll(self._store.get().dialog)
        if dialog is not None and dialog != self._store.get().dialog:
            main_view.ask(dialog)
        return dialogs.POLL_S if self._browser.on_screen else None

    @property
    def has_unsaved(self) -> bool:
        """True if there are unsaved changes that a session can store."""
        return self._app.document.path is not None and workspace.has_unsaved(self._store.get())

    def open(self, path: Path) -> None:
        """Open a file according to its content.

        Scenes and sessions replace everything, an edit becomes the top layer, a camera moves the view, and an
        edited picture goes into the form of a new edit.
        """

        def open_kind() -> None:
            file = unpack_bundle(path) if path.name.endswith(BUNDLE) else path
            picture = file.suffix.lower() in ENDINGS
            self._open(file, "picture" if picture else kind_of(file))

        attempt(self._app.main_view, open_kind)

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
            exports.region_file(region, len(self._app.document.original))
        self.session_autosave.drop()
        self.path = path
        main_view = self._app.main_view
        self._store.replace(workspace.mark_saved(self._store.get()))
        self._remember(path)
        main_view.show_message(f"Saved {path.resolve()}")

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
            self._app.main_view.show_message(f"Autosave failed: {error}", error=True)
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
        """Close the system file dialog, if it is still open."""
        self._browser.close()

    def _open(self, path: Path, kind: str) -> None:
        if self._app.main_view.at_start and kind in ("picture", "cameras", "gdf"):
            raise ProgdfError(f"{path.name} belongs to a scene; open that first")
        main_view = self._app.main_view
        if kind == "picture":
            if is_decal(path) and self._app.document.path is not None:
                decal = load_decal(main_view.context, path)
                self._store.replace(with_transient(self._store.get(), gizmo=decal))
                main_view.wake()
            else:
                edit_picture(main_view, path)
            return
        if kind == "cameras":
            look_through(self._app.main_view, path)
            return
        if kind == "gdf":
            try:
                self._edits.add(path)
            except ProgdfError as error:
                if "made for another scene" not in str(error):
                    raise
                line = f"{path.name} was made for another scene"
                main_view.show_message(line, True, button=("Rebind…", WithText("rebind", str(path))))
                return
        elif self.has_unsaved:
            self._app.main_view.ask(self._closing_question(WithText("open_file", str(path))))
            return
        elif kind == "session":
            self._open_session(path)
        else:
            self._open_scene(path)
        self._remember(path)

    def _open_session(self, path: Path) -> None:
        main_view = self._app.main_view
        opened = self._app.wait_for(lambda: session.open_session(path), f"Opening {path.name} …")
        self._app.open_document(opened.document, opened.view, opened.snapshots)
        self.session_autosave.drop()
        if opened.warning:
            main_view.show_message(opened.warning, error=True)
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
            main_view.show_message(f"Restored the unsaved work of {saved.name}")

    def offer_autosave(self) -> None:
        """Ask about the latest autosave of an earlier window, if there is any."""
        if self._app.document.path is None:
            return
        paths = session.find_autosaves(self._session_name(), numbered=self.path is None)
        new = [path for path in paths if path != self.session_autosave.path and path not in self._put_off]
        if new:
            self._put_off.add(new[0])  # in case the user does not decide now
            self._app.main_view.ask(Dialog("restore", str(new[0])))

    def _discard(self, _: None) -> None:
        """Discard unsaved work; its autosave stays under another name."""
        self._store.replace(workspace.mark_saved(self._store.get()))
        self.session_autosave.discard()

    def _discard_autosave(self, path: str) -> None:
        aside = session.put_aside(Path(path))
        self._app.main_view.show_message(f"Discarded; a copy is kept in {aside.name}")
        self.offer_autosave()

    def _open_scene(self, path: Path) -> None:
        def load() -> tuple[Document, ViewCamera]:
            opened = documents.load(path)
            up = opened.detected_up.direction
            return opened, first_camera(opened.scene, up=up, stored=opened.stored_camera)

        opened, camera = self._app.wait_for(load, f"Opening {path.name} …")
        self._app.open_document(opened, on_another_scene(self._store.get().view, camera))
        self.session_autosave.drop()
        self.path = None
        self.offer_autosave()

    def _keep_region(self, name: str) -> None:
        main_view = self._app.main_view
        opened = self._app.document
        if self.path is None and opened.path is None:
            raise ProgdfError(f"{opened.title} was not opened from a file; save the scene first")
        folder = (self.path or opened.path or Path()).resolve().parent
        view = self._store.get().view
        total = len(opened.original)
        selection = exports.keep_region(view.selection, name, folder, total)
        main_view.change(replace(view, selection=selection))
        line = f"Region '{selection.regions[-1].name}' saved"
        main_view.show_message(line, button=("New edit", Plain("new_edit")))

    def _rename_region(self, action: Rename) -> None:
        view = self._store.get().view
        total = len(self._app.document.original)
        renamed = exports.rename_region(view.selection, action.index, action.text, total)
        self._app.main_view.change(replace(view, selection=renamed))

    def _claim_regions(self, path: Path) -> None:
        """Assign new files next to a session at `path` to regions whose files it could not load."""
        main_view = self._app.main_view
        scene = self._app.document.path
        view = self._store.get().view
        if scene is not None and view.selection.regions:
            folders = exports.region_folders(path, scene)
            main_view.change(replace(view, selection=exports.claim_regions(view.selection, folders)))

    def _write(self, path: Path) -> None:
        session.save(path, self._session())

    def _session(self) -> WindowSession:
        work = self._store.get()
        return WindowSession(self._app.document, work.view, work.snapshots)

    def _save_where(self, then: Action | None, ask: bool) -> None:
        if self.path is None or ask:
            self._app.main_view.ask(Dialog("save", str(self._autosave_base()), then))
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
        main_view = self._app.main_view
        dialog = self._store.get().dialog
        if then is None:
            then = dialog.then if dialog else None

        def save() -> None:
            file = session_file(parse_path(path))
            if not overwrite and file != self.path and file.is_file() and kind_of(file) == "session":
                main_view.ask(Dialog("overwrite", str(file), then))
                return
            self.save(file)
            self._store.replace(replace(self._store.get(), dialog=None))
            if then is not None:
                main_view.request(then)

        if error := failure_line(save):
            main_view.ask(Dialog("save", path, then, error=error))

    def _browse(self, _: None) -> None:
        """Open the system file dialog next to the open dialog."""
        main_view = self._app.main_view
        dialog = self._store.get().dialog
        if dialog is not None:
            near = self.path or self._app.document.path or Path("file")
            main_view.ask(self._browser.open(dialog, near))

    def leave(self) -> None:
        """Close the window, after a question if there are unsaved changes."""
        if self.has_unsaved:
            self._app.main_view.ask(self._closing_question(Plain("quit")))
        else:
            self._app.leave()

    def _closing_question(self, then: Action) -> Dialog:
        return Dialog("leave", str(self._autosave_base()), then)

    def _session_name(self) -> Path:
        """Return the session's file, or its default name if it has none."""
        return self.path or session.default_path(self._app.document)

    def _autosave_base(self) -> Path:
        """Return the session's file, or an unused name if it has none."""
        return self.path or session.free_session(self._session_name(), self.session_autosave.path)

    def _remember(self, *paths: Path) -> None:
        """Add files to the recent ones."""
        recent = remember_recent(paths) if paths else read_recent()
        self._store.replace(with_transient(self._store.get(), recent=recent))
