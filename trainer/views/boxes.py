"""Views reduced to the box that an edit changes, or to a small size for cheap renders."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from torch import Tensor

from progdf.camera import Camera
from progdf.rasterize.engines import engine_device
from trainer.store.run_folder import stored_pictures

from .crops import CropScene, crop_scene
from .setup import TrainingSetup
from .view import (
    View,
    crop,
    shrink_image,
)

_PROBES = 3  # number of views in which movement is measured

Pictures = Mapping[float, Sequence[Tensor]]
"""Strength → whole edited pictures, one per view. [H,W,3] each"""


def boxed_pictures(
    pictures: Sequence[Tensor], views: Sequence[View], engine: str = "cpu"
) -> Sequence[Tensor]:
    """Crop whole pictures to the boxes of their views, on the engine's device. [H,W,3] -> [h,w,3] each"""
    device = engine_device(engine)

    def crop_picture(index: int) -> Tensor:
        return crop(pictures[index], views[index].box).to(device)

    return stored_pictures(crop_picture, range(min(len(pictures), len(views))))


def widen_views(setup: TrainingSetup, edited: Pictures) -> TrainingSetup:
    """Return the setup with training views whose boxes hold all changes of the edit."""
    views = [view.widen([pictures[i] for pictures in edited.values()]) for i, view in enumerate(setup.train)]
    return replace(setup, train=views)


def shrink_view(
    setup: TrainingSetup, view: View, edited: Tensor, camera: Camera
) -> tuple[CropScene, Callable[[Tensor], Tensor], Tensor]:
    """Return a view at the size of a smaller camera, for cheap renders.

    Returns:
        The scene in the box of the smaller view; a function that shrinks a picture of the view to that box;
        and the share of each pixel that is edited or belongs to the region. [h,w,1]
    """
    scale_x = camera.width / view.camera.width
    scale_y = camera.height / view.camera.height
    x0, y0, x1, y1 = view.box
    right = min(camera.width, math.ceil(x1 * scale_x))
    bottom = min(camera.height, math.ceil(y1 * scale_y))
    box = (math.floor(x0 * scale_x), math.floor(y0 * scale_y), right, bottom)

    def shrink(picture: Tensor) -> Tensor:
        return crop(shrink_image(picture, (camera.height, camera.width)), box)

    counted = (view.mask > 0.05) | ((edited - view.image).abs().amax(dim=2) > 2 / 255)
    scene = crop_scene(setup.scene, setup.region.members, camera, box, setup.background)
    return scene, shrink, shrink(counted.float()[..., None])


def probe_views(
    setup: TrainingSetup, count: int = _PROBES, still: bool = False, engine: str = "cpu"
) -> list[CropScene]:
    """Return a small number of training views at half size for measuring movement; see `crop_scene` for the
    arguments."""
    scene = setup.scene.to(engine_device(engine))
    chosen = setup.train[:: max(1, len(setup.train) // count)][:count]
    return [
        crop_scene(
            scene,
            setup.region.members,
            view.camera.resize(max(1, view.camera.width // 2), max(1, view.camera.height // 2)),
            (view.box[0] // 2, view.box[1] // 2, max(1, view.box[2] // 2), max(1, view.box[3] // 2)),
            setup.background,
            still,
            engine,
        )
        for view in chosen
    ]
