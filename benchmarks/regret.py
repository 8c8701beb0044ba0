"""`python -m benchmarks regret SCENE REGION EDITOR`: how much better or cheaper an edit of colors could be.

The editor pictures one edit once; strengths, steps, SH functions of the residual and views are swept, beside
what a run decides by itself. All are measured in the same views, in which nobody trained or chose. Strengths
that are solved for are those of the densest sweep; fewer take every other of its solutions.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import torch
import tyro
from torch import Tensor

from progdf.field import BakedField
from progdf.field.grade import band_offsets
from progdf.field.trajectory import Trajectory
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians, pack
from progdf.region import Region
from progdf.scene.regions import parse_region
from trainer.editors import make_editor
from trainer.editors.base import ImageEditor
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import fit_grades, visibility
from trainer.fit.slider_uniformity import equalized_strengths
from trainer.optimize.color_solver import (
    Judge,
    Solver,
    add_bands,
    color_views,
    iterations,
    make_solver,
    solve,
)
from trainer.optimize.pgs import PgsState, TargetStage
from trainer.options import EditorOptions, FieldOptions, OptimizeOptions, ViewOptions
from trainer.run.training import choose_effort
from trainer.setup import TrainingSetup, make_training_setup, quantize_image, widen_views
from trainer.views.choose import choose_views, split_held_out
from trainer.views.crops import crop_scene
from trainer.views.view import View, crop, name_cameras, region_rig, with_near_plane

MEASURED = (0.12, 0.38, 0.64, 0.88, 1.0)
"""Strengths at which the editor is asked for what it means."""
STAGES = (8, 4, 2)
STEPS = (5, 12, 24, 48)
"""Of conjugate gradients for each strength, none settled before: .4, 1, 2 and 4 times a hundred by eight."""
BANDS = (0, 1, 4)
VIEWS = (20, 30)
REPORTING = 13
"""Cameras of a rig, which stand where no training view does, in which all is measured."""
NEAR = 0.3
"""dB within which a cheaper run counts as equal."""


@dataclass(frozen=True)
class RegretOptions:
    """Sweep the effort of an edit of colors, and compare what a run decides by itself."""

    scene: tyro.conf.Positional[Path]
    """The scene."""
    region: tyro.conf.Positional[str]
    """As progdf train --region has it."""
    editor: tyro.conf.Positional[str]
    """An editor of colors that pictures any strength."""


@dataclass(frozen=True)
class Result:
    """One way to make the edit."""

    name: str
    psnrs: Sequence[float]  # at `MEASURED`, dB
    seconds: float  # of the processor: pictures, weights, model, solving, field
    bytes: float  # of the field by Gaussian

    @property
    def mean(self) -> float:
        """Of the end and the mean of the in-betweens, dB."""
        return (self.psnrs[-1] + sum(self.psnrs[:-1]) / (len(self.psnrs) - 1)) / 2


@dataclass
class Clock:
    """Processor seconds by what they were spent on."""

    spent: dict[str, float] = field(default_factory=dict)

    def time(self, what: str, work):  # type: ignore[no-untyped-def]
        began = time.process_time()
        made = work()
        self.spent[what] = self.spent.get(what, 0.0) + time.process_time() - began
        return made


@dataclass(frozen=True)
class Case:
    """A scene, a region of it and an edit."""

    scene: Gaussians
    region: Region
    editor: str

    @cached_property
    def original(self) -> Tensor:
        return pack(self.scene[self.region.members], with_shN=self.scene.sh_degree > 0)

    def setup(self, views: int) -> TrainingSetup:
        return make_training_setup(ViewOptions(views=views), self.scene, self.region)

    def make_editor(self, views: Sequence[View]) -> ImageEditor:
        return make_editor(EditorOptions(self.editor), self.scene, self.region, views)

    def judge(self, setup: TrainingSetup) -> Evaluator:
        """Views of everybody's, as large as those of `setup`."""
        assert setup.up is not None
        size = max(setup.train[0].camera.width, setup.train[0].camera.height)
        rig = region_rig(self.scene, self.region, REPORTING, size, setup.up.direction)[1:]
        cameras = with_near_plane(name_cameras(rig), self.scene)
        views = choose_views(self.scene, self.region, cameras, len(cameras), setup.background).views
        return self.evaluator(setup, views, MEASURED)

    def evaluator(self, setup: TrainingSetup, views: Sequence[View], strengths: Sequence[float]) -> Evaluator:
        editor = self.make_editor(views)
        edited = {s: [quantize_image(editor.edit(view, s)) for view in views] for s in strengths}
        return make_evaluator(
            self.scene, self.region, views, edited, setup.background, self.original.shape[1], True
        )


