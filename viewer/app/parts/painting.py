"""Paint of the color brush: it becomes a layer, and stays on screen until the layer is ready."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from progdf.errors import ProgdfError
from progdf.io.picture_camera import PictureLayers
from viewer.app.messages import Messages, Requests
from viewer.camera.view_camera import to_camera
from viewer.files import exports
from viewer.files.document import DocumentStore
from viewer.files.scenes import OwnScene
from viewer.files.session import WindowSession, visible_only
from viewer.jobs import training
from viewer.jobs.job_queue import JobQueue
from viewer.jobs.training import EditOrder
from viewer.render.paint_overlay import pixels_of
from viewer.state.forms import ALL, NewEdit
from viewer.state.transient import PendingPaint
from viewer.state.view_state import PaintedPicture
from viewer.state.workspace import Store, with_transient

_NAME = "paint"
POLL_S = 0.25
"""Seconds between looks at the runs of unfinished paint."""


class PaintingActions:
    """Layers from paint. `poll` it after the jobs.

    Args:
        store: state of the window
        documents: the open document
        messages: messages to the user
        queue: the jobs
    """

    def __init__(
        self, *, store: Store, documents: DocumentStore, messages: Messages, queue: JobQueue
    ) -> None:
        self._store = store
        self._documents = documents
        self._messages = messages
        self._queue = queue
        # paint in training with the file of its scene, which need not be open, see `poll`
        self._pending: list[tuple[Path | None, PendingPaint]] = []

    @property
    def requests(self) -> Requests:
        """Handlers of the requests about paint, by name."""
        return {"finish_paint": lambda _: self._finish()}

    def _finish(self) -> None:
        """Queue a run that lays the paint on the surface, above the visible layers.

        Raises:
            ProgdfError: nothing is painted, a visible layer has no file, or the pictures cannot be written.
        """
        work = self._store.get()
        painted = work.view.painted
        if not painted:
            raise ProgdfError("nothing is painted; paint on the scene with the color brush first")
        own = self._documents.get().only_scene()
        scene = own.path
        out = training.free_run(training.edits_folder(scene), replace(NewEdit(), name=_NAME).layer_name)
        shown = visible_only(WindowSession(self._documents.get(), work.view))
        layers = exports.picture_layers(shown.document, shown.view)
        files = self._write(painted, layers, out, own)
        order = EditOrder(
            scene.resolve(),
            out,
            out.name,
            region=ALL,
            editor=f"paint:{','.join(map(str, files))}",
            quick=False,
            threads=training.spare_threads(),
        )
        self._queue.add(order)
        view = replace(work.view, painted=(), color_brush=replace(work.view.color_brush, tool=""))
        paint = PendingPaint(out, painted)
        self._pending.append((self._documents.get().path, paint))
        self._store.replace(with_transient(work, pending=(*work.transient.pending, paint)))
        self._store.change(view)
        self._messages.show(f"Making “{out.name}”; the paint stays on screen until its layer is ready")

    def _write(
        self, painted: Sequence[PaintedPicture], layers: PictureLayers | None, out: Path, own: OwnScene
    ) -> list[Path]:
        """Write paint with transparency beside a run, and its cameras and layers; return the paths."""
        origin = own.file.gaussians.origin
        files = [out.with_name(f"{out.name}.view-{i + 1}.png").resolve() for i in range(len(painted))]
        if len(files) > 1 and any("," in str(path) for path in files):
            raise ProgdfError(
                f"{out.parent} has a comma in its name, which separates pictures; rename the folder"
            )
        for path, picture in zip(files, painted, strict=True):
            camera = own.camera(to_camera(picture.camera, *picture.size))
            exports.painted_picture(path, pixels_of(picture), camera, origin, layers)
        return files

    def poll(self) -> float | None:
        """Remove paint whose layer is ready, and return paint whose run has failed or was discarded.

        Paint of a scene that is not open is kept until that scene is opened.
        """
        if not self._pending:
            return None
        scene = self._documents.get().path
        status = {job.task.out: job.status for job in self._queue.jobs}
        left = list[tuple[Path | None, PendingPaint]]()
        for its_scene, paint in self._pending:
            now = status.get(paint.out)
            if now is None and not _is_trained(paint.out):
                now = "failed"
            if now == "failed" and its_scene == scene:
                self._put_back(paint)
            elif now not in (None, "done"):
                left.append((its_scene, paint))
        self._pending = left
        shown = tuple(paint for its_scene, paint in left if its_scene == scene)
        if shown != self._store.get().transient.pending:
            self._store.replace(with_transient(self._store.get(), pending=shown))
            self._store.wake()
        return POLL_S if left else None

    def _put_back(self, paint: PendingPaint) -> None:
        """Return paint to the brush, unless something else was painted meanwhile."""
        view = self._store.get().view
        if not view.painted:
            self._store.change(replace(view, painted=paint.painted))


def _is_trained(out: Path) -> bool:
    return (out / f"{out.name}.gdf").is_file()
