"""Training in the window: the form queues a run, cards show all jobs, the result becomes a layer."""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gdf.file import load_gdf, save_gdf
from progdf.io.atomic import read_file, write_file
from progdf.terminal import format_duration
from progdf.tidy import leave_paint
from viewer.app.decal import DecalPlace
from viewer.app.messages import Messages, Requests, attempt, failure_line
from viewer.app.parts.edits import EditActions
from viewer.files import exports, region_files, user_files
from viewer.files.document import DocumentStore
from viewer.files.scenes import OwnScene
from viewer.jobs import consent, training
from viewer.jobs.job_queue import Delivery, JobQueue, QueuedTask, job_card
from viewer.jobs.training import EditOrder
from viewer.state.commands import OnItem, Plain
from viewer.state.forms import ALL, SELECTION, NewEdit, without_values
from viewer.state.selection import (
    SUFFIX,
    NamedRegion,
    add_region,
    equal_region,
    free_name,
    pack,
    select_none,
)
from viewer.state.transient import DecalGhost
from viewer.state.view_state import LayerState
from viewer.state.workspace import Dialog, Store, with_transient

LIVE_EVERY_S = 3.0
"""Minimum interval between the recordings shown during a run, in seconds."""
LIVE_SHARE = 0.05
"""Maximum share of the window's time spent on showing recordings."""


