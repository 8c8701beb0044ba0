"""Tests of .ply files in use: valid variants give the same scene, others are refused in one line."""

from __future__ import annotations

import io
import resource
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

import progdf
from progdf.errors import ProgdfError
from progdf.formats.ply import load_ply, load_ply_with_report, save_ply
from progdf.formats.ply_file import read_header, row_blocks
from progdf.gaussians import ATTRIBUTES
from tests.helpers.ply_files import (
    COUNT,
    as_type,
    assert_same,
    camera_element,
    face_element,
    scene_of,
    table_of,
    with_extra,
    write,
)
from tests.helpers.refused import refusal
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
    "float in the middle of f_rest": (with_extra("confidence", "f4", 20), {}),
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
def test_saved_scene_loads_to_the_same_bits(degree: int, tmp_path: Path) -> None:
    scene = scene_of(degree)
    save_ply(tmp_path / "scene.ply", scene)
    assert_same(load_ply(tmp_path / "scene.ply"), scene)


def test_loading_is_idempotent_after_quaternion_normalization(tmp_path: Path) -> None:
    scene = random_gaussians(5000, seed=3, sh_degree=1)
    save_ply(tmp_path / "raw.ply", scene)
    once, report = load_ply_with_report(tmp_path / "raw.ply")
    assert report.scaled_quats == 5000
    torch.testing.assert_close(once.quats, scene.unit_quats)
    save_ply(tmp_path / "once.ply", once)
    twice, report = load_ply_with_report(tmp_path / "once.ply")
    assert_same(twice, once)
    assert report.scaled_quats == 0


def test_saved_file_matches_the_original_code(tmp_path: Path) -> None:
    scene = scene_of()
    save_ply(tmp_path / "scene.ply", scene)
    vertex = PlyData.read(str(tmp_path / "scene.ply"))["vertex"].data
    expected = table_of(scene)
    assert list(vertex.dtype.names) == list(expected)
    for name, values in expected.items():
        assert np.array_equal(vertex[name], values), name


def test_many_blocks_and_threads_keep_the_row_order(tmp_path: Path) -> None:
    scene = scene_of(1, count=20_011, seed=5)
    save_ply(tmp_path / "scene.ply", scene)
    assert_same(load_ply(tmp_path / "scene.ply"), scene)
    mixed = with_extra("label", "u1", 3)(table_of(scene))
    assert_same(load_ply(write(tmp_path / "mixed.ply", mixed)), scene)


def test_blocks_are_read_from_the_file_of_mapped_rows(tmp_path: Path) -> None:
    (mapped,), _ = read_header(write(tmp_path / "scene.ply", table_of(scene_of()))).rows("vertex")
    assert isinstance(mapped, np.memmap)
    assert mapped.filename  # without a name, pages of the mapping are kept
    read = [(first, block.copy()) for first, block in row_blocks(mapped, 7)]
    plain = list(row_blocks(np.array(mapped), 7))
    assert [first for first, _ in read] == [first for first, _ in plain]
    assert all(np.array_equal(a, b) for (_, a), (_, b) in zip(read, plain, strict=True))


def test_crlf_headers_and_comments_are_read(tmp_path: Path) -> None:
    scene = scene_of(0)
    save_ply(tmp_path / "scene.ply", scene)
    head, body = (tmp_path / "scene.ply").read_bytes().split(b"end_header\n", 1)
    head = head.replace(b"\nelement", b"\ncomment caf\xc3\xa9\nobj_info 1\nelement") + b"end_header\n"
    (tmp_path / "crlf.ply").write_bytes(head.replace(b"\n", b"\r\n") + body)
    assert_same(load_ply(tmp_path / "crlf.ply"), scene)


def test_failed_save_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
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


def test_public_names_are_the_same_functions() -> None:
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


def lacking(*names: str) -> dict[str, np.ndarray]:
    return {name: values for name, values in table_of(scene_of()).items() if name not in names}


@pytest.mark.parametrize(
    ("lost", "said"),
    [
        (("opacity",), "opacity"),
        (("scale_2",), "2D Gaussians"),
        (("rot_0", "rot_1", "rot_2", "rot_3"), "rot_0, rot_1, rot_2, rot_3"),
        (("f_rest_44",), "44 f_rest"),
        (("f_rest_7",), "without f_rest_7"),
        (("f_dc_1",), "f_dc_1"),
        (("z",), "z"),
    ],
)
def test_missing_property_is_named(lost: tuple[str, ...], said: str, tmp_path: Path) -> None:
    assert said in refusal(load_ply, write(tmp_path / "scene.ply", lacking(*lost)))


