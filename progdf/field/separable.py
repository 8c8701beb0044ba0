"""Separable field: Δ_i(s) = Σ_k B_ik a_k(s), a short sum per attribute, fitted by weighted SVD.

See docs/method.md 5. Basis 0 is the full offset, stored in integers if these are precise enough. s = 1 is by
definition their decoded value. The residual is a matrix of snapshots × numbers. Its leading singular vectors
are bases 1..R, stored as int8. The coefficients are then solved for the bases as stored.

a_k(s) is linear between the snapshots. A cubic gains nothing at the number of snapshots that a run records
(docs/lab/experiments.md, Separable fields).

`course_field` stores an edit whose trajectory is known in full, without training. `fit_keyframes`, the
baseline, interpolates linearly between snapshots; with all snapshots it equals the recording bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.gaussians import attribute_slices
from progdf.io.tensors import check_ascent
from progdf.system.equality import equal_fields

from .baked import AttributeBases, BakedField, member_ranges

_MAX_LEVELS = {torch.int8: 127, torch.int16: 32767}
"""Largest level in use by integer type. The lowest is unused, so that the levels are symmetric."""


@dataclass(frozen=True)
class AttributeTrajectory:
    """Trajectory of one attribute, split into full offset and residual."""

    __eq__ = equal_fields

    offsets: Tensor  # recorded offsets. [T,M,c] float32
    weights: Tensor  # visibility of an error in each number, ≥ 0. [M,c] float32
    amplitude: Tensor  # a_0 at the snapshots: best share of the full offset; 0 first, 1 last. [T] float32
    # weighted inner products of the residual between snapshots. [T,T] float64
    gram: Tensor
    # stored form of the last row, which was decoded from it; None: float32. [1,M,c], [1,c]
    end: tuple[Tensor, Tensor] | None = None

    @property
    def residual(self) -> Tensor:
        """Difference between the offsets and a_0 times the full offset; 0 at both ends. [T,M,c]"""
        residual = torch.addcmul(self.offsets, self.amplitude[:, None, None], self.offsets[-1], value=-1)
        residual[[0, -1]] = 0.0
        return residual

    def needed_rank(self, tolerance: float) -> int:
        """Return the smallest number of bases within the tolerance.

        Args:
            tolerance: root mean square of the remainder, as a share of the trajectory's RMS
        """
        return _needed_rank(self.gram, tolerance**2 * float(self.offsets.double().square().sum()))


def _needed_rank(gram: Tensor, allowed: float) -> int:
    """Return the smallest number of bases that leaves at most `allowed` of the residual's squares."""
    power = torch.linalg.eigvalsh(gram).flip(0).clamp(min=0)
    remaining = float(power.sum()) - power.cumsum(0)
    return 0 if float(power.sum()) <= allowed else 1 + int((remaining > allowed).sum())


