"""The .ply files of the wild: every valid variant gives the same scene, every broken one its one line."""

from __future__ import annotations

import io
import resource
import struct
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement
from torch import Tensor

import progdf
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.load_report import LoadReport
from progdf.ply import load_ply, load_ply_with_report, save_ply
from progdf.repair import INVISIBLE_LOGIT, OPAQUE_LOGIT
from tests.scenes import random_gaussians

COUNT = 50


def scene_of(sh_degree: int = 3, count: int = COUNT, seed: int = 1) -> Gaussians:
    """A scene with quaternions of unit length, as a file gives it."""
    scene = random_gaussians(count, seed=seed)
    higher = torch.randn(count, (sh_degree + 1) ** 2 - 1, 3, generator=torch.Generator().manual_seed(seed))
    return replace(scene, quats=scene.unit_quats, shN=higher)


def assert_same(found: Gaussians, expected: Gaussians) -> None:
    for name in ATTRIBUTES:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def table_of(scene: Gaussians) -> dict[str, np.ndarray]:
    """The scene as the file's columns, in the order of the original 3DGS code."""
    rest = scene.shN.transpose(1, 2).flatten(1)
    columns: dict[str, Tensor] = dict(zip("xyz", scene.means.unbind(1), strict=True))
    columns |= {name: torch.zeros(len(scene)) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{i}": scene.sh0[:, i] for i in range(3)}
    columns |= {f"f_rest_{i}": rest[:, i] for i in range(rest.shape[1])}
    columns["opacity"] = scene.logit_opacities
    columns |= {f"scale_{i}": scene.log_scales[:, i] for i in range(3)}
    columns |= {f"rot_{i}": scene.quats[:, i] for i in range(4)}
    return {name: values.numpy() for name, values in columns.items()}


def write(
    path: Path,
    columns: dict[str, np.ndarray],
    text: bool = False,
    byte_order: str = "<",
    before: Sequence[PlyElement] = (),
    after: Sequence[PlyElement] = (),
) -> Path:
    """A .ply written by plyfile, the oracle of the format."""
    rows = np.empty(len(columns["x"]), [(name, values.dtype) for name, values in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    vertex = PlyElement.describe(rows, "vertex")
    PlyData([*before, vertex, *after], text=text, byte_order=byte_order).write(str(path))
    return path


def camera_element() -> PlyElement:
    return PlyElement.describe(np.array([(1.0, 2.0)], [("fx", "f4"), ("fy", "f4")]), "camera")


def face_element() -> PlyElement:
    faces = np.empty(2, [("vertex_indices", "i4", (3,)), ("flag", "u1")])
    faces["vertex_indices"], faces["flag"] = [[0, 1, 2], [2, 1, 0]], 7
    return PlyElement.describe(faces, "face")


def as_type(code: str, names: str = "") -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    return lambda columns: {k: v.astype(code) if k in (names or k) else v for k, v in columns.items()}


def with_extra(name: str, code: str, place: int) -> Callable[[dict[str, np.ndarray]], dict[str, np.ndarray]]:
    def add(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        items = list(columns.items())
        items.insert(place, (name, np.arange(len(columns["x"])).astype(code)))
        return dict(items)

    return add


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


def test_loading_is_idempotent_after_quaternions_were_normalised(tmp_path: Path) -> None:
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


# ------------------------------------------------------------------------------------------- repairs


def damaged(tmp_path: Path, changes: dict[str, tuple[int, float]]) -> tuple[Gaussians, LoadReport]:
    columns = {name: values.copy() for name, values in table_of(scene_of()).items()}
    for name, (row, value) in changes.items():
        columns[name][row] = value
    return load_ply_with_report(write(tmp_path / "damaged.ply", columns))


UNUSABLE = [
    *((column, value) for column in ("y", "scale_1") for value in (np.nan, np.inf, 1e30)),
    *((column, value) for column in ("y", "rot_2", "f_dc_0") for value in (np.nan, -np.inf)),
    ("opacity", np.nan),
]


@pytest.mark.parametrize(("column", "value"), UNUSABLE)
def test_an_unusable_row_becomes_invisible_and_keeps_its_place(
    column: str, value: float, tmp_path: Path
) -> None:
    scene, report = damaged(tmp_path, {column: (7, value)})
    expected = scene_of()
    others = torch.arange(COUNT) != 7
    assert_same(scene[others], expected[others])
    assert float(scene.opacities[7]) < 1e-10
    assert all(bool(getattr(scene, name).isfinite().all()) for name in ATTRIBUTES)
    assert report.hidden == 1
    assert len(report.repairs) == 1


def test_infinite_opacities_become_finite_and_look_the_same(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {"opacity": (3, np.inf)})
    assert float(scene.logit_opacities[3]) == OPAQUE_LOGIT
    assert float(scene.opacities[3]) > 1 - 1e-6
    assert (report.opaque, report.hidden) == (1, 0)
    scene, report = damaged(tmp_path, {"opacity": (3, -np.inf)})
    assert float(scene.logit_opacities[3]) == INVISIBLE_LOGIT
    assert (report.transparent, report.hidden) == (1, 0)


def test_a_zero_quaternion_is_no_rotation(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {f"rot_{i}": (9, 0.0) for i in range(4)})
    assert scene.quats[9].tolist() == [1, 0, 0, 0]
    assert report.zero_quats == 1
    assert torch.equal(scene.quats[:9], scene_of().quats[:9])


def test_huge_and_tiny_quaternions_are_normalised_without_overflow(tmp_path: Path) -> None:
    changes = {"rot_0": (0, 3e30), "rot_1": (0, 4e30), "rot_2": (0, 0.0), "rot_3": (0, 0.0)}
    scene, _ = damaged(tmp_path, changes)
    torch.testing.assert_close(scene.quats[0], torch.tensor([0.6, 0.8, 0.0, 0.0]))


def test_a_broken_sh_coefficient_costs_only_itself(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {"f_rest_20": (4, np.nan)})  # green (20 // 15 = 1), coefficient 5
    expected = scene_of()
    assert float(scene.shN[4, 5, 1]) == 0
    expected.shN[4, 5, 1] = 0
    assert_same(scene, expected)
    assert (report.bad_sh, report.hidden) == (1, 0)


def test_an_exactly_flat_gaussian_stays_visible(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {"scale_2": (4, -np.inf)})
    assert bool(scene.log_scales.isfinite().all())
    assert float(scene.scales[4, 2]) < 1e-8
    assert float(scene.logit_opacities[4]) == float(scene_of().logit_opacities[4])
    assert report.flat_scales == 1


def test_repairs_are_logged_by_load_ply(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    columns = table_of(scene_of())
    columns["x"] = np.full(COUNT, np.nan, np.float32)
    load_ply(write(tmp_path / "all_bad.ply", columns))
    assert "50 Gaussians made invisible" in caplog.text


def test_the_report_names_what_was_ignored(tmp_path: Path) -> None:
    columns = with_extra("label", "i4", 99)(table_of(scene_of(4)))
    path = write(tmp_path / "scene.ply", columns, after=[camera_element()])
    path.write_bytes(path.read_bytes() + b"tail")
    report = load_ply_with_report(path)[1]
    assert report.ignored_properties == ("label",)
    assert report.ignored_elements == (("camera", 1),)
    assert report.trailing_bytes == 4
    assert report.sh_degree == 4
    text = "\n".join(report.lines())
    for part in ("50 Gaussians", "SH degree 4", "label", "camera", "4 bytes", "repaired: nothing"):
        assert part in text


# -------------------------------------------------------------------------------------- broken files


def refusal(path: Path) -> str:
    with pytest.raises(ProgdfError) as caught:
        load_ply(path)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    assert ";" in message, "what would be right is missing"
    return message


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
def test_a_missing_property_is_named(lost: tuple[str, ...], said: str, tmp_path: Path) -> None:
    assert said in refusal(write(tmp_path / "scene.ply", lacking(*lost)))


def test_a_gap_in_the_sh_properties_is_named(tmp_path: Path) -> None:
    columns = {("f_rest_45" if k == "f_rest_44" else k): v for k, v in table_of(scene_of()).items()}
    assert "without f_rest_44" in refusal(write(tmp_path / "scene.ply", columns))


def test_an_element_after_the_gaussians_must_fit_behind_them(tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of()), after=[camera_element()])
    path.write_bytes(path.read_bytes().replace(b"camera 1", b"camera 2"))
    assert "promises 2 rows of 'camera'" in refusal(path)


def test_other_kinds_of_file_are_called_by_their_name(tmp_path: Path) -> None:
    columns = {name: values for name, values in table_of(scene_of()).items() if name in "xyz"}
    path = tmp_path / "scene.ply"
    assert "mesh" in refusal(write(path, columns, after=[face_element()]))
    assert "point cloud" in refusal(write(path, columns))
    packed = {"x": columns["x"], "packed_position": np.zeros(COUNT, np.uint32)}
    assert "compressed" in refusal(write(path, packed))
    for content, said in (
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345678\n", "git lfs pull"),
        (b"hello\n", "not a .ply"),
        (b"", "0 bytes"),
        (b"\x1f\x8b\x08\x00", "gzip"),
        (b"PK\x03\x04", "zip"),
        (b"<!DOCTYPE html>", "web page"),
        (b"ply\nformat ascii 1.0\n", "end_header"),
        (b"ply\nend_header\n", "format"),
        (b"ply\nformat ascii 1.0\nend_header\n", "vertex"),
        (b"ply\nformat ascii 2.0\nend_header\n", "header line"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "header line"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty int x\nend_header\n", "twice"),
    ):
        path.write_bytes(content)
        assert said in refusal(path)


def test_a_missing_file_and_a_folder_are_one_line(tmp_path: Path) -> None:
    assert "does not exist" in refusal(tmp_path / "nowhere.ply")
    assert "folder" in refusal(tmp_path)


def test_zero_gaussians_are_refused_on_both_ways(tmp_path: Path) -> None:
    save_ply(tmp_path / "scene.ply", scene_of())
    content = (tmp_path / "scene.ply").read_bytes().replace(b"vertex 50\n", b"vertex 0\n")
    (tmp_path / "scene.ply").write_bytes(content[: content.index(b"end_header\n") + 11])
    assert "0 Gaussians" in refusal(tmp_path / "scene.ply")
    with pytest.raises(ProgdfError, match="no Gaussians"):
        save_ply(tmp_path / "none.ply", scene_of()[:0])
    assert not (tmp_path / "none.ply").exists()


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("kept", [0.999, 0.5, 0.3])
def test_a_file_cut_short_is_refused(text: bool, kept: float, tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of()), text=text)
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content))])
    assert "cut short" in refusal(path)


