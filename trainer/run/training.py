"""Optimization of the members over a run's training views, with regular saves, to a trajectory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from itertools import pairwise
from typing import Any, TypedDict

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import MONOMIALS
from progdf.field.trajectory import Trajectory
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, Gaussians, pack
from progdf.io.json_values import convert_json
from progdf.io.tensors import check_tensor
from progdf.metrics.image import LEVEL
from progdf.rasterize.engines import engine_device
from progdf.terminal import format_count
from trainer.methods import METHODS
from trainer.optimize.carry_on import CarryDecision, CarryRequest, make_tied_solver
from trainer.optimize.color_course import STEPS, StrengthSchedule, Target, solve, thin_model
from trainer.optimize.color_solver import (
    Model,
    Solver,
    choose_model,
    iterations,
    make_solver,
    solve_again,
    split_solver,
)
from trainer.optimize.color_views import (
    MAX_ERROR_SHARE,
    ColorEvaluator,
    ColorView,
    color_views,
    draw_color_views,
)
from trainer.optimize.groups import Groups, group_path, group_stage, region_extent, restore_groups
from trainer.optimize.growth import add_rows, place_seeds, removal_costs, seed_rows
from trainer.optimize.losses import Losses, Perceptual, loss_table
from trainer.optimize.pgs import SNAPSHOTS, DescentTask, OnStep, ParameterSnapshot, PgsState, TargetStage
from trainer.optimize.retime import record, retime, select_recordings, straight_recordings
from trainer.options import (
    MAX_STAGES,
    FieldOptions,
    OptimizeOptions,
    Slider,
    TrainingViewOptions,
    TrainOptions,
)
from trainer.paper.network import JointTraining, save_network
from trainer.store.memory import release_memory
from trainer.store.progress import RunLog
from trainer.store.run_folder import LazySequence
from trainer.store.state import PeriodicSave, Resumable, Saved, StateFolder, defer_signals
from trainer.views.boxes import Pictures, boxed_pictures, probe_views
from trainer.views.choose import split_held_out
from trainer.views.crops import CropScene, crop_scene, moving_attributes, only_recolors, render_all
from trainer.views.setup import TrainingSetup
from trainer.views.view import View


class _RecordingValues(TypedDict):
    """Saved values of a recording besides its tensors."""

    step: int
    ends_stage: bool
    means: dict[str, float]


class Recordings:
    """Recordings so far, in half precision: a `state.Resumable` that writes each to its own file once.

    Args:
        folder: folder for the files
        shape: shape of the offsets
        model: model of a color edit, whose recordings include the map
    """

    def __init__(self, folder: StateFolder, shape: torch.Size, model: Model | None) -> None:
        self.made: list[ParameterSnapshot] = []
        self._folder = folder
        self._shape = shape
        self._model = model
        self._written = 0

    def add(self, snapshot: ParameterSnapshot) -> None:
        """Append a recording."""
        release_memory()
        table = None if snapshot.table is None else snapshot.table.cpu()
        self.made.append(replace(snapshot, offsets=snapshot.offsets.half().cpu(), table=table))

    def capture_state(self) -> Saved:
        """Save the recordings added since the last call, and return their total number."""
        for index in range(self._written, len(self.made)):
            snapshot = self.made[index]
            values = {name: getattr(snapshot, name) for name in _RecordingValues.__annotations__}
            parts = {"offsets": snapshot.offsets, "table": snapshot.table}
            tensors = {name: part for name, part in parts.items() if part is not None}
            self._folder.save_later("recordings", tensors, values, index)
        self._written = len(self.made)
        return Saved({}, {"count": self._written})

    def restore(self, saved: Saved) -> None:
        """Read the saved number of recordings. Later files of a killed run are written again."""
        self._written = saved.values["count"]
        recordings = [self._folder.load("recordings", index) for index in range(self._written)]
        if None in recordings:
            raise ProgdfError(f"recordings are missing in {self._folder.path}; delete it and train again")
        self.made[:] = [self._read(kept) for kept in recordings if kept]

    def _read(self, saved: Saved) -> ParameterSnapshot:
        values = convert_json(saved.values, _RecordingValues)
        offsets = saved.tensors["offsets"]
        check_tensor("offsets", offsets, self._shape, torch.float16)
        if self._model is not None:
            numbers = MONOMIALS[max(1, self._model.degree)]
            check_tensor("table", saved.tensors["table"], (numbers, 3), torch.float32)
        return ParameterSnapshot(**values, offsets=offsets, table=saved.tensors.get("table"))


PART = "training"
"""Part of the saved state with everything that changes during the optimization of the members."""

_TIMED_VIEWS = 4  # views that time the slider; 8, or all at full size, are no better


# Sufficient number of pixels per unknown. With q pixels, noise adds 1/q to the error. Above 9, doubling q
# reduces the error by less than 5 % (docs/lab/experiments.md, Pixels).
_PIXELS_PER_UNKNOWN = (MAX_ERROR_SHARE - 0.5) / (1.0 - MAX_ERROR_SHARE)


Optimized = tuple[Trajectory, Losses, Mapping[str, Any]]
"""Trajectory, see `record`; loss terms and distance to the edit per recording; effort for report.json."""


@dataclass(frozen=True)
class StrengthSource:
    """Callbacks that edit further strengths on demand."""

    edit: Callable[[Sequence[float], Sequence[View]], Pictures]  # edits the given views, keeps them on disk
    look: Callable[[float, Sequence[View]], Sequence[Tensor]]  # edits the given views in memory only


def optimize_members(
    options: TrainOptions,
    optimization: OptimizeOptions,
    setup: TrainingSetup,
    edited: Pictures,
    perceptual: Perceptual,
    folder: StateFolder,
    log: RunLog,
    between: StrengthSource | None = None,
) -> Optimized:
    """Optimize the members, from the beginning or from the saved state.

    Args:
        options: resolved options
        optimization: fully resolved optimization options, see `resolve_kind`
        setup: scene, region, and views whose boxes hold the edit
        edited: strength → the whole edited training views
        perceptual: image distance
        folder: folder of the saved state
        log: log of the run
        between: source of further strengths for the color solver; None: only those of `edited`

    Raises:
        ProgdfError: the loss is not finite.
        KeyboardInterrupt: interrupted; the state is saved.
    """
    if optimization.solver == "colors":
        plan = plan_colors(
            optimization,
            setup,
            edited,
            between,
            options.views,
            log,
            options.field,
            CarryRequest(options.editor.carry_on, options.region.region),
        )
        return _solve(plan, iterations(optimization.steps), folder, log)
    scene = setup.scene
    members = setup.region.members
    engine = optimization.engine
    device = engine_device(optimization.engine)
    if engine == "warp":
        log.say(f"warp renders the training steps on {_device_name(device)}")
    original = pack(scene[members], with_shN=scene.sh_degree > 0).to(device)
    method = METHODS[options.preset]
    still = only_recolors(method.learning_rates(optimization.kind, original.shape[1], 1.0))
    crops = _crops(setup, still, engine)
    stages = _stages(optimization, setup, edited)
    groups = None
    if optimization.group_steps:
        groups = _groups(optimization, original, crops, stages, folder, log)
        stages = groups.to_stages(original, crops, stages)
    extent = region_extent(scene[members]) if groups is None else groups.extent
    rates = method.learning_rates(optimization.kind, original.shape[1], extent)
    if optimization.sh == "off":
        rates[BASE_CHANNELS:] = 0.0
    member_count = len(members)
    seeds = _make_or_load_seeds(setup, optimization, edited, folder) if optimization.grow else None
    if seeds is not None:
        setup = setup.extend(seeds)
        original = torch.cat([original, pack(seeds, with_shN=scene.sh_degree > 0).to(device)])
        crops = _crops(setup, still, engine)
        stages = [place_seeds(s, len(seeds)) for s in stages]
    state = PgsState(original, optimization.seed)
    recordings = Recordings(folder, original.shape, None)
    task = DescentTask(
        options=optimization,
        setup=setup,
        rates=rates,
        original=original,
        crops=crops,
        stages=stages,
        perceptual=perceptual,
        adds_rows=seeds is not None,
    )
    descend = partial(method.descend, task, state)
    joint = method.begin_network(options.field, task)
    all_snapshots = _record_snapshots(
        descend, sum(stage.steps for stage in stages), state, recordings, joint, folder, log
    )
    end = stages[-1].place(state.average).cpu().clone()
    snapshots = [replace(snapshot, offsets=snapshot.offsets[:member_count]) for snapshot in all_snapshots]
    if groups is not None:
        stage_ends = [snapshot for snapshot in all_snapshots if snapshot.ends_stage]
        offsets = [*(snapshot.offsets.float() for snapshot in stage_ends[:-1]), end]
        snapshots = group_path(
            original, groups, offsets, [snapshot.step for snapshot in stage_ends], SNAPSHOTS
        )
    trajectory = record(snapshots, end[:member_count], list(edited))
    effort: dict[str, Any] = {"strengths": list(edited)}
    if seeds is not None:
        finished = original + end.to(device)
        costs = removal_costs(crops, finished, stages[-1].targets, optimization.seed)[member_count:].cpu()
        trained = setup.scene.replace_rows(setup.region.members, finished.cpu())[len(scene) :]
        trajectory = add_rows(trajectory, trained[costs > 0.0])
        effort["added"] = 0 if trajectory.added is None else len(trajectory.added)
        log.say(f"growth: {effort['added']} Gaussians added, of {len(seeds)}; the others contribute nothing")
    return trajectory, loss_table([(snapshot.step, snapshot.means) for snapshot in all_snapshots]), effort


@dataclass(frozen=True)
class ColorPlan:
    """Solver and model of a color edit, and the strengths to solve for."""

    solver: Solver
    model: Model
    course: StrengthSchedule
    carry_on: CarryDecision | None  # decision on parts that no picture shows; None if there are many views


def plan_colors(
    optimization: OptimizeOptions,
    setup: TrainingSetup,
    edited: Pictures,
    between: StrengthSource | None,
    options: TrainingViewOptions,
    log: RunLog,
    field: FieldOptions,
    carry_on: CarryRequest | None = None,
) -> ColorPlan:
    """Solve for the finished edit, then choose the model size and the strengths to solve for next.

    Args:
        optimization: fully resolved options, see `resolve_kind`
        setup: scene, region, and views whose boxes hold the edit
        edited: strength → the whole edited views
        between: source of further strengths; None: only those of `edited`
        options: view options. Changed pictures require `make_tied_solver`. If the number of views is open,
            only every other view is used, provided that the remaining error is not visible
        log: log of the run
        field: quality of the model, and the error that it may have
        carry_on: request for the parts that no picture shows; without effect if there are many views
    """
    few = bool(options.pictures)
    engine = "cpu" if few else optimization.engine  # ties between neighbors are sparse matrices of scipy
    device = engine_device(engine)
    if device.type != "cpu":
        log.say(f"{engine} weighs the Gaussians, and colors are solved for, on {_device_name(device)}")
    scene = setup.scene.to(device)
    members = setup.region.members
    count = len(setup.train)
    original = pack(scene[members.to(device)], with_shN=scene.sh_degree > 0)
    stride = 1 if few else pixel_stride(setup)
    max_iterations = iterations(optimization.steps)
    held_out = split_held_out(setup.held_out)[0] if len(edited[1.0]) > count else []
    train = setup.train
    judging = held_out or setup.train

    def draw(views: Sequence[View]) -> list[ColorView]:
        if engine == "cpu":
            return draw_color_views(scene, members, views, setup.background, original, stride)
        make = partial(crop_scene, scene, members, background=setup.background, engine=engine)
        return color_views(LazySequence(views, lambda v: make(v.camera, v.box)), original, stride)

    def judge(pictures: Sequence[Tensor]) -> ColorEvaluator:
        return ColorEvaluator(aside, boxed_pictures(pictures, judging, engine))

    def target(s: float, pictures: Sequence[Tensor]) -> Target:
        stage = TargetStage(s, boxed_pictures(pictures, train, engine), 1)
        return stage, judge(split_held_out(pictures[len(train) :])[0] if held_out else pictures)

    def ask(strengths: Sequence[float]) -> list[Target]:
        edits = between.edit(strengths, [*train, *setup.held_out]) if between is not None else edited
        return [target(s, edits[s]) for s in strengths]

    with log.stage("weights"):
        drawn = draw(train)
        aside = draw(held_out) if held_out else drawn
    decision = None
    with log.stage("model"):
        finished = target(1.0, edited[1.0])
        targets = finished[0].targets
        if few:
            solver, decision = make_tied_solver(
                carry_on or CarryRequest(), setup, drawn, targets, edited[1.0], log.say
            )
        else:
            solver = make_solver(drawn, original)
        trial = split_solver(solver, targets) if few else (solver, finished[1])
        solver, model = choose_model(
            solver, trial, targets, max_iterations, 1 if optimization.sh == "off" else 9, field.quality
        )
        if model.error <= LEVEL and held_out and between is not None and not options.views:
            half_target = replace(finished[0], targets=targets[::2]), finished[1]
            fewer = solve_again(model, make_solver(drawn[::2], original), targets[::2], half_target[1])
            if fewer[1].error <= LEVEL:
                (solver, model), finished, train = fewer, half_target, train[::2]
    strengths = [s for s in edited if s < 1.0]
    if not strengths and between is not None:
        strengths = [0.5]
    look = None if between is None else cache(lambda s: judge(between.look(s, judging)))
    course = StrengthSchedule(ask(strengths), finished, look, ask)
    with log.stage("model"):
        middle = len(course.targets) // 2 if between is None else 0
        allowed_error = 0.0 if field.target_psnr is None else 10 ** (-field.target_psnr / 10)
        both = [*course.targets[middle : middle + 1], finished]
        model = thin_model(model, solver, both, max_iterations, allowed_error)
    evaluated_on = "held-out views" if held_out else "all views, as none is held out"
    if len(train) < count:
        log.say(f"solving for {len(train)} of {count} views; the others would make no visible difference")
    if few:
        evaluated_on = "held-out squares of the pictures"
    log.say(f"{model.line}, on {evaluated_on}")
    return ColorPlan(solver.only(model.residual), model, course, decision)


def _device_name(device: torch.device) -> str:
    """Return the name of the GPU for the log."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "the CPU instead of a GPU"


