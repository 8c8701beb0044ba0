"""The command `python -m benchmarks regret SCENE REGION EDITOR`: possible gains of a color edit in quality or
time.

The views, strengths, steps and SH functions that a run chooses automatically are compared with a sweep of all
of them. Every field is measured in views and at strengths that are not used for training or choice.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
import tyro
from torch import Tensor

from progdf.field.grade import band_offsets
from progdf.field.trajectory import Trajectory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians, pack
from progdf.metrics.image import LEVEL, decibels
from progdf.region import Region
from progdf.scene.regions import parse_region
from progdf.terminal import print_line
from trainer.editors import make_editor
from trainer.editors.base import ImageEditor
from trainer.editors.procedural import edit_course
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import visibility
from trainer.fit.grades import fit_grades
from trainer.fit.slider_uniformity import equalized_strengths
from trainer.optimize.color_course import STEPS as TAKEN
from trainer.optimize.color_course import solve
from trainer.optimize.color_model import Model
from trainer.optimize.color_solver import iterations, make_solver
from trainer.optimize.color_views import add_bands, color_views
from trainer.optimize.pgs import ParameterSnapshot, PgsState
from trainer.optimize.retime import smooth_course
from trainer.options import EditorOptions, FieldOptions, OptimizeOptions, TrainingViewOptions
from trainer.resolve import prepare_process
from trainer.run.training import StrengthSource, plan_colors
from trainer.store.progress import RunLog
from trainer.store.run_folder import quantize_image
from trainer.views.boxes import Pictures, widen_views
from trainer.views.choose import choose_views, split_held_out
from trainer.views.crops import CropScene, crop_scene
from trainer.views.setup import TrainingSetup, make_training_setup, render_thumbnails
from trainer.views.view import View, crop, name_cameras, region_rig, with_near_plane

from ..table import Table

MEASURED = (0.12, 0.38, 0.64, 0.88, 1.0)
"""Strengths at which fields are compared with the editor's pictures."""
STAGES = (8, 4, 2)  # swept numbers of evenly spaced strengths
STEPS = (5, 12, 24)  # swept steps of conjugate gradients per strength, without early stopping
BANDS = (0, 1, 4, 9)  # swept numbers of SH functions of the residual
VIEWS = (20, 30, 60)  # swept numbers of views, with the best SH functions of the run's own views
REPORTING = 13
"""Number of rig cameras for the evaluation; the first is skipped, and none is a training camera."""
NEAR = 0.3
"""dB within which a cheaper field counts as equal."""

NOTE = (
    f"dB against the editor's pictures at strength {', '.join(f'{s:g}' for s in MEASURED)}, in "
    f"{REPORTING - 1} rig views not used for training or choice, over the pixels that show the region. "
    "Mean: average of the PSNR at 1 and the mean PSNR at the other strengths, each limited to 48.1 dB, the "
    "PSNR of one 8-bit level. Seconds: "
    "processor time on one thread, for the pictures, their weights, the model, the solution and the choice "
    "of the field. The sweep solves each strength once, starting from the solution of the full edit; smaller "
    "numbers of strengths are subsets."
)


@dataclass(frozen=True)
class RegretOptions:
    """Sweep the effort of a color edit and compare it with the automatic choice."""

    scene: tyro.conf.Positional[Path]
    """The scene."""
    region: tyro.conf.Positional[str]
    """Region, as for progdf train --region."""
    editor: tyro.conf.Positional[str]
    """A color editor that supports any strength."""


