"""Choice of the cameras for training and measuring an edit.

A scene comes with hundreds of cameras in capture order, and ProGDF (AAAI 2025) edits at most 96. The first 96
would cover one side only. The value of a camera is the visible part of the region that no chosen camera shows
from a similar direction. The choice therefore covers every part of the region from all sides, in any list
order. The same measure chooses representative views to hold out.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.region import Region
from progdf.scene.scene_cameras import (
    TRANSFORMS_FILE,
    SceneCameras,
    load_scene_cameras,
    measure_coverage,
)
from progdf.scene.up_axis import find_up
from progdf.system.equality import equal_fields
from progdf.threads import map_threads
from trainer.options import TrainingViewOptions

from .view import View, fit_size, make_views

T = TypeVar("T")

_SAMPLES = 256
"""Number of members that represent the region when views are compared."""

_COMPARED_SIDE_PX = 96
"""Longer side at which cameras are compared."""

_MAX_RENDERED = 4
"""Maximum number of cameras rendered for comparison per requested view.

From more cameras, the best spread ones are selected without rendering.
"""

_MAX_TILT = 45.0  # degrees between the up axes of cameras and scene, as cameras are usually held level

_SMALL_SHARE = 0.25  # share of a picture; a scene usually fills more in the median view

_MIN_COVER = 0.25
"""Minimum visible area of the region, as a share of the median view's; views with less are dropped."""


def load_given_cameras(options: TrainingViewOptions, scene: Gaussians) -> SceneCameras:
    """Return the cameras of --cameras in the scene's frame; none if the option is not given.

    Adds a note if their mean up axis is tilted by more than 45° against the scene's, and the scene's shape
    leaves no doubt about its up axis.

    Cameras of a nerfstudio dataset without its dataparser_transforms.json are refused if they are tilted like
    this, even if the scene's up axis is doubtful, and the median camera shows the scene in less than a
    quarter of its picture. Both together indicate nerfstudio's frame, which is rotated and scaled.
    `--cameras-anyway` skips both checks.

    Raises:
        ProgdfError: see `load_scene_cameras`; or the cameras are probably in another frame.
    """
    if options.cameras is None:
        return SceneCameras([])
    found = load_scene_cameras(options.cameras, scene, options.scene, options.cameras_anyway)
    held = find_up(scene, found.cameras)
    shape = find_up(scene)
    tilt = math.degrees(math.acos(max(-1.0, min(1.0, float(held.direction @ shape.direction)))))
    if options.cameras_anyway or tilt <= _MAX_TILT:
        return found
    if found.lacks_transforms:
        median = measure_coverage(scene, found.cameras).median
        if median < _SMALL_SHARE:
            name = "the scene" if options.scene is None else os.fspath(options.scene)
            raise ProgdfError(
                f"{options.cameras} is probably not in the frame of {name}: the cameras are tilted by "
                f"{tilt:.0f}° and show the scene in {100 * median:.2g} % of a picture (median); put "
                f"nerfstudio's {TRANSFORMS_FILE} beside the scene, give cameras in its frame, or add "
                "--cameras-anyway"
            )
    if not shape.certain:
        return found
    note = (
        f"warning: the cameras are tilted by {tilt:.0f}° "
        f"({held.name} is up in them, {shape.name} in the scene); if the views are too, the cameras are of "
        f"another frame: put nerfstudio's {TRANSFORMS_FILE} beside the scene, or give others"
    )
    return SceneCameras(found.cameras, (*found.notes, note))


@dataclass(frozen=True)
class Visibility:
    """Visibility of S members in V cameras."""

    __eq__ = equal_fields

    visible: Tensor  # 0 to 1. [V,S]
    toward: Tensor  # unit vectors from the members to the cameras. [V,S,3]
    reach: float  # angle in radians beyond which another direction counts as another side

    def coverage_by(self, camera: int) -> Tensor:
        """Return the degree to which one camera covers each camera's view of each member, 0 to 1. [V,S]"""
        cosine = (self.toward * self.toward[camera]).sum(dim=2)
        near = torch.exp(-(1 - cosine) / (1 - math.cos(self.reach)))
        return self.visible[camera] * near


