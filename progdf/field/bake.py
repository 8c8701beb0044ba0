"""Baking: a network becomes the separable field that the viewer runs (docs/method.md 5).

The field is evaluated at nodes, both ends are pinned to what they must be, and the trajectory between them is
factored. Nodes and factors are chosen when the edit is made and kept in its file, with the error of both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from progdf.interpolation import interpolate_at
from progdf.metrics.image import decibels

from .baked import BakedField
from .evaluate import Field, sample_strengths
from .neural import NeuralField
from .rendered import Render
from .separable import fit_amplitude, fit_separable, moving_attributes, principal_modes

TOLERANCE = 0.01
"""Root mean square error of the factoring, as a share of the trajectory's own root mean square."""

MOST_NODES, MOST_RANK = 257, 16

_PER_BIN, _FEW_PER_BIN = 4, 2
_LARGE = 100_000  # numbers in a network beyond which fewer nodes are asked for, as loading waits for them
_JUMP = 1e-5  # width of the edge between two hard bins


@dataclass(frozen=True)
class BakePlan:
    """How a field is baked, so that every load gives the same.

    Args:
        knots: strengths at which the field is asked, ascending from 0 to 1. [S] float32
        ranks: bases beside the full offset, by attribute
        end_correction: how much of what the field misses of the end is added at each node, by attribute, 0
            first and 1 last; no entry: nothing is missed. [S] float32
    """

    knots: Tensor
    ranks: Mapping[str, int]
    end_correction: Mapping[str, Tensor]

    def __post_init__(self) -> None:
        if self.knots.ndim != 1 or not 2 <= len(self.knots) <= MOST_NODES:
            raise ValueError(f"a bake at nodes {list(self.knots.shape)}, expected 2 to {MOST_NODES}")
        for name, rank in self.ranks.items():
            if not 0 <= rank <= MOST_RANK:
                raise ValueError(f"a bake of {name} with {rank} bases, expected 0 to {MOST_RANK}")
        for name, share in self.end_correction.items():
            if share.shape != self.knots.shape or share.dtype != torch.float32:
                raise ValueError(
                    f"the end correction of {name} is {list(share.shape)}, expected {len(self.knots)} nodes"
                )


@dataclass(frozen=True)
class NeuralForm:
    """What a file keeps of a neural field.

    Args:
        network: the trained network
        plan: how it is baked
        rows_sha256: of the members' raw values that the network looks at; "" where it sees places alone
        error: what baking costs: "rms", relative, and with pictures "psnr_mean", "psnr_worst",
            dB, between the network, pinned, and what was baked of it
    """

    network: NeuralField
    plan: BakePlan
    rows_sha256: str = ""
    error: Mapping[str, float] | None = None

    def bake(self, rows: Tensor) -> BakedField:
        """The field that runs. `rows`: raw values of the members before the edit, packed. [M,≥14]

        Raises:
            ValueError: not as many Gaussians, or a number of the network is not usable.
        """
        network = self.network
        trajectory = pinned_trajectory(network.bind(rows), full_end(network), self.plan)
        baked = fit_separable(self.plan.knots, trajectory, self.plan.ranks, recorded=network.recorded)
        return replace(baked, kind="neural", origin=self)


def rows_hash(rows: Tensor) -> str:
    """SHA-256 of what a network sees of its members (float32 bytes). [M,≥14]"""
    seen = rows[:, :BASE_CHANNELS].detach().to("cpu", torch.float32).contiguous()
    return hashlib.sha256(seen.numpy().tobytes()).hexdigest()


def full_end(network: NeuralField) -> Tensor:
    """The recorded end, packed. [M,C]"""
    end = torch.zeros(network.members, network.shape.channels)
    end[:, network.shape.columns] = network.end
    return end


def bake_network(
    network: NeuralField,
    rows: Tensor,
    truth: Callable[[float], Tensor] | None = None,
    render: Render | None = None,
    tolerance: float = TOLERANCE,
) -> BakedField:
    """Choose how a network is baked, bake it, and measure what that costs.

    Args:
        network: trained
        rows: raw values of the members before the edit, packed. [M,≥14]
        truth: the recorded offsets at any strength; tells how the network's error at the end goes with that
            on the way. None: as its trajectory goes
        render: of some views; None leaves the error in decibels out
        tolerance: see `TOLERANCE`
    """
    field, end = network.bind(rows), full_end(network)
    large = network.parameters - network.codes.numel() > _LARGE
    nodes = bake_nodes(network.shape.bins, network.shape.hard, _FEW_PER_BIN if large else _PER_BIN)
    plan = BakePlan(nodes, {}, _end_corrections(field, end, nodes, truth))
    trajectory = pinned_trajectory(field, end, plan)
    plan = replace(plan, ranks=_ranks(trajectory, tolerance))
    own = network.shape.inputs == "own"
    form = NeuralForm(network, plan, rows_hash(rows) if own else "")
    baked = form.bake(rows)
    return replace(baked, origin=replace(form, error=bake_error(field, baked, plan, render)))


