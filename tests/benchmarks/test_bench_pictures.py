"""`python -m benchmarks pictures`: a few of a rig's pictures are given, the others judge."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import pictures
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from tests.helpers.demo_scenes import bear


def test_a_fill_comes_nearer_from_two_sides_than_from_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demo = bear(1500)
    save_ply(tmp_path / "bear.ply", demo.gaussians)
    body = np.zeros(1500, np.int64)
    body[demo.members("body").numpy()] = 1
    np.save(tmp_path / "bear_labels.npy", body)
    for name, value in (("EDITS", ("recolor:#3060d0",)), ("RIG", 6), ("SIZE", 64), ("LARGE", 96)):
        monkeypatch.setattr(pictures, name, value)
    monkeypatch.setattr(pictures, "GIVEN", ((0,), (0, 3)))
    (table,) = pictures.tables([tmp_path / "bear.ply"])
    means = [float(row[4].split(" / ")[0]) for row in table.rows]
    assert [row[1] for row in table.rows] == ["0", "0, 3"]
    assert means[1] > means[0] - 1.0
    assert min(means) > 18.0


def test_pictures_without_a_scene_are_one_line() -> None:
    with pytest.raises(ProgdfError, match="need a scene; name one with --scenes"):
        pictures.tables()
