"""Tests of `python -m benchmarks pictures`, which evaluates edits of some pictures of a rig on the others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import pictures
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.region import Region
from tests.helpers.demo_scenes import bear
from trainer.views.view import View, make_view


def test_fill_from_two_sides_is_closer_than_from_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    demo = bear(1500)
    save_ply(tmp_path / "bear.ply", demo.gaussians)
    body = np.zeros(1500, np.int64)
    body[demo.members("body").numpy()] = 1
    np.save(tmp_path / "bear_labels.npy", body)
    for name, value in (("EDITS", (("recolor:#3060d0", "all"),)), ("RIG", 6), ("SIZE", 64), ("LARGE", 96)):
        monkeypatch.setattr(pictures, name, value)
    monkeypatch.setattr(pictures, "GIVEN", ((0,), (0, 3)))
    (table,) = pictures.tables([tmp_path / "bear.ply"])
    assert [row[1] for row in table.rows] == ["0", "0, 3"]
    assert table.rows[0][5] != "-" == table.rows[1][5]  # hidden behind one view, not behind two
    means = [float(row[3].split(" / ")[0]) for row in table.rows]
    assert means[1] > means[0] - 1.0
    assert min(means) > 18.0


def test_pictures_benchmark_without_a_scene_is_refused() -> None:
    with pytest.raises(ProgdfError, match="need a scene; name one with --scenes"):
        pictures.tables()


def test_painting_one_half_leaves_the_other_unchanged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_ply(tmp_path / "bear.ply", bear(1500).gaussians)
    edits = tuple(("recolor:#3060d0", part) for part in ("all", "upper half"))
    for name, value in (("EDITS", edits), ("RIG", 3), ("SIZE", 64), ("LARGE", 64), ("GIVEN", ((0,),))):
        monkeypatch.setattr(pictures, name, value)
    counted = list[float]()

    def count(scene: object, region: Region, *rest: object) -> View:
        counted.append(len(region) / 1500)
        return make_view(scene, region, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(pictures, "make_view", count)
    (table,) = pictures.tables([tmp_path / "bear.ply"])
    assert [row[0] for row in table.rows] == ["bear, recolor:#3060d0", "bear, recolor:#3060d0, upper half"]
    assert max(counted) == 1.0
    assert 0.1 < min(counted) < 0.9
