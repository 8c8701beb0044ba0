"""Training setup: scene, region and the views to train on and to measure with."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.io.picture_camera import up_in_picture
from progdf.region import Region
from progdf.scene.bounds import is_surrounding
from progdf.scene.orbit_rig import ELEVATIONS, HALF_SPHERE
from progdf.scene.up_axis import UpAxis, find_up, up_from_json
from progdf.system.equality import equal_fields
from trainer.options import COLOR_VIEWS, VIEWS, TrainingViewOptions

from .choose import (
    ViewChoice,
    choose_cameras,
    choose_views,
    in_frame,
    load_given_cameras,
    sample_members,
    split_views,
)
from .lower_layers import LowerLayers
from .picture_cameras import picture_cameras
from .size import SizeLimits, choose_view_size
from .view import (
    BACKGROUND,
    RegionThumbnail,
    View,
    fit_size,
    make_glances,
    make_views,
    name_cameras,
    region_rig,
    with_near_plane,
)

SIZE = 256
"""Default longer side of views whose size does not follow the region's detail, pixels."""

SIZE_LIMITS = {True: SizeLimits(160, 16_000), False: SizeLimits(SIZE, 32_000)}
"""Limits of the views' size in a rig, by `TrainingViewOptions.dense`.

Color edits that are solved for are dense. Other edits are optimized view by view. The limits bound the time
of a run (docs/lab/experiments.md, Views).
"""

_SIZING_VIEWS = 5  # cameras of the rig in which the region's detail is measured

SAMPLING = math.sqrt(2.0)
"""Sampling rate of the cameras of a color edit.

Its pictures are displayed at one to two times the size of the views (docs/lab/experiments.md, Views).
"""

PICTURE_SIZE = 512
"""Maximum longer side of a changed picture in training, pixels."""

_MAX_GLANCES = 8
"""Maximum number of thumbnails. A large scene gets fewer, so that its draft takes seconds.

With up to 24 no draft improves by 0.1 dB.
"""
_GLANCE_SIZE = 192
"""Longer side of a thumbnail, pixels; smaller ones mix the region's colors with each other and the rest."""
_MAX_GLANCE_GAUSSIANS = 3_000_000  # maximum number of Gaussians rendered in all thumbnails together


