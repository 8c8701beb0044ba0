"""Tests of COLMAP sparse models as pycolmap writes them, with and without points, and damaged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from progdf.camera import Camera, Lens
from progdf.io.cameras import load_cameras, save_cameras
from tests.helpers.refused import refusal
from tests.helpers.scenes import orbit_camera

pycolmap = pytest.importorskip("pycolmap", reason="the colmap extra is not installed")

PINHOLE = ("PINHOLE", [250.0, 240.0, 161.0, 99.0])


def write_model(
    folder: Path,
    views: list[Camera],
    lens: tuple[str, list[float]] = PINHOLE,
    text: bool = False,
    points: bool = True,
) -> Path:
    """Write a model of 320x200 pixels with one point. Its images are in the reverse order of their names."""
    model = pycolmap.Reconstruction()
    kind, numbers = lens
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model=kind, width=320, height=200, params=numbers)
    )
    for i, view in enumerate(views):
        image = pycolmap.Image(name=f"left/{9 - i}.jpg", camera_id=1, image_id=i + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(torch.ones(2).double().numpy())])
        pose = pycolmap.Rigid3d(view.viewmat[:3].double().numpy())
        model.add_image_with_trivial_frame(image, pose)
    track = pycolmap.Track()
    for i in range(len(views)):
        track.add_element(i + 1, 0)
    model.add_point3D(torch.zeros(3).double().numpy(), track)
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(folder)
    if not points:
        (folder / f"points3D.{'txt' if text else 'bin'}").unlink()
    return folder


def views() -> list[Camera]:
    return [orbit_camera(azimuth=0.5 * i, elevation=0.2 * i) for i in range(4)]


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("points", [False, True])
def test_model_is_read_with_or_without_points(tmp_path: Path, text: bool, points: bool) -> None:
    found = load_cameras(write_model(tmp_path / "m", views(), text=text, points=points))
    assert [camera.name for camera in found] == [f"left/{i}.jpg" for i in (6, 7, 8, 9)]
    for camera, view in zip(found, reversed(views()), strict=True):
        torch.testing.assert_close(camera.viewmat, view.viewmat, atol=2e-6, rtol=0)
        assert camera.K.tolist() == [[250, 0, 161], [0, 240, 99], [0, 0, 1]]
        assert (camera.width, camera.height, camera.lens) == (320, 200, None)


@pytest.mark.slow
@pytest.mark.parametrize("place", ["", "sparse/0", "sparse", "0", "colmap/sparse/0"])
def test_model_is_found_in_its_project_folder(tmp_path: Path, place: str) -> None:
    write_model(tmp_path / "project" / place, views())
    assert len(load_cameras(tmp_path / "project")) == 4
    assert len(load_cameras(tmp_path / "project" / place / "images.bin")) == 4


def test_binary_model_is_preferred_to_text(tmp_path: Path) -> None:
    model = write_model(tmp_path / "m", views())
    for name in ("cameras.txt", "images.txt"):
        (model / name).write_text("left over from an export\n")
    assert len(load_cameras(model)) == 4


def test_model_without_registered_images_is_refused(tmp_path: Path) -> None:
    assert "no registered image" in refusal(load_cameras, write_model(tmp_path / "m", []))


def rig_model(folder: Path) -> pycolmap.Reconstruction:
    """Return a model of two cameras on a rig, the second rotated and moved against the first."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    pairs = zip((1, 2), ("OPENCV", "SIMPLE_RADIAL"), strict=True)
    for camera_id, kind in pairs:
        camera = pycolmap.Camera.create_from_model_name(camera_id, kind, 250.0, 320, 200)
        model.add_camera(camera)
        turned = pycolmap.Rigid3d(pycolmap.Rotation3d([0.1, 0.2, 0.3, 0.9]), [0.5, -0.25, 0.125])
        if camera_id == 1:
            rig.add_ref_sensor(camera.sensor_id)
        else:
            rig.add_sensor(camera.sensor_id, turned)
    model.add_rig(rig)
    for frame_id, view in enumerate(views(), 1):
        frame = pycolmap.Frame(frame_id=frame_id, rig_id=1)
        images = [2 * frame_id + camera_id for camera_id in (1, 2)]
        for camera_id, image_id in zip((1, 2), images, strict=True):
            frame.add_data_id(pycolmap.data_t(model.cameras[camera_id].sensor_id, image_id))
        frame.rig_from_world = pycolmap.Rigid3d(view.viewmat[:3].double().numpy())
        model.add_frame(frame)
        for camera_id, image_id in zip((1, 2), images, strict=True):
            name = f"{camera_id}/{frame_id}.jpg"
            image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id, frame_id=frame_id)
            model.add_image(image)
        model.register_frame(frame_id)
    folder.mkdir()
    return model


@pytest.mark.parametrize("text", [False, True])
def test_poses_and_intrinsics_of_a_rig_match_pycolmap(tmp_path: Path, text: bool) -> None:
    folder = tmp_path / "m"
    model = rig_model(folder)
    (model.write_text if text else model.write_binary)(folder)
    found = {camera.name: camera for camera in load_cameras(folder)}
    expected = {image.name: image for image in model.images.values()}
    assert found.keys() == expected.keys()
    assert len(found) == 8
    for name, image in expected.items():
        pose = torch.from_numpy(image.cam_from_world().matrix()).float()
        torch.testing.assert_close(found[name].viewmat[:3], pose, atol=1e-6, rtol=0)
        K = torch.from_numpy(image.camera.calibration_matrix()).float()
        assert torch.equal(found[name].K, K)


