"""Baking of a network into the separable field that the viewer evaluates (docs/method.md 5).

The field is evaluated at nodes, both ends are pinned to their exact values, and the trajectory between them
is factored. Nodes and ranks are chosen when the edit is made and stored in its file, with the error of both.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from progdf.gaussians import BASE_CHANNELS
from progdf.metrics.image import decibels

from .baked import MAX_RANK, BakedField, BakePlan, NeuralForm, interpolate_at
from .choose import Field, Render, sample_strengths
from .neural import NeuralField
from .separable import fit_amplitude, fit_separable, moving_attributes, principal_modes

TOLERANCE = 0.01
"""RMS error of the factoring, as a share of the trajectory's own RMS."""

_NODES_PER_BIN = 4
_NODES_PER_BIN_LARGE = 2  # nodes per bin of a large network
_LARGE_NETWORK = 100_000  # weights of a network; a larger one has fewer nodes, so that it loads fast
_EDGE_WIDTH = 1e-5  # strength between the two nodes at the edge of hard bins


def bake_form(form: NeuralForm, rows: Tensor) -> BakedField:
    """Return the baked field of a stored network.

    Args:
        form: the network and its bake plan
        rows: raw values of the members before the edit, packed. [M,≥14]

    Raises:
        ValueError: the number of Gaussians differs, or an offset of the network is not finite.
    """
    network = form.network
    plan = form.plan
    trajectory = pinned_trajectory(network.bind(rows), full_end(network), plan)
    baked = fit_separable(plan.knots, trajectory, plan.ranks, recorded=network.recorded)
    return replace(baked, kind="neural", origin=form)


def rows_hash(rows: Tensor) -> str:
    """Return the SHA-256 of the members' values that a network reads (float32 bytes). [M,≥14]"""
    seen = rows[:, :BASE_CHANNELS].detach().to("cpu", torch.float32).contiguous()
    return hashlib.sha256(seen.numpy().tobytes()).hexdigest()


def full_end(network: NeuralField) -> Tensor:
    """Return the recorded end, packed. [M,C]"""
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
    """Choose the bake plan of a network, bake it, and measure the error.

    Args:
        network: trained network
        rows: raw values of the members before the edit, packed. [M,≥14]
        truth: recorded offsets at any strength. They show how much of the network's error at the end occurs
            at smaller strengths. None: the error grows in proportion to its trajectory
        render: renders some views; None omits the error in decibels
        tolerance: see `TOLERANCE`
    """
    field = network.bind(rows)
    end = full_end(network)
    large = network.parameters - network.codes.numel() > _LARGE_NETWORK
    nodes = bake_nodes(
        network.shape.bins, network.shape.hard, _NODES_PER_BIN_LARGE if large else _NODES_PER_BIN
    )
    plan = BakePlan(nodes, {}, _end_corrections(field, end, nodes, truth))
    trajectory = pinned_trajectory(field, end, plan)
    plan = replace(plan, ranks=_choose_ranks(trajectory, tolerance))
    form = NeuralForm(network, plan, rows_hash(rows) if network.shape.inputs == "own" else "")
    baked = bake_form(form, rows)
    return replace(baked, origin=replace(form, error=bake_error(field, baked, plan, render)))


def bake_nodes(bins: int, hard: bool, per_bin: int = _NODES_PER_BIN) -> Tensor:
    """Return the strengths at which to bake, ascending. [S] float32

    Smooth bins have `per_bin` nodes each, hard bins one on each side of every edge.
    """
    if not hard:
        return torch.linspace(0, 1, per_bin * bins + 1)
    edges = torch.arange(2, bins) / bins  # see `neural.hard_bin`; the last edge is at strength 1
    inner = torch.stack([edges - _EDGE_WIDTH, edges], dim=1).flatten()
    return torch.cat([torch.tensor([0.0, _EDGE_WIDTH]), inner, torch.tensor([1.0 - _EDGE_WIDTH, 1.0])])


def pinned_trajectory(field: Field, end: Tensor, plan: BakePlan) -> Tensor:
    """Return the field at the nodes, zero at the first and the recorded end at the last. [S,M,C] float32

    The field's error at the end is distributed over the nodes, so that nothing jumps when the slider reaches
    1.
    """
    offsets = torch.stack([field.offsets(float(s)) for s in plan.knots])
    offsets[0] = 0.0
    missing = end - offsets[-1]
    for name, columns in moving_attributes(offsets).items():
        if name in plan.end_correction:
            offsets[:, :, columns] += plan.end_correction[name][:, None, None] * missing[:, columns]
    offsets[-1] = end
    return offsets


def bake_error(field: Field, baked: BakedField, plan: BakePlan, render: Render | None) -> dict[str, float]:
    """Measure the error of nodes and factoring, at strengths between the nodes too; see `NeuralForm`."""
    end = baked.offsets(1.0)
    missing = end - field.offsets(1.0)
    error_power = power = 0.0
    psnrs = []
    for s in sample_strengths():
        pinned = field.offsets(s)
        for name, columns in moving_attributes(end[None]).items():
            if name in plan.end_correction:
                end_correction = interpolate_at(plan.knots, plan.end_correction[name], s)
                pinned[:, columns] += end_correction * missing[:, columns]
        offsets = baked.offsets(s)
        error_power += float((offsets - pinned).double().square().sum())
        power += float(pinned.double().square().sum())
        if render is not None:
            with torch.no_grad():
                difference = render(offsets) - render(pinned)
            psnrs.append(decibels(float(difference.double().square().mean()) if len(difference) else 0.0))
    error = {"rms": (error_power / power) ** 0.5 if power > 0 else 0.0}
    if psnrs:
        error |= {"psnr_mean": sum(psnrs) / len(psnrs), "psnr_worst": min(psnrs)}
    return {name: float(f"{value:.4g}") for name, value in error.items()}


def _end_corrections(
    field: Field, end: Tensor, nodes: Tensor, truth: Callable[[float], Tensor] | None
) -> dict[str, Tensor]:
    """Return the share of the end's error to correct at each node, by attribute; see `BakePlan`."""
    offsets = torch.stack([field.offsets(float(s)) for s in nodes])
    missing = end - offsets[-1]
    corrections = {}
    for name, columns in moving_attributes(torch.stack([end, offsets[-1]])).items():
        end_error = missing[:, columns].double()
        power = float(end_error.square().sum())
        if power == 0.0:
            continue
        if truth is None:
            share = fit_amplitude(offsets[:, :, columns], torch.ones_like(end[:, columns])).amplitude
        else:
            errors = [
                truth(float(s))[:, columns] - a[:, columns] for s, a in zip(nodes, offsets, strict=True)
            ]
            share = torch.tensor([float((e.double() * end_error).sum()) / power for e in errors])
        share[0] = 0.0
        share[-1] = 1.0
        corrections[name] = share.float()
    return corrections


def _choose_ranks(trajectory: Tensor, tolerance: float) -> dict[str, int]:
    """Return the fewest bases that reproduce each attribute's trajectory within `tolerance`. [S,M,C]"""
    ranks = {}
    for name, columns in moving_attributes(trajectory).items():
        fitted = fit_amplitude(trajectory[:, :, columns], torch.ones_like(trajectory[0, :, columns]))
        ranks[name] = min(fitted.needed_rank(tolerance), MAX_RANK, principal_modes(fitted.gram).shape[1])
    return ranks
