"""`progdf render`, `export` and `check` on doubles far from 0 give the same results as near 0."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.field import fit_separable
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS
from progdf.gdf.file import fingerprint, save_gdf
from progdf.io.cameras import load_cameras, save_cameras
from tests.helpers.edits import edit_of
from tests.helpers.ply_files import as_type, moved_columns, write
from tests.helpers.stacks import bear_stack
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.state.view_state import LayerState, ViewState

FAR = (1e6, 2e6, -5e5)
SMALL = ("--size", "64x48", "--engine", "cpu")
Run = Callable[..., int]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write near.ply and far.ply, each with the scarf edit and the same cameras."""
    path = tmp_path_factory.mktemp("far")
    stack = bear_stack(800)
    for name, origin in (("near", (0.0, 0.0, 0.0)), ("far", FAR)):
        scene = load_ply(write(path / f"{name}.ply", moved_columns(stack.scene, origin)))
        assert scene.origin == origin
        save_gdf(path / f"{name}.gdf", replace(stack.gdfs[0], scene=fingerprint(scene)))
        cameras = [camera.resize(64, 48) for camera in stack.demo.cameras[:2]]
        save_cameras(path / f"{name}.json", cameras, origin)
    return path


@pytest.fixture
def run(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.chdir(folder)
    return lambda *argv: main([str(argument) for argument in argv])


def pixels(path: Path | str) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


@pytest.mark.parametrize(
    "how",
    [(), ("--orbit", "30,15"), ("--frame", "scarf"), ("--camera", "{}.json:1")],
    ids=lambda how: how[:1],
)
def test_far_scene_renders_like_the_near_one(run: Run, how: tuple[str, ...]) -> None:
    for name in ("near", "far"):
        words = [word.format(name) for word in how]
        assert run("render", f"{name}.ply", f"{name}.gdf", *words, *SMALL, "-o", f"{name}.png") == 0
    assert np.abs(pixels("far.png") - pixels("near.png")).max() <= 1
    assert pixels("far.png").std() > 10


def test_picture_of_a_far_scene_is_reused_as_camera(run: Run) -> None:
    assert run("render", "far.ply", "--orbit", "30,15", *SMALL, "-o", "a.png") == 0
    assert run("render", "far.ply", "--camera", "a.png", "--engine", "cpu", "-o", "b.png") == 0
    assert np.array_equal(pixels("a.png"), pixels("b.png"))
    assert np.abs(load_cameras("a.png")[0].position.numpy() - FAR).max() < 20.0


def test_far_session_renders_as_saved(run: Run, folder: Path) -> None:
    opened = document.load(folder / "far.ply", [folder / "far.gdf"])
    shown = ViewState(layers=(LayerState(0, "scarf", 1.0),))
    session.save(folder / "far.session.json", WindowSession(opened, shown))
    near = document.load(folder / "near.ply", [folder / "near.gdf"])
    session.save(folder / "near.session.json", WindowSession(near, shown))
    for name in ("near", "far"):
        assert run("render", f"{name}.session.json", *SMALL, "-o", f"{name}.png") == 0
    assert np.array_equal(pixels("far.png"), pixels("near.png"))


def test_edited_far_scene_is_exported_as_doubles(run: Run, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("near", "far"):
        assert run("export", f"{name}.ply", f"{name}.gdf", "-o", f"{name}_edited.ply") == 0
    near, far = capsys.readouterr().out.splitlines()
    assert far.endswith("scarf 1, x y z as doubles (far from 0); read back and compared")
    assert "doubles" not in near
    a = load_ply("near_edited.ply")
    b = load_ply("far_edited.ply")
    assert torch.allclose(b.means, a.means, rtol=0, atol=1e-9)  # doubles at 2e6 have steps of 2e-10
    assert torch.equal(b.sh0, a.sh0)
    assert b.origin == FAR


def test_edit_that_moves_the_origin_is_exported(run: Run) -> None:
    scene = load_ply("far.ply")
    offsets = torch.zeros(2, len(scene), BASE_CHANNELS)
    offsets[1, :, :3] = 21.3
    field = fit_separable(torch.tensor([0.0, 1.0]), offsets, dict.fromkeys(ATTRIBUTES, 1))
    save_gdf("away.gdf", edit_of(scene, torch.arange(len(scene)), field, "away"))
    assert run("export", "far.ply", "away.gdf", "-o", "away.ply") == 0
    found = load_ply("away.ply")
    assert found.origin != scene.origin
    assert float((found.world_means - scene.world_means - 21.3).abs().max()) < 1e-5


def test_info_reports_the_origin_and_float_precision_of_a_far_scene(
    run: Run, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("info", "far.ply") == 0
    lines = capsys.readouterr().out.splitlines()
    assert "origin: 1000000 2000000 -500000 (the scene is far from 0)" in lines
    assert not [line for line in lines if line.startswith("lost")]
    write(folder / "floats.ply", as_type("f4")(moved_columns(bear_stack(800).scene, FAR)))
    assert run("info", "floats.ply") == 0
    assert any(
        line.startswith("lost: float32 positions have steps of 0.12 this far from 0: ")
        for line in capsys.readouterr().out.splitlines()
    )
