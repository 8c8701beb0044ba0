"""Tests of the split of a color change into color and texture, and of its gains."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.compose.added import extend
from progdf.compose.composer import Composer
from progdf.compose.layers import BLENDS, Gains, Layer
from progdf.compose.reference import compose_layers
from progdf.field.baked import GradeForm
from progdf.field.grade import bake_grade, map_alone, monomials
from progdf.field.separable import course_field
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import Gdf
from progdf.gdf.texture import color_split, fit_map, has_texture, slopes
from progdf.sh import C0
from tests.helpers.draws import Draws
from tests.helpers.edits import bits, curved_field, edit_of, grade_of, painted, rimmed, some_rows
from tests.helpers.scenes import random_gaussians

STRENGTHS = torch.tensor([0.0, 0.3, 1.0])


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(300, seed=4, sh_degree=1)


def recolor(scene: Gaussians, rows: Tensor, noise: float = 0.0) -> Gdf:
    """Return an edit by a quadratic map of the members' colors, with a random remainder per member."""
    colors = (C0 * scene.sh0[rows].reshape(-1, 3) + 0.5).clamp(0.0, 1.5)
    change = 0.4 - 0.7 * colors + 0.3 * colors.flip(1).square()
    change = (change + noise * Draws(2).normal(len(rows), 3)) / C0
    offsets = torch.zeros(3, len(rows), 14)
    offsets[:, :, 11:] = torch.tensor([0.0, 0.6, 1.0])[:, None, None] * change
    return edit_of(scene, rows, course_field(STRENGTHS, offsets), "recolor")


def colors_of(composed: Gaussians, rows: Tensor) -> Tensor:
    return composed.sh0[rows].reshape(-1, 3)


def edits(scene: Gaussians) -> list[Gdf]:
    """Return edits held as bases, as a map with mask and residual, and as paint."""
    rows = some_rows(scene, 150, 1)
    return [
        edit_of(scene, rows, curved_field(150, 1, 14 + 3 * scene.shN.shape[1]), "style"),
        grade_of(scene, rows, "stripes"),
        rimmed(painted(scene, 40, 9), 1),
        recolor(scene, rows, 0.1),
    ]


@pytest.mark.parametrize("number", range(4))
def test_gains_of_one_give_the_edit_and_of_zero_the_original_colors(scene: Gaussians, number: int) -> None:
    edit = edits(scene)[number]
    for strength in (0.4, 1.0):
        whole = compose_layers(scene, [Layer(edit, strength)])
        ones = compose_layers(scene, [Layer(edit, strength, gains=Gains(color=1.0, texture=1.0))])
        assert bits(ones) == bits(whole)
        none = compose_layers(scene, [Layer(edit, strength, gains=Gains(color=0.0, texture=0.0))])
        for name in ("sh0", "shN"):
            assert torch.equal(getattr(none, name)[: len(scene)], getattr(scene, name))
        assert torch.equal(none.means, whole.means)


@pytest.mark.parametrize("number", range(4))
def test_color_and_texture_add_up_to_the_edit(scene: Gaussians, number: int) -> None:
    edit = edits(scene)[number]
    extended, (converted,) = extend(scene, [edit])
    split = color_split(extended, converted)
    assert split is not None
    members = converted.region.members
    for strength in (0.4, 1.0):
        color, texture, both, none = (
            compose_layers(scene, [Layer(edit, strength, gains=Gains(color=c, texture=t))])
            for c, t in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.0, 0.0))
        )
        for name in ("sh0", "shN"):
            parts = [getattr(each, name)[members] for each in (color, texture, both, none)]
            torch.testing.assert_close(parts[0] + parts[1], parts[2] + parts[3], atol=1e-5, rtol=1e-5)
        if split.color is not None and number != 2:
            change = (color.sh0 - extended.sh0)[members].reshape(-1, 3)
            expected = split.color.attribute_offsets("sh0", strength)
            torch.testing.assert_close(change, expected, atol=1e-5, rtol=1e-5)


def test_map_of_colors_has_no_texture_and_is_fitted_at_every_strength(scene: Gaussians) -> None:
    rows = some_rows(scene, 150, 1)
    edit = recolor(scene, rows)
    for strength in (0.15, 0.3, 0.7, 1.0):
        whole = colors_of(compose_layers(scene, [Layer(edit, strength)]), rows)
        color = colors_of(compose_layers(scene, [Layer(edit, strength, gains=Gains(texture=0.0))]), rows)
        torch.testing.assert_close(color, whole, atol=2e-3, rtol=0.0)
        texture = colors_of(compose_layers(scene, [Layer(edit, strength, gains=Gains(color=0.0))]), rows)
        torch.testing.assert_close(texture, colors_of(scene, rows), atol=2e-3, rtol=0.0)


