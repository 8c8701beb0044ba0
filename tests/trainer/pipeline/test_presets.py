"""Presets and what the options mean: the command line goes first, then the preset, then the defaults."""

from __future__ import annotations

from dataclasses import asdict
from typing import get_args

import pytest
import torch

from progdf.errors import ProgdfError
from trainer.cli import train_options
from trainer.optimize.objective import LossWeights
from trainer.optimize.settings import idle_options, loss_weights, pgs_settings, stage_count
from trainer.option_checks import resolve_options
from trainer.options import Preset, TrainOptions
from trainer.presets import PRESETS, apply_preset

ASKED = ("scene.ply", "--out", "run", "--region", "all", "--editor", "night")


def asked(*more: str) -> TrainOptions:
    return train_options([*ASKED, *more])


def test_every_preset_is_there_and_the_default_one_changes_nothing() -> None:
    assert set(PRESETS) == set(get_args(Preset))
    assert asked("--preset", "default") == asked()


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_a_preset_is_its_values_and_no_more(preset: Preset) -> None:
    plain, found = asdict(asked()), asdict(asked("--preset", preset))
    assert {name: found[name] for name in found if found[name] != plain[name]} == {
        **{name: value for name, value in PRESETS[preset].items() if plain[name] != value},
        "preset": preset,
    }
    assert found == asdict(apply_preset(asked(), preset)), "Python has the same"


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "default"])
def test_each_value_of_a_preset_could_be_given_on_the_command_line(preset: Preset) -> None:
    pairs = [(f"--{name.replace('_', '-')}", str(value)) for name, value in PRESETS[preset].items()]
    words = [word for pair in pairs for word in pair]
    assert asdict(asked(*words)) == {**asdict(asked("--preset", preset)), "preset": "default"}


def test_what_the_command_line_says_goes_before_the_preset_wherever_it_stands() -> None:
    before = asked("--steps", "300", "--preset", "paper")
    after = asked("--preset", "paper", "--steps", "300")
    assert before == after
    assert before.steps == 300
    assert before.progressive == "decay"


def test_a_default_that_the_command_line_spells_out_goes_before_the_preset_too() -> None:
    assert asked("--preset", "paper", "--stages", "0").stages == asked().stages == 0


def test_the_papers_trainer_is_as_printed() -> None:
    options = resolve_options(asked("--preset", "paper"))
    assert loss_weights(options, "color") == LossWeights(1.0, 1, "decay", 5.0, "paper", 1.0)
    assert loss_weights(options, "geometry") == loss_weights(options, "color"), "whatever the edit"
    settings = pgs_settings(options, "color", 23, 1.0, 1)
    assert bool((settings.rates > 0).all()), "all attributes are free"
    assert (settings.damped, settings.ramp, settings.fall, settings.reach) == (False, 0.0, 0.0, 0.0)
    assert (settings.smoothing, settings.every) == (0.0, options.steps // 32)
    assert 1500 <= options.steps <= 2000
    assert (options.stages, options.views, options.slider) == (1, 96, "time")


def test_the_paper_can_tighten_instead_of_letting_go() -> None:
    options = asked("--preset", "paper", "--progressive", "growth")
    assert loss_weights(options, "style").progressive == "growth"


def test_by_default_a_color_edit_is_paid_in_l1_mostly_and_a_style_for_its_texture_too() -> None:
    color, style, geometry = (loss_weights(asked(), kind) for kind in ("color", "style", "geometry"))
    assert (color.perceptual, style.perceptual, geometry.perceptual) == (0.1, 0.3, 0.3)
    assert (color.sharpness, style.sharpness, geometry.sharpness) == ("off", "hinge", "off")


def test_a_style_goes_straight_to_its_end_unless_stages_are_asked_for() -> None:
    asks = {kind: stage_count(resolve_options(asked()), kind) for kind in ("color", "style", "geometry")}
    assert asks == {"color": 8, "style": 1, "geometry": 8}
    assert stage_count(resolve_options(asked("--stages", "4")), "style") == 4
    assert stage_count(resolve_options(asked("--quick")), "color") == 4
    assert stage_count(resolve_options(asked("--steps", "200")), "color") == 4, "a stage needs its steps"
    assert stage_count(resolve_options(asked("--steps", "320")), "color") == 8
    assert stage_count(resolve_options(asked("--steps", "32")), "style") == 1
    assert stage_count(resolve_options(asked("--quick", "--stages", "2")), "color") == 2


def test_weights_that_are_given_hold_whatever_the_edit_and_zero_is_a_weight() -> None:
    options = asked("--perceptual-weight", "0", "--sharpness", "hinge")
    for kind in ("color", "style"):
        weights = loss_weights(options, kind)
        assert (weights.perceptual, weights.sharpness, weights.sharpness_weight) == (0.0, "hinge", 0.1)


def test_options_that_change_nothing_are_named() -> None:
    assert idle_options(asked(), "color") == []
    assert idle_options(asked("--preset", "paper"), "color") == []
    assert idle_options(asked("--group-steps", "9"), "color") == ["--group-steps"]
    assert idle_options(asked("--group-steps", "9"), "geometry") == []


def test_only_the_warm_up_shortens_the_first_steps() -> None:
    for progressive, warm in (("warmup", True), ("decay", False), ("growth", False), ("off", False)):
        settings = pgs_settings(asked("--progressive", progressive), "color", 14, 1.0, 4)
        assert settings.warmup == warm


def test_a_color_edit_holds_the_geometry_still_unless_the_plain_rates_are_asked_for() -> None:
    ours = pgs_settings(asked(), "color", 23, 1.0, 4).rates
    plain = pgs_settings(asked("--preset", "paper"), "color", 23, 1.0, 4).rates
    assert torch.equal(ours[:11], torch.zeros(11))
    assert float(plain[:11].min()) > 0
    assert float(ours[11]) > 10 * float(plain[11])


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
        resolve_options(asked(*words))
