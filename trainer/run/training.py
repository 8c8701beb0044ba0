"""PGS over a run's training views, saved as it goes: recordings in, a trajectory out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any

import msgspec
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import MONOMIALS
from progdf.field.trajectory import Trajectory
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, pack
from progdf.io.json_values import convert_json
from progdf.io.tensors import check_tensor
from progdf.rasterize.engines import engine_device
from progdf.scene.bounds import scene_sphere
from trainer.fit.network import JointTraining, begin_joint_training, save_network
from trainer.optimize.color_course import STEPS, Course, Target, solve
from trainer.optimize.color_solver import (
    Model,
    Solver,
    choose_model,
    enrich,
    iterations,
    make_solver,
    split_solver,
)
from trainer.optimize.color_views import ColorView, Judge, color_views
from trainer.optimize.groups import Groups, group_path, group_stage, restore_groups
from trainer.optimize.growth import add_rows, place_seeds, removal_costs, seed_rows
from trainer.optimize.losses import Losses, Objective, Perceptual, erode, loss_table
from trainer.optimize.pgs import (
    OnStep,
    ParameterSnapshot,
    PgsState,
    TargetStage,
    optimize,
    pgs_settings,
)
from trainer.optimize.retime import drop_jitter, record, resolve_slider, retime
from trainer.optimize.ties import surface_ties
from trainer.options import MOST_STAGES, OptimizeOptions, TrainOptions
from trainer.setup import Pictures, TrainingSetup, probe_views
from trainer.store.progress import RunLog, release_memory
from trainer.store.run_folder import LazySequence, stored_pictures
from trainer.store.state import PeriodicSave, Resumable, Saved, StateFolder, defer_signals
from trainer.views.choose import split_held_out
from trainer.views.crops import CropScene, crop_scene, moving_attributes, only_recolors, render_all
from trainer.views.view import View, crop


class _RecordingValues(msgspec.Struct):
    """What is saved of a recording beside its offsets."""

    step: int
    stage: int
    ends_stage: bool
    means: dict[str, float]


class Recordings:
    """All recordings so far, in half precision, a `state.Resumable`: each is written once, to its own file.

    Args:
        folder: where
        shape: of the offsets
        model: of an edit of colors, whose recordings have the map with them
    """

    def __init__(self, folder: StateFolder, shape: torch.Size, model: Model | None) -> None:
        self.made: list[ParameterSnapshot] = []
        self._folder, self._shape, self._model, self._written = folder, shape, model, 0

    def add(self, snapshot: ParameterSnapshot) -> None:
        """Keep one."""
        release_memory()
        table = None if snapshot.table is None else snapshot.table.cpu()
        self.made.append(replace(snapshot, offsets=snapshot.offsets.half().cpu(), table=table))

    def capture_state(self) -> Saved:
        """How many there are; those that came since the last time are saved first."""
        for index in range(self._written, len(self.made)):
            snapshot = self.made[index]
            values = {name: getattr(snapshot, name) for name in ("step", "stage", "ends_stage", "means")}
            tensors = {"offsets": snapshot.offsets}
            tensors |= {} if snapshot.table is None else {"table": snapshot.table}
            self._folder.save_later("recordings", tensors, values, index)
        self._written = len(self.made)
        return Saved({}, {"count": self._written})

    def restore(self, saved: Saved) -> None:
        """Read as many as there were; what a killed run wrote beyond them will be written again."""
        self._written = saved.values["count"]
        recordings = [self._folder.load("recordings", index) for index in range(self._written)]
        if None in recordings:
            raise ProgdfError(f"recordings are missing in {self._folder.path}; delete it and train again")
        self.made[:] = [self._read(kept) for kept in recordings if kept]

    def _read(self, saved: Saved) -> ParameterSnapshot:
        values, offsets = convert_json(saved.values, _RecordingValues), saved.tensors["offsets"]
        check_tensor("offsets", offsets, self._shape, torch.float16)
        table = None if self._model is None else saved.tensors["table"]
        if self._model is not None and table is not None:
            check_tensor("table", table, (MONOMIALS[max(1, self._model.degree)], 3), torch.float32)
        return ParameterSnapshot(values.step, values.stage, values.ends_stage, offsets, values.means, table)


PART = "training"
"""Of the saved state: all that changes while the members are optimized."""

_TIMED_VIEWS = 4  # in which the slider is timed; 8 or all at full size time it no better


_ENOUGH = 12  # pixels for each number of a color that is solved for


Way = Callable[[OnStep], Iterator[ParameterSnapshot]]
"""Optimizes from the state on, and yields recordings."""


@dataclass(frozen=True)
class Strengths:
    """Of an edit of colors: strengths that are edited when it is known that they are called for."""

    ruler: Sequence[float]  # see `Course.ruler`
    edit: Callable[[Sequence[float]], Pictures]  # all views, which stay on disk
    look: Callable[[float, Sequence[View]], Sequence[Tensor]]  # some views, as they would be


def optimize_members(
    options: TrainOptions,
    optimization: OptimizeOptions,
    setup: TrainingSetup,
    edited: Pictures,
    perceptual: Perceptual,
    folder: StateFolder,
    log: RunLog,
    between: Strengths | None = None,
) -> tuple[Trajectory, Losses, Mapping[str, Any]]:
    """Optimize the members, from the beginning or from the saved state.

    Args:
        options: resolved
        optimization: its part with nothing left open, see `resolve_kind`
        setup: scene, region, views with boxes that hold the edit
        edited: strength → the edited training views, whole
        perceptual: distance of pictures
        folder: where the state is saved
        log: of the run
        between: of colors that are solved for, what more strengths there may be; None: those of `edited`

    Returns:
        The trajectory, even in time; mean of every loss term, and what is left to the edit, per recording;
        the effort that was decided on, as report.json has it

    Raises:
        ProgdfError: the loss is not finite.
        KeyboardInterrupt: interrupted; the state is saved.
    """
    scene, members = setup.scene, setup.region.members
    bands = optimization.sh != "off"
    engine, device = optimization.engine, engine_device(optimization.engine)
    if engine == "warp":
        card = torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU, in place of a card"
        log.say(f"the steps are drawn by warp on {card}")
    original = pack(scene[members], with_shN=scene.sh_degree > 0).to(device)
    still = optimization.kind == "color" and optimization.rates == "kind"
    crops = _crops(setup, setup.train, still, engine)
    stages, groups = _stages(optimization, setup, edited), None
    if optimization.group_steps:
        groups = _groups(optimization, original, crops, stages, folder, log)
        stages = groups.to_stages(original, crops, stages)
    extent = 2.0 * scene_sphere(scene[members])[1] if groups is None else groups.extent
    settings = pgs_settings(optimization, bands, original.shape[1], extent, len(stages))
    own, seeds = len(members), _seeds(setup, optimization, edited, folder) if optimization.grow else None
    if seeds is not None:
        setup, settings = setup.extend(seeds), replace(settings, ramp=0.0)
        original = torch.cat([original, pack(seeds, with_shN=scene.sh_degree > 0).to(device)])
        crops = _crops(setup, setup.train, still, engine)
        stages = [place_seeds(s, len(seeds)) for s in stages]
    state = PgsState(original, settings.seed)
    way: Way
    model: Model | None = None
    steps, recordings_of = sum(stage.steps for stage in stages), partial(Recordings, folder, original.shape)
    if optimization.solver == "colors":
        most, steps = iterations(optimization.steps), len(edited) if between is None else MOST_STAGES
        colors, model, course = _prepare_colors(
            options, optimization, setup, edited, crops, original, between, log
        )
        stages, recordings = [course.finished[0]], recordings_of(model)
        way = partial(solve, original, colors, model, course, recordings.made, state, steps=most)
    else:
        recordings = recordings_of(None)
        inside = [erode(crop(view.mask, view.box)).to(device) for view in setup.train]
        objective = Objective(perceptual, optimization, inside)
        probes = probe_views(setup, engine=engine)
        way = partial(optimize, original, crops, probes, stages, objective, settings, state=state)
    joint = None
    if optimization.as_printed and options.field.field == "neural":
        joint = begin_joint_training(
            options.field, optimization, setup, settings.rates, stages, crops, perceptual
        )
    saver = _record_way(way, steps, state, recordings, joint, folder, log)
    distances = [made.means["left"] for made in recordings.made]
    log.say(f"L1 to the finished edit: {distances[0]:.4f} at first, {distances[-1]:.4f} at the end")
    log.say(f"the state was saved {saver.saves} times, in {saver.seconds:.2f} s")
    end = stages[-1].place(state.average).cpu().clone()
    ordered, strengths = recordings.made, list(edited)
    if model is not None:
        strengths, ordered = course.sort_recordings(ordered)
    snapshots = [(made.step, made.stage, made.ends_stage, made.offsets[:own]) for made in ordered]
    if groups is not None:
        ends = [made for made in recordings.made if made.ends_stage]
        offsets = [*(made.offsets.float() for made in ends[:-1]), end]
        snapshots = group_path(original, groups, offsets, [made.step for made in ends], settings.snapshots)
    taken = [int(made.means[STEPS]) for made in ordered if STEPS in made.means]
    rows = [(m.step, {name: mean for name, mean in m.means.items() if name != STEPS}) for m in ordered]
    trajectory, effort = record(snapshots, end[:own], strengths), {"strengths": strengths, STEPS: taken}
    if seeds is not None:
        finished = original + end.to(device)
        costs = removal_costs(crops, finished, stages[-1].targets, optimization.seed)[own:].cpu()
        trained = setup.scene.replace_rows(setup.region.members, finished.cpu())[len(scene) :]
        trajectory = add_rows(trajectory, trained[costs > 0.0])
        effort["added"] = 0 if trajectory.added is None else len(trajectory.added)
        log.say(f"growth: {effort['added']} Gaussians added, of {len(seeds)}; the others contribute nothing")
    if model is not None:
        maps = torch.stack([made.table for made in ordered if made.table is not None])
        trajectory = replace(trajectory, maps=maps, bands=model.bands, mask=model.mask)
        counts = (
            f"in {', '.join(map(str, taken))} steps, of {most} each at most" if taken else "by maps alone"
        )
        log.say(f"{len(strengths)} strengths {counts}")
        effort |= model.figures() | {"most_steps": most, "views": len(crops)}
    return trajectory, loss_table(rows), effort


def _stages(optimization: OptimizeOptions, setup: TrainingSetup, edited: Pictures) -> list[TargetStage]:
    """The strengths to optimize towards, and the steps that each gets."""
    steps = max(optimization.steps, len(edited) + 1)  # each stage is to have one
    return [
        TargetStage(s, _boxes(pictures, setup.train, optimization.engine), steps)
        for (s, pictures), steps in zip(edited.items(), _steps_by_stage(steps, len(edited)), strict=True)
    ]


def _boxes(pictures: Sequence[Tensor], views: Sequence[View], engine: str = "cpu") -> Sequence[Tensor]:
    device, pairs = engine_device(engine), zip(pictures, views, strict=False)
    return stored_pictures(crop(picture, view.box).to(device) for picture, view in pairs)


def _crops(
    setup: TrainingSetup, views: Sequence[View], still: bool, engine: str = "cpu"
) -> Sequence[CropScene]:
    """Of an edit of colors each is made when it is looked at: once, by `color_views`."""
    scene, members = setup.scene.to(engine_device(engine)), setup.region.members
    crops = LazySequence(
        views, lambda v: crop_scene(scene, members, v.camera, v.box, setup.background, still, engine)
    )
    return crops if still else list(crops)


def _prepare_colors(
    options: TrainOptions,
    optimization: OptimizeOptions,
    setup: TrainingSetup,
    edited: Pictures,
    crops: Sequence[CropScene],
    original: Tensor,
    between: Strengths | None,
    log: RunLog,
) -> tuple[Solver, Model, Course]:
    """The views to solve for, how much is modelled, and the strengths."""
    with log.stage("weights"):
        few = bool(options.views.pictures)
        every = 1 if few else _stride(setup, original)
        drawn = color_views(crops, original, every)
        aside = _look_aside(setup, drawn, original, edited, every)
        cameras = [view.camera for view in setup.train]
        ties = surface_ties(setup.scene, setup.region.members, cameras) if few else None

    def target(s: float, pictures: Sequence[Tensor]) -> Target:
        return TargetStage(s, _boxes(pictures, setup.train), 1), aside.judge(aside.pick(pictures))

    def ask(strengths: Sequence[float]) -> list[Target]:
        made = between.edit(strengths) if between is not None else edited
        return [target(s, made[s]) for s in strengths]

    def look(s: float) -> Judge:
        assert between is not None
        return aside.judge(between.look(s, aside.views))

    with log.stage("model"):
        (stage, judge), most = target(1.0, edited[1.0]), iterations(optimization.steps)
        solver = make_solver(drawn, original, ties)
        trials = [(solver, judge)] if ties is None else split_solver(solver, original, stage.targets)
        solver, model = choose_model(
            solver, trials, stage.targets, most, 1 if optimization.sh == "off" else 9
        )
    strengths = [s for s in edited if s < 1.0]
    if between is not None and model.richer is not None:  # which is decided there
        strengths = strengths or [between.ruler[len(between.ruler) // 2]]
    course = Course(ask(strengths) if strengths else [], (stage, judge))
    if between is not None:
        course = replace(course, ruler=between.ruler, look=cache(look), ask=ask)
    with log.stage("model"):
        middle = len(course.targets) // 2 if between is None else 0
        model = enrich(model, solver, *[*course.targets, course.finished][middle], most)
    on = "all views, as none is held out" if aside.drawn is drawn else "views that are held out"
    log.say(f"{model.line}, on {on if ties is None else 'squares of the pictures that are held out'}")
    if ties is not None:
        unseen = len(original) - int(solver.asked.sum())
        log.say(f"{unseen} members that no picture shows follow the map and their own surface")
    return solver, model, course


def _stride(setup: TrainingSetup, original: Tensor) -> int:
    """Of how many pixels of the training views one is solved for, see `color_views`: half of them say as much
    to some hundredths of a dB (docs/experiments.md, Pixels), fewer where many show each member."""
    bands = 1 if original.shape[1] == BASE_CHANNELS else 4
    pixels = sum(int((view.mask > 0.0).sum()) for view in setup.train) / (bands * len(original))
    return next(every for every in (8, 4, 2) if every == 2 or pixels >= _ENOUGH * every)


@dataclass(frozen=True)
class _Aside:
    """The views that judge what is solved for: the held-out ones that choose, or all where there are none."""

    views: Sequence[View]
    drawn: Sequence[ColorView]
    pick: Callable[[Sequence[Tensor]], Sequence[Tensor]]  # their pictures, of all views'

    def judge(self, pictures: Sequence[Tensor]) -> Judge:
        """How far from these views' pictures. [H,W,3] each"""
        return Judge(self.drawn, _boxes(pictures, self.views))


