"""Benchmarks with scenes and repetitions small enough for a test; all else is unchanged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from benchmarks import edits as run_edits
from benchmarks import field, rasterizer, table, training
from benchmarks.ablation import regret, setup
from benchmarks.analytic_warps import column_warps
from benchmarks.colors import grading, packing, stages
from benchmarks.editors import ideal_editors
from benchmarks.files import exports
from benchmarks.layers import gains, paint_order, pull_parts, pull_stages
from benchmarks.motion import trained_motion, warps
from benchmarks.motion.trained_motion import PullCase
from benchmarks.rasterizer import RasterCase
from benchmarks.viewer import frames, moving, painting, popping, pull_response, scenes, slider, window
from benchmarks.viewer.slider import SliderCase
from benchmarks.viewer.training import begin_training
from progdf.field import NeuralSettings
from tests.helpers import demo_scenes, drawn
from trainer.evaluate.suite.edits import SUITES
from trainer.options import TrainingViewOptions
from trainer.run import demo
from trainer.run.demo import Effort

PICTURE = (240, 200)  # pixels
SMALL_TRAINING = ("--views", "5", "--image-size", "48")


def shrink_benchmarks(patch: pytest.MonkeyPatch) -> None:
    """Make every benchmark take seconds."""
    patch.setattr(table, "_SPIN_S", 0.01)
    patch.setattr(exports, "DEMO_GAUSSIANS", 700)
    patch.setattr(packing, "MEMBERS", 700)
    patch.setattr(packing, "SIDE", 48)
    _shrink_editors(patch)
    patch.setattr(stages, "OPTIONS", ("--views", "5", "--image-size", "48", "--steps", "24", "--stages", "2"))
    patch.setattr(stages, "compile_kernels", lambda options: None)
    _shrink_training(patch)
    _shrink_layers(patch)
    _shrink_viewer(patch)
    _shrink_rasterizer(patch)


def _shrink_editors(patch: pytest.MonkeyPatch) -> None:
    """Measure one family of edits and one way of calling the model."""
    patch.setattr(ideal_editors, "WAYS", ideal_editors.WAYS[-2:-1])
    patch.setattr(ideal_editors, "FAMILIES", {"hue": ideal_editors.FAMILIES["hue"]})
    patch.setattr(ideal_editors, "GAUSSIANS", 700)
    patch.setattr(ideal_editors, "VIEWS", 8)
    patch.setattr(ideal_editors, "SIZE", 40)
    patch.setattr(ideal_editors, "CHOICES", 3)
    patch.setattr(ideal_editors, "SEEDS", (0, 10))


def shrink_demo(patch: pytest.MonkeyPatch) -> None:
    """Make `progdf demo --quick` take seconds, whatever its size is."""
    for name, plan in demo.SHOWS.items():
        small = replace(
            plan,
            make=lambda _, seed, make=plan.make: make(1500, seed),
            draft=Effort(views=4, image_size=48, steps=32),
        )
        patch.setitem(demo.SHOWS, name, small)


def shrink_field(patch: pytest.MonkeyPatch) -> None:
    """Make `python -m benchmarks field` take seconds."""
    patch.setattr(training, "BEAR", 700)
    patch.setattr(regret, "TrainingViewOptions", partial(TrainingViewOptions, views=8, image_size=48))
    patch.setattr(field, "STEPS", 2)
    patch.setattr(field, "TARGETS", (30.0,))
    patch.setattr(field, "MOVING", 700)
    patch.setattr(field, "SIDE", 48)
    patch.setattr(field, "SNAPSHOTS", 5)
    patch.setattr(field, "NETWORK", NeuralSettings("tiny", steps=3))
    patch.setattr(field, "CLOUDS", ((30, 300),))


def _shrink_training(patch: pytest.MonkeyPatch) -> None:
    shrink_field(patch)
    for module in (training, field):
        patch.setattr(module, "tasks", _last_task)
    patch.setattr(training, "OPTION_SETS", ("--quick --views 5 --image-size 48 --stages 2 --threads 1",))
    patch.setattr(run_edits, "VALUES", 3)
    patch.setattr(run_edits, "ASKED", 2)
    patch.setattr(warps, "STEPS", 32)
    patch.setattr(warps, "VIEWS", 5)
    patch.setattr(warps, "SIZE", 48)
    patch.setattr(warps, "_BEAR_GAUSSIANS", 700)
    patch.setattr(warps, "_STYLE", "tint:#c08040")
    patch.setattr(warps, "GROUP_STEPS", 10)
    patch.setattr(warps, "column_warps", lambda *given: dict([*column_warps(*given).items()][:1]))
    patch.setattr(trained_motion, "STEPS", 32)
    patch.setattr(trained_motion, "VIEWS", 5)
    patch.setattr(trained_motion, "SIZE", 48)
    patch.setattr(trained_motion, "_BEAR_GAUSSIANS", 700)
    for cases in ("bear_pulls", "_scene_pulls"):
        patch.setattr(trained_motion, cases, _first_of(getattr(trained_motion, cases)))
    patch.setattr(pull_parts, "PULLS", [pull for pull in pull_parts.PULLS if pull.name == "nose"])
    patch.setattr(pull_parts, "BEAR_GAUSSIANS", 1500)
    patch.setattr(pull_parts, "SIZE", 48)
    patch.setattr(regret, "STAGES", (2,))
    patch.setattr(regret, "STEPS", (2, 3))
    patch.setattr(regret, "BANDS", (0, 1))
    patch.setattr(regret, "VIEWS", (6,))
    patch.setattr(setup, "QUICK_STEPS", 4)
    patch.setattr(setup, "QUICK_STAGES", 2)
    patch.setattr(setup, "QUICK_VIEWS", 4)
    shrink_suite(patch)


def shrink_suite(patch: pytest.MonkeyPatch) -> None:
    """Make `progdf evaluate --suite sliders` take seconds: one edit of a small bear, without the paper."""
    whole = SUITES["sliders"]
    small = replace(
        whole,
        edits=whole.edits[:1],
        sizes={"bear": 1000},
        effort=Effort(views=6, image_size=48, steps=32),
        methods=("field", "keyframes", "matrix"),
    )
    patch.setitem(SUITES, "sliders", small)  # type: ignore[misc]


_tasks = training.tasks


def _last_task(folder: Path, scenes: Sequence[Path] = ()) -> list[training.TrainingTask]:
    """Return the task of the last given scene, or that of the bear if there is none."""
    return _tasks(folder, scenes[-1:])[-1:]


def _first_of(cases: Callable[..., list[PullCase]]) -> Callable[..., list[PullCase]]:
    """Return the function limited to its first case."""
    return lambda *given: cases(*given)[:1]


def _shrink_layers(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(gains, "COUNTS", (300,))
    patch.setattr(gains, "STEPS", 3)
    patch.setattr(paint_order, "SIDE", 60)
    patch.setattr(paint_order, "DISCS", 30)
    patch.setattr(paint_order, "STEPS", 3)
    patch.setattr(pull_stages, "CASES", ((300, 60),))
    patch.setattr(pull_stages, "STEPS", 3)
    patch.setattr(pull_stages, "_REPEATS", 1)


def _shrink_viewer(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(scenes, "SIZES", (600,))
    patch.setattr(slider, "CASES", (SliderCase(100, True),))
    patch.setattr(slider, "rows", partial(slider.rows, steps=2, size=PICTURE))
    patch.setattr(frames, "measure_turning", partial(frames.measure_turning, steps=2, size=PICTURE))
    patch.setattr(frames, "measure_starts", _measure_one_start(frames.measure_starts))
    patch.setattr(moving, "MILLION", 600)
    patch.setattr(frames, "MAX_COPIED", 0)
    patch.setattr(pull_response, "MEMBERS", (200,))
    patch.setattr(pull_response, "EVENTS", 2)
    patch.setattr(pull_response, "WARM_UP", 1)
    patch.setattr(pull_response, "SIZE", PICTURE)
    patch.setattr(moving, "TRAINED", 600)
    patch.setattr(moving, "begin_training", lambda scene: begin_training(scene, *SMALL_TRAINING))
    patch.setattr(moving, "_SETTLE_S", 0.05)
    patch.setattr(moving, "measure", partial(moving.measure, steps=2, size=PICTURE))
    patch.setattr(painting, "DABS", 3)
    patch.setattr(painting, "TURNS", 2)
    patch.setattr(painting, "_REST_S", 0.2)
    patch.setattr(painting, "measure", partial(painting.measure, size=PICTURE))
    patch.setattr(grading, "WARM_UP", 2)
    patch.setattr(grading, "measure", partial(grading.measure, steps=4))
    patch.setattr(popping, "FRAMES", 3)
    patch.setattr(popping, "room", lambda count: demo_scenes.room(1000))
    patch.setattr(popping, "film", partial(popping.film, size=PICTURE))
    patch.setattr(window, "SETTLED_S", 0.2)
    patch.setattr(window, "MEMBERS", 100)
    patch.setattr(window, "idle", partial(window.idle, wall_s=0.2))


_STARTS: list[frames.Start] = []


def _measure_one_start(measure: Callable[..., frames.Start]) -> Callable[..., frames.Start]:
    """Return a `measure_starts` that opens one window per process, as each takes some seconds."""

    def measure_once(path: Path, way: str) -> frames.Start:
        if not _STARTS:
            _STARTS.append(measure(path, way, times=1, size=(460, 400)))
        return _STARTS[0]

    return measure_once


def _shrink_rasterizer(patch: pytest.MonkeyPatch) -> None:
    cases = (RasterCase(60, 32), RasterCase(90, 40, baseline=False))
    patch.setattr(rasterizer, "CASES", cases)
    patch.setattr(rasterizer, "WARP_CASES", cases[:1])
    patch.setattr(rasterizer, "STEP_CASE", RasterCase(60, 40))
    patch.setattr(rasterizer, "measure", partial(rasterizer.measure, rounds=1, torch_rounds=1))
    patch.setattr(rasterizer, "list_table", partial(rasterizer.list_table, rounds=1))
    hard = {name: drawn.CASES[name] for name in ("no gaussians", "equal depths")}
    patch.setattr(drawn, "CASES", hard)
