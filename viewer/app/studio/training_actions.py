"""New edits in the window: the form starts a run, its card follows it, the finished edit becomes a layer."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf
from progdf.io.atomic import make_folder
from progdf.scene.regions import check_region
from viewer.app.application import Application, failure_line
from viewer.files import regions
from viewer.files.document import Document
from viewer.jobs import run_files
from viewer.jobs.new_edit import ALL, CHANGED, SELECTION, TYPED, NewEdit
from viewer.jobs.training_job import EditOrder, TrainingJob, duration
from viewer.jobs.training_queue import TrainingQueue, spare_threads
from viewer.state.selection import NOBODY, SUFFIX, NamedRegion, add_region, free_name
from viewer.state.view_state import LayerState
from viewer.state.workspace import Dialog

LIVE_EVERY_S = 3.0
"""Between two recordings that are shown while a run trains."""
LIVE_SHARE = 0.05
"""Of the window's time, at most, that showing them may take."""

_KINDS = ("masks", "photomasks", "text", "changed")
"""Of regions, besides those that every command knows."""


class StudioApplication(Application, Protocol):
    """What new edits need of the application."""

    def open(self, path: Path) -> None:
        """A file, by what it is."""

    def show(
        self, document: Document, live: tuple[Gdf, ...] = (), layers: tuple[LayerState, ...] = ()
    ) -> None:
        """Draw another document from now on, with what is being trained on top."""