def _look_aside(
    setup: TrainingSetup,
    drawn: Sequence[ColorView],
    original: Tensor,
    edited: Pictures,
    every: int,
) -> _Aside:
    """See `_Aside`. `drawn`: the training views."""
    views, count = split_held_out(setup.held_out)[0], len(setup.train)
    if not views or len(edited[1.0]) <= count:
        return _Aside(setup.train, drawn, lambda pictures: pictures[:count])
    choosing = color_views(_crops(setup, views, True), original, every)
    return _Aside(views, choosing, lambda pictures: split_held_out(pictures[count:])[0])


def _record_way(
    way: Way,
    steps: int,
    state: PgsState,
    recordings: Recordings,
    joint: JointTraining | None,
    folder: StateFolder,
    log: RunLog,
) -> PeriodicSave:
    """Go the way to its end, from the saved state on, and a jointly trained network with it."""
    parts: dict[str, Resumable] = {"pgs": state, "recordings": recordings, "log": log}
    saver = PeriodicSave(folder, PART, parts | ({"field": joint} if joint else {}))
    if saver.restore():
        if joint is not None:
            joint.refill([(made.step, made.offsets) for made in recordings.made])
        log.say(f"continuing at step {state.step} of {steps}, with {len(recordings.made)} recordings")
    with log.steps("optimize", steps) as advance, defer_signals() as stopped:
        saved_at = state.step

        def step_done(step: int, left: float) -> None:
            nonlocal saved_at
            if joint is not None:
                joint.step()
            advance(min(step, steps), "" if math.isnan(left) else f"loss to the edit {left:.4f}")
            if stopped():
                saver.save()
                raise KeyboardInterrupt
            if step > saved_at:  # within a step there is nothing new to save
                saver.step_done()
                saved_at = step

        advance(state.step, "")  # of a handful of pictures nearly all is done before the first step
        try:
            for snapshot in way(step_done):
                recordings.add(snapshot)
                if joint is not None:
                    joint.add(snapshot.step, snapshot.offsets.cpu())
        except FloatingPointError as error:
            saver.save()
            raise ProgdfError(
                f"training failed: {error}; the state before it is kept: fix the edited views and continue "
                "with --resume, or try --kind style in another folder"
            ) from error
    saver.save(waits=False)
    if joint is not None:
        save_network(joint, folder)
    return saver


