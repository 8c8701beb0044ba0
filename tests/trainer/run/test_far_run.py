"""Run on a scene of doubles far from 0: the same edit as near 0, bit for bit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.formats.ply import load_ply
from progdf.gdf.file import load_gdf
from progdf.io.cameras import load_cameras
from progdf.io.images import read_picture, to_picture
from progdf.io.picture_camera import camera_chunk
from progdf.scene.regions import parse_region
from tests.helpers.ply_files import moved_columns, write
from tests.helpers.trained import quick_options, train
from trainer.options import RegionOptions, TrainingViewOptions, WriteViewsOptions, with_values
from trainer.regions import command
from trainer.regions.from_pictures import RegionRequest, region_kinds
from trainer.run.record import render_run_views, reopen_run
from trainer.run.run import RunResult
from trainer.views.picture_cameras import picture_cameras

FAR = (1e6, 2e6, -5e5)
BOX = (-0.9, -0.9, -0.4, 0.9, 0.9, 0.9)


@pytest.fixture(scope="module")
def runs(folder: Path) -> dict[str, RunResult]:
    """Train the same box of the bear near 0 and far from it.

    The means lie on a grid of 2⁻²⁰, which float32 holds near 0 and doubles hold at 2e6 (their step is 2⁻³²).
    Both files therefore hold the same scene.
    """
    results = {}
    bear = load_ply(folder / "scene.ply")
    bear = replace(bear, means=(bear.means * 2**20).round() / 2**20)
    for name, origin in (("near", (0.0, 0.0, 0.0)), ("far", FAR)):
        write(folder / f"{name}.ply", moved_columns(bear, origin))
        box = ",".join(map(repr, np.add(BOX, 2 * origin).tolist()))
        more = {
            "views": 4,
            "image_size": 48,
            "steps": 16,
            "stages": 2,
            "region": f"box:{box}",
            "name": "coat",
        }
        options = with_values(quick_options(folder), scene=folder / f"{name}.ply", out=folder / name, **more)
        results[name] = train(options)
    return results


def test_edit_is_the_same_near_and_far(folder: Path, runs: dict[str, RunResult]) -> None:
    near, far = (load_gdf(runs[name].gdf, load_ply(folder / f"{name}.ply")) for name in ("near", "far"))
    assert torch.equal(far.region.members, near.region.members)
    assert torch.equal(far.field.offsets(0.7), near.field.offsets(0.7))
    assert near.scene != far.scene


def test_run_cameras_are_in_world_coordinates_and_read_back(folder: Path, runs: dict[str, RunResult]) -> None:
    near = load_cameras(runs["near"].folder.cameras)
    for a, b in zip(near, load_cameras(runs["far"].folder.cameras), strict=True):
        assert np.abs((b.position - a.position).numpy() - FAR).max() < 1.0  # float32 at 2e6
    for a, b in zip(near, load_cameras(runs["far"].folder.cameras, FAR), strict=True):
        assert torch.allclose(a.viewmat, b.viewmat, atol=1e-6)


def test_far_run_is_reopened_with_its_views(runs: dict[str, RunResult]) -> None:
    views = render_run_views(reopen_run(runs["far"].folder.root)).views
    for view in views:
        original = read_picture(runs["far"].folder.view("original", view.camera.name))
        assert float((view.image.clamp(0, 1) - original).abs().max()) < 2 / 255


def test_masks_over_views_of_a_far_scene_select_a_region(folder: Path, runs: dict[str, RunResult]) -> None:
    scene = load_ply(folder / "far.ply")
    command.write(WriteViewsOptions(folder / "far.ply", folder / "drawn", views=4, image_size=64))
    for path in sorted((folder / "drawn" / "original").iterdir()):
        picture = read_picture(path)
        mask = (picture.mean(dim=2) < 0.5).float()[..., None].expand(-1, -1, 3)
        to_picture(mask).save(folder / "drawn" / path.name)
    settings = RegionRequest(
        RegionOptions("masks"), TrainingViewOptions(scene=folder / "far.ply"), lambda: folder, True
    )
    found = parse_region(f"masks:{folder / 'drawn'}", scene, kinds=region_kinds(settings))
    assert 0 < len(found) < len(scene)


def test_changed_picture_of_a_far_scene_selects_a_region(folder: Path, runs: dict[str, RunResult]) -> None:
    scene = load_ply(folder / "far.ply")
    view = render_run_views(reopen_run(runs["far"].folder.root)).views[0]
    changed = view.image.clone()
    changed[16:28, 18:30] = torch.tensor([0.1, 0.2, 0.9])
    path = folder / "A.png"
    to_picture(changed).save(path, pnginfo=camera_chunk(view.camera, origin=scene.origin))
    (camera,) = picture_cameras([path], (), scene.origin)
    assert torch.allclose(camera.viewmat, view.camera.viewmat, atol=1e-6)
    settings = RegionRequest(
        RegionOptions("changed"), TrainingViewOptions(pictures=(path,)), lambda: folder, True
    )
    found = parse_region("changed", scene, kinds=region_kinds(settings))
    assert 0 < len(found) < len(scene) // 2
