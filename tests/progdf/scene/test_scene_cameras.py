"""Tests of moving cameras into a scene's frame, and of refusing cameras of another scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.cameras import save_cameras
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.scene_cameras import load_scene_cameras
from progdf.scene.up_axis import find_up
from tests.helpers.demo_scenes import bear, room
from tests.helpers.nerfstudio import move_scene, write_frames, write_transforms

UP_Y = torch.tensor([0.0, 1.0, 0.0])
APPLIED = torch.tensor([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], dtype=torch.float64)
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))  # from OpenCV's camera axes to OpenGL's
SCALE = 0.23


def scene() -> Gaussians:
    return bear(1500).gaussians


def rig(count: int = 12, to: Gaussians | None = None) -> list[Camera]:
    return orbit_rig(to or scene(), count, 64, 64, up=UP_Y)


def to_nerfstudio(cameras: Sequence[Camera]) -> Tensor:
    """Return nerfstudio's rigid motion, which centers cameras and rotates their mean up to +z. [4,4]"""
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3] = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    centers = torch.stack([camera.position for camera in cameras]).double()
    motion[:3, 3] = -motion[:3, :3] @ (centers.mean(dim=0) + torch.tensor([2.0, 0.5, -1.0]))
    return motion


def assert_same_views(found: Sequence[Camera], given: Sequence[Camera], way: Tensor, scale: float) -> None:
    """Check that the moved cameras see the moved scene as the given cameras see the original."""
    point = torch.tensor([0.3, -0.2, 0.5])
    moved_point = (scale * (way[:3, :3] @ point.double() + way[:3, 3])).float()
    for one, other in zip(found, given, strict=True):
        before = other.viewmat[:3, :3] @ point + other.viewmat[:3, 3]
        after = one.viewmat[:3, :3] @ moved_point + one.viewmat[:3, 3]
        torch.testing.assert_close(after, scale * before, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("beside", ["scene", "cameras", "checkpoint"])
@pytest.mark.parametrize("kind", ["plain", "applied", "older"])
def test_nerfstudio_frames_are_applied(tmp_path: Path, beside: str, kind: str) -> None:
    cameras = rig()
    motion = to_nerfstudio(cameras)
    fields = {} if kind == "plain" else {"applied_transform": APPLIED[:3].tolist()}
    for name in ("s", "c", "s/nerfstudio_models"):
        (tmp_path / name).mkdir()
    file = write_frames(tmp_path / "c" / "transforms.json", cameras, **fields)
    stated = motion @ APPLIED if kind == "applied" else motion
    write_transforms(tmp_path / ("c" if beside == "cameras" else "s"), stated, SCALE)
    path = tmp_path / ("s/nerfstudio_models/step.ckpt" if beside == "checkpoint" else "s/scene.ply")
    found = load_scene_cameras(file, move_scene(scene(), motion, SCALE), path)
    assert_same_views(found.cameras, cameras, motion, SCALE)
    (note,) = found.notes
    assert note.startswith("cameras: moved into nerfstudio's frame by")


def test_applied_scale_is_included(tmp_path: Path) -> None:
    cameras = rig()
    motion = to_nerfstudio(cameras)
    fields = {"applied_transform": APPLIED[:3].tolist(), "applied_scale": 2.0}
    file = write_frames(tmp_path / "transforms.json", cameras, **fields)
    write_transforms(tmp_path, motion @ APPLIED, 2.0 * SCALE)
    found = load_scene_cameras(file, move_scene(scene(), motion, SCALE))
    assert_same_views(found.cameras, cameras, motion, SCALE)


def test_scene_in_the_dataset_frame_keeps_its_cameras(tmp_path: Path) -> None:
    cameras = rig()
    file = write_frames(tmp_path / "transforms.json", cameras)
    write_transforms(tmp_path, to_nerfstudio(cameras), 40.0)
    found = load_scene_cameras(file, scene())
    assert "is not applied" in found.notes[0]
    assert_same_views(found.cameras, cameras, torch.eye(4, dtype=torch.float64), 1.0)


def test_scene_older_than_applied_transform_gets_its_cameras(tmp_path: Path) -> None:
    away = torch.eye(4, dtype=torch.float64)
    away[:3, 3] = torch.tensor([0.0, 30.0, 0.0])
    world = move_scene(scene(), away, 1.0)
    cameras = rig(to=world)
    file = write_frames(
        tmp_path / "transforms.json",
        [replace(c, viewmat=(c.viewmat.double() @ torch.linalg.inv(APPLIED)).float()) for c in cameras],
        applied_transform=APPLIED[:3].tolist(),
    )
    found = load_scene_cameras(file, world)
    assert "is reverted" in found.notes[0]
    assert_same_views(found.cameras, cameras, torch.eye(4, dtype=torch.float64), 1.0)


def test_cameras_saved_by_progdf_are_never_moved(tmp_path: Path) -> None:
    cameras = rig()
    save_cameras(tmp_path / "cameras.json", cameras)
    write_transforms(tmp_path, to_nerfstudio(cameras), SCALE)
    found = load_scene_cameras(tmp_path / "cameras.json", scene())
    assert not found.notes
    assert torch.equal(found.cameras[0].viewmat, cameras[0].viewmat)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is damaged"),
        ('{"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0}', "is damaged"),
        ('{"transform": [[1, 0, 0]], "scale": 1}', "is damaged"),
        ('{"transform": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 1}', "not a rotation"),
    ],
)
def test_broken_transforms_are_refused_by_file(tmp_path: Path, content: str, message: str) -> None:
    file = write_frames(tmp_path / "transforms.json", rig())
    (tmp_path / "dataparser_transforms.json").write_text(content)
    with pytest.raises(ProgdfError, match=f"dataparser_transforms.json.*{message}"):
        load_scene_cameras(file, scene())


