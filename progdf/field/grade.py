"""The grade field: one map of color for the whole region, and a small residual by Gaussian.

For each knot of the slider the map is a polynomial of the drawn color q = clamp(SH color, 0, 1.5):
color' = Σ_k c_k m_k(q), with m_k the monomials up to the degree; that of a .cube file is linear between the
points of its lattice, on q = clamp(SH color, 0, 1). It is held as spherical harmonics of the
members, which are computed from the scene's own when the field is loaded, so that a file keeps some hundred
numbers and whatever draws Gaussians draws it. A pattern takes a mask beside it: a byte by Gaussian, how much
of the map it takes. What both cannot say of single Gaussians is a residual of their lowest bands, of a few
int8 bases.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from progdf.gaussians import BASE_CHANNELS
from progdf.sh import C0, basis

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
    remap_slider,
)
from .separable import fit_course

MAX_COLOR = 1.5
"""Colors above this, which no screen shows, are mapped as this."""

_FIRST_BAND = BASE_CHANNELS - 3  # column of a packed row, see `attribute_slices`; the others follow
_DIRECTIONS = 32  # in which a member's color is mapped; twice the functions of three bands
_CHUNK = 1 << 11  # members at once
MAX_RESIDUALS = MAX_RANK // 2
"""Bases of a residual that are tried, each in up to two."""
COARSER = tuple(2.0 ** (i / 8) for i in range(-8, 25))
"""Steps of a residual's levels that are tried; with 1 nearly all members take 8 bits."""
_WITHIN = 0.999  # share of the members that do: few must not take the levels of all


def monomials(colors: Tensor, degree: int) -> Tensor:
    """The monomials of colors up to a degree, 1 first. [3,...] -> [K,...]"""
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
    """Values of the bands in even directions of the sphere, and their least squares. [D,B], [B,D] float32"""
    index = torch.arange(_DIRECTIONS, dtype=torch.float64) + 0.5
    z = 1 - 2 * index / _DIRECTIONS
    angle = math.pi * (1 + math.sqrt(5)) * index
    radius = (1 - z * z).sqrt()
    values = basis(degree, torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=1))
    return values.float().to(device), torch.linalg.pinv(values).float().to(device)


def map_colors(sh: Tensor, table: Tensor, degree: int) -> Tensor:
    """Spherical harmonics that show, from everywhere, what a map makes of the colors that they showed.

    What is drawn is clamped at 0, so a color that is to be black may be anything below: members whose colors
    go below 0 are projected once more, but for the directions where they are black and are to be. (More such
    rounds, and 48 directions, give .01 dB.) With the identity all stay as they are, bit for bit.

    Args:
        sh: of M members, B bands. [M,B,3]
        table: the map. [K,3]
        degree: of the map

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
    chunks: tuple[Tensor, ...] = torch.split(sh.movedim(2, 0), _CHUNK, dim=1)
    return torch.cat([_map_chunk(chunk, table, degree) for chunk in chunks], dim=1).movedim(0, 2).contiguous()


def map_drawn(colors: Tensor, table: Tensor, degree: int) -> Tensor:
    """What the map makes of colors; of a polynomial, what is above `MAX_COLOR` stays. [3,...] -> [3,...]"""
    if degree == LATTICE:
        return look_up(colors.clamp(0.0, 1.0), table)
    terms = monomials(colors.clamp(0.0, MAX_COLOR), degree).flatten(1)
    return (table.T @ terms).reshape(colors.shape) + (colors - MAX_COLOR).clamp_min(0.0)


def look_up(colors: Tensor, table: Tensor) -> Tensor:
    """Linear between the eight points of a lattice around each color, 0..1. [3,...], [K,3] -> [3,...]"""
    side = lattice_side(len(table))
    lattice = table.T.reshape(1, 3, side, side, side)  # blue, green, red
    places = (2.0 * colors.flatten(1).T - 1.0)[None, None, None]
    return grid_sample(lattice, places, align_corners=True)[0, :, 0, 0].reshape(colors.shape)


def _map_chunk(sh: Tensor, table: Tensor, degree: int) -> Tensor:
    """`map_colors` of the channels of some members. [3,m,B] -> [3,m,B]"""
    values, inverse = sphere(math.isqrt(sh.shape[2]) - 1, sh.device)
    colors = sh @ values.T + 0.5
    mapped = map_drawn(colors, table, degree)
    made = sh + (mapped - colors.clamp_min(0.0)) @ inverse.T
    clamped = (colors.amin(dim=2) < 0.0) | (mapped.amin(dim=2) < 0.0)
    some = made[clamped]
    target = mapped[clamped]
    now = some @ values.T + 0.5
    made[clamped] += (target - now).masked_fill_((target <= 0.0) & (now <= 0.0), 0.0) @ inverse.T
    return made


def member_bands(rows: Tensor) -> Tensor:
    """The bands of packed rows that are drawn. [M,14+3K] -> [M,B,3]"""
    return rows[:, _FIRST_BAND:].reshape(len(rows), -1, 3)[:, :16].contiguous()


def band_offsets(change: Tensor, channels: int) -> Tensor:
    """A change of the lowest bands as packed offsets. [M,B,3] -> [M,channels]"""
    return pad(change.flatten(1), (_FIRST_BAND, channels - _FIRST_BAND - 3 * change.shape[1]))


def mapped_bands(form: GradeForm, rows: Tensor) -> Tensor:
    """What the map adds to the members' bands at each knot. [M,14+3K] -> [S,M,3B]"""
    sh = member_bands(rows)
    share = form.share[:, None]
    changes = [share * (map_colors(sh, at_knot, form.degree) - sh).flatten(1) for at_knot in form.table]
    return torch.stack(changes)