@pytest.mark.parametrize("count", [b"51", b"2000000000", b"9999999999999999999", b"9" * 5000])
@pytest.mark.parametrize("text", [False, True])
def test_a_false_count_is_refused_and_allocates_nothing(count: bytes, text: bool, tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of()), text=text, before=[camera_element()])
    content = path.read_bytes()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    path.write_bytes(content.replace(b"vertex 50", b"vertex " + count))
    refusal(path)
    path.write_bytes(content.replace(b"camera 1", b"camera " + count))
    refusal(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize(("kind", "length"), [("uint", 4_000_000_000), ("int", -1)])
def test_a_list_of_impossible_length_is_refused(kind: str, length: int, tmp_path: Path) -> None:
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
    assert "ends within" in refusal(path)


def test_words_between_the_numbers_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "scene.ply", table_of(scene_of(0)), text=True)
    lines = path.read_bytes().split(b"\n")
    lines[-3] = lines[-3].replace(b" ", b" ?", 1)
    path.write_bytes(b"\n".join(lines))
    assert "no number" in refusal(path)


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
def test_a_damaged_file_loads_to_finite_numbers_or_is_refused(
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
        scene, message = None, str(refused)
    if scene is None:
        assert "\n" not in message
    else:
        assert all(bool(getattr(scene, name).isfinite().all()) for name in ATTRIBUTES)
        torch.testing.assert_close(scene.quats.norm(dim=1), torch.ones(len(scene)))
        assert bool(scene.scales.isfinite().all())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


# -------------------------------------------------------------------------------------------- saving


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


# ----------------------------------------------------------------------------------------- real files

SAME = (
    *("all_double", "ascii", "big_endian", "comments", "crlf_header", "double_xyz", "no_normals"),
    *("extra_element_after", "extra_element_before", "extra_filter3D", "extra_int_label"),
    *("extra_uchar_rgb_mid", "float32_typename", "reversed_order"),
)
BROKEN = (
    *("empty", "git_lfs_pointer", "huge_count", "mesh", "not_ply", "truncated"),
    *("missing_f_rest_44", "missing_opacity", "missing_rot", "missing_scale2_2dgs"),
)


@pytest.mark.parametrize("name", SAME)
def test_real_variants_give_the_same_scene(name: str, shared_data: Path) -> None:
    weird = shared_data / "weird"
    assert_same(load_ply(weird / f"{name}.ply"), load_ply(weird / "sh3_inria.ply"))


@pytest.mark.parametrize("name", BROKEN)
def test_real_broken_files_are_refused_in_one_line(name: str, shared_data: Path) -> None:
    refusal(shared_data / "weird" / f"{name}.ply")


@pytest.mark.parametrize("degree", [0, 1, 2, 4])
def test_real_files_of_every_sh_degree_share_their_bands(degree: int, shared_data: Path) -> None:
    base = load_ply(shared_data / "weird" / "sh3_inria.ply")
    scene = load_ply(shared_data / "weird" / f"sh{degree}.ply")
    assert scene.sh_degree == degree
    shared = min(base.shN.shape[1], scene.shN.shape[1])
    assert torch.equal(scene.shN[:, :shared], base.shN[:, :shared])


def test_the_real_damaged_file_is_repaired_row_by_row(shared_data: Path) -> None:
    base = load_ply(shared_data / "weird" / "sh3_inria.ply")
    scene, report = load_ply_with_report(shared_data / "weird" / "nan_inf_zeroquat.ply")
    assert (report.hidden, report.bad_means, report.bad_scales) == (3, 1, 2)
    assert (report.opaque, report.transparent, report.zero_quats) == (1, 1, 1)
    whole = torch.ones(500, dtype=torch.bool)
    whole[[3, 5, 7, 8, 9, 10, 11]] = False
    assert_same(scene[whole], base[whole])
