"""The benchmark `networks`: fully trained networks compared with the shipped field.

A network is trained on the recorded offsets like a network of the same size in `progdf fit --field neural`.
Its own output and its baked field are both evaluated and timed. Trained networks are saved in RUN/networks,
so that an interrupted benchmark resumes.

    python -m benchmarks networks --runs RUN …
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch

from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.errors import ProgdfError
from progdf.field import (
    BakedField,
    NeuralField,
    NeuralSettings,
    bake_network,
    choose_field,
    fit_keyframes,
)
from progdf.field.baked import NeuralForm
from progdf.field.neural_fit import NeuralFit, rendered_importance, train_network
from progdf.field.separable import moving_attributes
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import Gdf, load_gdf, save_gdf
from progdf.io.atomic import make_folder
from progdf.rasterize import set_threads
from progdf.terminal import group_digits
from trainer.fit.fit import stored_numbers

from .courses import KnownTrajectory, edit_of, processor_milliseconds
from .recorded_runs import recorded_edit
from .table import Table, mean_worst

NETWORKS: Mapping[str, NeuralSettings] = {
    "tiny": NeuralSettings("tiny"),
    "small": NeuralSettings("small"),
    "paper's 6 M, hard bins": NeuralSettings("paper", "position", bins="hard"),
    "paper's 6 M, smooth bins": NeuralSettings("paper", "position"),
}

MAX_TRAINING_S = 600.0
"""Largest processor time for training a network, seconds; others are timed untrained."""

ROUNDS = 15
"""Number of timed slider steps."""


NOTE = (
    "PSNR against the recording, at 13 slider values, in held-out views not used for any choice, over the "
    "pixels that show the region or that the edit changes. A training step samples all members, at most "
    "2048 (6 M: 1024). Networks that would train for more than ten minutes on one core are timed untrained. "
    f"ms: median processor time of {ROUNDS} slider steps on one thread, all fields in turns. Network "
    "itself: evaluation of the network only; baked: a step of the viewer with all new attributes. The "
    "paper gives 20 ms on a V100 for its own network, which cannot be checked here."
)


@dataclass(frozen=True)
class TrainedNetwork:
    """One network of one edit."""

    network: NeuralField  # in stored form
    baked: BakedField  # form that the viewer evaluates
    steps: int  # training steps; 0 if the training would take too long
    seconds: float  # processor time of these steps


def tables(runs: Sequence[Path] = ()) -> list[Table]:
    """Evaluate networks on the recorded edits of finished runs.

    Raises:
        ProgdfError: no run is named, or one is not finished.
    """
    if not runs:
        raise ProgdfError("networks are trained on finished runs; name some with --runs")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    set_threads(1)
    try:
        rows = [row for run in runs for row in _rows(run, recorded_edit(run))]
    finally:
        torch.set_num_threads(before)
        set_threads(None)
    return [Table.of("networks", "Networks, trained to the end", rows, NOTE)]


def _rows(run: Path, course: KnownTrajectory) -> list[dict[str, str]]:
    before = pack(course.scene[course.members])
    make_folder(run / "networks")
    baked: dict[str, BakedField] = {}
    seconds: dict[str, float] = {}
    begin = time.process_time()
    baked["2 keyframes"] = fit_keyframes(course.strengths, course.offsets, 2)
    seconds["2 keyframes"] = time.process_time() - begin
    begin = time.process_time()
    best = choose_field(
        course.strengths, course.offsets, course.look, course.weights, evaluator=course.chooser
    ).best
    baked["auto"] = best.field
    seconds["auto"] = time.process_time() - begin
    networks = {name: _trained(run, name, settings, course) for name, settings in NETWORKS.items()}
    baked |= {name: found.baked for name, found in networks.items()}
    seconds |= {name: found.seconds for name, found in networks.items()}
    asked = {name: found.network.bind(before) for name, found in networks.items()}
    works: dict[str, Callable[[float], object]] = {
        f"{name}, baked": _composed(course.scene, edit_of(course.scene, course.members, field))
        for name, field in baked.items()
    }
    works |= {name: bound.offsets for name, bound in asked.items()}
    ms = turns_ms(works)

    rows: list[dict[str, str]] = []
    for name, field in baked.items():
        network = networks.get(name)
        trained = network is None or network.steps > 0
        step = ms.get(name)
        composed = ms[f"{name}, baked"]
        count = network.network.parameters if network else stored_numbers(field)
        rows.append(
            {
                "edit": f"{course.name}, {len(course.members)} members",
                "field": f"auto at 40 dB: {best.label}" if name == "auto" else name,
                "numbers": group_digits(count),
                "bytes a Gaussian, no header": f"{field.bytes_per_member:.0f}",
                "steps": str(network.steps) if network and trained else "-",
                "processor s to fit": f"{seconds[name]:.1f}" if trained else "-",
                "network itself: mean / worst, dB": mean_worst(course.judge.curve(asked[name]))
                if network and trained
                else "-",
                "baked: mean / worst, dB": mean_worst(course.judge.curve(field)) if trained else "-",
                "network itself: ms a slider step": "-" if step is None else f"{step:.2f}",
                "µs a Gaussian": "-" if step is None else f"{1e3 * step / len(course.members):.1f}",
                "baked: ms a slider step": f"{composed:.3f}",
                "network / baked": "-" if step is None else f"{step / composed:.0f}×",
            }
        )
    return rows


def _trained(run: Path, name: str, settings: NeuralSettings, course: KnownTrajectory) -> TrainedNetwork:
    """Return the network of that name from the run's folder, or train it."""
    path = run / "networks" / f"{name.replace(', ', '-').replace(' ', '-')}.gdf"
    before = pack(course.scene[course.members])
    members = len(course.members)
    effort = settings.resolve()
    settings = replace(effort, batch=min(effort.batch, members))
    if not path.is_file():
        total_seconds = _step_seconds(course, settings) * settings.steps
        if total_seconds > MAX_TRAINING_S:
            fit = _begin(course, settings)
            return TrainedNetwork(fit.field(), bake_network(fit.field(), before), 0, total_seconds)
        begin = time.process_time()
        fit = _begin(course, settings)
        train_network(fit, course.strengths, course.offsets, settings.steps)
        network = fit.field(tuple(course.strengths.tolist()))
        effort_report = {"steps": settings.steps, "seconds": round(time.process_time() - begin, 1)}
        trained = edit_of(course.scene, course.members, bake_network(network, before, course.truth))
        save_gdf(path, replace(trained, name=name, report=effort_report))
    saved = load_gdf(path, course.scene)
    assert isinstance(saved.field.origin, NeuralForm)
    return TrainedNetwork(
        saved.field.origin.network, saved.field, saved.report["steps"], saved.report["seconds"]
    )