class Sweep:
    """Solutions of one set of views, each made once."""

    def __init__(self, case: Case, setup: TrainingSetup, judge: Evaluator) -> None:
        self.case, self.judge, self.clock = case, judge, Clock()
        editor = case.make_editor(setup.views)
        plain = tuple((i + 1) / STAGES[0] for i in range(STAGES[0]))
        self.strengths = equalized_strengths(editor, case.editor, setup.views, plain)

        def picture() -> dict[float, list[Tensor]]:
            return {s: [quantize_image(editor.edit(v, s)) for v in setup.views] for s in self.strengths}

        edited = self.clock.time("pictures", picture)
        count = len(setup.train)
        self.setup = widen_views(setup, {s: pictures[:count] for s, pictures in edited.items()})
        members = case.region.members

        def weigh() -> Solver:
            crops = [
                crop_scene(case.scene, members, v.camera, v.box, setup.background, True)
                for v in self.setup.train
            ]
            return make_solver(color_views(crops, case.original), case.original)

        self.solver = self.clock.time("weights", weigh)
        self.targets = {
            s: [crop(p, v.box) for p, v in zip(pictures, self.setup.train, strict=False)]
            for s, pictures in edited.items()
        }
        views = split_held_out(setup.held_out)[0]
        kept = {s: split_held_out(pictures[count:])[0] for s, pictures in edited.items()}
        self.choosing = make_evaluator(
            case.scene, case.region, views, kept, setup.background, case.original.shape[1], True
        )
        self.weights = visibility(case.scene, members, setup.train)
        self.tables: dict[tuple[int, float], tuple[Tensor, Tensor]] = {}
        self.solved: dict[tuple[int, int, float, int], tuple[Tensor, float]] = {}

    def mapped(self, degree: int, s: float) -> tuple[Tensor, Tensor]:
        if (degree, s) not in self.tables:
            table = self.clock.time("map", lambda: self.solver.table(degree, self.targets[s]))
            self.tables[degree, s] = table, self.solver.map_offsets(degree, table)
        return self.tables[degree, s]

    def solve(self, degree: int, bands: int, most: int) -> None:
        """Residuals of all strengths after each of `STEPS` up to `most`, and the seconds that they took.

        The finished edit's comes first and the others begin from it, as large as they are strong.
        """
        zero = torch.zeros(len(self.case.original), bands, 3)
        last: Tensor | None = None
        for s in (1.0, *self.strengths[:-1]):
            now, spent, done = zero if last is None else last * s, 0.0, 0
            mapped = self.mapped(degree, s)[1]
            for steps in (step for step in STEPS if step <= most):
                began = time.process_time()
                now, _ = self.solver.residual(mapped, now, self.targets[s], steps - done, lambda: None)
                spent, done = spent + time.process_time() - began, steps
                self.solved[degree, bands, s, steps] = now, spent
            last = now if last is None else last

    def result(self, name: str, degree: int, bands: int, steps: int, stages: int) -> Result:
        """The field of some of the strengths, measured."""
        strengths = self.strengths[STAGES[0] // stages - 1 :: STAGES[0] // stages]
        tables, offsets, seconds = [], [], 0.0
        for s in strengths:
            table, mapped = self.mapped(degree, s)
            if bands:
                residual, took = self.solved[degree, bands, s, steps]
                mapped, seconds = add_bands(mapped, residual), seconds + took
            tables.append(table)
            offsets.append(band_offsets(mapped, self.case.original.shape[1]))
        share, spent = stages / STAGES[0], self.clock.spent
        seconds += share * (spent["pictures"] + spent["map"]) + spent["weights"]
        return self.measure(name, strengths, bands, tables, offsets, seconds)

    def measure(
        self,
        name: str,
        strengths: Sequence[float],
        bands: int,
        tables: Sequence[Tensor],
        offsets: Sequence[Tensor],
        seconds: float,
    ) -> Result:
        """The field that a run would keep of these, its slider the editor's own strength."""
        count = len(strengths)
        trajectory = Trajectory(
            torch.tensor([0.0, *strengths]),
            torch.stack([torch.zeros_like(offsets[0]), *offsets]).half(),
            offsets[-1],
            torch.arange(count + 1),
            tuple(range(1, count + 1)),
            tuple(strengths),
            torch.stack(list(tables)),
            bands,
        )
        one = replace(
            self.choosing, crops=self.choosing.crops[:1], pixels=self.choosing.pixels[:1], edited={}
        )
        began = time.process_time()
        fitted = fit_grades(trajectory, self.case.original, self.choosing, one, self.weights, FieldOptions())
        seconds += time.process_time() - began
        chosen: BakedField = fitted.chosen.field
        psnrs = [
            self.judge.psnr(self.judge.pictures(chosen.offsets(s)), self.judge.edited[s]) for s in MEASURED
        ]
        return Result(name, psnrs, seconds, chosen.bytes_per_member)


def automatic(sweep: Sweep) -> tuple[int, Result]:
    """Degree of the map, and what a run decides by itself in the sweep's views."""
    setup, case, solver = sweep.setup, sweep.case, sweep.solver
    views, most = split_held_out(setup.held_out)[0], iterations(OptimizeOptions().steps)
    editor, spent = case.make_editor(setup.views), dict(sweep.clock.spent)
    a_picture = spent["pictures"] / len(sweep.strengths)
    crops = [
        crop_scene(case.scene, case.region.members, v.camera, v.box, setup.background, True) for v in views
    ]

    def boxes(of: Sequence[View], s: float) -> list[Tensor]:
        return [crop(quantize_image(editor.edit(view, s)), view.box) for view in of]

    finished = boxes(views, 1.0)
    began = time.process_time()
    drawn = color_views(crops, case.original)
    solver, model, line = choose_effort(
        solver.views, Judge(drawn, finished), sweep.targets[1.0], case.original, most, "auto", True
    )
    every = len(setup.train) // len(solver.views)
    took = time.process_time() - began
    strengths = equalized_strengths(editor, case.editor, setup.views, sweep.strengths, model.missed)
    judges = [Judge(drawn, boxes(views, s)) for s in strengths]
    stages = [TargetStage(s, boxes(setup.train, s)[::every], 1) for s in strengths]
    state = PgsState(case.original)
    sweep.choosing = case.evaluator(setup, views, strengths)
    began = time.process_time()
    made = list(solve(case.original, solver, model, stages, judges, state, lambda step, left: None, most))
    solving = time.process_time() - began
    print(
        f"{line}; {took:.1f} s; {len(strengths)} strengths, {solving:.1f} s, steps "
        + " ".join(f"{m.means.get('steps', 0):.0f}" for m in made),
        flush=True,
    )
    name = f"automatic: {len(solver.views)} views solved for, {len(strengths)} strengths, {model.bands} SH"
    return model.degree, sweep.measure(
        name,
        strengths,
        model.bands,
        [snapshot.table for snapshot in made if snapshot.table is not None],
        [snapshot.offsets for snapshot in made],
        took + solving + spent["weights"] + len(strengths) * a_picture,
    )


def sweep_effort(options: RegretOptions) -> Iterator[Result]:
    """The automatic way first, then all others."""
    scene = load_scene(options.scene)
    case = Case(scene, parse_region(options.region, scene), options.editor)
    setup = case.setup(0)
    judge = case.judge(setup)
    sweep = Sweep(case, setup, judge)
    print(
        len(scene),
        len(case.region),
        "sh",
        scene.sh_degree,
        len(setup.views),
        "views",
        setup.train[0].camera.width,
        sweep.clock.spent,
        flush=True,
    )
    choosing = sweep.choosing
    degree, auto = automatic(sweep)
    yield auto
    sweep.choosing = choosing
    count = len(setup.views)
    best: Result | None = None
    use = 1
    for bands in (b for b in BANDS if b <= sweep.solver.sh.shape[1]):
        if bands:
            sweep.solve(degree, bands, STEPS[-1] if bands < 9 else STEPS[1])
        for stages in STAGES:
            for steps in STEPS if bands else (0,):
                if bands == 9 and steps > STEPS[1]:
                    continue
                result = sweep.result(
                    f"{count} views, {stages} strengths, {steps} steps, {bands} SH",
                    degree,
                    bands,
                    steps,
                    stages,
                )
                if best is None or result.mean > best.mean:
                    best, use = result, bands
                yield result
    for views in VIEWS:
        if views == count:
            continue
        other = Sweep(case, case.setup(views), judge)
        if use:
            other.solve(degree, use, STEPS[2])
        for steps in STEPS[1:3] if use else (0,):
            yield other.result(
                f"{len(other.setup.views)} views, 8 strengths, {steps} steps, {use} SH", degree, use, steps, 8
            )


def main_regret(options: RegretOptions) -> None:
    results = []
    for r in sweep_effort(options):
        results.append(r)
        print(
            r.name,
            "|",
            " ".join(f"{p:.1f}" for p in r.psnrs),
            "|",
            f"{r.mean:.2f} dB {r.seconds:.1f} s {r.bytes:.0f} B",
            flush=True,
        )
    auto, rest = results[0], results
    best = max(rest, key=lambda r: r.mean)
    near = min((r for r in rest if r.mean >= best.mean - NEAR), key=lambda r: r.seconds)
    print(
        f"regret {best.mean - auto.mean:.2f} dB to {best.name}; the cheapest within {NEAR:g} dB of it, "
        f"{near.name}, takes {near.seconds:.1f} s; ratio {auto.seconds / near.seconds:.2f}"
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    from trainer.run.threads import use_threads

    use_threads(1)
    main_regret(tyro.cli(RegretOptions))