def _groups(
    optimization: OptimizeOptions,
    original: Tensor,
    crops: Sequence[CropScene],
    stages: Sequence[TargetStage],
    folder: StateFolder,
    log: RunLog,
) -> Groups:
    """The group stage, or what was saved of it."""
    done = folder.load("groups")
    if done is not None:
        return restore_groups(original, done.tensors)
    steps = optimization.group_steps or 0
    try:
        with log.steps("move parts", steps * len(stages)) as advance:
            groups = group_stage(
                original,
                crops,
                [stage.targets for stage in stages],
                steps,
                optimization.seed,
                lambda step, loss: advance(step, f"loss {loss:.4f}"),
                [stage.strength for stage in stages],
            )
    except FloatingPointError as error:
        raise ProgdfError(
            f"training failed: {error}; fix the edited views and continue with --resume"
        ) from error
    folder.save("groups", groups.capture_state(), {})
    for line in groups.lines():
        log.say(line)
    return groups


def _seeds(
    setup: TrainingSetup, optimization: OptimizeOptions, edited: Pictures, folder: StateFolder
) -> Gaussians | None:
    """The rows that are added, or what was saved of them; None where there are none."""
    saved, finished = folder.load("seeds"), edited[max(edited)]
    if saved is None:
        count = int(optimization.grow * len(setup.region))
        seeds = seed_rows(setup, setup.train, finished[: len(setup.train)], count, optimization.seed)
        saved = Saved({name: getattr(seeds, name) for name in ATTRIBUTES}, {})
        folder.save("seeds", saved.tensors, saved.values)
    rows: dict[str, Any] = dict(saved.tensors)
    return Gaussians(**rows) if len(rows["means"]) else None


