"""Edited views of a run: made on demand, saved to disk, and read again when the run resumes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import write_image
from progdf.threads import threads
from trainer.editors import editor_row
from trainer.editors.base import ImageEditor, confines_edit, editor_strengths
from trainer.editors.call_pool import CallPool
from trainer.editors.procedural import edit_course
from trainer.fit.slider_uniformity import equalized_strengths
from trainer.optimize.retime import resolve_slider
from trainer.options import OptimizeOptions, TrainOptions
from trainer.regions.from_pictures import CHANGED
from trainer.store.progress import LATER, Advance, RunLog
from trainer.store.run_folder import (
    LazySequence,
    RunFolder,
    add_pictures,
    from_bytes,
    quantize_image,
    read_views,
    to_bytes,
)
from trainer.store.state import Saved
from trainer.views.boxes import Pictures
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

from .agree import make_run_editor
from .kinds import Approach, choose_approach, resolve_approach
from .training import StrengthSource

_MAX_CACHED_PIXELS = 1_000_000  # pixels and painted members whose editor state is cached, up to 80 bytes each


class EditedViews:
    """Edited views of a run by strength, and the approach that they are trained with.

    Args:
        options: resolved options
        setup: scene, region and original views
        folder: folder of the run, which keeps the pictures and the state
        log: log of the run
    """

    def __init__(self, options: TrainOptions, setup: TrainingSetup, folder: RunFolder, log: RunLog) -> None:
        self.approach = Approach("color")
        self.trial: dict[str, Any] | None = None  # figures of the trial run that chose the approach
        self._options = options
        self._setup = setup
        self._folder = folder
        self._log = log
        self._pictures: dict[float, Sequence[Tensor]] = {}  # strength -> pictures, read lazily from disk
        # names of the views that are edited at strengths other than 1
        self._on_the_way = [view.camera.name for view in setup.views]
        self._known: list[float] = []  # strengths edited by the stopped run
        self._courses: dict[View, Callable[[float], Tensor]] = {}  # the editor's state of each view

    @property
    def pictures(self) -> Pictures:
        """The edited views by strength."""
        return self._pictures

    @property
    def editor(self) -> ImageEditor:
        """The run's editor, made on first use."""
        return self._editor_and_figures[0]

    @cached_property
    def _editor_and_figures(self) -> tuple[ImageEditor, Mapping[str, object]]:
        return make_run_editor(self._options, self._setup, self._folder, self._log)

    @property
    def optimization(self) -> OptimizeOptions:
        """The optimization options of the approach, fully resolved."""
        return resolve_approach(self._options, self.approach)

    @property
    def requests_strengths(self) -> bool:
        """True if training requests further strengths once the error of the first ones is known."""
        row = editor_row(self._options.editor)
        is_fixed = self._options.optimize.stages or row.external or row.slow_strengths
        return self.optimization.solver == "colors" and not is_fixed

    @property
    def source(self) -> StrengthSource | None:
        """Source of further strengths; None if training requests none."""
        return StrengthSource(self._edit, self._look) if self.requests_strengths else None

    def prepare(self) -> None:
        """Read the edited views of a stopped run, or choose the approach and edit the views.

        Raises:
            ProgdfError: a picture is invalid, or the edit changes no view.
        """
        saved = self._folder.state.load("edited")
        if saved is None or not self._read(saved):
            self._begin()

    def _read(self, saved: Saved) -> bool:
        """Read the edited views of the saved state; return False if they must be edited again."""
        values = saved.values
        views = self._setup.views
        names = [view.camera.name for view in views]
        try:
            self._on_the_way = values["on_the_way"]
            for s in values["strengths"]:
                wanted = set(names if s == 1.0 else self._on_the_way)
                cameras = [view.camera for view in views if view.camera.name in wanted]
                self._pictures[s] = read_views(self._folder, "edited", cameras, s)
            self.approach = Approach(values["kind"], values["group_steps"], values["grow"])
            self.trial = values["trial"]
            self._log.say("the edited views are on disk")
            self._log.expect(expected_work(self._setup, self.optimization, len(self._pictures)))
            return True
        except ProgdfError as error:
            self._pictures.clear()
            self._known = values["strengths"]
            self._log.say(f"the views are edited again: {str(error).partition(';')[0]}")
            return False

    def _begin(self) -> None:
        """Choose the approach and edit the views at the first strengths."""
        spec = self._options.editor.editor
        views = self._setup.views
        editor = self.editor
        row = editor_row(self._options.editor)
        note = row.note(self._options.editor.text)
        if note:
            self._log.say(note)
        if row.runs_program:
            self._call_ahead(views)
        self.approach, self.trial = choose_approach(self._options, self._setup, editor, self._log)
        optimization = self.optimization
        strengths = editor_strengths(editor, optimization.stages)
        self._log.expect(expected_work(self._setup, optimization, len(strengths)))
        if self.requests_strengths:
            strengths = (1.0,)
        elif resolve_slider(optimization.slider, strengths) == "even":
            strengths = equalized_strengths(editor, spec, views, strengths)
        self._edit(strengths, views)
        _check_change(self._pictures, self._setup, spec)
        if row.sends_pictures or row.runs_program:
            self._log.say(_strength_line(editor, self._pictures, views[0]))
        rest = [s for s in self._known if s not in self._pictures]
        if rest:
            self._edit(rest, [view for view in views if view.camera.name in self._on_the_way])

    def _call_ahead(self, views: Sequence[View]) -> None:
        """Let the editor's program make the finished edit of all views in parallel; its cache keeps them."""
        editor = self.editor
        with (
            self._log.steps("edit", len(views)) as advance,
            CallPool(self._options.editor.edit_workers, editor) as pool,
        ):
            edited = pool.map(lambda view: editor.edit(view, 1.0), views)
            for count, _ in enumerate(edited, 1):
                advance(count, "strength 1")

    def _edit(self, strengths: Sequence[float], views: Sequence[View]) -> Pictures:
        """Edit views at new strengths, save them, and return all edited views."""
        editor = self.editor
        row = editor_row(self._options.editor)
        new = [s for s in strengths if s not in self._pictures]
        is_confined = confines_edit(editor, self.approach.kind)
        course = self._course if self._fits_cache() else partial(edit_course, editor)
        with self._log.steps("edit", len(views) * len(new)) as advance:
            within = views
            if self._options.region.region == CHANGED:  # few members are found for paint finer than Gaussians
                within = [view.with_painted([editor.edit(view, 1.0)]) for view in views]
            workers = threads() if row.is_parallel else 0
            if row.runs_program or row.sends_pictures:
                workers = self._options.editor.edit_workers
            edited = edit_views(workers, within, new, self._folder, is_confined, advance, course, editor)
            self._pictures.update(edited)
        listed = ", ".join(f"{s:g}" for s in strengths)
        self._log.say(f"{self._options.editor.editor}: a {self.approach.kind} edit at strength {listed}")
        if min(strengths) < 1.0:
            self._on_the_way = [view.camera.name for view in views]
        self._save()
        return self._pictures

    def _save(self) -> None:
        """Save the strengths, the approach and its figures."""
        values = {
            "strengths": [*dict.fromkeys((*self._known, *self._pictures))],
            "on_the_way": self._on_the_way,
            **asdict(self.approach),
            "trial": self.trial,
            "shared": dict(self._editor_and_figures[1]),
        }
        self._folder.state.save("edited", {}, values)

    def _look(self, strength: float, views: Sequence[View]) -> list[Tensor]:
        """Edit views in memory only."""
        pictures = [self._course(view)(strength) for view in views]
        if confines_edit(self.editor, self.approach.kind):
            pictures = [view.confine(picture) for view, picture in zip(views, pictures, strict=True)]
        return [quantize_image(picture) for picture in pictures]

    def _course(self, view: View) -> Callable[[float], Tensor]:
        """Return a function from strength to edited view, and keep its state."""
        if view not in self._courses:
            self._courses[view] = edit_course(self.editor, view)
        return self._courses[view]

    def _fits_cache(self) -> bool:
        """Return True if the strength-independent editor state of all views fits the cache."""
        paints_members = editor_row(self._options.editor).paints_members
        painted = len(self._setup.region) if paints_members else 0
        counts = [int((view.mask > 0.0).sum()) + painted for view in self._setup.views]
        return sum(counts) <= _MAX_CACHED_PIXELS


