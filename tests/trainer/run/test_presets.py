"""Presets and what the options mean: the command line goes first, then the preset, then the defaults."""

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
from trainer.optimize.pgs import pgs_settings
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


def test_every_preset_is_there_and_the_default_one_changes_nothing() -> None:
    assert set(PRESETS) == set(get_args(Preset))
    assert asked("--preset", "default") == asked()


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_a_preset_is_its_values_and_no_more(preset: Preset) -> None:
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
def test_each_value_of_a_preset_could_be_given_on_the_command_line(preset: Preset) -> None:
    fixed = {"perceptual_every", "sharpness", "as_printed", "color_solver", "ema", "target_ramp"}
    values = {name: value for part in PRESETS[preset].values() for name, value in part.items()}
    words = [w for n, v in values.items() if n not in fixed for w in (f"--{n.replace('_', '-')}", str(v))]
    assert with_values(asked(*words), **{n: values[n] for n in fixed}, preset=preset) == asked(
        "--preset", preset
    )


def test_what_the_command_line_says_goes_before_the_preset_wherever_it_stands() -> None:
    before = asked("--steps", "300", "--preset", "paper")
    after = asked("--preset", "paper", "--steps", "300")
    assert before == after
    assert before.optimize.steps == 300
    assert before.optimize.progressive == "decay"


def test_a_default_that_the_command_line_spells_out_goes_before_the_preset_too() -> None:
    assert asked("--preset", "paper", "--stages", "0").optimize.stages == asked().optimize.stages == 0


def test_the_papers_trainer_can_leave_out_its_network() -> None:
    plan = resolve(asked("--preset", "paper", "--field", "auto"))
    assert plan.field.field == "auto"


def test_the_paper_can_tighten_instead_of_letting_go() -> None:
    assert planned("style", "--preset", "paper", "--progressive", "growth").progressive == "growth"


def test_by_default_a_color_edit_is_paid_in_l1_mostly_and_a_style_for_its_texture_too() -> None:
    color, style, geometry = (planned(kind) for kind in ("color", "style", "geometry"))
    assert (color.perceptual_weight, style.perceptual_weight, geometry.perceptual_weight) == (0.1, 0.3, 0.3)
    assert (color.sharpness, style.sharpness, geometry.sharpness) == ("off", "hinge", "off")


def test_colors_are_solved_for_unless_something_is_asked_for_that_a_descent_has() -> None:
    assert planned("color").solver == "colors"
    assert planned("color", "--perceptual-weight", "0").solver == "colors"
    assert planned("style").solver == "descent"
    for words in (("--perceptual-weight", "0.1"), ("--progressive", "decay"), ("--preset", "paper")):
        assert planned("color", *words).solver == "descent"


def test_a_style_goes_straight_to_its_end_unless_stages_are_asked_for() -> None:
    asks = {kind: planned(kind).stages for kind in ("color", "style", "geometry")}
    assert asks == {"color": 8, "style": 1, "geometry": 8}
    assert planned("style", "--stages", "4").stages == 4
    assert planned("color", "--quick").stages == 4
    assert planned("color", "--steps", "200").stages == 4, "a stage needs its steps"
    assert planned("color", "--steps", "320").stages == 8
    assert planned("style", "--steps", "32").stages == 1
    assert planned("color", "--quick", "--stages", "2").stages == 2


def test_weights_that_are_given_hold_whatever_the_edit_and_zero_is_a_weight() -> None:
    for kind in ("color", "style"):
        assert planned(kind, "--perceptual-weight", "0").perceptual_weight == 0.0


def test_parts_move_as_wholes_only_where_something_moves() -> None:
    assert planned("geometry", group_steps=9).group_steps == 9
    assert planned("color", group_steps=9).group_steps == 0


def test_a_color_edit_holds_the_geometry_still_unless_the_plain_rates_are_asked_for() -> None:
    ours = pgs_settings(planned("color"), True, 23, 1.0, 4).rates
    to_json = pgs_settings(planned("color", "--preset", "paper"), True, 23, 1.0, 4).rates
    assert torch.equal(ours[:11], torch.zeros(11))
    assert float(to_json[:11].min()) > 0
    assert float(ours[11]) > 5 * float(to_json[11])


def test_the_papers_rates_are_those_of_3dgs_as_gaussian_editor_multiplies_them() -> None:
    to_json, multiplied = (
        pgs_settings(planned("color", "--preset", "paper", *words), True, 14, 1.0, 1).rates
        for words in (("--rates", "3dgs"), ())
    )
    factors = [5.0] * 3 + [2.0] * 8 + [5.0] * 3  # means; log-scales, quaternion, opacity; color
    assert torch.allclose(multiplied / to_json, torch.tensor(factors))


@pytest.mark.parametrize(("part", "changes"), [("target_ramp", "ramp"), ("ema", "smoothing")])
def test_each_refinement_of_a_descent_can_be_left_out_alone(part: str, changes: str) -> None:
    without = resolve_kind(with_values(resolve(asked()), **{part: False}), "style", 0)
    whole = vars(pgs_settings(planned("style"), True, 14, 1.0, 4))
    less = vars(pgs_settings(without, True, 14, 1.0, 4))
    assert torch.equal(whole.pop("rates"), less.pop("rates"))
    assert {name for name in whole if whole[name] != less[name]} == {changes}
    assert not less[changes]


def test_colors_are_solved_for_unless_that_is_left_out() -> None:
    assert planned("color").solver == "colors"
    descends = with_values(resolve(asked()), color_solver=False)
    assert resolve_kind(descends, "color", 0).solver == "descent"


def test_only_a_color_edit_may_leave_the_bands_alone() -> None:
    assert planned("color").sh == "auto"
    assert planned("style").sh == "on"
    assert planned("color", "--preset", "paper").sh == planned("style", "--sh", "off").sh == "off"
    assert planned("style", "--sh", "off").sh == "off"


def test_a_plan_is_read_back_from_json_as_it_was() -> None:
    for words in ((), ("--preset", "paper"), ("--quick", "--cameras", "c.json", "--text-before", "a bear")):
        plan = resolve(asked(*words))
        assert convert_json(json.loads(json.dumps(to_json(plan))), TrainOptions) == plan


def test_two_plans_differ_by_the_first_option_that_does() -> None:
    def resolve(options: TrainOptions) -> TrainOptions:
        return recorded_options(trainer.resolve.resolve(options))

    plan = resolve(asked())
    assert plan_difference(plan, plan) == ""
    assert plan_difference(plan, resolve(asked("--steps", "40", "--stages", "2"))) == "--steps 800, not 40"
    assert plan_difference(plan, resolve(asked("--views", "9"))) == "--views by default, not 9"
    paper = resolve(asked("--preset", "paper", "--views", "9"))
    assert plan_difference(resolve(asked("--views", "9")), paper) == "--lift-rule share, not paper"
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
def test_weights_and_presets_that_make_no_sense_are_named(words: tuple[str, ...], named: str) -> None:
    with pytest.raises(ProgdfError, match=named):
        resolve(asked(*words))