def check_trajectory(strengths: Tensor, offsets: Tensor) -> None:
    """Refuse invalid trajectories.

    Raises:
        ValueError: strengths do not ascend from 0 to 1, or offsets are not [T,M,C], do not start at 0 or are
            not finite.
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
    """Return weights as [M,C] float32, from None (all 1), [M] (visibility) or [M,C] (sensitivity)."""
    if weights is None:
        return torch.ones(members, channels)
    spread = weights.float() if weights.ndim == 2 else weights.float()[:, None].expand(members, channels)
    if tuple(spread.shape) != (members, channels):
        raise ValueError(f"weights is {list(weights.shape)}, expected [{members}] or [{members}, {channels}]")
    if not bool(torch.isfinite(spread).all()) or bool((spread < 0).any()):
        raise ValueError("weights must be finite and not negative")
    return spread


def moving_attributes(offsets: Tensor) -> dict[str, slice]:
    """Return the attributes that change in [T,M,C] offsets, and their columns."""
    return {
        name: columns
        for name, columns in attribute_slices(offsets.shape[2]).items()
        if bool(offsets[:, :, columns].any())
    }


def fit_amplitude(
    offsets: Tensor, weights: Tensor, stored: tuple[Tensor, Tensor] | None = None
) -> AttributeTrajectory:
    """Fit one attribute's amplitude a_0 to its snapshots.

    Args:
        offsets: recorded offsets. [T,M,c] float32
        weights: visibility of an error in each number, ≥ 0. [M,c]
        stored: stored form of the last row, see `AttributeTrajectory`
    """
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
    """Return the best bases for every rank, by a weighted SVD of the rows to explain.

    Args:
        gram: weighted inner products of the T rows; row 0 and the last are 0. [T,T] float64

    Returns:
        Weights of the rows in each basis, strongest first. The same weights give the rows back from the
        bases. [T,R] float64; R is the numerical rank, at most T − 2
    """
    # T is small, and the T×T Gram matrix determines all left singular vectors
    values, vectors = torch.linalg.eigh(gram)
    values = values.flip(0)
    vectors = vectors.flip(1)
    rank = int((values > 1e-9 * values[0]).sum()) if float(values[0]) > 0 else 0
    modes: Tensor = vectors[:, : min(rank, max(len(gram) - 2, 0))]
    return modes


def store_attribute(
    trajectory: AttributeTrajectory,
    mix: Tensor,
    basis_type: torch.dtype = torch.int8,
    dtype: torch.dtype = torch.float32,
) -> AttributeBases:
    """Return the bases in stored form, with coefficients solved for the stored bases.

    Args:
        trajectory: trajectory of the attribute
        mix: weights of the residual's rows in each basis. [T,R]
        basis_type: int8, float16 or float32
        dtype: precision of the sums for the coefficients
    """
    full = trajectory.offsets[-1].clone()  # a view would keep all rows
    end, unit = trajectory.end or (full[None], torch.ones(1, full.shape[1]))
    exact = (mix.T.float() @ trajectory.residual.flatten(1)).reshape(-1, *full.shape)
    levels, step = quantize_bases(exact, basis_type)
    decoded = decode_bases(levels, step)
    table = solve_coefficients(trajectory.offsets, full, decoded, trajectory.weights, dtype)
    return AttributeBases(end[0], levels, torch.cat([unit, step]), table)


def quantize_bases(exact: Tensor, basis_type: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return bases in their stored type, and the value of one unit. [R,M,c] -> [R,M,c], [R,c] float32"""
    ranges = member_ranges(exact.shape[1])
    largest = exact.new_zeros(exact.shape[0], exact.shape[2])
    for part in ranges:
        largest = torch.maximum(largest, exact[:, part].abs().amax(dim=1))
    max_level = _MAX_LEVELS.get(basis_type)
    step = largest if max_level is None else largest / max_level  # float16 stays far from its limits
    step = torch.where(step > 0, step, torch.ones_like(step))
    levels = torch.empty(exact.shape, dtype=basis_type)
    for part in ranges:
        scaled = exact[:, part] / step[:, None]
        if max_level is not None:
            scaled = scaled.round_().clamp_(-max_level, max_level)
        levels[:, part] = scaled.to(basis_type)
    return levels, step


def decode_bases(levels: Tensor, step: Tensor) -> Tensor:
    """Decode bases, the inverse of `quantize_bases`. [R,M,c], [R,c] -> [R,M,c] float32"""
    return levels.float() * step[:, None]


def fit_bands(tensor: Tensor, width: int) -> Tensor:
    """Truncate higher SH bands to another scene's width, or fill up with 0. [...,c] -> [...,width]"""
    return torch.nn.functional.pad(tensor[..., :width], (0, max(0, width - tensor.shape[-1])))