def _begin(course: KnownTrajectory, settings: NeuralSettings) -> NeuralFit:
    before = pack(course.scene[course.members])
    moving = tuple(moving_attributes(course.offsets))
    channels = course.offsets.shape[2]
    fit = NeuralFit(before, channels, moving, settings, course.weights)
    fit.scale_to(course.offsets, rendered_importance(course.offsets, course.look))
    return fit


def _step_seconds(course: KnownTrajectory, settings: NeuralSettings) -> float:
    """Measure the processor time of one training step, seconds."""
    fit = _begin(course, settings)
    fit.step(course.strengths, course.offsets)
    begin = time.process_time()
    fit.step(course.strengths, course.offsets)
    return time.process_time() - begin


def _composed(scene: Gaussians, edit: Gdf) -> Callable[[float], object]:
    """Return a function that composes all attributes at a strength, like a slider step of the viewer."""
    composer = Composer(scene, [edit])
    return lambda s: composer.update([Layer(edit, s)])


def turns_ms(works: Mapping[str, Callable[[float], object]]) -> dict[str, float]:
    """Measure the median processor time of each function over changing strengths, in turns, ms."""
    times: dict[str, list[float]] = {name: [] for name in works}
    for i in range(ROUNDS + 1):
        s = 0.03 + 0.9 * i / ROUNDS
        for name, work in works.items():
            times[name].append(processor_milliseconds(partial(work, s)))
    return {name: statistics.median(found[1:]) for name, found in times.items()}