def shifted(cameras: Sequence[Camera], by: float) -> list[Camera]:
    move = torch.eye(4)
    move[0, 3] = -by
    return [replace(camera, viewmat=camera.viewmat @ move) for camera in cameras]


MISMATCHES = {
    "500 units away": lambda: shifted(rig(), 500.0),
    "seen from beside": lambda: shifted(rig(), 12.0),
    "other camera axes": lambda: [replace(c, viewmat=FLIP @ c.viewmat) for c in rig()],
}


@pytest.mark.parametrize("name", MISMATCHES)
def test_cameras_of_another_frame_are_refused_with_the_cause(tmp_path: Path, name: str) -> None:
    file = write_frames(tmp_path / "transforms.json", MISMATCHES[name]())
    with pytest.raises(ProgdfError, match=r"transforms.json is not in the frame of .*s\.ply") as caught:
        load_scene_cameras(file, scene(), tmp_path / "s.ply")
    message = str(caught.value)
    assert "add --cameras-anyway" in message
    assert "dataparser_transforms.json beside" in message
    assert ("behind 12 of 12" in message) == (name == "other camera axes")
    assert load_scene_cameras(file, scene(), anyway=True).cameras


def inside_room(count: int, spread: float = 1.0) -> tuple[Gaussians, list[Camera]]:
    gaussians = room(1500).gaussians
    generator = torch.Generator().manual_seed(3)
    center = gaussians.means.median(dim=0).values
    cameras = []
    for i in range(count):
        eye = center + spread * (torch.rand(3, generator=generator) - 0.5)
        heading = 2 * math.pi * i / count
        target = eye + torch.tensor([math.cos(heading), 0.0, math.sin(heading)])
        cameras.append(Camera(look_at(eye, target, UP_Y), intrinsics(0.9, 64, 48), 64, 48, f"c{i}"))
    return gaussians, cameras


def test_cameras_inside_a_room_pass(tmp_path: Path) -> None:
    gaussians, cameras = inside_room(10)
    save_cameras(tmp_path / "c.json", cameras)
    assert len(load_scene_cameras(tmp_path / "c.json", gaussians).cameras) == 10


def test_cameras_of_a_part_of_a_scene_pass(tmp_path: Path) -> None:
    gaussians, cameras = inside_room(40, 0.2)
    save_cameras(tmp_path / "c.json", cameras[:3])
    assert load_scene_cameras(tmp_path / "c.json", gaussians).cameras


@pytest.mark.parametrize("facing", [3, 6, 40])
def test_some_cameras_may_look_away(tmp_path: Path, facing: int) -> None:
    cameras = rig(40)
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away = [replace(camera, viewmat=turn @ camera.viewmat) for camera in cameras[facing:]]
    save_cameras(tmp_path / "c.json", [*cameras[:facing], *away])
    assert len(load_scene_cameras(tmp_path / "c.json", scene()).cameras) == 40


def test_up_comes_from_cameras_beside_the_scene_in_its_frame(tmp_path: Path) -> None:
    level = orbit_rig(scene(), 6, 64, 64, up=UP_Y, elevations=(0.0, 0.0))
    motion = to_nerfstudio(level)
    write_frames(tmp_path / "transforms.json", level)
    write_transforms(tmp_path, motion, SCALE)
    up = find_up(move_scene(scene(), motion, SCALE), path=tmp_path / "s.ply")
    assert (up.name, up.reason) == ("+z", "from the 6 cameras beside the scene's file")


def test_unused_cameras_beside_the_scene_are_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_cameras(tmp_path / "cameras.json", rig(6))
    find_up(replace(scene(), means=scene().means + torch.tensor([0.0, 500.0, 0.0])), path=tmp_path / "s.ply")
    assert "the 6 cameras beside" in caplog.text
    assert "do not face the scene and are not used" in caplog.text
