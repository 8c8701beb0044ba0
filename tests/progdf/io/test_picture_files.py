"""Tests of view names and of finding their pictures in folders."""

from __future__ import annotations

from pathlib import Path

import pytest
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io import images
from progdf.io.picture_files import ENDINGS, PictureFolder, find_picture, view_name, without_common_folder


def touch(folder: Path, *names: str) -> Path:
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return folder


def test_endings_match_the_formats_that_are_read() -> None:
    Image.init()
    read = {ending for ending, kind in Image.registered_extensions().items() if kind in images.FORMATS}
    assert set(ENDINGS) == read


@pytest.mark.parametrize("ending", ["JPG", "Png", "tif", "TIFF", "jpeg", "webp", "BMP", "JPG.png", "png.PNG"])
def test_pictures_of_any_ending_and_case_are_found(tmp_path: Path, ending: str) -> None:
    touch(tmp_path, f"DSC1.{ending}", "DSC10.png", "DSC1.txt")
    assert find_picture(tmp_path, "DSC1") == tmp_path / f"DSC1.{ending}"
    assert find_picture(tmp_path, "dsc1.png") == tmp_path / f"DSC1.{ending}"


def test_two_pictures_of_one_name_are_refused_by_naming_both(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "a.JPG", "A.png")
    with pytest.raises(ProgdfError, match=r"a\.JPG and .*a\.png are both pictures of the view a"):
        find_picture(tmp_path, "a")


def test_name_in_the_same_case_is_preferred(tmp_path: Path) -> None:
    touch(tmp_path, "a.png", "A.png")
    assert find_picture(tmp_path, "A") == tmp_path / "A.png"


def test_picture_with_special_characters_is_found_by_its_view(tmp_path: Path) -> None:
    touch(tmp_path, "my shot (1).JPG", "caf\u00e9.png")
    assert find_picture(tmp_path, view_name("my shot (1).jpg") or "") == tmp_path / "my shot (1).JPG"
    assert find_picture(tmp_path, view_name("cafe\u0301.png") or "") == tmp_path / "caf\u00e9.png"


def test_unsupported_format_is_named(tmp_path: Path) -> None:
    touch(tmp_path, "a.HEIC")
    with pytest.raises(ProgdfError, match=r"a\.HEIC uses the picture format HEIC.*save it as PNG"):
        PictureFolder(tmp_path).require("a", "put it there")


def test_pictures_in_subfolders_are_found_by_their_path(tmp_path: Path) -> None:
    touch(tmp_path, "Cam 0/1.JPG", "cam1/1.png", "2.png")
    names = ["cam_0/1", "cam1/1", "cam0/2", "cam1/3"]
    pictures = PictureFolder(tmp_path, names)
    assert [pictures.find(name) for name in names] == [
        tmp_path / "Cam 0/1.JPG", tmp_path / "cam1/1.png", tmp_path / "2.png", None,
    ]  # fmt: skip


def test_picture_that_fits_two_views_is_used_for_neither(tmp_path: Path) -> None:
    touch(tmp_path, "1.png")
    pictures = PictureFolder(tmp_path, ["cam0/1", "cam1/1"])
    assert pictures.find("cam0/1") is None


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cam0/1.jpg", "cam0/1"),
        ("./train/r_0", "train/r_0"),
        ("frame.0001", "frame.0001"),
        ("/home/me/x.tif", "home/me/x"),
        ("..\\..\\x.png", "x"),
        ("d:/x.png", "x"),
        ("a/../b.png", "a/b"),
        ("0.5/a.png", "0_5/a"),
        ("a.png/b.png", "a_png/b"),
        ("nul/b.png", None),
        ("a/aux.png", None),
        ("..", None),
        ("a/" * 100 + "b", None),
    ],
)
def test_view_names_are_safe_relative_paths(name: str, expected: str | None) -> None:
    assert view_name(name) == expected


def test_common_folder_is_not_part_of_picture_names() -> None:
    assert without_common_folder(["images/a.png", "images/b.png"]) == ["a.png", "b.png"]
    assert without_common_folder(["../d/cam0/1.png", "../d/cam1/1.png"]) == ["cam0/1.png", "cam1/1.png"]
    assert without_common_folder(["./train/r_0", "./test/r_0"]) == ["train/r_0", "test/r_0"]
    assert without_common_folder(["a.png", "images/b.png"]) == ["a.png", "images/b.png"]
    assert without_common_folder([]) == []
