"""Cameras converted to a scene's frame and checked against it.

nerfstudio trains in its own frame. `dataparser_transforms.json` holds the transform of a point from the
dataset's world: x' = scale · (R x + t). R rotates the camera poses, and camera centers transform like points.
A transforms.json may be in a third frame (`applied_transform`). nerfstudio writes the transform from the
dataset's world; older files hold the one from transforms.json. nerfstudio's own frame has z up, which tells
the two kinds of file apart.

The check renders the scene at a small size through some cameras. A camera sees the scene if it covers at
least 1/256 of the picture, a square of 1/16 of its sides. At least half of the cameras must see the scene. If
cameras look at other parts of a larger capture, it suffices that the scene covers a tenth of the picture in
three of them.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated

import msgspec
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, Origin
from progdf.io.atomic import read_file
from progdf.io.camera_json import make_rigid
from progdf.io.cameras import (
    camera_search_folder,
    load_cameras_with_report,
    log_cameras,
    relative_viewmat,
)
from progdf.io.file_rules import damage_error
from progdf.io.json_values import convert_json, decode_json
from progdf.rasterize import render
from progdf.scene.bounds import near_plane, scene_sphere
from progdf.threads import map_threads

_log = logging.getLogger(__name__)

TRANSFORMS_FILE = "dataparser_transforms.json"
_CHECKPOINTS = "nerfstudio_models"  # nerfstudio's folder of checkpoints; the file lies beside it

_CHECK_SIZE_PX = 96  # longer side of the renders of the check, pixels
_FIRST_COUNT = 8  # cameras that are checked first
_MAX_COUNT = 48  # cameras that are checked if the first ones do not decide
_MIN_SHARE = 1 / 256  # smallest share of the picture: 16 x 16 of the 256 x 256 pixels of a training view
_LARGE_SHARE = 0.1  # smallest share of the picture for a camera that is aimed at the scene
_LARGE_COUNT = 3  # cameras that must see the scene large: the smallest number for a training

_Number = Annotated[float, msgspec.Meta(gt=-3e38, lt=3e38)]
_Row = tuple[_Number, _Number, _Number, _Number]


class _Transforms(msgspec.Struct):
    """dataparser_transforms.json."""

    transform: Annotated[list[_Row], msgspec.Meta(min_length=3, max_length=4)]
    scale: Annotated[float, msgspec.Meta(gt=0, lt=3e38)]


@dataclass(frozen=True)
class SceneCameras:
    """Cameras in a scene's frame."""

    cameras: list[Camera]
    notes: tuple[str, ...] = ()  # lines that name the chosen frame
    # true for cameras of a nerfstudio dataset without a dataparser_transforms.json
    lacks_transforms: bool = False


