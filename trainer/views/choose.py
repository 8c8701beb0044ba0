"""Which cameras an edit is trained from, and which it is measured with.

A scene comes with hundreds of cameras, in the order in which someone walked; 96 is the most that ProGDF
(AAAI 2025) edits. The first 96 would show one side. So a camera is worth what it shows of the region that no
camera taken before shows from near the same direction: every part of the region is seen, and from all around,
whatever the list's order. The same measure decides which views represent the others, to be held out.
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
from progdf.threads import map_threads
from trainer.options import TrainingViewOptions

from .view import View, fit_size, make_view

T = TypeVar("T")

_SAMPLES = 256
"""Members that represent the region when views are compared."""

_LOOK = 96
"""Longer side in pixels at which cameras are compared."""

_MAX_LOOKED_THROUGH = 4
"""Times as many cameras as are wanted are looked through; of more, the best spread ones are taken unseen."""

_MAX_TILT = 45.0  # degrees between the up of cameras and of their scene: people hold cameras level

_SMALL_SHARE = 0.25  # of a picture: people frame a scene so that it fills more in the median view

_MIN_COVER = 0.25
"""Of what the median view shows of the region; a view that shows less is left out."""


def load_given_cameras(options: TrainingViewOptions, scene: Gaussians) -> SceneCameras:
    """Return the cameras of --cameras in the scene's frame, none if it is not given.

    A note tells where their mean up is more than 45° off the scene's, if its shape leaves no doubt.
    Cameras of a nerfstudio dataset without its dataparser_transforms.json are refused if they are tilted like
    this, even against a doubtful up, and the median camera shows the scene in less than a quarter of its
    picture. Both together are the marks of nerfstudio's frame, which is turned and scaled.

    Raises:
        ProgdfError: see `load_scene_cameras`; or the cameras are probably of another frame.
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
                f"{options.cameras} is probably not of the frame of {name}: the cameras are tilted by "
                f"{tilt:.0f}° and show the scene in {100 * median:.2g} % of a picture (median); put "
                f"nerfstudio's {TRANSFORMS_FILE} beside the scene, give cameras of its frame, or add "
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
    """What each of V cameras shows of S members: how well [V,S] 0..1, and from where (unit vectors from the
    member to the eye) [V,S,3]; `reach` is the angle in radians at which another direction is another side."""

    visible: Tensor
    toward: Tensor
    reach: float

    def coverage_by(self, camera: int) -> Tensor:
        """How far one camera serves what each shows of each member. [V,S] 0..1"""
        cosine = (self.toward * self.toward[camera]).sum(dim=2)
        near = torch.exp(-(1 - cosine) / (1 - math.cos(self.reach)))
        return self.visible[camera] * near


@dataclass(frozen=True)
class ViewChoice:
    """The views an edit works on."""

    views: tuple[View, ...]  # in the order of the cameras' list
    shown: Visibility  # what each of them shows
    offered: int  # how many cameras there were
    unseeing: int  # how many of them do not see the region
    scant: int  # how many show less than a quarter of what the median view shows

    def line(self) -> str:
        """What became of the cameras, for the log."""
        parts = [f"{len(self.views)} of {self.offered} cameras"]
        if self.unseeing:
            parts.append(f"{self.unseeing} do not see the region")
        if self.scant:
            parts.append(f"{self.scant} see too little of it")
        spare = self.offered - len(self.views) - self.unseeing - self.scant
        if spare:
            parts.append(f"{spare} show what others show")
        return "; ".join(parts)


def choose_views(
    scene: Gaussians, region: Region, cameras: Sequence[Camera], count: int, background: Tensor
) -> ViewChoice:
    """Up to `count` views that show all of the region from as many sides as the cameras do.

    Args:
        scene: what the cameras look at
        region: what the views are to show
        cameras: any number in any order; the choice hardly depends on the order
        count: how many views at most, ≥ 1
        background: rgb. [3]

    Raises:
        ProgdfError: no camera sees the region.
    """
    rows = sample_members(scene, region)
    places = scene.means[rows]
    framed = torch.stack([in_frame(places, camera) for camera in cameras])
    looked = framed.any(dim=1).nonzero()[:, 0].tolist()
    most = _MAX_LOOKED_THROUGH * count
    if len(looked) > most:
        toward = _toward(places, [cameras[i] for i in looked])
        looked = [looked[k] for k in _greedy(Visibility(framed[looked].float(), toward, _reach(most)), most)]
    cover, weights = _measure_visibility(scene, region, rows, [cameras[i] for i in looked])
    seeing = cover > 0
    if not bool(seeing.any()):
        raise ProgdfError(
            f"none of the {len(cameras)} cameras sees the region '{region.name}'; "
            "give cameras that look at it with --cameras"
        )
    enough = cover >= _MIN_COVER * cover[seeing].median()
    good = enough.nonzero()[:, 0].tolist()
    toward = _toward(places, [cameras[looked[k]] for k in good])
    visibility = Visibility(_relative_visibility(weights[good]), toward, _reach(count))
    taken = _greedy(visibility, count) if len(good) > count else list(range(len(good)))
    return ViewChoice(
        tuple(map_threads(lambda k: make_view(scene, region, cameras[looked[good[k]]], background), taken)),
        Visibility(visibility.visible[taken], visibility.toward[taken], visibility.reach),
        len(cameras),
        int((~framed.any(dim=1)).sum()) + int((~seeing).sum()),
        int((seeing & ~enough).sum()),
    )


