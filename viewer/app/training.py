"""Training in the window: the form queues a run, cards show all jobs, the result becomes a layer."""

from __future__ import annotations

import time
import webbrowser
import zlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write, make_folder, read_file, write_file
from progdf.io.cameras import save_cameras
from progdf.io.picture_camera import camera_chunk
from progdf.scene.regions import check_region
from progdf.terminal import format_duration
from viewer.app.application import Application, Requests, attempt, failure_line
from viewer.app.file_actions import EditActions
from viewer.files import exports
from viewer.jobs import training
from viewer.jobs.job_queue import Delivery, JobQueue, QueuedTask
from viewer.jobs.training import EditOrder
from viewer.state.commands import Plain
from viewer.state.forms import ALL, CHANGED, SELECTION, TYPED, NewEdit
from viewer.state.selection import EMPTY_MASK, SUFFIX, NamedRegion, add_region, free_name
from viewer.state.view_state import LayerState
from viewer.state.workspace import Dialog, JobCard, with_transient

LIVE_EVERY_S = 3.0
"""Minimum interval between the recordings shown during a run, in seconds."""
LIVE_SHARE = 0.05
"""Maximum share of the window's time spent on showing recordings."""


def is_newer(file: Path, other: Path) -> bool:
    """Return whether both files exist and the first is newer."""
    try:
        return file.stat().st_mtime_ns > other.stat().st_mtime_ns
    except OSError:
        return False


_REGION_KINDS = ("masks", "photomasks", "text", "changed")
"""Kinds of regions, besides those that every command supports."""


def job_card(job: QueuedTask) -> JobCard:
    """Return a job as the panel shows it."""
    task = job.task
    training = ""
    starting = "Starting"
    if isinstance(task, EditOrder):
        training = f"{task.editor} on {task.region}"
        if task.region == CHANGED:
            starting = "Finding the changes"
    return JobCard(
        job.number,
        task.name,
        task.out,
        job.status,
        training,
        job.progress.label or starting,
        job.progress.share,
        job.progress.loss,
        seconds_left=job.seconds_left,
        error=job.error,
        warning=job.warning,
    )