class TrainingActions:
    """Trains what the form asks for. `close` it with the window.

    Args:
        app: the window
        memory: folder of the program's state; the user's own if None
    """

    def __init__(self, app: StudioApplication, memory: Path | None = None) -> None:
        self._app, self._memory = app, memory
        self.queue = TrainingQueue()
        self._looked = False  # for what was stopped of the scene
        self._scene: Path | None = None
        self._live: Path | None = None  # the recording on screen
        self._live_due = 0.0
        self._leaves = False

    def handle(self, request: str) -> bool:
        """Do what is asked for; False where it is nothing of ours."""
        name, _, argument = request.partition(":")
        match name:
            case "train":
                self._train()
            case "stop_run":
                self.queue.stop(int(argument))
            case "resume_run":
                self._try(lambda: self.queue.resume(int(argument)))
            case "ask_discard":
                self._ask_discard(int(argument))
            case "discard_run":
                self._try(lambda: self.queue.discard(int(argument)))
            case "close_run":
                self.queue.dismiss(int(argument))
            case "run_log":
                self._show_log(int(argument))
            case "quit" if self.queue.busy and not self._leaves:
                self._app.main_view.ask(Dialog("training", self._running_name()))
            case "stop_and_quit":
                self._stop_and_quit()
            case _:
                return False
        self._publish()
        return True

    def poll(self) -> float | None:
        """Look at the runs; seconds until the next look, None for ever."""
        self._follow_document()
        for job in self.queue.poll():
            self._ended(job)
        self._show_live(time.monotonic())
        self._publish()
        if self._leaves and not self.queue.busy:
            self._leaves = False
            self._app.main_view.request("quit")
        return self.queue.next_poll()

    def close(self) -> None:
        """Stop what is trained."""
        self.queue.close()

    def _train(self) -> None:
        """What the form asks for goes into the queue; what is wrong stands in the form."""
        main_view = self._app.main_view
        form = main_view.work.form
        error = form.obstacle or failure_line(lambda: self._enqueue(form))
        form = replace(form, error=error) if error else replace(form, error="", name="")
        main_view.work = replace(main_view.work, form=form, form_open=bool(error))
        main_view.wake()

    def _enqueue(self, form: NewEdit) -> None:
        scene = self._app.document.path
        if scene is None:
            raise ProgdfError("the scene has no file yet; open one first")
        folder = run_files.edits_folder(scene, self._memory)
        out = run_files.free_run(folder, form.layer_name)
        region = self.region_spec(form, out.parent, out.name)
        order = EditOrder(scene.resolve(), out, out.name, region, form.spec, form.quick, spare_threads())
        self.queue.add(order)
        if form.region == SELECTION:
            self._keep_selection(out)

    def _keep_selection(self, out: Path) -> None:
        """The selection becomes a region of its own, so that its tint does not hide what is trained."""
        main_view = self._app.main_view
        view = main_view.work.view
        name = free_name(view.selection, out.name)
        kept = add_region(view.selection, name, out.with_name(f"{out.name}{SUFFIX}"))
        main_view.change(replace(view, selection=replace(kept, members=NOBODY, count=0)))

    def region_spec(self, form: NewEdit, folder: Path, name: str) -> str:
        """The form's region as `progdf train --region` has it; one that has no file gets one in the folder.

        Raises:
            ProgdfError: it cannot be read or written.
        """
        if form.region in (ALL, CHANGED):
            return form.region
        if form.region == TYPED:
            spec = form.typed_region.strip()
            check_region(spec, {kind: lambda _: None for kind in _KINDS})
            return spec
        selection, total = self._app.main_view.work.view.selection, len(self._app.document.scene)
        kept = {region.name: region for region in selection.regions}.get(form.region)
        if form.region != SELECTION and kept is None:
            raise ProgdfError(f"there is no region {form.region} any more; choose another one")
        members = selection.members if kept is None else kept.members
        make_folder(folder)
        path = folder / f"{name}{SUFFIX}"
        regions.write(NamedRegion(name, path, members, selection.count), total)
        return f"file:{path}"

    def _try(self, act: Callable[[], None]) -> None:
        """Do it, or say why it cannot be done."""
        if error := failure_line(act):
            self._app.main_view.show_message(error, error=True)

    def _ask_discard(self, number: int) -> None:
        """What was trained cannot be brought back: ask. What has not begun is no loss."""
        job = self.queue.job(number)
        if job is not None and run_files.is_begun(job.order.out):
            spent = run_files.read_progress(job.order, job.progress).seconds
            self._app.main_view.ask(Dialog("discard_run", duration(spent), str(number)))
        else:
            self._try(lambda: self.queue.discard(number))

    def _ended(self, job: TrainingJob) -> None:
        """A run is over: its edit comes on top, or its card says why not."""
        comes = job.status == "done" and self._scene == job.order.scene
        if not comes:  # else it takes the place of what is shown
            self._take_live_away()
        main_view = self._app.main_view
        if job.status == "failed":
            main_view.show_message(f"{job.order.name} was not trained: {job.error}", error=True)
        if job.status == "elsewhere" and job.order.gdf.is_file():
            main_view.show_message(f"{job.order.name} was trained in another window: {job.order.gdf}")
        if job.status != "done":
            return
        if not job.warning:
            self.queue.dismiss(job.number)
        if comes:
            self._live = None
            self._app.open(job.order.gdf)
            main_view.show_message(f"{job.order.name} is trained; drag its slider")
        else:
            main_view.show_message(f"{job.order.name} is trained: {job.order.gdf}")

    def leave_scene(self) -> None:
        """There is another scene; what is trained for this one goes on, and its card says for which."""
        self._looked, self._live = False, None

    def _follow_document(self) -> None:
        """Runs of the scene that were stopped another day come back."""
        if self._looked:
            return
        path = self._app.document.path
        self._looked, self._scene = True, path.resolve() if path is not None else None
        if (scene := self._scene) is not None:
            for order in run_files.stopped_orders(run_files.edits_folder(scene, self._memory), scene):
                self.queue.add_stopped(order)

    def _show_live(self, now: float) -> None:
        """The newest recording of the run, as far as showing it costs next to nothing."""
        job = next((job for job in self.queue.jobs if job.status == "running"), None)
        if job is None or job.order.scene != self._scene or now < self._live_due:
            return
        recording = run_files.newest_recording(job.order)
        if recording is None or recording == self._live:
            return
        begun = time.monotonic()
        edit = run_files.recorded_edit(job.order, recording, self._app.document.scene)
        if edit is not None:
            document = self._app.document
            layer = LayerState(len(document.gdfs), f"{edit.name} (training)", 1.0)
            self._app.show(document, (edit,), (layer,))
            self._live = recording
        cost = time.monotonic() - begun
        self._live_due = now + max(LIVE_EVERY_S, cost / LIVE_SHARE)

    def _take_live_away(self) -> None:
        if self._live is not None:
            self._live = None
            self._app.show(self._app.document)

    def _show_log(self, number: int) -> None:
        job = self.queue.job(number)
        if job is not None:
            self._app.main_view.ask(Dialog("log", str(run_files.log_of(job.order))))

    def _running_name(self) -> str:
        return next((job.order.name for job in self.queue.jobs if job.status == "running"), "")

    def _stop_and_quit(self) -> None:
        """Leave once what runs has saved what it has done; what waits is forgotten."""
        self._leaves = True
        for job in self.queue.jobs:
            self.queue.stop(job.number)
        self._app.main_view.show_message("Saving what is trained so far …")

    def _publish(self) -> None:
        """The panel shows the runs of this scene, and of others those that go on."""
        main_view = self._app.main_view
        jobs = tuple(
            job if job.order.scene == self._scene else replace(job, elsewhere=job.order.scene.name)
            for job in self.queue.jobs
            if job.order.scene == self._scene or job.status in ("queued", "running", "stopping")
        )
        if jobs != main_view.work.jobs:
            main_view.work = replace(main_view.work, jobs=jobs)
            main_view.wake()
