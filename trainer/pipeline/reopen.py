"""A finished run, opened again: its scene, region and views as they were, and what was recorded."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import msgspec
import torch

from progdf.errors import ProgdfError
from progdf.field.trajectory import Trajectory, load_trajectory
from progdf.formats.scene_file import load_scene, scene_file
from progdf.gaussians import Gaussians
from progdf.io.cameras import load_cameras
from progdf.io.json_values import convert_json
from progdf.region import Region
from trainer.editors.base import EditKind
from trainer.option_checks import check_name
from trainer.options import TrainOptions
from trainer.setup.training_setup import TrainingSetup
from trainer.store.run_folder import RunFolder
from trainer.views.view import make_view, with_near_plane


@dataclass(frozen=True)
class FinishedRun:
    """What a finished run left.

    Args:
        folder: its folder
        scene: the original
        region: what was edited
        trajectory: what was recorded
        about: what the trajectory's file says of the run: options, losses, …
    """

    folder: RunFolder
    scene: Gaussians
    region: Region
    trajectory: Trajectory
    about: Mapping[str, Any]


class _About(msgspec.Struct):
    """What of `FinishedRun.about` is used to open it."""

    scene: str
    held_out: list[str]
    background: tuple[float, float, float]
    options: dict[str, Any]
    objective: str
    losses: dict[str, list[float | None]]
    attribute_worth_db: dict[str, float]
    kind: EditKind | None = None
    group_steps: int | None = None

    def __post_init__(self) -> None:
        columns = [self.losses.get(name, []) for name in ("step", "left")]
        if not all(columns) or len({len(column) for column in self.losses.values()}) > 1:
            raise ValueError("its losses do not fit each other")


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
        kept = convert_json(about, _About)
        options_of(about)
        name = convert_json(kept.options["name"], str)
        try:
            check_name(name)
        except ProgdfError:
            raise ValueError("its name is not valid") from None
        members, score = extra["members"], extra["score"]
        path = scene or Path(kept.scene)
        if not os.path.isfile(scene_file(path)):
            raise ProgdfError(f"the scene {path} does not exist; give its path with --scene")
        gaussians = load_scene(path)
        if len(score) != len(gaussians):
            raise ProgdfError(
                f"{path} has {len(gaussians)} Gaussians, the run's scene had {len(score)}; "
                "give that one with --scene"
            )
        region = Region(name, members, score)
        if len(region) != trajectory.end.shape[0]:
            raise ValueError(f"it has {trajectory.end.shape[0]} members, the region {len(region)}")
    except ProgdfError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise ProgdfError(f"{folder.trajectory} is damaged ({error}); train again") from error
    return FinishedRun(folder, gaussians, region, trajectory, about)


def options_of(about: Mapping[str, Any]) -> TrainOptions:
    """The options of a finished run; what it does not know, as it is older, is as by default.

    Raises:
        ValueError: one is of another type.
    """
    known = {field.name for field in fields(TrainOptions)}
    given = {name: value for name, value in about["options"].items() if name in known}
    try:
        return msgspec.convert(given, TrainOptions, dec_hook=_path)
    except msgspec.ValidationError as error:
        raise ValueError(str(error)) from None


def _path(kind: type, value: object) -> object:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"{value!r} is not a {kind.__name__}")


def render_run_views(run: FinishedRun) -> TrainingSetup:
    """The run's views, rendered; their boxes hold the region, not what an edit may show beside it."""
    background = torch.tensor(run.about["background"])
    held_out = set(run.about["held_out"])
    cameras = with_near_plane(load_cameras(run.folder.cameras), run.scene)
    views = [make_view(run.scene, run.region, camera, background) for camera in cameras]
    return TrainingSetup(
        run.scene,
        run.region,
        [view for view in views if view.camera.name not in held_out],
        [view for view in views if view.camera.name in held_out],
        background,
    )
