"""A scene far from 0 gives the same pictures, cameras and regions as near 0."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import moderngl
import numpy as np
import pytest
import torch

from progdf.camera import Camera
from progdf.cli.info import survey
from progdf.errors import ProgdfError
from progdf.formats.scene_file import load_scene
from progdf.gaussians import Gaussians
from progdf.io.cameras import load_cameras, save_cameras
from progdf.rasterize import render
from progdf.rasterize.engines import render_depth
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import parse_region
from progdf.scene.subject import subject_rows
from progdf.scene.up_axis import find_up
from tests.helpers.ply_files import moved_columns, write
from tests.helpers.stacks import Stack
from viewer.camera.view_camera import first_camera, move_camera
from viewer.render.engine import ViewEngine
from viewer.state.view_state import ViewState

MOVES = [1e3, 1e5, 1e6, 1234567.891]
"""The last offset is on no grid: positions are rounded again, to 1e-7 of the scene's size."""

ENGINES = {"cpu": 3, "reference": 1, "gl": 3}
"""Number of cameras per engine; the reference engine is slow."""


@pytest.fixture(scope="module", params=MOVES)
def moved(request: pytest.FixtureRequest, stack: Stack, tmp_path_factory: pytest.TempPathFactory) -> Moved:
    return Moved(stack.scene, request.param, tmp_path_factory.mktemp("moved"))


class Moved:
    """A scene near 0 and the same scene loaded far from 0.

    Args:
        scene: near 0
        by: offset in world units: `by` along x, 2 `by` along y, -`by` along z
        folder: folder for its files
    """

    def __init__(self, scene: Gaussians, by: float, folder: Path) -> None:
        self.near, self.by, self.folder = scene, np.array([by, 2 * by, -by]), folder
        self.far = load_scene(write(folder / "far.ply", moved_columns(scene, self.by.tolist())))

    def cameras(self, cameras: list[Camera]) -> list[Camera]:
        """Return the cameras moved like the scene, after a round trip through a file."""
        x, y, z = self.by.tolist()
        save_cameras(self.folder / "cameras.json", cameras, (x, y, z))
        return load_cameras(self.folder / "cameras.json", self.far.origin)

    def spec(self, kind: str, point: tuple[float, ...], rest: str) -> str:
        """Return a region spec whose points are moved like the scene."""
        points = np.reshape(point, (-1, 3)) + self.by
        return f"{kind}:{','.join(map(repr, points.ravel().tolist()))}{rest}"


@pytest.fixture(scope="module")
def cameras(stack: Stack) -> list[Camera]:
    return orbit_rig(stack.scene, 3, 80, 60)


@pytest.fixture
def draw(ctx: moderngl.Context, request: pytest.FixtureRequest) -> Iterator[object]:
    engines: list[ViewEngine] = []

    def picture(scene: Gaussians, camera: Camera) -> np.ndarray:
        if request.param != "gl":
            return render(scene, camera, engine=request.param).image.detach().clamp(0, 1).numpy()
        engines.append(ViewEngine(ctx, scene, (), "gl"))
        return np.asarray(engines[-1].image(ViewState(), camera=camera))

    yield picture
    for engine in engines:
        engine.release()


@pytest.mark.parametrize(("draw", "count"), ENGINES.items(), indirect=["draw"])
def test_pictures_do_not_change(moved: Moved, cameras: list[Camera], draw: object, count: int) -> None:
    for camera, same in zip(cameras[:count], moved.cameras(cameras[:count]), strict=True):
        off = np.abs(draw(moved.far, same) - draw(moved.near, camera))  # type: ignore[operator]
        assert off.max() <= 1 / 255


def test_depth_does_not_change(moved: Moved, cameras: list[Camera]) -> None:
    far = render_depth(moved.far, moved.cameras(cameras)[0])
    near = render_depth(moved.near, cameras[0])
    assert torch.allclose(far.depth, near.depth, atol=1e-4)


def test_up_axis_orbit_rig_and_subject_do_not_change(moved: Moved) -> None:
    near = moved.near
    far = moved.far
    up = find_up(near)
    assert (find_up(far).name, find_up(far).reason) == (up.name, up.reason)
    assert torch.equal(subject_rows(far, up.direction), subject_rows(near, up.direction))
    radius = survey(near).radius
    by = moved.by - far.origin
    for a, b in zip(orbit_rig(near, 5, 64, 64), orbit_rig(far, 5, 64, 64), strict=True):
        assert torch.allclose(a.viewmat[:3, :3], b.viewmat[:3, :3], atol=1e-6)
        assert np.abs((b.position - a.position).numpy() - by).max() < 1e-5 * radius


def test_first_view_does_not_change(moved: Moved) -> None:
    near = first_camera(moved.near)
    far = first_camera(moved.far)
    x, y, z = (moved.by - moved.far.origin).tolist()
    assert np.allclose(far.pivot, move_camera(near, (x, y, z)).pivot, atol=1e-4)
    assert np.allclose(
        (far.distance, far.azimuth, far.elevation), (near.distance, near.azimuth, near.elevation)
    )


@pytest.mark.parametrize(
    ("kind", "point", "rest"),
    [
        ("box", (-1.013, -0.517, -0.511, 0.497, 0.503, 1.009), ""),
        ("sphere", (0.011, 0.207, 0.303), ",0.71"),
        ("flood", (0.0, 0.3, 0.6), ",0.1"),
    ],
)
def test_region_in_world_coordinates_is_the_same(
    moved: Moved, kind: str, point: tuple[float, ...], rest: str
) -> None:
    near = parse_region(f"{kind}:{','.join(map(repr, point))}{rest}", moved.near)
    far = parse_region(moved.spec(kind, point, rest), moved.far)
    assert 10 < len(near) < len(moved.near)
    assert torch.equal(far.members, near.members)


@pytest.mark.parametrize("shape", ["rectangle:{}:20,20,60,60", "front:{}"])
def test_region_drawn_over_a_picture_is_the_same(moved: Moved, cameras: list[Camera], shape: str) -> None:
    save_cameras(moved.folder / "near.json", cameras)
    moved.cameras(cameras)
    near = parse_region(shape.format(moved.folder / "near.json"), moved.near)
    assert torch.equal(
        parse_region(shape.format(moved.folder / "cameras.json"), moved.far).members, near.members
    )


def test_empty_region_error_gives_world_coordinates(moved: Moved) -> None:
    x = survey(moved.near).box[0] + moved.by[0]
    with pytest.raises(ProgdfError, match=rf"the scene spans x {int(x)}\.\d+ to "):
        parse_region("box:0,0,0,1,1,1", moved.far)