def test_gap_in_the_sh_properties_is_named(tmp_path: Path) -> None:
    columns = {("f_rest_45" if k == "f_rest_44" else k): v for k, v in table_of(scene_of()).items()}
    assert "without f_rest_44" in refusal(load_ply, write(tmp_path / "scene.ply", columns))


def test_element_after_the_gaussians_must_fit_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of()), after=[camera_element()])
    path.write_bytes(path.read_bytes().replace(b"camera 1", b"camera 2"))
    assert "declares 2 rows of 'camera'" in refusal(load_ply, path)


def test_other_file_kinds_are_named(tmp_path: Path) -> None:
    columns = {name: values for name, values in table_of(scene_of()).items() if name in "xyz"}
    path = tmp_path / "scene.ply"
    assert "mesh" in refusal(load_ply, write(path, columns, after=[face_element()]))
    assert "point cloud" in refusal(load_ply, write(path, columns))
    packed = {"x": columns["x"], "packed_position": np.zeros(COUNT, np.uint32)}
    assert "compressed" in refusal(load_ply, write(path, packed))
    for content, said in (
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345678\n", "git lfs pull"),
        (b"hello\n", "text file"),
        (b"\1\2\3\4\n", "not a .ply"),
        (b"", "0 bytes"),
        (b"\x1f\x8b\x08\x00", "gzip"),
        (b"PK\x03\x04", "zip"),
        (b"<!DOCTYPE html>", "web page"),
        (b"ply\nformat ascii 1.0\n", "end_header"),
        (b"ply\nend_header\n", "format"),
        (b"ply\nformat ascii 1.0\nend_header\n", "vertex"),
        (b"ply\nformat ascii 2.0\nend_header\n", "line 2: expected version"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "'element vertex -1' should be"),
        (b"ply\nformat ascii 1.0\nelement vertex %d\nend_header\n" % 10**30, "should be a name and a count"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty int x\nend_header\n",
            "same name",
        ),
    ):
        path.write_bytes(content)
        assert said in refusal(load_ply, path)


def test_missing_file_and_folder_are_reported_in_one_line(tmp_path: Path) -> None:
    assert "does not exist" in refusal(load_ply, tmp_path / "nowhere.ply")
    assert "folder" in refusal(load_ply, tmp_path)


def test_zero_gaussians_are_refused_on_load_and_save(tmp_path: Path) -> None:
    save_ply(tmp_path / "scene.ply", scene_of())
    content = (tmp_path / "scene.ply").read_bytes().replace(b"vertex 50\n", b"vertex 0\n")
    (tmp_path / "scene.ply").write_bytes(content[: content.index(b"end_header\n") + 11])
    assert "0 Gaussians" in refusal(load_ply, tmp_path / "scene.ply")
    with pytest.raises(ProgdfError, match="no Gaussians"):
        save_ply(tmp_path / "none.ply", scene_of()[:0])
    assert not (tmp_path / "none.ply").exists()


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("kept", [0.999, 0.5, 0.3])
def test_truncated_file_is_refused(text: bool, kept: float, tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of()), text=text)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    assert "truncated" in refusal(load_ply, path)


@pytest.mark.parametrize("count", [b"51", b"2000000000", b"9999999999999999999", b"9" * 5000])
@pytest.mark.parametrize("text", [False, True])
def test_false_count_is_refused_without_allocation(count: bytes, text: bool, tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of()), text=text, before=[camera_element()])
    content = path.read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    path.write_bytes(content.replace(b"vertex 50", b"vertex " + count))
    refusal(load_ply, path)
    path.write_bytes(content.replace(b"camera 1", b"camera " + count))
    refusal(load_ply, path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize(("kind", "length"), [("uint", 4_000_000_000), ("int", -1)])
def test_list_of_impossible_length_is_refused(kind: str, length: int, tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    save_ply(path, scene_of())
    head, body = path.read_bytes().split(b"element vertex", 1)
    face = b"element face 1\nproperty list %s double corners\n" % kind.encode()
    columns, rows = body.split(b"end_header\n", 1)
    content = (
        head
        + face
        + b"element vertex"
        + columns
        + b"end_header\n"
        + struct.pack("<i" if length < 0 else "<I", length)
        + rows
    )
    path.write_bytes(content)
    assert "ends within" in refusal(load_ply, path)


def test_words_between_numbers_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of(0)), text=True)
    lines = path.read_bytes().split(b"\n")
    lines[-3] = lines[-3].replace(b" ", b" ?", 1)
    path.write_bytes(b"\n".join(lines))
    assert "no number, at row" in refusal(load_ply, path)


