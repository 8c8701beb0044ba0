"""Kernels of the color solver beside the same sums in torch."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from progdf.sh import basis
from trainer.optimize.color_kernels import (
    add_curvature,
    add_gradients,
    apply_blocks,
    drop_held,
    inner_product,
    invert_blocks,
    keep_drawn,
    shade_views,
)


def random(*shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(*shape, generator=generator)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("views", [1, 8])
def test_colors_of_views_and_their_gradients_match_torch(degree: int, views: int) -> None:
    means = random(53, 3)
    centers = 4.0 * random(views, 3)
    count = (degree + 1) ** 2
    sh = random(53, count, 3)
    bases = [basis(degree, torch.nn.functional.normalize(means - center, dim=1)) for center in centers]
    expected = torch.stack([torch.einsum("mb,mbc->mc", one, sh) for one in bases])
    colors = shade_views(means.numpy(), centers.numpy(), sh.numpy(), 0.5, 0.0)
    torch.testing.assert_close(
        torch.from_numpy(colors), (expected + 0.5).clamp_min(0.0), rtol=1e-5, atol=2e-6
    )
    changes = shade_views(means.numpy(), centers.numpy(), sh.numpy(), 0.0, -math.inf)
    torch.testing.assert_close(torch.from_numpy(changes), expected, rtol=1e-5, atol=2e-6)
    by_color = random(views, 53, 3)
    expected_sh = sh + sum(torch.einsum("mb,mc->mbc", *pair) for pair in zip(bases, by_color, strict=True))
    add_gradients(means.numpy(), centers.numpy(), by_color.numpy(), sh.numpy())
    torch.testing.assert_close(sh, expected_sh, rtol=1e-5, atol=5e-6)


def test_inverse_blocks_solve_for_the_free_functions_only() -> None:
    half = random(40, 9, 9)
    curvature = half @ half.transpose(1, 2)
    free = random(40, 4) > -0.5
    diagonal = random(40).abs() + 0.1
    inverse = torch.from_numpy(invert_blocks(curvature.numpy(), free.numpy(), diagonal.numpy()))
    both = free[:, :, None] & free[:, None]
    regularized = curvature[:, :4, :4] * both + diagonal[:, None, None] * torch.eye(4)
    torch.testing.assert_close(inverse, torch.linalg.inv(regularized.double()).float() * both)
    descent = random(40, 4, 3)
    product = torch.empty_like(descent)
    apply_blocks(inverse.numpy(), descent.numpy(), product.numpy())
    torch.testing.assert_close(product, inverse @ descent)


def test_curvature_matches_torch() -> None:
    basis = random(40, 16)
    weights = random(40).clamp_min(0.0)
    bands = basis[:, :4]
    expected = (weights[:, None] * bands)[:, :, None] * bands[:, None]
    curvature = torch.zeros(40, 4, 4)
    add_curvature(basis.numpy(), weights.numpy(), curvature.numpy())
    torch.testing.assert_close(curvature, expected)


def test_channels_that_stay_black_are_dropped() -> None:
    colors = random(60, 3).clamp_min(0.0)
    gradient = random(60, 3)
    expected = (colors > 0.0) | (gradient > 0.0)
    dropped = gradient * expected
    drawn = torch.empty(60, 3, dtype=torch.bool)
    drop_held(colors.numpy(), gradient.numpy(), drawn.numpy())
    assert torch.equal(drawn, expected)
    assert torch.equal(gradient, dropped)
    kept = random(60, 3)
    expected_colors = kept * drawn
    keep_drawn(kept.numpy(), drawn.numpy())
    assert torch.equal(kept, expected_colors)


def test_inner_product_is_summed_in_float64() -> None:
    a = random(10_000)
    b = random(9_999 + 1).flip(0)
    found = inner_product(a, b)
    torch.testing.assert_close(found, float((a * b).double().sum()), rtol=1e-12, atol=1e-9)
