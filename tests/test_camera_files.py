"""The camera files of other programs and our own: read alike, or refused in one line."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import progdf
from progdf.camera import Camera, orbit_rig
from progdf.camera_files import load_cameras, save_cameras
from progdf.errors import ProgdfError
from progdf.lens import Lens
from tests.refused import refusal
from tests.scenes import ball


def some_cameras() -> list[Camera]:
    return orbit_rig(ball(), 4, 320, 200, fov_y=0.7, up=torch.tensor([0.2, -1.0, 0.1]))


def written(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content))
    return path


def nerfstudio(cameras: list[Camera], **changes: object) -> dict[str, Any]:
    """transforms.json as nerfstudio writes it; a change to None removes the key."""
    frames = []
    for camera in cameras:
        c2w = camera.c2w.double()
        c2w[:, 1:3] *= -1
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": c2w.tolist()})
    K = cameras[0].K
    content: dict[str, Any] = {"camera_model": "OPENCV", "w": 320, "h": 200, "k1": 0.0, "p2": 0}
    content |= {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": 160.0, "cy": 100.0}
    content |= {"frames": frames, **changes}
    return {key: value for key, value in content.items() if value is not None}


def inria(cameras: list[Camera]) -> list[dict[str, Any]]:
    return [
        {
            "id": i,
            "img_name": camera.name,
            "width": camera.width,
            "height": camera.height,
            "position": camera.position.tolist(),
            "rotation": camera.c2w[:3, :3].tolist(),
            "fx": float(camera.K[0, 0]),
            "fy": float(camera.K[1, 1]),
        }
        for i, camera in enumerate(cameras)
    ]


def assert_same_views(found: list[Camera], expected: list[Camera]) -> None:
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(
            a.viewmat, b.viewmat, atol=2e-6, rtol=0
        )  # the matrices were inverted twice
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


def test_one_camera_or_a_bare_list_of_ours_is_read(tmp_path: Path) -> None:
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


def test_nerfstudio_transforms_are_read(tmp_path: Path) -> None:
    cameras = some_cameras()
    assert_same_views(load_cameras(written(tmp_path / "t.json", nerfstudio(cameras))), cameras)


def test_a_frames_own_intrinsics_go_before_those_of_the_file(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras())
    content["frames"][2] |= {"fl_x": 111.0, "fl_y": 222.0, "cx": 33.0, "cy": 44.0, "w": 66, "h": 88}
    cameras = load_cameras(written(tmp_path / "t.json", content))
    assert cameras[2].K.tolist() == [[111, 0, 33], [0, 222, 44], [0, 0, 1]]
    assert (cameras[2].width, cameras[2].height) == (66, 88)
    assert_same_views(cameras[:2], some_cameras()[:2])


def test_a_field_of_view_stands_in_for_a_focal_length(tmp_path: Path) -> None:
    cameras = some_cameras()
    angle = 2 * math.atan(160 / float(cameras[0].K[0, 0]))
    content = nerfstudio(cameras, fl_x=None, fl_y=None, cx=None, cy=None, camera_angle_x=angle)
    assert_same_views(load_cameras(written(tmp_path / "t.json", content)), cameras)


def test_the_image_size_is_taken_from_the_picture_where_the_file_has_none(tmp_path: Path) -> None:
    cameras = some_cameras()
    content = nerfstudio(cameras, w=None, h=None)
    assert "w and h" in refusal(load_cameras, written(tmp_path / "t.json", content))
    (tmp_path / "images").mkdir()
    for camera, frame in zip(cameras, content["frames"], strict=True):
        Image.new("RGB", (320, 200)).save(tmp_path / "images" / f"{camera.name}.png")
        frame["file_path"] = f"./images/{camera.name}"  # synthetic NeRF scenes leave the suffix off
    assert_same_views(load_cameras(written(tmp_path / "t.json", content)), cameras)


def test_distortion_of_a_kind_that_programs_read_differently_is_refused(tmp_path: Path) -> None:
    for key in ("k4", "k5", "k6"):
        assert "undistort" in refusal(
            load_cameras, written(tmp_path / "t.json", nerfstudio(some_cameras(), **{key: 0.01}))
        )


def test_distortion_is_kept_as_the_cameras_lens_and_not_ignored(tmp_path: Path) -> None:
    content = nerfstudio(some_cameras(), k1=0.1, k2=-0.02, p1=0.003, p2=0.004, k3=0.0)
    content["frames"][1] |= {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}
    cameras = load_cameras(written(tmp_path / "t.json", content))
    assert cameras[0].lens == Lens(0.1, -0.02, 0.003, 0.004)
    assert cameras[1].lens is None
    save_cameras(tmp_path / "kept.json", cameras)
    assert [camera.lens for camera in load_cameras(tmp_path / "kept.json")] == [c.lens for c in cameras]
    assert cameras[0].resized(32, 20).lens == cameras[0].lens


Change = Callable[[dict[str, Any]], object]
BROKEN: dict[str, tuple[Change, str]] = {  # what is done to a good file, what must be said about it
    "fisheye": (lambda t: t.update(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE"),
    "no focal length": (lambda t: (t.pop("fl_x"), t.pop("fl_y")), "focal length"),
    "words": (lambda t: t.update(fl_x="wide"), "fl_x"),
    "endless integer": (lambda t: t.update(fl_x=10**400), "fl_x"),
    "no matrix": (lambda t: t["frames"][3].pop("transform_matrix"), "frame 3"),
    "a row gone": (lambda t: t["frames"][3]["transform_matrix"].pop(0), "no rotation"),
    "ragged matrix": (lambda t: t["frames"][3]["transform_matrix"][1].pop(), "transform_matrix"),
    "stretched": (
        lambda t: t["frames"][1]["transform_matrix"][0].__setitem__(slice(0, 3), [9, 0, 0]),
        "rotation",
    ),
    "mirrored": (
        lambda t: t["frames"][1]["transform_matrix"].insert(0, t["frames"][1]["transform_matrix"].pop(1)),
        "rotation",
    ),
    "NaN": (lambda t: t["frames"][1]["transform_matrix"][0].__setitem__(0, math.nan), "finite"),
    "frame is a number": (lambda t: t["frames"].append(7), "frame 4"),
    "no frames": (lambda t: t["frames"].clear(), "0 cameras"),
    "half a pixel": (lambda t: t.update(w=320.5), "w = 320.5"),
    "no pixels": (lambda t: t.update(h=0), "h = 0"),
    "negative focal length": (lambda t: t.update(fl_y=-5.0), "focal lengths"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_camera_is_named_in_one_line(case: str, tmp_path: Path) -> None:
    change, said = BROKEN[case]
    content = nerfstudio(some_cameras())
    change(content)
    assert said in refusal(load_cameras, written(tmp_path / "t.json", content))


@pytest.mark.parametrize(
    "content",
    [
        *("", "nonsense", "{", "{}", "[]", "[1, 2]", '{"frames": 3}', "[" * 5000, "7", "\x00\xff"),
        '[{"rotation": 1, "position": 2}]',
    ],
)
def test_any_other_json_is_one_line(content: str, tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(content.encode("latin-1"))
    refusal(load_cameras, path)


def test_a_missing_camera_file_is_one_line(tmp_path: Path) -> None:
    assert "does not exist" in refusal(load_cameras, tmp_path / "nowhere.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["frames", "cameras", "viewmat", "K", "w", "fl_x", "rotation"]), inner
        )
    ),
    max_leaves=12,
)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(content=JSON, kind=st.sampled_from(["inria", "nerfstudio", "ours"]), data=st.data())
def test_any_value_in_any_place_loads_or_is_refused(
    content: object, kind: str, data: st.DataObject, tmp_path: Path
) -> None:
    entry: Any = inria(some_cameras())[0]
    whole: Any = [entry]
    if kind == "nerfstudio":
        whole = nerfstudio(some_cameras()[:1])
        entry = data.draw(st.sampled_from([whole, whole["frames"][0]]))
    if kind == "ours":
        entry = {
            "name": "a",
            "width": 4,
            "height": 4,
            "K": torch.eye(3).tolist(),
            "viewmat": torch.eye(4).tolist(),
        }
        whole = {"cameras": [entry]}
    entry[data.draw(st.sampled_from(sorted(entry)))] = content
    path = written(tmp_path / "fuzz.json", whole)
    try:
        cameras = load_cameras(path)
    except ProgdfError as refused:
        cameras, message = [], str(refused)
        assert len(message.splitlines()) == 1
    for camera in cameras:
        assert bool(camera.viewmat.isfinite().all())
