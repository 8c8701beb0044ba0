"""A finished run opened for measuring: its shipped field, its held-out views and the compared contenders."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.compose.added import extend
from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory
from progdf.gdf.file import Gdf, load_gdf
from progdf.io.json_values import convert_json, decode_json
from progdf.metrics.slider import Pictures
from trainer.fit.evaluate import Evaluator
from trainer.fit.keyframes import TwoKeyframes, closest_keyframes
from trainer.run.finish import load_evaluator
from trainer.run.record import FinishedRun, render_edited_views, reopen_run
from trainer.views.setup import TrainingSetup

SLIDER = "slider"
"""Contender: the shipped field."""
KEYFRAMES = "2 keyframes"
"""Contender: a straight line to the full edit, raw or in OKLab, the closer one, with a uniform slider if the
run's is uniform (`closest_keyframes`)."""
FADE = "cross-fade"
"""Contender: a cross-fade in sRGB between the pictures of both ends."""


@dataclass(frozen=True)
class RunTime:
    """Durations of a run, seconds."""

    total: float | None = None  # over all its sessions


@dataclass(frozen=True)
class RunTrajectory:
    """The trajectory of a run."""

    slider: str = ""  # "even", "stages" or "time", see `resolve_slider`


@dataclass(frozen=True)
class RunFigures:
    """The parts of a run's report.json that an evaluation needs; all of them may be absent."""

    time: RunTime = RunTime()
    memory_mb: float | None = None  # peak
    trajectory: RunTrajectory = RunTrajectory()


@dataclass(frozen=True)
class OpenedRun:
    """A finished run with everything needed to measure it."""

    run: FinishedRun  # see `FinishedRun`
    report: Mapping[str, Any]  # its report.json
    figures: RunFigures  # the checked parts of report.json
    setup: TrainingSetup  # its views; the boxes of the training views contain the changes of the edit
    evaluator: Evaluator  # its held-out views, with the editor's pictures of them
    gdf: Gdf  # the shipped edit
    trajectory: Trajectory  # the recording, on the shipped slider
    keyframes: TwoKeyframes  # the baseline `KEYFRAMES`

    def contenders(self) -> dict[str, Pictures]:
        """Return for each contender a function from slider value to the held-out views' boxes."""
        field = self.gdf.field
        keyframes = self.keyframes
        first, last = (self.evaluator.pictures(field.offsets(s)) for s in (0.0, 1.0))

        def fade(s: float) -> list[Tensor]:
            return [torch.lerp(a, b, s) for a, b in zip(first, last, strict=True)]

        pictures_of = self.evaluator.course
        return {SLIDER: pictures_of(field), KEYFRAMES: pictures_of(keyframes), FADE: fade}


def open_run(root: Path, scene: Path | None = None) -> OpenedRun:
    """Open a run folder to measure it.

    Args:
        root: the folder
        scene: new path of the scene, if it has moved

    Raises:
        ProgdfError: the folder is not a finished run, or one of its files or the scene is missing or damaged.
    """
    run = reopen_run(root, scene)
    try:
        report = convert_json(decode_json(run.folder.report.read_bytes()), dict[str, Any])
        figures = convert_json(report, RunFigures)
    except FileNotFoundError:
        raise ProgdfError(f"{root} holds no report.json; give a folder that progdf train finished") from None
    except ValueError as error:
        raise ProgdfError(f"{run.folder.report} is damaged ({error}); run progdf fit {root}") from error
    gdf = load_gdf(run.folder.gdf(run.record.plan.name), run.scene)
    setup = render_edited_views(run)
    if not setup.train:
        raise ProgdfError(f"{root} has no views to measure with; train it again")
    shown_at = torch.tensor(gdf.field.recorded, dtype=torch.float32)
    if shown_at.shape != run.trajectory.s.shape:
        raise ProgdfError(f"{gdf.name}.gdf does not match the recording beside it; run progdf fit {root}")
    trajectory = replace(run.trajectory, s=shown_at)
    evaluator = load_evaluator(run.folder, setup, setup.judging, run.trajectory, gdf)
    extended, (gdf,) = extend(run.scene, [gdf])
    setup = replace(setup, scene=extended, region=gdf.region)
    is_even = figures.trajectory.slider == "even"
    two_keyframes = closest_keyframes(gdf.field, setup, evaluator, trajectory.stage_strengths, is_even)
    return OpenedRun(run, report, figures, setup, evaluator, gdf, trajectory, two_keyframes)
