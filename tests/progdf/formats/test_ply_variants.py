"""Tests of .ply fields of other trainers: converted, refused by name, or listed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.__main__ import main
from progdf.formats.ply import load_ply, load_ply_with_report, save_ply
from progdf.formats.scene_file import load_scene_with_report
from progdf.gaussians import Gaussians
from progdf.sh import rgb_to_sh0, sh0_to_rgb
from tests.helpers.ply_files import assert_same, camera_element, scene_of, table_of, write
from tests.helpers.refused import refusal
from tests.helpers.scene_files import write_compressed_ply

COUNT = 12
F_DC = ("f_dc_0", "f_dc_1", "f_dc_2")


def columns_without(scene: Gaussians, *names: str) -> dict[str, np.ndarray]:
    return {name: values for name, values in table_of(scene).items() if name not in names}


def rgb_columns(
    dtype: str, largest: float, names: tuple[str, ...] = ("red", "green", "blue")
) -> dict[str, np.ndarray]:
    values = np.linspace(0.0, largest, 3 * COUNT).reshape(COUNT, 3).astype(dtype)
    return {name: values[:, i] for i, name in enumerate(names)}


@pytest.mark.parametrize(
    ("dtype", "largest"), [("u1", 255), ("u2", 65535), ("f4", 1.0), ("f8", 1.0), ("f4", 1.2)]
)
@pytest.mark.parametrize("text", [False, True])
def test_rgb_without_f_dc_is_read(dtype: str, largest: float, text: bool, tmp_path: Path) -> None:
    colors = rgb_columns(dtype, largest)
    columns = columns_without(scene_of(0, COUNT), *F_DC) | colors
    scene, report = load_ply_with_report(write(tmp_path / "a.ply", columns, text=text))
    full = largest if dtype[0] == "u" else 1.0
    expected = np.stack(list(colors.values()), axis=1).astype(np.float64) / full
    torch.testing.assert_close(
        sh0_to_rgb(scene.sh0).double(), torch.from_numpy(expected), atol=1e-6, rtol=1e-6
    )
    assert report.sh_degree == 0
    assert report.conversions == ("red, green, blue to SH degree 0",)
    assert "red" not in report.ignored_properties


@pytest.mark.parametrize("prefix", ["diffuse_", ""])
def test_other_color_names_are_read(prefix: str, tmp_path: Path) -> None:
    names = ("diffuse_red", "diffuse_green", "diffuse_blue") if prefix else ("r", "g", "b")
    columns = columns_without(scene_of(0, COUNT), *F_DC) | rgb_columns("u1", 255, names)
    assert float(sh0_to_rgb(load_ply(write(tmp_path / "a.ply", columns)).sh0).max()) == pytest.approx(1.0)


def test_f_dc_overrides_red_green_blue(tmp_path: Path) -> None:
    scene = scene_of(1, COUNT)
    found, report = load_ply_with_report(write(tmp_path / "a.ply", table_of(scene) | rgb_columns("u1", 255)))
    assert_same(found, scene)
    assert report.ignored_properties == ("red", "green", "blue")


def test_colors_of_an_unknown_range_are_refused(tmp_path: Path) -> None:
    plain = columns_without(scene_of(0, COUNT), *F_DC)
    path = write(tmp_path / "a.ply", plain | rgb_columns("f4", 255.0))
    assert "'red' as floats from 0 to 255" in refusal(load_ply, path)
    path = write(tmp_path / "a.ply", plain | rgb_columns("i4", 255))
    assert "lacks f_dc_0" in refusal(load_ply, path)
    bands = columns_without(scene_of(1, COUNT), *F_DC) | rgb_columns("u1", 255)
    assert "f_rest properties without f_dc_0" in refusal(load_ply, write(tmp_path / "a.ply", bands))
    with_nan = rgb_columns("f4", 1.0)
    with_nan["red"][3] = np.nan
    _, report = load_ply_with_report(write(tmp_path / "a.ply", plain | with_nan))
    assert report.bad_colors == 1


def test_colored_point_cloud_stays_a_point_cloud(tmp_path: Path) -> None:
    cloud = {name: values for name, values in table_of(scene_of(0, COUNT)).items() if name in "xyz"}
    path = write(tmp_path / "a.ply", cloud | rgb_columns("u1", 255))
    assert "is a point cloud, not a Gaussian scene" in refusal(load_ply, path)


VARIANTS = {
    "trbf_center": "motion over time",
    "motion_0": "motion over time",
    "omega_3": "motion over time",
    "t": "time (4D Gaussians)",
    "scale_t": "time (4D Gaussians)",
    "velocity_0": "time (4D Gaussians)",
    "rot_r_0": "rotations in four dimensions",
    "rot_4": "rotations in four dimensions",
    "scale_3": "anchors",
    "f_offset_0": "anchors",
    "beta": "kernel shapes",
    "sb_params_0": "kernel shapes",
    "shape": "kernel shapes",
    "f_dc_3": "more than three color channels",
    "f_asg_0": "reflectance",
    "roughness": "reflectance",
    "base_color_0": "reflectance",
    "appearance_0": "colors that depend on an appearance network",
}


@pytest.mark.parametrize("name", VARIANTS)
def test_fields_of_variants_are_refused_by_name(name: str, tmp_path: Path) -> None:
    columns = table_of(scene_of(1, COUNT)) | {name: np.zeros(COUNT, np.float32)}
    path = write(tmp_path / "a.ply", columns)
    message = refusal(load_ply, path)
    assert f"'{name}'" in message
    assert VARIANTS[name] in message
    assert "damaged" not in message
    assert main(["info", str(path)]) == 2


def test_anchors_without_colors_are_named(tmp_path: Path) -> None:
    columns = columns_without(scene_of(0, COUNT), *F_DC) | {"f_anchor_feat_0": np.zeros(COUNT, np.float32)}
    assert "anchors of Scaffold-GS" in refusal(load_ply, write(tmp_path / "a.ply", columns))


@pytest.mark.parametrize("name", ["f_semantic_0", "label", "obj_dc_0", "confidence", "alpha", "rotation_x"])
def test_harmless_fields_are_listed(name: str, tmp_path: Path) -> None:
    scene = scene_of(1, COUNT)
    columns = table_of(scene) | {name: np.ones(COUNT, np.float32)}
    found, report = load_ply_with_report(write(tmp_path / "a.ply", columns))
    assert_same(found, scene)
    assert report.ignored_properties == (name,)


@pytest.mark.parametrize("text", [False, True])
def test_filter_3d_is_fused(text: bool, tmp_path: Path) -> None:
    scene = scene_of(1, COUNT)
    sizes = np.linspace(0.0, 0.3, COUNT).astype(np.float32)
    path = write(tmp_path / "a.ply", table_of(scene) | {"filter_3D": sizes}, text=text)
    found, report = load_ply_with_report(path)
    squares = scene.log_scales.double().exp() ** 2
    fused = squares + torch.from_numpy(sizes).double()[:, None] ** 2
    opacities = scene.opacities.double() * (squares.prod(dim=1) / fused.prod(dim=1)).sqrt()
    torch.testing.assert_close(found.scales.double(), fused.sqrt(), rtol=1e-5, atol=0.0)
    torch.testing.assert_close(found.opacities.double(), opacities, rtol=1e-4, atol=1e-9)
    assert_same(found[:1], scene[:1])
    assert report.conversions == ("Mip-Splatting's filter_3D, fused into scales and opacities",)
    assert report.ignored_properties == ()
    save_ply(tmp_path / "b.ply", found)
    assert_same(load_ply(tmp_path / "b.ply"), found)


def test_filter_3d_of_extreme_gaussians_stays_finite(tmp_path: Path) -> None:
    columns = table_of(scene_of(0, COUNT))
    columns = {name: values.copy() for name, values in columns.items()} | {
        "filter_3D": np.full(COUNT, 0.1, np.float32)
    }
    columns["opacity"][0] = np.inf
    columns["opacity"][1] = 80.0
    columns["scale_0"][2] = -np.inf
    columns["filter_3D"][3] = np.nan
    columns["filter_3D"][4] = np.inf
    columns["scale_0"][5] = -np.inf
    columns["filter_3D"][5] = 0.0
    scene, report = load_ply_with_report(write(tmp_path / "a.ply", columns))
    for name in ("log_scales", "logit_opacities"):
        assert bool(getattr(scene, name).isfinite().all()), name
    assert report.hidden == 2, "the rows with an unusable filter"


def test_unknown_elements_are_listed(tmp_path: Path) -> None:
    path = write(tmp_path / "a.ply", table_of(scene_of(0, COUNT)), after=[camera_element()])
    assert load_ply_with_report(path)[1].ignored_elements == (("camera", 1),)


def test_compressed_files_keep_their_own_columns(tmp_path: Path) -> None:
    path = write_compressed_ply(tmp_path / "a.ply", scene_of(1, COUNT))
    assert load_scene_with_report(path)[1].conversions == ()


def test_rgb_equals_the_same_colors_as_f_dc(tmp_path: Path) -> None:
    scene = scene_of(0, COUNT)
    colors = rgb_columns("u1", 255)
    as_bytes = load_ply(write(tmp_path / "a.ply", columns_without(scene, *F_DC) | colors))
    rgb = torch.from_numpy(np.stack(list(colors.values()), axis=1)).float() / 255
    table = table_of(scene) | {name: rgb_to_sh0(rgb)[:, i].numpy() for i, name in enumerate(F_DC)}
    assert_same(as_bytes, load_ply(write(tmp_path / "b.ply", table)))
