"""Baking: any field becomes the separable one that the viewer runs (method.md 5).

The field is asked at nodes, both ends are pinned to what they must be, and the course is factored. What the
nodes and the factoring cost is measured against the field itself.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from progdf.field.baked import BakedField
from progdf.field.neural import NeuralField
from progdf.field.separable import fit_separable, follow, leading_modes, moving_attributes

TOLERANCE = 0.01
"""Root mean square error of the factoring, as a share of the course's own root mean square."""

MOST_RANK = 12
_JUMP = 1e-5  # width of a hard bin's edge


class Field(Protocol):
    """Offsets of the members it was made for, at any strength."""

    @property
    def attributes(self) -> Collection[str]:
        """Names of the attributes that move."""
        ...

    def offsets(self, s: float) -> Tensor:
        """Packed raw-space offsets. [M,C] float32"""
        ...


@dataclass(frozen=True)
class BakePlan:
    """How a field is baked, kept in the file so that every load gives the same.

    Args:
        nodes: strengths at which the field is asked, ascending from 0 to 1. [S] float32
        ranks: bases beside the full offset, by attribute
    """

    nodes: Tensor
    ranks: Mapping[str, int]


def bake_nodes(bins: int, hard: bool, per_bin: int = 4) -> Tensor:
    """Strengths to bake at: `per_bin` to a smooth bin; both sides of every edge of hard ones. [S] float32"""
    if not hard:
        return torch.linspace(0, 1, per_bin * bins + 1)
    edges = torch.arange(1, bins) / bins
    inner = torch.stack([edges - _JUMP, edges], dim=1).flatten()
    return torch.cat([torch.tensor([0.0, _JUMP]), inner, torch.tensor([1.0 - _JUMP, 1.0])])


def pinned_course(field: Field, end: Tensor, nodes: Tensor) -> Tensor:
    """The field at the nodes, zero at the first and the recorded end at the last. [S,M,C] float32

    What the field misses of the end is spread over the way as its own course goes, so that the slider does
    not jump as it arrives: Δ(s) + a(s) (end − Δ(1)), a(s) the share of Δ(1) that Δ(s) has covered.

    Args:
        field: any
        end: the recorded offset at s = 1. [M,C]
        nodes: ascending from 0 to 1. [S]
    """
    asked = torch.stack([field.offsets(float(s)) for s in nodes])
    asked[0] = 0.0
    missing = end - asked[-1]
    for columns in moving_attributes(asked).values():
        lead = follow(asked[:, :, columns], torch.ones_like(end[:, columns])).lead
        asked[:, :, columns] += lead[:, None, None] * missing[:, columns]
    asked[-1] = end
    return asked


def bake(
    field: Field,
    end: Tensor,
    plan: BakePlan,
    kind: str,
    recorded: tuple[float, ...] = (),
) -> BakedField:
    """The separable form of a field; s = 0 is exactly zero, s = 1 exactly `end`.

    Args:
        field: any
        end: the recorded offset at s = 1. [M,C] float32
        plan: nodes and ranks
        kind: what the field was made as
        recorded: strengths for the slider's ticks
    """
    baked = fit_separable(plan.nodes, pinned_course(field, end, plan.nodes), plan.ranks, recorded=recorded)
    return replace(baked, kind=kind)


def planned(field: Field, end: Tensor, nodes: Tensor, tolerance: float = TOLERANCE) -> BakePlan:
    """The fewest bases with which each attribute's course is met to `tolerance` (relative, RMS)."""
    asked = pinned_course(field, end, nodes)
    ranks = {}
    for name, columns in moving_attributes(asked).items():
        course = follow(asked[:, :, columns], torch.ones_like(end[:, columns]))
        allowed = tolerance**2 * float(course.offsets.double().square().sum())
        power = torch.linalg.eigvalsh(course.gram).flip(0).clamp(min=0)
        left = float(power.sum()) - power.cumsum(0)
        needed = 0 if float(power.sum()) <= allowed else 1 + int((left > allowed).sum())
        ranks[name] = min(needed, MOST_RANK, leading_modes(course.gram)[0].shape[1])
    return BakePlan(nodes, ranks)


def bake_neural(field: NeuralField, rows: Tensor, plan: BakePlan) -> BakedField:
    """A neural field on its Gaussians, baked. `rows`: raw values of the members, packed. [M,≥14]"""
    end = torch.zeros(field.members, field.shape.channels)
    end[:, field.shape.columns] = field.end
    return bake(field.bound(rows), end, plan, "neural", field.recorded)
