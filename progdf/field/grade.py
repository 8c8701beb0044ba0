"""Grade field: one color map for the whole region, and a small residual per Gaussian.

At each knot of the slider the map is a polynomial of the drawn color q = clamp(SH color, 0, 1.5):
color' = Σ_k c_k m_k(q), with m_k the monomials up to the degree. The map of a .cube file is linear between
the points of its lattice, on q = clamp(SH color, 0, 1).

The mapped colors are spherical harmonics of the members. They are computed from the scene's coefficients when
the field is loaded. So a file stores only a few hundred numbers, and any renderer of Gaussians draws the
result. A pattern adds a mask: one byte per Gaussian, the share of the map that it takes. The remainder per
Gaussian is a residual of the lowest bands, stored in a small number of int8 bases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from progdf.gaussians import BASE_CHANNELS
from progdf.sh import C0, basis
from progdf.system.equality import equal_fields

from .baked import (
    LATTICE,
    MAX_RANK,
    BakedField,
    GradeForm,
    Segment,
    find_segment,
    identity_map,
    interpolate,
    lattice_colors,
    lattice_side,
    member_ranges,
    remap_slider,
)
from .separable import fit_course

MAX_COLOR = 1.5
"""Upper limit of the map's input. No screen shows brighter colors."""

_FIRST_BAND = BASE_CHANNELS - 3  # column of band 0 in a packed row; the higher bands follow
_DIRECTIONS = 32  # directions in which a member's color is mapped; twice the 16 SH functions of degree 3
_CHUNK_MEMBERS = 1 << 11  # members that are mapped at once
MAX_RESIDUALS = MAX_RANK // 2
"""Maximum number of residual bases to try. Each may be stored as two."""

RESIDUAL_STEPS = tuple(2.0 ** (i / 8) for i in range(-8, 25))
"""Step sizes to try for a residual's levels. At step size 1, nearly all members fit into 8 bits."""

_FITTING_SHARE = 0.999  # share of the members that fit into 8 bits: outliers must not coarsen all levels


def monomials(colors: Tensor, degree: int) -> Tensor:
    """Return the monomials of colors up to a degree, 1 first. [3,...] -> [K,...]"""
    red, green, blue = colors
    terms = [torch.ones_like(red), red, green, blue]
    if degree >= 2:
        terms += [red * red, green * green, blue * blue, red * green, green * blue, blue * red]
    if degree >= 3:
        squares = terms[4:7]
        terms += [square * color for square, color in zip(squares, colors, strict=True)]
        terms += [squares[0] * green, squares[0] * blue, squares[1] * red, squares[1] * blue]
        terms += [squares[2] * red, squares[2] * green, red * green * blue]
    return torch.stack(terms)


