"""Recorded edits of finished runs as known trajectories, for `python -m benchmarks networks --runs`."""

from __future__ import annotations

from pathlib import Path

from progdf.field import FieldEvaluator
from trainer.fit.fit import visibility
from trainer.run.finish import load_evaluator
from trainer.run.record import render_run_views, reopen_run
from trainer.views.choose import split_held_out

from .courses import KnownTrajectory

LOOKED = 3  # training views on which ranks are chosen
JUDGED = 2  # held-out views for the choice, and as many others for the evaluation


def recorded_edit(root: Path) -> KnownTrajectory:
    """Load the edit of a run folder; its truth is the recording, interpolated linearly between snapshots.

    Raises:
        ProgdfError: the folder is not a finished run, or its scene is missing or differs.
    """
    run = reopen_run(root)
    setup = render_run_views(run)
    trajectory = run.trajectory
    rank_views = setup.train[:: max(1, len(setup.train) // LOOKED)][:LOOKED]
    choosing, reporting = split_held_out(setup.judging)
    look, chooser, judge = (
        load_evaluator(run.folder, setup, views, trajectory).counted_pixels
        for views in (rank_views, choosing[:JUDGED], reporting[:JUDGED])
    )
    offsets = trajectory.nodes
    return KnownTrajectory(
        name=f"{run.region.name} (recorded)",
        scene=run.scene,
        members=run.region.members,
        strengths=trajectory.s,
        offsets=offsets,
        truth=trajectory.at,
        judge=FieldEvaluator(trajectory.s, offsets, judge),
        chooser=FieldEvaluator(trajectory.s, offsets, chooser),
        look=look,
        weights=visibility(run.scene, run.region.members, setup.train),
        unseen=judge,
    )
