"""Test of the editor `paint`: paint with transparency over several views."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.compose.reference import edited_scene
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.picture_camera import save_picture_camera
from progdf.metrics.image import psnr
from progdf.region import whole_scene
from progdf.sh import rgb_to_sh0
from progdf.surface.find import orbit
from tests.trainer.painted_wall import CAMERA, SIDE, picture, wall
from trainer.editors.base import EditorInput
from trainer.editors.paint import PaintEditor, check_paint, paint
from trainer.options import EditorOptions
from trainer.run.paint import make_goal, mean_square_error, recolor_gdf, recolor_paint
from trainer.run.pasted import train_decal


def put(path: Path, degrees: float = 0.0, color: tuple[int, int, int] = (200, 30, 40)) -> Path:
    """Write a painted square in the middle of a view of the wall, with its camera."""
    pixels = np.zeros((SIDE, SIDE, 4), np.uint8)
    pixels[52:76, 52:76] = (*color, 255)
    Image.fromarray(pixels).save(path)
    save_picture_camera(path, orbit(CAMERA, torch.zeros(3), degrees) if degrees else CAMERA)
    return path


def make(scene: Gaussians, *paths: Path) -> PaintEditor:
    text = ",".join(map(str, paths))
    given = EditorInput(text, scene, whole_scene(scene), (), EditorOptions(f"paint:{text}"))
    return paint(given)


@pytest.mark.slow
def test_paint_of_one_view_is_reproduced(tmp_path: Path) -> None:
    scene = wall()
    editor = make(scene, put(tmp_path / "a.png"))
    painted = train_decal(editor, scene, "paint")
    (view,) = editor.paints
    assert psnr(picture(edited_scene(scene, painted.gdf)), view.picture, view.mask) > 28.0
    assert painted.choice.startswith("the paint is made of ")
    assert painted.figures["pixels"] == 24 * 24


def test_later_pictures_cover_earlier_ones(tmp_path: Path) -> None:
    scene = wall(count=20_000, size=0.035, rough=0.01)
    red = put(tmp_path / "a.png")
    blue = put(tmp_path / "b.png", 10.0, (20, 40, 220))
    first, second = make(scene, red, blue).paints
    assert float(first.picture[64, 64, 2]) > 0.7, "the blue of the second picture, projected"
    assert float(second.picture[64, 64, 2]) > 0.7
    first, second = make(scene, blue, red).paints
    assert float(second.picture[64, 64, 0]) > 0.7


def test_colors_are_linear_in_the_strength(tmp_path: Path) -> None:
    scene = wall()
    goal = make_goal(scene, make(scene, put(tmp_path / "a.png")).paints)
    recolored = recolor_paint(goal)
    gdf = recolor_gdf(recolored, scene, "paint")
    half, full = (picture(edited_scene(scene, gdf, s)) for s in (0.5, 1.0))
    assert float((half - 0.5 * (picture(scene) + full)).abs().max()) < 0.02
    assert mean_square_error(recolored.ended, goal.views) < mean_square_error(scene, goal.views)


def test_recolored_gaussians_lie_between_their_color_and_the_paint(tmp_path: Path) -> None:
    scene = wall()
    goal = make_goal(scene, make(scene, put(tmp_path / "a.png")).paints)
    ended = recolor_paint(goal).ended
    red = rgb_to_sh0(torch.tensor([200.0, 30.0, 40.0]) / 255.0)
    change = ended.sh0 - scene.sh0
    shares = change / (red - scene.sh0)
    assert float(shares.min()) > -1e-3
    assert float(shares.max()) < 1.001
    assert float((shares - shares.mean(dim=1, keepdim=True)).abs().max()) < 2e-3
    assert float(shares.max()) > 0.5


def test_pictures_without_paint_are_refused(tmp_path: Path) -> None:
    path = put(tmp_path / "a.png")
    options = EditorOptions(f"paint:{path}")
    check_paint(str(path), options)
    Image.fromarray(np.zeros((SIDE, SIDE, 4), np.uint8)).save(path)
    with pytest.raises(ProgdfError, match="is fully transparent; paint on it"):
        check_paint(str(path), options)
    Image.fromarray(np.full((SIDE, SIDE, 3), 9, np.uint8)).save(path)
    with pytest.raises(ProgdfError, match="has no transparent pixels"):
        check_paint(str(path), options)


def test_paint_beside_the_scene_is_refused(tmp_path: Path) -> None:
    scene = wall()
    small = scene[(scene.means[:, 0] < -1.0).nonzero()[:, 0]]
    with pytest.raises(ProgdfError, match="no paint lies on an opaque part"):
        make(small, put(tmp_path / "a.png"))