def solve_coefficients(
    offsets: Tensor,
    full: Tensor,
    residual_basis: Tensor,
    weights: Tensor,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Solve least squares for a_0 … a_R at every snapshot. Both ends are fixed. [T,1+R] float32

    Args:
        offsets: recorded offsets. [T,M,c]
        full: basis 0. [M,c]
        residual_basis: bases 1..R, decoded. [R,M,c]
        weights: visibility of an error in each number. [M,c]
        dtype: precision of the sums; float64 where a region travels many times its own size
    """
    root = weights.sqrt().flatten().to(dtype)
    columns = torch.cat([full[None], residual_basis]).flatten(1) * root
    scale = columns.norm(dim=1).clamp(min=1e-30)
    columns = columns / scale[:, None]
    rows = offsets.flatten(1) * root
    normal = (columns @ columns.T).double()
    table: Tensor = (rows @ columns.T).double() @ torch.linalg.pinv(normal, rtol=1e-7, hermitian=True)
    return _fix_ends(table / scale, bool(full.any()))


def _solve_normal(normal: Tensor, pull: Tensor) -> Tensor:
    """Solve `solve_coefficients` from its sums. [1+R,1+R], [T,1+R] float64 -> [T,1+R]"""
    scale = normal.diagonal().sqrt().clamp(min=1e-30)
    scaled = normal / scale / scale[:, None]
    table: Tensor = (pull / scale) @ torch.linalg.pinv(scaled, rtol=1e-7, hermitian=True)
    return table / scale


def _fix_ends(table: Tensor, is_moving: bool) -> Tensor:
    """Return coefficients as float32 with both ends fixed. [T,1+R]"""
    table = table.float()
    if not is_moving:
        table[:, 0] = 0.0  # nothing to scale; a_0 is still 1 at the end
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
    """Fit the separable field of a trajectory with given ranks.

    Args:
        strengths: strengths of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members. The first row is 0, the last the recorded end. [T,M,C] float32
        ranks: number of bases in addition to the full offset, by attribute; 0 if absent
        weights: importance of an error: visibility [M] or sensitivity [M,C]; None: uniform
        recorded: strengths for the slider's ticks; None: `strengths`
        basis_type: storage type of bases 1..R: int8, float16 or float32

    Returns:
        A field with the snapshots as knots. Attributes that do not change are absent.

    Raises:
        ValueError: the trajectory is invalid, or the weights do not fit it.
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


_TRAJECTORY_TOLERANCE = 0.001  # RMS error of the factoring, as a share of the trajectory's own RMS
_MAX_TRAJECTORY_RANK = 8
_COURSE_BASIS_TYPES = {"means": torch.float16, "log_scales": torch.float16, "quats": torch.float16}
"""Storage types of a course's bases; others are int8, of which a step is half a pixel where a thing turns.
Centers take float32 where float16 exceeds their tolerance."""
_RISE = torch.tensor((0.0, 0.002, 0.005, 0.01, 0.02, 0.04, 0.07, 0.11, 0.17, 0.25, 0.35), dtype=torch.float64)
"""Strengths at which a logit bends most if opacity rises from 0. Mirrored for an opacity that falls to 0."""
OPACITY_KNOTS = torch.cat([_RISE, torch.tensor([0.5], dtype=torch.float64), 1.0 - _RISE.flip(0)])
"""Knots for the logits of opacities that rise from 0 or fall to 0, from 0 to 1. [S] float64"""


def course_field(knots: Tensor, offsets: Tensor, center_tolerance: float = math.inf) -> BakedField:
    """Return the field of a known trajectory. At its last knot it equals the int16 form of the end.

    Centers end in float32 if int16 is coarser than half the tolerance.

    Args:
        knots: strengths, ascending from 0 to 1. [S]
        offsets: packed offsets, 0 at the first knot. [S,M,C]
        center_tolerance: largest error of a center at the knots, world units

    Raises:
        ValueError: the trajectory is invalid.
    """
    check_trajectory(knots, offsets)
    attributes = {}
    for name, columns in moving_attributes(offsets).items():
        values = offsets[:, :, columns].clone()
        tolerance = center_tolerance if name == "means" else math.inf
        levels, step = quantize_bases(values[-1:], torch.int16)
        decoded = decode_bases(levels, step)[0]
        stored = None
        if float((decoded - values[-1]).norm(dim=1).max()) <= 0.5 * tolerance:
            values[-1] = decoded
            stored = levels, step
        attributes[name] = fit_course(values, stored, _COURSE_BASIS_TYPES.get(name, torch.int8), tolerance)
    return BakedField("separable", knots.float(), attributes, offsets.shape[2], ())


def fit_course(
    offsets: Tensor,
    stored: tuple[Tensor, Tensor] | None = None,
    basis_type: torch.dtype = torch.int8,
    tolerance: float = math.inf,
) -> AttributeBases:
    """Fit the fewest bases that reproduce an attribute's trajectory with at most 0.1 % RMS error.

    Args:
        offsets: offsets at the knots. [S,M,c]
        stored: stored form of the last row, see `quantize_bases`
        basis_type: storage type of bases 1..R: int8, float16 or float32
        tolerance: largest error of a row at the knots; further bases or float32 are used to keep it
    """
    sums = course_sums(offsets)
    modes = principal_modes(sums.gram)
    rank = min(sums.needed_rank(_TRAJECTORY_TOLERANCE), _MAX_TRAJECTORY_RANK)
    bases = _store_course(offsets, sums, modes[:, :rank], stored, basis_type)
    if tolerance == math.inf or largest_error(bases, offsets) <= tolerance:
        return bases
    ranks = range(rank, 1 + min(modes.shape[1], _MAX_TRAJECTORY_RANK))
    forms = [(count, kind) for count in ranks for kind in (basis_type, torch.float32)]
    forms.sort(key=lambda form: form[0] * form[1].itemsize)
    for count, kind in forms:
        bases = _store_course(offsets, sums, modes[:, :count], stored, kind)
        if largest_error(bases, offsets) <= tolerance:
            break
    return bases


@dataclass(frozen=True)
class CourseSums:
    """Sums of an unweighted trajectory that determine its bases; `AttributeTrajectory` is the plain form."""

    __eq__ = equal_fields

    amplitude: Tensor  # see `AttributeTrajectory`. [T] float64
    residual: Tensor  # rows of the residual as sums of the offsets' rows. [T,T] float64
    gram: Tensor  # inner products of the residual's rows. [T,T] float64
    power: float  # sum of the offsets' squares

    def needed_rank(self, tolerance: float) -> int:
        """See `AttributeTrajectory.needed_rank`."""
        return _needed_rank(self.gram, tolerance**2 * self.power)


def course_sums(offsets: Tensor) -> CourseSums:
    """Sum a trajectory in ranges of members, without copies of its size. [T,M,c]"""
    count = len(offsets)
    products = torch.zeros(count, count, dtype=torch.float64)
    for part in member_ranges(offsets.shape[1]):
        rows = offsets[:, part].flatten(1).double()
        products += rows @ rows.T
    amplitude = torch.linspace(0, 1, count).double()
    if float(products[-1, -1]) > 0:
        amplitude = products[:, -1] / products[-1, -1]
    amplitude[0] = 0.0
    amplitude[-1] = 1.0
    residual = torch.eye(count, dtype=torch.float64)
    residual[:, -1] -= amplitude
    residual[[0, -1]] = 0.0
    gram = residual @ products @ residual.T
    return CourseSums(amplitude, residual, gram, float(products.trace()))


def _store_course(
    offsets: Tensor,
    sums: CourseSums,
    mix: Tensor,
    stored: tuple[Tensor, Tensor] | None,
    basis_type: torch.dtype,
) -> AttributeBases:
    """Return the bases of an unweighted trajectory in stored form, see `store_attribute`."""
    full = offsets[-1].clone()
    end, unit = stored or (full[None], torch.ones(1, full.shape[1]))
    exact = torch.empty(mix.shape[1], *full.shape)
    combination = mix.T @ sums.residual
    for part in member_ranges(len(full)):
        rows = offsets[:, part].flatten(1).double()
        exact[:, part] = (combination @ rows).float().view(len(exact), *full[part].shape)
    levels, step = quantize_bases(exact, basis_type)
    del exact
    columns_count = 1 + len(levels)
    normal = torch.zeros(columns_count, columns_count, dtype=torch.float64)
    pull = torch.zeros(len(offsets), columns_count, dtype=torch.float64)
    for part in member_ranges(len(full)):
        decoded = decode_bases(levels[:, part], step)
        columns = torch.cat([full[None, part], decoded]).flatten(1).double()
        normal += columns @ columns.T
        pull += offsets[:, part].flatten(1).double() @ columns.T
    table = _fix_ends(_solve_normal(normal, pull), bool(full.any()))
    return AttributeBases(end[0], levels, torch.cat([unit, step]), table)


def largest_error(bases: AttributeBases, offsets: Tensor) -> float:
    """Return the largest distance of a row from its trajectory at the knots. [S,M,c]"""
    decoded = torch.cat([bases.end[None], decode_bases(bases.residual_basis, bases.scale[1:])])
    largest = 0.0
    for coefficients, expected in zip(bases.coefficients, offsets, strict=True):
        error = torch.einsum("r,rmc->mc", coefficients, decoded) - expected
        largest = max(largest, float(error.square().sum(dim=1).max().sqrt()))
    return largest


def opacity_course(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Return the logits of opacities that change linearly from start to end.

    Args:
        start, end: logits at strengths 0 and 1. [M]

    Returns:
        Knots [S], and the offset of each logit from `start` at them [S,M], exact at both ends.
    """
    opacity = torch.lerp(start.double().sigmoid(), end.double().sigmoid(), OPACITY_KNOTS[:, None])
    offsets = (opacity.logit() - start.double()).float()
    offsets[0] = 0.0
    offsets[-1] = end.float() - start.float()
    return OPACITY_KNOTS.float(), offsets


def keyframe_rows(strengths: Tensor, count: int) -> list[int]:
    """Return the indices of the snapshots that `fit_keyframes` keeps, ascending. strengths: [T]"""
    if count >= len(strengths):
        return list(range(len(strengths)))
    even = torch.linspace(0, 1, count, dtype=strengths.dtype)
    nearest = (strengths[:, None] - even).abs().argmin(dim=0)
    return sorted(set(nearest.tolist()))


def fit_keyframes(
    strengths: Tensor, offsets: Tensor, count: int, recorded: Sequence[float] | None = None
) -> BakedField:
    """Keep the `count` snapshots nearest to evenly spaced strengths, bit for bit.

    In a re-timed trajectory these strengths are evenly spaced in visible change. Snapshots are stored in half
    precision if that is exact, as for recordings.

    Args:
        strengths: strengths of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members. The first row is 0, the last the recorded end. [T,M,C] float32
        count: number of snapshots to keep, both ends included, ≥ 2. The number of snapshots or more keeps all
        recorded: strengths for the slider's ticks; None: `strengths`

    Returns:
        A field with those snapshots as knots. Attributes that do not change are absent.

    Raises:
        ValueError: the trajectory is invalid, or `count` is below 2.
    """
    check_trajectory(strengths, offsets)
    if count < 2:
        raise ValueError(f"{count} keyframes, expected at least 2")
    rows = keyframe_rows(strengths, count)
    table = torch.eye(len(rows))[:, [-1, *range(1, len(rows) - 1)]]
    attributes = {}
    selected = offsets[rows[1:-1]]
    inner = selected.half() if torch.equal(selected.half().float(), selected) else selected
    for name, columns in moving_attributes(offsets).items():
        full = offsets[-1, :, columns].contiguous()
        units = torch.ones(1 + len(inner), full.shape[1])  # any other scale would round half precision
        attributes[name] = AttributeBases(full, inner[:, :, columns], units, table.clone())
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("keyframes", strengths[rows].float(), attributes, offsets.shape[2], tuple(ticks))
