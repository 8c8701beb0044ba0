"""Finished run, opened again: its scene, region, views and recordings."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory, load_trajectory, save_trajectory
from progdf.formats.scene_file import load_scene, scene_file
from progdf.gaussians import Gaussians
from progdf.io.json_values import convert_json, to_json
from progdf.rasterize import activate
from progdf.region import Region
from progdf.threads import map_threads
from trainer.methods import METHODS
from trainer.options import EditKind, TrainOptions
from trainer.resolve import check_name
from trainer.store.progress import RunLog
from trainer.store.run_folder import RunFolder, read_run_cameras, read_views, write_views
from trainer.views.setup import TrainingSetup
from trainer.views.view import View, make_view, render_view, with_near_plane


@dataclass(frozen=True)
class RunRecord:
    """Metadata of a run in its trajectory file.

    Raises:
        ValueError: the losses differ in length, or the name is invalid.
    """

    plan: TrainOptions  # the run's options, see `recorded_options`
    scene: Path  # path of the scene during the run
    held_out: Sequence[str]  # names of the views that the edit was not trained on
    background: tuple[float, float, float]  # color behind the scene
    kind: EditKind  # attributes that move
    group_steps: int  # steps of the stage in which parts move rigidly; 0: there was none
    kind_trial: Mapping[str, Any] | None  # figures of the trial run that chose these two, if there was one
    objective: str  # description of the minimized loss
    losses: Mapping[str, Sequence[float | None]]  # see `Losses`
    attribute_worth_db: Mapping[str, float]  # loss of quality without each attribute, dB
    agreement: Mapping[str, Any] | None  # agreement of the edited views, if measured
    up: Mapping[str, Any] | None  # the up axis, and the reason for it
    effort: Mapping[str, Any] = field(default_factory=dict)  # chosen strengths, steps, model
    pictures: Mapping[str, str] = field(default_factory=dict)  # paths of changed pictures -> their hashes
    lower: str = ""  # layers that the changed pictures show, see `LowerLayers`; "" for none

    def __post_init__(self) -> None:
        columns = [self.losses.get(name, []) for name in ("step", "left")]
        if not all(columns) or len({len(column) for column in self.losses.values()}) > 1:
            raise ValueError("its losses differ in length")
        check_name(self.plan.name)


def read_record(about: Mapping[str, Any]) -> RunRecord:
    """Return the run record in the metadata of a trajectory file.

    Raises:
        ValueError: it is not a record, or damaged.
        ProgdfError: the run is of a version that recorded the paper's preset as options.
    """
    optimize = about.get("plan", {}).get("optimize", {}) if isinstance(about.get("plan"), Mapping) else {}
    if isinstance(optimize, Mapping) and optimize.get("as_printed"):
        raise ProgdfError(
            "the run was trained by an older version with --preset paper, which cannot be read any more; "
            "train it again"
        )
    return convert_json(about, RunRecord)


def save_recording(folder: RunFolder, region: Region, trajectory: Trajectory, record: RunRecord) -> None:
    """Write the trajectory file of a run: recordings, region and record."""
    extra = {"members": region.members, "score": region.score}
    save_trajectory(folder.trajectory, trajectory, extra, to_json(record))


def load_recording(folder: RunFolder) -> tuple[Trajectory, RunRecord]:
    """Return the recordings and the record of a run's trajectory file."""
    trajectory, _, about = load_trajectory(folder.trajectory)
    return trajectory, read_record(about)


@dataclass(frozen=True)
class FinishedRun:
    """Content of a finished run's folder."""

    folder: RunFolder
    scene: Gaussians  # the original
    region: Region  # the edited region
    trajectory: Trajectory  # the recordings
    record: RunRecord


def reopen_run(root: Path, scene: Path | None = None) -> FinishedRun:
    """Open a run folder.

    Args:
        root: the folder
        scene: current path of the scene, if it has moved

    Raises:
        ProgdfError: the folder is not a finished run, its scene is missing or different, or it was trained
            over other layers.
    """
    folder = RunFolder(root)
    if not folder.trajectory.is_file():
        raise ProgdfError(
            f"{root} holds no trajectory.safetensors; give a folder that progdf train finished "
            "(removals and decals have no trajectory)"
        )
    trajectory, extra, about = load_trajectory(folder.trajectory)
    try:
        record = read_record(about)
        if record.lower:
            raise ProgdfError(
                f"{root} was trained over other layers ({record.lower}), so it cannot be fitted or evaluated "
                "alone; train it again"
            )
        members = extra["members"]
        score = extra["score"]
        path = scene or record.scene
        if not os.path.isfile(scene_file(path)):
            raise ProgdfError(f"the scene {path} does not exist; give its path with --scene")
        gaussians = load_scene(path)
        if len(score) != len(gaussians):
            raise ProgdfError(
                f"{path} has {len(gaussians)} Gaussians, the run's scene had {len(score)}; "
                "give the run's scene with --scene"
            )
        region = Region(record.plan.name, members, score)
        rows = len(region) + (0 if trajectory.added is None else len(trajectory.added))
        if rows != trajectory.end.shape[0]:
            raise ValueError(f"it has {trajectory.end.shape[0]} members, the region {rows}")
    except ProgdfError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise ProgdfError(f"{folder.trajectory} is damaged ({error}); train again") from error
    return FinishedRun(folder, gaussians, region, trajectory, record)


def render_run_views(run: FinishedRun) -> TrainingSetup:
    """Render the run's views. Their boxes contain the region, but not the edit's changes outside of it.

    Raises:
        ProgdfError: cameras.json does not match the run's pictures, see `read_run_cameras`.
    """
    background = torch.tensor(run.record.background)
    held_out = set(run.record.held_out)
    found = read_run_cameras(run.folder, run.record.held_out, run.scene.origin)
    cameras = with_near_plane(found, run.scene)
    views = [make_view(run.scene, run.region, camera, background) for camera in cameras]
    return TrainingSetup(
        run.scene,
        run.region,
        [view for view in views if view.camera.name not in held_out],
        [view for view in views if view.camera.name in held_out],
        background,
    )


def render_edited_views(run: FinishedRun) -> TrainingSetup:
    """Render the run's views, with the boxes that the training views had in training.

    See `render_run_views`.
    """
    setup = render_run_views(run)
    cameras = [view.camera for view in setup.train]
    edited = {s: read_views(run.folder, "edited", cameras, s) for s in run.trajectory.strengths}
    return METHODS[run.record.plan.preset].box_views(setup, edited)


def write_finals(setup: TrainingSetup, edited: Gaussians, folder: RunFolder, log: RunLog) -> None:
    """Render and write the views of the finished edit."""
    gaussians = activate(edited)
    with log.looks("picture the edit", len(setup.views)) as count_view:

        def draw(view: View) -> tuple[str, Tensor]:
            picture = render_view(gaussians, view.camera, setup.background)
            count_view()
            return view.camera.name, picture

        finals = dict(map_threads(draw, setup.views))
    write_views(folder, "final", finals)
