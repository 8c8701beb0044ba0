"""The separable field: Δ_i(s) = Σ_k B_ik a_k(s), one small sum per attribute, fitted by weighted SVD
(docs/method.md 5).

Basis 0 is the end, in integers where that is enough: s = 1 is what they decode to. What it leaves is a matrix
of snapshots × numbers whose leading singular vectors are bases 1..R; those are kept as int8, and the
coefficients are solved again for the bases as stored.

a_k(s) is linear between the snapshots; a cubic gains nothing with as many as a run records
(docs/experiments.md, Separable fields).

`course_field` writes down an edit whose whole course is known, with nothing to train. The baseline is
snapshots and lines between them; all of them are the recording bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.io.tensors import check_ascent

from .baked import AttributeBases, BakedField

_LEVELS = {torch.int8: 127, torch.int16: 32767}
"""Largest level that is used; the lowest is left out to keep the levels symmetric."""


@dataclass(frozen=True)
class AttributeTrajectory:
    """One attribute's trajectory beside its full offset."""

    offsets: Tensor  # recorded offsets. [T,M,c] float32
    weights: Tensor  # how much an error of each number shows, ≥ 0. [M,c] float32
    amplitude: Tensor  # a_0 at the snapshots, the best share of the full offset; 0 first, 1 last. [T] float32
    # weighted inner products of what a_0 times the full offset leaves at the snapshots. [T,T] float64
    gram: Tensor
    # the last row as stored, which that row is decoded from; None: in float32. [1,M,c], [1,c]
    end: tuple[Tensor, Tensor] | None = None

    @property
    def residual(self) -> Tensor:
        """What a_0 times the full offset leaves; 0 at both ends. [T,M,c]"""
        residual = torch.addcmul(self.offsets, self.amplitude[:, None, None], self.offsets[-1], value=-1)
        residual[[0, -1]] = 0.0
        return residual

    def needed_rank(self, tolerance: float) -> int:
        """The fewest bases that leave at most this share of the trajectory's own root mean square."""
        allowed = tolerance**2 * float(self.offsets.double().square().sum())
        power = torch.linalg.eigvalsh(self.gram).flip(0).clamp(min=0)
        remaining = float(power.sum()) - power.cumsum(0)
        return 0 if float(power.sum()) <= allowed else 1 + int((remaining > allowed).sum())


def check_trajectory(strengths: Tensor, offsets: Tensor) -> None:
    """Refuse what is no trajectory.

    Raises:
        ValueError: strengths do not ascend from 0 to 1, offsets are not [T,M,C], do not start at 0, or have a
            number that is not finite.
    """
    count = len(strengths)
    if offsets.ndim != 3 or offsets.shape[0] != count or strengths.ndim != 1:
        raise ValueError(f"offsets is {list(offsets.shape)} for {count} strengths, expected [T,M,C]")
    check_ascent("strengths", strengths)
    if not bool(torch.isfinite(offsets).all()):
        raise ValueError("an offset is not finite")
    if bool(offsets[0].any()):
        raise ValueError("the offsets at strength 0 must be 0")


def channel_weights(weights: Tensor | None, members: int, channels: int) -> Tensor:
    """Weights as [M,C] float32, from None (all 1), [M] (visibility) or [M,C] (sensitivity)."""
    if weights is None:
        return torch.ones(members, channels)
    spread = weights.float() if weights.ndim == 2 else weights.float()[:, None].expand(members, channels)
    if tuple(spread.shape) != (members, channels):
        raise ValueError(f"weights is {list(weights.shape)}, expected [{members}] or [{members}, {channels}]")
    if not bool(torch.isfinite(spread).all()) or bool((spread < 0).any()):
        raise ValueError("weights must be finite and not negative")
    return spread


def moving_attributes(offsets: Tensor) -> dict[str, slice]:
    """The attributes that move at all in [T,M,C] offsets, and their columns."""
    return {
        name: columns
        for name, columns in attribute_slices(offsets.shape[2]).items()
        if bool(offsets[:, :, columns].any())
    }


def fit_amplitude(
    offsets: Tensor, weights: Tensor, stored: tuple[Tensor, Tensor] | None = None
) -> AttributeTrajectory:
    """One attribute's trajectory, and what its last row was decoded from. [T,M,c] float32, [M,c] ≥ 0"""
    root = weights.sqrt()
    end = (offsets[-1] * root).flatten()
    power = float(end.double() @ end.double())
    amplitude = torch.linspace(0, 1, len(offsets)).double()
    if power > 0:
        amplitude = ((offsets * root).flatten(1) @ end).double() / power
    amplitude[0] = 0.0
    amplitude[-1] = 1.0
    trajectory = AttributeTrajectory(offsets, weights, amplitude.float(), torch.zeros(0), stored)
    rows = trajectory.residual.mul_(root).flatten(1)
    return replace(trajectory, gram=(rows @ rows.T).double())


