"""`progdf render` and `progdf export` as command lines."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.camera import Camera
from progdf.compose.reference import Layer, compose_layers
from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import ATTRIBUTES
from progdf.gdf.file import save_gdf
from progdf.io.cameras import camera_in_picture, load_cameras, read_camera, save_cameras
from progdf.rasterize import render
from tests.helpers.stacks import Stack, bear_stack
from viewer.camera.view_camera import ViewCamera
from viewer.commands.open_stack import stack_layers
from viewer.commands.stack_options import StackOptions
from viewer.commands.viewpoint import fit_camera, parse_orbit
from viewer.files.document import load_edits
from viewer.files.scenes import SceneFile
from viewer.pictures import film

SMALL = ("--size", "64x48", "--engine", "cpu")
Run = Callable[..., int]


@pytest.fixture(scope="module")
def stack() -> Stack:
    return bear_stack(800)


@pytest.fixture(scope="module")
def folder(stack: Stack, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("render")
    stack.save(path)
    save_cameras(path / "cameras.json", [camera.resize(64, 48) for camera in stack.demo.cameras[:3]])
    return path


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(folder)
    return lambda *argv: main([str(argument) for argument in argv])


def pixels(path: Path | str) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB"))


def edited_by(stack: Stack, camera: Camera, scarf: float, ears: float) -> np.ndarray:
    layers = [Layer(stack.gdfs[0], scarf), Layer(stack.gdfs[1], ears)]
    return film.to_pixels(render(compose_layers(stack.scene, layers), camera).image.numpy())


def test_camera_file_and_strengths_render_the_composed_scene(run: Run, stack: Stack) -> None:
    options = ("--set", "scarf=0.7", "--set", "ears=1", "--camera", "cameras.json:1", "--engine", "cpu")
    assert run("render", "bear.ply", "scarf.gdf", "ears.gdf", *options, "-o", "a.png") == 0
    expected = edited_by(stack, stack.demo.cameras[1].resize(64, 48), 0.7, 1.0)
    assert np.abs(pixels("a.png").astype(int) - expected).max() <= 1


def test_picture_is_reused_as_camera(run: Run, stack: Stack) -> None:
    assert run("render", "bear.ply", "--orbit", "30,15", *SMALL, "-o", "a.png") == 0
    assert run("render", "bear.ply", "--camera", "a.png", "--engine", "cpu", "-o", "b.png") == 0
    assert np.array_equal(pixels("a.png"), pixels("b.png"))
    assert (load_cameras("a.png")[0].width, load_cameras("a.png")[0].name) == (64, "a")


def test_render_writes_its_camera_beside_the_picture(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for alpha in ((), ("--alpha",)):
        assert run("render", "bear.ply", "--orbit", "20,10", "-o", "own.png", *alpha, *SMALL) == 0
        carried = camera_in_picture("own.png")
        assert carried is not None
        (beside,) = load_cameras("own.camera.json")
        assert torch.equal(beside.viewmat, carried.viewmat)
        assert torch.equal(beside.K, carried.K)
    save_cameras("own.camera.json", [beside, beside])
    capsys.readouterr()
    assert run("render", "bear.ply", "--orbit", "20,10", "-o", "own.png", *SMALL) == 2
    assert "own.camera.json holds 2 cameras" in capsys.readouterr().err


def test_comparison_carries_no_camera(run: Run) -> None:
    assert run("render", "bear.ply", "scarf.gdf", "--split", *SMALL, "-o", "c.png") == 0
    assert camera_in_picture("c.png") is None
    assert not Path("c.camera.json").exists()


@pytest.mark.gl
def test_both_engines_write_the_same_picture(run: Run) -> None:
    options = ("bear.ply", "scarf.gdf", "--set", "scarf=1", "--camera", "cameras.json", "--size", "64x48")
    assert run("render", *options, "--engine", "cpu", "-o", "cpu.png") == 0
    assert run("render", *options, "--engine", "gl", "-o", "gl.png") == 0
    assert np.abs(pixels("cpu.png").astype(int) - pixels("gl.png")).max() <= 3, "the early stop: 0.01 of 255"


def test_edits_render_at_full_strength_by_default(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    edits = ("bear.ply", "scarf.gdf", "ears.gdf")
    both = ("--set", "scarf=1", "--set", "ears=1")
    for name, settings in (("none", ()), ("full", both), ("one", both[:2])):
        assert run("render", *edits, *settings, *SMALL, "-o", f"{name}.png") == 0
        assert capsys.readouterr().out.endswith("): scarf 1, ears 1\n")
        assert np.array_equal(pixels(f"{name}.png"), pixels("none.png"))
    assert run("render", "bear.ply", *SMALL, "-o", "plain.png") == 0
    assert run("render", *edits, "--set", "ears=0", "--set", "scarf=0", *SMALL, "-o", "zero.png") == 0
    assert "every slider is at 0" in capsys.readouterr().out
    assert np.array_equal(pixels("plain.png"), pixels("zero.png"))


def test_edits_export_at_full_strength_by_default(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("export", "bear.ply", "scarf.gdf", "ears.gdf", "-o", "none.ply") == 0
    assert "scarf 1, ears 1" in capsys.readouterr().out


def test_edit_without_set_keeps_its_strength(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    settings = ("--set", "scarf=0.8")
    assert run("export", "bear.ply", "scarf.gdf", "ears.gdf", *settings, "-o", "one.ply") == 0
    assert "scarf 0.8, ears 1;" in capsys.readouterr().out
    settings += ("--set", "ears=1")
    assert run("export", "bear.ply", "scarf.gdf", "ears.gdf", *settings, "-o", "two.ply") == 0
    assert Path("one.ply").read_bytes() == Path("two.ply").read_bytes()


def test_sweep_of_one_edit_leaves_the_others_at_zero(run: Run) -> None:
    for edits in (("ears.gdf",), ("ears.gdf", "scarf.gdf")):
        command = ("render", "bear.ply", *edits, "--sheet", "ears", *SMALL)
        assert run(*command, "-o", f"{len(edits)}.png") == 0
    assert np.array_equal(pixels("1.png"), pixels("2.png"))


def test_orbit_accepts_a_leading_minus(run: Run) -> None:
    for name, orbit in (("left", "-40,10"), ("right", "40,10"), ("near", "-40,10,3")):
        assert run("render", "bear.ply", "--orbit", orbit, *SMALL, "-o", f"{name}.png") == 0
    assert not np.array_equal(pixels("left.png"), pixels("right.png"))
    assert not np.array_equal(pixels("left.png"), pixels("near.png"))


def test_frame_fits_a_region_or_the_whole_scene(run: Run) -> None:
    for name, frame in (("scarf", ("--frame", "scarf")), ("all", ("--frame", "all")), ("plain", ())):
        options = (*frame, *SMALL, "--background", "#ff00ff", "-o", f"{name}.png")
        assert run("render", "bear.ply", "scarf.gdf", *options) == 0
    bare = {name: shown_share(f"{name}.png") for name in ("scarf", "plain", "all")}
    assert bare["scarf"] < bare["plain"] < bare["all"]


def test_picture_frames_a_sparse_scene_beside_a_dense_one(run: Run, stack: Stack, tmp_path: Path) -> None:
    sparse = tmp_path / "sparse.ply"
    save_ply(sparse, stack.scene[::20])
    picture = tmp_path / "both.png"
    assert run("render", sparse, "bear.ply", "--place", "bear=12,0,0", *SMALL, "-o", picture) == 0
    camera = read_camera(str(picture))
    center = stack.scene.means.mean(dim=0)
    for shift in (0.0, 12.0):
        point = camera.viewmat[:3, :3] @ (center + torch.tensor([shift, 0.0, 0.0])) + camera.viewmat[:3, 3]
        x, y, depth = (camera.K @ point).tolist()
        assert depth > 0
        assert 0 < x / depth < camera.width
        assert 0 < y / depth < camera.height


def shown_share(path: str) -> float:
    """Return the share of background pixels in a picture, 0 to 1."""
    return float((np.abs(pixels(path).astype(int) - (255, 0, 255)).max(axis=2) < 8).mean())


def test_frame_follows_the_orbit_and_keeps_a_given_distance(run: Run) -> None:
    for name, orbit in (("side", "90,10"), ("far", "90,10,30")):
        options = ("--frame", "scarf", "--orbit", orbit, *SMALL, "--background", "#ff00ff")
        assert run("render", "bear.ply", "scarf.gdf", *options, "-o", f"{name}.png") == 0
    assert shown_share("side.png") < 0.5 < shown_share("far.png")


def test_background_has_the_requested_color(run: Run) -> None:
    assert run("render", "bear.ply", "--background", "#204060", *SMALL, "-o", "blue.png") == 0
    assert tuple(pixels("blue.png")[0, 0]) == (0x20, 0x40, 0x60)


def test_sweep_is_a_looping_animation_there_and_back(run: Run) -> None:
    assert run("render", "bear.ply", "ears.gdf", "--sweep", "ears", *SMALL, "-o", "ears.gif") == 0
    with Image.open("ears.gif") as animation:
        assert animation.n_frames == 48
        assert animation.info["loop"] == 0
        frames = []
        for i in (0, 24, 1, animation.n_frames - 1):
            animation.seek(i)
            frames.append(np.asarray(animation.convert("RGB")).astype(int))
    assert np.abs(frames[0] - frames[1]).max() > 60, "both ends of the slider"
    assert (frames[0][0, 0] == 255).all(), "a white page stays white"
    assert np.array_equal(frames[2], frames[3]), "the way back is the way there"


def test_sweep_of_all_sliders_ends_with_all_at_one(run: Run) -> None:
    edits = ("scarf.gdf", "ears.gdf")
    assert run("render", "bear.ply", *edits, "--sweep", "all", *SMALL, "-o", "all") == 0
    assert len(list(Path("all").iterdir())) == 96
    found = [pixels(f"all/frame_{i:04d}.png").astype(float) for i in (0, 24, 48)]
    for frame, settings in zip(found, ((0, 0), (1, 0), (1, 1)), strict=True):
        strengths = [f"--set={name}={s}" for name, s in zip(("scarf", "ears"), settings, strict=True)]
        assert run("render", "bear.ply", *edits, *strengths, *SMALL, "-o", "still.png") == 0
        still = np.asarray(Image.open("still.png").convert("RGB")).astype(float)
        assert np.abs(frame - still).max() <= 1, settings


def test_turntable_needs_no_edit_and_starts_at_the_given_camera(run: Run) -> None:
    options = ("--turntable", "1", "--orbit", "40,20", *SMALL)
    assert run("render", "bear.ply", *options, "-o", "turn") == 0
    assert run("render", "bear.ply", "--orbit", "40,20", *SMALL, "-o", "still.png") == 0
    assert len(list(Path("turn").glob("*.png"))) == 24
    first, half, still = (
        pixels(name).astype(int) for name in ("turn/frame_0000.png", "turn/frame_0012.png", "still.png")
    )
    assert np.abs(first - still).mean() < 0.5
    assert np.abs(half - still).mean() > 2.0


def test_sheet_of_one_slider_is_a_row_of_five(run: Run) -> None:
    assert run("render", "bear.ply", "ears.gdf", "--sheet", "ears", *SMALL, "-o", "row.png") == 0
    height, width, _ = pixels("row.png").shape
    assert width >= 5 * 64
    assert 48 < height < 2 * 48


def test_sheet_of_two_sliders_is_a_grid_with_the_original(run: Run) -> None:
    edits = ("scarf.gdf", "ears.gdf", "--sheet", "scarf,ears")
    assert run("render", "bear.ply", *edits, *SMALL, "-o", "grid.png") == 0
    grid = pixels("grid.png")
    assert grid.shape[0] >= 5 * 48
    assert grid.shape[1] >= 5 * 64
    assert run("render", "bear.ply", *SMALL, "-o", "original.png") == 0
    original = pixels("original.png")
    places = (
        (y, x)
        for y in range(grid.shape[0] - 4 * 48)
        for x in range(grid.shape[1] - 4 * 64)
        if np.array_equal(grid[y : y + 48, x : x + 64], original)
    )
    assert next(places, None) is not None


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--set", "hat=1"), "--set hat: there is no edit of that name; there are scarf, ears"),
        (("--set", "scarf=nan"), "--set scarf=nan: the strength 'nan' is not a number from 0 to 1"),
        (("--set", "scarf=much"), "--set scarf=much: the strength 'much' is not a number from 0 to 1"),
        (("--set", "scarf=1.5"), "--set scarf=1.5: the strength '1.5' is not a number from 0 to 1"),
        (("--set", "scarf"), "--set scarf is not NAME=S"),
        (("--size", "0x48"), "--size 0x48 cannot be drawn; each side may be 1 to 16384 pixels"),
        (("--size", "99999x48"), "--size 99999x48 cannot be drawn"),
        (("--size", "big"), "--size big is not a size; write it as WIDTHxHEIGHT"),
        (("--size", f"{'9' * 5000}x1"), "--size 9999"),
        (("--camera", "cameras.json:--1"), "cameras.json:--1 does not exist"),
        (("--camera", f"cameras.json:{'9' * 200}"), "cameras.json:9999"),
        (("--camera", "nope.json"), "nope.json does not exist"),
        (("--camera", "cameras.json:3"), "cameras.json has no camera 3; it holds 3, numbered 0 to 2"),
        (("--camera", "cameras.json", "--orbit", "1,2"), "--camera and --orbit cannot be combined"),
        (("--camera", "cameras.json", "--frame", "all"), "--camera and --frame cannot be combined"),
        (("--frame", "hat"), "--frame hat: there is no edit of that name; there are scarf, ears"),
        (("--orbit", "30"), "--orbit 30 is not two or three numbers"),
        (("--orbit", "a,b"), "--orbit a,b is not a list of numbers"),
        (("--orbit", "0,91"), "--orbit 0,91: the elevation must be between -90 and 90 degrees, got 91"),
        (("--orbit", "0,0,0"), "--orbit 0,0,0: the distance must be above 0 and at most 1e+09, got 0"),
        (("--orbit", "0,0,1e300"), "--orbit 0,0,1e300: the distance must be above 0"),
        (("--background", "pink"), "'pink' is not a color"),
        (("--sweep", "scarf"), "x.png cannot hold a film"),
        (("--sheet", "scarf,hat"), "--sheet hat: there is no edit of that name"),
        (("--sheet", "scarf,scarf"), "--sheet scarf,scarf does not name one or two different edits"),
    ],
)
def test_invalid_option_is_one_line_and_leaves_no_file(
    run: Run, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], line: str
) -> None:
    assert run("render", "bear.ply", "scarf.gdf", "ears.gdf", *options, "-o", "x.png") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"progdf: {line}")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    assert not list(Path().glob("*x*.png"))


@pytest.mark.parametrize(
    ("argv", "line"),
    [
        (("render", "nope.ply", "-o", "x.png"), "nope.ply does not exist"),
        (("render", "bear.ply", "nope.gdf", "-o", "x.png"), "nope.gdf does not exist"),
        (("render", "bear.ply", "-o", "nowhere/x.png"), "the folder nowhere does not exist"),
        (("render", "bear.ply", "-o", "x.jpg"), "x.jpg is not a .png file"),
        (("render", "bear.ply", "-o", "x.gif"), "x.gif holds an animation; add --sweep NAME or"),
        (("render", "bear.ply", "--sweep", "ears", "-o", "x.gif"), "--sweep ears: no .gdf file was given"),
        (
            ("render", "bear.ply", "--turntable", "0", "-o", "x.gif"),
            "--turntable must be 1 to 120 seconds, got 0",
        ),
        (("view", "nope.ply"), "nope.ply does not exist"),
        (("view", "bear.ply", "scarf.gdf", "--set", "hat=1"), "--set hat: there is no edit of that name"),
        (("export", "bear.ply", "ears.gdf", "-o", "bear.ply"), "bear.ply is one of the files to read"),
        (
            ("export", "bear.ply", "ears.gdf", "-o", "x.obj"),
            "x.obj does not end in a known format; use .ply,",
        ),
        (
            ("export", "bear.ply", "ears.gdf", "--frames", "1", "-o", "x.ply"),
            "--frames takes 2 to 1000 steps, not 1",
        ),
        (
            ("export", "bear.ply", "ears.gdf", "--set", "ears=-1", "-o", "x.ply"),
            "--set ears=-1: the strength",
        ),
    ],
)
def test_invalid_files_are_one_line_each(
    run: Run, capsys: pytest.CaptureFixture[str], argv: tuple[str, ...], line: str
) -> None:
    assert run(*argv) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"progdf: {line}")
    assert error.count("\n") == 1


def test_missing_video_encoder_names_the_extra_to_install(
    run: Run, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(film.importlib.util, "find_spec", lambda name: None)
    assert run("render", "bear.ply", "ears.gdf", "--sweep", "ears", "-o", "x.mp4") == 2
    error = capsys.readouterr().err
    assert error.startswith("progdf: x.mp4 needs a video encoder; pip install 'progdf-studio[video]'")


def test_exported_scene_equals_the_composed_one(
    run: Run, stack: Stack, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ("--set", "ears=0.5", "--set", "scarf=1")
    assert run("export", "bear.ply", "scarf.gdf", "ears.gdf", *settings, "-o", "edited.ply") == 0
    assert "read back and compared" in capsys.readouterr().out
    expected = compose_layers(load_ply("bear.ply"), [Layer(stack.gdfs[0], 1.0), Layer(stack.gdfs[1], 0.5)])
    found = load_ply("edited.ply")
    for name in ATTRIBUTES:
        tolerance = 1e-6 if name == "quats" else 0.0
        assert torch.allclose(getattr(found, name), getattr(expected, name), rtol=0.0, atol=tolerance), name


@pytest.mark.parametrize("ending", [".compressed.ply", ".glb", ".splat"])
def test_export_to_another_format_reports_size_and_loss(
    run: Run, capsys: pytest.CaptureFixture[str], ending: str
) -> None:
    assert run("export", "bear.ply", "scarf.gdf", "-o", f"edited{ending}") == 0
    output = capsys.readouterr().out
    size = r"[\d.]+ kB, [\d.]+ bytes each"
    shift = r"positions (?:exact|within [\d.e-]+)"
    assert re.search(rf"{size}; read back: {shift}, (no pixel differs|[\d.]+ dB to it, )", output), output


def test_glb_is_exported_in_the_chosen_axes(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for axes in ("LUF", "RUB"):
        assert run("export", "bear.ply", "--glb-axes", axes, "-o", "a.glb") == 0
        assert "no pixel differs" in capsys.readouterr().out
        assert f'"axes": "{axes}"'.encode() in Path("a.glb").read_bytes()
    assert run("export", "bear.ply", "--glb-axes", "RUB", "-o", "a.ply") == 2
    assert "a.ply is not a .glb; leave out --glb-axes" in capsys.readouterr().err


def test_frames_go_from_the_original_to_the_strengths(run: Run, stack: Stack) -> None:
    assert (
        run("export", "bear.ply", "scarf.gdf", "--set", "scarf=0.8", "--frames", "3", "-o", "step.ply") == 0
    )
    scene = load_ply("bear.ply")
    for number, strength in enumerate((0.0, 0.4, 0.8)):
        expected = compose_layers(scene, [Layer(stack.gdfs[0], strength)])
        assert torch.equal(load_ply(f"step_{number:03d}.ply").sh0, expected.sh0), number


def test_export_that_fails_verification_leaves_no_file(
    run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from progdf.formats import ply

    def damaged(path: Path) -> object:
        scene = load_ply(path)
        return replace(scene, sh0=scene.sh0 + 1e-3) if Path(path).name != "bear.ply" else scene

    monkeypatch.setattr(ply, "load_ply", damaged)
    assert run("export", "bear.ply", "ears.gdf", "-o", "damaged.ply") == 2
    assert "does not match in its sh0" in capsys.readouterr().err
    assert not Path("damaged.ply").exists()
    assert not list(Path().glob(".damaged*"))


def test_second_edit_of_the_same_name_gets_a_number(stack: Stack, tmp_path: Path) -> None:
    for file in ("a.gdf", "b.gdf"):
        save_gdf(tmp_path / file, stack.gdfs[0])
    gdfs = load_edits([tmp_path / "a.gdf", tmp_path / "b.gdf"], [SceneFile("bear", stack.scene)])
    assert [gdf.name for gdf in gdfs] == ["scarf", "scarf-2"]
    half = StackOptions(scene=Path("bear.ply"), set=("scarf-2=0.5",))
    assert [layer.strength for layer in stack_layers(gdfs, half)] == [0.0, 0.5]


def test_camera_index_minus_one_is_the_last(folder: Path, stack: Stack) -> None:
    last = read_camera(f"{folder / 'cameras.json'}:-1")
    assert torch.equal(last.viewmat, stack.demo.cameras[2].viewmat)


def test_other_picture_size_keeps_the_vertical_field_of_view(stack: Stack) -> None:
    camera = stack.demo.cameras[0]
    wide = fit_camera(camera, (2 * camera.width, camera.height))
    assert float(wide.K[0, 0]) == float(wide.K[1, 1]) == float(camera.K[1, 1])
    assert float(wide.K[0, 2]) == camera.width
    half = fit_camera(camera, (camera.width // 2, camera.height // 2))
    assert torch.allclose(half.K, camera.resize(camera.width // 2, camera.height // 2).K)


def test_orbit_keeps_the_framed_pivot_and_distance() -> None:
    framed = ViewCamera(pivot=(1.0, 2.0, 3.0), distance=7.0)
    assert parse_orbit("-30,15", framed) == replace(framed, azimuth=-30.0, elevation=15.0)
    assert parse_orbit("0,90,2.5", framed).distance == 2.5
    assert math.isclose(parse_orbit("1e2,-90", framed).azimuth, 100.0)
