"""Baked field, the only form that the viewer and `export` evaluate: Δ_i(s) = Σ_k B_ik a_k(s), per attribute.

Every kind of field (separable, keyframes, neural, grade) is converted to this form when it is loaded. Basis 0
is the full offset with a_0(0) = 0 and a_0(1) = 1. All others vanish at both ends. So s = 0 is the original,
and s = 1 is exactly the decoded basis 0. Stored in float32, it equals the recorded end. Stored in integers,
it defines the end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.io.tensors import check_ascent, check_levels, check_tensor, deflate, inflate
from progdf.system.equality import equal_fields

from .neural import NeuralField


class Segment(NamedTuple):
    """Position between two knots."""

    right: int  # index of the right knot, 1..S−1; the left knot precedes it
    share: float  # 0 at the left knot, exactly 1 at the right one; outside 0..1 beyond all knots


def find_segment(knots: Tensor, x: float) -> Segment:
    """Return the segment that contains `x`. A knot belongs to the segment on its left.

    The outer segments are unbounded.

    Args:
        knots: ascending, at least 2. [S]
        x: position in the knots' unit. It is compared in their precision
    """
    values = knots.numpy()  # numpy, because torch takes ten times as long for one position
    right = min(max(int(values.searchsorted(values.dtype.type(x))), 1), len(values) - 1)
    low = float(values[right - 1])
    high = float(values[right])
    return Segment(right, (x - low) / (high - low))


def interpolate_at(knots: Tensor, values: Sequence[Tensor] | Tensor, x: float) -> Tensor:
    """Interpolate linearly between values at knots [S], constant outside them. S × [...] -> [...]"""
    right, share = find_segment(knots, x)
    return torch.lerp(values[right - 1], values[right], min(max(share, 0.0), 1.0))


def interpolate(x: Tensor, knots: Tensor, values: Tensor) -> Tensor:
    """Interpolate like `interpolate_at` at many positions, with one number per knot. [n], [S], [S] -> [n]"""
    right = torch.searchsorted(knots, x).clamp(1, len(knots) - 1)
    share = (x - knots[right - 1]) / (knots[right] - knots[right - 1])
    return torch.lerp(values[right - 1], values[right], share.clamp(0, 1))


BASIS_TYPES = (torch.int8, torch.float16, torch.float32)
"""Storage types of bases 1..R."""

END_TYPES = (torch.int8, torch.int16, torch.float32)
"""Storage types of basis 0, smallest first."""

MAX_KNOTS = 257
"""Maximum number of knots of a baked network."""

MAX_RANK = 16
"""Maximum number of bases, beside the full offset, of a baked network, and of a grade's residual."""

_MIN_KNOT_DISTANCE = 1 / 80
"""Smallest distance from a remap's knot to the field's knots at which it adds a row of coefficients."""

_RANGE_MEMBERS = 1 << 11
"""Members whose offsets are summed at once."""


def member_ranges(members: int) -> list[slice]:
    """Return ranges of members for sums whose temporary arrays would be as large as the trajectory."""
    return [slice(begin, begin + _RANGE_MEMBERS) for begin in range(0, members, _RANGE_MEMBERS)]


