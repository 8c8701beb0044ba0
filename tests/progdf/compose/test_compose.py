"""Tests of the rules for several edits on one scene, and of the Composer, which matches them to the bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from progdf.compose.composer import Composer
from progdf.compose.reference import BLENDS, Gains, Layer, compose_layers, coverage
from progdf.errors import ProgdfError
from progdf.field import fit_keyframes
from progdf.field.baked import BakedField, identity_map
from progdf.field.grade import bake_grade, fit_grade, lattice_form, map_colors
from progdf.gaussians import ATTRIBUTES, Gaussians, attribute_slices, pack
from progdf.gdf.file import Gdf, apply_grade
from progdf.rasterize import set_threads
from progdf.region import from_mask, whole_scene
from tests.helpers.edits import bits, curved_field, edit_of, some_rows
from tests.helpers.scenes import random_gaussians

COLOR = ("sh0", "shN")


def scene_with_signed_zeros(count: int = 400) -> Gaussians:
    scene = random_gaussians(count, seed=3, sh_degree=1)
    return replace(
        scene, sh0=scene.sh0 * (scene.sh0.abs() > 0.4), means=scene.means.index_fill(0, torch.arange(9), -0.0)
    )


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return scene_with_signed_zeros()


@pytest.fixture(scope="module")
def shirt(scene: Gaussians) -> Gdf:
    return edit_of(scene, some_rows(scene, 150, 1), curved_field(150, 1, end_type=torch.int8), "shirt")


@pytest.fixture(scope="module")
def hat(scene: Gaussians) -> Gdf:
    return edit_of(scene, some_rows(scene, 120, 2), curved_field(120, 2, moving=("sh0",)), "hat")


def change(scene: Gaussians, edited: Gaussians) -> torch.Tensor:
    return pack(edited, True).double() - pack(scene, True).double()


@pytest.mark.parametrize("blend", BLENDS)
def test_strength_zero_is_the_original_bit_for_bit(
    scene: Gaussians, shirt: Gdf, hat: Gdf, blend: str
) -> None:
    assert bits(compose_layers(scene, [Layer(shirt, 0.0), Layer(hat, -0.0)], blend)) == bits(scene)


@pytest.mark.parametrize("blend", BLENDS)
def test_one_layer_at_full_strength_is_the_recorded_end(scene: Gaussians, shirt: Gdf, blend: str) -> None:
    edited = compose_layers(scene, [Layer(shirt, 1.0)], blend)
    full = torch.cat([bases.end for bases in shirt.field.attributes.values()], dim=1)
    expected = scene.replace_rows(shirt.region.members, pack(scene)[shirt.region.members] + full)
    assert bits(edited) == bits(expected)


@pytest.mark.parametrize("blend", BLENDS)
def test_rows_outside_all_members_keep_their_bytes(
    scene: Gaussians, shirt: Gdf, hat: Gdf, blend: str
) -> None:
    outside = torch.ones(len(scene), dtype=torch.bool)
    outside[shirt.region.members] = False
    outside[hat.region.members] = False
    edited = compose_layers(scene, [Layer(shirt, 0.7), Layer(hat, 0.9)], blend)
    assert bits(edited[outside]) == bits(scene[outside])


def test_unmoved_attributes_are_the_tensors_of_the_scene(scene: Gaussians, hat: Gdf) -> None:
    edited = compose_layers(scene, [Layer(hat, 0.5)])
    assert edited.means is scene.means
    assert edited.shN is scene.shN


def test_rows_of_weight_zero_keep_their_bytes(scene: Gaussians, shirt: Gdf) -> None:
    weights = torch.ones(150)
    weights[::2] = 0.0
    edited = compose_layers(scene, [Layer(shirt, 0.6, weights=weights)])
    untouched = shirt.region.members[::2]
    assert bits(edited[untouched]) == bits(scene[untouched])


def test_weights_scale_the_change(scene: Gaussians, shirt: Gdf) -> None:
    whole = change(scene, compose_layers(scene, [Layer(shirt, 0.6)]))
    half = change(scene, compose_layers(scene, [Layer(shirt, 0.6, weights=torch.full((150,), 0.5))]))
    assert torch.allclose(half, whole / 2, atol=1e-6)


def test_gains_scale_only_their_own_kind_of_attribute(scene: Gaussians, shirt: Gdf) -> None:
    whole = change(scene, compose_layers(scene, [Layer(shirt, 0.6)]))
    found = change(
        scene,
        compose_layers(scene, [Layer(shirt, 0.6, gains=Gains(0.5, opacity=0.0, color=2.0, texture=2.0))]),
    )
    slices = attribute_slices(whole.shape[1])
    for names, gain in ((("means", "log_scales", "quats"), 0.5), (("logit_opacities",), 0.0), (COLOR, 2.0)):
        for name in names:
            assert torch.allclose(found[:, slices[name]], gain * whole[:, slices[name]], atol=1e-6), name


def test_disabled_layers_do_nothing(scene: Gaussians, shirt: Gdf, hat: Gdf) -> None:
    assert bits(compose_layers(scene, [Layer(shirt, 0.8), Layer(hat, 1.0, enabled=False)])) == bits(
        compose_layers(scene, [Layer(shirt, 0.8)])
    )


@pytest.mark.parametrize("blend", ["normalized", "sum"])
def test_order_of_layers_does_not_matter(scene: Gaussians, shirt: Gdf, hat: Gdf, blend: str) -> None:
    layers = [Layer(shirt, 0.8), Layer(hat, 0.9)]
    a, b = (change(scene, compose_layers(scene, order, blend)) for order in (layers, layers[::-1]))
    assert torch.allclose(a, b, atol=1e-6)


def test_normalized_is_the_sum_while_strengths_total_at_most_one(
    scene: Gaussians, shirt: Gdf, hat: Gdf
) -> None:
    layers = [Layer(shirt, 0.5), Layer(hat, 0.5)]
    assert bits(compose_layers(scene, layers, "normalized")) == bits(compose_layers(scene, layers, "sum"))


def test_normalized_divides_where_strengths_total_more_than_one(
    scene: Gaussians, shirt: Gdf, hat: Gdf
) -> None:
    layers = [Layer(shirt, 1.0), Layer(hat, 0.5)]
    both = torch.tensor(np.intersect1d(shirt.region.members, hat.region.members))
    assert len(both) > 10
    summed = change(scene, compose_layers(scene, layers, "sum"))[both]
    shared = change(scene, compose_layers(scene, layers, "normalized"))[both]
    divisor = torch.ones(summed.shape[1])
    colors = attribute_slices(summed.shape[1])["sh0"]
    divisor[colors] = 1.5  # the only kind of change that both make
    assert torch.allclose(shared, summed / divisor, atol=1e-6)
    assert bool((summed[:, :3] != 0).any(dim=1).all())


def test_over_puts_changes_of_the_last_layer_on_top(scene: Gaussians, shirt: Gdf, hat: Gdf) -> None:
    both = torch.tensor(np.intersect1d(shirt.region.members, hat.region.members))
    hidden = both[coverage(scene, hat)["color"][torch.searchsorted(hat.region.members, both)] == 1]
    assert len(hidden) > 10
    stacked = compose_layers(scene, [Layer(shirt, 1.0), Layer(hat, 1.0)], "over")
    alone = compose_layers(scene, [Layer(hat, 1.0)])
    assert torch.allclose(stacked.sh0[hidden], alone.sh0[hidden], atol=1e-6)


def test_over_shows_lower_layers_where_the_last_changes_nothing(scene: Gaussians, shirt: Gdf) -> None:
    gold = compose_layers(scene, [Layer(shirt, 0.8)])
    for s in (0.3, 1.0):
        stacked = compose_layers(scene, [Layer(shirt, 0.8), Layer(striped(scene, shirt), s)], "over")
        between = shirt.region.members[::2]
        assert bits(stacked[between]) == bits(gold[between]), "between the stripes"
        for name in ATTRIBUTES:
            if name != "sh0":
                assert torch.equal(getattr(stacked, name), getattr(gold, name)), "what stripes do not move"
    stripe = shirt.region.members[1::2]
    assert torch.allclose(stacked.sh0[stripe], scene.sh0[stripe] + 1.0, atol=1e-6)


def striped(scene: Gaussians, below: Gdf) -> Gdf:
    """Return an edit that brightens every other member of the edit below by 1."""
    changes = torch.zeros(3, len(below.region), 14)
    changes[1:, 1::2, 11:14] = torch.tensor([0.5, 1.0])[:, None, None]
    field = fit_keyframes(torch.tensor([0.0, 0.5, 1.0]), changes, 2)
    return edit_of(scene, below.region.members, field, "stripes")


@pytest.mark.parametrize("dragged", [0, 1])
def test_over_is_continuous_in_either_slider(scene: Gaussians, shirt: Gdf, dragged: int) -> None:
    stripes = striped(scene, shirt)

    def at(s: float) -> torch.Tensor:
        strengths = [0.7, 0.7]
        strengths[dragged] = s
        layers = [Layer(gdf, own) for gdf, own in zip((shirt, stripes), strengths, strict=True)]
        return pack(compose_layers(scene, layers, "over"))

    largest = float((at(1.0) - at(0.0)).abs().max())
    steps = [float((at(s) - at(s - 0.01)).abs().max()) for s in (0.01, 0.02, 0.35, 0.7, 0.71, 1.0)]
    # a bent path is up to a few times as fast as a straight one
    assert max(steps) < 0.05 * largest


def test_over_hides_as_much_of_a_kind_as_its_gain(scene: Gaussians, shirt: Gdf) -> None:
    top = striped(scene, shirt)
    below = compose_layers(scene, [Layer(shirt, 1.0)])
    for gain in (0.0, 0.5):
        stacked = compose_layers(
            scene, [Layer(shirt, 1.0), Layer(top, 1.0, gains=Gains(color=gain, texture=gain))], "over"
        )
        stripe = shirt.region.members[1::2]
        expected = torch.lerp(below.sh0[stripe], scene.sh0[stripe] + 1.0, gain)
        assert torch.allclose(stacked.sh0[stripe], expected, atol=1e-6)


def test_coverage_rises_with_each_kind_of_change_and_ends_at_one(scene: Gaussians) -> None:
    changes = torch.zeros(2, 40, 14)
    changes[1, :, 0] = 0.001  # invisible in a region some units wide
    changes[1, :, 11] = torch.linspace(0, 2, 40)
    edit = edit_of(scene, torch.arange(40), fit_keyframes(torch.tensor([0.0, 1.0]), changes, 2))
    covered = coverage(scene, edit)
    assert set(covered) == {"geometry", "color"}
    assert float(covered["geometry"].max()) < 1e-3
    assert float(covered["color"][0]) == 0.0
    assert bool((covered["color"].diff() >= 0).all())
    assert bool((covered["color"][20:] == 1.0).all()), "half of the largest changes, and more"


def test_single_layer_above_strength_one_is_not_divided(scene: Gaussians, shirt: Gdf) -> None:
    assert bits(compose_layers(scene, [Layer(shirt, 1.2)])) == bits(
        compose_layers(scene, [Layer(shirt, 1.2)], "sum")
    )


@pytest.mark.parametrize("strength", [float("nan"), float("inf")])
def test_strengths_that_are_not_finite_are_refused(scene: Gaussians, shirt: Gdf, strength: float) -> None:
    with pytest.raises(ProgdfError, match="the strength of shirt is"):
        compose_layers(scene, [Layer(shirt, strength)])


def test_unknown_blend_rule_is_refused(scene: Gaussians, shirt: Gdf) -> None:
    with pytest.raises(ProgdfError, match="normalized, sum, over"):
        compose_layers(scene, [Layer(shirt)], "multiply")


@pytest.mark.parametrize(
    "weights", [torch.ones(149), torch.full((150,), 1.5), torch.full((150,), float("nan"))]
)
def test_weights_of_wrong_size_or_range_are_refused(
    scene: Gaussians, shirt: Gdf, weights: torch.Tensor
) -> None:
    with pytest.raises(ValueError, match="weights of shirt"):
        compose_layers(scene, [Layer(shirt, 0.5, weights=weights)])


def test_scene_modified_in_place_counts_as_another_scene(scene: Gaussians, shirt: Gdf) -> None:
    own = replace(scene, means=scene.means.clone())
    compose_layers(own, [Layer(shirt)])
    own.means[0] += 1.0
    with pytest.raises(ProgdfError, match="shirt was made for another scene"):
        compose_layers(own, [Layer(shirt)])


def test_edit_of_another_scene_is_refused(scene: Gaussians, shirt: Gdf) -> None:
    with pytest.raises(ProgdfError, match="shirt was made for another scene: it has 400 Gaussians"):
        compose_layers(random_gaussians(30), [Layer(shirt)])


# ---- Composer, the fast twin


@pytest.fixture(scope="module")
def wardrobe(scene: Gaussians, shirt: Gdf, hat: Gdf) -> list[Gdf]:
    """Return overlapping edits of every storage type.

    One is int8, one a single member of float32, one float16 in everything, and one int16 with SH.
    """
    channels = 14 + 9
    single = edit_of(
        scene, some_rows(scene, 1, 5), curved_field(1, 5, channels, basis_type=torch.float32), "pin"
    )
    moving = ("means", "quats", "shN")
    night = curved_field(len(scene), 6, channels, moving, basis_type=torch.float16, end_type=torch.int16)
    return [shirt, hat, single, edit_of(scene, torch.arange(len(scene)), night, "night")]


def random_stack(rng: np.random.Generator, wardrobe: list[Gdf], order: np.ndarray) -> list[Layer]:
    layers = []
    for place in order:
        gdf = wardrobe[place]
        weights = (
            torch.from_numpy(rng.random(len(gdf.region)).astype(np.float32)) if rng.random() < 0.4 else None
        )
        if weights is not None:
            weights[torch.from_numpy(rng.random(len(weights)) < 0.3)] = 0.0
        gains = Gains(*(float(gain) for gain in rng.choice([0.0, 1.0, 0.5], 4)))
        strength = float(rng.choice([0.0, 1.0, 0.5, 1.2, rng.random()]))
        layers.append(Layer(gdf, strength, bool(rng.random() < 0.9), gains, weights))
    return layers


@pytest.mark.parametrize("mixed", [False, True])
@pytest.mark.parametrize("blend", BLENDS)
def test_composer_matches_compose_through_a_random_session(
    scene: Gaussians, wardrobe: list[Gdf], blend: str, mixed: bool
) -> None:
    rng = np.random.default_rng(BLENDS.index(blend))
    composer = Composer(scene, wardrobe)
    before = pack(scene, True)
    for step in range(60):
        if step % 5 == 0:
            order = rng.permutation(4)[: rng.integers(0, 5)]
        layers = random_stack(rng, wardrobe, order)
        if mixed:
            layers = [replace(layer, blend=str(rng.choice(["", *BLENDS]))) for layer in layers]
        changes = composer.update(layers, blend)
        assert bits(composer.gaussians) == bits(compose_layers(scene, layers, blend))
        now = pack(composer.gaussians, True).clone()
        moved = (now != before).any(dim=1).nonzero()[:, 0].numpy()
        assert np.isin(moved, changes.rows).all()
        for name, columns in attribute_slices(now.shape[1]).items():
            assert name in changes.attributes or torch.equal(now[:, columns], before[:, columns])
        farthest = float((now[:, :3].double() - before[:, :3].double()).norm(dim=1).max())
        assert changes.largest_move == pytest.approx(farthest, rel=1e-5, abs=1e-7)
        before = now


@pytest.mark.parametrize("blend", BLENDS)
def test_layers_with_one_rule_are_a_stack_with_that_rule(
    scene: Gaussians, wardrobe: list[Gdf], blend: str
) -> None:
    layers = random_stack(np.random.default_rng(7), wardrobe, np.arange(4))
    own = [replace(layer, blend=blend) for layer in layers]
    expected = compose_layers(scene, layers, blend)
    for other in BLENDS:
        assert bits(compose_layers(scene, own, other)) == bits(expected)


def test_layer_over_others_hides_only_those_below(scene: Gaussians, shirt: Gdf) -> None:
    members = shirt.region.members
    flat = [
        edit_of(scene, members, curved_field(150, seed, moving=("sh0",)), str(seed)) for seed in (3, 4, 5)
    ]
    low, middle, top = (change(scene, compose_layers(scene, [Layer(gdf)], "sum"))[members] for gdf in flat)
    layers = [Layer(flat[0]), Layer(flat[1], blend="over"), Layer(flat[2])]
    found = change(scene, compose_layers(scene, layers, "sum"))[members]
    covered = coverage(scene, flat[1])["color"][:, None]
    assert torch.allclose(found, low * (1 - covered) + middle + top, atol=1e-5)


def test_averaged_layers_are_averaged_without_the_added_one(scene: Gaussians, shirt: Gdf) -> None:
    members = shirt.region.members
    flat = [
        edit_of(scene, members, curved_field(150, seed, moving=("sh0",)), str(seed)) for seed in (3, 4, 5)
    ]
    low, middle, top = (change(scene, compose_layers(scene, [Layer(gdf)], "sum"))[members] for gdf in flat)
    layers = [Layer(flat[0]), Layer(flat[1]), Layer(flat[2], blend="sum")]
    found = change(scene, compose_layers(scene, layers, "normalized"))[members]
    assert torch.allclose(found, (low + middle) / 2 + top, atol=1e-5)


@pytest.mark.parametrize("blend", BLENDS)
def test_edits_overlapping_the_dragged_edit_keep_their_share(
    scene: Gaussians, wardrobe: list[Gdf], blend: str
) -> None:
    composer = Composer(scene, wardrobe)
    weights = torch.linspace(0, 1, 120)
    for strength in (0.5, 0.6, 1.0, 0.0):
        layers = [
            Layer(wardrobe[3], 0.3),
            Layer(wardrobe[0], strength),
            Layer(wardrobe[1], 0.4, weights=weights),
            Layer(wardrobe[2], 0.8),
        ]
        composer.update(layers, blend)
        assert bits(composer.gaussians) == bits(compose_layers(scene, layers, blend))


def test_composer_does_not_modify_the_scene(scene: Gaussians, shirt: Gdf) -> None:
    before = bits(scene)
    Composer(scene, [shirt]).update([Layer(shirt, 0.5)])
    assert bits(scene) == before


def test_slider_changes_only_the_rows_of_its_own_edit(scene: Gaussians, shirt: Gdf, hat: Gdf) -> None:
    composer = Composer(scene, [shirt, hat])
    composer.update([Layer(shirt, 0.5), Layer(hat, 0.5)], "normalized")
    changes = composer.update([Layer(shirt, 0.5), Layer(hat, 0.6)], "normalized")
    assert np.array_equal(changes.rows, hat.region.members.numpy())


def test_composer_reports_nothing_if_nothing_changed(scene: Gaussians, shirt: Gdf) -> None:
    composer = Composer(scene, [shirt])
    composer.update([Layer(shirt, 0.5)])
    changes = composer.update([Layer(shirt, 0.5)])
    assert (len(changes.rows), changes.attributes, changes.largest_move) == (0, (), 0.0)


def test_color_gain_needs_no_new_depth_order(scene: Gaussians, shirt: Gdf) -> None:
    composer = Composer(scene, [shirt])
    composer.update([Layer(shirt, 0.5)])
    changes = composer.update([Layer(shirt, 0.5, gains=Gains(color=0.3))])
    assert not changes.means_moved


def test_color_edit_needs_no_new_depth_order(scene: Gaussians, hat: Gdf) -> None:
    changes = Composer(scene, [hat]).update([Layer(hat, 0.5)])
    assert changes.attributes == ("sh0",)
    assert changes.largest_move == 0.0


@pytest.mark.parametrize("count", [255, 256, 257, 700])
def test_composer_matches_compose_for_blocks_of_any_length(count: int) -> None:
    scene = random_gaussians(900, seed=count)
    edits = [
        edit_of(scene, some_rows(scene, count, 1), curved_field(count, 1), "first"),
        edit_of(scene, torch.arange(count), curved_field(count, 2, rank=3), "second"),
    ]
    composer = Composer(scene, edits)
    for layers in ([Layer(edits[0], 0.3)], [Layer(edits[0], 0.3), Layer(edits[1], 0.4)]):
        composer.update(layers)
        assert bits(composer.gaussians) == bits(compose_layers(scene, layers))


def test_composer_matches_compose_for_rows_starting_within_a_block() -> None:
    scene = random_gaussians(800, seed=8)
    low, high = (
        edit_of(scene, rows, curved_field(len(rows), 3)) for rows in torch.arange(700).split(300)[:2]
    )
    composer = Composer(scene, [low, high])
    composer.update([Layer(low, 0.3)])
    layers = [Layer(low, 0.3), Layer(high, 0.4)]
    composer.update(layers)  # rewrites only rows 300 to 599
    assert bits(composer.gaussians) == bits(compose_layers(scene, layers))


def test_attribute_with_zero_coefficients_at_a_node_adds_nothing(scene: Gaussians, shirt: Gdf) -> None:
    still = {
        name: replace(bases, coefficients=bases.coefficients.index_fill(0, torch.tensor([4]), 0.0))
        for name, bases in shirt.field.attributes.items()
    }
    edit = edit_of(scene, shirt.region.members, replace(shirt.field, attributes=still))
    layers = [Layer(edit, 0.5)]
    composer = Composer(scene, [edit])
    composer.update(layers)
    assert bits(composer.gaussians) == bits(compose_layers(scene, layers))


def test_weights_out_of_range_are_refused_while_painting(scene: Gaussians, shirt: Gdf) -> None:
    composer = Composer(scene, [shirt])
    weights = torch.ones(150)
    composer.update([Layer(shirt, 0.5, weights=weights)])
    weights[3] = 1.5
    with pytest.raises(ValueError, match="weights of shirt has a number outside"):
        composer.update([Layer(shirt, 0.5, weights=weights)])


def test_weights_painted_in_place_are_noticed(scene: Gaussians, shirt: Gdf) -> None:
    composer = Composer(scene, [shirt])
    weights = torch.ones(150)
    composer.update([Layer(shirt, 0.5, weights=weights)])
    weights[:75] = 0.25
    composer.update([Layer(shirt, 0.5, weights=weights)])
    assert bits(composer.gaussians) == bits(compose_layers(scene, [Layer(shirt, 0.5, weights=weights)]))


def test_one_thread_and_two_give_the_same_bits() -> None:
    scene = random_gaussians(40_000, seed=9)
    edit = edit_of(scene, torch.arange(40_000), curved_field(40_000, 9, moving=("means", "sh0"), rank=1))
    found = []
    try:
        for count in (1, 2):
            set_threads(count)
            composer = Composer(scene, [edit])
            composer.update([Layer(edit, 0.37)])
            found.append(bits(composer.gaussians))
    finally:
        set_threads(None)
    assert found[0] == found[1]


def test_values_that_are_not_finite_stay_in_their_row(shirt: Gdf, scene: Gaussians) -> None:
    spoiled = replace(scene, sh0=scene.sh0.index_fill(0, shirt.region.members[:1], float("nan")))
    composer = Composer(spoiled, [shirt])
    composer.update([Layer(shirt, 0.5)])
    assert composer.gaussians.sh0.isnan().any(dim=1).sum() == 1


def test_edit_without_any_change_composes(scene: Gaussians) -> None:
    still = edit_of(scene, some_rows(scene, 7), curved_field(7, moving=()))
    composer = Composer(scene, [still])
    composer.update([Layer(still, 0.5)])
    assert bits(composer.gaussians) == bits(compose_layers(scene, [Layer(still, 0.5)])) == bits(scene)


def test_composer_refuses_an_unknown_edit(scene: Gaussians, shirt: Gdf, hat: Gdf) -> None:
    with pytest.raises(ValueError, match="hat is not one of the composer's edits"):
        Composer(scene, [shirt]).update([Layer(hat, 0.5)])


def test_every_attribute_has_a_gain(scene: Gaussians) -> None:
    everything = curved_field(len(scene), 1, 14 + 9)
    edit = edit_of(scene, torch.arange(len(scene)), everything)
    mute = compose_layers(scene, [Layer(edit, 0.5, gains=Gains(0.0, 0.0, 0.0, 0.0))])
    assert set(everything.attributes) == set(ATTRIBUTES)
    assert bits(mute) == bits(scene)


def graded(
    scene: Gaussians, members: torch.Tensor, darker: float, residual: bool = True, masked: bool = False
) -> Gdf:
    """Return an edit that darkens all colors of some rows and changes those of single rows a little.

    With a mask, each row takes another share.
    """
    knots = torch.tensor([0.0, 0.5, 1.0])
    table = torch.stack([identity_map(1) * torch.tensor(1.0 - darker * float(s)) for s in knots])
    residuals = torch.zeros(3, len(members), 3)
    if residual:
        residuals[1:] = 0.1 * torch.rand(2, len(members), 3, generator=torch.Generator().manual_seed(3))
    mask = torch.arange(len(members)).to(torch.uint8) if masked else None
    form = fit_grade(knots, 1, table, residuals, int(residual), torch.ones(len(members)), mask)
    rows = pack(scene[members], with_shN=scene.sh_degree > 0)
    return edit_of(scene, members, bake_grade(form, rows), "dark")


@pytest.mark.parametrize("strength", [0.0, 0.3, 1.0])
def test_adjust_maps_the_colors_of_the_layers_below(scene: Gaussians, shirt: Gdf, strength: float) -> None:
    dark = graded(scene, shirt.region.members, 0.6, residual=False)
    below = compose_layers(scene, [Layer(shirt, 1.0)])
    both = compose_layers(scene, [Layer(shirt, 1.0), Layer(dark, strength)], "adjust")
    rows = shirt.region.members
    table = identity_map(1) * (1.0 - 0.6 * strength)
    expected = map_colors(below.sh[rows], table, 1)
    torch.testing.assert_close(both.sh[rows], expected, atol=2e-6, rtol=0)
    if strength == 0.0:
        assert bits(both) == bits(below)


def test_adjust_on_the_original_is_the_trained_edit_and_keeps_weights(scene: Gaussians, shirt: Gdf) -> None:
    dark = graded(scene, shirt.region.members, 0.6)
    alone = compose_layers(scene, [Layer(dark, 0.7)])
    assert bits(compose_layers(scene, [Layer(dark, 0.7)], "adjust")) == bits(alone)
    elsewhere = graded(scene, torch.arange(len(scene))[-1:], 0.5)
    side = compose_layers(scene, [Layer(elsewhere, 1.0), Layer(dark, 0.7)], "adjust")
    rows = shirt.region.members[shirt.region.members < len(scene) - 1]
    assert torch.equal(side.sh[rows], alone.sh[rows])
    nothing = torch.zeros(len(shirt.region))
    unpainted = compose_layers(scene, [Layer(shirt, 1.0), Layer(dark, 1.0, weights=nothing)], "adjust")
    assert bits(unpainted) == bits(compose_layers(scene, [Layer(shirt, 1.0)]))


def test_adjust_maps_lower_layers_by_the_share_of_the_mask(scene: Gaussians, shirt: Gdf) -> None:
    rows = shirt.region.members
    dark = graded(scene, rows, 0.6, residual=False, masked=True)
    below = compose_layers(scene, [Layer(shirt, 1.0)])
    both = compose_layers(scene, [Layer(shirt, 1.0), Layer(dark, 1.0)], "adjust")
    share = (torch.arange(len(rows)) % 256)[:, None, None] / 255
    expected = torch.lerp(below.sh[rows], map_colors(below.sh[rows], identity_map(1) * 0.4, 1), share)
    torch.testing.assert_close(both.sh[rows], expected, atol=2e-6, rtol=0)


def test_adjust_depends_on_the_order_of_layers(scene: Gaussians, shirt: Gdf) -> None:
    dark = graded(scene, shirt.region.members, 0.9)
    above = compose_layers(scene, [Layer(shirt, 1.0), Layer(dark, 1.0)], "adjust")
    below = compose_layers(scene, [Layer(dark, 1.0), Layer(shirt, 1.0)], "adjust")
    assert not torch.equal(above.sh0, below.sh0)


def test_adjust_overlays_the_residual_of_a_pattern_grade(scene: Gaussians, shirt: Gdf) -> None:
    rows = torch.arange(len(scene))
    dark = compose_layers(scene, [Layer(graded(scene, rows, 0.6, residual=False))])
    knots = torch.tensor([0.0, 1.0])
    table = identity_map(1)
    halfway = table + 0.5 * (torch.tensor([[0.1, 0.3, 0.9]] + [[0.0] * 3] * 3) - table)
    mapped = map_colors(scene.sh, halfway, 1) - scene.sh
    residual = torch.zeros(2, len(scene), 12)
    residual[1] = torch.where(rows[:, None] % 2 == 0, -1.0, 1.0) * mapped.flatten(1)
    form = fit_grade(knots, 1, torch.stack([table, halfway]), residual, 1, torch.ones(len(scene)))
    stripes = edit_of(scene, rows, bake_grade(form, pack(scene, True)), "stripes")
    assert float(coverage(scene, stripes)["map"].mean()) < 0.1, "half of it is undone, the other half doubled"
    layers = [Layer(graded(scene, rows, 0.6, residual=False)), Layer(stripes)]
    both = compose_layers(scene, layers, "adjust")
    alone = compose_layers(scene, [Layer(stripes)])
    between = rows[::2]
    far = coverage(scene, stripes)["color"] == 1.0
    assert float((both.sh0 - dark.sh0)[between].abs().mean()) < 0.1
    assert torch.allclose(both.sh0[far], alone.sh0[far], atol=0.1)
    assert int(far.sum()) > 50


def test_grades_without_common_rows_use_the_fast_path_of_adjust(
    scene: Gaussians, hat: Gdf, monkeypatch: pytest.MonkeyPatch
) -> None:
    halves = [graded(scene, half, 0.6) for half in torch.arange(len(scene)).split(len(scene) // 2)]
    composer = Composer(scene, [*halves, hat])
    monkeypatch.setattr(composer, "_write_plainly", None)
    for stack in ([Layer(halves[1], 0.3), Layer(halves[0], 0.8)], [Layer(halves[1], 0.3), Layer(hat, 0.5)]):
        composer.update(stack, "adjust")
        assert bits(composer.gaussians) == bits(compose_layers(scene, stack, "adjust"))
    with pytest.raises(TypeError):
        composer.update([Layer(hat, 0.5), Layer(halves[1], 0.3)], "adjust")


@pytest.mark.parametrize("masked", [False, True])
def test_composer_adjusts_like_compose(scene: Gaussians, shirt: Gdf, hat: Gdf, masked: bool) -> None:
    dark = graded(scene, shirt.region.members, 0.6, masked=masked)
    composer = Composer(scene, [shirt, hat, dark])
    for stack in (
        [Layer(shirt, 0.4), Layer(hat, 1.0), Layer(dark, 0.3)],
        [Layer(shirt, 1.0), Layer(dark, 1.0), Layer(hat, 0.2)],
        [Layer(dark, 0.8)],
        [Layer(shirt, 1.0), Layer(dark, 1.2, gains=Gains(color=0.5))],
        [],
    ):
        composer.update(stack, "adjust")
        assert bits(composer.gaussians) == bits(compose_layers(scene, stack, "adjust"))


def test_composer_adjusts_with_foreign_grades_and_tables_like_compose(
    scene: Gaussians, shirt: Gdf, hat: Gdf
) -> None:
    table = torch.rand(125, 3, generator=torch.Generator().manual_seed(5))
    field = BakedField("grade", torch.tensor([0.0, 1.0]), {}, 14, (), lattice_form(table))
    look = edit_of(scene, torch.zeros(0, dtype=torch.int64), field)
    above = apply_grade(look, scene, from_mask("some", torch.arange(len(scene)) % 2 == 0))
    other = random_gaussians(60, seed=8)
    below = apply_grade(graded(other, torch.arange(60), 0.5), scene, whole_scene(scene))
    composer = Composer(scene, [shirt, hat, above, below])
    weights = torch.linspace(0, 1, len(above.region))
    for stack in (
        [Layer(shirt, 1.0), Layer(above, 1.0), Layer(hat, 0.7)],
        [Layer(below, 1.0), Layer(shirt, 0.3), Layer(above, 0.6, weights=weights)],
        [Layer(above, 0.6), Layer(below, 1.0)],
        [Layer(shirt, 1.0), Layer(below, 0.4, gains=Gains(color=0.5)), Layer(above, 1.2)],
        [Layer(above, 0.5)],
    ):
        for blend in BLENDS:
            composer.update(stack, blend)
            assert bits(composer.gaussians) == bits(compose_layers(scene, stack, blend)), blend
    orders = [
        compose_layers(scene, [Layer(a), Layer(b)], "adjust") for a, b in ((above, below), (below, above))
    ]
    assert not torch.equal(orders[0].sh0, orders[1].sh0)
    both = compose_layers(scene, [Layer(below, 1.0), Layer(above, 1.0)], "adjust")
    once = compose_layers(scene, [Layer(below, 1.0)])
    rows = above.region.members
    expected = map_colors(once.sh[rows], table, 0)
    torch.testing.assert_close(both.sh[rows], expected, atol=2e-6, rtol=0)
    weak = compose_layers(scene, [Layer(below), Layer(above, 0.6)], "adjust").sh[rows]
    torch.testing.assert_close(weak, torch.lerp(once.sh[rows], expected, 0.6), atol=2e-6, rtol=0)
