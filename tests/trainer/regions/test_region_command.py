"""`progdf region`: preview and saving of a region; `progdf views`: pictures to draw masks on."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw
from PIL.PngImagePlugin import PngInfo

from progdf.__main__ import main
from progdf.demo_scenes import DemoScene
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.io.cameras import load_cameras, save_cameras
from progdf.region import from_mask
from progdf.scene.orbit_rig import orbit_rig
from progdf.scene.regions import parse_region
from progdf.terminal import format_count
from tests.helpers.demo_scenes import bear
from trainer.options import RegionOptions, TrainingViewOptions
from trainer.regions.command import picture
from trainer.regions.from_pictures import RegionRequest, region_kinds


@pytest.fixture(scope="module")
def demo() -> DemoScene:
    return bear(3000)


@pytest.fixture
def scene(demo: DemoScene, tmp_path: Path) -> Path:
    save_ply(tmp_path / "bear.ply", demo.gaussians)
    np.save(tmp_path / "labels.npy", demo.labels.numpy())
    return tmp_path / "bear.ply"


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == 0
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    assert main([str(argument) for argument in arguments]) == 2
    return capsys.readouterr().err


def test_saved_region_loads_as_the_same_region(
    demo: DemoScene, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = f"labels:{tmp_path}/labels.npy:0+sphere:0,1,0,0.2"
    out = tmp_path / "members.npy"
    line = said(capsys, "region", scene, spec, "-o", out)
    kept = np.load(out)
    wanted = parse_region(spec, demo.gaussians)
    assert kept.dtype == np.int64
    assert torch.equal(parse_region(f"file:{out}", demo.gaussians).members, wanted.members)
    assert f"{format_count(len(kept))} of 3 000" in line
    mask = np.zeros(3000, np.bool_)
    mask[kept] = True
    np.save(tmp_path / "mask.npy", mask)
    both = parse_region(f"all - file:{tmp_path}/mask.npy", demo.gaussians)
    assert len(both) == 3000 - len(kept)


@pytest.mark.parametrize(
    ("stored", "told"),
    [
        (np.array([0, 3000]), "names row 3000, the scene has rows 0 to 2999"),
        (np.array([-1, 2]), "names row -1"),
        (np.ones(2999, np.bool_), "is a mask of 2999, the scene has 3000 Gaussians"),
        (np.zeros(4), "float64 numbers"),
        (np.zeros((2, 2), np.int64), "2 dimensions"),
    ],
)
def test_rows_of_another_scene_are_a_one_line_error(
    stored: np.ndarray, told: str, demo: DemoScene, tmp_path: Path
) -> None:
    np.save(tmp_path / "m.npy", stored)
    with pytest.raises(ProgdfError, match=told):
        parse_region(f"file:{tmp_path}/m.npy", demo.gaussians)


def test_picture_tints_the_region_and_grays_the_remainder(demo: DemoScene) -> None:
    camera = demo.cameras[0].resize(64, 64)
    nothing = picture(demo.gaussians, from_mask("", torch.zeros(3000, dtype=torch.bool)), camera)
    assert float((nothing.amax(dim=2) - nothing.amin(dim=2)).max()) < 1e-3, "gray"
    assert float(nothing.min()) > 0.6, "pale"
    region = from_mask("", demo.labels == demo.labels[0])
    shown = picture(demo.gaussians, region, camera)
    changed = (shown - nothing).abs().amax(dim=2) > 0.1
    assert 20 < int(changed.sum()) < 64 * 64 / 2
    red, _, blue = shown[changed].mean(dim=0).tolist()
    assert red > blue + 0.2


def test_region_is_shown_from_four_sides_or_a_given_camera(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_cameras(tmp_path / "c.json", orbit_rig(bear(1000).gaussians, 2, 40, 30))
    out = tmp_path / "r.png"
    for asked, size in (
        ((), (128, 96)),
        (("--camera", f"{tmp_path}/c.json:1"), (40, 30)),
    ):
        said(capsys, "region", scene, "all", "--size", "64x48", "-o", out, *asked)
        assert Image.open(out).size == size


def test_invalid_region_command_is_refused_and_writes_nothing(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "r.png"
    assert "not a .png or .npy" in refused(capsys, "region", scene, "all", "-o", tmp_path / "r.jpg")
    assert "holds no Gaussian" in refused(capsys, "region", scene, "sphere:99,0,0,1", "-o", out)
    assert "--size" in refused(capsys, "region", scene, "all", "-o", out, "--size", "0x9")
    assert not out.exists()


def test_masks_drawn_on_views_select_the_region_for_training(
    demo: DemoScene, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "v"
    line = said(capsys, "views", scene, "--out", out, "--views", "5", "--image-size", "96", "--up", "+y")
    cameras = load_cameras(out / "cameras.json")
    assert len(cameras) == 5
    assert f"--cameras {out}/cameras.json --region masks:{out}" in line
    from trainer.views.view import render_colors, with_near_plane

    bear_itself = demo.members(*(name for name in demo.label_names if name not in ("plinth", "grass")))
    member = torch.zeros(3000, 3)
    member[bear_itself] = 1.0
    for camera in with_near_plane(cameras, demo.gaussians)[:4]:
        with Image.open(out / "original" / f"{camera.name}.png") as original:
            assert original.size == (96, 96)
        seen = render_colors(demo.gaussians, member, camera, torch.zeros(3))[..., 0] > 0.5
        Image.fromarray((255 * seen.numpy()).astype(np.uint8)).save(out / f"{camera.name}.png")
    settings = RegionRequest(
        RegionOptions("masks"), TrainingViewOptions(out / "cameras.json"), lambda: tmp_path
    )
    found = parse_region(f"masks:{out}", demo.gaussians, kinds=region_kinds(settings))
    both = torch.isin(found.members, bear_itself).sum()
    assert int(both) > 0.85 * max(len(found), len(bear_itself))


def test_views_of_cameras_in_subfolders_keep_the_subfolders(
    demo: DemoScene, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rig = orbit_rig(demo.gaussians, 4, 64, 64)
    names = ("images/cam0/1.JPG", "images/cam1/1.JPG", "images/../../../cam0/2.JPG", "images/cam1/2.JPG")
    save_cameras(tmp_path / "c.json", [replace(c, name=n) for c, n in zip(rig, names, strict=True)])
    out = tmp_path / "v"
    said(capsys, "views", scene, "--out", out, "--cameras", tmp_path / "c.json")
    written = sorted(path.relative_to(out / "original").as_posix() for path in out.rglob("*.png"))
    assert written == [f"images/cam{i}/{j}.png" for i in (0, 1) for j in (1, 2)]
    for name in ("cam0", "cam1"):
        (out / name).mkdir()
        Image.new("L", (64, 64), 255).save(out / name / "1.JPG.png")
    request = RegionRequest(RegionOptions("masks"), TrainingViewOptions(), lambda: tmp_path)
    assert len(parse_region(f"masks:{out}", demo.gaussians, kinds=region_kinds(request)))


def test_views_do_not_overwrite_a_folder_of_views(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cameras.json").write_text("[]")
    assert "already exists" in refused(capsys, "views", scene, "--out", tmp_path)
    assert (tmp_path / "cameras.json").read_text() == "[]"
    assert not (tmp_path / "original").exists()


def paint_strokes(view: Path, out: Path, **lines: list[tuple[int, int]]) -> Path:
    """Draw colored lines over a rendered view and save it like a painting program; return the path."""
    with Image.open(view) as opened:
        info = PngInfo()
        for key, text in opened.text.items():  # type: ignore[attr-defined]
            info.add_text(key, text)
        image = opened.convert("RGB")
    for color, line in lines.items():
        ImageDraw.Draw(image).line(line, fill=color, width=5)
    image.save(out, pnginfo=info)
    return out


def test_strokes_painted_on_a_view_select_a_region(
    demo: DemoScene, scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    view = tmp_path / "view.png"
    out = tmp_path / "rows.npy"
    said(capsys, "render", scene, "-o", view, "--size", "320x240", "--engine", "cpu")
    line = [(10, 228), (60, 190), (75, 225)]
    beside = [(100, 190), (160, 215), (220, 195), (190, 140)]
    strokes = paint_strokes(view, tmp_path / "strokes.png", lime=line, red=beside)
    said(capsys, "region", scene, f"scribbles:{strokes}", "-o", out)
    ground = np.zeros(3000, bool)
    ground[demo.members("grass").numpy()] = True
    mask = np.zeros(3000, bool)
    mask[np.load(out)] = True
    assert (mask & ground).sum() > 0.9 * (mask | ground).sum()
    for color, missing in (
        ("lime", "no red stroke"),
        ("red", "no green stroke"),
        ("blue", "no green stroke"),
    ):
        one = paint_strokes(view, tmp_path / "one.png", **{color: line})
        assert missing in refused(capsys, "region", scene, f"scribbles:{one}", "-o", tmp_path / "none.npy")
    Image.open(strokes).convert("RGB").save(tmp_path / "bare.png")
    (tmp_path / "broken.png").write_bytes(b"no picture")
    for file in ("bare.png", "broken.png", "absent.png"):
        assert (
            refused(
                capsys, "region", scene, f"scribbles:{tmp_path / file}", "-o", tmp_path / "none.npy"
            ).count("\n")
            == 1
        )
    assert "write scribbles:A.png" in refused(
        capsys, "region", scene, "scribbles:", "-o", tmp_path / "none.npy"
    )
    assert not (tmp_path / "none.npy").exists()