@dataclass(frozen=True)
class AttributeBases:
    """Bases of one attribute with c channels, for M members."""

    __eq__ = equal_fields

    end_offset: Tensor  # basis 0, the offset at s = 1, in stored form. [M,c] int8, int16 or float32
    residual_basis: Tensor  # bases 1..R in stored form. [R,M,c] int8, float16 or float32
    scale: Tensor  # raw-space value of one stored unit, per basis (0 first) and channel. [1+R,c] float32
    coefficients: Tensor  # a_k at the knots; row 0 all 0, the last row 1, 0, …, 0. [S,1+R] float32

    def __post_init__(self) -> None:
        check_tensor("end_offset", self.end_offset, (None, None), *END_TYPES)
        check_tensor("residual_basis", self.residual_basis, (None, *self.end_offset.shape), *BASIS_TYPES)
        ranks, _, width = self.residual_basis.shape
        check_tensor("scale", self.scale, (1 + ranks, width), torch.float32)
        check_tensor("coefficients", self.coefficients, (None, 1 + ranks), torch.float32)
        if not len(self.coefficients):
            raise ValueError("coefficients has no knots")
        ends = self.coefficients[[0, -1]]
        if bool(ends[0].any()) or bool(ends[1, 1:].any()) or float(ends[1, 0]) != 1.0:
            raise ValueError("coefficients must be 0 at s = 0 and 1, 0, …, 0 at s = 1")

    @property
    def end(self) -> Tensor:
        """Offset at s = 1, raw space. [M,c] float32"""
        return self.end_offset.float() * self.scale[0]

    def take(self, members: Tensor) -> AttributeBases:
        """Return the bases of some members. [m] int64"""
        end = self.end_offset[members]
        return AttributeBases(end, self.residual_basis[:, members], self.scale, self.coefficients)

    @property
    def label(self) -> str:
        """Storage form, as in "int8 + 2": the type of the end, and the number of further bases."""
        ranks = len(self.residual_basis)
        return str(self.end_offset.dtype).removeprefix("torch.") + (f" + {ranks}" if ranks else "")

    @property
    def bytes_per_member(self) -> float:
        """Stored bytes per member of the region."""
        stored = self.end_offset[None], self.residual_basis
        return sum(len(part) * part.shape[2] * part.element_size() for part in stored)


@dataclass(frozen=True)
class BakePlan:
    """Parameters of baking a field, so that every load gives the same result."""

    __eq__ = equal_fields

    knots: Tensor  # strengths at which the field is evaluated, ascending from 0 to 1. [S] float32
    ranks: Mapping[str, int]  # bases in addition to the full offset, by attribute
    # share of the end's error to add at each knot, by attribute, 0 first, 1 last. [S] float32
    end_correction: Mapping[str, Tensor]

    def __post_init__(self) -> None:
        if self.knots.ndim != 1 or not 2 <= len(self.knots) <= MAX_KNOTS:
            raise ValueError(f"bake plan has knots {list(self.knots.shape)}, expected 2 to {MAX_KNOTS}")
        for name, rank in self.ranks.items():
            if not 0 <= rank <= MAX_RANK:
                raise ValueError(f"bake plan of {name} has {rank} bases, expected 0 to {MAX_RANK}")
        for name, share in self.end_correction.items():
            check_tensor(f"the end correction of {name}", share, self.knots.shape, torch.float32)


@dataclass(frozen=True)
class NeuralForm:
    """Stored form of a neural field."""

    network: NeuralField  # the trained network
    plan: BakePlan  # parameters of baking it
    # hash of the members' raw values that the network reads; "" if it reads positions only
    rows_sha256: str = ""
    # error of baking, between the pinned network and the baked field: "rms", relative, and with pictures
    # "psnr_mean" and "psnr_worst", dB
    error: Mapping[str, float] | None = None

    @property
    def members(self) -> int:
        """Number of members M."""
        return self.network.members

    @property
    def bytes_per_member(self) -> float:
        """Stored bytes per member, including its share of the network."""
        return self.network.bytes_per_member


@dataclass(frozen=True)
class SliderRemap:
    """Piecewise linear map from strengths on an old slider to positions on a new one."""

    __eq__ = equal_fields

    old: Tensor  # ascending from 0 to 1. [K] float64
    new: Tensor  # the same strengths on the new slider, ascending from 0 to 1. [K] float64

    def __post_init__(self) -> None:
        if self.old.shape != self.new.shape:
            raise ValueError(f"remap has {list(self.old.shape)} old and {list(self.new.shape)} new knots")
        for knots in (self.old, self.new):
            check_ascent("the knots of a remap", knots)

    def __call__(self, s: Tensor) -> Tensor:
        """Return new strengths for old ones, 0..1, exact at both ends. [n] -> [n] float64"""
        return interpolate(s.double(), self.old, self.new)

    @property
    def is_identity(self) -> bool:
        """True if the remap changes nothing."""
        return torch.equal(self.old, self.new)

    def at(self, s: float) -> float:
        """Return the new strength for one old strength."""
        return float(self(torch.tensor([s], dtype=torch.float64)))


