"""Tests of reading camera files of ProGDF and of other programs."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

import progdf
from progdf.camera import Camera, Lens
from progdf.errors import ProgdfError
from progdf.io.cameras import (
    kind_of_cameras,
    load_cameras,
    load_cameras_with_report,
    read_camera,
    save_cameras,
)
from tests.helpers.camera_tables import inria, nerfstudio, some_cameras, written
from tests.helpers.full_disk import files_up_to
from tests.helpers.refused import refusal


def assert_same_views(found: list[Camera], expected: list[Camera]) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a.viewmat, b.viewmat, atol=2e-6, rtol=0)  # two matrix inversions
        torch.testing.assert_close(a.K, b.K)
        assert (a.width, a.height) == (b.width, b.height)


def test_saved_cameras_load_to_the_same_bits(tmp_path: Path) -> None:
    cameras = some_cameras()
    save_cameras(tmp_path / "cameras.json", cameras)
    for found, expected in zip(load_cameras(tmp_path / "cameras.json"), cameras, strict=True):
        assert torch.equal(found.viewmat, expected.viewmat)
        assert torch.equal(found.K, expected.K)
        assert (found.width, found.height, found.name) == (expected.width, expected.height, expected.name)
    assert progdf.load_cameras is load_cameras


def test_sampling_of_a_camera_is_saved(tmp_path: Path) -> None:
    cameras = [replace(some_cameras()[0], sampling=sampling) for sampling in (1.0, math.sqrt(2.0))]
    save_cameras(tmp_path / "c.json", cameras)
    assert [camera.sampling for camera in load_cameras(tmp_path / "c.json")] == [1.0, math.sqrt(2.0)]
    assert (tmp_path / "c.json").read_text().count("sampling") == 1
    assert read_camera(f"{tmp_path / 'c.json'}:1").sampling == 1.0, "who looks from there sees a picture"


def test_single_camera_or_bare_list_is_read(tmp_path: Path) -> None:
    cameras = some_cameras()
    save_cameras(tmp_path / "cameras.json", cameras)
    entries = json.loads((tmp_path / "cameras.json").read_text())["cameras"]
    assert_same_views(load_cameras(written(tmp_path / "list.json", entries)), cameras)
    assert_same_views(load_cameras(written(tmp_path / "one.json", entries[1])), cameras[1:2])


def test_inria_cameras_are_read(tmp_path: Path) -> None:
    cameras = some_cameras()
    found = load_cameras(written(tmp_path / "cameras.json", inria(cameras)))
    assert_same_views(found, cameras)
    assert found[0].name == cameras[0].name


def test_inria_focal_lengths_belong_to_their_axes(tmp_path: Path) -> None:
    entries = inria(some_cameras())
    entries[0] |= {"fx": 200.0, "fy": 300.0}
    K = load_cameras(written(tmp_path / "cameras.json", entries))[0].K
    assert K.tolist() == [[200, 0, 160], [0, 300, 100], [0, 0, 1]]


def test_inria_principal_point_and_lens_are_used(tmp_path: Path) -> None:
    entries = inria(some_cameras())
    entries[0] |= {
        "cx": 100.0,
        "cy": 120.0,
        "k1": 0.1,
        "camera_model": "OPENCV",
        "scale": 1.0,
        "trans": [0, 0],
    }
    entries[1] |= {"cx": 90.5, "img_name": "left\\b"}
    first, second, *_ = load_cameras(written(tmp_path / "cameras.json", entries))
    assert first.K[:2, 2].tolist() == [100.0, 120.0]
    assert first.lens == Lens(k1=0.1)
    assert second.K[:2, 2].tolist() == [90.5, 100.0]
    assert (second.name, second.lens) == ("left/b", None)


def test_inria_fields_of_view_replace_missing_focal_lengths(tmp_path: Path) -> None:
    cameras = some_cameras()
    entries = inria(cameras)
    for entry in entries:
        entry["FoVx"] = 2 * math.atan(160 / entry.pop("fx"))
        entry["FoVy"] = 2 * math.atan(100 / entry.pop("fy"))
    assert_same_views(load_cameras(written(tmp_path / "cameras.json", entries)), cameras)


def test_nerfstudio_transforms_are_read(tmp_path: Path) -> None:
    cameras = some_cameras()
    assert_same_views(load_cameras(written(tmp_path / "t.json", nerfstudio(cameras))), cameras)


def test_frame_intrinsics_override_those_of_the_file(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras())
    content["frames"][2] |= {"fl_x": 111.0, "fl_y": 222.0, "cx": 30.0, "cy": 40.0, "w": 66, "h": 88}
    cameras = load_cameras(written(tmp_path / "t.json", content))
    assert cameras[2].K.tolist() == [[111, 0, 30], [0, 222, 40], [0, 0, 1]]
    assert (cameras[2].width, cameras[2].height) == (66, 88)
    assert_same_views(cameras[:2], some_cameras()[:2])


def test_field_of_view_replaces_a_missing_focal_length(tmp_path: Path) -> None:
    cameras = some_cameras()
    angle = 2 * math.atan(160 / float(cameras[0].K[0, 0]))
    content = nerfstudio(cameras, fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=angle)
    assert_same_views(load_cameras(written(tmp_path / "t.json", content)), cameras)


@pytest.mark.parametrize(
    ("given", "focal"),
    [
        ({"fl_x": 250.0}, (250, 250)),
        ({"fl_y": 240.0}, (240, 240)),
        ({"camera_angle_y": 2 * math.atan(100 / 240)}, (240, 240)),
        (
            {"camera_angle_x": 2 * math.atan(160 / 250), "camera_angle_y": 2 * math.atan(100 / 240)},
            (250, 240),
        ),
    ],
    ids=["fl_x", "fl_y", "angle y", "both angles"],
)
def test_intrinsics_of_one_axis_apply_to_both(
    given: dict[str, float], focal: tuple[float, float], tmp_path: Path
) -> None:
    content = nerfstudio(some_cameras(), **{"fl_x": None, "fl_y": None, **given})
    K = load_cameras(written(tmp_path / "t.json", content))[0].K
    assert (float(K[0, 0]), float(K[1, 1])) == pytest.approx(focal, rel=1e-6)


def test_frame_angle_overrides_the_focal_length_of_the_file(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras())
    content["frames"][1]["camera_angle_x"] = 2 * math.atan(160 / 123)
    cameras = load_cameras(written(tmp_path / "t.json", content))
    assert cameras[1].K.diagonal().tolist() == pytest.approx([123.0, 123.0, 1.0])
    assert_same_views(cameras[:1], some_cameras()[:1])


def test_fields_of_view_in_degrees_are_read(tmp_path: Path) -> None:
    angle = math.degrees(2 * math.atan(160 / 250))
    content = nerfstudio(some_cameras(), fl_x=None, fl_y=None, x_fov=angle)
    K = load_cameras(written(tmp_path / "t.json", content))[0].K
    assert (float(K[0, 0]), float(K[1, 1])) == pytest.approx((250, 250), rel=1e-6)


def test_disabled_lens_fields_change_nothing(tmp_path: Path) -> None:
    off = {"is_fisheye": False, "k4": 0.0, "rolling_shutter": [0, 0, 0], "camera_type": "perspective"}
    cameras = some_cameras()
    assert_same_views(load_cameras(written(tmp_path / "t.json", nerfstudio(cameras, **off))), cameras)


def test_ignored_fields_are_reported_once_in_order(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras(), aabb_scale=4, offset=0.5)
    content["frames"][0]["sharpness"] = 30.0
    content["frames"][1]["mask_path"] = "masks/a.png"
    _, report = load_cameras_with_report(written(tmp_path / "t.json", content))
    assert set(report.ignored) == {"aabb_scale", "offset", "sharpness", "mask_path"}
    assert report.ignored[:3] == ("aabb_scale", "offset", "sharpness")


def test_rounded_matrices_are_made_rotations(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras())
    for frame in content["frames"]:
        frame["transform_matrix"] = [[round(x, 3) for x in row] for row in frame["transform_matrix"]]
    for camera in load_cameras(written(tmp_path / "t.json", content)):
        rotation = camera.viewmat[:3, :3].double()
        error = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max()
        assert float(error) < 1e-6


@pytest.mark.parametrize("model", [None, "opencv", "Simple_Pinhole"])
def test_camera_model_may_be_missing_or_lowercase(model: str | None, tmp_path: Path) -> None:
    cameras = some_cameras()
    found = load_cameras(written(tmp_path / "t.json", nerfstudio(cameras, camera_model=model)))
    assert_same_views(found, cameras)
    assert found[0].name == f"{cameras[0].name}.png"


def test_missing_image_size_is_read_from_the_picture(tmp_path: Path) -> None:
    cameras = some_cameras()
    content = nerfstudio(cameras, w=None, h=None)
    assert "w and h" in refusal(load_cameras, written(tmp_path / "t.json", content))
    (tmp_path / "images").mkdir()
    for camera, frame in zip(cameras, content["frames"], strict=True):
        Image.new("RGB", (320, 200)).save(tmp_path / "images" / f"{camera.name}.png")
        frame["file_path"] = f"./images/{camera.name}"  # synthetic NeRF scenes omit the suffix
    assert_same_views(load_cameras(written(tmp_path / "t.json", content)), cameras)


def test_windows_paths_name_the_same_picture(tmp_path: Path) -> None:
    cameras = some_cameras()
    content = nerfstudio(cameras, w=None, h=None)
    (tmp_path / "images").mkdir()
    for camera, frame in zip(cameras, content["frames"], strict=True):
        Image.new("RGB", (320, 200)).save(tmp_path / "images" / f"{camera.name}.png")
        frame["file_path"] = f"images\\{camera.name}.png"
    found = load_cameras(written(tmp_path / "t.json", content))
    assert_same_views(found, cameras)
    assert [camera.name for camera in found] == [f"{camera.name}.png" for camera in cameras]


def test_distortion_is_kept_as_the_lens_of_the_camera(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras(), k1=0.1, k2=-0.02, p1=0.003, p2=0.004, k3=0.0)
    content["frames"][1] |= {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    cameras = load_cameras(written(tmp_path / "t.json", content))
    assert cameras[0].lens == Lens(0.1, -0.02, 0.003, 0.004)
    assert cameras[1].lens is None
    save_cameras(tmp_path / "kept.json", cameras)
    assert [camera.lens for camera in load_cameras(tmp_path / "kept.json")] == [c.lens for c in cameras]
    assert cameras[0].resize(32, 20).lens == cameras[0].lens


def test_number_of_distorted_cameras_is_logged(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    content = nerfstudio(some_cameras(), k1=0.1)
    content["frames"][1] |= {"k1": 0.0}
    with caplog.at_level(logging.INFO, logger="progdf"):
        load_cameras(written(tmp_path / "t.json", content))
        assert "3 of 4 cameras have lens distortion" in caplog.text
        caplog.clear()
        load_cameras(written(tmp_path / "t.json", nerfstudio(some_cameras())))
        assert caplog.text == ""


def test_failed_save_leaves_the_old_cameras_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    save_cameras(path, some_cameras())
    old = path.read_bytes()
    with files_up_to(100), pytest.raises(ProgdfError, match=r"cameras\.json cannot be written \("):
        save_cameras(path, some_cameras()[:2])
    assert path.read_bytes() == old
    assert [entry.name for entry in tmp_path.iterdir()] == ["cameras.json"]


def test_kind_of_an_unreadable_camera_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not exist"):
        kind_of_cameras(tmp_path / "cameras.json")
