"""Tests of glTF scenes (.glb, .gltf): each returns the written scene, or one line with the reason."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from progdf.__main__ import main
from progdf.color.oklab import linear_from_srgb, srgb_from_linear
from progdf.errors import ProgdfError
from progdf.formats.axes import AXES, Axes, convert_axes
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene, load_scene_with_report, save_scene, scene_format
from progdf.gaussians import ATTRIBUTES, Gaussians, from_arrays
from progdf.quaternions import rotation_matrices
from progdf.sh import basis, half_turn, rotation_change, sh0_to_rgb, shade, spread_directions
from tests.helpers.gltf_files import (
    EXTENSION,
    SPLAT_TRANSFORM_ROWS,
    GltfBuilder,
    one_mesh,
    splat_transform_glb,
)
from tests.helpers.ply_files import scene_of
from tests.helpers.refused import refusal
from tests.helpers.scene_files import write_scene
from tests.helpers.scenes import random_gaussians

IDENTITY = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


def small(degree: int = 0, count: int = 12, seed: int = 1) -> Gaussians:
    return scene_of(degree, count, seed)


def loaded(path: Path) -> Gaussians:
    """Return the scene of a file in the file's own axes LUF."""
    return convert_axes(load_scene(path), "RDF", "LUF")


def assert_close(found: Gaussians, expected: Gaussians, tolerance: float = 1e-5) -> None:
    for name in ("means", "log_scales", "opacities", "sh0", "shN"):
        torch.testing.assert_close(
            getattr(found, name), getattr(expected, name), rtol=0.0, atol=tolerance, msg=name
        )
    torch.testing.assert_close(covariances(found), covariances(expected), rtol=0.0, atol=tolerance)


def covariances(scene: Gaussians) -> Tensor:
    axes = rotation_matrices(scene.unit_quats) * scene.scales[:, None]
    return axes @ axes.transpose(1, 2)


# ---- reading and axes


def foreign_scene() -> Gaussians:
    """Return the scene that splat-transform converted."""
    rows = np.array(SPLAT_TRANSFORM_ROWS, np.float32)
    rest = rows[:, 6:15].reshape(-1, 3, 3).transpose(0, 2, 1)
    columns = {"means": rows[:, :3], "sh0": rows[:, 3:6], "shN": rest, "logit_opacities": rows[:, 15]}
    return from_arrays(columns | {"log_scales": rows[:, 16:19], "quats": rows[:, 19:]})


