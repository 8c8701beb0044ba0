"""Tests of affine motions of a region: exact ends, mirrored and stretched Gaussians, and the way there."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from progdf.gaussians import Gaussians, pack
from progdf.quaternions import normalize_quats, rotation_matrices
from progdf.region import whole_scene
from progdf.sh import shade
from progdf.similarity import MIN_STRETCH, AffineMotion, affine_motion, continue_axes, transform_rows
from progdf.tidy import Step, mirror, similarity, tidy
from tests.helpers.scenes import random_gaussians

STILL = torch.zeros(3, dtype=torch.float64)


def scene_of(count: int = 48) -> Gaussians:
    return random_gaussians(count, seed=7, sh_degree=3, spread=0.5, scale=0.1)


def rows_of(scene: Gaussians) -> Tensor:
    return pack(scene, with_shN=True).double()


def covariances(rows: Tensor) -> Tensor:
    axes = rotation_matrices(normalize_quats(rows[:, 6:10]))
    half = axes * rows[:, 3:6].exp()[:, None, :]
    return half @ half.mT


def colors(rows: Tensor, directions: Tensor) -> Tensor:
    """Return the colors of each Gaussian along each direction. [M,D,3]"""
    sh = torch.cat([rows[:, None, 11:14], rows[:, 14:].reshape(len(rows), -1, 3)], dim=1)
    seen = [shade(3, d.expand(len(rows), 3), sh) for d in directions]
    return torch.stack(seen, dim=1)


angles = st.floats(-3.0, 3.0)
factors = st.floats(0.2, 4.0)
numbers = st.floats(-5.0, 5.0)


@given(
    st.tuples(angles, angles, angles),
    st.tuples(factors, factors, factors),
    st.tuples(*[st.sampled_from([1.0, -1.0])] * 3),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers),
)
def test_rows_after_an_affine_motion_are_those_of_its_matrix(
    turn: tuple[float, ...],
    scale: tuple[float, ...],
    signs: tuple[float, ...],
    shift: tuple[float, ...],
    pivot: tuple[float, ...],
) -> None:
    rotation = torch.from_numpy(Rotation.from_rotvec(turn).as_matrix())
    other = torch.from_numpy(Rotation.from_rotvec(turn[::-1]).as_matrix())
    matrix = rotation @ torch.diag(torch.tensor(scale, dtype=torch.float64)) @ other
    matrix = matrix @ torch.diag(torch.tensor(signs, dtype=torch.float64))
    at = torch.tensor(pivot, dtype=torch.float64)
    by = torch.tensor(shift, dtype=torch.float64)
    motion = affine_motion(matrix, by, at)
    torch.testing.assert_close(motion.linear(), matrix, atol=1e-9, rtol=1e-9)
    rows = rows_of(scene_of())
    moved = transform_rows(rows, motion)
    torch.testing.assert_close(moved[:, :3], at + by + (rows[:, :3] - at) @ matrix.T)
    expected = matrix @ covariances(rows) @ matrix.T
    scale_of = expected.diagonal(dim1=1, dim2=2).amax(dim=1)[:, None, None]
    torch.testing.assert_close(covariances(moved) / scale_of, expected / scale_of, atol=1e-9, rtol=0)
    assert torch.equal(moved[:, 10:14], rows[:, 10:14]), "opacity and the color of band 0"


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirrored_colors_are_seen_from_mirrored_directions(axis: int) -> None:
    rows = rows_of(scene_of())
    directions = torch.nn.functional.normalize(torch.randn(9, 3, dtype=torch.float64), dim=1)
    flip = torch.ones(3, dtype=torch.float64)
    flip[axis] = -1.0
    mirrored = transform_rows(rows, mirror(axis))
    torch.testing.assert_close(colors(mirrored, directions * flip), colors(rows, directions))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_mirroring_twice_is_the_identity(axis: int) -> None:
    rows = rows_of(scene_of())
    twice = transform_rows(transform_rows(rows, mirror(axis)), mirror(axis))
    torch.testing.assert_close(twice[:, :3], rows[:, :3], atol=1e-14, rtol=0)
    torch.testing.assert_close(covariances(twice), covariances(rows), atol=1e-15, rtol=0)
    torch.testing.assert_close(twice[:, 6:10], -rows[:, 6:10], atol=1e-12, rtol=0)
    assert torch.equal(twice[:, 3:6], rows[:, 3:6])
    assert torch.equal(twice[:, 10:], rows[:, 10:])


def test_mirror_flattens_half_way_and_unfolds_on_the_other_side() -> None:
    rows = rows_of(scene_of())
    center = rows[:, 0].mean()
    for share, factor in ((0.25, 0.5), (0.5, 0.0), (0.75, -0.5), (1.0, -1.0)):
        moved = transform_rows(rows, mirror(0), share)
        torch.testing.assert_close(moved[:, 0] - center, factor * (rows[:, 0] - center))
        torch.testing.assert_close(moved[:, 1:3], rows[:, 1:3])
        assert bool(torch.isfinite(moved).all())


def test_slider_between_the_knots_is_close_to_the_exact_stretch() -> None:
    rows = rows_of(scene_of())
    stretch = torch.diag(torch.tensor([math.log(3.0), 0.0, -0.5], dtype=torch.float64))
    motion = AffineMotion(STILL, STILL, stretch)
    strengths = motion.strengths(1 / 8).tolist()
    states = torch.stack([transform_rows(rows, motion, s) for s in strengths])[:, :, :10]
    continued = continue_axes(states)
    assert torch.equal(continued[0], states[0])
    for state, same in zip(states, continued, strict=True):
        torch.testing.assert_close(covariances(same), covariances(state), atol=1e-14, rtol=0)
    for i, (first, second) in enumerate(pairwise(strengths)):
        both = continued[i] + continued[i + 1]
        exact = covariances(transform_rows(rows, motion, (first + second) / 2.0))
        error = (covariances(both / 2.0) - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))
        assert float(error.median()) < 0.01
        assert float(error.max()) < 0.1


def test_the_smallest_rotation_decides_on_the_mirrored_axis() -> None:
    for axis in range(3):
        flip = torch.eye(3, dtype=torch.float64)
        flip[axis, axis] = -1.0
        motion = affine_motion(flip, STILL)
        assert motion.mirror == axis
        assert not motion.turn.any()
        assert not motion.stretch.any()


def test_singular_matrix_keeps_a_small_thickness() -> None:
    motion = affine_motion(torch.zeros(3, 3), STILL)
    assert motion.mirror is None
    torch.testing.assert_close(motion.stretch.diagonal(), torch.full((3,), math.log(MIN_STRETCH)).double())
    rows = transform_rows(rows_of(scene_of()), motion)
    assert bool(torch.isfinite(rows).all())


def test_edit_of_a_mirror_ends_at_the_mirrored_scene() -> None:
    scene = scene_of(384)
    gdf = tidy(scene, [Step("transform", whole_scene(scene), mirror(1))], "mirrored")
    end = gdf.field.offsets(1.0)
    expected = (transform_rows(rows_of(scene), mirror(1)) - rows_of(scene)).float()
    span = expected.abs().amax(dim=0).clamp_min(1e-6)
    assert float(((end - expected).abs() / span).max()) < 1e-3


def test_uniform_motion_keeps_the_shapes_of_the_axes() -> None:
    rows = rows_of(scene_of())
    moved = transform_rows(rows, similarity((1.0, 0.0, 0.0), (0.0, 0.5, 0.0), 2.0))
    torch.testing.assert_close(moved[:, 3:6], rows[:, 3:6] + math.log(2.0))
    assert np.isclose(float(moved[:, 0].mean() - rows[:, 0].mean()), 1.0)