def principal_modes(gram: Tensor) -> Tensor:
    """The best bases of any number, by the inner products of the rows they shall explain (a weighted SVD).

    Args:
        gram: of the T rows, row 0 and the last are 0. [T,T] float64

    Returns:
        How each basis is mixed from the rows, strongest first, and what the bases are multiplied with to give
        the rows again. [T,R] float64; R is as large as there is anything to explain, at most T − 2
    """
    # T is small: the T×T Gram matrix holds all there is to know of the left singular vectors
    values, vectors = torch.linalg.eigh(gram)
    values = values.flip(0)
    vectors = vectors.flip(1)
    rank = int((values > 1e-9 * values[0]).sum()) if float(values[0]) > 0 else 0
    modes: Tensor = vectors[:, : min(rank, max(len(gram) - 2, 0))]
    return modes


def store_attribute(
    trajectory: AttributeTrajectory, mix: Tensor, basis_type: torch.dtype = torch.int8
) -> AttributeBases:
    """Bases as stored, with coefficients solved for them as they are stored.

    Args:
        trajectory: the attribute's trajectory
        mix: how each basis beside the full offset is mixed from what that leaves. [T,R]
        basis_type: int8, float16 or float32
    """
    full = trajectory.offsets[-1].clone()  # a view would keep all rows
    end, unit = trajectory.end or (full[None], torch.ones(1, full.shape[1]))
    exact = (mix.T.float() @ trajectory.residual.flatten(1)).reshape(-1, *full.shape)
    levels, step = quantize_bases(exact, basis_type)
    table = solve_coefficients(trajectory.offsets, full, decode_bases(levels, step), trajectory.weights)
    return AttributeBases(end[0], levels, torch.cat([unit, step]), table)


def quantize_bases(exact: Tensor, basis_type: torch.dtype) -> tuple[Tensor, Tensor]:
    """Bases in their stored type, and what one unit is worth. [R,M,c] -> [R,M,c], [R,c] float32"""
    largest = exact.abs().amax(dim=1) if exact.shape[1] else exact.new_zeros(exact.shape[0], exact.shape[2])
    if most := _LEVELS.get(basis_type):
        step = largest / most
        step = torch.where(step > 0, step, torch.ones_like(step))
        return (exact / step[:, None]).round().clamp(-most, most).to(basis_type), step
    step = torch.where(largest > 0, largest, torch.ones_like(largest))  # keeps float16 away from its limits
    return (exact / step[:, None]).to(basis_type), step


def decode_bases(levels: Tensor, step: Tensor) -> Tensor:
    """The inverse of `quantize_bases`. [R,M,c], [R,c] -> [R,M,c] float32"""
    return levels.float() * step[:, None]


def fit_bands(tensor: Tensor, width: int) -> Tensor:
    """Numbers of higher SH bands, cut or filled up with 0 to another scene's. [...,c] -> [...,width]"""
    return torch.nn.functional.pad(tensor[..., :width], (0, max(0, width - tensor.shape[-1])))


def solve_coefficients(offsets: Tensor, full: Tensor, residual_basis: Tensor, weights: Tensor) -> Tensor:
    """Least squares for a_0 … a_R at every snapshot; both ends are given, not solved. [T,1+R] float32

    Args:
        offsets: [T,M,c]
        full: basis 0. [M,c]
        residual_basis: bases 1..R in real units. [R,M,c]
        weights: [M,c]
    """
    root = weights.sqrt().flatten()
    columns = torch.cat([full[None], residual_basis]).flatten(1) * root
    scale = columns.norm(dim=1).clamp(min=1e-30)
    columns = columns / scale[:, None]
    rows = offsets.flatten(1) * root
    normal = (columns @ columns.T).double()
    table: Tensor = (rows @ columns.T).double() @ torch.linalg.pinv(normal, rtol=1e-7, hermitian=True)
    table = (table / scale).float()
    if not bool(full.any()):
        table[:, 0] = 0.0  # nothing to scale; the end is still a_0 = 1
    table[0] = 0.0
    table[-1] = 0.0
    table[-1, 0] = 1.0
    return table


def fit_separable(
    strengths: Tensor,
    offsets: Tensor,
    ranks: Mapping[str, int],
    weights: Tensor | None = None,
    recorded: Sequence[float] | None = None,
    basis_type: torch.dtype = torch.int8,
) -> BakedField:
    """The separable field of a trajectory with given ranks.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        ranks: number of bases beside the full offset, by attribute; 0 where not named
        weights: how much an error shows: visibility [M] or sensitivity [M,C]; None is evenly
        recorded: strengths for the slider's ticks; `strengths` when None
        basis_type: how bases 1..R are stored: int8, float16 or float32

    Returns:
        A field with the snapshots as nodes; attributes that never move are absent.

    Raises:
        ValueError: no trajectory, or weights that do not fit.
    """
    check_trajectory(strengths, offsets)
    spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
    attributes = {
        name: _fit_attribute(offsets[:, :, columns], spread[:, columns], ranks.get(name, 0), basis_type)
        for name, columns in moving_attributes(offsets).items()
    }
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("separable", strengths.float(), attributes, offsets.shape[2], tuple(ticks))