def bake_grade(form: GradeForm, rows: Tensor, mapped: Tensor | None = None) -> BakedField:
    """The field that runs.

    Args:
        form: what a file keeps
        rows: raw values of the members before the edit, packed. [M,14+3K]
        mapped: see `mapped_bands`, where that is known

    Raises:
        ValueError: not as many Gaussians, or fewer bands than the residual has.
    """
    width = form.residual.shape[2]
    if len(rows) != form.members or width // 3 > member_bands(rows).shape[1]:
        raise ValueError(f"a grade of {form.members} members for {len(rows)} of {rows.shape[1]} numbers")
    course = mapped_bands(form, rows) if mapped is None else mapped.clone()
    if len(form.residual):
        course[:, :, :width] += torch.einsum(
            "sr,rmc->smc", form.coefficients, form.residual * form.scale[:, None]
        )
    higher = rows.shape[1] - BASE_CHANNELS
    parts = {"sh0": course[:, :, :3], "shN": pad(course[:, :, 3:], (0, higher - course.shape[2] + 3))}
    attributes = {name: fit_course(part) for name, part in parts.items() if bool(part.any())}
    knots = form.knots.tolist()
    baked = BakedField("grade", form.knots, attributes, rows.shape[1], tuple(knots), form)
    return baked if form.remap.is_identity else remap_slider(baked, form.remap)


