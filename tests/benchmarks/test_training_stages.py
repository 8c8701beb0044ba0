"""Tests of `python -m benchmarks training-stages`: sums by stage, Amdahl's law, and one small training."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch

from benchmarks.__main__ import main
from benchmarks.colors.stages import StageOptions, list_edits, nearest_members, predicted_wall, sum_stages
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from tests.helpers.demo_scenes import bear
from tests.helpers.small_benchmarks import shrink_benchmarks


def _stretch(stage: str, begun: float, ended: float, user: float, peak: float) -> dict[str, float | str]:
    return {"stage": stage, "begun": begun, "ended": ended, "user": user, "system": 0.0, "peak_mb": peak}


def test_stretches_of_one_stage_add_up() -> None:
    lines = [
        _stretch("model", 0.0, 1.0, 1.0, 10.0),
        _stretch("fit", 1.0, 2.0, 2.0, 30.0),
        _stretch("model", 2.0, 3.0, 2.0, 20.0),
    ]
    found = sum_stages(lines, [(0.5, 1), (1.5, 2), (2.5, 3)])
    assert list(found) == ["model", "fit"]
    assert found["model"].processor == 3.0
    assert found["model"].wall == 2.0
    assert found["model"].peak_mb == 20.0
    assert found["model"].parallel == 0.75  # 3 of 4 units of work
    assert found["fit"].parallel == 1.0


def test_small_stages_are_added_up_as_other() -> None:
    lines = [_stretch("fit", 0.0, 9.0, 9.9, 1.0), _stretch("agree", 9.0, 9.1, 0.05, 2.0)]
    found = sum_stages(lines, [])
    assert list(found) == ["fit", "other"]
    assert found["other"].peak_mb == 2.0


def test_predicted_wall_follows_amdahls_law() -> None:
    assert predicted_wall(0.0, 16) == 1.0
    assert predicted_wall(1.0, 16) == 1 / 16
    assert predicted_wall(0.5, 2) == 0.75


def test_nearest_members_are_the_closest_to_their_median() -> None:
    scene = bear(600).gaussians
    members = torch.arange(0, len(scene), 2)
    near = nearest_members(scene, members, 50)
    center = scene.means[members].double().median(dim=0).values
    distances = (scene.means[members].double() - center).norm(dim=1)
    assert set(near.tolist()) <= set(members.tolist())
    assert (scene.means[near].double() - center).norm(dim=1).max() <= distances.sort().values[49]
    assert nearest_members(scene, members, 10_000).tolist() == members.tolist()


def test_wrong_number_of_regions_is_refused() -> None:
    options = StageOptions((Path("a.ply"), Path("b.ply"), Path("c.ply")), Path("o"), region=("all", "all"))
    with pytest.raises(ProgdfError, match="--region has 2 values for 3 scenes"):
        list_edits(options)


def test_scenes_with_the_same_name_are_refused() -> None:
    options = StageOptions((Path("a.ply"), Path("b/a.ply")), Path("o"))
    with pytest.raises(ProgdfError, match="same name"):
        list_edits(options)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--members", "-5"), "--members must be 0 (all) or more, got -5"),
        (("--threads", "0"), "--threads must be between 1 and 1024, got 0"),
        (("--threads", "1", "-2"), "--threads must be between 1 and 1024, got -2"),
        (("--threads",), "--threads has no value"),
    ],
)
def test_number_out_of_range_is_refused_before_a_folder_is_made(
    words: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    out = tmp_path / "measured"
    with pytest.raises(ProgdfError, match=re.escape(said)):
        main(["training-stages", "--scene", "a.ply", "--out", str(out), *words])
    assert not out.exists()


def test_folder_without_the_project_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="no checkout"):
        main(["training-stages", "--scene", "a.ply", "--out", "o", "--code", str(tmp_path)])


@pytest.mark.slow
def test_small_training_is_measured_by_stage_and_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    shrink_benchmarks(monkeypatch)
    scene = tmp_path / "bear.ply"
    save_ply(scene, bear(700).gaussians)
    words = ["training-stages", "--scene", str(scene), "--members", "200", "--threads", "2"]
    page = tmp_path / "page.md"
    page.write_text("<!-- bench training-stages -->\n<!-- end training-stages -->\n")
    main([*words, "--out", str(tmp_path / "old")])
    main([*words, "--out", str(tmp_path / "old"), "--before", str(tmp_path / "old"), "--markdown", str(page)])
    printed = capsys.readouterr().out
    assert "| bear | 200 / 7" in printed
    assert "→" in page.read_text()
    folder = tmp_path / "old" / "bear-200-2t"
    named = {json.loads(line)["stage"] for line in (folder / "events.jsonl").read_text().splitlines()}
    assert {"imports", "scene", "draft", "views", "edit", "weights", "model", "fit", "report"} <= named


def test_failed_training_ends_with_its_message(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shrink_benchmarks(monkeypatch)
    scene = tmp_path / "bear.ply"
    save_ply(scene, bear(400).gaussians)
    words = ["--scene", str(scene), "--editor", "recolor:nothing", "--out", str(tmp_path / "new")]
    with pytest.raises(ProgdfError, match=r"bear cannot be trained: .*nothing"):
        main(["training-stages", *words])
