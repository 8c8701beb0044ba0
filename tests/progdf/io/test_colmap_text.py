"""Tests of COLMAP text models, and of choosing among several models. Neither needs pycolmap."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch

from progdf.camera import Lens
from progdf.io.cameras import camera_files, load_cameras, load_cameras_with_report
from tests.helpers.colmap_text import PINHOLE, write_text_model
from tests.helpers.refused import refusal

NAMES = ["b.jpg", "a.jpg", "c.jpg"]


def names_of(path: Path) -> list[str]:
    return [camera.name for camera in load_cameras(path)]


@pytest.fixture(autouse=True)
def without_pycolmap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("progdf.io.colmap.importlib.util.find_spec", lambda name: None)


@pytest.mark.parametrize(
    "names",
    [
        ["A drone 1 (402).jpg", "A drone 2 (403).jpg"],
        ["two  blanks.jpg", "zwölf.jpg"],
        ["0001", "0002"],
        ["left/0 1.jpg", "right/0 1.jpg"],
    ],
    ids=["blanks", "more blanks", "numbers", "folders"],
)
def test_image_names_are_the_rest_of_the_line(tmp_path: Path, names: list[str]) -> None:
    assert names_of(write_text_model(tmp_path / "m", names)) == names
    assert names_of(write_text_model(tmp_path / "bare", names, points=None)) == names


def test_backslashes_in_image_names_become_slashes(tmp_path: Path) -> None:
    assert names_of(write_text_model(tmp_path / "m", ["left\\a.jpg"])) == ["left/a.jpg"]


@pytest.mark.parametrize("points", ["", "10.5 20.25 -1 3 4 17", "  ", None, "1e2 5.0 3"])
def test_point_lines_may_be_full_empty_or_omitted(tmp_path: Path, points: str | None) -> None:
    found = load_cameras(write_text_model(tmp_path / "m", NAMES, points=points))
    assert [camera.name for camera in found] == sorted(NAMES)
    assert [float(camera.viewmat[2, 3]) for camera in found] == [2.0, 1.0, 3.0]


def test_windows_line_ends_and_byte_order_mark_are_accepted(tmp_path: Path) -> None:
    model = write_text_model(tmp_path / "m", NAMES, header="# Image list")
    for name in ("images.txt", "cameras.txt"):
        content = (model / name).read_bytes().replace(b"\n", b"\r\n")
        (model / name).write_bytes(b"\xef\xbb\xbf" + content)
    assert names_of(model) == sorted(NAMES)


def test_fewer_images_than_the_header_counts_are_refused(tmp_path: Path) -> None:
    header = "# Number of images: {}, mean observations per image: 0"
    message = refusal(load_cameras, write_text_model(tmp_path / "m", NAMES, header=header.format(4)))
    assert "images.txt lists 3 of the 4 images that its header counts" in message
    for count in (3, 2):  # 2 is the header of COLMAP's manual, which writers copy
        model = write_text_model(tmp_path / f"m{count}", NAMES, header=header.format(count))
        assert len(load_cameras(model)) == 3


def test_each_image_uses_its_named_camera(tmp_path: Path) -> None:
    cameras = ["7 SIMPLE_RADIAL 64 48 50 32 24 0.1", PINHOLE]
    model = write_text_model(tmp_path / "m", NAMES, cameras=cameras)
    images = (model / "images.txt").read_text()
    (model / "images.txt").write_text(images.replace("1 b.jpg", "7 b.jpg"))
    first, second, _ = load_cameras(model)
    assert (first.width, first.lens) == (640, None)
    assert (second.width, second.height, second.lens) == (64, 48, Lens(k1=0.1))
    assert second.K.tolist() == [[50, 0, 32], [0, 50, 24], [0, 0, 1]]


DAMAGES = {  # file, old text, new text, expected error
    "a name gone": ("images.txt", " b.jpg", "", "line 1 has 9 of 10 fields of an image"),
    "a word for a number": ("images.txt", "1 1 0", "1 one 0", "line 1 has 'one' in place of a number"),
    "NaN": ("images.txt", "1 1 0", "1 nan 0", "line 1 has 'nan' in place of a number"),
    "an endless number": ("images.txt", "1 1 0", "1 1e999 0", "in place of a number"),
    "a quaternion too long": ("images.txt", "1 1 0", "1 1 1", "line 1 has a quaternion of length 1.414"),
    "another camera": ("images.txt", "1 b.jpg", "9 b.jpg", "line 1 names the camera 9"),
    "an image twice": ("images.txt", "2 1 0 0", "1 1 0 0", "line 3 repeats the image 1"),
    "no whole number": ("cameras.txt", "640", "640.5", "line 2 has '640.5' in place of a whole number"),
    "a camera twice": ("cameras.txt", PINHOLE, f"{PINHOLE}\n{PINHOLE}", "line 3 repeats the camera 1"),
    "a camera without a size": ("cameras.txt", PINHOLE, "1 PINHOLE", "line 2 has 2 of 4 fields of a camera"),
}


@pytest.mark.parametrize("case", DAMAGES)
def test_damaged_line_is_named_with_its_file(tmp_path: Path, case: str) -> None:
    file, old, new, said = DAMAGES[case]
    path = write_text_model(tmp_path / "m", NAMES) / file
    content = path.read_text()
    assert old in content
    path.write_text(content.replace(old, new, 1))
    message = refusal(lambda _: load_cameras(tmp_path / "m"), path)
    assert said in message
    assert "is damaged" in message


def test_latin_1_names_are_unsupported_not_damaged(tmp_path: Path) -> None:
    path = write_text_model(tmp_path / "m", ["zw\xf6lf.jpg"]) / "images.txt"
    path.write_bytes(path.read_text(encoding="utf-8").encode("latin-1"))
    message = refusal(lambda _: load_cameras(tmp_path / "m"), path)
    assert "a text encoding other than UTF-8 (line 1)" in message


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ("1 OPENCV_FISHEYE 640 480 500 501 320 240 0 0 0 0", "the camera model OPENCV_FISHEYE"),
        ("1 EQUIRECTANGULAR 640 320 640 320", "the camera model EQUIRECTANGULAR"),
        ("1 SOMETHING_NEW 640 320 640 320", "the camera model SOMETHING_NEW"),
        ("1 FULL_OPENCV 640 480 500 501 320 240 0 0 0 0 0 0.1 0 0", "k4 of the camera model FULL_OPENCV"),
        ("1 PINHOLE 640 480 500 320 240", "3 parameters of a PINHOLE camera, which has 4"),
        ("1 PINHOLE 640 480 -500 501 320 240", "focal lengths"),
        ("1 PINHOLE 0 480 500 501 320 240", "0x480 pixels"),
        ("1 PINHOLE 640 9999999999 500 501 320 240", "640x9999999999 pixels"),
    ],
)
def test_unsupported_text_cameras_are_refused_by_name(tmp_path: Path, camera: str, said: str) -> None:
    model = write_text_model(tmp_path / "m", NAMES, cameras=[camera])
    message = refusal(load_cameras, model)
    assert said in message
    assert "damaged" not in message


@pytest.mark.parametrize("place", ["sparse", "", "colmap/sparse"])
def test_largest_of_several_models_is_read(
    tmp_path: Path, place: str, caplog: pytest.LogCaptureFixture
) -> None:
    for number, names in enumerate((NAMES[:1], NAMES, NAMES[:2])):
        write_text_model(tmp_path / place / str(number), names)
    write_text_model(tmp_path / place / "10", NAMES[:2])
    with caplog.at_level(logging.WARNING, logger="progdf"):
        assert len(load_cameras(tmp_path)) == 3
        load_cameras(tmp_path)
    (record,) = caplog.records
    chosen = tmp_path / place / "1"
    message = f"{chosen} is used, the largest of 4 COLMAP models: 3 images, 0 has 1, 2 has 2, 10 has 2"
    assert record.getMessage() == message
    assert camera_files(tmp_path) == (chosen / "cameras.txt", chosen / "images.txt")


def test_named_model_is_read_even_if_another_is_larger(tmp_path: Path) -> None:
    small = write_text_model(tmp_path / "sparse" / "0", NAMES[:1])
    large = write_text_model(tmp_path / "sparse" / "1", NAMES)
    cameras, report = load_cameras_with_report(small)
    assert len(cameras) == 1
    assert report.notes == (f"{small} has 1 image; {large} beside it has 3",)
    assert load_cameras_with_report(large)[1].notes == ()


def test_binary_image_count_is_compared_with_a_text_model(tmp_path: Path) -> None:
    write_text_model(tmp_path / "sparse" / "0", NAMES)
    binary = tmp_path / "sparse" / "1"
    binary.mkdir()
    (binary / "cameras.bin").write_bytes(bytes(8))
    (binary / "images.bin").write_bytes((2).to_bytes(8, "little"))
    assert len(load_cameras(tmp_path)) == 3
    (binary / "images.bin").write_bytes((4).to_bytes(8, "little"))
    assert "needs pycolmap" in refusal(lambda _: load_cameras(tmp_path), binary)


def test_model_file_selects_its_own_form(tmp_path: Path) -> None:
    model = write_text_model(tmp_path / "m", NAMES)
    for name in ("cameras.bin", "images.bin"):
        (model / name).write_bytes(bytes(8))
    assert len(load_cameras(model / "images.txt")) == 3
    assert camera_files(model / "images.bin") == (model / "cameras.bin", model / "images.bin")


def test_text_pose_is_the_rotation_of_its_quaternion(tmp_path: Path) -> None:
    model = write_text_model(tmp_path / "m", ["a.jpg"])
    (model / "images.txt").write_text("1 0.5 0.5 0.5 0.5 1 2 3 1 a.jpg\n")
    (camera,) = load_cameras(model)
    expected = torch.tensor([[0.0, 0, 1, 1], [1, 0, 0, 2], [0, 1, 0, 3], [0, 0, 0, 1]])
    torch.testing.assert_close(camera.viewmat, expected, atol=1e-7, rtol=0)
