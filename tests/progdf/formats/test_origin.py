"""Tests of scenes far from 0: the origin that loading subtracts, and its return in files and figures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

from progdf.cli.info import survey
from progdf.cli.rebind import match_scenes
from progdf.formats.ply import load_ply, load_ply_with_report, save_ply
from progdf.formats.repair import find_origin
from progdf.formats.scene_file import load_scene, rotate_about_x
from progdf.gaussians import ZERO, Gaussians
from progdf.gdf.file import fingerprint
from tests.helpers.ply_files import COUNT, as_type, assert_same, moved_columns, scene_of, table_of, write
from tests.helpers.scene_files import write_scene
from tests.helpers.scenes import random_gaussians

FAR = (1e6, 2e6, -5e5)


def places(path: Path) -> np.ndarray:
    """Return x, y, z as a file has them, in float64. [N,3]"""
    rows = PlyData.read(str(path))["vertex"].data
    return np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)


def small() -> Gaussians:
    """Return a scene a few units wide with Gaussians of size 0.01."""
    scene = scene_of()
    return replace(scene, log_scales=torch.full((COUNT, 3), 0.01).log())


@pytest.mark.parametrize("far", [64.0, 1e3, 1e5, 1e6])
def test_doubles_load_to_the_same_bits_at_any_distance(tmp_path: Path, far: float) -> None:
    path = write(tmp_path / "far.ply", moved_columns(small(), (far, -far, 0.0)))
    assert_same(load_ply(path), load_ply(write(tmp_path / "near.ply", table_of(small()))))
    assert np.abs(np.abs(load_ply(path).origin) - (far, far, 0.0)).max() < 2.0


def test_scene_near_zero_has_no_origin(tmp_path: Path) -> None:
    for by in (0.0, 1.0, 10.0):
        assert load_ply(write(tmp_path / "a.ply", moved_columns(small(), (by, by, by)))).origin == ZERO
    assert load_ply(write(tmp_path / "a.ply", table_of(small()))).origin == ZERO


def test_distance_for_an_origin_scales_with_the_scene() -> None:
    for unit in (1e-6, 1e-3, 1.0, 1e3):
        means = unit * small().means.double()
        log_scales = small().log_scales + np.log(unit)
        assert find_origin(means + 10 * unit, log_scales) == ZERO
        origin = find_origin(means + 1e4 * unit, log_scales)
        assert all(abs(at - 1e4 * unit) < 4 * unit for at in origin)


def test_values_that_are_not_finite_do_not_move_the_origin() -> None:
    means = small().means.double() + 1e6
    log_scales = small().log_scales
    origin = find_origin(means, log_scales)
    spoilt = means.clone()
    spoilt[:5], spoilt[5:8] = torch.nan, torch.inf
    assert np.abs(np.subtract(find_origin(spoilt, log_scales), origin)).max() <= 2.0
    for value in (torch.nan, torch.inf, 1e300):
        assert find_origin(torch.full_like(means, value), log_scales) == ZERO
    assert find_origin(means, torch.full_like(log_scales, torch.nan)) == ZERO


def test_doubles_are_written_as_doubles_and_read_back_equal(tmp_path: Path) -> None:
    path = write(tmp_path / "far.ply", moved_columns(small(), FAR))
    scene = load_ply(path)
    save_ply(tmp_path / "again.ply", scene)
    assert PlyData.read(str(tmp_path / "again.ply"))["vertex"].data.dtype["x"] == np.dtype("<f8")
    assert np.array_equal(places(tmp_path / "again.ply"), places(path))
    again = load_ply(tmp_path / "again.ply")
    assert_same(again, scene)
    assert again.origin == scene.origin


def test_scene_near_zero_is_written_as_floats(tmp_path: Path) -> None:
    save_ply(tmp_path / "near.ply", load_ply(write(tmp_path / "a.ply", moved_columns(small(), ZERO))))
    assert PlyData.read(str(tmp_path / "near.ply"))["vertex"].data.dtype["x"] == np.dtype("<f4")


@pytest.mark.parametrize("text", [True, False])
def test_text_and_big_endian_doubles_are_read(tmp_path: Path, text: bool) -> None:
    path = write(tmp_path / "far.ply", moved_columns(small(), FAR), text=text, byte_order=">")
    scene = load_ply(path)
    assert float((scene.world_means - torch.from_numpy(places(path))).abs().max()) < 1e-6
    assert scene.origin != ZERO


def test_rows_without_a_position_are_hidden_at_the_scene_center(tmp_path: Path) -> None:
    columns = moved_columns(small(), FAR)
    columns["x"][3] = np.nan
    scene, report = load_ply_with_report(write(tmp_path / "far.ply", columns))
    assert report.bad_means == 1
    assert float(scene.means[3].norm()) < 10.0
    assert len(scene) == COUNT


def test_positions_lost_to_float32_are_counted_and_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    columns = as_type("f4")(moved_columns(small(), (1e6, 1e6, 0.0)))
    scene, report = load_ply_with_report(write(tmp_path / "far.ply", columns))
    x, y = (len(np.unique(columns[name])) for name in "xy")
    assert 1 < x < COUNT
    assert report.distinct == (x, y, 0)
    lost = next(line for line in report.lines() if line.startswith("lost: "))
    assert f"steps of 0.062 this far from 0: {x} distinct x, {y} distinct y remain of 50 Gaussians" in lost
    assert "origin: 1000000 1000000 0 (the scene is far from 0)" in report.lines()
    assert np.array_equal(scene.world_means.numpy(), places(tmp_path / "far.ply"))
    load_scene(tmp_path / "far.ply")
    assert "far.ply: float32 positions have steps" in caplog.text


def test_coarse_grid_of_a_format_is_no_loss_of_float32(tmp_path: Path) -> None:
    step = 2.0**-4  # of float32 near 1e6
    rng = np.random.default_rng(0)
    for grid, is_lost in ((step, True), (8 * step, False)):
        columns = moved_columns(small(), (0.0, 0.0, 0.0))
        columns["x"] = 1e6 + grid * rng.integers(0, 64, COUNT)
        path = write(tmp_path / "far.ply", as_type("f4")(columns))
        assert bool(load_ply_with_report(path)[1].lost) is is_lost


def test_doubles_and_scenes_near_zero_lose_nothing(tmp_path: Path) -> None:
    for columns in (moved_columns(small(), FAR), table_of(small())):
        report = load_ply_with_report(write(tmp_path / "a.ply", columns))[1]
        assert report.lost == ""
        assert not [line for line in report.lines() if line.startswith("lost")]


def test_floats_far_from_zero_keep_their_fingerprint(tmp_path: Path) -> None:
    columns = as_type("f4")(moved_columns(small(), FAR))
    far = load_ply(write(tmp_path / "far.ply", columns))
    plain = replace(far, means=torch.from_numpy(np.stack([columns[n] for n in "xyz"], axis=1)), origin=ZERO)
    assert fingerprint(far) == fingerprint(plain)
    save_ply(tmp_path / "doubles.ply", far)
    assert fingerprint(load_ply(tmp_path / "doubles.ply")) == fingerprint(far)
    assert fingerprint(replace(far, origin=ZERO)) != fingerprint(far)  # the same tensor at another origin


def test_figures_are_in_world_coordinates(tmp_path: Path) -> None:
    near = load_ply(write(tmp_path / "near.ply", table_of(small())))
    far = load_ply(write(tmp_path / "far.ply", moved_columns(small(), FAR)))
    a = survey(near)
    b = survey(far)
    assert (b.radius, b.up.name, b.surrounding) == (a.radius, a.up.name, a.surrounding)
    assert np.allclose(np.subtract(b.center, FAR), a.center, rtol=0, atol=1e-9)
    assert np.allclose(np.subtract(b.box, 2 * FAR), a.box, rtol=0, atol=1e-9)
    box = next(line for line in b.lines() if line.startswith("all: "))
    assert box.startswith("all: --region box:99999")
    assert len(box.split(",")[0].partition(".")[2]) >= 3  # the box is distinct from its neighbor


@pytest.mark.parametrize("kind", ["spz", "splat", "ksplat", "sog"])
def test_other_formats_load_relative_to_their_origin(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("gaussforge")
    near = random_gaussians(60, seed=3)
    scene = replace(near, quats=near.unit_quats, log_scales=near.log_scales - 3, shN=near.shN[:, :0])
    far = replace(scene, means=scene.means + torch.tensor([1000.0, 1000.0, 0.0]))
    path = write_scene(tmp_path / f"far.{kind}", far)
    found = load_scene(path)
    assert found.origin[0] != 0
    assert found.origin[1] != 0
    center = found.world_means.median(dim=0).values  # a .sog reorders its rows
    assert float((center - far.means.double().median(dim=0).values).abs().max()) < 0.1


def test_half_turn_about_x_rotates_the_origin_too() -> None:
    scene = replace(small(), origin=FAR)
    expected = scene.world_means * torch.tensor([1.0, -1.0, -1.0]).double()
    assert torch.equal(rotate_about_x(scene).world_means, expected)
    assert str(rotate_about_x(small()).origin) == "(0.0, 0.0, 0.0)"


def test_edit_is_carried_between_two_origins_of_one_scene() -> None:
    scene = small()
    shifted = replace(scene, means=scene.means - 4.0, origin=(1004.0, 1004.0, 1004.0))
    match = match_scenes(replace(scene, origin=(1000.0, 1000.0, 1000.0)), shifted)
    assert match.rows.tolist() == list(range(COUNT))
    assert match.median < 1e-3
    assert match_scenes(scene, shifted).matched == 0.0
