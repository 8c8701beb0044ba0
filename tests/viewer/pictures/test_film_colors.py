"""Films keep the colors of their frames in players that follow the file's color tags."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from progdf.__main__ import main
from tests.helpers.ui_rig import bear
from viewer.pictures import film

SIX = np.array([[0, 255, 0], [255, 0, 0], [0, 0, 255], [255, 255, 255], [0, 0, 0], [190, 120, 60]], np.uint8)
SIDE = 32
LUMA = {"bt709": (0.2126, 0.0722), "smpte170m": (0.299, 0.114), "bt470bg": (0.299, 0.114)}
"""Weights of red and blue in the luma of each matrix."""


def six_colors(width: int = 3 * SIDE, height: int = 2 * SIDE) -> np.ndarray:
    """Return a frame of six color fields in two rows of three. [H,W,3]"""
    frame = SIX.reshape(2, 3, 3).repeat(SIDE, axis=0).repeat(SIDE, axis=1)
    return np.ascontiguousarray(frame[:height, :width])


def centers(frame: np.ndarray) -> np.ndarray:
    """Return the colors at the centers of the six fields. [6,3]"""
    middle = SIDE // 2
    return frame[middle::SIDE, middle::SIDE, :3].reshape(6, 3).astype(int)


def ffmpeg(*arguments: object) -> subprocess.CompletedProcess[bytes]:
    encoder = pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    command = [encoder.get_ffmpeg_exe(), "-hide_banner", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, check=False, timeout=60.0)


def video_tags(path: Path) -> dict[str, str]:
    """Return the color tags and the size of a video."""
    colors = r"(\w+), ([\w-]+)(?:/([\w-]+)/([\w-]+))?"
    facts = re.search(rf"yuv420p\({colors}[^)]*\), (\d+x\d+)", ffmpeg("-i", path).stderr.decode())
    assert facts is not None, "the colors have no tags"
    color_range, matrix, primaries, curve, size = facts.groups()
    return {
        "range": color_range,
        "matrix": matrix,
        "primaries": primaries or matrix,
        "curve": curve or matrix,
        "size": size,
    }


def played(path: Path) -> np.ndarray:
    """Return the first frame of a video as decoded by its tags. [H,W,3] 0 to 255"""
    tags = video_tags(path)
    width, height = (int(side) for side in tags["size"].split("x"))
    raw = ffmpeg("-i", path, "-frames:v", 1, "-pix_fmt", "yuv420p", "-f", "rawvideo", "-").stdout
    levels = np.frombuffer(raw, np.uint8).astype(float)
    assert tags["range"] == "tv"
    luma = (levels[: width * height].reshape(height, width) - 16.0) / 219.0
    halves = (levels[width * height :].reshape(2, height // 2, width // 2) - 128.0) / 224.0
    blueness, redness = halves.repeat(2, axis=1).repeat(2, axis=2)
    of_red, of_blue = LUMA[tags["matrix"]]
    red = luma + 2.0 * (1.0 - of_red) * redness
    blue = luma + 2.0 * (1.0 - of_blue) * blueness
    green = (luma - of_red * red - of_blue * blue) / (1.0 - of_red - of_blue)
    shown: np.ndarray = np.stack([red, green, blue], axis=-1).clip(0.0, 1.0) * 255.0
    return shown


def test_video_colors_are_restored_by_its_tags(tmp_path: Path) -> None:
    film.write_film(tmp_path / "film.mp4", [six_colors()] * 2, 24)
    assert video_tags(tmp_path / "film.mp4") == {
        "range": "tv",
        "matrix": "bt709",
        "primaries": "bt709",
        "curve": "iec61966-2-1",
        "size": "96x64",
    }
    assert np.abs(centers(played(tmp_path / "film.mp4")) - SIX).max() <= 2


def test_video_with_odd_size_is_padded_to_even_sides(tmp_path: Path) -> None:
    film.write_film(tmp_path / "film.mp4", [six_colors(3 * SIDE - 1, 2 * SIDE - 1)], 24)
    assert video_tags(tmp_path / "film.mp4")["size"] == "96x64"
    assert np.abs(centers(played(tmp_path / "film.mp4")) - SIX).max() <= 2


@pytest.mark.parametrize(("ending", "tolerance"), [(".gif", 0), (".webp", 4)])
def test_animation_colors_are_restored(tmp_path: Path, ending: str, tolerance: int) -> None:
    path = tmp_path / f"film{ending}"
    film.write_film(path, [six_colors(3 * SIDE - 1, 2 * SIDE - 1)] * 2, 24)
    with Image.open(path) as animation:
        assert animation.size == (3 * SIDE - 1, 2 * SIDE - 1)
        assert np.abs(centers(np.asarray(animation.convert("RGB"))) - SIX).max() <= tolerance


def sweep(tmp_path: Path, out: Path, *words: str) -> int:
    """Render a sweep of one slider."""
    scene, edit, *_ = bear().save(tmp_path)
    options = ["--size", "21x15", "--engine", "cpu", "--sweep", edit.stem, "-o", str(out)]
    return main(["render", str(scene), str(edit), *options, *words])


@pytest.mark.parametrize(("name", "size"), [("film.mp4", "22x16"), ("film.webp", "21x15"), ("film", "21x15")])
def test_output_reports_the_written_size(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, size: str
) -> None:
    if name.endswith(".mp4"):
        pytest.importorskip("imageio_ffmpeg", reason="the extra video is not installed")
    assert sweep(tmp_path, tmp_path / name) == 0
    assert f"frames of {size}, " in capsys.readouterr().out


@pytest.mark.parametrize("name", ["film.webp", "frames"])
def test_film_with_alpha_has_a_transparent_background(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    assert sweep(tmp_path, out, "--alpha") == 0
    first = out if out.is_file() else out / "frame_0000.png"
    with Image.open(first) as picture:
        assert picture.mode == "RGBA"
        alpha = np.asarray(picture)[..., 3]
    assert alpha[0, 0] == 0, "nothing stands in the corner"
    assert alpha.max() > 200


@pytest.mark.parametrize("name", ["film.gif", "film.mp4"])
def test_film_format_without_alpha_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    assert sweep(tmp_path, tmp_path / name, "--alpha") == 2
    assert f"{name} cannot hold a transparent background" in capsys.readouterr().err
    assert not (tmp_path / name).exists()