@pytest.mark.parametrize("version", ["1.10.1", "2.3.1", "2.7.1"])
def test_splat_transform_files_match_the_scene_of_the_ply(version: str, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    path.write_bytes(splat_transform_glb(version))
    found, report = load_scene_with_report(path)
    assert_close(found, foreign_scene(), 1e-6)
    same = found.quats * foreign_scene().unit_quats
    assert float(same.sum(dim=1).abs().min()) > 1 - 1e-6  # edits change these values
    assert any("logarithms" in phrase for phrase in report.conversions) == (version != "2.7.1")
    assert report.repairs == ()


def test_written_glb_matches_splat_transform(tmp_path: Path) -> None:
    save_scene(tmp_path / "a.glb", foreign_scene())
    (tmp_path / "b.glb").write_bytes(splat_transform_glb("2.7.1"))
    ours = columns_of(tmp_path / "a.glb")
    theirs = columns_of(tmp_path / "b.glb")
    assert ours.keys() == theirs.keys()
    for name, column in ours.items():
        if name == f"{EXTENSION}:ROTATION":
            assert np.abs(np.abs((column * theirs[name]).sum(axis=1)) - 1).max() < 1e-6
        elif name != "COLOR_0":
            assert np.abs(column - theirs[name]).max() < 1e-6, name


def columns_of(path: Path) -> dict[str, np.ndarray]:
    """Return the attributes of the only primitive of a .glb with packed views."""
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    tables = json.loads(content[20 : 20 + size])
    data = content[28 + size :]
    columns = {}
    for name, index in tables["meshes"][0]["primitives"][0]["attributes"].items():
        entry = tables["accessors"][index]
        view = tables["bufferViews"][entry["bufferView"]]
        dtype = "<f4" if entry["componentType"] == 5126 else "u1"
        part = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        columns[name] = np.frombuffer(part, dtype).reshape(entry["count"], -1)
    return columns


def test_glb_has_linear_point_colors_for_other_viewers(tmp_path: Path) -> None:
    scene = small()
    save_scene(tmp_path / "a.glb", scene)
    expected = linear_from_srgb(sh0_to_rgb(scene.sh0).clamp(0, 1)) * 255
    assert np.abs(columns_of(tmp_path / "a.glb")["COLOR_0"][:, :3] - expected.numpy()).max() <= 0.501


@pytest.mark.parametrize("axes", ["LUF", "RUB"])
def test_glb_in_any_axes_loads_to_the_same_bits(axes: Axes, tmp_path: Path) -> None:
    scene = small(3)
    save_scene(tmp_path / "a.glb", scene, axes)
    found = load_scene(tmp_path / "a.glb")
    for name in ("means", "sh0", "shN"):
        assert torch.equal(getattr(found, name), getattr(scene, name)), name
    assert torch.allclose(found.quats, scene.quats, rtol=0, atol=1e-6)
    stored = torch.from_numpy(columns_of(tmp_path / "a.glb")["POSITION"].copy())
    signs = {"LUF": [-1.0, -1.0, 1.0], "RUB": [1.0, -1.0, -1.0]}[axes]
    assert torch.equal(stored, scene.means * torch.tensor(signs))


def test_progdf_glb_without_axes_uses_opengl_axes(tmp_path: Path) -> None:
    builder = one_mesh(convert_axes(small(), "RDF", "RUB"))
    builder.tables["asset"]["generator"] = "progdf"
    assert_close(load_scene(builder.write(tmp_path / "a.glb")), small())


def test_glb_keeps_positions_far_from_zero(tmp_path: Path) -> None:
    scene = replace(small(2), origin=(4e6, -3e6, 2e6))
    save_scene(tmp_path / "a.glb", scene)
    found = load_scene(tmp_path / "a.glb")
    assert float((found.world_means - scene.world_means).abs().max()) <= 1e-6
    for name in ("sh0", "shN"):
        assert torch.equal(getattr(found, name), getattr(scene, name)), name
    assert torch.allclose(found.log_scales, scene.log_scales, atol=1e-6)
    assert torch.allclose(found.opacities, scene.opacities, atol=1e-7)


def test_edit_writes_the_chosen_axes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_ply(Path("a.ply"), small())
    words = ["edit", "a.ply", "--move", "all:0,0,0", "--glb-axes", "RUB", "-o"]
    assert main([*words, "b.glb"]) == 0
    assert b'"axes": "RUB"' in Path("b.glb").read_bytes()
    assert main([*words, "b.ply"]) == 2
    assert "b.ply is not a .glb; leave out --glb-axes" in capsys.readouterr().err


@pytest.mark.parametrize("start", AXES)
@pytest.mark.parametrize("end", AXES)
def test_axes_conversion_round_trip_keeps_the_bits(start: Axes, end: Axes) -> None:
    scene = replace(small(3), origin=(1.0, 2.0, 3.0))
    turned = convert_axes(scene, start, end)
    back = convert_axes(turned, end, start)
    for name in ATTRIBUTES:
        assert torch.equal(getattr(back, name), getattr(scene, name)), name
    assert back.origin == scene.origin
    assert float(torch.det(torch.linalg.lstsq(scene.means, turned.means).solution)) > 0


@pytest.mark.parametrize("axis", range(3))
def test_half_turns_agree_with_rotations(axis: int) -> None:
    quat = torch.zeros(1, 4)
    quat[0, 1 + axis] = 1.0
    shN = small(3).shN
    signs = [1.0 if i == axis else -1.0 for i in range(3)]
    expected = shN + rotation_change(shN, quat)
    torch.testing.assert_close(half_turn(shN, (signs[0], signs[1], signs[2])), expected, rtol=0, atol=2e-6)


# ---- scales and colors


def test_scales_with_a_rounding_error_below_zero_stay_linear(tmp_path: Path) -> None:
    builder = GltfBuilder()
    attributes = builder.attributes(small())
    scales = small().scales.numpy().astype("<f4")
    scales[3, 1] = -1e-9
    attributes[f"{EXTENSION}:SCALE"] = builder.accessor(scales)
    builder.mesh(builder.primitive(attributes))
    found, report = load_scene_with_report(builder.write(tmp_path / "a.glb"))
    assert report.flat_scales == 1
    assert report.conversions == ()
    assert torch.allclose(found.log_scales[4:], small().log_scales[4:], atol=1e-6)


def test_linear_colors_without_bands_are_converted_exactly(tmp_path: Path) -> None:
    builder = one_mesh(small(), colorSpace="lin_rec709_display")
    found, report = load_scene_with_report(builder.write(tmp_path / "a.glb"))
    expected = srgb_from_linear(sh0_to_rgb(small().sh0).clamp_min(0))
    torch.testing.assert_close(sh0_to_rgb(found.sh0), expected, rtol=0, atol=1e-6)
    assert "converted: linear light (lin_rec709_display) to sRGB" in report.lines()


def test_linear_colors_with_bands_are_close_from_every_side(tmp_path: Path) -> None:
    rng = torch.Generator().manual_seed(1)
    base = torch.rand(40, 3, generator=rng) + 0.2
    scene = replace(small(2, 40), sh0=base, shN=0.1 * torch.randn(40, 8, 3, generator=rng))
    builder = one_mesh(scene, colorSpace="lin_rec709_display")
    found = loaded(builder.write(tmp_path / "a.glb"))
    views = spread_directions(30).float()
    error = []
    for direction in views:
        directions = direction.expand(40, 3)
        error.append(shade(2, directions, found.sh) - srgb_from_linear(shade(2, directions, scene.sh)))
    rms = float(torch.stack(error).square().mean().sqrt())
    assert rms < 0.01


# ---- sparse accessors


@pytest.mark.parametrize("based", [True, False])
def test_sparse_rows_are_applied(based: bool, tmp_path: Path) -> None:
    builder = GltfBuilder()
    scene = small()
    attributes = builder.attributes(scene)
    entry = builder.tables["accessors"][attributes[f"{EXTENSION}:SH_DEGREE_0_COEF_0"]]
    if not based:
        del entry["bufferView"]
    rows = builder.view(np.array([2, 7], "<u2").tobytes())
    values = builder.view(np.array([[1, 2, 3], [4, 5, 6]], "<f4").tobytes())
    indices = {"bufferView": rows, "componentType": 5123}
    entry["sparse"] = {"count": 2, "indices": indices, "values": {"bufferView": values}}
    builder.mesh(builder.primitive(attributes))
    expected = scene.sh0.clone() if based else torch.zeros_like(scene.sh0)
    expected[[2, 7]] = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    assert torch.equal(load_scene(builder.write(tmp_path / "a.glb")).sh0, expected)


@pytest.mark.parametrize(
    ("count", "row", "kind", "said"),
    [
        (1, 12, 5123, "names row 12 of 12"),
        (13, 0, 5123, "replaces 13 rows"),
        (12, 0, 5123, "of its data"),
        (1, 0, 5126, "row numbers of type 5126"),
    ],
)
def test_sparse_rows_out_of_range_are_refused(
    count: int, row: int, kind: int, said: str, tmp_path: Path
) -> None:
    builder = GltfBuilder()
    attributes = builder.attributes(small())
    view = builder.view(np.array([row, 0], "<u2").tobytes())
    indices = {"bufferView": view, "componentType": kind}
    values = {"bufferView": builder.view(b"\0" * 12)}
    entry = builder.tables["accessors"][attributes["POSITION"]]
    entry["sparse"] = {"count": count, "indices": indices, "values": values}
    builder.mesh(builder.primitive(attributes))
    assert said in refusal(load_scene, builder.write(tmp_path / "a.glb"))


def test_integers_are_normalized_or_taken_as_values(tmp_path: Path) -> None:
    builder = GltfBuilder()
    scene = replace(small(), quats=torch.tensor([[1.0, 0, 0, 0]]).expand(12, 4))
    attributes = builder.attributes(scene)
    opacities = np.full((12, 1), 51, "u1")
    rotations = np.tile(np.array([0, 0, 0, 127], "i1"), (12, 1))
    positions = np.arange(36).reshape(12, 3).astype("<i2")
    attributes[f"{EXTENSION}:OPACITY"] = builder.accessor(opacities, normalized=True)
    attributes[f"{EXTENSION}:ROTATION"] = builder.accessor(rotations, normalized=True)
    attributes["POSITION"] = builder.accessor(positions)
    builder.mesh(builder.primitive(attributes))
    builder.tables["extensionsRequired"] = ["KHR_mesh_quantization"]
    found = loaded(builder.write(tmp_path / "a.glb"))
    assert torch.allclose(found.opacities, torch.tensor(0.2))
    assert torch.equal(found.means, torch.arange(36.0).reshape(12, 3))


def test_indices_choose_the_rows(tmp_path: Path) -> None:
    builder = GltfBuilder()
    primitive = builder.primitive(builder.attributes(small()))
    primitive["indices"] = builder.accessor(np.array([[3], [1], [3]], "<u4"))
    builder.mesh(primitive)
    assert torch.equal(loaded(builder.write(tmp_path / "a.glb")).means, small().means[[3, 1, 3]])


# ---- meshes and nodes


def test_parts_of_a_lower_degree_are_padded_with_zeros(tmp_path: Path) -> None:
    builder = GltfBuilder()
    parts = [small(0), small(2, 5, seed=2), small(1, 3, seed=3)]
    builder.mesh(*(builder.primitive(builder.attributes(part)) for part in parts))
    found = loaded(builder.write(tmp_path / "a.glb"))
    assert found.sh_degree == 2
    assert torch.equal(found.means, torch.cat([part.means for part in parts]))
    assert not bool(found.shN[:12].any())
    assert torch.equal(found.shN[12:17], parts[1].shN)
    assert torch.equal(found.shN[17:, :3], parts[2].shN)
    assert not bool(found.shN[17:, 3:].any())


def two_meshes() -> GltfBuilder:
    builder = GltfBuilder()
    for seed in (1, 2):
        builder.mesh(builder.primitive(builder.attributes(small(seed=seed))))
    return builder


def test_meshes_outside_the_scene_are_left_out_and_listed(tmp_path: Path) -> None:
    builder = two_meshes()
    builder.nodes({"mesh": 0}, {"mesh": 1})
    found, report = load_scene_with_report(builder.write(tmp_path / "a.glb"))
    assert len(found) == 12
    assert "meshes[1] outside the scene" in report.lines()[1]


@pytest.mark.parametrize(
    ("nodes", "roots", "chosen"),
    [
        ([{"mesh": 0}, {"mesh": 1}], None, [1, 2]),  # no scene: all nodes
        ([{"mesh": 0}, {"mesh": 1}], (1,), [2]),
        ([{"mesh": 1}, {"mesh": 1}, {"children": [0, 1]}], (2,), [2, 2]),  # instances
        ([{"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": False}}}, {"mesh": 1}], (0, 1), [2]),
    ],
)
def test_only_meshes_of_the_scene_are_read(
    nodes: list[dict[str, Any]], roots: tuple[int, ...] | None, chosen: list[int], tmp_path: Path
) -> None:
    builder = two_meshes()
    builder.nodes(*nodes, roots=roots or ())
    if roots is None:
        del builder.tables["scene"], builder.tables["scenes"]
    found = loaded(builder.write(tmp_path / "a.glb"))
    assert torch.equal(found.means, torch.cat([small(seed=seed).means for seed in chosen]))


