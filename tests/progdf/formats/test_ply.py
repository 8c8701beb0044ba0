"""The .ply files of the wild: every valid variant gives the same scene, and what is saved comes back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData

import progdf
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, load_ply_with_report, save_ply
from tests.helpers.ply_files import (
    as_type,
    assert_same,
    camera_element,
    face_element,
    scene_of,
    table_of,
    with_extra,
    write,
)
from tests.helpers.scenes import random_gaussians

VARIANTS: dict[str, tuple[Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]], dict[str, object]]] = {
    "plain": (dict, {}),
    "ascii": (dict, {"text": True}),
    "big endian": (dict, {"byte_order": ">"}),
    "all double": (as_type("f8"), {}),
    "double positions": (as_type("f8", "xyz"), {}),
    "no normals": (lambda c: {k: v for k, v in c.items() if k not in ("nx", "ny", "nz")}, {}),
    "reversed columns": (lambda c: dict(reversed(c.items())), {}),
    "int at the end": (with_extra("segment", "i4", 99), {}),
    "uchar in the middle": (with_extra("red", "u1", 4), {}),
    "float in the middle of f_rest": (with_extra("filter_3D", "f4", 20), {}),
    "element before": (dict, {"before": [camera_element()]}),
    "element after": (dict, {"after": [camera_element()]}),
    "lists before": (dict, {"before": [face_element()]}),
    "lists before, big endian": (dict, {"before": [face_element()], "byte_order": ">"}),
    "lists before, ascii": (dict, {"before": [face_element()], "text": True}),
    "lists after": (dict, {"after": [face_element()]}),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_valid_variant_gives_the_same_scene(variant: str, tmp_path: Path) -> None:
    scene = scene_of()
    change, how = VARIANTS[variant]
    path = write(tmp_path / "scene.ply", change(table_of(scene)), **how)  # type: ignore[arg-type]
    loaded, report = load_ply_with_report(path)
    assert_same(loaded, scene)
    assert report.repairs == ()


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_a_saved_scene_loads_to_the_same_bits(degree: int, tmp_path: Path) -> None:
    scene = scene_of(degree)
    save_ply(tmp_path / "scene.ply", scene)
    assert_same(load_ply(tmp_path / "scene.ply"), scene)


def test_loading_is_idempotent_after_quaternions_were_normalized(tmp_path: Path) -> None:
    scene = random_gaussians(5000, seed=3, sh_degree=1)
    save_ply(tmp_path / "raw.ply", scene)
    once, report = load_ply_with_report(tmp_path / "raw.ply")
    assert report.scaled_quats == 5000
    torch.testing.assert_close(once.quats, scene.unit_quats)
    save_ply(tmp_path / "once.ply", once)
    twice, report = load_ply_with_report(tmp_path / "once.ply")
    assert_same(twice, once)
    assert report.scaled_quats == 0


def test_a_saved_file_is_what_the_original_code_writes(tmp_path: Path) -> None:
    scene = scene_of()
    save_ply(tmp_path / "scene.ply", scene)
    vertex = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
    expected = table_of(scene)
    assert list(vertex.dtype.names) == list(expected)
    for name, values in expected.items():
        assert np.array_equal(vertex[name], values), name


def test_many_blocks_and_threads_keep_every_row_in_its_place(tmp_path: Path) -> None:
    scene = scene_of(1, count=20_011, seed=5)
    save_ply(tmp_path / "scene.ply", scene)
    assert_same(load_ply(tmp_path / "scene.ply"), scene)
    mixed = with_extra("label", "u1", 3)(table_of(scene))
    assert_same(load_ply(write(tmp_path / "mixed.ply", mixed)), scene)


def test_crlf_headers_and_comments_are_read(tmp_path: Path) -> None:
    scene = scene_of(0)
    save_ply(tmp_path / "scene.ply", scene)
    head, body = (tmp_path / "scene.ply").read_bytes().split(b"end_header\n", 1)
    head = head.replace(b"\nelement", b"\ncomment caf\xc3\xa9\nobj_info 1\nelement") + b"end_header\n"
    (tmp_path / "crlf.ply").write_bytes(head.replace(b"\n", b"\r\n") + body)
    assert_same(load_ply(tmp_path / "crlf.ply"), scene)


def test_a_failed_save_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    save_ply(path, scene_of())
    old = path.read_bytes()
    broken = scene_of()
    broken.means[3, 1] = torch.nan
    with pytest.raises(ProgdfError, match="means holds NaN"):
        save_ply(path, broken)
    assert path.read_bytes() == old
    with pytest.raises(ProgdfError, match="does not exist"):
        save_ply(tmp_path / "nowhere" / "scene.ply", scene_of())
    assert [entry.name for entry in tmp_path.iterdir()] == ["scene.ply"]


def test_the_public_names_are_the_same_functions() -> None:
    assert progdf.load_ply is load_ply
    assert progdf.save_ply is save_ply


SAME = (
    *("all_double", "ascii", "big_endian", "comments", "crlf_header", "double_xyz", "no_normals"),
    *("extra_element_after", "extra_element_before", "extra_filter3D", "extra_int_label"),
    *("extra_uchar_rgb_mid", "float32_typename", "reversed_order"),
)


@pytest.mark.parametrize("name", SAME)
def test_real_variants_give_the_same_scene(name: str, shared_data: Path) -> None:
    weird = shared_data / "weird"
    assert_same(load_ply(weird / f"{name}.ply"), load_ply(weird / "sh3_inria.ply"))


@pytest.mark.parametrize("degree", [0, 1, 2, 4])
def test_real_files_of_every_sh_degree_share_their_bands(degree: int, shared_data: Path) -> None:
    base = load_ply(shared_data / "weird" / "sh3_inria.ply")
    scene = load_ply(shared_data / "weird" / f"sh{degree}.ply")
    assert scene.sh_degree == degree
    shared = min(base.shN.shape[1], scene.shN.shape[1])
    assert torch.equal(scene.shN[:, :shared], base.shN[:, :shared])