def split_held_out(held_out: Sequence[T]) -> tuple[Sequence[T], Sequence[T]]:
    """Held-out views to choose a field on, every other one, and those to report its errors on, the others.

    One view alone serves for both.
    """
    return held_out[::2], held_out[1::2] or held_out


def split_views(choice: ViewChoice, held_out: int) -> tuple[list[View], list[View]]:
    """Views to train with, and up to `held_out` that show most of what all show, from as many sides.

    At most a third is held out, which of two is none.
    """
    views = choice.views
    count = min(held_out, len(choice.views) // 3)
    chosen = _greedy(replace(choice.shown, reach=_reach(count)), count) if count > 0 else []
    return [view for i, view in enumerate(views) if i not in chosen], [views[i] for i in chosen]


def _greedy(visibility: Visibility, count: int) -> list[int]:
    """The cameras that add most, one after the other, in the order of the list; ties by that order."""
    served = torch.zeros_like(visibility.visible)
    left = torch.ones(len(served), dtype=torch.bool)
    for _ in range(count):
        gain = (visibility.visible * (1 - served)).sum(dim=1)
        best = int(torch.where(left, gain, -1.0).argmax())
        left[best] = False
        served = torch.maximum(served, visibility.coverage_by(best))
    return (~left).nonzero()[:, 0].tolist()


def _reach(count: int) -> float:
    """The mean angle between neighbors of `count` directions spread over a half sphere."""
    return min(1.0, math.sqrt(2 * math.pi / count))


def sample_members(scene: Gaussians, region: Region) -> Tensor:
    """Rows that represent the region, evenly by the area they can cover. -> [S] int64"""
    total = visible_area(scene[region.members]).cumsum(dim=0)
    ticks = (torch.arange(_SAMPLES, dtype=torch.float64) + 0.5) / _SAMPLES * total[-1]
    picked = torch.searchsorted(total, ticks).clamp_max(len(total) - 1)
    return region.members[torch.unique_consecutive(picked)]


def in_frame(places: Tensor, camera: Camera) -> Tensor:
    """Which places fall into the picture or near it, whatever stands before them. [S,3] -> [S] bool

    Near: within half the picture's size, as what is large reaches in.
    """
    seen = places @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = seen @ camera.K.T
    size = torch.tensor([camera.width, camera.height])
    aside = (pixels[:, :2] / pixels[:, 2:] / size - 0.5).abs().amax(dim=1)
    return (aside <= 1.0) & (seen[:, 2] > 0)


def _toward(places: Tensor, cameras: Sequence[Camera]) -> Tensor:
    eyes = torch.stack([camera.position for camera in cameras])
    return torch.nn.functional.normalize(eyes[:, None] - places, dim=2)


def _measure_visibility(
    scene: Gaussians, region: Region, rows: Tensor, cameras: Sequence[Camera]
) -> tuple[Tensor, Tensor]:
    """The region's share of each picture [V], and each sample's blended weight in it [V,S]."""
    cover = torch.zeros(len(cameras))
    weights = torch.zeros(len(cameras), len(rows))

    def look(i: int) -> None:
        small = fit_size(cameras[i], _LOOK)
        found = alpha_weights(scene, small, torch.ones(small.height, small.width))[:, 2]
        cover[i] = found[region.members].sum() / (small.width * small.height)
        weights[i] = found[rows]

    map_threads(look, range(len(cameras)))
    return cover, weights


def _relative_visibility(weights: Tensor) -> Tensor:
    """How well each sample shows, 1 where it shows as in the median view that shows it. [V,S] -> 0..1"""
    typical = torch.where(weights > 0, weights, torch.nan).nanmedian(dim=0).values.nan_to_num(1.0)
    return (weights / typical.clamp_min(1e-9)).clamp_max(1.0)


_GIANT = 20.0
"""Times the mean area at which one Gaussian counts no more."""


def visible_area(gaussians: Gaussians) -> Tensor:
    """Opacity times the two longer axes, cut off so that no giant speaks for all. [N] float64"""
    _, middle, long = gaussians.scales.sort(dim=1).values.double().unbind(1)
    areas = gaussians.opacities.double() * middle * long
    return areas.clamp_max(_GIANT * float(areas.mean()))
