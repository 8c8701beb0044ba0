"""Placed scenes and their edits: the similarity of a composed scene is the composition of the placed one."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.demo_scenes import bear
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, ZERO, Gaussians, pack
from progdf.gdf.file import Gdf, fingerprint
from progdf.gdf.placed import Placement, Target, carry_edit, check_rounding, place_scene
from progdf.metrics.image import psnr
from progdf.rasterize.engines import render
from progdf.region import from_mask
from progdf.scene.orbit_rig import orbit_rig
from progdf.similarity import AffineMotion, affine_motion, transform_rows
from progdf.tidy import Step, tidy
from tests.helpers.draws import Draws
from tests.helpers.edits import bits, curved_field, edit_of, painted, some_rows
from tests.helpers.scenes import random_gaussians

PLACED = Placement((0.5, -2.0, 1.0), (0.3, -1.1, 0.4), 1.7)


def motion() -> AffineMotion:
    """Return the placement as a motion about the world's origin."""
    return affine_motion(1.7 * PLACED.rotation, PLACED.offset, torch.zeros(3))


def carried(gdf: Gdf, scene: Gaussians, placement: Placement) -> Gdf:
    target = Target(fingerprint(scene), scene.origin, scene.shN.shape[1], lambda rows: rows)
    return carry_edit(gdf, placement, target)


def close(a: Gaussians, b: Gaussians, tolerance: float = 2e-5) -> bool:
    return all(torch.allclose(getattr(a, n), getattr(b, n), atol=tolerance, rtol=1e-5) for n in ATTRIBUTES)


def moving_edits(scene: Gaussians) -> list[Gdf]:
    """Return edits of every attribute: a curved one, paint with added rows, and a move of parts."""
    curved = edit_of(scene, some_rows(scene, 40), curved_field(40, channels=14 + 3 * scene.shN.shape[1]))
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[:50] = True
    turn = torch.tensor([0.2, 0.9, -0.3], dtype=torch.float64)
    stretch = torch.diag(torch.tensor([0.3, 0.0, -0.2], dtype=torch.float64))
    step = Step("transform", from_mask("part", mask), AffineMotion(torch.ones(3).double(), turn, stretch))
    return [curved, painted(scene, 12, 3), tidy(scene, [step], "moved")]


def test_placed_scene_is_that_of_the_similarity_of_its_rows() -> None:
    scene = random_gaussians(60, sh_degree=2)
    placed = place_scene(scene, PLACED, ZERO, 15)
    rows = transform_rows(pack(scene, with_shN=True).double(), motion()).float()
    assert torch.allclose(pack(placed, with_shN=True)[:, : rows.shape[1]], rows, atol=1e-5)
    assert not placed.shN[:, 8:].any()
    back = place_scene(placed, PLACED.inverse, ZERO, 15)
    assert close(back, place_scene(scene, Placement(), ZERO, 15))


@pytest.mark.parametrize("strength", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("kind", [0, 1, 2])
def test_placed_edit_gives_the_placed_edited_scene(kind: int, strength: float) -> None:
    scene = random_gaussians(80, sh_degree=1)
    edit = moving_edits(scene)[kind]
    placed = place_scene(scene, PLACED, ZERO, 3)
    moved = carried(edit, placed, PLACED)
    expected = compose_extended(scene, edit, strength)
    found = compose_extended(placed, moved, strength)
    assert close(found, place_scene(expected, PLACED, ZERO, 3), 1e-4)


def compose_extended(scene: Gaussians, gdf: Gdf, strength: float) -> Gaussians:
    from progdf.compose.added import extend

    extended, (edit,) = extend(scene, [gdf])
    return compose_layers(extended, [Layer(edit, strength)])


def test_edit_at_the_identity_keeps_its_bits() -> None:
    scene = random_gaussians(80, sh_degree=1)
    for edit in moving_edits(scene):
        same = carried(edit, scene, Placement())
        for strength in (0.0, 0.5, 1.0):
            a = compose_extended(scene, edit, strength)
            assert bits(a) == bits(compose_extended(scene, same, strength))


def test_placements_follow_each_other() -> None:
    point = Draws(1).normal(5, 3).double()
    pivot = torch.tensor([1.0, 2.0, -0.5], dtype=torch.float64)
    step = affine_motion(
        2.0 * Placement(turn=(0.0, 1.0, 0.5)).rotation, torch.tensor([3.0, 0.0, 1.0]).double(), pivot
    )
    once = 1.7 * point @ PLACED.rotation.T + PLACED.offset
    expected = pivot + step.shift + (once - pivot) @ step.linear().T
    both = PLACED.then(step, ZERO)
    found = both.factor * point @ both.rotation.T + both.offset
    assert torch.allclose(found, expected)
    assert math.isclose(both.factor, 3.4)


def test_a_scene_keeps_its_proportions() -> None:
    for linear in (torch.diag(torch.tensor([1.0, 2.0, 1.0])), torch.diag(torch.tensor([1.0, -1.0, 1.0]))):
        with pytest.raises(ProgdfError, match="keeps its proportions"):
            Placement().then(affine_motion(linear, torch.zeros(3)), ZERO)


def test_mirrored_part_refuses_a_turn_of_its_scene() -> None:
    scene = random_gaussians(30)
    mask = torch.ones(30, dtype=torch.bool)
    mirror = affine_motion(torch.diag(torch.tensor([-1.0, 1.0, 1.0])), torch.zeros(3))
    edit = tidy(scene, [Step("transform", from_mask("all", mask), mirror)], "mirror")
    assert carried(edit, scene, Placement((1.0, 0.0, 0.0), factor=2.0)).motions is not None
    with pytest.raises(ProgdfError, match="mirrors a part"):
        carried(edit, scene, PLACED)


def test_scene_far_from_the_origin_looks_the_same_or_is_refused() -> None:
    scene = bear(3000).gaussians
    camera = orbit_rig(scene, 1, 96, 96)[0]
    near = render(scene, camera, torch.zeros(3)).image
    sizes = scene.scales.median(dim=1).values
    limit = float(sizes.median())
    for power in range(2, 9):
        shift = 10.0**power
        placed = place_scene(scene, Placement(shift=(shift, 0.0, 0.0)), ZERO, scene.shN.shape[1])
        if np.spacing(np.float32(shift)) > limit:
            with pytest.raises(ProgdfError, match="place it nearer"):
                check_rounding(placed, "bear")
            continue
        check_rounding(placed, "bear")
        viewmat = camera.viewmat.double()
        viewmat[:3, 3] -= shift * viewmat[:3, 0]
        far = render(placed, replace(camera, viewmat=viewmat.to(camera.viewmat)), torch.zeros(3)).image
        assert psnr(far.clamp(0, 1).double(), near.clamp(0, 1).double()) > 45.0