@dataclass(frozen=True)
class ViewChoice:
    """Chosen views of an edit."""

    views: tuple[View, ...]  # in the order of the cameras' list
    shown: Visibility  # visibility of the members in these views
    offered: int  # number of cameras to choose from
    unseeing: int  # number of cameras that do not see the region
    scant: int  # number of cameras that show less than a quarter of the median view's area

    def line(self) -> str:
        """Return the log line on the use of the cameras."""
        parts = [f"{len(self.views)} of {self.offered} cameras"]
        if self.unseeing:
            parts.append(f"{self.unseeing} do not see the region")
        if self.scant:
            parts.append(f"{self.scant} see too little of the region")
        spare = self.offered - len(self.views) - self.unseeing - self.scant
        if spare:
            parts.append(f"{spare} are redundant")
        return "; ".join(parts)


@dataclass(frozen=True)
class CameraChoice:
    """Chosen cameras of an edit, before their views are rendered. See `ViewChoice`."""

    cameras: Sequence[Camera]  # in the order of the list
    shown: Visibility
    offered: int
    unseeing: int
    scant: int

    def views(self, scene: Gaussians, region: Region, background: Tensor) -> ViewChoice:
        """Render the views. background: rgb. [3]"""
        views = make_views(scene, region, self.cameras, background)
        return ViewChoice(tuple(views), self.shown, self.offered, self.unseeing, self.scant)


def choose_views(
    scene: Gaussians, region: Region, cameras: Sequence[Camera], count: int, background: Tensor
) -> ViewChoice:
    """Return up to `count` views that cover the region, see `choose_cameras`. background: rgb. [3]"""
    return choose_cameras(scene, region, cameras, count).views(scene, region, background)


def choose_cameras(scene: Gaussians, region: Region, cameras: Sequence[Camera], count: int) -> CameraChoice:
    """Return up to `count` cameras that cover the region from as many sides as all of them do.

    Args:
        scene: the original
        region: the region to cover
        cameras: any number in any order; the choice hardly depends on the order
        count: maximum number of cameras, ≥ 1

    Raises:
        ProgdfError: no camera sees the region.
    """
    rows = sample_members(scene, region)
    positions = scene.means[rows]
    framed = torch.stack([in_frame(positions, camera) for camera in cameras])
    candidates = framed.any(dim=1).nonzero()[:, 0].tolist()
    max_candidates = _MAX_RENDERED * count
    if len(candidates) > max_candidates:
        toward = _toward(positions, [cameras[i] for i in candidates])
        visibility = Visibility(framed[candidates].float(), toward, _mean_spacing(max_candidates))
        candidates = [candidates[k] for k in _greedy(visibility, max_candidates)]
    cover, weights = _measure_visibility(scene, region, rows, [cameras[i] for i in candidates])
    seeing = cover > 0
    if not bool(seeing.any()):
        raise ProgdfError(
            f"none of the {len(cameras)} cameras sees the region '{region.name}'; "
            "give cameras that look at it with --cameras"
        )
    is_sufficient = cover >= _MIN_COVER * cover[seeing].median()
    sufficient = is_sufficient.nonzero()[:, 0].tolist()
    toward = _toward(positions, [cameras[candidates[k]] for k in sufficient])
    visibility = Visibility(_relative_visibility(weights[sufficient]), toward, _mean_spacing(count))
    chosen = _greedy(visibility, count) if len(sufficient) > count else list(range(len(sufficient)))
    return CameraChoice(
        [cameras[candidates[sufficient[k]]] for k in chosen],
        Visibility(visibility.visible[chosen], visibility.toward[chosen], visibility.reach),
        len(cameras),
        int((~framed.any(dim=1)).sum()) + int((~seeing).sum()),
        int((seeing & ~is_sufficient).sum()),
    )


def split_held_out(held_out: Sequence[T]) -> tuple[Sequence[T], Sequence[T]]:
    """Return the held-out views to choose a field on (every other one), and those to report its errors on.

    A single view serves for both.
    """
    return held_out[::2], held_out[1::2] or held_out