def test_model_older_than_rigs_is_read(tmp_path: Path) -> None:
    model = write_model(tmp_path / "m", views())
    for name in ("rigs.bin", "frames.bin"):
        (model / name).unlink()
    assert len(load_cameras(model)) == 4


@pytest.mark.parametrize(
    ("kind", "numbers", "lens"),
    [
        ("SIMPLE_RADIAL", [250.0, 160.0, 100.0, 0.1], Lens(k1=0.1)),
        ("RADIAL", [250.0, 160.0, 100.0, 0.1, -0.02], Lens(0.1, -0.02)),
        ("OPENCV", [250.0, 240.0, 160.0, 100.0, 0.1, -0.02, 0.003, 0.004], Lens(0.1, -0.02, 0.003, 0.004)),
        (
            "FULL_OPENCV",
            [250.0, 240.0, 160.0, 100.0, 0.1, -0.02, 0.003, 0.004, 0.05, 0.0, 0.0, 0.0],
            Lens(0.1, -0.02, 0.003, 0.004, 0.05),
        ),
        ("SIMPLE_RADIAL", [250.0, 160.0, 100.0, 0.0], None),
    ],
)
def test_lens_distorts_rays_like_colmap(
    tmp_path: Path, kind: str, numbers: list[float], lens: Lens | None
) -> None:
    camera = load_cameras(write_model(tmp_path / "m", views(), (kind, numbers)))[0]
    assert camera.lens == lens
    rays = torch.tensor([[0.3, -0.2], [-0.5, 0.1], [0.0, 0.0]]).double()
    bent = (lens or Lens()).distort(rays)
    oracle = pycolmap.Camera(camera_id=1, model=kind, width=320, height=200, params=numbers)
    pixels = torch.from_numpy(oracle.img_from_cam(torch.cat([rays, torch.ones(3, 1)], dim=1).numpy()))
    torch.testing.assert_close(bent @ camera.K[:2, :2].double() + camera.K[:2, 2].double(), pixels)


@pytest.mark.parametrize(
    ("kind", "numbers", "said"),
    [
        ("OPENCV_FISHEYE", [250.0, 240.0, 160.0, 100.0, 0.1, 0.0, 0.0, 0.0], "OPENCV_FISHEYE"),
        ("SIMPLE_RADIAL_FISHEYE", [250.0, 160.0, 100.0, 0.1], "SIMPLE_RADIAL_FISHEYE"),
        ("FOV", [250.0, 240.0, 160.0, 100.0, 0.1], "FOV"),
        ("FULL_OPENCV", [250.0, 240.0, 160.0, 100.0, 0, 0, 0, 0, 0, 0.1, 0, 0], "k4"),
    ],
)
def test_unsupported_lens_is_refused(tmp_path: Path, kind: str, numbers: list[float], said: str) -> None:
    message = refusal(load_cameras, write_model(tmp_path / "m", views(), (kind, numbers)))
    assert said in message
    assert "image_undistorter" in message


Damage = Callable[[Path], object]
DAMAGES: dict[str, Damage] = {
    "cameras cut off": lambda m: (m / "cameras.bin").write_bytes((m / "cameras.bin").read_bytes()[:20]),
    "images cut off": lambda m: (m / "images.bin").write_bytes((m / "images.bin").read_bytes()[:60]),
    "no cameras": lambda m: (m / "cameras.bin").write_bytes(bytes(8)),
    "nothing in images": lambda m: (m / "images.bin").write_bytes(b""),
    "a billion images": lambda m: (m / "images.bin").write_bytes(
        b"\xff" * 4 + bytes(4) + (m / "images.bin").read_bytes()[8:]
    ),
    "text in a binary": lambda m: (m / "images.bin").write_text("# Image list\n" * 20),
    "frames cut off": lambda m: (m / "frames.bin").write_bytes((m / "frames.bin").read_bytes()[:30]),
}


def test_model_with_an_excessive_point_count_is_refused(tmp_path: Path) -> None:
    model = write_model(tmp_path / "m", views())
    content = bytearray((model / "images.bin").read_bytes())
    at = content.index(b".jpg\0") + 5
    content[at : at + 8] = (1 << 40).to_bytes(8, "little")
    (model / "images.bin").write_bytes(bytes(content))
    message = refusal(load_cameras, model)
    assert "pycolmap cannot read" in message
    assert "damaged" not in message  # not known to be damaged


@pytest.mark.parametrize("damage", DAMAGES)
def test_broken_model_is_reported_in_one_line(tmp_path: Path, damage: str) -> None:
    model = write_model(tmp_path / "m", views())
    DAMAGES[damage](model)
    refusal(load_cameras, model)


def test_folder_without_cameras_or_with_two_kinds_is_refused(tmp_path: Path) -> None:
    assert "sparse/0" in refusal(load_cameras, tmp_path)
    write_model(tmp_path / "sparse" / "0", views())
    save_cameras(tmp_path / "cameras.json", views())
    assert "belong to the scene" in refusal(load_cameras, tmp_path)
    assert len(load_cameras(tmp_path / "cameras.json")) == 4


def test_folder_with_one_camera_file_reads_that_file(tmp_path: Path) -> None:
    save_cameras(tmp_path / "cameras.json", views())
    assert len(load_cameras(tmp_path)) == 4


def test_missing_pycolmap_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = write_model(tmp_path / "m", views())
    monkeypatch.setattr("progdf.io.colmap.importlib.util.find_spec", lambda name: None)
    assert "progdf-studio[colmap]" in refusal(load_cameras, model)