def test_overlong_number_costs_no_memory(tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of(0)), text=True)
    lines = path.read_bytes().split(b"\n")
    lines[-3] = lines[-3].replace(b" ", b" " + b"1" * 400_000, 1)
    path.write_bytes(b"\n".join(lines))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "at row 48" in refusal(load_ply, path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_millions_of_lists_before_the_vertices_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    save_ply(path, scene_of())
    head, body = path.read_bytes().split(b"element vertex", 1)
    columns, rows = body.split(b"end_header\n", 1)
    face = b"element face 2000000\nproperty list uchar uchar corners\nelement vertex"
    path.write_bytes(head + face + columns + b"end_header\n" + b"\0" * 2_000_000 + rows)
    assert "vertices first" in refusal(load_ply, path)


def test_huge_count_of_empty_rows_costs_nothing(tmp_path: Path) -> None:
    path = tmp_path / "scene.ply"
    save_ply(path, scene_of())
    content = path.read_bytes().replace(b"element vertex", b"element a 1000000000000\nelement vertex")
    path.write_bytes(content)
    assert len(load_ply(path)) == COUNT
    path.write_bytes(content.replace(b"binary_little_endian", b"ascii"))
    assert "truncated" in refusal(load_ply, path)


def test_header_is_parsed_in_linear_time(tmp_path: Path) -> None:
    """Write a megabyte of elements or properties, whose pairwise comparison would take minutes."""
    path = tmp_path / "scene.ply"
    for what in (b"element a%d 0\n", b"property float a%d\n"):
        lines = b"".join(what % i for i in range(20_000))
        path.write_bytes(b"ply\nformat ascii 1.0\nelement b 0\n" + lines + b"end_header\n")
        assert "no element 'vertex'" in refusal(load_ply, path)


def base_bytes() -> bytes:
    buffer = io.BytesIO()
    columns = with_extra("label", "u1", 5)(table_of(scene_of(1, count=8)))
    rows = np.empty(8, [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    PlyData([camera_element(), face_element(), PlyElement.describe(rows, "vertex")], byte_order="<").write(
        buffer
    )
    return buffer.getvalue()


BASE = base_bytes()


@settings(max_examples=400, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    flips=st.lists(st.tuples(st.integers(0, len(BASE) - 1), st.integers(0, 255)), max_size=6),
    kept=st.one_of(st.just(len(BASE)), st.integers(0, len(BASE))),
)
@example(flips=[(BASE.index(b"face 2") + 5, ord("9"))], kept=len(BASE))
def test_damaged_file_is_read_as_finite_values_or_refused(
    flips: list[tuple[int, int]], kept: int, tmp_path: Path
) -> None:
    content = bytearray(BASE)
    for place, value in flips:
        content[place] = value
    path = tmp_path / "fuzz.ply"
    path.write_bytes(bytes(content[:kept]))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        scene = load_ply(path)
    except ProgdfError as refused:
        scene = None
        message = str(refused)
    if scene is None:
        assert "\n" not in message
    else:
        assert all(bool(getattr(scene, name).isfinite().all()) for name in ATTRIBUTES)
        torch.testing.assert_close(scene.quats.norm(dim=1), torch.ones(len(scene)))
        assert bool(scene.scales.isfinite().all())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


BROKEN = (
    *("empty", "git_lfs_pointer", "huge_count", "mesh", "not_ply", "truncated"),
    *("missing_f_rest_44", "missing_opacity", "missing_rot", "missing_scale2_2dgs"),
)


@pytest.mark.parametrize("name", BROKEN)
def test_real_broken_files_are_refused_in_one_line(name: str, shared_data: Path) -> None:
    refusal(load_ply, shared_data / "weird" / f"{name}.ply")
