"""The only field that the viewer and `export` run: Δ_i(s) = Σ_k B_ik a_k(s), per attribute.

Every kind of field (separable, keyframes, neural) becomes one of these when it is loaded. Basis 0 is the full
offset in float32 with a_0(0) = 0 and a_0(1) = 1, all others vanish at both ends, so s = 0 is the original and
s = 1 the recorded end without any rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices

if TYPE_CHECKING:
    from .bake import NeuralForm

REST_TYPES = (torch.int8, torch.float16, torch.float32)
"""How bases 1..R may be stored."""


@dataclass(frozen=True)
class AttributeBases:
    """One attribute's bases for M members of c channels each.

    Args:
        full: basis 0, the offset at s = 1, raw space. [M,c] float32
        rest: bases 1..R as stored. [R,M,c] int8, float16 or float32
        step: what one unit of `rest` is worth, per basis and channel. [R,c] float32
        coefficients: a_k at the field's nodes; row 0 is all 0, the last row is 1, 0, …, 0. [S,1+R] float32
    """

    full: Tensor
    rest: Tensor
    step: Tensor
    coefficients: Tensor

    def __post_init__(self) -> None:
        if self.full.ndim != 2 or self.rest.ndim != 3:
            raise ValueError(
                f"full is {list(self.full.shape)}, rest {list(self.rest.shape)}; expected [M,c], [R,M,c]"
            )
        members, width = self.full.shape
        ranks = self.rest.shape[0]
        if self.rest.dtype not in REST_TYPES:
            raise ValueError(f"rest is {self.rest.dtype}, expected int8, float16 or float32")
        for name in ("full", "step", "coefficients"):
            if getattr(self, name).dtype != torch.float32:
                raise ValueError(f"{name} is {getattr(self, name).dtype}, expected float32")
        if tuple(self.rest.shape[1:]) != (members, width) or tuple(self.step.shape) != (ranks, width):
            raise ValueError(
                f"rest {list(self.rest.shape)} or step {list(self.step.shape)} does not fit full"
            )
        if self.coefficients.ndim != 2 or self.coefficients.shape[1] != 1 + ranks:
            raise ValueError(f"coefficients is {list(self.coefficients.shape)}, expected [S, {1 + ranks}]")
        if not len(self.coefficients):
            raise ValueError("coefficients has no nodes")
        ends = self.coefficients[[0, -1]]
        if bool(ends[0].any()) or bool(ends[1, 1:].any()) or float(ends[1, 0]) != 1.0:
            raise ValueError("coefficients must be 0 at s = 0 and 1, 0, …, 0 at s = 1")

    @property
    def bytes_per_member(self) -> float:
        """Stored bytes for one member of the region."""
        full = self.full.shape[1] * self.full.element_size()
        return full + self.rest.shape[0] * self.rest.shape[2] * self.rest.element_size()


@dataclass(frozen=True)
class BakedField:
    """A field ready to run, for the members it was made for.

    Args:
        kind: what it was made as: "separable", "keyframes" or "neural"
        nodes: strengths at which the coefficients are given, ascending, first 0, last 1. [S] float32
        attributes: bases by attribute name (see gaussians.ATTRIBUTES); one that does not move is absent
        channels: width of a packed row, 14, or 14 + 3K when shN moves
        recorded: strengths of the recorded snapshots, for the slider's ticks
        origin: the network that it was baked from and that a file keeps in its place; None: it is kept itself
    """

    kind: str
    nodes: Tensor
    attributes: Mapping[str, AttributeBases]
    channels: int
    recorded: tuple[float, ...] = ()
    origin: NeuralForm | None = None

    def __post_init__(self) -> None:
        if self.nodes.ndim != 1 or self.nodes.dtype != torch.float32:
            raise ValueError(f"nodes is {list(self.nodes.shape)} {self.nodes.dtype}, expected float32 [S]")
        if len(self.nodes) < 2 or float(self.nodes[0]) != 0.0 or float(self.nodes[-1]) != 1.0:
            raise ValueError("nodes must run from 0 to 1")
        if bool((self.nodes[1:] <= self.nodes[:-1]).any()):
            raise ValueError("nodes must ascend")
        slices = attribute_slices(self.channels)
        counts = {bases.full.shape[0] for bases in self.attributes.values()}
        if len(counts) > 1:
            raise ValueError(f"the attributes have different numbers of members: {sorted(counts)}")
        for name, bases in self.attributes.items():
            if name not in slices or slices[name].stop - slices[name].start != bases.full.shape[1]:
                raise ValueError(f"{name} has {bases.full.shape[1]} channels, which do not fit a packed row")
            if bases.coefficients.shape[0] != len(self.nodes):
                raise ValueError(
                    f"{name} has coefficients for {bases.coefficients.shape[0]} nodes of {len(self.nodes)}"
                )

    @property
    def members(self) -> int:
        """Number of members M."""
        return next((int(bases.full.shape[0]) for bases in self.attributes.values()), 0)

    @property
    def bytes_per_member(self) -> float:
        """Bytes on disk for one member of the region, of a network its share."""
        if self.origin is not None:
            return self.origin.network.bytes_per_member
        return self.baked_bytes_per_member

    @property
    def baked_bytes_per_member(self) -> float:
        """Bytes in memory for one member, which a slider step has to read."""
        return sum(bases.bytes_per_member for bases in self.attributes.values())

    def coefficients(self, name: str, s: float) -> Tensor:
        """a_0(s) … a_R(s) of one attribute, piecewise linear between the nodes. [1+R] float32

        Outside 0..1 (overshoot) the last segment is continued: that is extrapolation, not a recorded edit.
        """
        table = self.attributes[name].coefficients
        right = int(torch.searchsorted(self.nodes, torch.tensor(s, dtype=self.nodes.dtype)))
        right = min(max(right, 1), len(self.nodes) - 1)
        left_s, right_s = float(self.nodes[right - 1]), float(self.nodes[right])
        if s == right_s:
            return table[right]
        share = (s - left_s) / (right_s - left_s)
        return table[right - 1] + share * (table[right] - table[right - 1])

    def attribute_offsets(self, name: str, s: float) -> Tensor:
        """Offsets of one attribute at strength `s`, raw space; exactly 0 at 0, `full` at 1. [M,c] float32"""
        bases = self.attributes[name]
        weights = self.coefficients(name, s)
        if not bool(weights.any()):
            return torch.zeros_like(bases.full)
        total = weights[0] * bases.full
        for k in range(bases.rest.shape[0]):
            if float(weights[1 + k]) != 0.0:
                total = total + (weights[1 + k] * bases.step[k]) * bases.rest[k].float()
        return total

    def offsets(self, s: float) -> Tensor:
        """Offsets of the raw parameters at strength `s`, packed as in `gaussians.pack`. [M,C] float32

        This is the plain form; `compose_layers` runs the same sum without building the packed rows.
        """
        packed = torch.zeros(self.members, self.channels)
        slices = attribute_slices(self.channels)
        for name in self.attributes:
            packed[:, slices[name]] = self.attribute_offsets(name, s)
        return packed
