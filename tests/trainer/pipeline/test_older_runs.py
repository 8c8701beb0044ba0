"""Runs of earlier versions: their plans had other names for their parts, and are read all the same."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from progdf.errors import ProgdfError
from progdf.io.json_values import convert_json
from tests.helpers.trained import quick_options
from trainer.options import TrainOptions
from trainer.run.record import upgrade_plan
from trainer.run.resume import find_run

ALL = ("solves", "asks_evenly", "damps", "ramps", "slows", "sizes", "averages", "leads_back", "prunes")


def earlier_plan(printed: bool = False) -> dict[str, Any]:
    """As version 1 wrote it."""
    network: Mapping[str, object] = {"size": "tiny", "inputs": "own", "bins": "smooth", "code": 8}
    if printed:
        network = {"size": "paper", "inputs": "position", "bins": "hard", "code": 0}
    return {
        "scene": "scene.ply",
        "name": "blue",
        "region": {
            "region": "all",
            "lift_rule": "share",
            "lift_threshold": None,
            "segmenter": {"detector": "d", "sam_model": "s", "box_threshold": 0.4},
        },
        "editor": {
            "editor": "instruct:make it blue",
            "model": "",
            "guidance": 7.5,
            "image_guidance": 1.25,
            "edit_steps": None,
            "edit_size": None,
            "graded": True,
            "seed": 3,
        },
        "views": {
            "cameras": None,
            "up": "auto",
            "views": None,
            "image_size": 64,
            "dense": True,
            "pictures": ["A.png"],
            "scene": "scene.ply",
        },
        "optimization": {
            "kind": None,
            "steps": 48,
            "stages": None,
            "group_steps": None,
            "sh": "on",
            "perceptual_weight": None,
            "progressive": "off",
            "progressive_norm": "squares",
            "reedit_every": 9,
            "rates": "kind",
            "perceptual_every": 2,
            "sharpness": "kind",
            "raw": printed,
            "whole": printed,
            "joint": printed,
            "seed": 3,
            "refinements": {**dict.fromkeys(ALL, not printed), "propagates": not printed},
            "few": False,
        },
        "slider": "even",
        "field": {
            "field": "auto",
            "target_psnr": 41.0,
            "bytes_budget": None,
            "network": {**network, "loss": "parameters", "draft": True, "seed": 3, "sharpness": True},
        },
        "texts": {"before": "a bear", "after": "a blue bear", "asked": True},
    }


@pytest.mark.parametrize("printed", [False, True])
def test_a_plan_of_an_earlier_version_is_read_with_all_its_values(printed: bool) -> None:
    plan = convert_json(upgrade_plan(earlier_plan(printed)), TrainOptions)
    assert (plan.name, plan.region.region, plan.region.box_threshold) == ("blue", "all", 0.4)
    assert plan.editor.guidance == "7.5,1.25"
    assert (plan.views.views, plan.views.image_size, plan.views.pictures) == (0, 64, (Path("A.png"),))
    assert (plan.optimize.kind, plan.optimize.steps, plan.optimize.slider) == ("auto", 48, "even")
    assert (plan.field.target_psnr, plan.field.draft, plan.field.seed) == (41.0, True, 3)
    assert (plan.texts.text_before, plan.texts.text_after, plan.texts.asked) == (
        "a bear",
        "a blue bear",
        True,
    )
    assert plan.optimize.as_printed == plan.field.as_printed == printed
    assert plan.optimize.ema == (not printed)


def test_a_plan_of_this_version_stays_as_it_is() -> None:
    plan = {"optimize": {}}
    assert upgrade_plan(plan) is plan


@pytest.mark.parametrize("plan", [earlier_plan(False), {"editor": {"reedit_every": 200}}])
def test_a_run_that_an_earlier_version_began_is_refused_in_one_line(
    tmp_path: Path, plan: dict[str, object]
) -> None:
    options = quick_options(tmp_path)
    (options.out / "state").mkdir(parents=True)
    (options.out / "state" / "run.json").write_text(json.dumps({"plan": plan}))
    with pytest.raises(ProgdfError, match="was begun by an earlier version, which") as told:
        find_run(options)
    assert "\n" not in str(told.value)