@dataclass(frozen=True)
class Result:
    """Figures of the edit with one set of options."""

    name: str
    psnrs: Sequence[float]  # at `MEASURED`, dB
    seconds: float  # processor time
    bytes: float  # of the field, per Gaussian

    @property
    def mean(self) -> float:
        """Average of the PSNR at 1 and the mean PSNR at the other strengths, each at most 48.1 dB."""
        *between, end = (min(psnr, decibels(LEVEL)) for psnr in self.psnrs)
        return (end + sum(between) / len(between)) / 2

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of its row in the table."""
        psnrs = " ".join(f"{psnr:.1f}" for psnr in self.psnrs)
        return self.name, psnrs, f"{self.mean:.2f}", f"{self.seconds:.1f}", f"{self.bytes:.0f}"


@dataclass
class RegretEdit:
    """An edit from one set of views, with cached pictures and solutions."""

    scene: Gaussians
    region: Region
    editor: str
    painter: ImageEditor  # shared by all sets of views, so that its color of the region is the same
    setup: TrainingSetup
    seconds: float = 0.0  # processor time of the work shared by all options
    pictures: dict[float, list[Tensor]] = field(default_factory=dict)  # of all views, by strength
    courses: list[Callable[[float], Tensor]] = field(default_factory=list)  # strength -> picture, per view
    a_strength: float = 0.0  # processor time of all views' pictures at one strength

    def __post_init__(self) -> None:
        self.original = pack(self.scene[self.region.members], with_shN=self.scene.sh_degree > 0)
        finished = self.picture(1.0)[: len(self.setup.train)]
        self.setup = widen_views(self.setup, {1.0: finished})
        began = time.process_time()
        self.drawn = color_views(self._crops(self.setup.train), self.original)
        self.seconds += time.process_time() - began
        self.choosing = split_held_out(self.setup.held_out)[0]
        self.weights = visibility(self.scene, self.region.members, self.setup.train)
        self.solved: dict[tuple[int, int, float, int], tuple[Tensor, Tensor, float]] = {}

    def strengths(self, count: int) -> tuple[float, ...]:
        """Return `count` strengths with equal visible changes between them."""
        plain = tuple((i + 1) / count for i in range(count))
        return equalized_strengths(self.painter, self.editor, self.setup.views, plain)

    def picture(self, s: float) -> list[Tensor]:
        """Return the edited pictures of all views at a strength, quantized to 8 bits."""
        if s not in self.pictures:
            began = time.process_time()
            self.courses = self.courses or [edit_course(self.painter, view) for view in self.setup.views]
            self.pictures[s] = [quantize_image(edit(s)) for edit in self.courses]
            self.a_strength = time.process_time() - began
        return self.pictures[s]

    def targets(self, s: float) -> list[Tensor]:
        """Return the edited boxes of the training views at a strength."""
        pairs = zip(self.picture(s), self.setup.train, strict=False)
        return [crop(picture, view.box) for picture, view in pairs]

    def aside(self, s: float) -> list[Tensor]:
        """Return the edited pictures, not cropped, of the views on which the field is chosen."""
        return list(split_held_out(self.picture(s)[len(self.setup.train) :])[0])

    def automatic(self, judge: Evaluator) -> tuple[Model, Sequence[float], str, Result]:
        """Run the automatic choice; return model, strengths, a description of the choice, and its figures."""
        waited = 0.0  # processor time of pictures, which `measure` counts
        courses = {view.camera.name: edit_course(self.painter, view) for view in self.choosing}

        def edit(strengths: Sequence[float], views: Sequence[View]) -> Pictures:
            nonlocal waited
            began = time.process_time()
            chosen = {view.camera.name for view in views}
            is_chosen = [view.camera.name in chosen for view in self.setup.views]
            pictures = {s: list(compress(self.picture(s), is_chosen)) for s in strengths}
            waited += time.process_time() - began
            return pictures

        def look(s: float, views: Sequence[View]) -> list[Tensor]:
            return [quantize_image(courses[view.camera.name](s)) for view in views]

        finished = edit([1.0], self.setup.views)
        waited = 0.0
        began = time.process_time()
        between = StrengthSource(edit, look)
        with TemporaryDirectory() as folder, closing(RunLog(Path(folder) / "log.txt", quiet=True)) as log:
            options = (
                OptimizeOptions(engine="cpu"),
                self.setup,
                finished,
                between,
                TrainingViewOptions(),
                log,
                FieldOptions(),
            )
            plan = plan_colors(*options)
        solver = plan.solver
        model = plan.model
        course = plan.course
        snapshots = list[ParameterSnapshot]()
        state = PgsState(self.original)
        max_steps = iterations(OptimizeOptions().steps)
        for snapshot in solve(solver, model, course, snapshots, state, lambda step, left: None, max_steps):
            snapshots.append(snapshot)
        # `measure` adds `self.seconds`, but this run has prepared its views itself
        spent = time.process_time() - began - waited - self.seconds
        strengths, snapshots = course.sort_recordings(snapshots)
        steps = ", ".join(f"{snapshot.means.get(TAKEN, 0):.0f}" for snapshot in snapshots)
        at = ", ".join(f"{s:g}" for s in strengths)
        tables = [snapshot.table for snapshot in snapshots if snapshot.table is not None]
        offsets = [snapshot.offsets for snapshot in snapshots]
        views = len(self.setup.held_out) + len(solver.views)
        # without the pictures that the automatic choice does not need
        spent -= (1.0 - views / len(self.setup.views)) * (len(snapshots) - 1) * self.a_strength
        name = f"automatic: {views} views, {len(strengths)} strengths, {model.bands} SH"
        result = self.measure(name, judge, strengths, model.bands, tables, offsets, spent, model.mask)
        return model, strengths, f"{model.line}; strengths {at} in {steps} steps", result

    def sweep(
        self,
        judge: Evaluator,
        degree: int,
        bands: int,
        most: int,
        stages: Sequence[int],
        mask: Tensor | None,
    ) -> Iterator[Result]:
        """Solve for several strengths and steps, and yield the figures of each combination."""
        began = time.process_time()
        solver = make_solver(self.drawn, self.original)
        last = None
        solver = solver if mask is None else solver.with_mask(mask.float() / 255.0)
        once = time.process_time() - began
        every = self.strengths(stages[0])
        for s in (1.0, *every[:-1]):
            targets = self.targets(s)
            began = time.process_time()
            table, mapped = solver.fit_map(degree, targets)
            spent = time.process_time() - began
            done = 0
            now = torch.zeros(len(mapped), bands, 3) if last is None else s * last
            for steps in (steps for steps in STEPS if steps <= most):
                began = time.process_time()
                if bands:
                    now, _ = solver.residual(mapped, now, targets, steps - done)
                spent = spent + time.process_time() - began
                done = steps
                self.solved[degree, bands, s, steps] = table, add_bands(mapped, now), spent
            last = now if last is None else last
        for count in stages:
            strengths = every[len(every) // count - 1 :: len(every) // count]
            for steps in STEPS[: 1 if not bands else len(STEPS)]:
                if steps <= most:
                    solutions = [self.solved[degree, bands, s, steps] for s in strengths]
                    suffix = f", {steps} steps" if bands else ""
                    if mask is not None:
                        suffix += ", a mask"
                    name = f"{len(self.setup.views)} views, {count} strengths{suffix}, {bands} SH"
                    offsets = [band_offsets(change, self.original.shape[1]) for _, change, _ in solutions]
                    spent = once + sum(seconds for *_, seconds in solutions)
                    tables = [table for table, *_ in solutions]
                    yield self.measure(name, judge, strengths, bands, tables, offsets, spent, mask)

    def measure(
        self,
        name: str,
        judge: Evaluator,
        strengths: Sequence[float],
        bands: int,
        tables: Sequence[Tensor],
        offsets: Sequence[Tensor],
        spent: float,
        mask: Tensor | None = None,
    ) -> Result:
        """Fit and measure the field that a run would ship; the slider value is the editor's strength."""
        count = len(strengths)
        trajectory = Trajectory(
            s=torch.tensor([0.0, *strengths]),
            offsets=torch.stack([torch.zeros_like(offsets[0]), *offsets]).half(),
            end=offsets[-1],
            steps=torch.arange(count + 1),
            stage_ends=tuple(range(1, count + 1)),
            strengths=tuple(strengths),
            maps=torch.stack(list(tables)),
            bands=bands,
            mask=mask,
        )
        trajectory = smooth_course(trajectory)
        choosing = self.evaluator(self.choosing, {s: self.aside(s) for s in strengths})
        one = replace(choosing, crops=choosing.crops[:1], pixels=choosing.pixels[:1], edited={})
        began = time.process_time()
        fitted = fit_grades(trajectory, self.original, choosing, one, self.weights, FieldOptions())
        seconds = self.seconds + count * self.a_strength + spent + time.process_time() - began
        chosen = fitted.chosen.field
        psnrs = [judge.psnr(judge.pictures(chosen.offsets(s)), judge.edited[s]) for s in MEASURED]
        return Result(name, psnrs, seconds, chosen.bytes_per_member)

    def judge(self) -> Evaluator:
        """Prepare an evaluator on views of the same size that are not used for training."""
        assert self.setup.up is not None
        camera = self.setup.train[0].camera
        size = max(camera.width, camera.height)
        rig = region_rig(self.scene, self.region, REPORTING, size, self.setup.up.direction)[1:]
        rig = [replace(one, sampling=camera.sampling) for one in rig]
        cameras = with_near_plane(name_cameras(rig), self.scene)
        views = choose_views(self.scene, self.region, cameras, len(cameras), self.setup.background).views
        edited = {s: [quantize_image(self.painter.edit(view, s)) for view in views] for s in MEASURED}
        return self.evaluator(views, edited)

    def evaluator(self, views: Sequence[View], edited: dict[float, list[Tensor]]) -> Evaluator:
        """Prepare an evaluator on views with their edited pictures."""
        channels = self.original.shape[1]
        return make_evaluator(self.scene, self.region, views, edited, self.setup.background, channels, True)

    def _crops(self, views: Sequence[View]) -> list[CropScene]:
        members = self.region.members
        background = self.setup.background
        return [crop_scene(self.scene, members, v.camera, v.box, background, True) for v in views]


