"""Warp of a decal onto a surface, and the camera with which training projects it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.camera import Camera, intrinsics, look_at
from progdf.surface.find import PaintSurface
from progdf.surface.footprint import DepthPicture, fit_footprint
from trainer.editors.decal import draw_decal, parse_place
from viewer.camera.decal_warp import (
    DecalFrame,
    DecalMesh,
    decal_camera,
    is_hidden,
    painted_pixels,
    project,
    upright_on,
    vec3,
    visible_cells,
    warp_on_footprint,
    warp_on_surface,
)

SIDE = 200
VIEW = Camera(
    look_at(torch.tensor([1.0, 0.5, -3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])),
    intrinsics(math.radians(45), SIDE, SIDE),
    SIDE,
    SIDE,
)
SHAPE = (80, 40)
FRAME = DecalFrame((0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0), 0.6, 0.0, 3.0, 0.01)


def wall_picture(opaque_side: float = -math.inf) -> DepthPicture:
    """Return the depth of the plane z = 0; pixels whose point has a smaller x are holes."""
    K = VIEW.K.double().numpy()
    pixels = np.arange(SIDE) + 0.5
    columns, rows = np.meshgrid((pixels - K[0, 2]) / K[0, 0], (pixels - K[1, 2]) / K[1, 1])
    rays = np.stack([columns, rows, np.ones_like(columns)], 2) @ VIEW.viewmat[:3, :3].double().numpy()
    eye = VIEW.position.double().numpy()
    depth = -eye[2] / rays[..., 2]
    points = eye + depth[..., None] * rays
    return DepthPicture(VIEW, depth, np.full_like(depth, 1e-3), points[..., 0] >= opaque_side)


def laid(angle: float = 0.0, opaque_side: float = -math.inf) -> tuple[DecalFrame, DecalMesh]:
    picture = wall_picture(opaque_side)
    footprint = fit_footprint(picture, SIDE / 2, SIDE / 2, 30.0)
    assert footprint is not None
    frame = replace(FRAME, center=vec3(footprint.center), normal=vec3(footprint.normal), angle=angle)
    return frame, warp_on_footprint(frame, SHAPE, footprint, picture)


@pytest.mark.parametrize("angle", [0.0, 30.0])
def test_decal_lies_undistorted_on_a_slanted_plane(angle: float) -> None:
    frame, mesh = laid(angle)
    assert mesh.shown.all()
    assert np.abs(mesh.points[..., 2]).max() < 1e-4
    across = mesh.points[0, -1] - mesh.points[0, 0]
    down = mesh.points[-1, 0] - mesh.points[0, 0]
    assert np.linalg.norm(across) == pytest.approx(0.6, rel=1e-4)
    assert np.linalg.norm(down) == pytest.approx(0.3, rel=1e-4)
    assert float(across @ down) == pytest.approx(0.0, abs=1e-4)
    right, up = frame.axes()
    assert np.allclose(across, 0.6 * right, atol=1e-4)
    assert np.degrees(np.arccos(up @ np.array(frame.upright))) == pytest.approx(angle)


def test_ghost_ends_where_the_surface_ends() -> None:
    frame, mesh = laid(opaque_side=-0.1)
    inside = mesh.points[..., 0] - frame.center[0]
    assert mesh.shown[inside > 0.0].all()
    assert not mesh.shown[inside < -0.15].any()


def test_training_draws_the_decal_where_its_ghost_is(tmp_path: Path) -> None:
    pixels = np.zeros((40, 80, 4), np.uint8)
    pixels[10:30, 20:60] = 255
    Image.fromarray(pixels).save(tmp_path / "logo.png")
    frame, mesh = laid(25.0)
    camera, at = decal_camera(frame, SHAPE)
    drawn = draw_decal(tmp_path / "logo.png", parse_place(at, camera), camera)
    painted = painted_pixels(frame, camera, pixels[..., 3] > 0)
    assert ((drawn[..., 3] > 0.5).numpy() != painted).mean() < 0.01
    inner = mesh.points[6:19:12, 6:19:12]
    places = project(inner, camera)[0].reshape(-1, 2)
    rows, columns = np.nonzero(painted)
    for x, y in places:
        assert np.hypot(columns + 0.5 - x, rows + 0.5 - y).min() < 1.5, "corners of the visible part"
    assert painted.sum() == pytest.approx(0.25 * 2 * 60**2 / 4, rel=0.1)


def test_cells_across_a_step_are_not_drawn() -> None:
    frame, _ = laid()
    camera, _ = decal_camera(frame, SHAPE)
    depth = np.full((camera.height, camera.width), frame.distance)
    depth[:, camera.width // 2 :] += 0.5
    opaque = np.ones(depth.shape, bool)
    surface = PaintSurface(
        camera, depth, np.zeros((2, *depth.shape)), opaque, opaque.astype(int), opaque, 0.0
    )
    stepped = warp_on_surface(frame, SHAPE, surface, opaque)
    assert stepped.shown.all()
    assert (~stepped.joined).any(axis=0).sum() == 1, "one column of cells crosses the step"
    half = warp_on_surface(frame, SHAPE, surface, depth < frame.distance + 0.25)
    assert half.shown.mean() == pytest.approx(0.5, abs=0.05)


def test_cells_that_face_away_are_not_drawn() -> None:
    _, mesh = laid()
    assert visible_cells(mesh, VIEW)[1].all()
    behind = replace(
        VIEW, viewmat=look_at(torch.tensor([0.0, 0.0, 3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    )
    assert not visible_cells(mesh, behind)[1].any()


def test_level_counts_from_the_up_axis() -> None:
    up = (0.0, 1.0, 0.0)
    tilted = vec3(np.array([0.6, 0.8, 0.0]))
    wall = (0.0, 0.0, 1.0)
    assert upright_on(wall, up, tilted, level=True) == pytest.approx(up)
    assert upright_on(wall, up, tilted, level=False) == pytest.approx(tilted)
    floor = upright_on(up, up, (0.0, 0.6, 0.8), level=True)
    assert floor == pytest.approx((0.0, 0.0, 1.0)), "a floor has no level: the picture's axis along it"
    assert np.dot(upright_on(up, up, up, level=False), up) == pytest.approx(0.0)


def test_object_in_front_hides_the_decal() -> None:
    frame, mesh = laid()
    camera, _ = decal_camera(frame, SHAPE)
    free = np.full((camera.height, camera.width), frame.distance)
    opaque = np.ones(free.shape, bool)
    assert not is_hidden(mesh, frame, DepthPicture(camera, free, free, opaque))
    assert is_hidden(mesh, frame, DepthPicture(camera, 0.3 * free, free, opaque))
    assert not is_hidden(mesh, frame, DepthPicture(camera, 0.3 * free, free, ~opaque))