class JobActions:
    """Training of the form's edit, and the state of all jobs. `close` it with the window.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        edits: adds drafts and results as layers
        open_file: opens a file according to its content
        decal_place: returns the decal being placed with camera and position, see `MainView.decal_place`
        draft: returns the file of a grade that previews the form
        anchor: returns the picture of one view that the form's sentence should follow
        follow: opens that picture's file in another program and shows the saved result
        leave_ghost: keeps the preview on screen until the edit of a run has a layer
        look_behind: turns the view to the camera of a picture and shows it there
    """

    def __init__(
        self,
        *,
        store: Store,
        documents: DocumentStore,
        messages: Messages,
        edits: EditActions,
        open_file: Callable[[Path], None],
        decal_place: Callable[[], DecalPlace | None],
        draft: Callable[[NewEdit], Path | None] = lambda _: None,
        anchor: Callable[[NewEdit], tuple[NDArray[np.uint8], Camera] | None] = lambda _: None,
        follow: Callable[[Path], None] = lambda _: None,
        leave_ghost: Callable[[Path], None] = lambda _: None,
        look_behind: Callable[[Path], None] = lambda _: None,
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._edits = edits
        self._open_file = open_file
        self._decal_place = decal_place
        self._draft = draft
        self._anchor = anchor
        self._follow = follow
        self._leave_ghost = leave_ghost
        self._look_behind = look_behind
        self.queue = JobQueue()
        self._scenes: tuple[Path, ...] = ()  # the open scenes; their stopped runs are in the queue
        self._live: Path | None = None  # the recording on screen
        self._live_layers: tuple[LayerState, ...] = ()  # its layers
        self._live_due = 0.0
        self._taken: set[int] = set()  # jobs whose trained edit has been taken over
        self._discarded: set[int] = set()  # jobs to discard once they have stopped
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
            "resume_run": self._resume,
            "allow_outside": self._allow,
            "keep_run": self._keep_run,
            "ask_discard": self._ask_discard,
            "discard_run": queue.discard,
            "close_run": queue.dismiss,
            "carry_on": self._carry_on,
            "fill_hole": self._fill_hole,
            "look_behind": self._show_behind,
            "show_file": lambda number: webbrowser.open(queue.job(number).task.out.parent.as_uri()),
            "copy_path": lambda number: imgui.set_clipboard_text(str(queue.job(number).task.out)),
            "run_log": self._show_log,
            "stop_and_quit": lambda _: self._quit(EditOrder),
            "drop_and_quit": lambda _: self._quit(Delivery),
        }

    def _resume(self, number: int) -> None:
        """Resume a stopped run; ask first if it would run a program or send pictures.

        Raises:
            ProgdfError: it cannot be resumed.
        """
        task = self.queue.job(number).task
        if isinstance(task, EditOrder):
            action = consent.outside_action(task.editor, task.api_url)
            if not consent.is_allowed(action):
                self._messages.ask(Dialog("allow", action, then=OnItem("resume_run", number)))
                return
        self.queue.resume(number)

    def _allow(self, action: str) -> None:
        """Remember that the user allows an action.

        Raises:
            ProgdfError: the user's folder cannot be written.
        """
        consent.allow(action)

    def holds_window(self) -> bool:
        """Return whether a job runs; if so, ask the user what to do before the window closes.

        The report of a written edit does not count: it stops, and its card offers to resume it next time.
        """
        busy = [job for job in self.queue.jobs if job.busy and not self._only_reports(job)]
        trainings = [job for job in busy if isinstance(job.task, EditOrder)]
        job = None if self._quits else next(iter(trainings + busy), None)
        if job is not None:
            kind = "training" if isinstance(job.task, EditOrder) else "delivery"
            self._messages.ask(Dialog(kind, job.task.title))
        return job is not None

    def _only_reports(self, job: QueuedTask) -> bool:
        """Return whether a job's edit is written and only its report is left."""
        return isinstance(job.task, EditOrder) and job.status != "queued" and job.task.is_delivered

    def _quit(self, kind: type) -> None:
        """Stop all jobs of this class, and close the window once they have ended."""
        self._quits = kind
        for job in self.queue.jobs:
            if isinstance(job.task, kind):
                self.queue.stop(job.number)
        if kind is EditOrder:
            self._messages.show("Saving the training state …")

    def _carry_on(self, number: int) -> None:
        """Queue a finished run again, continued over the parts that its picture does not show.

        The result replaces the layer of the first run.
        """
        task = self.queue.job(number).task
        if isinstance(task, EditOrder):
            out = training.free_run(task.out.parent, f"{task.name} all around")
            replaced = str(task.result)
            self.queue.add(replace(task, out=out, name=out.name, carry_on="always", replaces=replaced))
            self.queue.dismiss(number)

    def _fill_hole(self, index: int) -> None:
        """Toggle the fill of a removal's hole: fill it, stop the filling, or take the fill away.

        The removal stays unfilled until the filled one replaces it.

        Raises:
            ProgdfError: a file is missing or cannot be written.
        """
        document = self._documents.get()
        layer = self._store.get().view.layers[self._edits.layer(index)]
        gdf_index = layer.gdf
        path = document.gdf_paths[gdf_index] if gdf_index < len(document.gdf_paths) else None
        if path is None:
            raise ProgdfError("this removal has no file; remove the selection again")
        for job in self.queue.jobs:
            if (
                job.busy
                and isinstance(job.task, EditOrder)
                and job.task.fills
                and job.task.replaces == str(path)
            ):
                self._discarded.add(job.number)
                self.queue.stop(job.number)
                return
        gdf = document.edits[gdf_index]
        if "removal" in gdf.report:
            unfilled = training.unfilled_edit(path)
            if unfilled is None:
                raise ProgdfError(
                    "the removal without the fill has no file; undo, or remove the selection again"
                )
            self._edits.replace_file(path, unfilled)
            return
        out = training.filled_run(path)
        mask = gdf.region.mask.numpy()
        members = NamedRegion(out.name, out.with_name(f"{out.name}{SUFFIX}"), pack(mask), len(gdf.region))
        region_files.write_region(members, len(document.original))
        order = EditOrder(
            document.own_scene(document.owner(gdf_index)).path.resolve(),
            out,
            out.name,
            region=f"file:{members.path}",
            editor="remove",
            quick=False,
            threads=training.spare_threads(),
            replaces=str(path),
            hole_of=layer.name,
        )
        self.queue.add(order)

    def _show_behind(self, number: int) -> None:
        """Show the picture of the continued edit from behind.

        Raises:
            ProgdfError: it cannot be read.
        """
        task = self.queue.job(number).task
        if isinstance(task, EditOrder):
            self._look_behind(task.behind)

    def _show_log(self, number: int) -> None:
        self._messages.ask(Dialog("log", str(self.queue.job(number).task.log)))

    def poll(self) -> float | None:
        """Poll the jobs; return the seconds until the next poll, None for never."""
        self._follow_document()
        for job in self.queue.poll():
            self._end(job)
        for job in self.queue.jobs:
            if job.status == "running" and isinstance(job.task, EditOrder) and job.task.is_delivered:
                attempt(self._messages, partial(self._take, job.number, job.task))
        self._show_live(time.monotonic())
        self._publish()
        if self._quits is not None and not self.queue.busy(self._quits):
            self._quits = None
            self._messages.request(Plain("quit"))
        return self.queue.next_poll()

    def close(self) -> None:
        """Stop the running jobs."""
        self.queue.close()

    def _train(self, _: None) -> None:
        """Queue the form's edit; an error stays in the form."""
        form = self._store.get().form
        action = consent.outside_action(form.spec, form.url)
        if not form.obstacle and not consent.is_allowed(action):
            self._messages.ask(Dialog("allow", action, then=Plain("train")))
            return
        error = form.obstacle or failure_line(lambda: self._enqueue(form))
        form = replace(form, error=error) if error else without_values(form)
        self._store.replace(replace(self._store.get(), form=form, form_open=bool(error)))
        self._store.wake()

    def _enqueue(self, form: NewEdit) -> None:
        document = self._documents.get()
        state = self._store.get().view.selection
        own = region_files.own_scene(form, document, state)
        out = training.free_run(training.edits_folder(own.path), form.layer_name)
        state = own.selection(state, len(document.original))
        region = region_files.region_option(form, out.parent, state, own.count, out.name)
        anchor = ""
        if form.choice.has_anchor and form.choice.setting != "program":
            anchor = self._write_anchor(form, out, own)
        if form.choice.is_outside:
            user_files.keep_outside(form.outside)
        order = EditOrder(
            own.path.resolve(),
            out,
            out.name,
            region=region,
            editor=form.spec,
            quick=form.quick,
            threads=training.spare_threads(),
            model=form.model_option,
            api_url=form.url,
            prompt=form.prompt,
            anchor=anchor,
        )
        self.queue.add(order)
        if (draft := self._draft(form)) is not None:
            attempt(self._messages, partial(self._add_draft, order, draft, form.strength))
        else:
            self._leave_ghost(out)
        if form.region == SELECTION:  # its selection becomes a region: the highlight would hide the edit
            view = self._store.get().view
            selection = view.selection
            if equal_region(selection, selection.members, len(document.scene)) is None:
                name = free_name(selection, out.name)
                path = out.with_name(f"{out.name}{SUFFIX}")
                selection = add_region(selection, name, path, edit=out.name)
            self._store.change(replace(view, selection=select_none(selection)))

    def _lay_decal(self, _: None) -> None:
        """Queue the placed decal with its camera and its position in the picture."""
        own = self._documents.get().only_scene()
        placed = self._decal_place()
        self._store.replace(with_transient(self._store.get(), gizmo=None))
        if placed is None:
            return
        decal, camera, at = placed
        name = replace(NewEdit(), name=decal.path.stem).layer_name
        out = training.free_run(training.edits_folder(own.path), name)
        camera_file = exports.single_camera(out, own.camera(camera), own.file.gaussians.origin)
        order = EditOrder(
            own.path.resolve(),
            out,
            out.name,
            region=ALL,
            editor=f"decal:{decal.path.resolve()}",
            quick=False,
            threads=training.spare_threads(),
            at=at,
            camera=str(camera_file),
        )
        self.queue.add(order)
        if decal.mesh is not None:
            ghost = DecalGhost(out, decal.texture, decal.mesh)
            ghosts = (*self._store.get().transient.ghosts, ghost)
            self._store.replace(with_transient(self._store.get(), ghosts=ghosts))

    def _add_draft(self, order: EditOrder, draft: Path, strength: float = 1.0) -> None:
        """Add a grade as the layer that the trained edit replaces later.

        Raises:
            ProgdfError: its file cannot be written or read.
        """
        write_file(order.draft, read_file(draft))
        self._edits.add(order.draft, order.name, strength)

    def _write_anchor(self, form: NewEdit, run: Path, own: OwnScene) -> str:
        """Return the file of the picture that a sentence should follow, saved beside its run; "" for none.

        Raises:
            ProgdfError: it cannot be written.
        """
        taken = None if form.anchor else self._anchor(form)
        if taken is None:
            return form.anchor
        path = run.with_name(f"{run.name}.anchor.png")
        pixels, camera = taken
        exports.painted_picture(path, pixels, own.camera(camera), own.file.gaussians.origin)
        return str(path)

    def _paint_over(self, _: None) -> None:
        """Save the picture for editing in another program, and follow that file from now on."""
        form = self._store.get().form
        own = region_files.own_scene(form, self._documents.get(), self._store.get().view.selection)
        run = training.free_run(training.edits_folder(own.path), form.layer_name)
        if path := self._write_anchor(form, run, own):
            self._store.replace(replace(self._store.get(), form=replace(form, anchor=path)))
            self._follow(Path(path))

    def _ask_discard(self, number: int) -> None:
        """Ask before discarding a run that has begun; discard a waiting one directly."""
        job = self.queue.job(number)
        if job.task.is_begun:
            spent = job.task.read_progress(job.progress).seconds
            self._messages.ask(Dialog("discard_run", format_duration(spent), item=number))
        else:
            self.queue.discard(job.number)

    def _keep_run(self, number: int) -> None:
        """Make a layer of the newest recording of a stopped run. A resumed run replaces it by its result.

        Raises:
            ProgdfError: no recording is readable, or the layer's file cannot be written.
        """
        order = self.queue.job(number).task
        if not isinstance(order, EditOrder):
            return
        recording = order.newest_recording()
        edit = None
        if recording is not None and order.is_keepable:
            edit = order.recorded_edit(recording, self._documents.get().file_at(order.scene).gaussians)
        if edit is None:
            raise ProgdfError(f"{order.name} has no recording that is not a layer yet; resume it")
        save_gdf(order.kept_edit, edit)
        if not self._edits.finish(order.kept_edit, order.kept_edit):
            self._edits.add(order.kept_edit, order.name)

    def _end(self, job: QueuedTask) -> None:
        """Handle the end of a job: add or replace the layer, or show a message."""
        task = job.task
        if job.number in self._discarded and job.status == "stopped":
            self._discarded.discard(job.number)
            if any(listed.number == job.number for listed in self.queue.jobs):
                self.queue.discard(job.number)
            return
        if job.status == "done" and not (job.warning or job.offer) and isinstance(task, EditOrder):
            self.queue.dismiss(job.number)
        # with the panel, its card shows the error
        if job.status == "failed" and not self._store.get().view.panel:
            self._messages.show(f"{task.title}: {job.error}", error=True)
        if isinstance(task, Delivery):
            if job.status == "done" and task.words[0] == "rebind":
                self.queue.dismiss(job.number)
                self._open_file(task.out)
            elif job.status == "done":
                self._messages.show(f"Wrote {task.out}")
            return
        if job.status == "done":
            self._take(job.number, task)
        elif self._live is not None:
            self._live = None
            self._documents.replace(self._documents.get())

    def _take(self, number: int, task: EditOrder) -> None:
        """Add a trained edit as a layer, or replace the layer of its draft, once per job."""
        if number in self._taken:
            return
        self._taken.add(number)
        if task.fills:
            self._take_fill(task)
        elif task.scene in self._scenes:  # the result replaces the recordings
            self._live = None
            if not self._take_result(task):
                self._open_file(task.result)
            summary = "" if task.warning() else task.summary()  # its card shows the warning
            self._messages.show(
                f"“{task.name}” is ready. {summary}" if summary else f"“{task.name}” is ready"
            )
        else:
            self._messages.show(f"“{task.name}” is ready: {task.result}")

    def _take_fill(self, task: EditOrder) -> None:
        """Replace a removal by the filled one, if it is still a layer.

        The filled one leaves paint where the removal did.
        """
        document = self._documents.get()
        removal = document.edit_of(Path(task.replaces)) if task.scene in self._scenes else None
        if removal is not None and removal.anchors is not None and removal.anchors.leaves_paint:
            filled = load_gdf(task.result, document.file_at(task.scene).gaussians)
            save_gdf(task.result, leave_paint(filled))
        if task.scene in self._scenes and self._edits.replace_file(Path(task.replaces), task.result):
            self._messages.show(f"The hole of “{task.hole_of}” is filled")
        else:
            self._messages.show(f"The hole of “{task.hole_of}” is filled: {task.result}")

    def _take_result(self, task: EditOrder) -> bool:
        """Replace the layer of a draft, or of the run that is continued; return True if there is one."""
        if task.replaces and self._edits.replace_file(Path(task.replaces), task.result):
            return True
        return any(self._edits.finish(path, task.result) for path in task.drafts)

    def leave_scene(self) -> None:
        """Reset the state of the old scene. Its runs continue, and their cards name that scene."""
        self._scenes = ()
        self._live = None

    def _follow_document(self) -> None:
        """Add the stopped runs of earlier sessions to the queue when scenes were opened."""
        files = self._documents.get().scene_files
        if len(files) == len(self._scenes):
            return
        known = self._scenes
        self._scenes = tuple(file.path.resolve() if file.path else Path() for file in files)
        for draft in dict.fromkeys(self._documents.get().gdf_paths):
            if (result := training.finished_edit(draft)) is not None:
                attempt(self._messages, partial(self._edits.finish, draft, result))
        for scene in {*self._scenes} - {*known, Path()}:
            for order in training.stopped_orders(training.edits_folder(scene), scene):
                self.queue.add_stopped(order)

    def _show_live(self, now: float) -> None:
        """Show the newest recording of the run, within the time budget `LIVE_SHARE`."""
        running = (job for job in self.queue.jobs if job.status == "running")
        orders = (job.task for job in running if job.number not in self._taken)
        order = next((task for task in orders if isinstance(task, EditOrder)), None)
        if order is None or order.scene not in self._scenes or now < self._live_due or order.replaces:
            return
        live = self._store.get().transient.live
        grade = order.out / "draft.gdf"
        layers = set(order.drafts).intersection(self._documents.get().gdf_paths)
        if layers or (live and live != self._live_layers):
            return  # the edit has a layer already, or the form's preview is shown
        if grade.is_file() and not order.draft.exists():
            attempt(self._messages, partial(self._add_draft, order, grade))
            return
        recording = order.newest_recording()
        if recording is None or recording == self._live or order.paints_over_layers:
            return
        begun = time.monotonic()
        document = self._documents.get()
        if (edit := order.recorded_edit(recording, document.file_at(order.scene).gaussians)) is not None:
            edit = document.place(edit, document.scene_at(order.scene))
            layer = LayerState(len(document.gdfs), f"{edit.name} (training)", 1.0)
            self._documents.replace(document, (edit,), (layer,))
            self._live = recording
            self._live_layers = (layer,)
        cost = time.monotonic() - begun
        self._live_due = now + max(LIVE_EVERY_S, cost / LIVE_SHARE)

    def _filled_edit(self, task: EditOrder | Delivery) -> int | None:
        """Return the index of the removal whose hole a task fills; None for other tasks."""
        if not isinstance(task, EditOrder) or not task.fills:
            return None
        view = self._store.get().view
        paths = self._documents.get().gdf_paths
        used = (layer.gdf for layer in view.layers if layer.gdf < len(paths))
        return next((gdf for gdf in used if str(paths[gdf]) == task.replaces), None)

    def _publish(self) -> None:
        """Publish the jobs of this scene and the busy jobs of others to the panel."""
        jobs = tuple(
            replace(job_card(job), fills=self._filled_edit(job.task))
            if job.task.scene in self._scenes
            else replace(job_card(job), elsewhere=job.task.scene.name, keepable=False)
            for job in self.queue.jobs
            if job.task.scene in self._scenes or job.busy
        )
        if jobs != self._store.get().jobs:
            self._store.replace(replace(self._store.get(), jobs=jobs))
            self._store.wake()
        layers = set(self._documents.get().gdf_paths)
        runs = [job.task for job in self.queue.jobs if job.busy and job.task.scene in self._scenes]
        orders = [run for run in runs if isinstance(run, EditOrder) and not run.is_delivered]
        waiting = {run.out for run in orders if layers.isdisjoint(run.drafts)}
        ghosts = self._store.get().transient.ghosts
        kept = tuple(ghost for ghost in ghosts if ghost.run in waiting)
        if kept != ghosts:
            self._store.replace(with_transient(self._store.get(), ghosts=kept))
