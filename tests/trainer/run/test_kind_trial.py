"""Trial runs that find the kind of an edit given as pictures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.rasterize import render
from tests.helpers.demo_scenes import bear
from tests.helpers.trained import WHITE, Small, quick_options, small
from trainer.editors import make_editor
from trainer.evaluate.suite.analytic_edits import AnalyticEdit, bear_edits
from trainer.options import EditorOptions, TrainOptions, with_values
from trainer.resolve import resolve
from trainer.run.kinds import Approach, Trial, approaches, choose_approach, try_approaches
from trainer.store.progress import RunLog
from trainer.views.setup import TrainingSetup

COLOR = Approach("color")
STYLE = Approach("style")
FREE = Approach("geometry")
IN_PARTS = Approach("geometry", 120)
GROWN = Approach("geometry", grow=0.2)
GROWN_STYLE = Approach("style", grow=0.2)


def asked(**more: object) -> TrainOptions:
    options = with_values(quick_options(Path("nowhere")), editor="folder:nowhere")
    return resolve(with_values(options, **{"steps": 144, **more}))


def setup(case: Small) -> TrainingSetup:
    return TrainingSetup(case.scene, case.region, case.views, [], WHITE)


def pictured(case: Small, edit: AnalyticEdit) -> list[Tensor]:
    edited = edit.apply(case.scene, case.region.members, 1.0)
    with torch.no_grad():
        return [render(edited, view.camera, WHITE).image.clamp(0, 1) for view in case.views]


def waves(part: Gaussians, strength: float) -> Gaussians:
    """Return the part with a soft vertical wave around the neck."""
    means = part.means.clone()
    means[:, 1] += 0.1 * strength * torch.sin(5 * torch.atan2(means[:, 0], means[:, 2]))
    return replace(part, means=means)


@cache
def scarf() -> Small:
    return small("scarf", count=6, image_size=72)


def test_recolor_given_as_pictures_is_a_color_edit() -> None:
    case = scarf()
    editor = make_editor(EditorOptions("recolor:#3060d0"), case.scene, case.region, case.views)
    pictures = [editor.edit(view, 1.0) for view in case.views]
    trial = try_approaches(asked(), setup(case), pictures, [COLOR, STYLE, FREE, IN_PARTS])
    assert trial.chosen == COLOR
    assert trial.psnrs[COLOR] > trial.psnrs[FREE] + 2


def test_paper_preset_moves_all_attributes_without_a_trial(tmp_path: Path) -> None:
    case = scarf()
    editor = make_editor(EditorOptions("recolor:#3060d0"), case.scene, case.region, case.views)
    options = with_values(asked(), preset="paper", group_steps=0)
    log = RunLog(tmp_path / "log.txt", quiet=True)
    assert choose_approach(options, setup(case), editor, log) == (FREE, None)
    log.close()


def test_moved_part_is_a_geometry_edit_in_parts() -> None:
    case = small("ears", count=6, image_size=72)
    edit, _ = bear_edits(bear(1500))["big ears"]
    trial = try_approaches(asked(), setup(case), pictured(case, edit), [COLOR, STYLE, FREE, IN_PARTS])
    assert trial.chosen == IN_PARTS
    assert trial.psnrs[IN_PARTS] > trial.psnrs[FREE] + 2


def test_soft_bend_is_a_geometry_edit_without_parts() -> None:
    case = scarf()
    pictures = pictured(case, AnalyticEdit("waves", waves))
    trial = try_approaches(asked(), setup(case), pictures, [COLOR, STYLE, FREE, IN_PARTS])
    assert trial.chosen == FREE
    assert trial.psnrs[FREE] > trial.psnrs[STYLE]


def test_same_trial_gives_the_same_figures() -> None:
    case = scarf()
    pictures = pictured(case, AnalyticEdit("waves", waves))
    assert try_approaches(asked(), setup(case), pictures, [STYLE]) == try_approaches(
        asked(), setup(case), pictures, [STYLE]
    )


def test_colors_alone_win_if_full_training_is_hardly_better() -> None:
    assert Trial(40, {COLOR: 19.9, STYLE: 20.0, FREE: 12.0}, 10.0).chosen == COLOR
    assert Trial(40, {COLOR: 19.0, STYLE: 20.0, FREE: 12.0}, 10.0).chosen == STYLE


def test_geometry_wins_if_it_gains_nearly_as_much_as_paint() -> None:
    assert Trial(40, {COLOR: 20.7, STYLE: 21.3, FREE: 21.1, IN_PARTS: 20.2}, 19.8).chosen == FREE
    assert Trial(40, {COLOR: 15.1, STYLE: 14.9, FREE: 12.2, IN_PARTS: 9.8}, 10.4).chosen == COLOR
    assert Trial(40, {FREE: 9.0, IN_PARTS: 9.5}, 10.0).chosen == IN_PARTS
    assert Trial(40, {COLOR: 9.0, STYLE: 9.5, FREE: 9.9}, 10.0).chosen == STYLE, "nothing gains"


def test_growth_wins_with_a_tenth_less_error_unless_something_moves() -> None:
    assert Trial(60, {COLOR: 14.8, STYLE: 15.2, IN_PARTS: 20.2, GROWN: 27.1}, 14.6).chosen == GROWN
    assert Trial(60, {COLOR: 20.4, STYLE: 20.4, GROWN: 20.4}, 20.4).chosen == COLOR
    # a tenth of the error is 0.46 dB
    assert Trial(60, {STYLE: 20.0, GROWN_STYLE: 20.4}, 10.0).chosen == STYLE
    assert Trial(60, {STYLE: 20.0, GROWN_STYLE: 20.5}, 10.0).chosen == GROWN_STYLE
    # growth would fade in an object that only moves
    moved = Trial(60, {FREE: 17.0, IN_PARTS: 28.0, GROWN: 29.5}, 14.0)
    assert moved.chosen == IN_PARTS
    assert "growth removes less than 10 % of the error, or replaces parts that move" in moved.line()
    assert moved.figures() == Trial(60, {FREE: 17.0, IN_PARTS: 28.0}, 14.0).figures()


def test_summary_line_names_tried_and_chosen_approaches() -> None:
    line = Trial(40, {COLOR: 18.0, FREE: 21.23}, 10.0).line()
    assert "40 steps with L1" in line
    assert "color 18.0, geometry 21.2 dB" in line
    assert "chosen: geometry (--kind geometry --group-steps 0 skips the trial)" in line
    assert "\n" not in line


@pytest.mark.parametrize(
    ("more", "expected"),
    [
        ({}, [COLOR, STYLE, FREE, IN_PARTS]),
        ({"group_steps": 0}, [COLOR, STYLE, FREE]),
        ({"group_steps": 50}, [COLOR, STYLE, Approach("geometry", 50)]),
        ({"kind": "geometry"}, [FREE, IN_PARTS]),
        ({"kind": "geometry", "group_steps": 12}, [Approach("geometry", 12)]),
        ({"kind": "style"}, [STYLE]),
        ({"grow": 0.2}, [COLOR, STYLE, FREE, IN_PARTS, GROWN]),
        ({"grow": 0.2, "kind": "geometry", "group_steps": 0}, [FREE, GROWN]),
        ({"grow": 0.2, "kind": "style"}, [STYLE, GROWN_STYLE]),
    ],
)
def test_options_restrict_the_tried_approaches(more: dict[str, object], expected: list[Approach]) -> None:
    case = scarf()
    assert approaches(asked(**more), setup(case), [view.image for view in case.views]) == expected


def test_pictures_repainted_all_over_do_not_try_geometry() -> None:
    case = scarf()
    repainted = [0.8 * view.image for view in case.views]
    assert approaches(asked(), setup(case), repainted) == [COLOR, STYLE]
    assert approaches(asked(grow=0.2), setup(case), repainted) == [COLOR, STYLE, GROWN_STYLE]
    assert approaches(asked(kind="geometry"), setup(case), repainted) == [FREE, IN_PARTS]