@cache
def sphere(degree: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return SH functions in evenly spread directions, and their pseudoinverse. [D,B], [B,D] float32"""
    index = torch.arange(_DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / _DIRECTIONS
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = (1 - z * z).sqrt()
    values = basis(degree, torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1))
    return values.float().to(device), torch.linalg.pinv(values).float().to(device)


def map_colors(sh: Tensor, table: Tensor, degree: int) -> Tensor:
    """Return spherical harmonics that show, from all directions, the mapped colors of the given ones.

    Drawn colors are clamped at 0, so any negative value represents black. Members with negative colors are
    therefore projected a second time, without the directions in which they are black before and after. (More
    rounds, and 48 directions, gain 0.01 dB.) The identity returns all coefficients unchanged, bit for bit.

    Args:
        sh: coefficients of B SH functions for M members. [M,B,3]
        table: the map. [K,3]
        degree: degree of the map

    Returns:
        [M,B,3]
    """
    bands = sh.shape[1]
    if torch.equal(table, identity_map(degree, len(table)).to(table)):
        return sh.clone()
    if bands == 1:
        colors = sh[:, 0].T * C0 + 0.5
        mapped = map_drawn(colors, table, degree)
        hidden = ((mapped <= 0.0) & (colors <= 0.0)).T
        return torch.where(hidden, sh[:, 0], (mapped.T - 0.5) / C0)[:, None]
    chunks: tuple[Tensor, ...] = torch.split(sh.movedim(2, 0), _CHUNK_MEMBERS, dim=1)
    return torch.cat([_map_chunk(chunk, table, degree) for chunk in chunks], dim=1).movedim(0, 2).contiguous()


def map_drawn(colors: Tensor, table: Tensor, degree: int) -> Tensor:
    """Return the mapped colors. A polynomial keeps the excess above `MAX_COLOR`. [3,...] -> [3,...]"""
    if degree == LATTICE:
        return look_up(colors.clamp(0.0, 1.0), table)
    terms = monomials(colors.clamp(0.0, MAX_COLOR), degree).flatten(1)
    return (table.T @ terms).reshape(colors.shape) + (colors - MAX_COLOR).clamp_min(0.0)


def look_up(colors: Tensor, table: Tensor) -> Tensor:
    """Interpolate linearly between the 8 lattice points around a color, 0..1. [3,...], [K,3] -> [3,...]"""
    side = lattice_side(len(table))
    lattice = table.T.reshape(1, 3, side, side, side)  # blue, green, red
    positions = (2.0 * colors.flatten(1).T - 1.0)[None, None, None]
    return grid_sample(lattice, positions, align_corners=True)[0, :, 0, 0].reshape(colors.shape)


def _map_chunk(sh: Tensor, table: Tensor, degree: int) -> Tensor:
    """Apply `map_colors` to some members, channels first. [3,m,B] -> [3,m,B]"""
    values, inverse = sphere(math.isqrt(sh.shape[2]) - 1, sh.device)
    colors = sh @ values.T + 0.5
    mapped = map_drawn(colors, table, degree)
    return _project_colors(sh, colors, mapped, values, inverse)


def _project_colors(sh: Tensor, colors: Tensor, mapped: Tensor, values: Tensor, inverse: Tensor) -> Tensor:
    """Return the coefficients of mapped colors in the directions of `sphere`, see `map_colors`.

    Args:
        sh: coefficients before. [3,m,B]
        colors, mapped: colors before and after. [3,m,D]
        values, inverse: see `sphere`
    """
    new_sh = sh + (mapped - colors.clamp_min(0.0)) @ inverse.T
    clamped = (colors.amin(dim=2) < 0.0) | (mapped.amin(dim=2) < 0.0)
    clamped_sh = new_sh[clamped]
    target = mapped[clamped]
    drawn = clamped_sh @ values.T + 0.5
    new_sh[clamped] += (target - drawn).masked_fill_((target <= 0.0) & (drawn <= 0.0), 0.0) @ inverse.T
    return new_sh


def member_bands(rows: Tensor) -> Tensor:
    """Return the SH coefficients of packed rows that are drawn, B ≤ 16. [M,14+3K] -> [M,B,3]"""
    return rows[:, _FIRST_BAND:].reshape(len(rows), -1, 3)[:, :16].contiguous()


def band_offsets(change: Tensor, channels: int) -> Tensor:
    """Return a change of the lowest bands as packed offsets. [M,B,3] -> [M,channels]"""
    return pad(change.flatten(1), (_FIRST_BAND, channels - _FIRST_BAND - 3 * change.shape[1]))


def mapped_bands(form: GradeForm, rows: Tensor) -> Tensor:
    """Return the map's change of the members' bands at each knot. [M,14+3K] -> [S,M,3B]"""
    sh = member_bands(rows)
    share = form.share[:, None]
    changes = torch.empty(len(form.table), *sh.flatten(1).shape)
    for part in member_ranges(len(sh)):
        mapped = map_colors_along(sh[part], form.table, form.degree)
        changes[:, part] = share[part] * (mapped - sh[part]).flatten(2)
    return changes


def map_colors_along(sh: Tensor, tables: Tensor, degree: int) -> Tensor:
    """Return `map_colors` by several maps, which share the monomials. [m,B,3], [S,K,3] -> [S,m,B,3]"""
    bands = sh.shape[1]
    if bands == 1 or degree == LATTICE:
        return torch.stack([map_colors(sh, table, degree) for table in tables])
    identity = identity_map(degree, tables.shape[1]).to(tables)
    values, inverse = sphere(math.isqrt(bands) - 1, sh.device)
    channels = sh.movedim(2, 0)
    colors = channels @ values.T + 0.5
    limited = colors.clamp(0.0, MAX_COLOR)
    excess = (colors - MAX_COLOR).clamp_min(0.0)
    terms = monomials(limited, degree).flatten(1)
    mapped_sh = []
    for table in tables:
        if torch.equal(table, identity):
            mapped_sh.append(sh)
            continue
        mapped = (table.T @ terms).reshape(colors.shape) + excess
        mapped_sh.append(_project_colors(channels, colors, mapped, values, inverse).movedim(0, 2))
    return torch.stack(mapped_sh)


def bake_grade(form: GradeForm, rows: Tensor, mapped: Tensor | None = None) -> BakedField:
    """Return the baked field of a grade.

    Args:
        form: stored form
        rows: raw values of the members before the edit, packed. [M,14+3K]
        mapped: result of `mapped_bands`, if already known; it is overwritten, as it may be large

    Raises:
        ValueError: the number of Gaussians differs, or they have fewer bands than the residual.
    """
    width = form.residual.shape[2]
    if len(rows) != form.members or width // 3 > member_bands(rows).shape[1]:
        raise ValueError(
            f"grade of {form.members} members does not fit {len(rows)} rows of {rows.shape[1]} numbers"
        )
    changes = mapped_bands(form, rows) if mapped is None else mapped
    if len(form.residual):
        for part in member_ranges(len(rows)):
            changes[:, part, :width] += torch.einsum(
                "sr,rmc->smc", form.coefficients, form.residual[:, part] * form.scale[:, None]
            )
    higher = rows.shape[1] - BASE_CHANNELS
    shN = changes[:, :, 3:]
    if shN.shape[2] < higher:  # bands that are not drawn
        shN = pad(shN, (0, higher - shN.shape[2]))
    parts = {"sh0": changes[:, :, :3], "shN": shN}
    attributes = {name: fit_course(part) for name, part in parts.items() if bool(part.any())}
    knots = form.knots.tolist()
    baked = BakedField("grade", form.knots, attributes, rows.shape[1], tuple(knots), form)
    return baked if form.remap.is_identity else remap_slider(baked, form.remap)


def adjust_colors(
    form: GradeForm,
    sh: Tensor,
    members: Tensor | slice,
    s: float,
    shares: tuple[Tensor, float] | None = None,
) -> Tensor:
    """Return the change by a grade at strength `s`, applied to colors that other layers have changed.

    Args:
        form: the grade
        sh: coefficients of these members in the layers below. [m,B,3]
        members: indices of these members in the grade
        s: slider value; beyond 1 the last segment continues
        shares: shares of the map for all members [M], and of the residual; None: those of the grade

    Returns:
        [m,B,3]; exactly 0 at 0, and the map and residual of the file at 1
    """
    right, share = _segment(form, s)
    if form.degree == LATTICE:  # colors above 1 change linearly too
        change = share * (map_colors(sh, form.table[right], LATTICE) - sh)
    else:
        change = map_colors(sh, map_at(form, s), form.degree) - sh
    map_shares, residual_share = (form.share, 1.0) if shares is None else shares
    change = map_shares[members, None, None] * change
    if len(form.residual) and residual_share:
        row = residual_share * torch.lerp(form.coefficients[right - 1], form.coefficients[right], share)
        residual = (form.residual[:, members] * (row[:, None] * form.scale)[:, None]).sum(dim=0)
        change[:, : residual.shape[1] // 3] += residual.reshape(len(sh), -1, 3)
    return change


def map_share(field: BakedField) -> Tensor:
    """Return the map's share of each member's change at strength 1: 1 − |residual|² / |map|², 0..1. [M]

    It is 0 where the residual undoes the map, as between stripes, or is as large as the map's change.
    """
    form = field.origin
    moved = field.attributes
    ends = [moved[name].end for name in ("sh0", "shN") if name in moved]
    if not isinstance(form, GradeForm) or not len(form.residual) or not ends:
        return torch.ones(field.members)
    change = torch.cat(ends, dim=1)
    residual = torch.zeros_like(change)
    scaled = form.residual * form.scale[:, None]
    residual[:, : scaled.shape[2]] = torch.einsum("r,rmc->mc", form.coefficients[-1], scaled)
    ratio = residual.square().sum(dim=1) / (change - residual).square().sum(dim=1)
    return (1.0 - ratio).clamp(0.0, 1.0).nan_to_num(1.0)


def map_at(form: GradeForm, s: float) -> Tensor:
    """Return the map of a grade at slider value `s`. [K,3]"""
    right, share = _segment(form, s)
    return torch.lerp(form.table[right - 1], form.table[right], share)


def _segment(form: GradeForm, s: float) -> Segment:
    at = form.remap.new.new_tensor([s])
    return find_segment(form.knots, float(interpolate(at, form.remap.new, form.remap.old)) if s < 1.0 else s)


def mapped_lattice(form: GradeForm, s: float, side: int) -> Tensor:
    """Return the mapped colors of a lattice at strength `s`, see `lattice_colors`. [side³,3]"""
    return map_drawn(lattice_colors(side).T, map_at(form, s), form.degree).T


def lattice_form(table: Tensor) -> GradeForm:
    """Return the grade of a lattice without members: a linear change to the colors of the table. [K,3]"""
    ends = torch.stack([lattice_colors(lattice_side(len(table))), table])
    return map_form(torch.tensor([0.0, 1.0]), LATTICE, ends, 0)


def map_alone(form: GradeForm, members: int) -> GradeForm:
    """Return the map of a grade without residual, for the given number of members of any scene."""
    return replace(map_form(form.knots, form.degree, form.table, members), remap=form.remap)


def map_form(knots: Tensor, degree: int, table: Tensor, members: int) -> GradeForm:
    """Return a grade without residual. [S], [S,K,3]"""
    no_residual = torch.zeros(0, members, 0, dtype=torch.int8)
    return GradeForm(degree, knots, table, no_residual, torch.zeros(0, 0), torch.zeros(len(knots), 0))


def fit_grade(
    knots: Tensor,
    degree: int,
    table: Tensor,
    course: Tensor,
    rank: int,
    weights: Tensor,
    mask: Tensor | None = None,
    coarser: float = 1.0,
    bases: tuple[Tensor, float] | None = None,
) -> GradeForm:
    """Fit a grade whose residual has a given number of bases.

    Args:
        knots: strengths, ascending from 0 to 1. [S]
        degree: degree of the map
        table: map at each knot, the identity at the first. [S,K,3]
        course: residual of the members' lowest bands at each knot; 0 at the first. [S,M,3b]
        rank: number of bases, at most `rank_limit`
        weights: visibility of an error in each member, ≥ 0. [M]
        mask: see `GradeForm`
        coarser: step size in units of the 8-bit step; larger steps compress better
        bases: result of `residual_bases` for this rank, if already known
    """
    exact, largest = bases or residual_bases(course, rank, weights)
    step = coarser / 127.0 * largest
    levels = torch.empty(exact.shape, dtype=torch.int8)
    overflow = torch.empty_like(levels)  # overflow of outliers, stored in bases of their own
    for part in member_ranges(exact.shape[1]):
        rounded = (exact[:, part] / (step or 1.0)).round_().clamp_(-254.0, 254.0)
        levels[:, part] = rounded.clamp(-127.0, 127.0).to(torch.int8)
        overflow[:, part] = (rounded - levels[:, part]).to(torch.int8)
    levels = torch.cat([levels, overflow[overflow.flatten(1).any(dim=1)]])
    scale = torch.full((len(levels), exact.shape[2]), step or 1.0)
    normal = torch.zeros(len(levels), len(levels), dtype=torch.float64)
    pull = torch.zeros(len(course), len(levels), dtype=torch.float64)
    for part in member_ranges(exact.shape[1]):
        columns = levels[:, part] * scale[:, None]
        weighted = (columns * weights[part, None]).flatten(1).T
        normal += columns.flatten(1) @ weighted
        pull += course[:, part].flatten(1) @ weighted
    coefficients = pull @ torch.linalg.pinv(normal, rtol=1e-9, hermitian=True)
    coefficients[0] = 0.0
    return GradeForm(degree, knots.float(), table.float(), levels, scale, coefficients.float(), mask=mask)


def residual_bases(course: Tensor, rank: int, weights: Tensor) -> tuple[Tensor, float]:
    """Return the best bases of a residual, and the value that nearly all members stay within.

    One value serves all channels, as all are colors: those with small changes get few levels and compress
    well.

    Args:
        course, rank, weights: see `fit_grade`

    Returns:
        [R,M,3b]; the largest value of `_FITTING_SHARE` of the members, over all bases and channels
    """
    mix = _basis_shares(course, weights)[:, :rank].T
    exact = (mix @ course.flatten(1)).reshape(rank, *course.shape[1:])
    return exact, max(map(_fitting_value, exact), default=0.0)


def _basis_shares(course: Tensor, weights: Tensor) -> Tensor:
    """Return the share of each knot in each of the best bases, strongest first. [S,S] float32"""
    products = torch.zeros(len(course), len(course), dtype=torch.float64)
    for part in member_ranges(course.shape[1]):
        rows = (course[:, part] * weights[part, None].sqrt()).flatten(1)
        products += rows @ rows.T
    _, vectors = torch.linalg.eigh(products)
    shares: Tensor = vectors.flip(1).float()
    return shares


@dataclass(frozen=True)
class ResidualBases:
    """Exact bases of a residual, made one at a time. `residual_bases` is the plain form."""

    __eq__ = equal_fields

    course: Tensor  # residual of the lowest bands at each knot. [S,M,3b]
    mix: Tensor  # share of each knot in each basis, strongest first. [S,S] float32
    made: list[tuple[Tensor, float]]  # bases so far [M,3b], and the value that nearly all members stay within

    @classmethod
    def of(cls, course: Tensor, weights: Tensor) -> ResidualBases:
        """Return the bases of a residual [S,M,3b] whose members have a visibility [M]."""
        return cls(course, _basis_shares(course, weights), [])

    def first(self, rank: int) -> tuple[Tensor, float]:
        """Return the result of `residual_bases`."""
        while len(self.made) < rank:
            exact = self._basis(len(self.made))
            self.made.append((exact, _fitting_value(exact)))
        if not rank:
            return self.course.new_zeros(0, *self.course.shape[1:]), 0.0
        return torch.stack([exact for exact, _ in self.made[:rank]]), max(v for _, v in self.made[:rank])

    def _basis(self, index: int) -> Tensor:
        """Return one basis. [M,3b]"""
        exact = torch.empty(self.course.shape[1:])
        for part in member_ranges(len(exact)):
            rows = self.course[:, part].flatten(1)
            exact[part] = (self.mix[:, index] @ rows).view(exact[part].shape)
        return exact


def _fitting_value(exact: Tensor) -> float:
    """Return the value that `_FITTING_SHARE` of the members stay within in every channel. [M,3b]"""
    count = max(1, math.ceil(_FITTING_SHARE * len(exact)))
    return float(exact.abs().kthvalue(count, dim=0).values.max())


def rank_limit(course: Tensor) -> int:
    """Return the largest useful number of bases for a residual. course: [S,M,3b]"""
    return min(len(course) - 1, MAX_RESIDUALS) if bool(course.any()) else 0
