"""How many bases each attribute gets: by what a byte of it takes from the error in the pictures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from progdf.metrics.image import decibels

from .rendered import Modes, RenderedTrajectories


def grow_ranks(seen: RenderedTrajectories, most_bytes: float) -> list[dict[str, int]]:
    """Ranks from none upwards; each step adds the basis that takes most rendered error per byte."""
    widths = {name: trajectory.offsets.shape[2] for name, trajectory in seen.trajectories.items()}
    evenly = torch.ones(seen.gram.shape[1], dtype=torch.float64)
    modes = seen.modes(evenly)
    ranks = dict.fromkeys(seen.trajectories, 0)
    stored = 4.0 * sum(widths.values())
    path = [dict(ranks)]
    now = _hardness(seen.mse(modes, ranks))
    while now > 0:
        best: tuple[float, str, float] | None = None
        for name, width in widths.items():
            if ranks[name] >= modes[name][0].shape[1] or stored + width > most_bytes:
                continue
            then = _hardness(seen.mse(modes, {**ranks, name: ranks[name] + 1}))
            gain = math.log(now / max(then, 1e-30)) / width
            if best is None or gain > best[0]:
                best = (gain, name, then)
        if best is None or now < 1e-10:  # 100 dB
            break
        _, name, now = best
        ranks[name] += 1
        stored += widths[name]
        path.append(dict(ranks))
    return path


def _hardness(mse: Tensor) -> float:
    """Between mean and worst over the snapshots: the fourth-power mean, so that no step is in vain."""
    return float(mse.pow(4).mean().pow(0.25))


def emphasize_modes(seen: RenderedTrajectories, ranks: Mapping[str, int]) -> Modes:
    """Bases for these ranks, with snapshots of large error made to count more until the worst is least."""
    emphasis = torch.ones(seen.gram.shape[1], dtype=torch.float64)
    best = modes = seen.modes(emphasis)
    least = mse = seen.mse(modes, ranks)
    for _ in range(8):
        inner = mse[1:-1]
        if not bool((inner > 0).any()):
            break
        emphasis[1:-1] *= (inner / inner.mean()).clamp(min=1e-3).pow(0.5)
        emphasis = emphasis.clamp(1e-3, 1e3)
        modes = seen.modes(emphasis)
        mse = seen.mse(modes, ranks)
        if float(mse.max()) < float(least.max()):
            best, least = modes, mse
    return best


def expected_worst(seen: RenderedTrajectories, path: Sequence[Mapping[str, int]]) -> list[float]:
    """Least PSNR over the slider that each of these ranks should give at least, dB."""
    modes = seen.modes(torch.ones(seen.gram.shape[1], dtype=torch.float64))
    return [decibels(float(seen.mse(modes, ranks).max())) for ranks in path]
