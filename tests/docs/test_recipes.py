"""Tests of docs/recipes.md: its Python blocks and commands run unchanged on a scene of a few Gaussians."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from progdf import Layer, compose_layers, load_gdf, load_scene, save_ply
from progdf.__main__ import main
from progdf.gdf.file import save_gdf
from progdf.io.cameras import save_cameras
from progdf.quaternions import rotation_matrices
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.camera_tables import nerfstudio, some_cameras, written
from tests.helpers.documents import blocks
from tests.helpers.edits import curved_field, edit_of, some_rows
from tests.helpers.paths import ROOT
from tests.helpers.scenes import random_gaussians

PAGE = (ROOT / "docs" / "recipes.md").read_text(encoding="utf-8")


def section(heading: str) -> str:
    """Return the text below a heading of the page."""
    (text,) = [part for part in PAGE.split("\n## ")[1:] if part.startswith(heading)]
    return text


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Enter a folder with the files that the page names."""
    monkeypatch.chdir(tmp_path)
    scene = random_gaussians(60, seed=3, sh_degree=2)
    save_ply("robot.ply", scene)
    for seed, name in enumerate(("blue", "hand")):
        Path("runs", name).mkdir(parents=True)
        members = some_rows(scene, 20, seed)
        gdf = edit_of(scene, members, curved_field(20, seed, 38), name)
        save_gdf(Path("runs", name, f"{name}.gdf"), gdf)
    save_cameras("cameras.json", orbit_rig(scene, 2, 32, 24))
    return tmp_path


def run_python(heading: str) -> dict[str, Any]:
    """Run the only Python block below a heading. Return the names it defines."""
    (code,) = blocks(section(heading), "python")
    names: dict[str, Any] = {"__name__": "recipe"}
    exec(compile(code, heading, "exec"), names)
    return names


def run_commands(heading: str) -> int:
    """Run each command below a heading except `train` and `view`. Return their number."""
    lines = [shlex.split(line) for block in blocks(section(heading)) for line in block.splitlines()]
    commands = [words[1:] for words in lines if words[0] == "progdf" and words[1] not in ("train", "view")]
    for words in commands:
        assert main(words) == 0, words
    return len(commands)


def edited(strength: float) -> Any:
    scene = load_scene("robot.ply")
    return compose_layers(scene, [Layer(load_gdf("runs/blue/blue.gdf", scene), strength)])


def test_recipe_from_python_renders_and_exports(here: Path) -> None:
    names = run_python("From Python")
    assert names["image"].shape == (24, 32, 3)
    assert Path("edited.png").is_file()
    assert len(load_scene("edited.compressed.ply")) == len(names["edited"]) == 60
    assert not torch.equal(names["edited"].sh0, names["scene"].sh0)


def test_viser_shows_the_edit_at_the_slider_strength(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    viser = pytest.importorskip("viser", reason="pip install viser")
    monkeypatch.setattr(viser.ViserServer, "sleep_forever", lambda server: None)
    names = run_python("viser")
    try:
        splats = names["splats"]
        for strength in (0.0, 1.0):
            names["slider"].value = strength
            after = edited(strength)
            axes = rotation_matrices(after.unit_quats) * after.scales[:, None]
            assert np.array_equal(splats.centers, after.means.numpy())
            np.testing.assert_allclose(splats.covariances, axes @ axes.mT, rtol=1e-3, atol=1e-6)  # float16
            assert np.abs(splats.opacities[:, 0] / 255.0 - after.opacities.numpy()).max() < 0.005
    finally:
        names["server"].stop()


def test_rerun_records_every_step(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rerun = pytest.importorskip("rerun", reason="pip install rerun-sdk")
    log = rerun.log
    logged = []
    monkeypatch.setattr(rerun, "log", lambda *given, **more: (logged.append(given[1]), log(*given, **more)))
    run_python("Rerun")
    assert Path("blue.rrd").stat().st_size > 21 * 60 * 15 * 3
    assert len(logged) == 1 + 21
    centers = np.asarray(logged[-1].centers.as_arrow_array().to_pylist(), np.float32)
    assert np.array_equal(centers, edited(1.0).means.numpy())


def test_blender_gets_time_samples_in_meters(here: Path) -> None:
    usd = pytest.importorskip("pxr", reason="pip install progdf-studio[usd]")
    assert usd
    from pxr import Usd, UsdGeom

    assert run_commands("Blender") == 2
    stage = Usd.Stage.Open("blue.usdc")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0, "else Blender takes units for centimeters"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 24.0)
    positions = stage.GetDefaultPrim().GetAttribute("positions")
    assert positions.GetNumTimeSamples() == 25
    turned = np.array(positions.Get(24)) * (1, -1, -1)
    np.testing.assert_array_equal(turned, edited(1.0).means.numpy())


def test_supersplat_round_trip_applies_to_a_cropped_scene(here: Path) -> None:
    scene = load_scene("robot.ply")
    save_ply("cleaned.ply", scene[torch.arange(len(scene) - 1, 3, -1)])  # cropped and reordered
    assert run_commands("SuperSplat") == 5
    assert len(list(here.glob("turn_*.ply"))) == 25
    rows = torch.arange(len(scene) - 1, 3, -1)
    np.testing.assert_allclose(load_scene("edited_cleaned.ply").means, edited(1.0).means[rows], atol=1e-6)


def test_checkpoints_and_cameras_of_trainers_are_read(here: Path) -> None:
    scene = load_scene("robot.ply")
    parts = {
        "means": scene.means,
        "quats": scene.quats,
        "scales": scene.log_scales,
        "opacities": scene.logit_opacities,
    }
    torch.save(
        {"step": 1, "splats": {**parts, "sh0": scene.sh0[:, None], "shN": scene.shN}}, "ckpt_29999_rank0.pt"
    )
    named = {**parts, "opacities": scene.logit_opacities[:, None]}
    named |= {"features_dc": scene.sh0, "features_rest": scene.shN}
    torch.save(
        {"step": 1, "pipeline": {f"_model.gauss_params.{n}": t for n, t in named.items()}},
        "step-000029999.ckpt",
    )
    written(Path("transforms.json"), nerfstudio(some_cameras()))
    pycolmap = pytest.importorskip("pycolmap", reason="the colmap extra is not installed")
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=320, height=200, params=[300.0, 300, 160, 100])
    )
    for i, view in enumerate(some_cameras()):
        image = pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(view.viewmat[:3].double().numpy()))
    Path("colmap/sparse/0").mkdir(parents=True)
    model.write("colmap/sparse/0")
    assert run_commands("nerfstudio") == 4
    for name in ("ckpt_29999_rank0.pt", "step-000029999.ckpt"):
        assert torch.equal(load_scene(name).shN, scene.shN)


def test_every_python_block_except_blender_is_run() -> None:
    with_code = [part.split(":")[0].strip() for part in PAGE.split("\n## ")[1:] if "```python" in part]
    names = [name.splitlines()[0] for name in with_code]
    assert names == ["From Python", "viser", "Rerun", "Blender"]