def bake_nodes(bins: int, hard: bool, per_bin: int = _PER_BIN) -> Tensor:
    """Strengths to bake at: `per_bin` to a smooth bin; both sides of every edge of hard ones. [S] float32"""
    if not hard:
        return torch.linspace(0, 1, per_bin * bins + 1)
    edges = torch.arange(2, bins) / bins  # see `neural.hard_bin`; the last edge is the end itself
    inner = torch.stack([edges - _JUMP, edges], dim=1).flatten()
    return torch.cat([torch.tensor([0.0, _JUMP]), inner, torch.tensor([1.0 - _JUMP, 1.0])])


def pinned_trajectory(field: Field, end: Tensor, plan: BakePlan) -> Tensor:
    """The field at the nodes, zero at the first and the recorded end at the last. [S,M,C] float32

    What the field misses of the end is spread over the way, so that nothing jumps where the slider arrives.
    """
    asked = torch.stack([field.offsets(float(s)) for s in plan.knots])
    asked[0] = 0.0
    missing = end - asked[-1]
    for name, columns in moving_attributes(asked).items():
        if name in plan.end_correction:
            asked[:, :, columns] += plan.end_correction[name][:, None, None] * missing[:, columns]
    asked[-1] = end
    return asked


def bake_error(field: Field, baked: BakedField, plan: BakePlan, render: Render | None) -> dict[str, float]:
    """What the nodes and the factoring cost, at strengths between the nodes too; see `NeuralForm`."""
    end = baked.offsets(1.0)
    missing = end - field.offsets(1.0)
    wrong = whole = 0.0
    psnrs = []
    for s in sample_strengths():
        pinned = field.offsets(s)
        for name, columns in moving_attributes(end[None]).items():
            if name in plan.end_correction:
                end_correction = interpolate_at(plan.knots, plan.end_correction[name], s)
                pinned[:, columns] += end_correction * missing[:, columns]
        found = baked.offsets(s)
        wrong += float((found - pinned).double().square().sum())
        whole += float(pinned.double().square().sum())
        if render is not None:
            with torch.no_grad():
                difference = render(found) - render(pinned)
            psnrs.append(decibels(float(difference.double().square().mean()) if len(difference) else 0.0))
    error = {"rms": (wrong / whole) ** 0.5 if whole > 0 else 0.0}
    if psnrs:
        error |= {"psnr_mean": sum(psnrs) / len(psnrs), "psnr_worst": min(psnrs)}
    return {name: float(f"{value:.4g}") for name, value in error.items()}


def _end_corrections(
    field: Field, end: Tensor, nodes: Tensor, truth: Callable[[float], Tensor] | None
) -> dict[str, Tensor]:
    """How much of what is missing at the end is missing at each node, by attribute; see `BakePlan`."""
    asked = torch.stack([field.offsets(float(s)) for s in nodes])
    missing = end - asked[-1]
    found = {}
    for name, columns in moving_attributes(torch.stack([end, asked[-1]])).items():
        least = missing[:, columns].double()
        power = float(least.square().sum())
        if power == 0.0:
            continue
        if truth is None:
            share = fit_amplitude(asked[:, :, columns], torch.ones_like(end[:, columns])).amplitude
        else:
            errors = [truth(float(s))[:, columns] - a[:, columns] for s, a in zip(nodes, asked, strict=True)]
            share = torch.tensor([float((e.double() * least).sum()) / power for e in errors])
        share[0], share[-1] = 0.0, 1.0
        found[name] = share.float()
    return found


def _ranks(trajectory: Tensor, tolerance: float) -> dict[str, int]:
    """The fewest bases with which each attribute's trajectory is met to `tolerance`. [S,M,C]"""
    ranks = {}
    for name, columns in moving_attributes(trajectory).items():
        own = fit_amplitude(trajectory[:, :, columns], torch.ones_like(trajectory[0, :, columns]))
        allowed = tolerance**2 * float(own.offsets.double().square().sum())
        power = torch.linalg.eigvalsh(own.gram).flip(0).clamp(min=0)
        left = float(power.sum()) - power.cumsum(0)
        needed = 0 if float(power.sum()) <= allowed else 1 + int((left > allowed).sum())
        ranks[name] = min(needed, MOST_RANK, principal_modes(own.gram)[0].shape[1])
    return ranks
