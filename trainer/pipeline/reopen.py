"""A finished run, opened again: its scene, region and views as they were, and what was recorded."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import torch

from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory, load_trajectory
from progdf.formats.scene_file import load_scene, scene_file
from progdf.gaussians import Gaussians
from progdf.io.cameras import load_cameras
from progdf.region import Region
from trainer.pipeline.record import RunRecord, read_record
from trainer.setup import TrainingSetup
from trainer.store.run_folder import RunFolder
from trainer.views.view import make_view, with_near_plane


@dataclass(frozen=True)
class FinishedRun:
    """What a finished run left."""

    folder: RunFolder
    scene: Gaussians  # the original
    region: Region  # what was edited
    trajectory: Trajectory  # what was recorded
    record: RunRecord


def reopen_run(root: Path, scene: Path | None = None) -> FinishedRun:
    """Open a run folder.

    Args:
        root: the folder
        scene: where the scene is now, if it has moved

    Raises:
        ProgdfError: the folder is no finished run, or its scene is gone or another.
    """
    folder = RunFolder(root)
    if not folder.trajectory.is_file():
        raise ProgdfError(f"{root} holds no trajectory.safetensors; give a folder that progdf train finished")
    trajectory, extra, about = load_trajectory(folder.trajectory)
    try:
        record = read_record(about)
        members, score = extra["members"], extra["score"]
        path = scene or record.scene
        if not os.path.isfile(scene_file(path)):
            raise ProgdfError(f"the scene {path} does not exist; give its path with --scene")
        gaussians = load_scene(path)
        if len(score) != len(gaussians):
            raise ProgdfError(
                f"{path} has {len(gaussians)} Gaussians, the run's scene had {len(score)}; "
                "give that one with --scene"
            )
        region = Region(record.plan.name, members, score)
        if len(region) != trajectory.end.shape[0]:
            raise ValueError(f"it has {trajectory.end.shape[0]} members, the region {len(region)}")
    except ProgdfError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise ProgdfError(f"{folder.trajectory} is damaged ({error}); train again") from error
    return FinishedRun(folder, gaussians, region, trajectory, record)


def render_run_views(run: FinishedRun) -> TrainingSetup:
    """The run's views, rendered; their boxes hold the region, not what an edit may show beside it."""
    background = torch.tensor(run.record.background)
    held_out = set(run.record.held_out)
    cameras = with_near_plane(load_cameras(run.folder.cameras, run.scene.origin), run.scene)
    views = [make_view(run.scene, run.region, camera, background) for camera in cameras]
    return TrainingSetup(
        run.scene,
        run.region,
        [view for view in views if view.camera.name not in held_out],
        [view for view in views if view.camera.name in held_out],
        background,
    )