def _fit_attribute(offsets: Tensor, weights: Tensor, rank: int, basis_type: torch.dtype) -> AttributeBases:
    trajectory = fit_amplitude(offsets, weights)
    return store_attribute(trajectory, principal_modes(trajectory.gram)[:, :rank], basis_type)


_COURSE_TOLERANCE = 0.003  # root mean square that factoring may cost, as a share of the course's own
_MAX_COURSE_RANK = 8
_OPACITY_KNOTS = (0.0, 0.002, 0.005, 0.01, 0.02, 0.04, 0.07, 0.11, 0.17, 0.25, 0.35)
"""Where a logit bends most when an opacity rises from nothing; mirrored for one that falls to it."""


def course_field(knots: Tensor, offsets: Tensor) -> BakedField:
    """The field of a course: at its last knot exactly what int16 makes of the end.

    Args:
        knots: strengths, ascending from 0 to 1. [S]
        offsets: packed, 0 at the first knot. [S,M,C]

    Raises:
        ValueError: no course.
    """
    check_trajectory(knots, offsets)
    attributes = {}
    for name, columns in moving_attributes(offsets).items():
        course = offsets[:, :, columns].clone()
        stored = quantize_bases(course[-1:], torch.int16)
        course[-1] = decode_bases(*stored)[0]
        attributes[name] = fit_course(course, stored)
    return BakedField("separable", knots.float(), attributes, offsets.shape[2], ())


def fit_course(offsets: Tensor, stored: tuple[Tensor, Tensor] | None = None) -> AttributeBases:
    """The fewest bases by which an attribute's course is met to a three-hundredth. [S,M,c]

    `stored`: what its last row was decoded from, see `quantize_bases`.
    """
    fitted = fit_amplitude(offsets, torch.ones_like(offsets[0]), stored)
    rank = min(fitted.needed_rank(_COURSE_TOLERANCE), _MAX_COURSE_RANK)
    return store_attribute(fitted, principal_modes(fitted.gram)[:, :rank])


def opacity_course(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Logits of opacities that go linearly from one to another.

    Args:
        start, end: logits at strengths 0 and 1. [M]

    Returns:
        Knots [S] and the offset of each logit from `start` at them [S,M], exact at both ends
    """
    rise = torch.tensor(_OPACITY_KNOTS, dtype=torch.float64)
    knots = torch.cat([rise, torch.tensor([0.5], dtype=torch.float64), 1.0 - rise.flip(0)])
    opacity = torch.lerp(start.double().sigmoid(), end.double().sigmoid(), knots[:, None])
    offsets = (opacity.logit() - start.double()).float()
    offsets[0], offsets[-1] = 0.0, end.float() - start.float()
    return knots.float(), offsets


def keyframe_rows(strengths: Tensor, count: int) -> list[int]:
    """The snapshots that `fit_keyframes` keeps, ascending. [T]"""
    even = torch.linspace(0, 1, count, dtype=strengths.dtype)
    nearest = (strengths[:, None] - even).abs().argmin(dim=0)
    return sorted({*(nearest if count < len(strengths) else torch.arange(len(strengths))).tolist()})


def fit_keyframes(
    strengths: Tensor, offsets: Tensor, count: int, recorded: Sequence[float] | None = None
) -> BakedField:
    """Keep the `count` snapshots nearest to even strengths (even visible change in a re-timed trajectory)
    bit for bit: in half precision where that holds them, as it does recordings.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        count: snapshots kept, both ends among them, ≥ 2; as many as there are or more keeps all
        recorded: strengths for the slider's ticks; `strengths` when None

    Returns:
        A field with those snapshots as knots; attributes that never move are absent.

    Raises:
        ValueError: no trajectory, or fewer than 2 snapshots asked for.
    """
    check_trajectory(strengths, offsets)
    if count < 2:
        raise ValueError(f"{count} keyframes, expected at least 2")
    rows = keyframe_rows(strengths, count)
    table = torch.eye(len(rows))[:, [-1, *range(1, len(rows) - 1)]]
    attributes = {}
    kept = offsets[rows[1:-1]]
    inner = kept.half() if torch.equal(kept.half().float(), kept) else kept
    for name, columns in moving_attributes(offsets).items():
        full = offsets[-1, :, columns].contiguous()
        units = torch.ones(1 + len(inner), full.shape[1])  # of another size they would round it
        attributes[name] = AttributeBases(full, inner[:, :, columns], units, table.clone())
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("keyframes", strengths[rows].float(), attributes, offsets.shape[2], tuple(ticks))
