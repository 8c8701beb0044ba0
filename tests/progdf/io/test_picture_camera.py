"""Tests of the camera stored in a rendered picture, and of substitutes where a program removed it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.cameras import PICTURE_KEY, camera_in_picture, cameras_to_json, load_cameras, save_cameras
from progdf.io.picture_camera import camera_chunk, find_picture_camera, save_picture_camera
from tests.helpers.camera_tables import some_cameras
from tests.helpers.refused import refusal


def saved(path: Path, camera: Camera | None, size: tuple[int, int] = (32, 20)) -> Path:
    Image.new("RGB", size, "gray").save(path, pnginfo=camera_chunk(camera) if camera else None)
    return path


def with_text(path: Path, text: str, zipped: bool = False) -> Path:
    info = PngInfo()
    info.add_text(PICTURE_KEY, text, zip=zipped)
    Image.new("RGB", (8, 8)).save(path, pnginfo=info)
    return path


def assert_same(found: Camera | None, expected: Camera) -> None:
    assert found is not None
    assert torch.equal(found.viewmat, expected.viewmat)
    assert torch.equal(found.K, expected.K)
    assert (found.width, found.height) == (expected.width, expected.height)


def test_picture_returns_its_stored_camera_to_the_bit(tmp_path: Path) -> None:
    camera = some_cameras()[1]
    path = saved(tmp_path / "A.png", camera)
    assert_same(find_picture_camera(path), camera)
    assert find_picture_camera(path).name == "A"
    assert_same(load_cameras(path)[0], camera)


def test_text_chunk_after_the_pixels_is_found(tmp_path: Path) -> None:
    path = saved(tmp_path / "A.png", some_cameras()[1])
    content = path.read_bytes()
    at = content.index(b"tEXt") - 4
    length = 12 + int.from_bytes(content[at : at + 4], "big")
    end = content.index(b"IEND") - 4
    chunk = content[at : at + length]
    path.write_bytes(content[:at] + content[at + length : end] + chunk + content[end:])
    assert_same(find_picture_camera(path), some_cameras()[1])


def test_camera_file_beside_the_picture_replaces_the_text(tmp_path: Path) -> None:
    camera, other = some_cameras()[:2]
    path = saved(tmp_path / "A.png", None)
    save_cameras(tmp_path / "A.camera.json", [camera])
    assert_same(find_picture_camera(path), camera)
    saved(path, other)  # the camera in the picture has priority
    assert_same(find_picture_camera(path), other)


def test_saved_camera_beside_the_picture_is_found_again(tmp_path: Path) -> None:
    camera, other = some_cameras()[:2]
    path = saved(tmp_path / "A.jpg", None)
    save_picture_camera(path, other)
    save_picture_camera(path, camera)
    assert_same(find_picture_camera(path), camera)


def test_only_one_saved_camera_is_overwritten(tmp_path: Path) -> None:
    path = saved(tmp_path / "A.png", None)
    beside = tmp_path / "A.camera.json"
    save_cameras(beside, some_cameras()[:2])
    with pytest.raises(ProgdfError, match=r"A\.camera\.json holds 2 cameras; move it"):
        save_picture_camera(path, some_cameras()[0])
    beside.write_text("[]")
    with pytest.raises(ProgdfError, match=r"A\.camera\.json is not a saved camera; move it"):
        save_picture_camera(path, some_cameras()[0])
    assert beside.read_text() == "[]"


def test_jpeg_takes_the_given_camera_of_its_name(tmp_path: Path) -> None:
    cameras = some_cameras()
    for name in (cameras[2].name, f"images/{cameras[2].name}.PNG"):
        named = [*cameras[:2], Camera(cameras[2].viewmat, cameras[2].K, 320, 200, name)]
        path = tmp_path / f"{cameras[2].name}.jpg"
        Image.new("RGB", (64, 40)).save(path)
        assert_same(find_picture_camera(path, named), cameras[2])


def test_picture_without_a_camera_is_reported_in_one_line(tmp_path: Path) -> None:
    path = saved(tmp_path / "A.png", None)
    message = refusal(find_picture_camera, path)
    assert "A.camera.json" in message
    assert "--cameras" in message
    cameras = some_cameras()
    save_cameras(tmp_path / "A.camera.json", cameras)
    with pytest.raises(ProgdfError, match="holds 4 cameras; keep the one"):
        find_picture_camera(path)
    (tmp_path / "A.camera.json").unlink()
    twice = [Camera(c.viewmat, c.K, c.width, c.height, "A") for c in cameras[:2]]
    with pytest.raises(ProgdfError, match="2 cameras are named A; give"):
        find_picture_camera(path, twice)


def test_files_that_are_no_pictures_are_reported_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "A.png"
    assert "does not exist" in refusal(find_picture_camera, path)
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    assert "cannot be read" in refusal(find_picture_camera, path)


def changed(change: Callable[[dict[str, Any]], object]) -> str:
    content = json.loads(cameras_to_json(some_cameras()[:1]))
    change(content)
    return json.dumps(content)


HOSTILE = {
    "broken JSON": '{"format": "progdf cameras 1", "cameras": [',
    "no object": "[" * 60_000,
    "another format": changed(lambda c: c.update(format="progdf cameras 2")),
    "no camera": changed(lambda c: c.update(cameras=[])),
    "two cameras": changed(lambda c: c["cameras"].append(c["cameras"][0])),
    "transforms": json.dumps({"frames": [{"file_path": "/etc/passwd"}]}),
    "a negative size": changed(lambda c: c["cameras"][0].update(width=-4)),
    "an endless size": changed(lambda c: c["cameras"][0].update(height=10**12)),
    "half a pixel": changed(lambda c: c["cameras"][0].update(width=3.5)),
    "no rotation": changed(lambda c: c["cameras"][0].update(viewmat=[[2.0] * 4] * 4)),
    "words": changed(lambda c: c["cameras"][0].update(K="wide")),
    "not finite": changed(lambda c: c).replace("320", "1e999", 1),
    "NaN": changed(lambda c: c).replace("320", "NaN", 1),
    "no focal length": changed(lambda c: c["cameras"][0].update(K=[[0.0] * 3] * 3)),
    "a megabyte": " " * (1 << 20) + changed(lambda c: c),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_text_is_reported_in_one_line(tmp_path: Path, what: str) -> None:
    refusal(camera_in_picture, with_text(tmp_path / "A.png", HOSTILE[what]))


def test_text_that_unpacks_to_gigabytes_is_reported_in_one_line(tmp_path: Path) -> None:
    path = with_text(tmp_path / "A.png", " " * (64 << 20), zipped=True)
    assert path.stat().st_size < 1 << 20
    refusal(camera_in_picture, path)
