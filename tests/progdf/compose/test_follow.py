"""Tests of added rows that follow the surface below them when other edits change it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from progdf.cli import rebind
from progdf.compose.composer import Composer
from progdf.compose.layers import BLENDS, Gains, Layer
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians, pack
from progdf.gdf.anchors import Anchors, choose_anchors
from progdf.gdf.file import UNSEEN_LOGIT, Gdf, anchor_added, load_gdf, save_gdf
from progdf.quaternions import multiply_quats, rotate_vectors, turn_quats
from progdf.region import from_mask, whole_scene
from progdf.sh import rotation_change
from progdf.tidy import Step, similarity, tidy
from tests.helpers.draws import Draws
from tests.helpers.edits import added_rows, bits, curved_field, edit_of, growing, painted, some_rows
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.scenes import random_gaussians
from viewer.state.facts import describe_loaded

COUNT = 300
DISCS = 25
SHIFT = (1.0, -2.0, 0.5)
TURN = (0.3, -0.2, 0.5)


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(COUNT, seed=5, sh_degree=1)


@pytest.fixture(scope="module")
def logo(scene: Gaussians) -> Gdf:
    return painted(scene, DISCS, 9)


def moved(scene: Gaussians, shift: Any = SHIFT, turn: Any = TURN, scale: float = 1.5) -> Gdf:
    motion = similarity(shift, turn, scale)
    return tidy(scene, [Step("transform", whole_scene(scene), motion)], "move")


def removed(scene: Gaussians, mask: Tensor | None = None) -> Gdf:
    region = whole_scene(scene) if mask is None else from_mask("part", mask)
    return tidy(scene, [Step("remove", region)], "remove")


def opaque_rows() -> Gaussians:
    return replace(added_rows(DISCS, 9), logit_opacities=torch.full((DISCS,), 3.0))


def without_following(gdf: Gdf) -> Gdf:
    anchors = gdf.anchors
    if anchors is None:
        return gdf
    return replace(gdf, anchors=replace(anchors, weights=torch.zeros_like(anchors.weights)))


@pytest.mark.parametrize("blend", BLENDS)
@settings(max_examples=20)
@given(
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-1.5, 1.5)] * 3),
    st.floats(0.5, 2.0),
    st.sampled_from([0.3, 1.0]),
)
def test_paint_makes_the_same_motion_as_the_object(
    blend: str, shift: tuple[float, ...], turn: tuple[float, ...], scale: float, strength: float
) -> None:
    scene = random_gaussians(60, seed=5)
    logo = painted(scene, 8, 9, pushed=10)
    move = moved(scene, shift, turn, scale)
    alone = compose_layers(scene, [Layer(logo, strength)])
    both = compose_layers(scene, [Layer(move, 1.0), Layer(logo, strength)], blend)
    center = scene.means.double().mean(dim=0)
    quat = turn_quats(torch.tensor([turn], dtype=torch.float64))
    arm = scale * rotate_vectors(alone.means.double() - center, quat.expand(len(alone), 4))
    expected = center + torch.tensor(shift) + arm
    # a move is stored in 16 bits
    torch.testing.assert_close(both.means.double(), expected, atol=2e-3, rtol=0)
    turned = multiply_quats(quat.expand(len(alone), 4), alone.quats.double())
    torch.testing.assert_close(both.quats.double(), turned, atol=2e-3, rtol=0)
    grown = alone.log_scales.double() + np.log(scale)
    torch.testing.assert_close(both.log_scales.double(), grown, atol=2e-3, rtol=0)
    assert torch.equal(both.logit_opacities, alone.logit_opacities)


@pytest.mark.parametrize("blend", BLENDS)
def test_removal_fades_paint_to_nothing_with_the_object(scene: Gaussians, logo: Gdf, blend: str) -> None:
    remove = removed(scene)
    full = compose_layers(scene, [Layer(logo, 1.0)]).opacities[COUNT:]
    for strength in (0.25, 0.5, 0.75):
        half = compose_layers(scene, [Layer(logo, 1.0), Layer(remove, strength)], blend)
        torch.testing.assert_close(
            half.opacities[COUNT:] / full, torch.full((DISCS,), 1 - strength), atol=0.03, rtol=0
        )
    gone = compose_layers(scene, [Layer(logo, 1.0), Layer(remove, 1.0)], blend)
    assert bool((gone.logit_opacities < UNSEEN_LOGIT).all())


@pytest.mark.parametrize("blend", BLENDS)
def test_paint_is_unchanged_without_changes_of_shape_below(scene: Gaussians, logo: Gdf, blend: str) -> None:
    tint = edit_of(scene, some_rows(scene, 120, 2), curved_field(120, 2, moving=("sh0",)), "tint")
    other = painted(scene, 10, 12, "heart")
    stack = [Layer(logo, 0.8), Layer(tint, 0.7), Layer(other, 1.0)]
    plain = [replace(layer, gdf=without_following(layer.gdf)) for layer in stack]
    assert bits(compose_layers(scene, stack, blend)) == bits(compose_layers(scene, plain, blend))


@pytest.mark.parametrize("blend", BLENDS)
def test_paint_elsewhere_is_unchanged(scene: Gaussians, logo: Gdf, blend: str) -> None:
    anchors = logo.anchors
    assert anchors is not None
    far = torch.ones(COUNT, dtype=torch.bool)
    far[anchors.rows.unique()] = False
    far[logo.region.members] = False
    with_removal = compose_layers(scene, [Layer(logo, 1.0), Layer(removed(scene, far), 1.0)], blend)
    alone = compose_layers(scene, [Layer(logo, 1.0)], blend)
    assert bits(with_removal[COUNT:]) == bits(alone[COUNT:])


@pytest.mark.parametrize("blend", BLENDS)
def test_strength_zero_of_everything_is_the_original(scene: Gaussians, logo: Gdf, blend: str) -> None:
    layers = [Layer(logo, 0.0), Layer(moved(scene), 0.0), Layer(removed(scene), 0.0)]
    assert bits(compose_layers(scene, layers, blend)[:COUNT]) == bits(scene)


@pytest.mark.parametrize("blend", ["normalized", "sum"])
def test_order_of_paint_and_move_does_not_matter(scene: Gaussians, logo: Gdf, blend: str) -> None:
    layers = [Layer(logo, 0.9), Layer(moved(scene), 0.6)]
    back = [Layer(logo, 0.0), *layers[::-1]]
    assert bits(compose_layers(scene, layers, blend)) == bits(compose_layers(scene, back, blend))


def test_copy_follows_nothing_and_fill_follows_the_rest(scene: Gaussians) -> None:
    cut = from_mask("cut", torch.arange(COUNT) < 40)
    copy = tidy(scene, [Step("duplicate", cut, similarity(SHIFT))], "copy")
    assert copy.anchors is None
    steps = [Step("remove", cut), Step("duplicate", cut, similarity(SHIFT))]
    both = tidy(scene, steps, "both", added=opaque_rows())
    anchors = both.anchors
    assert anchors is not None
    assert anchors.free == 40
    assert not anchors.pushes
    weighted = anchors.rows[:DISCS][anchors.weights[:DISCS] > 1e-3]
    assert not bool(torch.isin(weighted, cut.members).any()), "a removed row holds nothing"
    alone = compose_layers(scene, [Layer(both, 1.0)])
    gone = compose_layers(scene, [Layer(both, 1.0), Layer(removed(scene), 1.0)])
    assert bool((alone.logit_opacities[COUNT:] > UNSEEN_LOGIT).any())
    assert bool((gone.logit_opacities[COUNT : COUNT + DISCS] < UNSEEN_LOGIT).all())
    assert bits(gone[COUNT + DISCS :]) == bits(alone[COUNT + DISCS :])


@pytest.mark.parametrize("blend", BLENDS)
def test_composer_follows_like_compose_and_reports_every_change(scene: Gaussians, blend: str) -> None:
    draws = Draws(3)
    half = scene.means[:, 0] > 0
    gdfs = [
        painted(scene, 20, 9),
        anchor_added(growing(scene, some_rows(scene, 40, 1), DISCS, 7), scene),
        tidy(scene, [Step("transform", from_mask("half", half), similarity(SHIFT, TURN, 0.7))], "move"),
        removed(scene, scene.means[:, 1] > 0.3),
        painted(scene, 15, 12, "heart"),
        edit_of(scene, some_rows(scene, 90, 2), curved_field(90, 2), "shirt"),
    ]
    composer = Composer(scene, gdfs)
    followed = 0
    for _ in range(60):
        layers = [
            Layer(
                gdfs[i],
                float(draws.uniform(1)) * 1.2,
                enabled=float(draws.uniform(1)) < 0.7,
                gains=Gains(*draws.uniform(4).tolist()) if float(draws.uniform(1)) < 0.3 else Gains(),
                weights=draws.uniform(gdfs[i].members) if float(draws.uniform(1)) < 0.4 else None,
            )
            for i in draws.order(len(gdfs)).tolist()
        ]
        before = pack(composer.gaussians, True)
        change = composer.update(layers, blend)
        after = pack(composer.gaussians, True)
        none = [Layer(gdf, 0.0) for gdf in gdfs]
        plain = pack(compose_layers(scene, [*none, *layers], blend), True)
        torch.testing.assert_close(after, plain, atol=1e-6, rtol=1e-6)
        still = [replace(layer, gdf=without_following(layer.gdf)) for layer in [*none, *layers]]
        followed += not torch.equal(plain, pack(compose_layers(scene, still, blend), True))
        changed = (after != before).any(dim=1).nonzero()[:, 0].tolist()
        assert set(changed) <= set(change.rows.tolist())
        steps = (after - before)[:, :3].norm(dim=1)
        assert float(steps.max()) <= change.largest_move + 1e-5
    assert followed > 20


def test_bands_of_grown_rows_turn_with_the_object() -> None:
    scene = random_gaussians(COUNT, seed=5, sh_degree=3)
    added = replace(opaque_rows(), shN=Draws(4).normal(DISCS, 15, 3))
    empty = from_mask("none", torch.zeros(COUNT, dtype=torch.bool))
    hat = tidy(scene, [Step("remove", empty)], "hat", added=added)
    layers = [Layer(hat, 1.0), Layer(moved(scene), 1.0)]
    turn = turn_quats(torch.tensor([TURN], dtype=torch.float64)).expand(DISCS, 4)
    expected = added.shN.double() + rotation_change(added.shN.double(), turn)
    both = compose_layers(scene, layers)
    # a move is stored in 16 bits
    torch.testing.assert_close(both.shN[COUNT:].double(), expected, atol=2e-3, rtol=0)
    composer = Composer(scene, [hat, moved(scene)])
    composer.update([Layer(hat, 1.0)])
    assert torch.equal(composer.gaussians.shN[COUNT:], added.shN)
    composer = Composer(scene, [layer.gdf for layer in layers])
    change = composer.update(layers)
    assert "shN" in change.attributes
    torch.testing.assert_close(composer.gaussians.shN, both.shN, atol=1e-6, rtol=1e-6)
    composer.update([layers[0], replace(layers[1], strength=0.0)])
    assert torch.equal(composer.gaussians.shN[COUNT:], added.shN)


def test_dragging_the_paint_needs_no_new_depth_order(scene: Gaussians) -> None:
    empty = from_mask("none", torch.zeros(COUNT, dtype=torch.bool))
    still = tidy(scene, [Step("remove", empty)], "fill", added=opaque_rows())
    move = moved(scene)
    composer = Composer(scene, [still, move])
    composer.update([Layer(still, 0.5), Layer(move, 0.5)])
    assert not composer.update([Layer(still, 0.6), Layer(move, 0.5)]).means_moved
    assert composer.update([Layer(still, 0.6), Layer(move, 0.6)]).means_moved


def test_anchors_lie_on_the_surface_below() -> None:
    wall = torch.cartesian_prod(torch.linspace(-1, 1, 21), torch.linspace(-1, 1, 21), torch.zeros(1))
    dust = torch.cartesian_prod(torch.linspace(-1, 1, 21), torch.linspace(-1, 1, 21), torch.tensor([0.02]))
    behind = wall + torch.tensor([0.0, 0.0, -0.5])
    base = random_gaussians(3 * 441, seed=1)
    logits = torch.cat([torch.full((441,), 4.0), torch.full((441,), -5.0), torch.full((441,), 4.0)])
    scene = replace(
        base,
        means=torch.cat([wall, dust, behind]),
        logit_opacities=logits,
        log_scales=torch.full((1323, 3), -3.0),
    )
    places = torch.tensor([[0.03, 0.02, 0.01], [0.96, -0.97, 0.0]])
    anchors = choose_anchors(scene, places, UNSEEN_LOGIT)
    on_wall = (anchors.rows < 441).float()
    assert float((anchors.weights * on_wall).sum(dim=1).min()) > 0.97
    mean = (anchors.weights[..., None] * scene.means[anchors.rows]).sum(dim=1)
    assert float((mean - places).norm(dim=1).max()) < 0.06


def test_anchors_are_saved_and_older_files_get_them_on_load(
    scene: Gaussians, logo: Gdf, tmp_path: Path
) -> None:
    path = tmp_path / "logo.gdf"
    save_gdf(path, replace(logo, report={"paint": {}}))
    loaded = load_gdf(path, scene)
    assert loaded.anchors is not None
    assert logo.anchors is not None
    assert torch.equal(loaded.anchors.rows, logo.anchors.rows)
    assert torch.equal(loaded.anchors.weights, logo.anchors.weights)
    assert loaded.anchors.pushes
    assert not loaded.anchors_found
    header = header_of(path.read_bytes())
    tensors = safetensors.torch.load(path.read_bytes())
    old: dict[str, Any] = {k: v for k, v in header.items() if k not in ("anchored", "pushes")}
    kept = {k: v for k, v in tensors.items() if not k.startswith("anchors.")}
    path.write_bytes(signed_gdf({**old, "format": 7}, kept))
    found = load_gdf(path, scene)
    assert found.anchors_found
    assert found.anchors is not None
    assert torch.equal(found.anchors.rows, logo.anchors.rows)
    assert found.anchors.pushes
    assert "added Gaussian" in describe_loaded(found)
    recolored = edit_of(scene, some_rows(scene, 90, 2), curved_field(90, 2))
    assert describe_loaded(replace(recolored, anchors_found=True)) == ""
    path.write_bytes(signed_gdf({**old, "format": 7, "report": {}}, kept))
    assert load_gdf(path, scene).anchors is None, "an edit without a report is a copy"


@pytest.mark.parametrize(
    "change",
    [
        {"anchors.rows": torch.full((DISCS, 4), COUNT, dtype=torch.int32)},
        {"anchors.rows": torch.full((DISCS, 4), -1, dtype=torch.int32)},
        {"anchors.rows": torch.zeros(DISCS, 3, dtype=torch.int32)},
        {"anchors.weights": torch.full((DISCS, 4), 0.3)},
        {"anchors.weights": torch.full((DISCS, 4), float("nan"))},
        {"anchors.weights": torch.tensor([[2.0, -1.0, 0.0, 0.0]]).repeat(DISCS, 1)},
        {"anchors.weights": torch.full((DISCS, 4), 0.25, dtype=torch.float64)},
    ],
)
def test_invalid_anchors_are_refused(
    scene: Gaussians, logo: Gdf, tmp_path: Path, change: dict[str, Tensor]
) -> None:
    path = tmp_path / "logo.gdf"
    save_gdf(path, logo)
    content = path.read_bytes()
    path.write_bytes(signed_gdf(header_of(content), {**safetensors.torch.load(content), **change}))
    with pytest.raises(ProgdfError, match=r"logo\.gdf is inconsistent"):
        load_gdf(path, scene)


def test_anchors_of_another_number_of_rows_are_refused(logo: Gdf) -> None:
    few = Anchors(torch.zeros(3, 4, dtype=torch.int64), torch.full((3, 4), 0.25))
    with pytest.raises(ValueError, match="3 added rows have anchors"):
        replace(logo, anchors=few)


def test_rebind_anchors_paint_in_the_other_file(scene: Gaussians, logo: Gdf, tmp_path: Path) -> None:
    order = Draws(2).order(COUNT)
    save_ply(tmp_path / "a.ply", scene)
    save_ply(tmp_path / "b.ply", scene[order])
    save_gdf(tmp_path / "logo.gdf", logo)
    paths = [f"--from={tmp_path / 'a.ply'}", f"--to={tmp_path / 'b.ply'}"]
    rebind.main([str(tmp_path / "logo.gdf"), *paths, "-o", str(tmp_path / "new.gdf")])
    rebound = load_gdf(tmp_path / "new.gdf", scene[order])
    assert rebound.anchors is not None
    assert logo.anchors is not None
    assert torch.equal(order[rebound.anchors.rows], logo.anchors.rows)