@dataclass(frozen=True)
class Coverage:
    """Share of the picture that a scene covers, for some of the cameras."""

    shares: tuple[float, ...]  # 0 to 1, one per checked camera

    @property
    def showing(self) -> int:
        """Number of cameras that see the scene."""
        return sum(share >= _MIN_SHARE for share in self.shares)

    @property
    def median(self) -> float:
        """Median share, 0 to 1."""
        return sorted(self.shares)[len(self.shares) // 2]

    @property
    def fits(self) -> bool:
        """True if the cameras are probably in the scene's frame."""
        count = len(self.shares)
        large = sum(share >= _LARGE_SHARE for share in self.shares)
        return self.showing > 0 and (2 * self.showing >= count or large >= _LARGE_COUNT)


def load_scene_cameras(
    path: Path, scene: Gaussians, scene_file: Path | None = None, anyway: bool = False
) -> SceneCameras:
    """Return the cameras of a file or folder in the frame of a scene.

    The result is in the first of these frames in which the cameras see the scene:

    1. nerfstudio's, if a dataparser_transforms.json is beside the scene or the cameras
    2. the file's
    3. the dataset's frame before the applied_transform of a transforms.json

    Cameras that this program saved are in the scene's frame.

    Args:
        path: see `progdf.io.cameras.load_cameras`
        scene: the scene; the cameras are relative to its origin
        scene_file: the scene's file, if there is one
        anyway: use the first frame without a check

    Raises:
        ProgdfError: `load_cameras` fails, dataparser_transforms.json is broken, or the cameras see the scene
            in no frame.
    """
    cameras, report = load_cameras_with_report(path, scene.origin)
    log_cameras(path, cameras, report)
    file = None if report.dataset is None else _find_transforms(path, scene_file)
    candidates = _candidates(path, cameras, scene.origin, report.dataset, file)
    is_foreign = report.dataset is not None and file is None
    if anyway or not len(scene):
        return candidates[0]
    coverages = []
    for candidate in candidates:
        coverage = measure_coverage(scene, candidate.cameras)
        if coverage.fits:
            return replace(candidate, lacks_transforms=is_foreign)
        coverages.append(coverage)
    raise _mismatch_error(path, scene, candidates[0].cameras, scene_file, coverages[0], is_foreign)


def scene_cameras_beside(path: Path, scene: Gaussians) -> list[Camera]:
    """Return the cameras beside a scene's file whose pictures contain its middle, in its frame.

    A log line reports cameras that all look past it. The check renders nothing, because the cameras are only
    used to find the up axis.
    """
    try:
        cameras = load_scene_cameras(camera_search_folder(path), scene, path, anyway=True).cameras
    except (ProgdfError, OSError):
        return []
    facing = [camera for camera in cameras if _has_middle(camera, scene)]
    if not facing:
        _warn_once(f"the {len(cameras)} cameras beside {path} do not face the scene and are not used")
    return facing


def _has_middle(camera: Camera, scene: Gaussians) -> bool:
    """Return whether the scene's middle is in a camera's picture."""
    center = camera.viewmat[:3, :3] @ scene_sphere(scene)[0] + camera.viewmat[:3, 3]
    x, y, depth = (float(c) for c in camera.K @ center)
    return depth > 0 and 0 <= x <= camera.width * depth and 0 <= y <= camera.height * depth


@cache
def _warn_once(line: str) -> None:
    _log.warning("%s", line)


def measure_coverage(scene: Gaussians, cameras: Sequence[Camera]) -> Coverage:
    """Return the picture shares that a scene covers, for up to 48 cameras spread over the list."""
    spread = sorted(range(len(cameras)), key=lambda i: math.sqrt(2.0) * i % 1.0)[:_MAX_COUNT]
    near = near_plane(scene_sphere(scene)[1])

    def covered_share(index: int) -> float:
        camera = cameras[index]
        scale = min(1.0, _CHECK_SIZE_PX / max(camera.width, camera.height))
        width = max(1, round(camera.width * scale))
        height = max(1, round(camera.height * scale))
        small = replace(camera.resize(width, height), near=near, lens=None)
        with torch.no_grad():
            transmittance = render(scene, small, (0.0, 0.0, 0.0)).transmittance
        return 1.0 - float(transmittance.mean())

    shares = map_threads(covered_share, spread[:_FIRST_COUNT])
    coverage = Coverage(tuple(shares))
    if coverage.fits or len(spread) <= _FIRST_COUNT:
        return coverage
    return Coverage((*shares, *map_threads(covered_share, spread[_FIRST_COUNT:])))


def _candidates(
    path: Path, cameras: list[Camera], origin: Origin, dataset: Tensor | None, file: Path | None
) -> list[SceneCameras]:
    """Return the cameras in the frames that the scene may be in, likeliest first.

    Args:
        path: the cameras' file or folder
        cameras: cameras in the file's frame, relative to `origin`
        origin: origin of the scene
        dataset: see `CameraReport.dataset`
        file: the dataparser_transforms.json, if there is one
    """
    is_applied = dataset is not None and not torch.equal(dataset, torch.eye(4, dtype=torch.float64))
    found = []
    if file is not None and dataset is not None:
        rigid, scale = _read_transforms(file)
        applied_scale = float(dataset[:3, :3].det() ** (1 / 3))
        applied = dataset.clone()
        applied[:3] /= applied_scale
        transforms = [rigid @ torch.linalg.inv(applied)]
        if is_applied:
            transforms.append(rigid)
        transforms.sort(key=lambda transform: -_upright(cameras, transform))
        note = f"cameras: moved into nerfstudio's frame by {file}"
        for transform in transforms:
            transform[:3] *= scale / applied_scale
            found.append(SceneCameras([_move(camera, transform, origin) for camera in cameras], (note,)))
    note = f"cameras: {file} is not applied, because the scene is not visible with it"
    found.append(SceneCameras(cameras, () if file is None else (note,)))
    if is_applied and dataset is not None:
        note = f"cameras: the applied_transform of {path} is reverted, because the scene does not include it"
        transform = torch.linalg.inv(dataset)
        found.append(SceneCameras([_move(camera, transform, origin) for camera in cameras], (note,)))
    return found


def _upright(cameras: Sequence[Camera], way: Tensor) -> float:
    """Return the z component of the cameras' mean up after a rotation, -1 to 1, rounded to 0.001."""
    up = torch.stack([-camera.viewmat[1, :3] for camera in cameras]).double().mean(dim=0)
    return round(float((way[:3, :3] @ torch.nn.functional.normalize(up, dim=0))[2]), 3)


def _find_transforms(path: Path, scene_file: Path | None) -> Path | None:
    """Return the dataparser_transforms.json beside a scene, or else beside its cameras."""
    folders = [path if path.is_dir() else path.parent]
    if scene_file is not None:
        folder = scene_file.absolute().parent
        folders = [folder, *folders]
        if folder.name == _CHECKPOINTS:
            folders = [folder.parent, *folders]
    return next(
        (folder / TRANSFORMS_FILE for folder in folders if (folder / TRANSFORMS_FILE).is_file()), None
    )


def _read_transforms(file: Path) -> tuple[Tensor, float]:
    """Return a rigid transform, [4,4] float64, and the scale that follows it.

    Raises:
        ProgdfError: the file is damaged, or its transform is not a rotation and translation.
    """
    try:
        content = convert_json(decode_json(read_file(file)), _Transforms)
    except ValueError as error:
        raise damage_error(file, str(error)) from None
    matrix = torch.tensor([*content.transform[:3], (0.0, 0.0, 0.0, 1.0)], dtype=torch.float64)
    return make_rigid(os.fspath(file), matrix), content.scale


def _move(camera: Camera, way: Tensor, origin: Origin) -> Camera:
    """Return a camera, relative to `origin`, after a similarity transform of the world. [4,4] float64"""
    x, y, z = origin
    pose = way @ torch.linalg.inv(relative_viewmat(camera.viewmat, (-x, -y, -z)))
    pose[:3, :3] /= way[:3, :3].det() ** (1 / 3)
    viewmat = relative_viewmat(torch.linalg.inv(pose), origin)
    return replace(camera, viewmat=viewmat.float())


def _mismatch_error(
    path: Path,
    scene: Gaussians,
    cameras: Sequence[Camera],
    scene_file: Path | None,
    coverage: Coverage,
    is_foreign: bool,
) -> ProgdfError:
    """Return the error for cameras that do not show a scene, with the likely cause."""
    name = "the scene" if scene_file is None else str(scene_file)
    center, radius = scene_sphere(scene)
    in_camera = torch.stack([camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3] for camera in cameras])
    distance = float(in_camera.norm(dim=1).median())
    behind = int((in_camera[:, 2] < 0).sum())
    cause = f"their median distance is {distance:.3g}, the scene's radius {radius:.3g}"
    if 2 * behind > len(cameras):
        cause = f"the scene is behind {behind} of {len(cameras)}, which suggests other camera axes"
    remedy = "give cameras in the scene's frame"
    if is_foreign:
        remedy = (
            f"put nerfstudio's {TRANSFORMS_FILE} beside a scene that it trained, or give cameras in its frame"
        )
    return ProgdfError(
        f"{path} is not in the frame of {name}: "
        f"{coverage.showing} of {len(coverage.shares)} cameras see it, "
        f"in {100 * max(coverage.shares):.2g} % of a picture at most ({cause}); "
        f"{remedy}, or add --cameras-anyway"
    )
