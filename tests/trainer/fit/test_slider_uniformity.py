"""Slider uniformity: equal steps look equally large, in the editor's strengths and the fitted field."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.field import fit_separable
from progdf.gaussians import pack
from progdf.metrics.slider import slider_statistics
from tests.helpers.trained import WHITE, quick_options, small
from trainer.editors import make_editor
from trainer.fit.slider_uniformity import equalize_slider, equalized_strengths, equalizing_remap
from trainer.optimize.retime import resolve_slider
from trainer.options import EditKind, EditorOptions, Slider
from trainer.resolve import resolve
from trainer.views.crops import crop_scene, render_all
from trainer.views.setup import TrainingSetup
from trainer.views.view import View

QUARTERS = (0.25, 0.5, 0.75, 1.0)


@dataclass
class Late:
    """Editor whose change appears late; it counts its calls."""

    stages: tuple[float, ...] = ()
    kind: EditKind = "color"
    is_confined: bool = True
    power: float = 3.0
    asked: int = 0

    def edit(self, view: View, strength: float) -> Tensor:
        self.asked += 1
        return torch.lerp(view.image, torch.zeros(3), strength**self.power)


def uniformity(dial_of: Tensor) -> float:
    steps = dial_of.diff().abs()
    return float(steps.min() / steps.max())


def test_editor_is_requested_at_evenly_spaced_changes() -> None:
    views = small(count=4).views
    editor = Late()
    asked = equalized_strengths(editor, "darken:0.5", views, QUARTERS)
    assert asked == pytest.approx([0.25 ** (1 / 3), 0.5 ** (1 / 3), 0.75 ** (1 / 3), 1.0], abs=0.01)
    pictures = [torch.stack([editor.edit(view, s) for view in views]) for s in (0.0, *asked)]
    steps = torch.stack([(b - a).abs().mean() for a, b in pairwise(pictures)])
    assert float(steps.min() / steps.max()) > 0.95


def test_slow_model_is_sampled_at_nine_strengths_of_one_view() -> None:
    views = small(count=4).views
    editor = Late()
    asked = equalized_strengths(editor, "instruct:make him smile", views, QUARTERS)
    assert asked == pytest.approx([0.25 ** (1 / 3), 0.5 ** (1 / 3), 0.75 ** (1 / 3), 1.0], abs=0.02)
    assert editor.asked == 9


def test_strengths_have_three_decimals_for_folder_names() -> None:
    asked = equalized_strengths(Late(), "darken:0.5", small(count=4).views, QUARTERS)
    assert all(float(f"{s:g}") == s and s == round(s, 3) for s in asked)
    assert asked[-1] == 1.0


@pytest.mark.parametrize(
    ("editor", "spec", "plain"),
    [
        (Late(stages=QUARTERS), "folder:somewhere", QUARTERS),
        (Late(), "darken:0.5", (1.0,)),
    ],
)
def test_given_strengths_and_single_targets_are_not_probed(
    editor: Late, spec: str, plain: tuple[float, ...]
) -> None:
    assert equalized_strengths(editor, spec, small(count=4).views, plain) == plain
    assert editor.asked == 0


def test_abrupt_edit_uses_the_plain_strengths() -> None:
    assert equalized_strengths(Late(power=300.0), "darken:0.5", small(count=4).views, QUARTERS) == QUARTERS
    assert equalized_strengths(Late(power=1e6), "darken:0.5", small(count=4).views, QUARTERS) == QUARTERS


def test_steps_are_even_from_any_start() -> None:
    def seen(s: float) -> Tensor:
        return torch.tensor([s + 0.8 * (1 - math.cos(9 * s)) / 9 + 2.0 * s**4], dtype=torch.float64)

    before = uniformity(torch.cat([seen(i / 20) for i in range(21)]))
    remap, _ = equalizing_remap(seen)
    back = type(remap)(remap.new, remap.old)
    assert before < 0.4
    for phase in (0.0, 0.25, 0.5, 0.75):
        steps = torch.cat([seen(back.at((i + phase) / 20)) for i in range(20)])
        assert uniformity(steps) > 0.75, phase


def test_unchanging_edit_keeps_its_slider() -> None:
    remap, _ = equalizing_remap(lambda s: torch.zeros(4))
    assert remap.at(0.3) == pytest.approx(0.3)


def test_fitted_field_is_even_in_held_out_views() -> None:
    case = small(count=6)
    members = case.region.members
    original = pack(case.scene[members])
    strengths = torch.linspace(0, 1, 17)
    change = torch.zeros_like(original)
    change[:, -3:] = -0.8
    offsets = strengths[:, None, None] ** 2.5 * change
    field = fit_separable(strengths, offsets, {"sh0": 2})
    train = case.views[:4]
    held_out = case.views[4:]
    setup = TrainingSetup(case.scene, case.region, train, held_out, WHITE)
    even, remap = equalize_slider(field, setup)
    crops = [crop_scene(case.scene, members, view.camera, view.box, WHITE) for view in held_out]
    before, after = (
        slider_statistics(lambda s, f=f: render_all(crops, original + f.offsets(s))) for f in (field, even)
    )
    assert before.uniformity < 0.3
    assert after.uniformity > 0.85
    assert torch.equal(even.offsets(1.0), field.offsets(1.0))
    assert remap.at(0.5) < 0.3, "half the strength is far less than half of the change"


def test_auto_slider_is_even_unless_pictures_of_strengths_are_given() -> None:
    def resolved(slider: Slider, editor: str, strengths: tuple[float, ...] = QUARTERS) -> str:
        options = resolve(quick_options(Path("nowhere"), editor=editor, slider=slider))
        return resolve_slider(options.optimize.slider, strengths)

    assert resolved("auto", "recolor:#3060d0") == "even"
    assert resolved("auto", "folder:here", (1.0,)) == "even"
    assert resolved("auto", "folder:here") == "stages"
    assert resolved("auto", "photographs:here") == "stages"
    assert resolved("even", "folder:here") == "even"
    assert resolved("time", "recolor:#3060d0") == "time"


def test_stripes_are_requested_at_strengths_of_visible_change() -> None:
    case = small(count=6)
    editor = make_editor(EditorOptions("stripes:#20a040"), case.scene, case.region, case.views)
    asked = equalized_strengths(editor, "stripes:#20a040", case.views, QUARTERS)
    assert asked != QUARTERS
    assert all(a < b for a, b in pairwise((0.0, *asked)))