def split_views(choice: ViewChoice, held_out: int) -> tuple[list[View], list[View]]:
    """Return the views to train on, and up to `held_out` representative views from as many sides.

    At most a third is held out, so none of two views.
    """
    views = choice.views
    count = min(held_out, len(choice.views) // 3)
    chosen = _greedy(replace(choice.shown, reach=_mean_spacing(count)), count) if count > 0 else []
    return [view for i, view in enumerate(views) if i not in chosen], [views[i] for i in chosen]


def _greedy(visibility: Visibility, count: int) -> list[int]:
    """Return the cameras with the largest gains, chosen greedily, in list order. Ties go to the first."""
    covered = torch.zeros_like(visibility.visible)
    remaining = torch.ones(len(covered), dtype=torch.bool)
    for _ in range(count):
        gain = (visibility.visible * (1 - covered)).sum(dim=1)
        best = int(torch.where(remaining, gain, -1.0).argmax())
        remaining[best] = False
        covered = torch.maximum(covered, visibility.coverage_by(best))
    return (~remaining).nonzero()[:, 0].tolist()


def _mean_spacing(count: int) -> float:
    """Return the mean angle in radians between neighbors of `count` directions spread over a half sphere."""
    return min(1.0, math.sqrt(2 * math.pi / count))


def sample_members(scene: Gaussians, region: Region) -> Tensor:
    """Return rows that represent the region, evenly spaced by the area that they can cover. [S] int64"""
    total = visible_area(scene[region.members]).cumsum(dim=0)
    ticks = (torch.arange(_SAMPLES, dtype=torch.float64) + 0.5) / _SAMPLES * total[-1]
    picked = torch.searchsorted(total, ticks).clamp_max(len(total) - 1)
    return region.members[torch.unique_consecutive(picked)]


def in_frame(places: Tensor, camera: Camera) -> Tensor:
    """Return the positions inside the picture or near it, regardless of occlusion. [S,3] -> [S] bool

    Near is within half the picture's size, as large Gaussians extend into it.
    """
    camera_positions = places @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = camera_positions @ camera.K.T
    size = torch.tensor([camera.width, camera.height])
    offset = (pixels[:, :2] / pixels[:, 2:] / size - 0.5).abs().amax(dim=1)
    return (offset <= 1.0) & (camera_positions[:, 2] > 0)


def _toward(places: Tensor, cameras: Sequence[Camera]) -> Tensor:
    eyes = torch.stack([camera.position for camera in cameras])
    return torch.nn.functional.normalize(eyes[:, None] - places, dim=2)


def _measure_visibility(
    scene: Gaussians, region: Region, rows: Tensor, cameras: Sequence[Camera]
) -> tuple[Tensor, Tensor]:
    """Return the region's share of each picture [V], and each sample's blended weight in it [V,S]."""
    cover = torch.zeros(len(cameras))
    weights = torch.zeros(len(cameras), len(rows))

    def look(i: int) -> None:
        small_camera = fit_size(cameras[i], _COMPARED_SIDE_PX)
        visible = alpha_weights(scene, small_camera, torch.ones(small_camera.height, small_camera.width))[
            :, 2
        ]
        cover[i] = visible[region.members].sum() / (small_camera.width * small_camera.height)
        weights[i] = visible[rows]

    map_threads(look, range(len(cameras)))
    return cover, weights


def _relative_visibility(weights: Tensor) -> Tensor:
    """Return each sample's weight as a share of its weight in the median view that shows it, at most 1.

    [V,S] -> [V,S] 0 to 1
    """
    typical = torch.where(weights > 0, weights, torch.nan).nanmedian(dim=0).values.nan_to_num(1.0)
    return (weights / typical.clamp_min(1e-9)).clamp_max(1.0)


_MAX_AREA = 20.0
"""Limit of the area that counts for a Gaussian, in mean areas."""


def visible_area(gaussians: Gaussians) -> Tensor:
    """Return opacity × longest axis × middle axis, clamped so that no huge Gaussian dominates. [N] float64"""
    _, middle, long = gaussians.scales.sort(dim=1).values.double().unbind(1)
    areas = gaussians.opacities.double() * middle * long
    return areas.clamp_max(_MAX_AREA * float(areas.mean()))