def edit_views(
    workers: int,
    views: Sequence[View],
    strengths: Sequence[float],
    folder: RunFolder,
    is_confined: bool,
    advance: Advance,
    course: Callable[[View], Callable[[float], Tensor]],
    editor: object = None,
) -> dict[float, Sequence[Tensor]]:
    """Edit every view at every strength. Training uses the 8-bit pictures saved to disk.

    Args:
        workers: number of views that are edited at the same time, each at all strengths; 0: one picture after
            another, strength by strength
        views: all views
        strengths: requested strengths
        folder: folder of the pictures
        is_confined: revert changes outside the region; otherwise members would move to reproduce them
        advance: reports progress
        course: returns a view's function from strength to edited view, see `edit_course`
        editor: the editor, which is stopped if the edit fails or is interrupted
    """

    def edit(request: Sequence[tuple[float, int]]) -> list[Tensor]:
        made = []
        for strength, i in request:
            whole = course(views[i])(strength)
            made.append(to_bytes(views[i].confine(whole) if is_confined else whole))
            write_image(folder.view("edited", views[i].camera.name, strength), from_bytes(made[-1]))
        return made

    add_pictures(folder.views, [folder.view("edited", v.camera.name, s) for s in strengths for v in views])
    edited: dict[float, list[Tensor]] = {strength: [] for strength in strengths}
    groups = [strengths] if workers and strengths else [[strength] for strength in strengths]
    requests = [[(strength, i) for strength in group] for group in groups for i in range(len(views))]
    with CallPool(workers or 1, editor) as pool:
        made = pool.map(edit, requests) if workers else map(edit, requests)
        for request, pictures in zip(requests, made, strict=True):
            for (strength, _), picture in zip(request, pictures, strict=True):
                edited[strength].append(picture)
            advance(sum(map(len, edited.values())), f"strength {request[-1][0]:g}")
    return {strength: LazySequence(pictures, from_bytes) for strength, pictures in edited.items()}


