"""Tests of moves that carry the changes and the added rows of other layers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import safetensors.torch
import torch
from torch import Tensor

from progdf.compose.composer import Composer
from progdf.compose.layers import BLENDS, Gains, Layer
from progdf.compose.parents import carrier
from progdf.compose.parents.rest import rest_frame
from progdf.compose.reference import compose_layers
from progdf.errors import ProgdfError
from progdf.field.separable import fit_keyframes
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import Gdf, anchor_added, load_gdf, save_gdf
from progdf.quaternions import normalize_quats, rotation_matrices
from progdf.region import Region, from_mask, whole_scene
from progdf.similarity import AffineMotion, affine_motion, transform_rows
from progdf.tidy import Step, leave_paint, mirror, similarity, tidy
from tests.helpers.draws import Draws
from tests.helpers.edits import bits, curved_field, edit_of, growing, painted, some_rows
from tests.helpers.fuzz_changes import header_of, signed_gdf
from tests.helpers.scenes import random_gaussians

COUNT = 200
SHIFT = (1.0, -2.0, 0.5)
TURN = (0.3, -0.2, 0.9)
PIVOT = torch.tensor([0.2, 0.1, -0.3], dtype=torch.float64)
STRETCH = torch.diag(torch.tensor([1.8, 1.0, 0.6], dtype=torch.float64))

MOTIONS = {
    "turn and scale": replace(similarity(SHIFT, TURN, 1.5), pivot=PIVOT),
    "mirror": replace(mirror(1), pivot=PIVOT),
    "stretch": affine_motion(STRETCH, torch.tensor(SHIFT), PIVOT),
    "turn and mirror": replace(similarity(SHIFT, TURN, 1.2), mirror=2, pivot=PIVOT),
}


@pytest.fixture(scope="module")
def scene() -> Gaussians:
    return random_gaussians(COUNT, seed=5, sh_degree=2)


def move_of(scene: Gaussians, motion: AffineMotion, region: Region | None = None) -> Gdf:
    return tidy(scene, [Step("transform", region or whole_scene(scene), motion)], "move")


def child_of(scene: Gaussians, seed: int = 2) -> Gdf:
    """Return an edit of geometry and of all colors."""
    channels = 14 + 3 * scene.shN.shape[1]
    attributes = ("means", "log_scales", "quats", "sh0", "shN")
    return edit_of(scene, some_rows(scene, 90, seed), curved_field(90, seed, channels, attributes), "child")


def covariances(gaussians: Gaussians) -> Tensor:
    axes = rotation_matrices(normalize_quats(gaussians.quats.double()))
    half = axes * gaussians.log_scales.double().exp()[:, None]
    return half @ half.mT


def check_same(found: Gaussians, expected: Gaussians, error: float = 3e-3) -> None:
    """Compare two scenes; a move is stored in 16 bits, and straight between its knots."""
    torch.testing.assert_close(found.means, expected.means, atol=error, rtol=0)
    size = covariances(expected).flatten(1).norm(dim=1)[:, None, None]
    torch.testing.assert_close(covariances(found) / size, covariances(expected) / size, atol=error, rtol=0)
    torch.testing.assert_close(found.shN, expected.shN, atol=error, rtol=0)
    assert torch.equal(found.logit_opacities, expected.logit_opacities)
    assert torch.equal(found.sh0, expected.sh0)


@pytest.mark.parametrize("order", ["below", "above"])
@pytest.mark.parametrize("strength", [0.4, 1.0])
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_move_acts_on_the_scene_that_its_children_edit(
    scene: Gaussians, motion: AffineMotion, strength: float, order: str
) -> None:
    children = [Layer(child_of(scene), strength), Layer(painted(scene, 20, 9), strength)]
    edited = compose_layers(scene, children, "sum")
    rows = transform_rows(pack(edited, True).double(), motion)
    expected = edited.replace_rows(torch.arange(len(edited)), rows)
    move = Layer(move_of(scene, motion), 1.0)
    stack = [*children, move] if order == "below" else [move, *children]
    zeros = [Layer(children[0].gdf, 0.0), Layer(children[1].gdf, 0.0)]
    found = compose_layers(scene, [*zeros, *stack], "sum")
    check_same(found, expected)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_children_follow_half_way_like_the_scene(scene: Gaussians, motion: AffineMotion) -> None:
    child = Layer(child_of(scene), 1.0)
    edited = compose_layers(scene, [child])
    rows = transform_rows(pack(edited, True).double(), motion, 0.25)
    expected = edited.replace_rows(torch.arange(len(edited)), rows)
    check_same(compose_layers(scene, [child, Layer(move_of(scene, motion), 0.25)]), expected, 0.03)


@pytest.mark.parametrize("blend", BLENDS)
@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_strength_zero_of_parent_or_child_is_exact(
    scene: Gaussians, motion: AffineMotion, blend: str
) -> None:
    child = child_of(scene)
    logo = painted(scene, 20, 9)
    move = move_of(scene, motion)
    alone = compose_layers(scene, [Layer(child, 0.7), Layer(logo, 0.7)], blend)
    with_parent = [Layer(child, 0.7), Layer(logo, 0.7), Layer(move, 0.0)]
    assert bits(compose_layers(scene, with_parent, blend)) == bits(alone)
    moved = compose_layers(scene, [Layer(move, 0.6)], blend)
    with_child = [Layer(child, 0.0), Layer(logo, 0.0), Layer(move, 0.6)]
    assert bits(compose_layers(scene, with_child, blend)[:COUNT]) == bits(moved)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_members_move_in_small_parts_with_the_same_bits(
    scene: Gaussians, motion: AffineMotion, monkeypatch: pytest.MonkeyPatch
) -> None:
    gdfs = [child_of(scene), painted(scene, 20, 9), move_of(scene, motion)]
    layers = [Layer(gdf, 0.7) for gdf in gdfs]
    found = []
    for members in (COUNT, 7):
        monkeypatch.setattr(carrier, "_CHUNK_MEMBERS", members)
        composer = Composer(scene, gdfs)
        composer.update(layers)
        found.append(bits(composer.gaussians))
    assert found[0] == found[1]


@pytest.mark.parametrize("blend", BLENDS)
def test_composer_carries_like_compose_and_reports_every_change(scene: Gaussians, blend: str) -> None:
    draws = Draws(3)
    half = from_mask("half", scene.means[:, 0] > 0)
    other = from_mask("other", scene.means[:, 1] > 0)
    gdfs = [
        painted(scene, 20, 9),
        anchor_added(growing(scene, some_rows(scene, 40, 1), 15, 7), scene),
        move_of(scene, MOTIONS["turn and scale"], half),
        move_of(scene, MOTIONS["mirror"], other),
        leave_paint(move_of(scene, similarity(SHIFT), other)),
        tidy(scene, [Step("transform", half, MOTIONS["turn and scale"]), Step("remove", other)], "both"),
        child_of(scene),
    ]
    composer = Composer(scene, gdfs)
    for _ in range(60):
        layers = [
            Layer(
                gdfs[i],
                float(draws.uniform(1)) * 1.2,
                enabled=float(draws.uniform(1)) < 0.6,
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
        torch.testing.assert_close(after, plain, atol=1e-5, rtol=1e-5)
        changed = (after != before).any(dim=1).nonzero()[:, 0].tolist()
        assert set(changed) <= set(change.rows.tolist())
        steps = (after - before)[:, :3].norm(dim=1)
        assert float(steps.max()) <= change.largest_move + 1e-5


def test_sliders_in_any_order_give_the_same_bits(scene: Gaussians) -> None:
    gdfs = [child_of(scene), painted(scene, 20, 9), move_of(scene, MOTIONS["stretch"])]
    strengths = [0.4, 0.9, 0.7]
    found = []
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        composer = Composer(scene, gdfs)
        now = [0.0, 0.0, 0.0]
        for edit in order:
            now[edit] = strengths[edit]
            composer.update([Layer(gdf, s) for gdf, s in zip(gdfs, now, strict=True)])
        found.append(bits(composer.gaussians))
    assert found[0] == found[1] == found[2]


def test_upper_move_acts_on_the_lower_one(scene: Gaussians) -> None:
    first = replace(similarity(SHIFT), pivot=PIVOT)
    second = MOTIONS["turn and scale"]
    rows = transform_rows(transform_rows(pack(scene, True).double(), first), second)
    expected = scene.replace_rows(torch.arange(COUNT), rows)
    check_same(compose_layers(scene, [Layer(move_of(scene, first)), Layer(move_of(scene, second))]), expected)


def test_moved_file_keeps_its_motions(scene: Gaussians, tmp_path: Path) -> None:
    half = from_mask("half", scene.means[:, 0] > 0)
    steps = [Step("transform", half, MOTIONS["stretch"]), Step("transform", whole_scene(scene), mirror(0))]
    move = tidy(scene, steps, "move")
    save_gdf(tmp_path / "move.gdf", move)
    loaded = load_gdf(tmp_path / "move.gdf", scene)
    layers = [Layer(child_of(scene), 1.0), Layer(painted(scene, 20, 9), 1.0)]
    found = compose_layers(scene, [*layers, Layer(loaded, 0.8)])
    assert bits(found) == bits(compose_layers(scene, [*layers, Layer(move, 0.8)]))


def test_damaged_motions_are_refused(scene: Gaussians, tmp_path: Path) -> None:
    path = tmp_path / "move.gdf"
    save_gdf(path, move_of(scene, MOTIONS["mirror"]))
    content = path.read_bytes()
    header = header_of(content)
    header["motions"][0][0]["mirror"] = 5
    path.write_bytes(signed_gdf(header, safetensors.torch.load(content)))
    with pytest.raises(ProgdfError, match="axis 5 is mirrored"):
        load_gdf(path, scene)


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_change_on_screen_becomes_a_child_of_the_moves(scene: Gaussians, motion: AffineMotion) -> None:
    half = from_mask("half", scene.means[:, 0] > 0)
    stack = [Layer(move_of(scene, motion, half), 0.9), Layer(move_of(scene, MOTIONS["turn and scale"], half))]
    members = some_rows(scene, 60, 4)
    child = edit_of(scene, members, curved_field(60, 4, 14 + 3 * scene.shN.shape[1]), "pull")
    offsets = 0.3 * child.field.offsets(1.0)
    offsets[:, 10:14] = 0.0
    shown = compose_layers(scene, stack)
    wanted = shown.replace_rows(members, pack(shown[members], True) + offsets)
    frame = rest_frame(scene, stack, "adjust", members)
    assert frame is not None
    rest = fit_keyframes(torch.tensor([0.0, 1.0]), torch.stack([0 * offsets, frame.offsets(offsets)]), 2)
    pull = replace(child, field=rest, adds=True)
    check_same(compose_layers(scene, [*stack, Layer(pull)]), wanted)


def test_shifts_need_no_rest_frame(scene: Gaussians) -> None:
    stack = [Layer(move_of(scene, similarity(SHIFT)), 0.9)]
    assert rest_frame(scene, stack, "adjust", torch.arange(COUNT)) is None
    assert rest_frame(scene, [], "adjust", torch.arange(COUNT)) is None
