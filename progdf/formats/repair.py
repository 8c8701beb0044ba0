"""Repair of loaded scenes: all numbers become finite, means relative to an origin; and the load report.

An unusable row is made invisible rather than dropped, because labels and .gdf files rely on row indices.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.quaternions import normalize_quats
from progdf.terminal import file_size, format_count, group_digits

LARGEST_MEAN = 1e18
"""Largest usable coordinate. It leaves a margin to 1.8e19, whose square overflows float32."""

LARGEST_LOG_SCALE = 40.0
"""Largest usable log-scale. It leaves a margin to 44, at which the variance e^88 nears the float32 limit."""

FLAT_LOG_SCALE = -20.0
"""Replacement for a log-scale of −inf. The scale is 2e-9, like the thinnest Gaussians in real files."""

OPAQUE_LOGIT = 15.0
"""Replacement for a logit of +inf. Opacity 1 − 3e-7 renders the same, and an edit can still lower it."""

INVISIBLE_LOGIT = -30.0
"""Replacement for a logit of −inf. Opacity 1e-13 is far below 1/255, the cutoff of every rasterizer."""

MIN_QUAT = 1e-6  # length; a shorter quaternion counts as no rotation
_MAX_SAMPLE_ROWS = 10_000
"""Number of evenly spaced rows for finding the origin. Their median is off by 1 % of the extent."""

_SMALL_GAP_QUANTILE = 0.05
"""Quantile of the gaps between distinct coordinates that is compared with the step of float32. Where float32
rounded them, more gaps than this are one step; few enough that a finer grid near 0 does not decide."""

_MAX_GAP_STEPS = 1.5  # steps of float32; a larger gap at this quantile comes from a coarser grid

UNIT_TOLERANCE = 1e-6
"""Deviation from unit length up to which a quaternion stays unchanged, so saved scenes reload exactly."""


def repair(scene: Gaussians, path: str | os.PathLike[str]) -> tuple[Gaussians, dict[str, Any]]:
    """Return the repaired scene, and the counts of repairs by fields of `LoadReport`.

    World means (float32 or float64) become float32 relative to an origin. Unusable numbers are replaced, and
    quaternions are normalized. Tensors without repairs are not copied.

    Args:
        scene: N Gaussians as stored
        path: their file, for the error

    Raises:
        ProgdfError: no Gaussian is usable.
    """
    near, moved = _move_to_origin(scene)
    repaired, counts = _replace_unusable(near)
    if counts.get("hidden") == len(scene):
        reasons = ", ".join(_unusable_reasons(scene))
        raise ProgdfError(f"{path} holds no usable Gaussian: {reasons}; export the scene again")
    return repaired, {**moved, **counts}


def logits_of_shares(opacities: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the logits of opacities in a format that stores them as shares. [N] 0 to 1 -> [N] float64

    0 and 1 are values of such a format, as bytes of 0 and 255, and no damage. They become the finite logits
    `INVISIBLE_LOGIT` and `OPAQUE_LOGIT`. Values outside of 0 to 1 become NaN.
    """
    shares = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return limit_logits(np.log(shares) - np.log1p(-shares))


