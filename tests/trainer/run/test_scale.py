"""Independence of the unit of length: millimeter and kilometer scenes train to the same edit."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.camera import NEAR
from progdf.compose.reference import Layer, compose_layers
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians
from progdf.gdf.file import load_gdf
from progdf.region import Region
from progdf.scene.bounds import near_plane
from tests.helpers.demo_scenes import bear
from tests.helpers.trained import train
from trainer.options import (
    EditorOptions,
    FieldOptions,
    Kind,
    OptimizeOptions,
    RegionOptions,
    TrainingViewOptions,
    TrainOptions,
)
from trainer.views.view import region_rig, render_view, with_near_plane

FACTORS = (1e-3, 1e4)


def scaled(scene: Gaussians, factor: float) -> Gaussians:
    return replace(scene, means=factor * scene.means, log_scales=scene.log_scales + math.log(factor))


@pytest.mark.parametrize("factor", FACTORS)
def test_scene_of_any_size_is_trained_on_the_same_pictures(factor: float) -> None:
    demo = bear(1500)
    members = demo.members("scarf")
    region = Region("scarf", members, torch.zeros(1500).index_fill(0, members, 1.0))
    pictures = []
    for scene in (demo.gaussians, scaled(demo.gaussians, factor)):
        cameras = with_near_plane(region_rig(scene, region, 4, 64), scene)
        pictures.append([render_view(scene, camera, torch.ones(3)) for camera in cameras])
    for first, second in zip(*pictures, strict=True):
        assert float((first < 0.9).float().mean()) > 0.2, "there is something to see"
        assert float((first - second).abs().max()) < 0.01


def trained(folder: Path, scene: Gaussians, members: Tensor, editor: str, kind: Kind) -> Gaussians:
    """Return the scene with a full edit from a short training run."""
    folder.mkdir()
    save_ply(folder / "scene.ply", scene)
    labels = torch.zeros(len(scene), dtype=torch.uint8).index_fill(0, members, 1)
    np.save(folder / "labels.npy", labels.numpy())
    options = TrainOptions(
        folder / "scene.ply",
        folder / "edit",
        RegionOptions(f"labels:{folder / 'labels.npy'}:1"),
        EditorOptions(editor),
        views=TrainingViewOptions(views=6, image_size=64),
        optimize=OptimizeOptions(steps=40, stages=2, kind=kind),
        field=FieldOptions("separable"),
        threads=1,
    )
    train(options, quiet=True)
    return compose_layers(scene, [Layer(load_gdf(folder / "edit/edit.gdf", scene), 1.0)])


@pytest.mark.parametrize(
    ("editor", "kind"),
    [("recolor:#3060d0", "color"), ("darken:0.6", "style")],
)
@pytest.mark.slow
def test_scaled_scene_trains_to_the_same_picture(tmp_path: Path, editor: str, kind: Kind) -> None:
    demo = bear(1500)
    members = demo.members("scarf")
    region = Region("scarf", members, torch.zeros(1500).index_fill(0, members, 1.0))
    finished = {}
    for factor in (1.0, *FACTORS):
        scene = scaled(demo.gaussians, factor)
        edited = trained(tmp_path / f"{factor:g}", scene, members, editor, kind)
        (camera,) = with_near_plane(region_rig(scene, region, 1, 64), scene)
        finished[factor] = render_view(edited, camera, torch.ones(3))
        if factor == 1.0:
            change = finished[1.0] - render_view(scene, camera, torch.ones(3))
            assert float(change.abs().max()) > 0.2, "the edit shows"
    for factor in FACTORS:
        # each step of Adam divides by the size of the gradient, which amplifies rounding
        assert float((finished[factor] - finished[1.0]).abs().mean()) < 2e-3


def test_near_plane_is_closer_only_for_smaller_scenes() -> None:
    assert near_plane(1e-3) == pytest.approx(1e-5)
    assert near_plane(1.0) == near_plane(1e4) == NEAR
