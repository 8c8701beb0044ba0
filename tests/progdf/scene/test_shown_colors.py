"""Colors that Gaussians show in a view, and flooding from a pixel."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.cameras import save_cameras
from progdf.scene.regions import check_region, parse_region
from progdf.scene.selection import base_colors, pixel_color, rows_at_pixel, shown_colors
from progdf.sh import rgb_to_sh0
from tests.helpers.scenes import random_gaussians

SIDE = 30
FRONT = np.ones(SIDE * SIDE, bool)


def speckled_sheet() -> Gaussians:
    """Return a sheet of red and blue Gaussians that blend to purple on its left half; the right is green."""
    x, y = torch.meshgrid(torch.linspace(-1, 1, SIDE), torch.linspace(-1, 1, SIDE), indexing="xy")
    means = torch.stack([x.flatten(), y.flatten(), torch.zeros(SIDE * SIDE)], dim=1)
    even = (torch.arange(SIDE * SIDE) + torch.arange(SIDE * SIDE) // SIDE) % 2 == 0
    colors = torch.where(even[:, None], torch.tensor([0.9, 0.1, 0.1]), torch.tensor([0.1, 0.1, 0.9]))
    colors = torch.where((means[:, :1] > 0), torch.tensor([0.1, 0.8, 0.1]), colors)
    scene = random_gaussians(len(means), seed=1)
    return replace(
        scene,
        means=means,
        log_scales=torch.full_like(means, math.log(0.12)),
        logit_opacities=torch.zeros(len(means)),
        sh0=rgb_to_sh0(colors),
        shN=scene.shN[:, :0],
    )


def camera() -> Camera:
    viewmat = look_at(torch.tensor([0.0, 0.0, 3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    return Camera(viewmat, intrinsics(math.radians(50.0), 96, 96), 96, 96)


def test_shown_colors_are_those_of_the_picture() -> None:
    scene = speckled_sheet()
    left = (scene.means[:, 0] < -0.3).numpy()
    color = pixel_color(scene, camera(), 30, 48)
    own = np.linalg.norm(base_colors(scene)[left] - color, axis=1)
    shown = np.linalg.norm(shown_colors(scene, camera(), FRONT)[left] - color, axis=1)
    assert np.median(own) > 0.1
    assert np.median(shown) < 0.05


def test_hidden_gaussians_keep_their_own_color() -> None:
    scene = speckled_sheet()
    away = replace(camera(), viewmat=torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0])) @ camera().viewmat)
    assert np.allclose(shown_colors(scene, away, FRONT), base_colors(scene), atol=1e-6)
    assert np.array_equal(shown_colors(scene, camera(), ~FRONT), base_colors(scene))


def test_pixel_lists_its_gaussians_with_their_shares() -> None:
    rows, shares = rows_at_pixel(speckled_sheet(), camera(), 30, 48)
    assert len(rows) > 1
    assert 0.5 < shares.sum() <= 1.0


def test_flood_from_a_pixel_selects_its_color_on_screen(tmp_path: Path) -> None:
    scene = speckled_sheet()
    save_cameras(tmp_path / "view.json", [camera()])
    chosen = parse_region(f"flood:{tmp_path}/view.json:30,48,0.1", scene).mask.numpy()
    left = (scene.means[:, 0] < -0.3).numpy()
    assert chosen[left].mean() > 0.9
    assert chosen[(scene.means[:, 0] > 0.3).numpy()].mean() < 0.05


@pytest.mark.parametrize("text", ["flood:view.json:1", "flood:view.json:1,2,3,4", "flood:view.json:1,2,0"])
def test_flood_with_wrong_numbers_is_refused(text: str, tmp_path: Path) -> None:
    save_cameras(tmp_path / "view.json", [camera()])
    with pytest.raises(ProgdfError):
        check_region(text.replace("view.json", f"{tmp_path}/view.json"))
