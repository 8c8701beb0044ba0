"""Tests of reading exports back: positions within the format's rounding, other differences named."""

from __future__ import annotations

import gzip
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.__main__ import main
from progdf.errors import ProgdfError
from progdf.formats.packed import spz
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene, save_frames, save_scene
from progdf.gaussians import Gaussians
from progdf.metrics.readback import compare
from tests.helpers.scenes import random_gaussians

LOSSY = [".compressed.ply", ".spz", ".sog", ".splat", ".glb"]


@pytest.fixture(autouse=True)
def _needs_gaussforge() -> None:
    pytest.importorskip("gaussforge")


def scene_of(degree: int = 0) -> Gaussians:
    """Return a scene that every format can store."""
    scene = random_gaussians(60, seed=3, sh_degree=degree, scale=0.05)
    colors = scene.sh0.clamp(-1.0, 1.0)
    return replace(
        scene, log_scales=scene.log_scales.clamp(-7.0, 0.0), sh0=colors, shN=scene.shN.clamp(-0.9, 0.9)
    )


def with_mean(scene: Gaussians, row: int, mean: tuple[float, float, float]) -> Gaussians:
    """Return the scene with one Gaussian moved to `mean`."""
    means = scene.means.clone()
    means[row] = torch.tensor(mean)
    return replace(scene, means=means)


@pytest.mark.parametrize(
    ("farthest", "bits"), [(3.0, 12), (2047.9, 12), (2048.0, 11), (5000.0, 10), (1e6, 3), (8e6, 0)]
)
def test_spz_uses_fewer_fractional_bits_for_far_positions(farthest: float, bits: int, tmp_path: Path) -> None:
    scene = with_mean(scene_of(), 17, (0.25, -farthest, 1.5))
    path = tmp_path / "a.spz"
    found = save_scene(path, scene)
    assert found is not None
    assert gzip.decompress(path.read_bytes())[13] == bits
    assert found.position_error <= 0.5 * 2.0**-bits
    errors = (load_scene(path).world_means - scene.world_means).abs()
    assert float(errors.max()) <= 0.5 * 2.0**-bits + 1e-9 * farthest


def test_spz_beyond_its_range_names_row_and_coordinate(tmp_path: Path) -> None:
    scene = with_mean(scene_of(), 17, (0.25, 1.5, -9e6))
    with pytest.raises(ProgdfError, match=r"z of Gaussian 17 is -9000000, and an \.spz holds ±8388607"):
        save_scene(tmp_path / "a.spz", scene)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", LOSSY)
@pytest.mark.parametrize("farthest", [5000.0, 1e6])
def test_far_positions_come_back_in_every_format(ending: str, farthest: float, tmp_path: Path) -> None:
    scene = with_mean(scene_of(1), 5, (farthest, -farthest, 1.0))
    found = save_scene(tmp_path / f"a{ending}", scene)
    assert found is not None
    relative = {".sog": 5e-4, ".compressed.ply": 1e-3, ".spz": 2e-7}.get(ending, 1e-7)
    assert found.position_error <= relative * farthest


@pytest.mark.parametrize("ending", LOSSY)
def test_scene_with_an_origin_is_written_in_world_coordinates(ending: str, tmp_path: Path) -> None:
    scene = replace(scene_of(), origin=(4e6, -3e6, 2e6))
    found = save_scene(tmp_path / f"a{ending}", scene)
    assert found is not None
    assert float((found.scene.world_means.mean(dim=0) - scene.world_means.mean(dim=0)).abs().max()) < 2e3


@pytest.mark.parametrize("ending", LOSSY)
def test_scene_in_range_comes_back_without_a_note(ending: str, tmp_path: Path) -> None:
    found = save_scene(tmp_path / f"a{ending}", scene_of())
    assert found is not None
    assert found.notes == ()


def changed(**values: Tensor) -> Gaussians:
    """Return the scene with the first two Gaussians changed."""
    scene = scene_of(1)
    tensors = {name: getattr(scene, name).clone() for name in values}
    for name, value in values.items():
        tensors[name][:2] = value
    return replace(scene, **tensors)