def adjust_colors(form: GradeForm, sh: Tensor, members: Tensor | slice, s: float) -> Tensor:
    """What a grade adds at strength `s` to colors that others have changed already.

    Args:
        form: the grade
        sh: of these members, as it lies below. [m,B,3]
        members: which of the grade's members these are
        s: of the slider; beyond 1 the last segment goes on

    Returns:
        [m,B,3]; exactly 0 at 0, and the map and residual of the file at 1
    """
    right, share = _segment(form, s)
    if form.degree == LATTICE:  # colors above 1 go the straight way too
        change = share * (map_colors(sh, form.table[right], LATTICE) - sh)
    else:
        change = map_colors(sh, map_at(form, s), form.degree) - sh
    change = form.share[members, None, None] * change
    if len(form.residual):
        row = torch.lerp(form.coefficients[right - 1], form.coefficients[right], share)
        residual = (form.residual[:, members] * (row[:, None] * form.scale)[:, None]).sum(dim=0)
        change[:, : residual.shape[1] // 3] += residual.reshape(len(sh), -1, 3)
    return change


def map_share(field: BakedField) -> Tensor:
    """How much of each member's change at strength 1 is its map's: 1 − |residual|² / |map|², 0..1. [M]

    Where the residual undoes the map, as between stripes, or does as much again, it is 0.
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
    """The map of a grade at strength `s` of the slider. [K,3]"""
    right, share = _segment(form, s)
    return torch.lerp(form.table[right - 1], form.table[right], share)


def _segment(form: GradeForm, s: float) -> Segment:
    at = form.remap.new.new_tensor([s])
    return find_segment(form.knots, float(interpolate(at, form.remap.new, form.remap.old)) if s < 1.0 else s)


def mapped_lattice(form: GradeForm, s: float, side: int) -> Tensor:
    """What the map at strength `s` makes of the colors of a lattice, see `lattice_colors`. [side³,3]"""
    return map_drawn(lattice_colors(side).T, map_at(form, s), form.degree).T


def lattice_form(table: Tensor) -> GradeForm:
    """The grade of a lattice, for no members: the straight way to the colors of the table. [K,3]"""
    ends = torch.stack([lattice_colors(lattice_side(len(table))), table])
    return map_form(torch.tensor([0.0, 1.0]), LATTICE, ends, 0)


def map_alone(form: GradeForm, members: int) -> GradeForm:
    """The map of a grade alone, for so many members of any scene."""
    return replace(map_form(form.knots, form.degree, form.table, members), remap=form.remap)


def map_form(knots: Tensor, degree: int, table: Tensor, members: int) -> GradeForm:
    """A grade that is a map alone. [S], [S,K,3]"""
    none = torch.zeros(0, members, 0, dtype=torch.int8)
    return GradeForm(degree, knots, table, none, torch.zeros(0, 0), torch.zeros(len(knots), 0))


def fit_grade(
    knots: Tensor,
    degree: int,
    table: Tensor,
    course: Tensor,
    rank: int,
    weights: Tensor,
    mask: Tensor | None = None,
    coarser: float = 1.0,
) -> GradeForm:
    """A grade whose residual has so many bases.

    Args:
        knots: strengths, ascending from 0 to 1. [S]
        degree: of the map
        table: the map at each knot, the identity at the first. [S,K,3]
        course: what the members' lowest bands need beside the map at each knot; 0 at the first. [S,M,3b]
        rank: number of bases, at most `rank_limit`
        weights: how much an error of each member shows, ≥ 0. [M]
        mask: see `GradeForm`
        coarser: how many of the steps that 8 bits have one of its steps is; they compress the better
    """
    root = weights.sqrt()[:, None]
    rows = (course * root).flatten(1)
    _, vectors = torch.linalg.eigh((rows @ rows.T).double())
    mix = vectors.flip(1)[:, :rank].T.float()
    exact = (mix @ course.flatten(1)).reshape(rank, *course.shape[1:])
    # one step for all, as all are of colors: channels that hardly move take few levels, and compress
    nearly_all = max(1, math.ceil(_WITHIN * exact.shape[1]))
    step = coarser / 127.0 * (float(exact.abs().kthvalue(nearly_all, dim=1).values.max()) if rank else 0.0)
    whole = (exact / (step or 1.0)).round().clamp(-254.0, 254.0)
    levels = whole.clamp(-127.0, 127.0).to(torch.int8)
    beyond = (whole - levels).to(torch.int8)  # of few members, in bases of their own
    levels = torch.cat([levels, beyond[beyond.flatten(1).any(dim=1)]])
    scale = torch.full((len(levels), exact.shape[2]), step or 1.0)
    columns = (levels * scale[:, None] * root).flatten(1)
    normal = (columns @ columns.T).double()
    coefficients = (rows @ columns.T).double() @ torch.linalg.pinv(normal, rtol=1e-9, hermitian=True)
    coefficients[0] = 0.0
    return GradeForm(degree, knots.float(), table.float(), levels, scale, coefficients.float(), mask=mask)


def rank_limit(course: Tensor) -> int:
    """The most bases that say anything of a residual's course. [S,M,3b]"""
    return min(len(course) - 1, MAX_RESIDUALS) if bool(course.any()) else 0
