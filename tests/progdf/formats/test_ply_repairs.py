"""Tests of repairs of a damaged scene: only the broken rows change."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.formats.ply import load_ply, load_ply_with_report
from progdf.formats.repair import INVISIBLE_LOGIT, OPAQUE_LOGIT, LoadReport
from progdf.gaussians import ATTRIBUTES, Gaussians
from tests.helpers.ply_files import COUNT, assert_same, camera_element, scene_of, table_of, with_extra, write
from tests.helpers.refused import refusal


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
def test_unusable_row_becomes_invisible_and_keeps_its_index(
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


def test_zero_quaternion_becomes_the_identity(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {f"rot_{i}": (9, 0.0) for i in range(4)})
    assert scene.quats[9].tolist() == [1, 0, 0, 0]
    assert report.zero_quats == 1
    assert torch.equal(scene.quats[:9], scene_of().quats[:9])


def test_huge_and_tiny_quaternions_are_normalized_without_overflow(tmp_path: Path) -> None:
    changes = {"rot_0": (0, 3e30), "rot_1": (0, 4e30), "rot_2": (0, 0.0), "rot_3": (0, 0.0)}
    scene, _ = damaged(tmp_path, changes)
    torch.testing.assert_close(scene.quats[0], torch.tensor([0.6, 0.8, 0.0, 0.0]))


def test_broken_sh_coefficient_changes_only_itself(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {"f_rest_20": (4, np.nan)})  # green (20 // 15 = 1), coefficient 5
    expected = scene_of()
    assert float(scene.shN[4, 5, 1]) == 0
    expected.shN[4, 5, 1] = 0
    assert_same(scene, expected)
    assert (report.bad_sh, report.hidden) == (1, 0)


def test_exactly_flat_gaussian_stays_visible(tmp_path: Path) -> None:
    scene, report = damaged(tmp_path, {"scale_2": (4, -np.inf)})
    assert bool(scene.log_scales.isfinite().all())
    assert float(scene.scales[4, 2]) < 1e-8
    assert float(scene.logit_opacities[4]) == float(scene_of().logit_opacities[4])
    assert report.flat_scales == 1


def test_repairs_are_logged_by_load_ply(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    columns = table_of(scene_of())
    columns["x"][1:] = np.nan
    load_ply(write(tmp_path / "most_bad.ply", columns))
    assert "49 Gaussians made invisible" in caplog.text


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        ("scale_0", np.nan, "50 of 50 Gaussians have a NaN scale"),
        ("x", np.inf, "50 of 50 Gaussians have an infinite position"),
        ("scale_1", 90.0, "50 of 50 Gaussians have a far too large scale"),
        ("opacity", np.nan, "50 of 50 Gaussians have a NaN opacity"),
        ("rot_3", np.nan, "50 of 50 Gaussians have a NaN rotation"),
        ("f_dc_2", -np.inf, "50 of 50 Gaussians have an infinite color"),
    ],
)
def test_scene_without_a_usable_row_is_refused(
    column: str, value: float, reason: str, tmp_path: Path
) -> None:
    columns = table_of(scene_of())
    columns[column] = np.full(COUNT, value, np.float32)
    assert reason in refusal(load_ply, write(tmp_path / "a.ply", columns))


def test_unusable_rows_for_two_reasons_are_both_named(tmp_path: Path) -> None:
    columns = table_of(scene_of())
    columns["x"][:20] = np.nan
    columns["opacity"][20:] = np.nan
    message = refusal(load_ply, write(tmp_path / "a.ply", columns))
    assert "20 of 50 Gaussians have a NaN position, 30 of 50 Gaussians have a NaN opacity" in message


def test_report_names_ignored_content(tmp_path: Path) -> None:
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


def test_real_damaged_file_is_repaired_row_by_row(shared_data: Path) -> None:
    base = load_ply(shared_data / "weird" / "sh3_inria.ply")
    scene, report = load_ply_with_report(shared_data / "weird" / "nan_inf_zeroquat.ply")
    assert (report.hidden, report.bad_means, report.bad_scales) == (3, 1, 2)
    assert (report.opaque, report.transparent, report.zero_quats) == (1, 1, 1)
    whole = torch.ones(500, dtype=torch.bool)
    whole[[3, 5, 7, 8, 9, 10, 11]] = False
    assert_same(scene[whole], base[whole])