def retime_trajectory(
    trajectory: Trajectory, setup: TrainingSetup, optimization: OptimizeOptions, log: RunLog
) -> Trajectory:
    """Without jitter, and at the slider values where its change is due; every recording is rendered once.

    Args:
        trajectory: as recorded
        setup: scene, region, views
        optimization: what slider values mean, and whether jitter is kept
        log: of the run
    """
    moving = moving_attributes(trajectory.end)
    small = probe_views(setup, _TIMED_VIEWS, still=only_recolors(trajectory.offsets))
    original = pack(setup.scene[setup.region.members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    pictures: list[Tensor] = []
    with log.steps("time the slider", len(trajectory)) as advance:
        for i in range(len(trajectory)):
            images = render_all(small, original + trajectory.node(i), moving)
            pictures.append(torch.cat([image.flatten() for image in images]))
            advance(i + 1, "recordings")
    if not optimization.as_printed and trajectory.maps is None:
        trajectory, pictures = drop_jitter(trajectory, pictures)
    return retime(trajectory, pictures, resolve_slider(optimization.slider, trajectory.strengths))


def _steps_by_stage(steps: int, stages: int) -> list[int]:
    """Steps per stage, adding up to `steps`; the last, which is looked at most, has twice as many."""
    marks = [steps * i // (stages + 1) for i in range(stages)]
    return [b - a for a, b in pairwise([*marks, steps])]