def _strength_line(editor: ImageEditor, edited: Pictures, view: View) -> str:
    """Return where the strengths come from and how even their visible steps are, for the log.

    Args:
        editor: the editor
        edited: strength → edited views
        view: the first view, in which the steps are measured
    """
    strengths = sorted(edited)
    if strengths == [1.0]:
        return "strengths: the editor makes the finished edit only; the trainer finds the way to it"
    pictures = [view.image, *(edited[s][0] for s in strengths)]
    steps = [float((b - a).abs().mean()) for a, b in pairwise(pictures)]
    even = max(sum(steps) / len(steps), 1e-9)
    source = "the prompts of --degrees" if editor.stages else "the editor's own control"
    return (
        f"strengths: {source}; visible steps are {min(steps) / even:.2f} to {max(steps) / even:.2f} "
        "of an even step"
    )


def _check_change(edited: Pictures, setup: TrainingSetup, spec: str) -> None:
    """Raise a ProgdfError if no view shows an edit."""
    originals = [quantize_image(view.image) for view in setup.views]
    pairs = (pair for views in edited.values() for pair in zip(views, originals, strict=True))
    if all(picture.equal(original) for picture, original in pairs):
        raise ProgdfError(f"{spec} changes none of the views; check the region and the editor's settings")


def expected_work(setup: TrainingSetup, optimization: OptimizeOptions, strengths: int) -> dict[str, float]:
    """Return the expected work per stage for `RunLog.expect`, in units of preparing one view.

    Args:
        setup: scene, region, views
        optimization: fully resolved options
        strengths: number of edited strengths
    """
    views = len(setup.views)
    train = len(setup.train)
    work = {name: each * views for name, each in LATER.items()}
    work["views"] = views
    work["edit"] = 0.1 * views * strengths
    if optimization.solver == "colors":
        work["weights"] = 0.5 * train
        work["model"] = 1.5 * train
        work["optimize"] = 0.45 * train * strengths
        return work
    group_steps = optimization.group_steps or 0
    work["move parts"] = 0.2 * group_steps * strengths
    work["optimize"] = 0.25 * optimization.steps
    return work