def identity_remap() -> SliderRemap:
    """Return the slider remap that changes nothing."""
    ends = torch.tensor([0.0, 1.0], dtype=torch.float64)
    return SliderRemap(ends, ends)


MONOMIALS = {1: 4, 2: 10, 3: 20}
"""Degree → number of monomials of three channels up to that degree."""

LATTICE = 0
"""Value of `degree` for a map given at the points of a color cube, like a .cube file."""

MAX_SIDE = 129
"""Maximum number of points along an edge of a lattice. The largest that color programs write has 65."""


def lattice_colors(side: int) -> Tensor:
    """Return the colors at the points of a lattice over 0..1, red fastest. [side³,3]"""
    at = torch.linspace(0.0, 1.0, side)
    blue, green, red = torch.meshgrid(at, at, at, indexing="ij")
    return torch.stack([red, green, blue], dim=-1).reshape(-1, 3)


def lattice_side(points: int) -> int:
    """Return the number of points along an edge of a lattice.

    Raises:
        ValueError: the number of points is not a cube of 2 to `MAX_SIDE`.
    """
    side: int = round(points ** (1 / 3))
    if side**3 != points or not 2 <= side <= MAX_SIDE:
        raise ValueError(f"lattice has {points} colors, expected the cube of 2 to {MAX_SIDE}")
    return side


def identity_map(degree: int, points: int = 0) -> Tensor:
    """Return the map that changes no color. `points`: number of points of a lattice. [K,3]"""
    if degree == LATTICE:
        return lattice_colors(lattice_side(points))
    table = torch.zeros(MONOMIALS[degree], 3)
    table[1:4] = torch.eye(3)
    return table


