"""Cameras: the rig around a scene, which way is up, and the camera files of other programs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

import progdf
from progdf.camera import Camera, orbit_rig, split_held_out
from progdf.camera_files import load_cameras, save_cameras
from progdf.errors import ProgdfError
from progdf.framing import front, guess_up, is_surrounding, normals_of, scene_sphere
from progdf.gaussians import Gaussians, normalize_quats
from progdf.lens import Lens
from progdf.rasterize.reference import rotation_matrices
from progdf.scenes import bear
from tests.scenes import random_gaussians

Y_UP = torch.tensor([0.0, 1.0, 0.0])


def ball(count: int = 2000, radius: float = 1.0, seed: int = 0) -> Gaussians:
    """Gaussians inside a ball around the origin."""
    scene = random_gaussians(count, seed=seed, scale=0.01)
    places = torch.nn.functional.normalize(scene.means, dim=1)
    distances = torch.rand(count, 1, generator=torch.Generator().manual_seed(seed)) ** (1 / 3)
    return replace(scene, means=radius * distances * places)


def quat_of(rotation: Tensor) -> Tensor:
    """The quaternion wxyz of a rotation matrix of a quarter or half turn. [3,3] -> [4]"""
    w = 0.5 * math.sqrt(max(0.0, 1 + float(rotation.trace())))
    xyz = torch.stack(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    if w > 0.1:
        return torch.cat([torch.tensor([w]), xyz / (4 * w)])
    axis = (rotation + torch.eye(3))[:, int(rotation.diagonal().argmax())]
    return torch.cat([torch.zeros(1), axis / axis.norm()])


def turned(scene: Gaussians, rotation: Tensor) -> Gaussians:
    """The scene rotated about the origin, its Gaussians with it."""
    w, x, y, z = quat_of(rotation)
    left = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return replace(scene, means=scene.means @ rotation.T, quats=normalize_quats(scene.quats) @ left.T)


# ---------------------------------------------------------------------------------------------- rig


def seen(scene: Gaussians, camera: Camera) -> Tensor:
    """Which centres fall into the picture. [N] bool"""
    places = scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    pixels = (places @ camera.K.T)[:, :2] / places[:, 2:]
    inside = (pixels >= 0) & (pixels <= torch.tensor([camera.width, camera.height]))
    return inside.all(dim=1) & (places[:, 2] > 0)


@pytest.mark.parametrize(("width", "height"), [(64, 64), (128, 64), (64, 128)])
@pytest.mark.parametrize("fov", [20.0, 60.0, 100.0])
def test_the_rig_frames_the_scene_whatever_the_lens(width: int, height: int, fov: float) -> None:
    scene = ball()
    for camera in orbit_rig(scene, 5, width, height, fov_y=math.radians(fov), up=Y_UP):
        assert float(seen(scene, camera).float().mean()) > 0.99
        assert (camera.width, camera.height) == (width, height)
        places = scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = (places @ camera.K.T)[:, :2] / places[:, 2:]
        spread = pixels.amax(dim=0) - pixels.amin(dim=0)
        assert float(spread.max()) > 0.6 * min(width, height)


def test_the_rig_surrounds_the_scene_evenly() -> None:
    cameras = orbit_rig(ball(), 40, 64, 64, up=Y_UP)
    places = torch.stack([camera.position for camera in cameras])
    azimuths = torch.atan2(places[:, 0], places[:, 2]).sort().values
    gaps = azimuths.diff()
    torch.testing.assert_close(gaps, torch.full((39,), 2 * math.pi / 40), atol=0.02, rtol=0)
    heights = (places[:, 1] / places.norm(dim=1)).sort().values
    low, high = math.sin(math.radians(5)), math.sin(math.radians(60))
    even = low + (high - low) * (torch.arange(40) + 0.5) / 40
    assert float((heights - even).abs().max()) < 0.05
    every_fifth = places[::5, 1] / places[::5].norm(dim=1)
    assert float(every_fifth.max() - every_fifth.min()) > 0.6 * (high - low)


def test_the_rig_looks_at_the_centre_with_up_up_and_begins_at_the_front() -> None:
    scene = ball()
    scene = replace(scene, means=scene.means + torch.tensor([5.0, -3.0, 2.0]))
    centre, _ = scene_sphere(scene)
    up = torch.tensor([0.0, -1.0, 0.0])
    cameras = orbit_rig(scene, 7, 64, 48, up=up)
    for camera in cameras:
        ahead = camera.viewmat[:3, :3] @ (centre - camera.position)
        torch.testing.assert_close(ahead[:2], torch.zeros(2), atol=1e-4, rtol=0)
        assert float((camera.viewmat[:3, :3] @ up)[1]) < 0
        assert float((camera.position - centre) @ up) > 0, "a camera under the ground"
    away = cameras[0].position - centre
    assert float(away @ front(up)) > 0.8 * float(away.norm()) * math.cos(math.radians(60))
    assert [camera.name for camera in cameras[:2]] == ["orbit_000", "orbit_001"]


def test_the_rig_may_look_from_below() -> None:
    cameras = orbit_rig(ball(), 20, 64, 64, up=Y_UP, elevations=(-40.0, 40.0))
    heights = torch.stack([camera.position[1] for camera in cameras])
    assert 8 <= int((heights < 0).sum()) <= 12


def test_far_strays_do_not_move_the_rig() -> None:
    scene = ball()
    means = scene.means.clone()
    means[:40] = torch.tensor([2000.0, 0.0, 0.0])
    centre, radius = scene_sphere(replace(scene, means=means))
    assert float(centre.norm()) < 0.1
    assert 0.8 < radius < 1.1


def test_a_single_gaussian_is_framed_by_its_own_size() -> None:
    scene = ball(1)
    camera = orbit_rig(scene, 1, 64, 64)[0]
    distance = float((camera.position - scene.means[0]).norm())
    assert 2 < distance / float(scene.scales.max()) < 20


@pytest.mark.parametrize(("count", "elevations"), [(0, (5.0, 60.0)), (4, (60.0, 5.0)), (4, (0.0, 90.0))])
def test_an_impossible_rig_is_one_line(count: int, elevations: tuple[float, float]) -> None:
    with pytest.raises(ProgdfError, match="the rig"):
        orbit_rig(ball(), count, 64, 64, elevations=elevations)


def test_held_out_cameras_are_spread_over_the_list_and_never_trained_with() -> None:
    cameras = orbit_rig(ball(), 30, 64, 64, up=Y_UP)
    train, held = split_held_out(cameras, 6)
    assert [camera.name for camera in held] == [f"orbit_{i:03d}" for i in (2, 7, 12, 17, 22, 27)]
    assert len(train) == 24
    assert not {camera.name for camera in train} & {camera.name for camera in held}
    assert split_held_out(cameras, 0) == (cameras, [])
    with pytest.raises(ProgdfError, match="held out"):
        split_held_out(cameras, 30)


# ----------------------------------------------------------------------------------------- which way

AXES = [torch.eye(3)[i] * sign for i in range(3) for sign in (1.0, -1.0)]


@pytest.fixture(scope="module")
def small_bear() -> Gaussians:
    return bear(3000).gaussians


@pytest.mark.parametrize("up", AXES, ids=["+x", "-x", "+y", "-y", "+z", "-z"])
def test_up_is_found_however_the_bear_lies(up: Tensor, small_bear: Gaussians) -> None:
    axis = int(up.abs().argmax())
    second = torch.eye(3)[(axis + 1) % 3]
    # y -> up, z -> second, x -> their cross product: a rotation by quarter turns
    rotation = torch.stack([torch.linalg.cross(up, second), up, second], dim=1)
    assert torch.equal(guess_up(turned(small_bear, rotation)), up)


def test_normals_are_the_shortest_axes() -> None:
    scene = random_gaussians(50, seed=4)
    rotations = rotation_matrices(scene.unit_quats)
    expected = rotations[torch.arange(50), :, scene.scales.argmin(dim=1)]
    torch.testing.assert_close(normals_of(scene), expected)


def test_cameras_that_agree_tell_the_up_direction(small_bear: Gaussians) -> None:
    up = torch.nn.functional.normalize(torch.tensor([0.1, -1.0, 0.2]), dim=0)
    cameras = orbit_rig(ball(), 12, 64, 64, up=up)
    found = guess_up(small_bear, cameras)
    torch.testing.assert_close(found, up, atol=0.05, rtol=0)


def test_the_front_is_level_and_of_unit_length() -> None:
    for up in [*AXES, torch.nn.functional.normalize(torch.tensor([0.3, -0.9, 0.4]), dim=0)]:
        assert abs(float(front(up) @ up)) < 1e-6
        assert abs(float(front(up).norm()) - 1) < 1e-6
    assert front(torch.tensor([0.0, -1.0, 0.0])).tolist() == [0, 0, -1]
    assert front(torch.tensor([0.0, 0.0, 1.0])).tolist() == [0, -1, 0]


def walls(ceiling: bool) -> Gaussians:
    """A room of 4 x 3 x 4 with furniture, y up, with or without its ceiling."""
    spots = torch.rand(6000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    side = torch.arange(6000) % (6 if ceiling else 5)
    for face, (axis, place) in enumerate([(0, -0.5), (0, 0.5), (1, -0.5), (2, -0.5), (2, 0.5), (1, 0.5)]):
        spots[side == face, axis] = place
    scene = random_gaussians(6000, scale=0.02)
    return replace(scene, means=spots * torch.tensor([4.0, 3.0, 4.0]))


def test_a_scene_to_stand_inside_is_recognised(
    small_bear: Gaussians, caplog: pytest.LogCaptureFixture
) -> None:
    assert is_surrounding(walls(ceiling=True), Y_UP)
    assert not is_surrounding(walls(ceiling=False), Y_UP)
    assert not is_surrounding(small_bear, Y_UP)
    assert not is_surrounding(ball(), Y_UP)
    landscape = random_gaussians(3000)
    far = replace(landscape, means=landscape.means * torch.linspace(0, 3, 3000)[:, None].exp() ** 2)
    assert is_surrounding(far, Y_UP)
    orbit_rig(walls(ceiling=True), 2, 64, 64, up=Y_UP)
    assert "give its own cameras" in caplog.text


# ---------------------------------------------------------------------------------------------- files


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
    assert "w and h" in refusal(written(tmp_path / "t.json", content))
    (tmp_path / "images").mkdir()
    for camera, frame in zip(cameras, content["frames"], strict=True):
        Image.new("RGB", (320, 200)).save(tmp_path / "images" / f"{camera.name}.png")
        frame["file_path"] = f"./images/{camera.name}"  # synthetic NeRF scenes leave the suffix off
    assert_same_views(load_cameras(written(tmp_path / "t.json", content)), cameras)


def refusal(path: Path) -> str:
    with pytest.raises(ProgdfError) as caught:
        load_cameras(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_distortion_of_a_kind_that_programs_read_differently_is_refused(tmp_path: Path) -> None:
    for key in ("k4", "k5", "k6"):
        assert "undistort" in refusal(written(tmp_path / "t.json", nerfstudio(some_cameras(), **{key: 0.01})))


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
    assert said in refusal(written(tmp_path / "t.json", content))


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
    refusal(path)


def test_a_missing_camera_file_is_one_line(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "nowhere.json")


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