@pytest.mark.parametrize(
    ("ending", "scene", "note"),
    [
        (".spz", changed(log_scales=torch.tensor(8.0)), "scale of 2 Gaussians off by up to a factor of 7"),
        (".spz", changed(log_scales=torch.tensor(-13.0)), "scale of 2 Gaussians off by up to a factor of"),
        (".compressed.ply", changed(log_scales=torch.tensor(25.0)), "scale of"),
        (".spz", changed(shN=torch.tensor(2.5)), "SH of 2 Gaussians off by up to 1.5"),
        (".compressed.ply", changed(shN=torch.tensor(6.0)), "SH of 2 Gaussians off by up to 2"),
        (".spz", changed(sh0=torch.tensor(5.0)), "color of 2 Gaussians off by up to 0.47"),
        (".splat", changed(sh0=torch.tensor(3.0)), "color of 2 Gaussians off by up to 0.35"),
        (".splat", scene_of(2), "SH of degree 2 cut to degree 0"),
    ],
)
def test_values_beyond_a_format_are_named(ending: str, scene: Gaussians, note: str, tmp_path: Path) -> None:
    found = save_scene(tmp_path / f"a{ending}", scene)
    assert found is not None
    assert any(line.startswith(note) for line in found.notes), found.notes


def test_name_of_a_file_may_be_text(tmp_path: Path) -> None:
    scene = scene_of()
    for ending in (".ply", ".splat"):
        save_scene(str(tmp_path / f"a{ending}"), scene)
        assert len(load_scene(tmp_path / f"a{ending}")) == len(scene)


def test_small_coordinate_in_a_long_chunk_is_in_its_bound(tmp_path: Path) -> None:
    scene = random_gaussians(4096, seed=5)
    is_near = torch.arange(4096)[:, None] % 2 == 0
    means = torch.where(is_near, 1e-3 * scene.means, 100 * scene.means)
    save_scene(tmp_path / "a.compressed.ply", replace(scene, means=means))


@pytest.mark.parametrize("ending", LOSSY)
@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "sh0", "logit_opacities"])
def test_nan_is_refused_with_its_row(ending: str, name: str, tmp_path: Path) -> None:
    scene = scene_of()
    values = getattr(scene, name).clone()
    values[7] = torch.nan
    with pytest.raises(ProgdfError, match=f"{name} of Gaussian 7 holds NaN or infinity"):
        save_scene(tmp_path / f"a{ending}", replace(scene, **{name: values}))
    assert not list(tmp_path.iterdir())


def test_single_wrong_row_is_named() -> None:
    scene = scene_of()
    wrong = with_mean(scene, 23, (904.0, 0.0, 0.0))
    bounds = torch.full((60, 3), 1e-3, dtype=torch.float64)
    with pytest.raises(ProgdfError, match=r"[xyz] of Gaussian \d+ is .* and comes back as"):
        compare("a.spz", scene, wrong, bounds)
    with pytest.raises(ProgdfError, match="only 59 of 60 Gaussians can be read back"):
        compare("a.spz", scene, wrong[:59], bounds)


def test_antialiased_is_kept_in_an_spz(tmp_path: Path) -> None:
    save_scene(tmp_path / "a.spz", replace(scene_of(), antialiased=True))
    assert load_scene(tmp_path / "a.spz").antialiased


def test_writer_that_wraps_positions_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(spz, "position_bits", lambda scene: spz.MAX_BITS)
    with pytest.raises(ProgdfError, match="x of Gaussian 4 is 5000 and comes back as 904"):
        save_scene(tmp_path / "a.spz", with_mean(scene_of(), 4, (5000.0, 0.0, 0.0)))
    assert not list(tmp_path.iterdir())


def test_frames_warn_once_about_lost_values(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    scene = changed(sh0=torch.tensor(5.0))
    assert len(save_frames(tmp_path / "a.splat", [scene, scene])) == 2
    assert caplog.text.count("color of 2 Gaussians") == 1


def test_export_reports_the_position_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_ply(tmp_path / "a.ply", with_mean(changed(sh0=torch.tensor(5.0)), 9, (5000.0, 0.0, 0.0)))
    assert main(["export", str(tmp_path / "a.ply"), "-o", str(tmp_path / "a.spz")]) == 0
    line = capsys.readouterr().out
    assert "read back: positions within 0.0004" in line
    assert "color of 2 Gaussians off by up to" in line