@dataclass(frozen=True)
class GradeForm:
    """Stored form of a grade field.

    Raises:
        ValueError: its parts do not fit each other.
    """

    __eq__ = equal_fields

    degree: int  # degree of the map, 1 to 3, or `LATTICE`
    knots: Tensor  # strengths at which the map is given, ascending from 0 to 1. [S] float32
    table: Tensor  # the map at each knot; the identity at the first. [S,K,3] float32
    residual: Tensor  # bases for the B SH functions of the lowest bands, as stored. [R,M,3B] int8
    scale: Tensor  # value of one unit of the bases. [R,3B] float32
    coefficients: Tensor  # coefficients of the bases at each knot; 0 at the first. [S,R] float32
    remap: SliderRemap = field(default_factory=identity_remap)  # from these knots to the slider
    mask: Tensor | None = None  # share of the map per member, in 255ths; None: all. [M] uint8

    def __post_init__(self) -> None:
        if self.degree not in (LATTICE, *MONOMIALS) or self.table.ndim != 3:
            raise ValueError(f"grade has degree {self.degree}, expected 0 to 3")
        knots = len(self.knots)
        numbers = MONOMIALS.get(self.degree, self.table.shape[1])
        check_tensor("residual", self.residual, (None, None, None), torch.int8)
        ranks, members, channels = self.residual.shape
        check_tensor("table", self.table, (knots, numbers, 3), torch.float32)
        check_tensor("coefficients", self.coefficients, (knots, ranks), torch.float32)
        check_tensor("scale", self.scale, (ranks, channels), torch.float32)
        check_ascent("knots", self.knots)
        if ranks > MAX_RANK or (self.degree == LATTICE and knots > 2):
            raise ValueError(
                f"grade has {ranks} bases and {knots} knots, expected at most {MAX_RANK} bases, and at most "
                "2 knots for a lattice"
            )
        if channels not in (0, 3, 12, 27, 48):
            raise ValueError(f"residual has {channels} channels, expected whole bands")
        if self.mask is not None:
            check_tensor("mask", self.mask, (members,), torch.uint8)
        if bool(self.coefficients[0].any()) or not torch.equal(
            self.table[0], identity_map(self.degree, numbers)
        ):
            raise ValueError("the map must be the identity and the residual 0 at strength 0")

    @property
    def members(self) -> int:
        """Number of members M."""
        return int(self.residual.shape[1])

    def take(self, members: Tensor) -> GradeForm:
        """Return the grade of some members. [m] int64"""
        mask = None if self.mask is None else self.mask[members]
        return replace(self, residual=self.residual[:, members], mask=mask)

    @property
    def share(self) -> Tensor:
        """Share of the map per member, 0..1. [M] float32"""
        return torch.ones(self.members) if self.mask is None else self.mask.float() / 255.0

    @property
    def label(self) -> str:
        """Description, as in "grade of degree 2, a mask, 2 bases of DC"."""
        kind = f"degree {self.degree}" if self.degree else f"{lattice_side(self.table.shape[1])}³ colors"
        mask = "" if self.mask is None else "a mask, "
        bases = len(self.residual)
        residual = "no residual"
        if bases:
            bands = {12: "two bands", 27: "three bands"}.get(self.residual.shape[2], "DC")
            residual = f"{bases} {'basis' if bases == 1 else 'bases'} of {bands}"
        return f"grade of {kind}, {mask}{residual}"

    @cached_property
    def packed_levels(self) -> dict[str, Tensor]:
        """Data per member in stored form, see `deflate`. [B] uint8 each

        "residual" holds the nonzero levels, "functions" a bit per member and SH function that has levels, and
        "mask" the share of the map.
        """
        packed = dict[str, Tensor]()
        if len(self.residual):
            bases, members, channels = self.residual.shape
            levels = self.residual.view(bases, members, channels // 3, 3).permute(0, 3, 2, 1)
            functions = levels.any(dim=0).any(dim=0)
            bits = torch.from_numpy(np.packbits(functions.numpy()))
            packed = {"functions": deflate(bits), "residual": deflate(levels[:, :, functions])}
        return packed if self.mask is None else packed | {"mask": deflate(self.mask)}

    @property
    def bytes_per_member(self) -> float:
        """Stored bytes per member. The map belongs to the region and is not included."""
        return sum(map(len, self.packed_levels.values())) / max(1, self.members)


def unpack_levels(functions: Tensor, levels: Tensor, bases: int, members: int, channels: int) -> Tensor:
    """Decode `GradeForm.packed_levels`. [B] uint8 each -> [R,M,3b] int8

    Raises:
        ValueError: the two arrays do not fit each other.
    """
    check_levels((bases, members, channels))
    bits = inflate(functions, (-(-channels // 3 * members // 8),), torch.uint8)
    present = torch.from_numpy(np.unpackbits(bits.numpy(), count=channels // 3 * members)).bool()
    residual = torch.zeros(bases, 3, len(present), dtype=torch.int8)
    residual[:, :, present] = inflate(levels, (bases, 3, int(present.sum())), torch.int8)
    return residual.view(bases, 3, channels // 3, members).permute(0, 3, 2, 1).flatten(2)


@dataclass(frozen=True)
class BakedField:
    """Field as stored bases of M members and their coefficients over the strength."""

    __eq__ = equal_fields

    kind: str  # "grade", "separable", "keyframes" or "neural"
    knots: Tensor  # strengths at which the coefficients are given, ascending, first 0, last 1. [S] float32
    attributes: Mapping[str, AttributeBases]  # by name, see `ATTRIBUTES`; unchanged attributes are absent
    channels: int  # width of a packed row: 14, or 14 + 3K when shN changes
    recorded: tuple[float, ...] = ()  # strengths of the recorded snapshots, for the slider's ticks
    origin: NeuralForm | GradeForm | None = None  # form it was baked from, which a file stores instead

    def __post_init__(self) -> None:
        check_tensor("knots", self.knots, (None,), torch.float32)
        check_ascent("knots", self.knots)
        slices = attribute_slices(self.channels)
        counts = {bases.end_offset.shape[0] for bases in self.attributes.values()}
        if len(counts) > 1:
            raise ValueError(f"the attributes have different numbers of members: {sorted(counts)}")
        for name, bases in self.attributes.items():
            if name not in slices or slices[name].stop - slices[name].start != bases.end_offset.shape[1]:
                raise ValueError(
                    f"{name} has {bases.end_offset.shape[1]} channels, which do not fit a packed row"
                )
            if bases.coefficients.shape[0] != len(self.knots):
                raise ValueError(
                    f"{name} has coefficients for {bases.coefficients.shape[0]} knots of {len(self.knots)}"
                )

    @property
    def members(self) -> int:
        """Number of members M."""
        return next((int(bases.end_offset.shape[0]) for bases in self.attributes.values()), 0)

    @property
    def bytes_per_member(self) -> float:
        """Bytes on disk per member of the region."""
        return self.baked_bytes_per_member if self.origin is None else self.origin.bytes_per_member

    @property
    def baked_bytes_per_member(self) -> float:
        """Bytes in memory per member, which a slider step reads."""
        return sum(bases.bytes_per_member for bases in self.attributes.values())

    def coefficients(self, name: str, s: float) -> Tensor:
        """Return a_0(s) … a_R(s) of one attribute, piecewise linear between the knots. [1+R] float32

        Outside 0..1 (overshoot) the last segment continues. That is an extrapolation, not a recorded edit.
        """
        table = self.attributes[name].coefficients
        right, share = find_segment(self.knots, s)
        if share == 1.0:
            return table[right]
        return table[right - 1] + share * (table[right] - table[right - 1])

    def factors(self, name: str, s: float) -> Tensor:
        """Return the factor of each stored basis of one attribute at `s`. [1+R,c] float32"""
        return self.coefficients(name, s)[:, None] * self.attributes[name].scale

    def attribute_offsets(self, name: str, s: float) -> Tensor:
        """Return raw offsets of one attribute at strength `s`; exactly 0 at 0, `end` at 1. [M,c] float32"""
        total = torch.zeros(self.attributes[name].end_offset.shape)
        self._add_offsets(name, s, total)
        return total

    def _add_offsets(self, name: str, s: float, total: Tensor) -> None:
        """Write `attribute_offsets` into zeros, for some members at a time. [M,c]"""
        bases = self.attributes[name]
        weights = self.coefficients(name, s).tolist()
        factors = self.factors(name, s)
        if not any(weights):
            return
        for part in member_ranges(len(total)):
            offsets = factors[0] * bases.end_offset[part].float()
            for weight, factor, basis in zip(weights[1:], factors[1:], bases.residual_basis, strict=True):
                if weight != 0.0:
                    offsets += factor * basis[part].float()
            total[part] = offsets

    def offsets(self, s: float) -> Tensor:
        """Return offsets of the raw parameters at strength `s`, packed as in `gaussians.pack`. [M,C] float32

        This is the plain form. `compose_layers` computes the same sum without building the packed rows.
        """
        packed = torch.zeros(self.members, self.channels)
        slices = attribute_slices(self.channels)
        for name in self.attributes:
            self._add_offsets(name, s, packed[:, slices[name]])
        return packed


def remap_slider(field: BakedField, remap: SliderRemap) -> BakedField:
    """Return the field under another slider.

    Its knots move, and a knot is added where the remap bends far from all of them. No basis changes, so the
    bytes per member and both ends stay the same, bit for bit.

    Args:
        field: any field but a network, whose slider is learned. A grade must not have a remap yet
        remap: from the field's strengths to the new ones

    Raises:
        ValueError: the field is a network's.
    """
    if isinstance(field.origin, NeuralForm):
        raise ValueError("the slider of a neural field cannot be remapped; use another kind of field")
    origin = None if field.origin is None else replace(field.origin, remap=remap)
    old = field.knots.double()
    far = (remap.old[:, None] - old).abs().amin(dim=1) > _MIN_KNOT_DISTANCE
    knots = torch.cat([old, remap.old[far]]).sort().values
    moved = remap(knots).float()
    distinct = torch.ones(len(knots), dtype=torch.bool)
    distinct[1:] = moved.diff() > 0  # in float32 two knots may coincide
    distinct[:-1] &= moved[:-1] < 1.0
    distinct[-1] = True
    attributes = {
        name: replace(
            bases, coefficients=torch.stack([field.coefficients(name, float(s)) for s in knots[distinct]])
        )
        for name, bases in field.attributes.items()
    }
    ticks = remap(torch.tensor(field.recorded, dtype=torch.float64)).tolist()
    return replace(field, knots=moved[distinct], attributes=attributes, recorded=tuple(ticks), origin=origin)
