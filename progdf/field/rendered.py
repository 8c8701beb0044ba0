"""The trajectory as pictures see it: how much each attribute's trajectory beside its straight end shows, and
with what.

Numbers of different attributes cannot be compared, and an error that no picture shows is none. So every
attribute is straightened (its offset replaced by a_0(s) times the full one), one at a time, at every
snapshot, and what changes in
the pictures is kept: one row of pixels per attribute and snapshot. All that the choice of ranks needs is in
the inner products of these rows; the errors of several attributes may add up or cancel, and both is seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from .separable import AttributeTrajectory, fit_amplitude, moving_attributes, principal_modes

Render = Callable[[Tensor], Tensor]
"""Offsets of the members -> the pixels that count, of some views side by side. [M,C] -> [P,3]"""

MOST_PIXELS = 40_000
"""Pixels kept of each render; of more, evenly spread ones."""

MOST_SNAPSHOTS = 40
"""Snapshots that are rendered; between two of them changes are taken to go straight."""

UNSEEN = 0.1
"""Say of the bare numbers beside the pictures, for members that these views do not show."""

Modes = Mapping[str, tuple[Tensor, Tensor]]
"""By attribute, as `separable.principal_modes` gives them."""


@dataclass(frozen=True)
class RenderedTrajectories:
    """What straightening each attribute changes in the pictures.

    Args:
        trajectories: by attribute
        gram: inner products of these changes over pixels and colors. [A,T,A,T] float64
        pictures: inner products of what the snapshots change in the pictures. [T,T] float64
        values: numbers that each inner product sums over
        channels: width of a packed row
    """

    trajectories: Mapping[str, AttributeTrajectory]
    gram: Tensor
    pictures: Tensor
    values: int
    channels: int

    def modes(self, emphasis: Tensor) -> Modes:
        """Each attribute's best bases, when the snapshots count as `emphasis` says. [T] float64, > 0"""
        found = {}
        for i, (name, trajectory) in enumerate(self.trajectories.items()):
            seen = self.gram[i, :, i]
            parameters = float(trajectory.gram.diagonal().sum())
            share = UNSEEN * float(seen.diagonal().sum()) / parameters if parameters > 0 else 0.0
            found[name] = principal_modes(seen + share * trajectory.gram, emphasis)
        return found

    def mse(self, modes: Modes, ranks: Mapping[str, int]) -> Tensor:
        """Expected mean squared error of the pictures at each snapshot. [T] float64"""
        snapshots = self.gram.shape[1]
        left = torch.eye(snapshots, dtype=torch.float64).repeat(len(self.trajectories), 1, 1)
        for i, name in enumerate(self.trajectories):
            mix, table = (part[:, : ranks.get(name, 0)] for part in modes[name])
            left[i] -= table @ mix.T  # row t: what remains there, as a sum of the rows of pixels
        half = torch.einsum("ats,asbu->atbu", left, self.gram)
        return torch.einsum("atbu,btu->t", half, left).clamp(min=0) / self.values


def render_trajectories(offsets: Tensor, weights: Tensor, render: Render) -> RenderedTrajectories:
    """Straighten every attribute at every snapshot, and look.

    Args:
        offsets: [T,M,C] float32, the first row 0
        weights: how much an error of each number shows, ≥ 0. [M,C]
        render: called 2 + (1 + A)·(T − 2) times at most, where T counts no more than `MOST_SNAPSHOTS`
    """
    attributes = moving_attributes(offsets)
    trajectories = {
        name: fit_amplitude(offsets[:, :, columns], weights[:, columns])
        for name, columns in attributes.items()
    }
    snapshots = len(offsets)
    looked = _rendered_snapshots(snapshots)
    with torch.no_grad():
        original = render(offsets[0])
        stride = _stride(original)
        still = torch.zeros_like(original[::stride].flatten())
        seen, changes = [still], [[still] for _ in attributes]
        for t in looked[1:-1]:
            pixels = render(offsets[t])
            seen.append((pixels - original)[::stride].flatten())
            for i, (name, columns) in enumerate(attributes.items()):
                straight = offsets[t].clone()
                straight[:, columns] = trajectories[name].amplitude[t] * offsets[-1, :, columns]
                changes[i].append((pixels - render(straight))[::stride].flatten())
        seen.append((render(offsets[-1]) - original)[::stride].flatten())
    spread = _interpolation_weights(looked, snapshots)
    shown = torch.stack(seen)
    pictures = spread @ (shown @ shown.T).double() @ spread.T
    gram = torch.zeros(len(attributes), snapshots, len(attributes), snapshots, dtype=torch.float64)
    if not attributes or snapshots < 3:
        return RenderedTrajectories(trajectories, gram, pictures, 1, offsets.shape[2])
    rows = torch.cat([torch.stack([*own, still]) for own in changes])
    products = (rows @ rows.T).double().reshape(len(attributes), len(looked), len(attributes), len(looked))
    gram = torch.einsum("ts,asbu,vu->atbv", spread, products, spread)
    return RenderedTrajectories(trajectories, gram, pictures, max(1, rows.shape[1]), offsets.shape[2])


def picture_gram(offsets: Tensor, render: Render) -> Tensor:
    """Inner products of what the snapshots change in the pictures. [T,M,C] -> [T,T] float64"""
    looked = _rendered_snapshots(len(offsets))
    with torch.no_grad():
        original = render(offsets[0])
        stride = _stride(original)
        rows = torch.stack([(render(offsets[t]) - original)[::stride].flatten() for t in looked])
    spread = _interpolation_weights(looked, len(offsets))
    return spread @ (rows @ rows.T).double() @ spread.T


def _rendered_snapshots(snapshots: int) -> list[int]:
    """Snapshots that are rendered, even and both ends among them."""
    if snapshots <= MOST_SNAPSHOTS:
        return list(range(snapshots))
    return [round(i * (snapshots - 1) / (MOST_SNAPSHOTS - 1)) for i in range(MOST_SNAPSHOTS)]


def _interpolation_weights(looked: Sequence[int], snapshots: int) -> Tensor:
    """How much of each snapshot that is looked at every one holds. [T,L] float64"""
    shares = torch.zeros(snapshots, len(looked), dtype=torch.float64)
    shares[looked, range(len(looked))] = 1.0
    for column, (a, b) in enumerate(pairwise(looked)):
        inner = torch.arange(a + 1, b)
        share = (inner - a).double() / (b - a)
        shares[inner, column], shares[inner, column + 1] = 1.0 - share, share
    return shares


def _stride(pixels: Tensor) -> int:
    return max(1, -(-len(pixels) // MOST_PIXELS))


def rendered_importance(offsets: Tensor, render: Render, seed: int = 0) -> dict[str, float]:
    """How much an error of one spread in each attribute shows in pictures, half way; these add up to 1.

    Args:
        offsets: [T,M,C]
        render: pixels of some views
    """
    draws = torch.Generator().manual_seed(seed)
    middle = offsets[len(offsets) // 2].float()
    found = {}
    with torch.no_grad():
        expected = render(middle)
        for name, columns in moving_attributes(offsets).items():
            spread = float(offsets[1:, :, columns].float().square().mean().sqrt())
            moved = middle.clone()
            moved[:, columns] += 0.1 * spread * torch.randn(moved[:, columns].shape, generator=draws)
            found[name] = float((render(moved) - expected).square().mean()) if len(expected) else 1.0
    total = sum(found.values())
    return {name: value / total if total > 0 else 1.0 / len(found) for name, value in found.items()}