def pixel_stride(setup: TrainingSetup) -> int:
    """Return the stride over the views' pixels for the solver, see `color_views`: the largest with enough
    pixels."""
    degree = min(2, setup.scene.sh_degree)  # degree of the residual
    # the bands that half a sphere of directions can determine
    unknowns = (degree + 1) * (degree + 2) // 2 * len(setup.region)
    region_pixels = sum(int((view.mask > 0.0).sum()) for view in setup.train)
    return next((stride for stride in (4, 2) if region_pixels >= stride * _PIXELS_PER_UNKNOWN * unknowns), 1)


def _solve(plan: ColorPlan, most_steps: int, folder: StateFolder, log: RunLog) -> Optimized:
    """Solve for colors over all views at once."""
    solver = plan.solver
    model = plan.model
    course = plan.course
    state = PgsState(solver.original)
    recordings = Recordings(folder, solver.original.shape, model)
    solve_course = partial(solve, solver, model, course, recordings.made, state, steps=most_steps)
    max_stages = len(course.targets) + 1 if course.look is None else MAX_STAGES
    snapshots = _record_snapshots(solve_course, max_stages, state, recordings, None, folder, log)
    strengths, snapshots = course.sort_recordings(snapshots)
    trajectory = record(snapshots, state.average.detach().cpu(), strengths)
    maps = torch.stack([one.table for one in snapshots if one.table is not None])
    step_counts = [int(one.means[STEPS]) for one in snapshots if STEPS in one.means]
    rows = [
        (one.step, {name: mean for name, mean in one.means.items() if name != STEPS}) for one in snapshots
    ]
    steps = f"in {', '.join(map(str, step_counts))} steps (at most {most_steps} each)"
    effort_text = steps if step_counts else "by color maps alone"
    log.say(f"solved {format_count(len(strengths), 'strength')} {effort_text}")
    effort = {
        "strengths": strengths,
        STEPS: step_counts,
        "most_steps": most_steps,
        "views": len(solver.views),
    }
    mask = None if model.mask is None else model.mask.cpu()
    trajectory = replace(trajectory, maps=maps, bands=model.bands, mask=mask)
    if plan.carry_on is not None:
        effort["carry_on"] = plan.carry_on.figures()
    return trajectory, loss_table(rows), effort | model.figures()


