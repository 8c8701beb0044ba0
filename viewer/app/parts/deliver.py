"""Exports, pictures and films: the dialog for the output path, and the command that writes the file."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

from progdf import __version__
from progdf.errors import ProgdfError
from progdf.formats.scene_file import WRITTEN_SUFFIXES
from progdf.io.bundle import BUNDLE
from viewer.app.messages import Messages, Requests, failure_line
from viewer.files import exports, session
from viewer.files.document import DocumentStore
from viewer.files.user_files import parse_path
from viewer.jobs.job_queue import Delivery, JobQueue
from viewer.jobs.training import free_path
from viewer.state import timeline
from viewer.state.forms import ALL_SLIDERS, TURNTABLE, DeliverOptions, picture_size
from viewer.state.view_state import Comparison, ViewState
from viewer.state.workspace import Dialog, Store

SUFFIXES = {"export": ".ply", "export_page": ".html", "render_picture": ".png", "render_film": ".mp4"}
"""Suffix of the output file, per dialog."""
NOUNS = {"export": "Scene", "export_page": "Web page", "render_picture": "Picture", "render_film": "Film"}
"""First word of a job's name, per dialog; it fits a running and a finished job."""


class DeliverActions:
    """Dialogs for exports, pictures and films, and their commands.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        queue: runs the commands
    """

    def __init__(
        self, *, store: Store, documents: DocumentStore, messages: Messages, queue: JobQueue
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._queue = queue
        self._options: dict[str, DeliverOptions] = {}  # the last options of each dialog, preset in the next

    @property
    def requests(self) -> Requests:
        """Handlers for the dialogs of `SUFFIXES`, for their output, and for rebinding an edit."""
        ask, version = self._messages.ask, sys.version.split()[0]
        return {
            **{name: partial(self._ask, name) for name in SUFFIXES},
            "deliver": self._deliver,
            "rebind": lambda edit: ask(Dialog("rebind", file=edit)),
            "rebind_from": lambda action: self._rebind(action.edit, action.scene),
            "about": lambda _: ask(Dialog("about", f"ProGDF Studio {__version__}, Python {version}")),
        }

    def _deliver(self, kind: str) -> None:
        """Queue the delivery; an error stays in the dialog."""
        if (dialog := self._store.get().dialog) is not None:
            error = failure_line(lambda: self._start(kind, dialog))
            after = replace(dialog, error=error) if error else None
            self._store.replace(replace(self._store.get(), dialog=after))
            self._store.wake()

    def _ask(self, name: str, _: None) -> None:
        path = self._documents.get().file
        view = self._store.get().view
        focus = self._store.get().focus
        options = self._options.get(name, DeliverOptions())
        if name == "render_film":
            keys = ("timeline",) if len(view.timeline.keys) > 1 else ()
            sliders = [layer.name for layer in reversed(view.layers)]
            if len(view.layers) > 1:
                sliders.append(ALL_SLIDERS)
            moving = (*keys, *sliders, TURNTABLE)
            moves = moving[0] if keys or focus is None or not view.layers else view.layers[focus].name
            options = self._options.get(name, DeliverOptions(width=1280, height=720))
            fps = view.timeline.fps if keys else options.fps
            options = replace(options, moves=moves, can_move=moving, fps=fps)
        if view.safe_frame:
            width, height = picture_size(min(options.width, options.height), view.safe_frame)
            options = replace(options, width=width, height=height)
        suffix = options.format if name == "render_film" else SUFFIXES[name]
        folder = exports.folder_of(path)
        written = self._written()
        free = free_path(folder, f"{path.stem}_edited", suffix, lambda out: out.exists() or out in written)
        self._messages.ask(Dialog(name, str(free), options=options))

    def _rebind(self, file: str, source: str) -> None:
        """Queue a rebind of an edit from the scene at `source` to the open scene."""
        edit = Path(file)
        scene = self._documents.get().file.resolve()
        out = free_path(edit.parent, f"{edit.stem}-rebound", edit.suffix)
        words = ("rebind", str(edit), f"--from={parse_path(source)}", f"--to={scene}", f"--out={out}")
        log = self._queue.folder / f"rebind{len(list(self._queue.folder.iterdir()))}.log"
        self._queue.add(Delivery(f"Rebound {edit.name}", out, words, log, scene))

    def _start(self, kind: str, dialog: Dialog) -> None:
        out = parse_path(dialog.text).resolve()
        options = dialog.options or DeliverOptions()
        suffix = options.format if kind == "render_film" else SUFFIXES[kind]
        named = kind == "export" and out.name.lower().endswith((*WRITTEN_SUFFIXES, BUNDLE))
        if suffix and not named and out.suffix.lower() != suffix:
            out = out.with_name(out.name + suffix)
        if not out.parent.is_dir():
            raise ProgdfError(f"the folder {out.parent} does not exist; create it first")
        if out in self._written():
            raise ProgdfError(f"{out.name} is being written already; choose another name")
        exists = f"{out.name} exists; give another name, or press again to replace it"
        if out.exists() and dialog.error != exists:
            raise ProgdfError(exists)
        document = self._documents.get()
        view = replace(self._store.get().view, compare=Comparison())
        if kind == "render_film" and options.moves != "timeline":
            view = _film(view, options)
        elif kind == "render_film":
            view = replace(view, timeline=replace(view.timeline, fps=options.fps))
        number = len(list(self._queue.folder.iterdir()))
        stack = self._queue.folder / f"stack{number}.session.json"
        session.save(stack, session.WindowSession(document, view, self._store.get().snapshots))
        size = f"--size={options.width}x{options.height}"
        background = ["--alpha"] if options.alpha else []
        words = {
            "export": ["export", f"--out={out}"],
            "export_page": ["export", f"--out={out}", f"--title={Path(document.title).stem}"],
            "render_picture": ["render", f"--out={out}", size, *background],
            "render_film": ["render", f"--out={out}", size, "--timeline"],
        }[kind]
        title = f"{NOUNS[kind]} {out.name}"
        self._queue.add(
            Delivery(title, out, (*words, str(stack)), stack.with_suffix(".log"), document.file.resolve())
        )
        self._options[kind] = options

    def _written(self) -> set[Path]:
        """Return the output paths of the busy jobs."""
        return {job.task.out for job in self._queue.jobs if job.busy}


def _film(view: ViewState, options: DeliverOptions) -> ViewState:
    """Return the view with a timeline that moves sliders from 0 to 1 and back, or orbits the camera once."""
    if options.moves == TURNTABLE:
        return replace(view, timeline=timeline.turntable(view.camera, options.fps, options.seconds))
    gdfs = [layer.gdf for layer in view.layers if options.moves in (layer.name, ALL_SLIDERS)]
    return replace(view, timeline=timeline.slider_film(view, gdfs, options.fps, options.seconds))
