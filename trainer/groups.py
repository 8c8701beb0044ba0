"""The group stage: before anything bends, each connected part is moved as a whole to where the edit shows it.

Free descent smears a part that has to travel half its own size: every Gaussian fades towards whatever colour
it lies on. A part has seven numbers (shift, turn, growth); they are found first, coarse to fine, and the
members start from there (method.md 3, large moves).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from trainer.crops import CropScene
from trainer.losses import l1
from trainer.motion import Motion, Parts, moved

_BLURS = (9, 21)  # pixels; a part finds its way from about as far as the widest reaches
_RATES = (0.06, 0.03, 0.03)  # a step of shift in part sizes, of log-scale, of turn in radians
_MOVING = ("means", "log_scales", "quats")
_SETTLED = 0.25  # share of the steps, the last, over which the motion is averaged

OnStep = Callable[[int, float], None]
"""Called after every step: steps done, loss."""


def find_motion(
    original: Tensor,
    parts: Parts,
    start: Motion,
    crops: Sequence[CropScene],
    targets: Sequence[Tensor],
    steps: int,
    seed: int = 0,
    on_step: OnStep | None = None,
) -> Motion:
    """The motion of the parts that brings the views closest to their targets.

    Args:
        original: raw member rows. [M,C]
        parts: the region taken apart
        start: where to look first
        crops: the training views
        targets: their edited boxes. [h,w,3] each
        steps: how many, each in one view
        seed: order of the views
        on_step: progress

    Returns:
        The motion found; `start` where that is no worse in the mean of all views.

    Raises:
        FloatingPointError: the loss is no longer finite.
    """
    values = torch.cat(
        [start.shift / parts.sizes[:, None], start.log_scale[:, None], start.turn], dim=1
    ).requires_grad_()
    shift, size, turn = _RATES
    rates = torch.tensor([shift] * 3 + [size] + [turn] * 3)
    first, second = torch.zeros_like(rates).expand_as(values).clone(), torch.zeros_like(values)
    order = torch.Generator().manual_seed(seed)
    queue: list[int] = []
    settled = torch.zeros_like(values)
    averaged = max(1, round(_SETTLED * steps))
    for step in range(steps):
        if not queue:
            queue = torch.randperm(len(crops), generator=order).tolist()
        view = queue.pop()
        loss = _distance(crops[view], moved(original, parts, _motion(values, parts)), targets[view])
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"the loss is {value} at step {step} of the group stage")
        (gradient,) = torch.autograd.grad(loss, values)
        with torch.no_grad():
            first.lerp_(gradient, 0.2)
            second.lerp_(gradient.square(), 0.02)
            mean, spread = first / (1 - 0.8 ** (step + 1)), (second / (1 - 0.98 ** (step + 1))).sqrt()
            fall = 0.05 + 0.475 * (1 + math.cos(math.pi * step / steps))
            values -= fall * rates * mean / (spread + 1e-12)
            if steps - step <= averaged:
                settled += values / averaged
        if on_step is not None:
            on_step(step + 1, value)
    found = _motion(settled.detach(), parts)
    with torch.no_grad():
        errors = [
            sum(
                float(_distance(c, moved(original, parts, m), t)) for c, t in zip(crops, targets, strict=True)
            )
            for m in (start, found)
        ]
    return found if errors[1] < errors[0] else start


def _motion(values: Tensor, parts: Parts) -> Motion:
    return Motion(values[:, :3] * parts.sizes[:, None], values[:, 3], values[:, 4:])


def _distance(scene: CropScene, rows: Tensor, target: Tensor) -> Tensor:
    """L1 at full sharpness and blurred: a blur lets a part feel a place that it does not touch yet."""
    image, _ = scene.render(rows, _MOVING)
    loss = l1(image, target)
    difference = (image - target).permute(2, 0, 1)[None]
    for width in _BLURS:
        width = min(width, *image.shape[:2])
        loss = loss + avg_pool2d(difference, width, max(1, width // 3)).abs().mean()
    return loss