def test_fitted_map_has_the_least_weighted_error(scene: Gaussians) -> None:
    draws = Draws(5)
    inputs = monomials((C0 * scene.sh0.reshape(-1, 3).T + 0.5).clamp(0.0, 1.5), 2)
    change = draws.normal(len(scene), 3)
    weights = draws.uniform(len(scene)).double()
    table = fit_map(inputs, change, weights)
    error = (change - inputs.T @ table).double()
    gradient = inputs.double() @ (weights[:, None] * error)
    assert float(gradient.abs().max()) < 1e-3 * float((inputs.double().abs() * weights).sum(dim=1).max())


def test_slopes_are_the_derivative_of_the_map() -> None:
    draws = Draws(6)
    colors = 0.2 + 0.6 * draws.uniform(3, 20).double()
    table = draws.normal(10, 3).double()
    found = slopes(colors, table)
    for channel in range(3):
        step = torch.zeros(3, 1, dtype=torch.float64)
        step[channel] = 1e-6
        change = (monomials(colors + step, 2) - monomials(colors - step, 2)).T @ table / 2e-6
        torch.testing.assert_close(found[:, channel], change, atol=1e-6, rtol=1e-6)


def test_grade_without_mask_and_residual_has_no_texture(scene: Gaussians) -> None:
    edit = grade_of(scene, some_rows(scene, 100, 2), "warm")
    form = edit.field.origin
    assert isinstance(form, GradeForm)
    assert has_texture(edit)
    rows = pack(scene[edit.region.members], with_shN=True)
    alone = replace(edit, field=bake_grade(map_alone(form, len(edit.region)), rows))
    assert not has_texture(alone)
    assert color_split(scene, alone) is None
    whole = compose_layers(scene, [Layer(alone)])
    assert bits(compose_layers(scene, [Layer(alone, gains=Gains(texture=0.0))])) == bits(whole)
    assert bits(compose_layers(scene, [Layer(alone, gains=Gains(color=0.0))])) == bits(scene)


def test_gains_of_zero_give_discs_the_color_of_the_surface_below(scene: Gaussians) -> None:
    edit = painted(scene, 40, 9)
    extended, (converted,) = extend(scene, [edit])
    anchors = converted.anchors
    assert anchors is not None
    discs = converted.region.members[-40:]
    below = (anchors.weights[..., None] * colors_of(extended, anchors.rows.flatten()).reshape(40, 4, 3)).sum(
        dim=1
    )
    none = compose_layers(scene, [Layer(edit, gains=Gains(color=0.0, texture=0.0))])
    torch.testing.assert_close(colors_of(none, discs), below, atol=1e-5, rtol=0.0)
    twice = compose_layers(scene, [Layer(edit, 0.3, gains=Gains(color=0.0, texture=0.0)), Layer(edit, 0.8)])
    assert torch.equal(colors_of(twice, discs), colors_of(extended, discs)), "the stronger layer's color"


@pytest.mark.parametrize("blend", BLENDS)
def test_composer_divides_color_and_texture_like_compose(scene: Gaussians, blend: str) -> None:
    gdfs = edits(scene)
    draws = Draws(3)
    composer = Composer(scene, gdfs)
    for _ in range(20):
        layers = [
            Layer(gdfs[i], float(draws.uniform(1)), gains=Gains(1.0, 1.0, *draws.uniform(2).tolist()))
            for i in draws.order(4).tolist()[: 1 + int(3 * float(draws.uniform(1)))]
        ]
        composer.update(layers, blend)
        none = [Layer(gdf, 0.0) for gdf in gdfs]
        plain = compose_layers(scene, [*none, *layers], blend)
        for name in ("sh0", "shN"):
            found = getattr(composer.gaussians, name)
            torch.testing.assert_close(found, getattr(plain, name), atol=1e-5, rtol=1e-5)


def test_texture_alone_lies_on_the_colors_of_lower_layers(scene: Gaussians) -> None:
    rows = some_rows(scene, 150, 1)
    below = recolor(scene, rows)
    above = edit_of(scene, rows, curved_field(150, 7, moving=("sh0",)), "strokes")
    tinted = colors_of(compose_layers(scene, [Layer(below)]), rows)
    strokes = colors_of(compose_layers(scene, [Layer(above, gains=Gains(color=0.0))]), rows) - colors_of(
        scene, rows
    )
    both = compose_layers(scene, [Layer(below), Layer(above, gains=Gains(color=0.0))], "over")
    torch.testing.assert_close(colors_of(both, rows), tinted + strokes, atol=1e-5, rtol=0.0)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_small_or_uniform_regions_give_finite_colors(scene: Gaussians, count: int) -> None:
    rows = torch.arange(count)
    gray = replace(scene, sh0=torch.zeros_like(scene.sh0), logit_opacities=scene.logit_opacities - 200.0)
    for each in (scene, gray):
        edit = edit_of(each, rows, curved_field(count, 3, moving=("sh0",)), "few")
        found = compose_layers(each, [Layer(edit, gains=Gains(texture=0.0))])
        assert bool(found.sh0.isfinite().all())
        assert float((found.sh0 - each.sh0).abs().max()) < 100.0