@dataclass(frozen=True)
class TrainingSetup:
    """Scene, region, and views of a run, with notes on them."""

    __eq__ = equal_fields

    scene: Gaussians  # the original, or `LowerLayers.base`
    region: Region  # members that may change
    train: Sequence[View] = ()  # views to train on
    held_out: Sequence[View] = ()  # views to measure with; empty if there are too few views, see `judging`
    background: Tensor = field(default_factory=lambda: torch.tensor(BACKGROUND))  # rgb. [3]
    notes: Sequence[str] = ()  # lines for the log
    up: UpAxis | None = None  # the axis that is up
    lower: LowerLayers | None = None  # layers that changed pictures show; None: the original

    @property
    def seen(self) -> Gaussians | None:
        """The scene that changed pictures show; None: `scene`."""
        return self.lower.seen if self.lower is not None and self.lower.paints else None

    @property
    def views(self) -> list[View]:
        """All views, training views first."""
        return [*self.train, *self.held_out]

    def extend(self, added: Gaussians | None) -> TrainingSetup:
        """Return the setup with added rows after the scene's own, as members too; unchanged for None."""
        if added is None:
            return self
        rows = torch.arange(len(self.scene), len(self.scene) + len(added))
        region = Region(
            self.region.name,
            torch.cat([self.region.members, rows]),
            torch.cat([self.region.score, torch.ones(len(rows))]),
        )
        return replace(self, scene=concatenate([self.scene, added]), region=region)

    def keep_solved(self, effort: Mapping[str, Any]) -> TrainingSetup:
        """Return the setup with the training views that the color solver used: all, or every other one."""
        return replace(self, train=self.train[:: -(-len(self.train) // effort.get("views", len(self.train)))])

    @property
    def judging(self) -> Sequence[View]:
        """Views that measure the edit: the held-out views, or the training views if none are held out."""
        return self.held_out or self.train

    @property
    def judged_on(self) -> str:
        """Description of `judging` for use beside a figure; it stresses that a held-out view is alone."""
        if not self.held_out:
            return "training views"
        return f"{len(self.held_out)} held-out views" if len(self.held_out) > 1 else "one held-out view alone"


def check_given_cameras(options: TrainingViewOptions, scene: Gaussians) -> None:
    """Raise a ProgdfError if the cameras of --cameras are invalid or probably in another frame."""
    load_given_cameras(options, scene)


def make_training_setup(options: TrainingViewOptions, scene: Gaussians, region: Region) -> TrainingSetup:
    """Return the setup with its views: those of changed pictures, the best given cameras, or a rig around the
    region.

    Raises:
        ProgdfError: no camera sees the region.
    """
    background = torch.tensor(BACKGROUND)
    found = load_given_cameras(options, scene)
    given = found.cameras
    up = find_up(scene, given, options.up, options.scene)
    if options.pictures:
        if options.up == "auto":
            up = _up_of_pictures(options.pictures) or up
        setup = _picture_setup(options, scene, region, given, up)
        return replace(setup, notes=[*found.notes, *setup.notes])
    default_count = COLOR_VIEWS[scene.sh_degree > 1] if options.dense else VIEWS
    views = options.views or default_count
    elevations = HALF_SPHERE if options.dense else ELEVATIONS
    size = options.image_size or SIZE
    notes = [*found.notes, f"up is {up.name}, {up.reason}"]
    if options.cameras is None and options.fills and not options.image_size:
        rig = region_rig(scene, region, _SIZING_VIEWS, SIZE, up.direction, elevations, fills=True)
        rig = with_near_plane(rig, scene)
        chosen = choose_view_size(scene, region, rig, SIZE_LIMITS[options.dense])
        size = chosen.side
        notes.append(chosen.line())

    def cameras_of(count: int) -> list[Camera]:
        if options.cameras is not None:
            fitted = [fit_size(camera, size) for camera in given]
        else:
            fitted = region_rig(scene, region, count, size, up.direction, elevations, options.fills)
        if options.dense:
            fitted = [replace(camera, sampling=SAMPLING) for camera in fitted]
        return with_near_plane(name_cameras(fitted), scene)

    held_out_count = views // 5
    if not options.views:
        held_out_count = min(held_out_count, VIEWS // 5)
    held_out_count = max(1, held_out_count)
    if options.cameras is None:
        choice, train, held_out = _rig_views(
            scene, region, cameras_of, views - held_out_count, held_out_count, background
        )
    else:
        choice = choose_views(scene, region, cameras_of(views), views, background)
        train, held_out = split_views(choice, min(held_out_count, max(1, len(choice.views) // 5)))
    if options.cameras is None and is_surrounding(scene, up.direction):
        notes.append(
            f"the scene surrounds the viewer: {choice.offered} cameras at free places around the region "
            "(a guess; --cameras gives the scene's own)"
        )
    if len(choice.views) < choice.offered:
        notes.append(choice.line())
    if any(view.camera.lens for view in choice.views):
        notes.append(
            "the cameras have lens distortion and the training views have none; give edited copies of "
            "photographs with --editor photographs:EDITED,ORIGINALS"
        )
    return TrainingSetup(scene, region, train, held_out, background, notes, up)


def render_thumbnails(
    options: TrainingViewOptions, scene: Gaussians, region: Region
) -> list[RegionThumbnail]:
    """Return thumbnails of the region from all sides, independent of number and size of its views.

    They come from the first given cameras that show it, spread over the list, or from a rig. There are none
    if no camera can be placed for the region.
    """
    given = load_given_cameras(options, scene).cameras
    up = find_up(scene, given, options.up, options.scene).direction
    count = max(3, min(_MAX_GLANCES, _MAX_GLANCE_GAUSSIANS // len(scene)))
    if given:
        spread = sorted(range(len(given)), key=lambda i: math.sqrt(2.0) * i % 1.0)
        positions = scene.means[sample_members(scene, region)]
        spread.sort(key=lambda i: not bool(in_frame(positions, given[i]).any()))  # visible region first
        cameras = [fit_size(given[i], _GLANCE_SIZE) for i in spread]
    else:
        try:
            cameras = region_rig(scene, region, count, _GLANCE_SIZE, up, HALF_SPHERE)
        except ProgdfError:
            return []
    return make_glances(scene, region, with_near_plane(cameras, scene), count)


def _rig_views(
    scene: Gaussians,
    region: Region,
    rig: Callable[[int], Sequence[Camera]],
    count: int,
    aside: int,
    background: Tensor,
) -> tuple[ViewChoice, list[View], list[View]]:
    """Return the choice of training views from a rig, these views, and held-out views between them.

    Args:
        scene, region: target of the cameras
        rig: returns a rig with the given number of cameras
        count, aside: numbers of training and held-out views; if some cameras do not see the region, the rig
            gets up to 1.5 times as many
        background: rgb. [3]
    """
    cameras = rig(count)
    chosen = choose_cameras(scene, region, cameras, count)
    if len(chosen.cameras) < count:
        cameras = rig(min(-(-count * count // len(chosen.cameras)), count + count // 2))
        chosen = choose_cameras(scene, region, cameras, count)
    choice = chosen.views(scene, region, background)
    train = list(choice.views)
    indices = {camera.name: i for i, camera in enumerate(cameras)}
    between = rig(2 * len(cameras))[1::2]
    successors = {indices[train[k * len(train) // aside].camera.name] for k in range(aside)}
    # a rig at free places may have fewer cameras than requested
    places = sorted({i * len(between) // len(cameras) for i in successors}) if between else []
    others = [replace(between[i], name=f"between_{i:03d}") for i in places]
    views = make_views(scene, region, others, background)
    held_out = [view for view in views if bool((view.mask > 0.0).any())]
    return choice, *((train, held_out) if held_out else split_views(choice, aside))


def _up_of_pictures(paths: Sequence[Path]) -> UpAxis | None:
    """Return the up axis stored in the first picture that has one; None if none has."""
    directions = (up_from_json(up_in_picture(path)) for path in paths)
    found = next((up for up in directions if up is not None), None)
    return None if found is None else UpAxis(found, "as in the window that the picture is from")


def _picture_setup(
    options: TrainingViewOptions, scene: Gaussians, region: Region, given: Sequence[Camera], up: UpAxis
) -> TrainingSetup:
    """Return the setup of changed pictures. All are trained on, as each may show unique areas."""
    background = torch.tensor(BACKGROUND)
    size = options.image_size or PICTURE_SIZE
    cameras = [fit_size(camera, size) for camera in picture_cameras(options.pictures, given, scene.origin)]
    cameras = with_near_plane(name_cameras(cameras), scene)
    views = make_views(scene, region, cameras, background)
    for view, path in zip(views, options.pictures, strict=True):
        if not bool((view.mask > 0).any()):
            raise ProgdfError(f"{path} does not show the region '{region.name}'; leave it out")
    return TrainingSetup(scene, region, views, [], background, [f"up is {up.name}, {up.reason}"], up)
