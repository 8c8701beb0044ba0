"""What a .ply held and what loading it had to repair."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

from progdf.gaussians import ZERO, Origin

_log = logging.getLogger(__name__)

_EXPLAINED = {
    "filter_3D": "filter_3D (Mip-Splatting's: fuse it into the scales and opacities for the exact look)"
}


@dataclass(frozen=True)
class LoadReport:
    """What a .ply held, what was repaired, what was left out. Counts are rows (Gaussians).

    Args:
        file: the file's name
        file_bytes: its size
        format: "binary little-endian", "binary big-endian" or "ascii"
        count: Gaussians N; loading never drops or adds a row
        sh_degree: 0..4
        antialiased: it says that it was trained with Mip-Splatting's 2D filter
        origin: what the means are kept relative to, see `repair.find_origin`
        distinct: how many different x, y and z there are, of positions that were float32 far from 0; 0 on an
            axis that is near 0, () where nothing was lost
        hidden: rows made invisible because a number was unusable; the next five say which number
        bad_means: NaN, infinite or beyond ±1e18
        bad_scales: NaN, infinite or beyond e^40
        bad_quats: NaN or infinite
        bad_opacities: NaN
        bad_colors: NaN or infinite f_dc
        bad_sh: NaN or infinite f_rest; only the broken coefficients become 0, the row stays visible
        flat_scales: −inf log-scale (an exactly flat Gaussian), made a very thin one
        opaque: +inf opacity, made a finite one that looks the same
        transparent: −inf opacity, made a finite one that looks the same
        zero_quats: |q| < 1e-6, taken as no rotation
        scaled_quats: quaternions that were not of unit length and were divided by it
        ignored_properties: vertex properties that 3DGS does not have
        ignored_elements: tables other than vertex, with their row counts
        trailing_bytes: bytes after the last row
    """

    file: str
    file_bytes: int
    format: str
    count: int
    sh_degree: int
    antialiased: bool = False
    origin: Origin = ZERO
    distinct: tuple[int, ...] = ()
    hidden: int = 0
    bad_means: int = 0
    bad_scales: int = 0
    bad_quats: int = 0
    bad_opacities: int = 0
    bad_colors: int = 0
    bad_sh: int = 0
    flat_scales: int = 0
    opaque: int = 0
    transparent: int = 0
    zero_quats: int = 0
    scaled_quats: int = 0
    ignored_properties: tuple[str, ...] = ()
    ignored_elements: tuple[tuple[str, int], ...] = ()
    trailing_bytes: int = 0

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
        left = ", ".join(
            f"{group_digits(count)} distinct {axis}"
            for axis, count in zip("xyz", self.distinct, strict=True)
            if count
        )
        return (
            f"positions are float32, which has steps of {step:.2g} so far from 0: {left} are left of "
            f"{format_count(self.count)}; export the scene near 0, or with x, y, z as doubles"
        )

    @property
    def ignored(self) -> tuple[str, ...]:
        """One phrase for each part of the file that was not used."""
        phrases = []
        if self.ignored_properties:
            phrases.append(f"properties {', '.join(_EXPLAINED.get(p, p) for p in self.ignored_properties)}")
        phrases += [f"element '{name}' ({format_count(rows, 'row')})" for name, rows in self.ignored_elements]
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
            *(f"ignored: {phrase}" for phrase in self.ignored),
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


def format_count(count: int, noun: str = "Gaussian") -> str:
    """1 as "1 Gaussian", 12345 as "12 345 Gaussians"."""
    return f"{group_digits(count)} {noun}{'' if count == 1 else 's'}"


def file_size(count: int) -> str:
    """Bytes for a person: "4.7 MB", "1.8 kB"."""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def format_place(at: float, size: float, digits: int) -> str:
    """A coordinate of something of this size: so many digits, and those by which it is farther off."""
    beyond = math.log10(abs(at) / size) if at and size > 0 else 0.0
    return f"{at:.{digits + max(0, math.floor(beyond))}g}"


def group_digits(number: int) -> str:
    """12345 as "12 345"."""
    return f"{number:,}".replace(",", " ")