def limit_logits(logits: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return logits with finite values for opacities of 0 and 1, see `logits_of_shares`. [N] -> [N]"""
    return np.where(np.isinf(logits), np.clip(logits, INVISIBLE_LOGIT, OPAQUE_LOGIT), logits)


def _unusable_reasons(scene: Gaussians) -> list[str]:
    """Return phrases for the unusable attributes, such as "700 of 700 Gaussians have a NaN scale"."""
    finite = torch.finfo(torch.float32).max
    limits = {
        "position": (scene.means, -LARGEST_MEAN, LARGEST_MEAN),
        "scale": (scene.log_scales, -torch.inf, LARGEST_LOG_SCALE),
        "rotation": (scene.quats, -finite, finite),
        "opacity": (scene.logit_opacities[:, None], -torch.inf, torch.inf),
        "color": (scene.sh0, -finite, finite),
    }
    total = format_count(len(scene))
    reasons = []
    for name, (values, low, high) in limits.items():
        has_nan = values.isnan().any(dim=1)
        has_infinity = values.isinf().any(dim=1) & ~has_nan
        is_outside = ~((values >= low) & (values <= high)).all(dim=1)
        kinds = {
            "NaN": has_nan,
            "infinite": is_outside & has_infinity,
            "far too large": is_outside & ~has_nan & ~has_infinity,
        }
        for kind, rows in kinds.items():
            count = int(rows.sum())
            if count:
                article = "an" if kind == "infinite" else "a"
                reasons.append(f"{group_digits(count)} of {total} have {article} {kind} {name}")
    return reasons


def find_origin(means: Tensor, log_scales: Tensor) -> Origin:
    """Return the origin that the means of a scene are stored relative to; 0 on each axis that is near 0.

    An axis is near 0 if float32 rounding is invisible there. Rounding moves a mean by 2^-24 of its distance,
    and together with the camera's rounding by three times that. The slope of exp(-x²/2) is at most 0.61.
    A Gaussian of standard deviation s therefore changes by less than 1/255 up to a distance of 2^15 s, at any
    zoom. The limit is an eighth of that, because depth order and cutoffs change in steps, which the estimate
    does not bound.

    Here s is the median of the middle axes, or 2^-9 of the scene's extent if that is larger, rounded down to
    a power of two. Beyond the limit, the origin is a multiple of 2^8 s. Subtracting it from float32 values is
    exact, and a scene that was moved by such a multiple gets its original bits back.

    Args:
        means: world means, float32 or float64; NaN and infinities are ignored. [N,3]
        log_scales: [N,3]
    """
    rows = slice(None, None, max(1, -(-len(means) // _MAX_SAMPLE_ROWS)))
    means = means[rows].double()
    middle = means.nanmedian(dim=0).values
    extent = float((means - middle).abs().amax(dim=1).nanmedian())
    size = float(log_scales[rows].median(dim=1).values.nanmedian().clamp(FLAT_LOG_SCALE, LARGEST_LOG_SCALE))
    s = max(math.exp(size), extent / 512 if extent <= LARGEST_MEAN else 0.0)
    if not math.isfinite(s):
        return ZERO
    grid = 2.0 ** (math.floor(math.log2(s)) + 8)
    x, y, z = (
        round(at / grid) * grid if 16 * grid < abs(at) <= LARGEST_MEAN else 0.0 for at in middle.tolist()
    )
    return x, y, z


def _move_to_origin(scene: Gaussians) -> tuple[Gaussians, dict[str, Any]]:
    """Return the scene relative to its origin, and the report fields `origin` and `distinct`."""
    world = scene.means
    origin = find_origin(world, scene.log_scales)
    if origin == ZERO:
        return replace(scene, means=world.float()), {}
    moved = world.double() - torch.tensor(origin, dtype=torch.float64)
    near = replace(scene, means=moved.float(), origin=origin)
    counts: dict[str, Any] = {"origin": origin}
    if bool(((world.float() == world) | world.isnan()).all()):
        distinct = [
            _count_rounded(column.double(), at) for at, column in zip(origin, world.unbind(1), strict=True)
        ]
        if any(distinct):
            counts["distinct"] = tuple(distinct)
    return near, counts


def _count_rounded(column: Tensor, at: float) -> int:
    """Return the number of distinct coordinates if float32 limits their spacing, else 0.

    A format with a coarser grid of its own, such as the 16 bits of a .sog, loses nothing to float32.

    Args:
        column: coordinates along an axis, in the world. [N] float64
        at: origin of the scene on this axis; 0 if it is near 0
    """
    if not at:
        return 0
    values = torch.unique(column[column.isfinite()])
    if len(values) < 2:
        return 0
    gaps = values.diff()
    small = gaps.kthvalue(max(1, round(_SMALL_GAP_QUANTILE * len(gaps)))).values
    return len(values) if float(small) < _MAX_GAP_STEPS * _float32_step(at) else 0


def _float32_step(at: float) -> float:
    """Return the distance of neighboring float32 numbers near a number other than 0."""
    return 2.0 ** (math.frexp(at)[1] - 24)


def _replace_unusable(scene: Gaussians) -> tuple[Gaussians, dict[str, int]]:
    """Replace all unusable numbers, and count the affected rows by fields of `LoadReport`."""
    quats, lengths = _unit(scene.quats)
    counts = {"scaled_quats": int((lengths != 1).sum())}
    if _is_clean(scene, lengths):
        return replace(scene, quats=quats), counts

    flat = scene.log_scales == -torch.inf
    zero_quats = scene.quats.abs().amax(dim=1) < MIN_QUAT
    opaque = scene.logit_opacities == torch.inf
    transparent = scene.logit_opacities == -torch.inf
    unusable = {
        "bad_means": ~(scene.means.abs() <= LARGEST_MEAN).all(dim=1),
        "bad_scales": ~((scene.log_scales <= LARGEST_LOG_SCALE) | flat).all(dim=1),
        "bad_quats": ~scene.quats.isfinite().all(dim=1),
        "bad_opacities": scene.logit_opacities.isnan(),
        "bad_colors": ~scene.sh0.isfinite().all(dim=1),
    }
    hidden = torch.stack([*unusable.values()]).any(dim=0)
    rows = unusable | {
        "scaled_quats": (lengths != 1) & ~zero_quats & ~unusable["bad_quats"],
        "hidden": hidden,
        "bad_sh": ~scene.shN.flatten(1).isfinite().all(dim=1),
        "flat_scales": flat.any(dim=1) & ~hidden,
        "opaque": opaque & ~hidden,
        "transparent": transparent & ~hidden,
        "zero_quats": zero_quats,
    }
    counts = {name: int(mask.sum()) for name, mask in rows.items()}
    usable_means = scene.means[~hidden]
    # hidden rows move to the median, where they change neither the bounds nor the camera rig
    middle = usable_means.median(dim=0).values if len(usable_means) else torch.zeros(3)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0])
    row = hidden[:, None]
    logits = scene.logit_opacities.clamp(INVISIBLE_LOGIT, OPAQUE_LOGIT)
    logits = torch.where(opaque | transparent, logits, scene.logit_opacities)
    repaired = replace(
        scene,
        means=torch.where(row, middle, scene.means),
        quats=torch.where(row | zero_quats[:, None], identity, quats),
        log_scales=torch.where(row | flat, FLAT_LOG_SCALE, scene.log_scales),
        logit_opacities=torch.where(hidden, INVISIBLE_LOGIT, logits),
        sh0=torch.where(row, 0.0, scene.sh0),
        shN=torch.where(scene.shN.isfinite(), scene.shN, 0.0),
    )
    return repaired, counts


def _unit(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Return normalized quaternions [N,4], and the length each was divided by: exactly 1 if unchanged. [N]

    The quaternions are returned as they are, without a copy, if all lengths are 1.
    """
    lengths = quats.norm(dim=1)
    lengths.masked_fill_((lengths - 1).abs_() <= UNIT_TOLERANCE, 1.0)
    if bool((lengths == 1).all()):
        return quats, lengths
    unit = quats / lengths[:, None]
    is_regular = (lengths > MIN_QUAT) & lengths.isfinite()
    if not bool(is_regular.all()):
        unit[~is_regular] = normalize_quats(quats[~is_regular])
    return unit, lengths


def _is_clean(scene: Gaussians, lengths: Tensor) -> bool:
    """Return whether no row needs repair, in one pass over the data without temporaries."""
    return (
        _within(scene.means, -LARGEST_MEAN, LARGEST_MEAN)
        and _within(scene.log_scales, -torch.inf, LARGEST_LOG_SCALE)
        and bool((lengths > MIN_QUAT).all() and lengths.isfinite().all())
        and all(_within(t, -torch.inf, torch.inf) for t in (scene.logit_opacities, scene.sh0, scene.shN))
    )


def _within(tensor: Tensor, least: float, most: float) -> bool:
    """Return whether every number is finite and in [least, most]; `aminmax` propagates NaN, which fails."""
    if not tensor.numel():
        return True
    low, high = (float(edge) for edge in tensor.aminmax())
    return least <= low and high <= most and -torch.inf < low and high < torch.inf


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadReport:
    """Contents of a scene file, its repairs and its unused parts. Counts are rows (Gaussians)."""

    file: str  # file name
    file_bytes: int  # file size
    format: str  # description of the format, such as "binary little-endian", "ascii" or ".splat"
    count: int  # number of Gaussians N; loading never drops or adds a row
    sh_degree: int  # 0 to 4
    antialiased: bool = False  # the file states that it was trained with Mip-Splatting's 2D filter
    origin: Origin = ZERO  # origin that the means are relative to, see `repair.find_origin`
    # numbers of distinct x, y and z values if float32 limits their spacing; 0 on an axis where it does not,
    # () if it does on none
    distinct: tuple[int, ...] = ()
    hidden: int = 0  # rows made invisible due to an unusable number; the next five fields count the causes
    bad_means: int = 0  # NaN, infinite or beyond ±1e18
    bad_scales: int = 0  # NaN, infinite or beyond e^40
    bad_quats: int = 0  # NaN or infinite
    bad_opacities: int = 0  # NaN
    bad_colors: int = 0  # NaN or infinite f_dc
    bad_sh: int = 0  # NaN or infinite f_rest; only the bad coefficients become 0, and the row stays visible
    flat_scales: int = 0  # −inf log-scale (exactly flat), replaced by `FLAT_LOG_SCALE`
    opaque: int = 0  # +inf opacity logit, replaced by `OPAQUE_LOGIT`
    transparent: int = 0  # −inf opacity logit, replaced by `INVISIBLE_LOGIT`
    zero_quats: int = 0  # |q| < 1e-6, treated as no rotation
    scaled_quats: int = 0  # quaternions that were not unit length, normalized
    ignored_properties: tuple[str, ...] = ()  # vertex properties that 3DGS does not have
    ignored_elements: tuple[tuple[str, int], ...] = ()  # unused elements with their row counts
    ignored_comments: tuple[str, ...] = ()  # comments about the up axis that name no axis, or different ones
    trailing_bytes: int = 0  # bytes after the last row
    conversions: tuple[str, ...] = ()  # conversions from other conventions, a phrase each

    @property
    def repairs(self) -> tuple[str, ...]:
        """Phrases for the repairs, one per kind; normalized quaternions are left out."""
        reasons = (
            (self.bad_means, "NaN, infinite or absurd position"),
            (self.bad_scales, "NaN, infinite or absurd scale"),
            (self.bad_quats, "NaN or infinite rotation"),
            (self.bad_opacities, "NaN opacity"),
            (self.bad_colors, "NaN or infinite color"),
        )
        hidden = ", ".join(f"{group_digits(rows)} with {reason}" for rows, reason in reasons if rows)
        phrases = (
            (self.hidden, f"made invisible: {hidden}"),
            (self.bad_sh, "with NaN or infinite SH coefficients, which were set to 0"),
            (self.flat_scales, "with a log-scale of −inf, made very thin"),
            (self.opaque, "with an opacity of +inf, made finite and just as opaque"),
            (self.transparent, "with an opacity of −inf, made finite and just as invisible"),
            (self.zero_quats, "with a zero quaternion, taken as no rotation"),
        )
        return tuple(f"{format_count(rows)} {what}" for rows, what in phrases if rows)

    @property
    def lost(self) -> str:
        """Description of a loss that cannot be repaired (positions rounded to float32), or ""."""
        if not self.distinct:
            return ""
        step = max(_float32_step(at) for at, count in zip(self.origin, self.distinct, strict=True) if count)
        counts = ", ".join(
            f"{group_digits(count)} distinct {axis}"
            for axis, count in zip("xyz", self.distinct, strict=True)
            if count
        )
        return (
            f"float32 positions have steps of {step:.2g} this far from 0: {counts} remain of "
            f"{format_count(self.count)}; export the scene near 0, or with x, y, z as doubles"
        )

    @property
    def ignored_parts(self) -> tuple[str, ...]:
        """Phrases for the unused parts of the file, one each."""
        phrases = []
        if self.ignored_properties:
            phrases.append(f"properties {', '.join(self.ignored_properties)}")
        phrases += [f"element '{name}' ({format_count(rows, 'row')})" for name, rows in self.ignored_elements]
        for comment in self.ignored_comments:
            phrases.append(f"comment '{comment}', which is not used as an up axis")
        if self.trailing_bytes:
            phrases.append(f"{format_count(self.trailing_bytes, 'byte')} after the last row")
        return tuple(phrases)

    def log(self) -> None:
        """Log repairs and losses as warnings."""
        for phrase in self.repairs:
            _log.warning("%s: repaired: %s", self.file, phrase)
        if self.lost:
            _log.warning("%s: %s", self.file, self.lost)

    def lines(self) -> list[str]:
        """Return the report for the user, one line per fact."""
        sh = f"SH degree {self.sh_degree}"
        if self.sh_degree == 4:
            sh += " (band 4 is kept but not rendered)"
        lines = [
            f"{self.file}: {format_count(self.count)}, {sh}, {self.format}, {file_size(self.file_bytes)}",
            *(f"converted: {phrase}" for phrase in self.conversions),
            *(f"ignored: {phrase}" for phrase in self.ignored_parts),
        ]
        if self.antialiased:
            lines.append("antialiased: trained and rendered with Mip-Splatting's 2D filter")
        if self.scaled_quats:
            lines.append(f"normalized: {format_count(self.scaled_quats, 'quaternion')} not of unit length")
        if self.origin != ZERO:
            lines.append(f"origin: {' '.join(f'{at:.17g}' for at in self.origin)} (the scene is far from 0)")
        if self.lost:
            lines.append(f"lost: {self.lost}")
        return lines + [f"repaired: {phrase}" for phrase in self.repairs or ("nothing",)]
