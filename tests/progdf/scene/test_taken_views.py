"""Tests of the remembered views of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io.atomic import state_folder
from progdf.io.picture_camera import find_picture_camera
from progdf.scene import taken_views as module
from progdf.scene.taken_views import find_taken_view, remember_view, taken_views
from tests.helpers.camera_tables import some_cameras
from tests.helpers.changed_pictures import Pixels


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(module, "MAX_VIEWS", 3)
    monkeypatch.setattr(module, "MAX_SCENES", 2)
    return tmp_path / "robot.ply"


def pattern(seed: int, size: tuple[int, int] = (240, 320)) -> Pixels:
    """Return a picture with texture of all sizes. [H,W,3]"""
    rng = np.random.default_rng(seed)
    total = np.zeros((*size, 3))
    for cells in (4, 9, 30):
        noise = Image.fromarray(rng.integers(0, 256, (cells, cells, 3), np.uint8))
        total += np.asarray(noise.resize(size[::-1], Image.Resampling.BICUBIC))
    return (total / 3).astype(np.uint8)


def test_last_views_are_kept_with_their_cameras(scene: Path) -> None:
    cameras = some_cameras()[:2]
    for number in range(5):
        remember_view(scene, pattern(number), cameras[number % 2], ["scarf"] if number == 4 else [])
    views = taken_views(scene)
    assert len(views) == 3
    assert [view.edits for view in views] == ["scarf", "", ""]
    assert torch.equal(views[0].camera.viewmat, cameras[0].viewmat)
    assert np.array_equal(views[1].image, pattern(3))
    assert taken_views(scene.with_name("other.ply")) == []


def test_damaged_views_are_ignored_and_replaced(scene: Path) -> None:
    for number in range(3):
        remember_view(scene, pattern(number), some_cameras()[0])
    (folder,) = (state_folder() / "views").iterdir()
    first, second, _ = sorted(folder.iterdir())
    first.write_bytes(b"")
    second.write_bytes(second.read_bytes()[:300])
    (folder / "notes.txt").touch()
    assert len(taken_views(scene)) == 1
    remember_view(scene, pattern(3), some_cameras()[0])
    assert len(taken_views(scene)) == 2


def test_oldest_scene_is_forgotten(scene: Path) -> None:
    names = [scene.with_name(f"{name}.ply") for name in "abc"]
    for name in names:
        remember_view(name, pattern(0), some_cameras()[0])
    assert [len(taken_views(name)) for name in names] == [0, 1, 1]


def test_unwritable_state_folder_is_no_error(scene: Path) -> None:
    (state_folder()).parent.mkdir(parents=True, exist_ok=True)
    state_folder().touch()
    remember_view(scene, pattern(0), some_cameras()[0])
    assert taken_views(scene) == []


def test_jpeg_of_a_taken_view_gets_its_camera_beside_it(scene: Path, tmp_path: Path) -> None:
    camera = some_cameras()[0]
    for number in range(3):
        remember_view(scene, pattern(number), camera)
    image = pattern(1)
    image[40:120, 60:200] = (200, 30, 30)
    path = tmp_path / "back.jpg"
    Image.fromarray(image).save(path, quality=80)
    found = find_taken_view(path, scene)
    assert found is not None
    assert "of its detail agrees" in found.agreement
    assert torch.equal(find_picture_camera(path).viewmat, camera.viewmat)
    assert torch.allclose(find_picture_camera(path).K, camera.resize(320, 240).K)
    other = tmp_path / "other.jpg"
    Image.fromarray(pattern(9)).save(other)
    assert find_taken_view(other, scene) is None
    assert not other.with_name("other.camera.json").exists()


def test_picture_of_an_edited_view_is_refused(scene: Path, tmp_path: Path) -> None:
    remember_view(scene, pattern(1), some_cameras()[0], ["scarf"])
    Image.fromarray(pattern(1)).save(tmp_path / "worn.jpg")
    with pytest.raises(ProgdfError, match=r"shows edits \(scarf\)"):
        find_taken_view(tmp_path / "worn.jpg", scene)
