"""Recorded edits for `python -m benchmarks field --runs`: what a finished run left, as a course to follow."""

from __future__ import annotations

from pathlib import Path

import torch

from progdf.field import FieldJudge
from trainer.fit.fit import visibility
from trainer.pipeline.fit_and_report import kept_judge
from trainer.pipeline.reopen import its_views, reopened

from .courses import KnownCourse

LOOKED, JUDGED = 3, 2
"""Training views that fields are chosen on, held-out views that they are judged in."""


def recorded_course(root: Path) -> KnownCourse:
    """The edit of a run folder; its truth is the recording, straight from one snapshot to the next.

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    run = reopened(root)
    stand, trajectory = its_views(run), run.trajectory
    few = stand.train[:: max(1, len(stand.train) // LOOKED)][:LOOKED]
    look, judge = (
        kept_judge(run.folder, stand, views, trajectory).counted for views in (few, stand.held_out[:JUDGED])
    )
    offsets = torch.stack([trajectory.node(i) for i in range(len(trajectory))])
    return KnownCourse(
        f"{run.region.name} (recorded)",
        run.scene,
        run.region.members,
        trajectory.s,
        offsets,
        trajectory.at,
        FieldJudge(trajectory.s, offsets, judge),
        look,
        visibility(run.scene, run.region.members, stand.train),
        judge,
    )