def test_chosen_scene_is_read(tmp_path: Path) -> None:
    builder = two_meshes()
    builder.nodes({"mesh": 0}, {"mesh": 1})
    builder.tables |= {"scene": 1, "scenes": [{"nodes": [0]}, {"nodes": [1]}]}
    assert torch.equal(loaded(builder.write(tmp_path / "a.glb")).means, small(seed=2).means)


def test_identity_matrix_changes_nothing(tmp_path: Path) -> None:
    save_scene(tmp_path / "a.glb", small(3))
    builder = one_mesh(convert_axes(small(3), "RDF", "LUF"), {"matrix": IDENTITY})
    found = load_scene(builder.write(tmp_path / "b.glb"))
    expected = load_scene(tmp_path / "a.glb")
    for name in ATTRIBUTES:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


TURN = [0.5, -0.1, 0.7, 0.5]  # xyzw, normalized below
TURN = [float(part) for part in np.array(TURN) / np.linalg.norm(TURN)]
QUARTER = [0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)]


def matrix_of(rotation: list[float], scale: float, shift: tuple[float, float, float]) -> np.ndarray:
    x, y, z, w = rotation
    matrix = np.eye(4)
    matrix[:3, :3] = scale * rotation_matrices(torch.tensor([[w, x, y, z]], dtype=torch.float64))[0].numpy()
    matrix[:3, 3] = shift
    return matrix