def begin_edit(scene: Gaussians, region: Region, editor: str) -> RegretEdit:
    """Prepare an edit with the views that a run chooses automatically."""
    setup = make_training_setup(TrainingViewOptions(), scene, region)
    glances = partial(render_thumbnails, TrainingViewOptions(), scene, region)
    painter = make_editor(EditorOptions(editor), scene, region, setup.views, glances)
    return RegretEdit(scene, region, editor, painter, setup)


def run_regret(options: RegretOptions) -> Table:
    """Run the sweep; print a line per result and return the table.

    Raises:
        ProgdfError: the scene, region or editor cannot be used.
    """
    prepare_process(1)
    scene = load_scene(options.scene)
    region = parse_region(options.region, scene)

    edit = begin_edit(scene, region, options.editor)
    camera = edit.setup.train[0].camera
    judge = edit.judge()
    edit.automatic(judge)  # not counted: the first use loads libraries
    model, _, line, automatic = edit.automatic(judge)
    print_line(line)
    results = [automatic]
    print_line(" | ".join(automatic.cells))
    for bands in (bands for bands in BANDS if bands <= edit.drawn[0].basis.shape[1]):
        max_steps = STEPS[-1] if bands == model.bands else STEPS[-2]
        for result in edit.sweep(judge, model.degree, bands, max_steps, STAGES, model.mask):
            print_line(" | ".join(result.cells))
            results.append(result)
    best_bands = max(results[1:], key=lambda result: result.mean).name.split()[-2]
    for views in VIEWS:
        size = max(camera.width, camera.height)
        others = make_training_setup(TrainingViewOptions(views=views, image_size=size), scene, region)
        other = RegretEdit(scene, region, options.editor, edit.painter, others)
        for result in other.sweep(judge, model.degree, int(best_bands), STEPS[-2], STAGES[:1], model.mask):
            print_line(" | ".join(result.cells))
            results.append(result)
    best = max(results, key=lambda result: result.mean)
    fast = min((r for r in results if r.mean >= best.mean - NEAR), key=lambda result: result.seconds)
    summary = (
        f"Regret {best.mean - automatic.mean:.2f} dB to {best.name}. The cheapest within {NEAR:g} dB of that "
        f"is {fast.name}; the automatic one takes {automatic.seconds / fast.seconds:.2f} times as long."
    )
    columns = ("options", "dB", "mean", "s", "bytes a Gaussian")
    title = f"{options.scene.stem} ({len(region)} members, SH {scene.sh_degree}), {options.editor}"
    return Table("regret", title, columns, tuple(r.cells for r in results), f"{summary} {NOTE}")
