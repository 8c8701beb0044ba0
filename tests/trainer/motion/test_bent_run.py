"""Full run towards a bending edit: the log reports the bend, and the result matches the edit."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.analytic_warps import column_warps
from tests.helpers.analytic_views import Truth, write_analytic_views, write_truth
from tests.helpers.demo_scenes import bear
from tests.helpers.trained import quick_options, train


@pytest.mark.slow
def test_bent_body_is_reproduced_by_control_points(tmp_path: Path) -> None:
    demo = bear(1500)
    edit = column_warps(demo.gaussians.means[demo.members("body")], demo.up)["stretch and bend"]
    truth = Truth(demo.gaussians, demo.labels.numpy(), (demo.label_names.index("body"),), edit)
    _, region = write_truth(tmp_path, truth)
    edited = tmp_path / "edited"
    options = quick_options(
        tmp_path,
        region=region,
        editor=f"folder:{edited}",
        kind="geometry",
        group_steps=40,
        field="lossless",
        steps=48,
        views=6,
        image_size=64,
    )
    write_analytic_views(edited, truth, options, (1.0,))
    run = train(options)
    assert "bent by" in run.folder.log.read_text(encoding="utf-8")
    assert run.report["edit"]["psnr_to_views"] > 22.0
