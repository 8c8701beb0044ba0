"""Adam with short memories, for searches of few steps among few numbers, one view a step."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

_SETTLED = 0.25  # share of the steps, the last, over which the numbers are averaged

OnStep = Callable[[int, float], None]
"""Called after every step: steps done, loss."""


def descend(
    start: Tensor,
    loss_in: Callable[[Tensor, int, int], Tensor],
    rates_at: Callable[[int], Tensor],
    steps: int,
    views: int,
    seed: int,
    damping: float = 0.0,
    on_step: OnStep | None = None,
) -> Tensor:
    """The numbers that lower a loss, averaged over the last quarter of the steps.

    Args:
        start: where to begin. [P,C]
        loss_in: numbers, index of a view, steps done -> the loss in this view
        rates_at: steps done -> length of a step, of each column. [C]
        steps: in all
        views: all are taken in random order, again and again
        seed: of the order
        damping: share of a column's typical gradient below Adam's fraction: rows that hardly show stay put
        on_step: progress

    Raises:
        FloatingPointError: the loss is no longer finite.
    """
    values = start.detach().clone().requires_grad_()
    first, second = torch.zeros_like(values), torch.zeros_like(values)
    settled = torch.zeros_like(values)
    averaged = max(1, round(_SETTLED * steps))
    order = torch.Generator().manual_seed(seed)
    queue: list[int] = []
    for step in range(steps):
        if not queue:
            queue = torch.randperm(views, generator=order).tolist()
        loss = loss_in(values, queue.pop(), step)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss is {value} at step {step} of the group stage")
        (gradient,) = torch.autograd.grad(loss, values)
        with torch.no_grad():
            first.lerp_(gradient, 0.2)
            second.lerp_(gradient.square(), 0.02)
            mean = first / (1 - 0.8 ** (step + 1))
            spread = (second / (1 - 0.98 ** (step + 1))).sqrt()
            floor = damping * spread.square().mean(dim=0).sqrt()
            values -= rates_at(step) * mean / (spread + floor + 1e-12)
            if steps - step <= averaged:
                settled += values / averaged
        if on_step is not None:
            on_step(step + 1, value)
    return settled


def falling(step: int, steps: int) -> float:
    """Factor to a rate, from 1 to a twentieth along half a wave."""
    return 0.05 + 0.95 * (0.5 + 0.5 * math.cos(math.pi * step / steps))
