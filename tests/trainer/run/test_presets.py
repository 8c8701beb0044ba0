"""Presets and resolved options: the command line overrides the preset, which overrides the defaults."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest
import torch

import trainer.run.run
from progdf.errors import ProgdfError
from progdf.io.json_values import convert_json, to_json
from trainer.cli import train_options
from trainer.methods import METHODS
from trainer.options import (
    PRESETS,
    EditKind,
    OptimizeOptions,
    Preset,
    TrainOptions,
    apply_preset,
    with_values,
)
from trainer.resolve import recorded_options, resolve, resolve_kind
from trainer.run.resume import plan_difference

ASKED = ("scene.ply", "--out", "run", "--region", "all", "--editor", "night")


def asked(*more: str) -> TrainOptions:
    return train_options([*ASKED, *more])


def planned(kind: EditKind, *more: str, group_steps: int = 0) -> OptimizeOptions:
    return resolve_kind(resolve(asked(*more)), kind, group_steps)


def test_every_preset_has_a_method_and_the_default_changes_nothing() -> None:
    assert set(PRESETS) == set(METHODS) == set(get_args(Preset))
    assert asked("--preset", "default") == asked()


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_preset_sets_exactly_its_values(preset: Preset) -> None:
    to_json = asked()
    found = asked("--preset", preset)
    for part, values in PRESETS[preset].items():
        before = vars(getattr(to_json, part))
        after = vars(getattr(found, part))
        assert after == {**before, **values}
    parts = {part: getattr(to_json, part) for part in PRESETS[preset]}
    assert replace(found, preset="default", **parts) == to_json
    assert found == apply_preset(asked(), preset), "Python has the same"


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_preset_values_can_be_given_on_the_command_line(preset: Preset) -> None:
    fixed = {"color_solver"}
    values = {name: value for part in PRESETS[preset].values() for name, value in part.items()}
    words = [w for n, v in values.items() if n not in fixed for w in (f"--{n.replace('_', '-')}", str(v))]
    assert with_values(asked(*words), **{n: values[n] for n in fixed}, preset=preset) == asked(
        "--preset", preset
    )


def test_command_line_overrides_the_preset_in_any_order() -> None:
    before = asked("--steps", "300", "--preset", "paper")
    after = asked("--preset", "paper", "--steps", "300")
    assert before == after
    assert before.optimize.steps == 300
    assert before.optimize.slider == "time"


def test_explicit_default_overrides_the_preset() -> None:
    assert asked("--preset", "paper", "--stages", "0").optimize.stages == asked().optimize.stages == 0


def test_paper_preset_can_leave_out_its_network() -> None:
    plan = resolve(asked("--preset", "paper", "--field", "auto"))
    assert plan.field.field == "auto"


def test_default_loss_weights_depend_on_the_kind() -> None:
    color, style, geometry = (planned(kind) for kind in ("color", "style", "geometry"))
    assert (color.perceptual_weight, style.perceptual_weight, geometry.perceptual_weight) == (0.1, 0.3, 0.3)


def test_color_solver_is_used_unless_a_descent_option_is_given() -> None:
    assert planned("color").solver == "colors"
    assert planned("color", "--perceptual-weight", "0").solver == "colors"
    assert planned("style").solver == "descent"
    for words in (("--perceptual-weight", "0.1"), ("--preset", "paper")):
        assert planned("color", *words).solver == "descent"


def test_default_stages_depend_on_kind_and_steps() -> None:
    asks = {kind: planned(kind).stages for kind in ("color", "style", "geometry")}
    assert asks == {"color": 8, "style": 1, "geometry": 8}
    assert planned("style", "--stages", "4").stages == 4
    assert planned("color", "--quick").stages == 4
    assert planned("color", "--steps", "200").stages == 4, "a stage needs its steps"
    assert planned("color", "--steps", "320").stages == 8
    assert planned("style", "--steps", "32").stages == 1
    assert planned("color", "--quick", "--stages", "2").stages == 2


def test_given_weights_hold_for_every_kind_including_zero() -> None:
    for kind in ("color", "style"):
        assert planned(kind, "--perceptual-weight", "0").perceptual_weight == 0.0


def test_group_steps_apply_only_to_geometry() -> None:
    assert planned("geometry", group_steps=9).group_steps == 9
    assert planned("color", group_steps=9).group_steps == 0


def test_color_edit_keeps_geometry_except_with_the_paper_preset() -> None:
    ours = METHODS["default"].learning_rates("color", 23, 1.0)
    printed = METHODS["paper"].learning_rates("color", 23, 1.0)
    assert torch.equal(ours[:11], torch.zeros(11))
    assert float(printed[:11].min()) > 0
    assert float(ours[11]) > 5 * float(printed[11])


def test_color_solver_can_be_disabled() -> None:
    assert planned("color").solver == "colors"
    descends = with_values(resolve(asked()), color_solver=False)
    assert resolve_kind(descends, "color", 0).solver == "descent"


def test_only_color_edits_may_leave_the_sh_bands_unchanged() -> None:
    assert planned("color").sh == "auto"
    assert planned("style").sh == "on"
    assert planned("color", "--preset", "paper").sh == planned("style", "--sh", "off").sh == "off"
    assert planned("style", "--sh", "off").sh == "off"


def test_plan_round_trips_through_json() -> None:
    for words in ((), ("--preset", "paper"), ("--quick", "--cameras", "c.json", "--text-before", "a bear")):
        plan = resolve(asked(*words))
        assert convert_json(json.loads(json.dumps(to_json(plan))), TrainOptions) == plan


def test_plan_difference_names_the_first_differing_option() -> None:
    def resolve(options: TrainOptions) -> TrainOptions:
        return recorded_options(trainer.resolve.resolve(options))

    plan = resolve(asked())
    assert plan_difference(plan, plan) == ""
    assert plan_difference(plan, resolve(asked("--steps", "40", "--stages", "2"))) == "--steps 800, not 40"
    assert plan_difference(plan, resolve(asked("--views", "9"))) == "--views by default, not 9"
    paper = resolve(asked("--preset", "paper", "--views", "9"))
    assert plan_difference(resolve(asked("--views", "9")), paper) == "--preset default, not paper"
    here = resolve(replace(asked(), scene=Path.cwd() / "scene.ply"))
    assert plan_difference(plan, here) == "", "the same file"


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (("--perceptual-weight", "-1"), "--perceptual-weight"),
        (("--perceptual-weight", "nan"), "--perceptual-weight"),
        (("--preset", "papers"), "preset"),
    ],
)
def test_invalid_weights_and_presets_are_named(words: tuple[str, ...], named: str) -> None:
    with pytest.raises(ProgdfError, match=named):
        resolve(asked(*words))