def _stages(optimization: OptimizeOptions, setup: TrainingSetup, edited: Pictures) -> list[TargetStage]:
    """Return the stages, one per strength, with their steps: twice as many for the last, at strength 1."""
    steps = max(optimization.steps, len(edited) + 1)  # at least one step per stage
    marks = [*(steps * i // (len(edited) + 1) for i in range(len(edited))), steps]
    return [
        TargetStage(s, boxed_pictures(pictures, setup.train, optimization.engine), end - begin)
        for (s, pictures), (begin, end) in zip(edited.items(), pairwise(marks), strict=True)
    ]


def _crops(setup: TrainingSetup, still: bool, engine: str) -> list[CropScene]:
    scene = setup.scene.to(engine_device(engine))
    members = setup.region.members
    make = partial(crop_scene, scene, members, background=setup.background, still=still, engine=engine)
    return [make(view.camera, view.box) for view in setup.train]


def _record_snapshots(
    way: Callable[[OnStep], Iterator[ParameterSnapshot]],
    steps: int,
    state: PgsState,
    recordings: Recordings,
    joint: JointTraining | None,
    folder: StateFolder,
    log: RunLog,
) -> Sequence[ParameterSnapshot]:
    """Run the optimization from the saved state to its end, together with a jointly trained network.

    `way`: optimizes from the saved state, and yields recordings

    Returns:
        All recordings.
    """
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
            if step > saved_at:  # nothing new to save within a step
                saver.step_done()
                saved_at = step

        advance(state.step, "")  # for a small number of pictures most work comes before the first step
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
    distances = [made.means["left"] for made in recordings.made]
    log.say(f"L1 to the finished edit: {distances[0]:.4f} at first, {distances[-1]:.4f} at the end")
    log.say(f"saved the state {format_count(saver.saves, 'time')} in {saver.seconds:.2f} s")
    return recordings.made


def _groups(
    optimization: OptimizeOptions,
    original: Tensor,
    crops: Sequence[CropScene],
    stages: Sequence[TargetStage],
    folder: StateFolder,
    log: RunLog,
) -> Groups:
    """Run the group stage, or restore it from the saved state."""
    saved = folder.load("groups")
    if saved is not None:
        return restore_groups(original, saved.tensors)
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


def _make_or_load_seeds(
    setup: TrainingSetup, optimization: OptimizeOptions, edited: Pictures, folder: StateFolder
) -> Gaussians | None:
    """Return the rows to add, made now or restored from the saved state; None if there are none."""
    saved = folder.load("seeds")
    finished = edited[max(edited)]
    if saved is None:
        count = int(optimization.grow * len(setup.region))
        seeds = seed_rows(setup, setup.train, finished[: len(setup.train)], count, optimization.seed)
        saved = Saved({name: getattr(seeds, name) for name in ATTRIBUTES}, {})
        folder.save("seeds", saved.tensors, saved.values)
    rows: dict[str, Any] = dict(saved.tensors)
    return Gaussians(**rows) if len(rows["means"]) else None


def retime_trajectory(
    trajectory: Trajectory, setup: TrainingSetup, slider: Slider, cleans: bool, log: RunLog
) -> Trajectory:
    """Remove jitter and assign slider values by the visible change. Every recording is rendered once.

    Args:
        trajectory: the recordings
        setup: scene, region, views
        slider: meaning of slider values
        cleans: remove jitter
        log: log of the run
    """
    moving = moving_attributes(trajectory.end)
    probes = probe_views(setup, _TIMED_VIEWS, still=only_recolors(trajectory.offsets))
    original = pack(setup.scene[setup.region.members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    pictures: list[Tensor] = []
    with log.steps("time the slider", len(trajectory)) as advance:
        for i in range(len(trajectory)):
            images = render_all(probes, original + trajectory.node(i), moving)
            pictures.append(torch.cat([image.flatten() for image in images]))
            advance(i + 1, "recordings")
    if cleans and trajectory.maps is None:
        nodes = straight_recordings(trajectory, pictures)
        trajectory = select_recordings(trajectory, nodes)
        pictures = [pictures[i] for i in nodes]
    return retime(trajectory, pictures, slider)
