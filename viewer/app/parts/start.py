"""Start page: recent files with thumbnails, the examples and the demo."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import moderngl

from progdf.demo_scenes import SKY
from progdf.errors import ProgdfError
from progdf.io.atomic import make_folder, read_file, state_folder, write_file
from progdf.io.bundle import BUNDLE
from progdf.io.session import sha256
from viewer.app.messages import Messages, Requests, attempt
from viewer.app.parts.edits import EditActions
from viewer.files import user_files
from viewer.files.document import DocumentStore
from viewer.gl.present import picture_texture
from viewer.jobs.job_queue import Delivery, JobQueue
from viewer.panel.pages import folder_name
from viewer.pictures.film import to_pixels
from viewer.render.engine import ViewEngine
from viewer.state import history
from viewer.state.transient import StartFile
from viewer.state.view_state import Comparison, ViewState
from viewer.state.workspace import Store, start_tour, with_transient

POLL_S = 0.5
EXAMPLES = Path(__file__).parents[2] / "examples"
EXAMPLE_TITLES = {
    EXAMPLES / f"{name}{BUNDLE}": about
    for name, about in {
        "bear": ("Four looks of a bear", "Scarf, gold, frost; a panda from one picture"),
        "room": ("A room at dusk", "To stand in: rug, walls, the light"),
        "play": ("Shapes, and a film", "Head, twin, no scarf; Space plays"),
    }.items()
}
"""Examples that come with the program, with title and content."""


class StartActions:
    """Recent files with thumbnails, and the demo, whose edits appear one by one.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        edits: adds the edits of the demo as layers
        open_file: opens a file according to its content
        context: the GL context
        queue: runs the demo's command
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        edits: EditActions,
        open_file: Callable[[Path], None],
        context: moderngl.Context,
        queue: JobQueue,
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._edits = edits
        self._open_file = open_file
        self._context = context
        self._queue = queue
        self._textures: dict[Path, moderngl.Texture | None] = {}
        self._examples = (state_folder() / "examples").resolve()  # copies of the examples
        self._demo: Path | None = None  # its folder while it is being made
        self._added: dict[Path, tuple[Path, int]] = {}  # per edit folder: the open file and its time in ns

    @property
    def requests(self) -> Requests:
        """Handlers for the demo, for a bundle of the examples, and to forget a file."""
        return {"demo": self._start_demo, "example": self._open_example, "forget_file": self._forget}

    def _forget(self, path: str) -> None:
        recent = user_files.forget_recent(Path(path))
        self._store.replace(with_transient(self._store.get(), recent=recent))

    def poll(self) -> float | None:
        """Open the finished parts of the demo; return the seconds until the next poll, None for never."""
        self._publish()
        self._offer_tour()
        if self._demo is None:
            return None
        scene = self._demo / "scene.ply"
        opened = self._documents.get().path
        if opened is not None and opened.resolve() != scene:
            self._demo = None  # the user has opened another scene
            return None
        if opened is None and scene.is_file():
            self._open_file(scene)
            work = self._store.get()
            view = replace(work.view, background=SKY)
            self._store.replace(replace(work, view=view, past=history.begin(view)))
        folders = sorted(file.parent for file in self._demo.glob("*/*.gdf") if self._documents.get().path)
        for folder in dict.fromkeys(folders):
            attempt(self._messages, partial(self._show_edit, folder))
        if not self._queue.busy(Delivery):
            self._demo = None
        return POLL_S

    def keep_picture(self, engine: ViewEngine, view: ViewState, *paths: Path | None) -> None:
        """Save a thumbnail of the current view for these files on the start page."""
        files = [path for path in paths if path is not None]
        if not files:
            return
        try:
            thumbnail_view = ViewState(
                view.camera, view.layers, view.blend, view.background, compare=Comparison()
            )
            pixels = to_pixels(engine.image(thumbnail_view, user_files.THUMBNAIL_SIZE))
        except ProgdfError:
            return
        for path in files:
            user_files.keep_thumbnail(path, pixels)

    def close(self) -> None:
        """Release the textures."""
        for texture in self._textures.values():
            if texture is not None:
                texture.release()
        self._textures.clear()

    def _start_demo(self, _: None) -> None:
        folder = (state_folder() / "demo").resolve()
        self._demo = folder
        self._added = {}
        words = ("demo", "--quick", "--no-window", f"--out={folder}")
        log = self._queue.folder / "demo.log"
        self._queue.add(Delivery("Demo: four edits", folder, words, log, folder / "scene.ply"))
        self._messages.show("Making the demo's scene …")

    def _show_edit(self, folder: Path) -> None:
        """Show an edit of the demo: its draft first, then the finished file."""
        draft = folder / "draft.gdf"
        result = folder / f"{folder.name}.gdf"
        path = result if result.is_file() else draft
        old_version = self._added.get(folder)
        version = path, path.stat().st_mtime_ns
        if version != old_version:
            self._added[folder] = version
            if old_version is None or not self._edits.finish(old_version[0], path):
                self._edits.add(path, folder.name)

    def _open_example(self, bundle: str) -> None:
        """Copy the bundle into the program's state folder and open the copy, so that the user can save it."""
        folder = self._examples / sha256(Path(bundle))[:8]
        make_folder(folder)
        copy = folder / Path(bundle).name
        if not copy.exists():
            write_file(copy, read_file(Path(bundle)))
        self._open_file(copy)

    def _offer_tour(self) -> None:
        """Start the tour in an example, unless the user has finished or skipped it before."""
        work = self._store.get()
        path = self._documents.get().path
        if work.layout.toured or work.transient.tour is not None or path is None:
            return
        if path.is_relative_to(self._examples):
            self._store.replace(start_tour(work))
            self._store.wake()

    def _publish(self) -> None:
        """Update the files of the start page while it is open."""
        if not self._documents.get().is_empty:
            return
        recent = []
        for path in user_files.read_recent(missing=True):
            used = user_files.thumbnail_time(path)
            missing = not path.is_file()
            age = user_files.describe_age(time.time() - used) if used else ""
            line = "  ·  ".join(filter(None, ("Moved?" if missing else age, folder_name(path))))
            recent.append(StartFile(path, self._texture(path), line=line, missing=missing))
        examples = [StartFile(path, self._texture(path), *about) for path, about in EXAMPLE_TITLES.items()]
        work = self._store.get()
        updated = with_transient(work, start_files=tuple(recent), examples=tuple(examples))
        if updated != work:
            self._store.replace(updated)
            self._store.wake()

    def _texture(self, path: Path) -> int:
        if path not in self._textures:
            if path.parent == EXAMPLES:
                pixels = user_files.read_thumbnail(path.with_name(path.name.replace(BUNDLE, ".jpg")))
            else:
                pixels = user_files.load_thumbnail(path)
            self._textures[path] = picture_texture(self._context, pixels) if pixels is not None else None
        texture = self._textures[path]
        return int(texture.glo) if texture is not None else 0