NESTED = [
    {"rotation": TURN, "scale": [2.0, 2.0, 2.0], "translation": [1.0, 2.0, 3.0], "children": [1]},
    {"matrix": matrix_of(QUARTER, 0.5, (0.0, -1.0, 0.0)).T.ravel().tolist(), "children": [2]},
    {"mesh": 0, "translation": [0.25, 0.0, 0.0]},
]
PLACES = {
    "rotation": ([{"mesh": 0, "rotation": TURN}], matrix_of(TURN, 1.0, (0, 0, 0))),
    "scale": ([{"mesh": 0, "scale": [3.0, 3.0, 3.0]}], matrix_of([0, 0, 0, 1], 3.0, (0, 0, 0))),
    "half a turn by scales": (
        [{"mesh": 0, "scale": [-1.0, 1.0, -1.0]}],
        matrix_of([0, 1, 0, 0], 1.0, (0, 0, 0)),
    ),
    "nested": (
        NESTED,
        matrix_of(TURN, 2.0, (1, 2, 3))
        @ matrix_of(QUARTER, 0.5, (0, -1, 0))
        @ matrix_of([0, 0, 0, 1], 1.0, (0.25, 0, 0)),
    ),
}


@pytest.mark.parametrize("name", PLACES)
def test_nodes_place_their_gaussians(name: str, tmp_path: Path) -> None:
    nodes, matrix = PLACES[name]
    scene = small(3)
    builder = one_mesh(scene)
    builder.nodes(*nodes)
    found = loaded(builder.write(tmp_path / "a.glb"))
    linear = torch.from_numpy(matrix[:3, :3]).float()
    means = scene.means @ linear.T + torch.from_numpy(matrix[:3, 3]).float()
    torch.testing.assert_close(found.means, means, rtol=0, atol=1e-5)
    torch.testing.assert_close(
        covariances(found), linear @ covariances(scene) @ linear.T, rtol=1e-4, atol=1e-5
    )
    directions = torch.nn.functional.normalize(torch.tensor([[0.3, -0.7, 0.6]]), dim=1).expand(12, 3)
    turned = torch.nn.functional.normalize(directions @ linear.T, dim=1)
    torch.testing.assert_close(shade(3, turned, found.sh), shade(3, directions, scene.sh), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("node", "does"),
    [
        ({"scale": [1.0, 2.0, 1.0]}, "scales unevenly"),
        ({"scale": [-1.0, 1.0, 1.0]}, "mirrors or shears"),
        ({"scale": [0.0, 0.0, 0.0]}, "scales unevenly"),
        ({"matrix": [1.0, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "scales unevenly"),
        ({"matrix": [1.0, 0, 0, 0, 0.6, 0.8, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}, "mirrors or shears"),
    ],
)
def test_deforming_node_is_named(node: dict[str, Any], does: str, tmp_path: Path) -> None:
    builder = one_mesh(small())
    builder.nodes({"children": [1]}, {"name": "table", "children": [2]} | node, {"mesh": 0})
    message = refusal(load_scene, builder.write(tmp_path / "a.glb"))
    assert f"nodes[1] 'table', which {does} Gaussians" in message


@pytest.mark.parametrize(
    ("nodes", "said"),
    [
        ([{"children": [1], "mesh": 0}, {"children": [0]}], "nodes[0] has two parents"),
        ([{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}], "nodes[2] has two parents"),
        ([{"children": [7]}], "refers to nodes[7], of 1"),
        ([{"mesh": 3}], "refers to meshes[3], of 1"),
        ([{"mesh": 0, "matrix": IDENTITY, "scale": [1, 1, 1]}], "has a matrix and a translation"),
        ([{"mesh": 0, "matrix": [1, 2]}], "nodes[0].matrix is [1, 2], which glTF does not allow"),
        ([{"mesh": 0, "rotation": [0, 0, 0, 0]}], "rotation of length 0"),
        ([{"mesh": 0, "skin": 0}], "the skin of nodes[0]"),
        ([{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}], "EXT_mesh_gpu_instancing in nodes[0]"),
    ],
)
def test_invalid_nodes_are_reported_in_one_line(
    nodes: list[dict[str, Any]], said: str, tmp_path: Path
) -> None:
    builder = one_mesh(small())
    builder.nodes(*nodes)
    assert said in refusal(load_scene, builder.write(tmp_path / "a.glb"))


# ---- unsupported features, refused by name


@pytest.mark.parametrize(
    ("look", "said"),
    [
        ({"colorSpace": "acescg"}, "colorSpace 'acescg' in meshes[0].primitives[0]"),
        ({"kernel": "box"}, "kernel 'box'"),
        ({"projection": "equirect"}, "projection 'equirect'"),
        ({"sortingMethod": "none"}, "sortingMethod 'none'"),
        ({"extensions": {"EXT_new_kernel": {}}}, "EXT_new_kernel in meshes[0].primitives[0]"),
        ({"kernel": 3}, "kernel '3'"),
    ],
)
def test_unknown_appearance_is_refused_by_name(look: dict[str, Any], said: str, tmp_path: Path) -> None:
    assert said in refusal(load_scene, one_mesh(small(), **look).write(tmp_path / "a.glb"))


@pytest.mark.parametrize(
    "name",
    ["EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression", "EXT_future"],
)
def test_unknown_required_extension_is_refused_by_name(name: str, tmp_path: Path) -> None:
    builder = one_mesh(small())
    builder.tables["extensionsRequired"] = [name]
    assert f"the required extension {name}" in refusal(load_scene, builder.write(tmp_path / "a.glb"))


def test_material_extensions_are_only_listed(tmp_path: Path) -> None:
    builder = one_mesh(small())
    builder.tables["extensionsRequired"] = ["KHR_materials_unlit"]
    builder.tables["extensionsUsed"] += ["KHR_materials_unlit", "MSFT_lod"]
    builder.tables["animations"] = [{}]
    report = load_scene_with_report(builder.write(tmp_path / "a.glb"))[1]
    assert "animations (the rest pose is read), KHR_materials_unlit, MSFT_lod" in report.lines()[1]


def test_compressed_view_without_a_fallback_is_refused_by_name(tmp_path: Path) -> None:
    builder = one_mesh(small())
    compression = {"EXT_meshopt_compression": {"buffer": 0, "byteLength": 9}}
    builder.tables["bufferViews"][0] |= {"buffer": 1, "extensions": compression}
    path = builder.write(tmp_path / "a.glb")
    content = path.read_bytes()
    size = struct.unpack_from("<I", content, 12)[0]
    tables = json.loads(content[20 : 20 + size])
    tables["buffers"].append({"byteLength": 4096})
    text = json.dumps(tables).encode() + b" " * 3
    text = text[: len(text) // 4 * 4]
    rest = content[20 + size :]
    head = b"glTF" + struct.pack("<IIII", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    path.write_bytes(head + text + rest)
    message = refusal(load_scene, path)
    assert "compression (EXT_meshopt_compression)" in message
    assert "gltf-transform copy" in message


def test_attributes_without_the_extension_are_gaussians(tmp_path: Path) -> None:
    builder = one_mesh(small())  # as gltf-transform leaves it
    del builder.tables["meshes"][0]["primitives"][0]["extensions"]
    found, report = load_scene_with_report(builder.write(tmp_path / "a.glb"))
    assert len(found) == 12
    assert report.conversions == (f"colors taken as sRGB, as {EXTENSION} is absent",)


def test_morph_targets_are_refused_by_name(tmp_path: Path) -> None:
    builder = one_mesh(small())
    builder.tables["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": 0}]
    assert "morph targets" in refusal(load_scene, builder.write(tmp_path / "a.glb"))


def test_file_of_triangles_holds_no_gaussians(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.mesh({"attributes": {"POSITION": builder.accessor(np.zeros((3, 3), "<f4"))}})
    builder.nodes({"mesh": 0})
    assert "holds no Gaussians" in refusal(load_scene, builder.write(tmp_path / "a.gltf", builder.data_uri()))


# ---- compressed as .spz


def spz_file(content: bytes, name: str, count: int | None) -> GltfBuilder:
    builder = GltfBuilder()
    attributes = {}
    if count is not None:
        builder.tables["accessors"].append({"componentType": 5126, "count": count, "type": "VEC3"})
        attributes["POSITION"] = 0
    compression = {name: {"bufferView": builder.view(content)}}
    builder.mesh(builder.primitive(attributes, extensions=compression))
    builder.nodes({"mesh": 0})
    builder.tables["extensionsRequired"] = [EXTENSION, name]
    return builder


@pytest.mark.parametrize("name", [f"{EXTENSION}_compression_spz", f"{EXTENSION}_compression_spz_2"])
@pytest.mark.parametrize("count", [60, None])
def test_embedded_spz_matches_the_scene_of_the_spz(name: str, count: int | None, tmp_path: Path) -> None:
    path = write_scene(tmp_path / "a.spz", random_gaussians(60, seed=2, sh_degree=1), 3)
    builder = spz_file(path.read_bytes(), name, count)
    found, report = load_scene_with_report(builder.write(tmp_path / "a.glb"))
    assert_close(found, load_scene(path), 1e-6)
    assert "compressed as .spz" in report.format


@pytest.mark.parametrize("content", [b"\0" * 32, b"NGSP" + b"\xff" * 40, b"?"])
def test_broken_embedded_spz_is_reported_in_one_line(content: bytes, tmp_path: Path) -> None:
    pytest.importorskip("gaussforge")
    builder = spz_file(content, f"{EXTENSION}_compression_spz_2", 3)
    assert "a.glb: its .spz part" in refusal(load_scene, builder.write(tmp_path / "a.glb"))


def test_embedded_spz_of_another_count_is_refused(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "a.spz", random_gaussians(60, seed=2), 3)
    builder = spz_file(path.read_bytes(), f"{EXTENSION}_compression_spz", 61)
    assert "has 61 Gaussians and its .spz 60" in refusal(load_scene, builder.write(tmp_path / "a.glb"))


# ---- buffers


@pytest.mark.parametrize("ending", ["glb", "gltf"])
@pytest.mark.parametrize(
    ("uri", "place"), [("a.bin", "a.bin"), ("my%20files/b%C3%BC.bin", "my files/bü.bin"), (None, None)]
)
def test_external_buffers_are_read(ending: str, uri: str | None, place: str | None, tmp_path: Path) -> None:
    builder = one_mesh(small(1))
    path = builder.write(tmp_path / f"a.{ending}", uri or builder.data_uri())
    size = path.stat().st_size
    if place is not None:
        (tmp_path / place).parent.mkdir(exist_ok=True)
        (tmp_path / place).write_bytes(builder.data)
        size += len(builder.data)
    assert scene_format(path) == ending
    found, report = load_scene_with_report(path)
    assert_close(convert_axes(found, "RDF", "LUF"), small(1))
    assert report.file_bytes == size


def test_info_and_render_accept_a_gltf(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    builder = one_mesh(small())
    path = builder.write(tmp_path / "a.gltf", "a.bin")
    (tmp_path / "a.bin").write_bytes(builder.data)
    assert main(["info", str(path)]) == 0
    assert "a.gltf: 12 Gaussians, SH degree 0, .gltf, turned from axes LUF" in capsys.readouterr().out
    assert main(["render", str(path), "--size", "16x16", "-o", str(tmp_path / "a.png")]) == 0


def test_gltf_is_not_bundled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    builder = one_mesh(small())
    path = builder.write(tmp_path / "a.gltf", builder.data_uri())
    assert main(["export", str(path), "-o", str(tmp_path / "a.progdf.zip")]) == 2
    assert "keeps numbers in other files; export the scene as a .glb" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("uri", "said"),
    [
        ("../a.bin", "outside its folder"),
        ("b/%2e%2e/%2E%2E/a.bin", "outside its folder"),
        ("b\\..\\..\\a.bin", "outside its folder"),
        ("/etc/hostname", "outside its folder"),
        ("%2Fetc/hostname", "outside its folder"),
        ("\\\\host\\a.bin", "outside its folder"),
        ("C:/a.bin", "the address C:/a.bin"),
        ("https://a.b/c.bin", "the address https://a.b/c.bin"),
        ("file:///etc/hostname", "the address file:///etc/hostname"),
        ("%00", "outside its folder"),
        ("%FF", "outside its folder"),
        ("", "outside its folder"),
        ("data:;base64,!!!", "is not base64"),
        ("data:nothing", "is not base64"),
        ("data:;base64,AAAA", "has 3 of"),
        ("none.bin", "none.bin does not exist"),
        (".", "outside its folder"),
        ("folder", "is a folder"),
        ("9" * 5000, "does not exist"),
        ("link", "does not exist"),
    ],
)
def test_buffers_in_other_places_are_refused(uri: str, said: str, tmp_path: Path) -> None:
    path = one_mesh(small()).write(tmp_path / "a.gltf", uri)
    (tmp_path.parent / "a.bin").write_bytes(b"\0" * 4096)
    (tmp_path / "folder").mkdir()
    (tmp_path / "link").symlink_to("nowhere")
    with pytest.raises(ProgdfError) as caught:
        load_scene(path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_short_buffer_error_names_the_buffer_file(tmp_path: Path) -> None:
    builder = one_mesh(small())
    path = builder.write(tmp_path / "a.gltf", "a.bin")
    (tmp_path / "a.bin").write_bytes(builder.data[:-1])
    message = refusal(lambda _: load_scene(path), tmp_path / "a.bin")
    assert message.startswith(f"{tmp_path / 'a.bin'} is damaged: it has {len(builder.data) - 1} of")


# ---- damage


Change = Callable[[GltfBuilder], object]


def set_accessor(**values: Any) -> Change:
    return lambda builder: builder.tables["accessors"][0].update(values)


def drop(name: str, key: str) -> Change:
    return lambda builder: builder.tables[name][0].pop(key)


def set_view(**values: Any) -> Change:
    return lambda builder: builder.tables["bufferViews"][0].update(values)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (set_accessor(count=-3), "accessors[0].count is -3, which glTF does not allow"),
        (set_accessor(count="a"), "accessors[0].count is 'a', which glTF does not allow"),
        (set_accessor(count=0), "accessors[0] has no rows"),
        (set_accessor(count=11), "has 11 of POSITION and 12 of"),
        (set_accessor(type="VEC2"), "accessors[0] is VEC2 of 5126, not VEC3"),
        (set_accessor(componentType=5124), "accessors[0] is VEC3 of 5124, not VEC3"),
        (set_accessor(bufferView=77), "refers to bufferViews[77], of 5"),
        (set_accessor(byteOffset=4), "accessors[0] ends at byte"),
        (drop("accessors", "count"), "accessors[0].count is missing"),
        (drop("bufferViews", "byteLength"), "bufferViews[0].byteLength is missing"),
        (drop("accessors", "bufferView"), "without stored positions"),
        (set_view(byteOffset=10**17), "bufferViews[0] ends at byte"),
        (set_view(byteStride=2), "rows of 12 bytes every 2 bytes"),
        (set_view(byteStride=10**17), "accessors[0] ends at byte"),
        (set_view(buffer=3), "refers to buffers[3], of 1"),
        (lambda b: b.tables.pop("asset"), "names no version"),
        (lambda b: b.tables["asset"].update(version="1.0"), "glTF 1.0 (asset.version)"),
        (lambda b: b.tables["asset"].update(minVersion="2.1"), "glTF 2.1 (asset.minVersion)"),
        (lambda b: b.tables["asset"].update(version=2), "asset.version is 2, which glTF does not allow"),
        (lambda b: b.tables.update(meshes=3), "meshes is 3, which glTF does not allow"),
        (
            lambda b: b.tables["meshes"][0]["primitives"][0]["attributes"].pop(f"{EXTENSION}:OPACITY"),
            f"meshes[0].primitives[0] lacks {EXTENSION}:OPACITY",
        ),
        (
            lambda b: b.tables["meshes"][0]["primitives"][0]["extensions"].update({EXTENSION: 3}),
            "is not an object",
        ),
    ],
)
def test_damaged_file_is_reported_in_gltf_terms(change: Change, said: str, tmp_path: Path) -> None:
    builder = one_mesh(small())
    change(builder)
    message = refusal(load_scene, builder.write(tmp_path / "a.glb"))
    assert said in message
    assert "required field" not in message
    assert "expected" not in message


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"glTF", "fewer than a header"),
        (b"glTF" + struct.pack("<IIII", 1, 20, 0, 0), "version 1 of .glb"),
        (b"glTF" + struct.pack("<IIII", 2, 99, 0, 0), "it has 20 of 99 bytes"),
        (b"glTF" + struct.pack("<IIII", 2, 20, 9, 0x4E4F534A), "not the whole JSON"),
        (b"glTF" + struct.pack("<IIII", 2, 22, 2, 0x4E4F534A) + b"{}", "names no version"),
        (b"gltf\2\0\0\0", "does not begin with glTF"),
    ],
)
def test_broken_container_is_reported_in_one_line(content: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.glb").write_bytes(content)
    assert said in refusal(load_scene, tmp_path / "a.glb")


# ---- bounds


def repeated_mesh() -> GltfBuilder:
    builder = GltfBuilder()
    attributes = builder.attributes(small(count=2000))
    builder.mesh(*(builder.primitive(attributes) for _ in range(2000)))
    return builder


def repeated_nodes() -> GltfBuilder:
    builder = one_mesh(small(count=2000))
    builder.nodes(*({"mesh": 0} for _ in range(2000)), roots=tuple(range(2000)))
    return builder


def empty_columns() -> GltfBuilder:
    builder = one_mesh(small())
    for entry in builder.tables["accessors"]:
        entry["count"] = 10**12
        entry["sparse"] = {
            "count": 1,
            "indices": {"bufferView": 0, "componentType": 5125},
            "values": {"bufferView": 0},
        }
        del entry["bufferView"]
    return builder


def empty_indices() -> GltfBuilder:
    builder = one_mesh(small())
    builder.tables["accessors"].append({"componentType": 5125, "count": 10**12, "type": "SCALAR"})
    builder.tables["meshes"][0]["primitives"][0]["indices"] = len(builder.tables["accessors"]) - 1
    return builder


@pytest.mark.parametrize("make", [repeated_mesh, repeated_nodes, empty_columns, empty_indices])
def test_row_count_is_bounded_by_the_file_before_allocation(
    make: Callable[[], GltfBuilder], tmp_path: Path
) -> None:
    path = make().write(tmp_path / "a.glb")
    tracemalloc.start()
    message = refusal(load_scene, path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "repeats its rows beyond 16 times its size" in message
    assert peak < 16 << 20


def test_few_instances_are_accepted(tmp_path: Path) -> None:
    builder = one_mesh(small(count=200))
    builder.nodes(*({"mesh": 0} for _ in range(100)), roots=tuple(range(100)))
    assert len(load_scene(builder.write(tmp_path / "a.glb"))) == 20_000


def test_buffer_is_bounded_by_its_file(tmp_path: Path) -> None:
    path = one_mesh(small()).write(tmp_path / "a.gltf", "a.bin")
    tables = json.loads(path.read_text())
    tables["buffers"][0]["byteLength"] = 1 << 40
    path.write_text(json.dumps(tables))
    (tmp_path / "a.bin").write_bytes(b"\0" * 9)
    tracemalloc.start()
    message = refusal(lambda _: load_scene(path), tmp_path / "a.bin")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "it has 9 of 1099511627776 bytes" in message
    assert peak < 16 << 20


def test_json_size_is_bounded(tmp_path: Path) -> None:
    (tmp_path / "a.gltf").write_text("[" + "[]," * 2_100_000 + "0]")
    assert "values in its JSON" in refusal(load_scene, tmp_path / "a.gltf")


def test_spread_directions_fit_every_band() -> None:
    values = basis(3, spread_directions(96))
    assert float(torch.linalg.cond(values)) < 1.2
    assert torch.allclose(spread_directions(96).norm(dim=1), torch.ones(96, dtype=torch.float64))