class JobActions:
    """Training of the form's edit, and the state of all jobs. `close` it with the window.

    Args:
        app: the window
        draft: returns the file of a grade that previews the form
        anchor: returns the picture of one view that the form's sentence should follow
        follow: opens that picture's file in another program and shows the saved result
    """

    def __init__(
        self,
        app: Application,
        draft: Callable[[NewEdit], Path | None] = lambda _: None,
        anchor: Callable[[NewEdit], tuple[NDArray[np.uint8], Camera] | None] = lambda _: None,
        follow: Callable[[Path], None] = lambda _: None,
    ) -> None:
        self._app = app
        self._store = app.store
        self._draft = draft
        self._anchor = anchor
        self._follow = follow
        self._edits = EditActions(app)
        self.queue = JobQueue()
        self._scene: Path | None = None
        self._followed = False  # the scene's stopped runs are in the queue
        self._live: Path | None = None  # the recording on screen
        self._live_layers: tuple[LayerState, ...] = ()  # its layers
        self._live_due = 0.0
        self._quits: type | None = None  # quit once no task of this class is busy

    @property
    def requests(self) -> Requests:
        """Handlers of the requests of the form and the cards. Requests of a card name a job by its number."""
        queue = self.queue
        return {
            "train": self._train,
            "paint_over": self._paint_over,
            "lay_decal": self._lay_decal,
            "stop_run": queue.stop,
            "resume_run": queue.resume,
            "ask_discard": self._ask_discard,
            "discard_run": queue.discard,
            "close_run": queue.dismiss,
            "show_file": lambda number: webbrowser.open(queue.job(number).task.out.parent.as_uri()),
            "copy_path": lambda number: imgui.set_clipboard_text(str(queue.job(number).task.out)),
            "run_log": self._show_log,
            "stop_and_quit": lambda _: self._quit(EditOrder),
            "drop_and_quit": lambda _: self._quit(Delivery),
        }

    def holds_window(self) -> bool:
        """Return whether a job runs; if so, ask the user what to do before the window closes."""
        job = None if self._quits else self.queue.busy(EditOrder) or self.queue.busy()
        if job is not None:
            kind = "training" if isinstance(job.task, EditOrder) else "delivery"
            self._app.main_view.ask(Dialog(kind, job.task.name))
        return job is not None

    def _quit(self, kind: type) -> None:
        """Stop all jobs of this class, and close the window once they have ended."""
        self._quits = kind
        for job in self.queue.jobs:
            if isinstance(job.task, kind):
                self.queue.stop(job.number)
        if kind is EditOrder:
            self._app.main_view.show_message("Saving the training state …")

    def _show_log(self, number: int) -> None:
        self._app.main_view.ask(Dialog("log", str(self.queue.job(number).task.log)))

    def poll(self) -> float | None:
        """Poll the jobs; return the seconds until the next poll, None for never."""
        self._follow_document()
        for job in self.queue.poll():
            self._end(job)
        self._show_live(time.monotonic())
        self._publish()
        if self._quits is not None and not self.queue.busy(self._quits):
            self._quits = None
            self._app.main_view.request(Plain("quit"))
        return self.queue.next_poll()

    def close(self) -> None:
        """Stop the running jobs."""
        self.queue.close()

    def _train(self, _: None) -> None:
        """Queue the form's edit; an error stays in the form."""
        main_view = self._app.main_view
        form = self._store.get().form
        error = form.obstacle or failure_line(lambda: self._enqueue(form))
        form = replace(form, error=error) if error else replace(form, error="", name="")
        self._store.replace(replace(self._store.get(), form=form, form_open=bool(error)))
        main_view.wake()

    def _enqueue(self, form: NewEdit) -> None:
        scene = self._app.document.file
        out = training.free_run(training.edits_folder(scene), form.layer_name)
        region = self.region_spec(form, out.parent, out.name)
        threads = training.spare_threads()
        model = anchor = ""
        if form.choice.setting == "sentence":
            model = form.model
            anchor = self._write_anchor(form, out)
        order = EditOrder(
            scene.resolve(),
            out,
            out.name,
            region=region,
            editor=form.spec,
            quick=form.quick,
            threads=threads,
            model=model,
            anchor=anchor,
        )
        self.queue.add(order)
        if (draft := self._draft(form)) is not None:
            attempt(self._app.main_view, partial(self._add_draft, order, draft, form.strength))
        if form.region == SELECTION:  # its selection becomes a region: the highlight would hide the edit
            main_view = self._app.main_view
            view = self._store.get().view
            name = free_name(view.selection, out.name)
            path = out.with_name(f"{out.name}{SUFFIX}")
            selection = replace(add_region(view.selection, name, path), members=EMPTY_MASK, count=0)
            main_view.change(replace(view, selection=selection))

    def _lay_decal(self, _: None) -> None:
        """Queue the placed decal with its camera and its position in the picture."""
        main_view = self._app.main_view
        scene = self._app.document.path
        placed = main_view.decal_place
        self._store.replace(with_transient(self._store.get(), gizmo=None))
        if placed is None or scene is None:
            return
        path, camera, at = placed
        name = replace(NewEdit(), name=path.stem).layer_name
        out = training.free_run(training.edits_folder(scene), name)
        make_folder(out.parent)
        camera_file = out.with_name(f"{out.name}.camera.json")
        save_cameras(camera_file, [camera], self._app.document.scene.origin)
        order = EditOrder(
            scene.resolve(),
            out,
            out.name,
            region=ALL,
            editor=f"decal:{path.resolve()}",
            quick=False,
            threads=training.spare_threads(),
            at=at,
            camera=str(camera_file),
        )
        self.queue.add(order)

    def _add_draft(self, order: EditOrder, draft: Path, strength: float = 1.0) -> None:
        """Add a grade as the layer that the trained edit replaces later.

        Raises:
            ProgdfError: its file cannot be written or read.
        """
        write_file(order.draft, read_file(draft))
        self._edits.add(order.draft, order.name, strength)

    def _take_packed(self, order: EditOrder, packed: Path) -> None:
        """Replace the draft's layer by the trained edit, whose evaluation is still running."""
        write_file(order.packed_edit, read_file(packed))
        self._edits.finish(order.draft, order.packed_edit)

    def _write_anchor(self, form: NewEdit, run: Path) -> str:
        """Return the file of the picture that a sentence should follow, saved beside its run; "" for none.

        Raises:
            ProgdfError: it cannot be written.
        """
        taken = None if form.anchor else self._anchor(form)
        if taken is None:
            return form.anchor
        make_folder(run.parent)
        path = run.with_name(f"{run.name}.anchor.png")
        chunk = camera_chunk(taken[1], origin=self._app.document.scene.origin)
        with atomic_write(path) as temporary_file:
            Image.fromarray(taken[0]).save(temporary_file, "PNG", pnginfo=chunk)
        return str(path)

    def _paint_over(self, _: None) -> None:
        """Save the picture for editing in another program, and follow that file from now on."""
        scene = self._app.document.file
        form = self._store.get().form
        run = training.free_run(training.edits_folder(scene), form.layer_name)
        if path := self._write_anchor(form, run):
            self._store.replace(replace(self._store.get(), form=replace(form, anchor=path)))
            self._follow(Path(path))

    def region_spec(self, form: NewEdit, folder: Path, name: str = "") -> str:
        """Return the form's region as a value of `progdf train --region`; write a file into the folder if
        needed.

        Without a name, a hash of the region names the file, so that a reader can reuse what it has loaded.

        Raises:
            ProgdfError: it cannot be read or written.
        """
        if form.region in (ALL, CHANGED):
            return form.region
        if form.region == TYPED:
            spec = form.typed_region.strip()
            check_region(spec, {kind: lambda _: None for kind in _REGION_KINDS})
            return spec
        selection = self._store.get().view.selection
        total = len(self._app.document.original)
        region = {region.name: region for region in selection.regions}.get(form.region)
        if form.region != SELECTION and region is None:
            raise ProgdfError(f"the region {form.region} was deleted; choose another one")
        members = selection.members if region is None else region.members
        make_folder(folder)
        path = folder / f"{name or f'{zlib.crc32(members):08x}'}{SUFFIX}"
        exports.write_region(NamedRegion(name, path, members, selection.count), total)
        return f"file:{path}"

    def _ask_discard(self, number: int) -> None:
        """Ask before discarding a run that has begun; discard a waiting one directly."""
        job = self.queue.job(number)
        if job.task.is_begun:
            spent = job.task.read_progress(job.progress).seconds
            self._app.main_view.ask(Dialog("discard_run", format_duration(spent), item=number))
        else:
            self.queue.discard(job.number)

    def _end(self, job: QueuedTask) -> None:
        """Handle the end of a job: add or replace the layer, or show a message."""
        task = job.task
        main_view = self._app.main_view
        if job.status == "done" and not job.warning and isinstance(task, EditOrder):
            self.queue.dismiss(job.number)
        # with the panel, its card shows the error
        if job.status == "failed" and not self._store.get().view.panel:
            main_view.show_message(f"{task.name}: {job.error}", error=True)
        if isinstance(task, Delivery):
            if job.status == "done" and task.words[0] == "rebind":
                self.queue.dismiss(job.number)
                self._app.open(task.out)
            elif job.status == "done":
                main_view.show_message(f"Wrote {task.out}")
            return
        if job.status == "done" and self._scene == task.scene:  # the result replaces the recordings
            self._live = None
            if not any(self._edits.finish(path, task.result) for path in (task.draft, task.packed_edit)):
                self._app.open(task.result)
            main_view.show_message(f"{task.name} is ready")
            return
        if self._live is not None:
            self._live = None
            self._app.show(self._app.document)
        if job.status == "done":
            main_view.show_message(f"{task.name} is ready: {task.result}")

    def leave_scene(self) -> None:
        """Reset the state of the old scene. Its runs continue, and their cards name that scene."""
        self._followed = False
        self._live = None

    def _follow_document(self) -> None:
        """Add the scene's stopped runs of earlier sessions to the queue."""
        if self._followed:
            return
        path = self._app.document.path
        self._followed, self._scene = True, path.resolve() if path is not None else None
        if (scene := self._scene) is not None:
            for draft in dict.fromkeys(self._app.document.gdf_paths):
                if (result := training.finished_edit(draft)) is not None:
                    attempt(self._app.main_view, partial(self._edits.finish, draft, result))
            for order in training.stopped_orders(training.edits_folder(scene), scene):
                self.queue.add_stopped(order)

    def _show_live(self, now: float) -> None:
        """Show the newest recording of the run, within the time budget `LIVE_SHARE`."""
        orders = (job.task for job in self.queue.jobs if job.status == "running")
        order = next((task for task in orders if isinstance(task, EditOrder)), None)
        if order is None or order.scene != self._scene or now < self._live_due:
            return
        live = self._store.get().transient.live
        packed = order.out / "draft.gdf"
        layers = {order.draft, order.packed_edit}.intersection(self._app.document.gdf_paths)
        if order.draft in layers and is_newer(packed, order.draft):
            attempt(self._app.main_view, partial(self._take_packed, order, packed))
        if layers or (live and live != self._live_layers):
            return  # the edit has a layer already, or the form's preview is shown
        if packed.is_file() and not order.draft.exists():
            attempt(self._app.main_view, partial(self._add_draft, order, packed))
            return
        recording = order.newest_recording()
        if recording is None or recording == self._live:
            return
        begun = time.monotonic()
        document = self._app.document
        if (edit := order.recorded_edit(recording, document.original)) is not None:
            layer = LayerState(len(document.gdfs), f"{edit.name} (training)", 1.0)
            self._app.show(document, (edit,), (layer,))
            self._live = recording
            self._live_layers = (layer,)
        cost = time.monotonic() - begun
        self._live_due = now + max(LIVE_EVERY_S, cost / LIVE_SHARE)

    def _publish(self) -> None:
        """Publish the jobs of this scene and the busy jobs of others to the panel."""
        jobs = tuple(
            replace(job_card(job), elsewhere="" if job.task.scene == self._scene else job.task.scene.name)
            for job in self.queue.jobs
            if job.task.scene == self._scene or job.busy
        )
        if jobs != self._store.get().jobs:
            self._store.replace(replace(self._store.get(), jobs=jobs))
            self._app.main_view.wake()
