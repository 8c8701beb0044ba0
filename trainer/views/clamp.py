"""A clamp whose gradient still leads back into the range."""

from __future__ import annotations

import torch
from torch import Tensor


class _ClampTowards(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = (low, high)  # type: ignore[attr-defined]
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors  # type: ignore[attr-defined]
        low, high = ctx.bounds  # type: ignore[attr-defined]
        # descent moves x against the gradient: below the range a negative one brings it back
        useful = ((x >= low) | (gradient < 0)) & ((x <= high) | (gradient > 0))
        return gradient * useful, None, None


def clamp_towards(x: Tensor, low: float, high: float) -> Tensor:
    """`x.clamp(low, high)` whose gradient also passes where descent would bring x back into the range.

    A sixth of a trained scene's colors have a channel below 0; with the plain clamp they could never change
    (docs/experiments.md, Rates and steps).
    """
    clamped: Tensor = _ClampTowards.apply(x, low, high)  # type: ignore[no-untyped-call]
    return clamped
