"""Tests of `progdf info`: the description of a file."""

from __future__ import annotations

import io
import json
import sys
import threading
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.cli.info import survey
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import Gaussians
from progdf.io.cameras import save_cameras
from progdf.scene.orbit_rig import orbit_rig
from progdf.terminal import format_count, notice_when_slow
from tests.helpers.camera_tables import nerfstudio, some_cameras
from tests.helpers.colmap_text import write_text_model
from tests.helpers.scenes import random_gaussians
from tests.helpers.stacks import bear_stack

FAR = 1e6


def tidy(count: int = 300) -> Gaussians:
    """Return small round Gaussians with unit quaternions, none of them unusual."""
    scene = random_gaussians(count, seed=6)
    return replace(
        scene,
        quats=scene.unit_quats,
        log_scales=torch.full((count, 3), 0.02).log(),
        logit_opacities=torch.ones(count),
    )


def lines_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> list[str]:
    assert main(list(arguments)) == 0
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out.splitlines()


def error_of(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(list(arguments)) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("progdf: ")
    assert captured.err.count("\n") == 1
    return captured.err


def test_info_shows_the_count_and_that_nothing_was_repaired(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_ply(tmp_path / "scene.ply", tidy(1200))
    lines = lines_of(capsys, "info", str(tmp_path / "scene.ply"))
    assert lines[0] == "scene.ply: 1 200 Gaussians, SH degree 0, binary little-endian, 82.0 kB"
    assert "repaired: nothing" in lines
    assert not [line for line in lines if line.startswith(("ignored", "normalized", "odd"))]


def test_info_names_every_repair(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.ply"
    scene = tidy()
    scene.means[3] = FAR
    scene.means[5] = FAR
    scene.quats[7] = 0
    save_ply(path, scene)
    far, nan = (torch.tensor(value).numpy().tobytes() for value in (FAR, float("nan")))
    path.write_bytes(path.read_bytes().replace(far, nan))
    lines = lines_of(capsys, "info", str(path))
    assert "repaired: 2 Gaussians made invisible: 2 with NaN, infinite or absurd position" in lines
    assert "repaired: 1 Gaussian with a zero quaternion, taken as no rotation" in lines
    assert "repaired: nothing" not in lines


def test_info_reports_strays_and_the_command_that_removes_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tidy()
    scene.log_scales[0] = torch.tensor(50.0).log()
    scene.log_scales[1:4, 0] = torch.tensor(20.0).log()
    scene.logit_opacities[4:9] = -9.0
    save_ply(tmp_path / "scene.ply", scene)
    line = lines_of(capsys, "info", str(tmp_path / "scene.ply"))[-1]
    assert line.startswith("strays: 4 giants, ")
    assert ", 5 too transparent to be drawn; progdf edit " in line


def test_survey_describes_the_bulk_of_the_scene() -> None:
    scene = tidy(2000)
    scene.means[0] = torch.tensor([500.0, 0.0, 0.0])
    found = survey(scene)
    assert found.farthest == pytest.approx(500, rel=0.01)
    assert 2.5 < found.radius < 3.5
    assert max(abs(x) for x in found.center) < 0.2
    assert found.median_size == pytest.approx(0.02)
    assert not found.surrounding


def test_info_of_a_broken_file_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "scene.ply"
    save_ply(path, tidy())
    path.write_bytes(path.read_bytes()[:-10])
    assert "truncated" in error_of(capsys, "info", str(path))


def test_info_detects_files_by_content_not_by_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    stack = bear_stack(2000)
    scene, scarf, _ = stack.save(tmp_path)
    save_cameras(tmp_path / "c.json", orbit_rig(stack.scene, 3, 64, 48))
    expected = {scene: "2 000 Gaussians", scarf: "the edit 'scarf'", tmp_path / "c.json": "3 cameras"}
    for path, description in expected.items():
        disguised = path.rename(tmp_path / f"{path.stem}.txt")
        assert description in lines_of(capsys, "info", str(disguised))[0]


def test_info_of_an_edit_shows_its_scene_region_field_and_errors(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from progdf.gdf.file import save_gdf

    stack = bear_stack(2000)
    report = {"field": {"psnr_worst": 46.91234, "psnr_mean": 50.0}, "edit": {"clip_direction": None}}
    gdf = replace(stack.gdfs[0], options={"steps": 600, "slider": "even"}, report=report)
    save_gdf(tmp_path / "scarf.gdf", gdf)
    lines = lines_of(capsys, "info", str(tmp_path / "scarf.gdf"))
    assert f"instruction: {gdf.instruction}" in lines
    assert f"scene: 2 000 Gaussians, fingerprint {gdf.scene.means_sha256[:12]}" in lines
    members = len(gdf.region)
    assert any(line.startswith(f"region: scarf, {members} Gaussians") for line in lines)
    assert any(
        line.startswith(f"field: {gdf.field.kind}, ") and "bytes per Gaussian" in line for line in lines
    )
    assert any(line.endswith(", 5 knots; full edits and bases: sh0 float32 + 1") for line in lines)
    assert {"option: steps 600", "option: slider even"} <= set(lines)
    assert {"report: field.psnr_worst 46.91", "report: edit.clip_direction not measured"} <= set(lines)


def test_info_lists_ignored_fields_of_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = nerfstudio(some_cameras(), aabb_scale=16, k1=0.1)
    content["frames"][1] |= {"sharpness": 20.5, "k1": 0.0}
    path = tmp_path / "transforms.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(content).encode())  # byte order mark
    assert lines_of(capsys, "info", str(path)) == [
        "transforms.json: 4 cameras",
        "images: 320x200 pixels",
        "lens: 3 of 4 cameras have one; photographs are undistorted",
        "ignored: aabb_scale, sharpness",
    ]


def test_info_shows_a_folder_of_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_text_model(tmp_path / "sparse" / "0", ["a.jpg"])
    large = write_text_model(tmp_path / "sparse" / "1", ["a.jpg", "b c.jpg"])
    note = f"{large} is used, the largest of 2 COLMAP models: 2 images, 0 has 1"
    expected = [f"{tmp_path.name}: 2 cameras", note, "images: 640x480 pixels"]
    assert lines_of(capsys, "info", str(tmp_path)) == expected
    assert lines_of(capsys, "info", str(large / "images.txt"))[0] == "images.txt: 2 cameras"
    assert "is a folder" in error_of(capsys, "info", str(tmp_path / "sparse" / ".." / ".."))


def test_cameras_and_up_options_are_for_scenes_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_ply(tmp_path / "scene.ply", tidy())
    save_cameras(tmp_path / "c.json", orbit_rig(tidy(), 3, 64, 48))
    lines = lines_of(capsys, "info", str(tmp_path / "scene.ply"), "--cameras", str(tmp_path / "c.json"))
    assert any(line.startswith("up: ") for line in lines)
    assert any(
        line.startswith("up: +z")
        for line in lines_of(capsys, "info", str(tmp_path / "scene.ply"), "--up", "+z")
    )
    assert "is not a scene" in error_of(capsys, "info", str(tmp_path / "c.json"), "--up", "+z")


def test_info_of_any_other_file_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "picture.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    assert "is a picture (JPEG), not a scene" in error_of(capsys, "info", str(tmp_path / "picture.jpg"))
    Image.new("RGB", (4, 4)).save(tmp_path / "picture.png")
    assert "has no stored camera" in error_of(capsys, "info", str(tmp_path / "picture.png"))
    (tmp_path / "a.gdf").write_bytes(b"")
    assert "not a .gdf" in error_of(capsys, "info", str(tmp_path / "a.gdf"))
    (tmp_path / "a.ply").write_bytes(b"version https://git-lfs.github.com/spec/v1\n")
    assert "git lfs pull" in error_of(capsys, "info", str(tmp_path / "a.ply"))
    assert "is a folder" in error_of(capsys, "info", str(tmp_path))


def test_every_real_file_is_described_or_refused_in_one_line(
    shared_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = sorted(shared_data.glob("*/*.ply"))
    assert files
    for path in files:
        status = main(["info", str(path)])
        captured = capsys.readouterr()
        if status == 0:
            assert captured.err == ""
            assert captured.out.startswith(f"{path.name}: {format_count(len(load_ply(path)))}, ")
        else:
            assert status == 2
            assert captured.out == ""
            assert captured.err.count("\n") == 1


class Terminal(io.StringIO):
    """Stderr that claims to be a terminal and signals when a line arrives."""

    def __init__(self) -> None:
        super().__init__()
        self.written = threading.Event()

    def isatty(self) -> bool:
        return True

    def flush(self) -> None:
        self.written.set()


def test_slow_search_is_announced_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with notice_when_slow("looking for strays", seconds=0.0):
        assert terminal.written.wait(60.0)
    assert terminal.getvalue() == "looking for strays\n"


def test_quick_search_prints_no_notice(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with notice_when_slow("looking for strays", seconds=3600.0):
        pass
    timers = [thread for thread in threading.enumerate() if isinstance(thread, threading.Timer)]
    assert all(timer.finished.is_set() for timer in timers)
    assert terminal.getvalue() == ""


def test_slow_search_adds_nothing_to_a_log(capsys: pytest.CaptureFixture[str]) -> None:
    with notice_when_slow("looking for strays", seconds=0.0):
        pass
    assert capsys.readouterr().err == ""
