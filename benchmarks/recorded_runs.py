"""Recorded edits for `python -m benchmarks field --runs`: what a finished run left, as a course to follow."""

from __future__ import annotations

from pathlib import Path

import torch

from progdf.field import FieldEvaluator
from trainer.fit.fit import visibility
from trainer.pipeline.fit_and_report import load_evaluator
from trainer.pipeline.reopen import render_run_views, reopen_run

from .courses import KnownEdit

LOOKED, JUDGED = 3, 2
"""Training views that fields are chosen on, held-out views that they are judged in."""


def recorded_edit(root: Path) -> KnownEdit:
    """The edit of a run folder; its truth is the recording, straight from one snapshot to the next.

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    run = reopen_run(root)
    setup, trajectory = render_run_views(run), run.trajectory
    few = setup.train[:: max(1, len(setup.train) // LOOKED)][:LOOKED]
    look, evaluator = (
        load_evaluator(run.folder, setup, views, trajectory).counted_pixels
        for views in (few, setup.held_out[:JUDGED])
    )
    offsets = torch.stack([trajectory.node(i) for i in range(len(trajectory))])
    return KnownEdit(
        f"{run.region.name} (recorded)",
        run.scene,
        run.region.members,
        trajectory.s,
        offsets,
        trajectory.at,
        FieldEvaluator(trajectory.s, offsets, evaluator),
        look,
        visibility(run.scene, run.region.members, setup.train),
        evaluator,
    )
