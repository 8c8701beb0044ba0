"""Kernels of the color solver beside the same sums in torch."""

from __future__ import annotations

import torch
from torch import Tensor

from trainer.optimize.color_kernels import (
    add_colors,
    add_curvature,
    add_gradients,
    drop_held,
    inner_product,
    keep_drawn,
)


def random(*shape: int) -> Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return torch.randn(*shape, generator=generator)


def test_colors_and_their_gradients_match_torch() -> None:
    basis = random(50, 16)
    offsets = random(50, 9, 3)
    colors = random(50, 3)
    expected = colors + (basis[:, :9, None] * offsets).sum(dim=1)
    add_colors(basis.numpy(), offsets.numpy(), colors.numpy())
    torch.testing.assert_close(colors, expected)
    pull = random(50, 3)
    pull[::3] = 0.0
    expected = offsets + basis[:, :9, None] * pull[:, None]
    add_gradients(basis.numpy(), pull.numpy(), offsets.numpy())
    torch.testing.assert_close(offsets, expected)


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
