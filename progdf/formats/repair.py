"""Scenes made drawable, every number finite and near the origin, and the report of what that took.

What cannot be used is made invisible rather than dropped, because labels and .gdf files count on row indices.
"""

from __future__ import annotations

import logging
import math
import os
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Gaussians, Origin
from progdf.quaternions import normalize_quats
from progdf.terminal import file_size, format_count, group_digits

LARGEST_MEAN = 1e18
LARGEST_LOG_SCALE = 40.0
"""Beyond these a squared distance or a variance overflows float32."""

FLAT_LOG_SCALE = -20.0
"""In place of −inf: 2e-9, as thin as the thinnest seen in real files."""

OPAQUE_LOGIT = 15.0
"""In place of +inf: opacity 1 − 3e-7, which no renderer shows differently, yet an edit can still lower it."""

INVISIBLE_LOGIT = -30.0
"""In place of −inf: opacity 1e-13, far under the 1/255 that every rasterizer skips."""

MIN_QUAT = 1e-6
_SAMPLE = 10_000
"""Rows that the origin is found from, an even sample: its median is off by 1 % of the extent."""

UNIT_TOLERANCE = 1e-6
"""A quaternion this close to unit length is left alone, so that a saved scene loads bit for bit."""


def repair(scene: Gaussians, path: str | os.PathLike[str]) -> tuple[Gaussians, dict[str, Any]]:
    """Return a scene that can be drawn, and the counts of repairs by fields of `LoadReport`.

    Means in the world, of either floating type, become float32 relative to an origin. Unusable numbers are
    replaced, quaternions get unit length. Tensors that need nothing are passed on, not copied.

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
            if count := int(rows.sum()):
                article = "an" if kind == "infinite" else "a"
                reasons.append(f"{group_digits(count)} of {total} have {article} {kind} {name}")
    return reasons


def find_origin(means: Tensor, log_scales: Tensor) -> Origin:
    """What point of the world a scene's means are kept relative to; 0 on an axis along which it is near.

    Near is where float32 shows in no picture. It keeps a mean to 2^-24 of its distance, and with the camera's
    rounding a Gaussian is off by three times that; as exp(-x²/2) is nowhere steeper than .61, one of standard
    deviation s changes by less than 1/255 up to a distance of 2^15 s, however near one looks. An eighth of
    that is near: the order of Gaussians in depth, and where they end, change by steps, which no bound holds.

    Here s is the median of the middle axes, or 2^-9 of the scene's own extent where that is more, rounded
    down to a power of two. Farther off, the origin is a multiple of 2^8 s: taking it away from what float32
    held is exact, and a scene that was moved by such a multiple gets back the bits that it had.

    Args:
        means: in the world, float32 or float64; NaN and infinities do not count. [N,3]
        log_scales: [N,3]
    """
    rows = slice(None, None, max(1, -(-len(means) // _SAMPLE)))
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
    """The scene relative to its origin; that, and what float32 had lost there."""
    world = scene.means
    origin = find_origin(world, scene.log_scales)
    if origin == ZERO:
        return replace(scene, means=world.float()), {}
    moved = world.double() - torch.tensor(origin, dtype=torch.float64)
    near = replace(scene, means=moved.float(), origin=origin)
    counts: dict[str, Any] = {"origin": origin}
    if bool(((world.float() == world) | world.isnan()).all()):
        counts["distinct"] = tuple(
            len(torch.unique(column)) if at else 0 for at, column in zip(origin, world.unbind(1), strict=True)
        )
    return near, counts


def _replace_unusable(scene: Gaussians) -> tuple[Gaussians, dict[str, int]]:
    """Every number in range, and how many rows needed it."""
    quats, lengths = _unit(scene.quats)
    counts = {"scaled_quats": int((lengths != 1).sum())}
    if _is_clean(scene, lengths):
        return replace(scene, quats=quats), counts

    flat = scene.log_scales == -torch.inf
    zero_quats = scene.quats.abs().amax(dim=1) < MIN_QUAT
    opaque = scene.logit_opacities == torch.inf
    transparent = scene.logit_opacities == -torch.inf
    bad = {
        "bad_means": ~(scene.means.abs() <= LARGEST_MEAN).all(dim=1),
        "bad_scales": ~((scene.log_scales <= LARGEST_LOG_SCALE) | flat).all(dim=1),
        "bad_quats": ~scene.quats.isfinite().all(dim=1),
        "bad_opacities": scene.logit_opacities.isnan(),
        "bad_colors": ~scene.sh0.isfinite().all(dim=1),
    }
    hidden = torch.stack([*bad.values()]).any(dim=0)
    rows = bad | {
        "scaled_quats": (lengths != 1) & ~zero_quats & ~bad["bad_quats"],
        "hidden": hidden,
        "bad_sh": ~scene.shN.flatten(1).isfinite().all(dim=1),
        "flat_scales": flat.any(dim=1) & ~hidden,
        "opaque": opaque & ~hidden,
        "transparent": transparent & ~hidden,
        "zero_quats": zero_quats,
    }
    counts = {name: int(mask.sum()) for name, mask in rows.items()}
    good = scene.means[~hidden]
    # in the middle of the scene, where it changes neither its bounds nor the rig
    middle = good.median(dim=0).values if len(good) else torch.zeros(3)
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
    """Quaternions of unit length, and the length each was divided by: exactly 1 if left alone. [N]"""
    lengths = quats.norm(dim=1)
    lengths = torch.where((lengths - 1).abs() <= UNIT_TOLERANCE, 1.0, lengths)
    ordinary = (lengths > MIN_QUAT) & lengths.isfinite()
    unit = quats / lengths[:, None]
    if not bool(ordinary.all()):
        unit[~ordinary] = normalize_quats(quats[~ordinary])
    return unit, lengths


def _is_clean(scene: Gaussians, lengths: Tensor) -> bool:
    """Whether nothing at all needs repair; one pass over the data without temporaries."""
    return (
        _within(scene.means, -LARGEST_MEAN, LARGEST_MEAN)
        and _within(scene.log_scales, -torch.inf, LARGEST_LOG_SCALE)
        and bool((lengths > MIN_QUAT).all() and lengths.isfinite().all())
        and all(_within(t, -torch.inf, torch.inf) for t in (scene.logit_opacities, scene.sh0, scene.shN))
    )


def _within(tensor: Tensor, least: float, most: float) -> bool:
    """Whether every number is finite and in [least, most]; NaN passes through aminmax and fails."""
    if not tensor.numel():
        return True
    low, high = (float(edge) for edge in tensor.aminmax())
    return least <= low and high <= most and -torch.inf < low and high < torch.inf


_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LoadReport:
    """What a .ply held, what was repaired, what was left out. Counts are rows (Gaussians)."""

    file: str  # the file's name
    file_bytes: int  # its size
    format: str  # "binary little-endian", "binary big-endian" or "ascii"
    count: int  # Gaussians N; loading never drops or adds a row
    sh_degree: int  # 0..4
    antialiased: bool = False  # it says that it was trained with Mip-Splatting's 2D filter
    origin: Origin = ZERO  # what the means are kept relative to, see `repair.find_origin`
    # how many different x, y and z there are, of positions that were float32 far from 0; 0 on an axis that is
    # near 0, () where nothing was lost
    distinct: tuple[int, ...] = ()
    hidden: int = 0  # rows made invisible because a number was unusable; the next five say which number
    bad_means: int = 0  # NaN, infinite or beyond ±1e18
    bad_scales: int = 0  # NaN, infinite or beyond e^40
    bad_quats: int = 0  # NaN or infinite
    bad_opacities: int = 0  # NaN
    bad_colors: int = 0  # NaN or infinite f_dc
    bad_sh: int = 0  # NaN or infinite f_rest; only the broken coefficients become 0, the row stays visible
    flat_scales: int = 0  # −inf log-scale (an exactly flat Gaussian), made a very thin one
    opaque: int = 0  # +inf opacity, made a finite one that looks the same
    transparent: int = 0  # −inf opacity, made a finite one that looks the same
    zero_quats: int = 0  # |q| < 1e-6, taken as no rotation
    scaled_quats: int = 0  # quaternions that were not of unit length and were divided by it
    ignored_properties: tuple[str, ...] = ()  # vertex properties that 3DGS does not have
    ignored_elements: tuple[tuple[str, int], ...] = ()  # tables other than vertex, with their row counts
    ignored_comments: tuple[str, ...] = ()  # comments about the up axis: no axis, or several
    trailing_bytes: int = 0  # bytes after the last row
    conversions: tuple[str, ...] = ()  # fields of other conventions that were converted, a phrase each

    @property
    def repairs(self) -> tuple[str, ...]:
        """One phrase for each kind of repair that changed what is shown or could be noticed."""
        reasons = (
            (self.bad_means, "NaN, infinite or absurd position"),
            (self.bad_scales, "NaN, infinite or absurd scale"),
            (self.bad_quats, "NaN or infinite rotation"),
            (self.bad_opacities, "NaN opacity"),
            (self.bad_colors, "NaN or infinite color"),
        )
        hidden = ", ".join(f"{group_digits(rows)} with {what}" for rows, what in reasons if rows)
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
        """What cannot be repaired, "" for nothing: positions that float32 has rounded."""
        if not self.distinct:
            return ""
        step = max(2.0 ** (math.frexp(at)[1] - 24) for at in self.origin if at)
        counts = ", ".join(
            f"{group_digits(count)} distinct {axis}"
            for axis, count in zip("xyz", self.distinct, strict=True)
            if count
        )
        return (
            f"positions are float32, which has steps of {step:.2g} so far from 0: {counts} are left of "
            f"{format_count(self.count)}; export the scene near 0, or with x, y, z as doubles"
        )

    @property
    def ignored_parts(self) -> tuple[str, ...]:
        """One phrase for each part of the file that was not used."""
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
        """Warn of what was repaired, and of what was lost."""
        for phrase in self.repairs:
            _log.warning("%s: repaired: %s", self.file, phrase)
        if self.lost:
            _log.warning("%s: %s", self.file, self.lost)

    def lines(self) -> list[str]:
        """The report for a person, a line per fact."""
        sh = f"SH degree {self.sh_degree}"
        if self.sh_degree == 4:
            sh += " (band 4 is kept, and not shown)"
        lines = [
            f"{self.file}: {format_count(self.count)}, {sh}, {self.format}, {file_size(self.file_bytes)}",
            *(f"converted: {phrase}" for phrase in self.conversions),
            *(f"ignored: {phrase}" for phrase in self.ignored_parts),
        ]
        if self.antialiased:
            lines.append("trained anti-aliased (mip), and drawn so")
        if self.scaled_quats:
            lines.append(
                f"normalized: {format_count(self.scaled_quats, 'quaternion')} of another length than 1"
            )
        if self.origin != ZERO:
            lines.append(f"origin: {' '.join(f'{at:.17g}' for at in self.origin)}, as it lies far from 0")
        if self.lost:
            lines.append(f"lost: {self.lost}")
        return lines + [f"repaired: {phrase}" for phrase in self.repairs or ("nothing",)]
