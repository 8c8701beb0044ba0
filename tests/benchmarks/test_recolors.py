"""Tests of `python -m benchmarks recolors`, which judges recolors of materials of all brightnesses."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks.colors import recolors
from progdf.color import edits as color
from progdf.io.images import read_picture


@pytest.mark.parametrize("name", recolors.MATERIALS)
def test_material_takes_each_color_and_keeps_its_shading(name: str) -> None:
    picture, inside, diffuse = recolors.ball(recolors.MATERIALS[name])
    rgb = picture[inside]
    for text in recolors.TARGETS.values():
        target = color.parse_color(text)
        after = recolors.edits_of(rgb, target)
        for edit in ("recolor", "grade"):
            goals = recolors.expected_ab(rgb, target, edit)
            verdict = recolors.judge(rgb, after[edit], goals, diffuse[inside])
            assert verdict.is_good, f"{edit} to {text}: {verdict}"


def test_wrong_hue_pale_colors_and_lost_shading_are_judged() -> None:
    picture, inside, diffuse = recolors.ball(recolors.MATERIALS["paper"])
    rgb = picture[inside]
    target = color.parse_color("#1c3fa8")
    goals = recolors.expected_ab(rgb, target, "recolor")
    after = recolors.edits_of(rgb, target)["recolor"]
    assert recolors.judge(rgb, after.flip(-1), goals, diffuse[inside]).off_hue > 0.9
    assert recolors.judge(rgb, 0.5 * (after + rgb), goals, diffuse[inside]).color_error > recolors.JND
    assert recolors.judge(rgb, after.roll(7, dims=0), goals, diffuse[inside]).correlation < 0.95


def test_table_has_a_row_per_source_and_edit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(recolors, "MATERIALS", {"paper": recolors.MATERIALS["paper"]})
    (table,) = recolors.tables(plot=tmp_path / "recolors.png")
    assert [row[:2] for row in table.rows] == [("paper", edit) for edit in recolors.EDITS]
    assert torch.isfinite(read_picture(tmp_path / "recolors.jpg")).all()
