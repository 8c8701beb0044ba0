"""Path of an edit of which only the end is known: a color map bowed in OKLab, and straight lines.

A straight line in sRGB passes through gray between opposite hues. The change of the region's colors is
therefore split. A polynomial map of the whole region takes the path of recolored colors, bowed along the hue
circle. The residual of each Gaussian fades in with the strength. Opacities are straight as opacities, so that
a part fades evenly. All other attributes are straight.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.color.edits import typical_color
from progdf.color.oklab import bend_of, color_path
from progdf.field.baked import identity_map
from progdf.field.grade import band_offsets, map_colors, map_drawn, member_bands, monomials
from progdf.field.trajectory import Trajectory
from progdf.gaussians import attribute_slices
from progdf.sh import C0

KNOTS = 9
"""Recordings of a bowed path; between them the path is straight."""

MIN_BOW = 1.0 / 255.0
"""Smallest visible bow of colors or opacities, 0 to 1. A smaller one takes bytes and does not show."""

_RIDGE = 1e-4  # ridge of a map's coefficients, as a share of the members' total weight
_MAX_LOGIT = 9.0  # largest absolute logit of an opacity between the two ends


@dataclass(frozen=True)
class EndPath:
    """Path from the original to the only known end of an edit."""

    trajectory: Trajectory
    bow: float  # mean distance of the visible colors from the straight line at strength 0.5, sRGB
    fades: bool  # opacities are straight as opacities

    @property
    def reason(self) -> str:
        """Description of the path, for the log."""
        levels = 255.0 * self.bow
        parts = ["no picture in between: "]
        if len(self.trajectory) == 2:
            parts.append(f"straight, as a color map would bow the path by {levels:.1f} of 255 levels only")
        elif self.bow < MIN_BOW:
            parts.append("straight")
        else:
            parts.append(
                f"a color map bowed in OKLab by {levels:.1f} of 255 levels at 0.5, the rest straight"
            )
        if self.fades:
            parts.append(", opacities fade evenly")
        return "".join(parts)


def find_end_path(line: Trajectory, rows: Tensor, weights: Tensor) -> EndPath:
    """Return the path of an edit whose editor makes no picture between the original and the finished edit.

    Both ends are those of the line.

    Args:
        line: the original and the finished edit, two recordings
        rows: raw values of the members before the edit, packed. [M,14+3K]
        weights: visibility of each member. [M]
    """
    knots = torch.linspace(0.0, 1.0, KNOTS)
    bands = member_bands(rows)
    before = (bands[:, 0] * C0 + 0.5).clamp(0.0, 1.0)
    finished = member_bands(line.end)[:, 0]
    changed = weights * finished.any(dim=1)
    after = ((bands[:, 0] + finished) * C0 + 0.5).clamp(0.0, 1.0)
    if line.maps is None:
        degree = 1
        table = identity_map(1)
    else:
        degree, tables = line.map_course
        table = tables[-1]
    has_map = not torch.equal(table, identity_map(degree))
    target = table if has_map else fit_colors_map(before, after, changed, degree)
    mapped = map_drawn(before.T, target, degree).T.clamp(0.0, 1.0)
    bend = bend_of(typical_color(before, changed), typical_color(mapped, changed))
    path = color_path(before, mapped, bend)
    bows = [path(float(s)) - torch.lerp(before, mapped, float(s)) for s in knots]
    shares = torch.ones_like(weights) if line.mask is None else line.mask.float() / 255.0
    half_bow = (shares[:, None] * bows[KNOTS // 2]).abs().mean(dim=1)
    bow = float((half_bow * changed).sum() / changed.sum().clamp_min(1e-12))
    opacity = attribute_slices(line.end.shape[1])["logit_opacities"]
    fades = _bends_opacity(rows[:, opacity], line.end[:, opacity], weights)
    if bow < MIN_BOW and not fades:
        return EndPath(line, bow, fades)
    maps = None
    changes = list[Tensor]()
    if line.maps is not None:
        straight = torch.lerp(identity_map(degree), table, knots[:, None, None])
        bent = torch.stack([_fit_table(before, one, changed, degree) for one in bows])
        maps = straight + (bent if bow >= MIN_BOW else 0.0)
        maps[-1] = table
        changes = [shares[:, None, None] * (map_colors(bands, one, degree) - bands) for one in maps]
    offsets = torch.zeros(KNOTS, *line.end.shape, dtype=torch.float16)
    for i in range(1, KNOTS):
        now = float(knots[i]) * line.end
        if changes:  # the rest of the change fades in
            excess = changes[i] - float(knots[i]) * changes[-1]
            now += band_offsets(excess, now.shape[1])
        elif bow >= MIN_BOW:
            now += band_offsets(bows[i][:, None] / C0, now.shape[1])
        if fades and i < KNOTS - 1:
            now[:, opacity] = _fade(rows[:, opacity], line.end[:, opacity], float(knots[i]))
        offsets[i] = now.half()
    offsets[-1] = line.end.half()
    trajectory = replace(
        line,
        s=knots,
        offsets=offsets,
        steps=(knots * float(line.steps[-1])).round().long(),
        stage_ends=(KNOTS - 1,),
        maps=None if maps is None else maps[1:],
    )
    return EndPath(trajectory, bow, fades)


def fit_colors_map(before: Tensor, after: Tensor, weights: Tensor, degree: int) -> Tensor:
    """Return the polynomial map of least weighted squares between the colors of members.

    Args:
        before, after: sRGB colors, 0 to 1. [M,3]
        weights: visibility of each member; 0 leaves it out. [M]
        degree: degree of the map, 1 to 3
    """
    return identity_map(degree) + _fit_table(before, after - before, weights, degree)


def _fit_table(colors: Tensor, change: Tensor, weights: Tensor, degree: int) -> Tensor:
    """Return the coefficients of a color's monomials that give a change best. [M,3], [M,3] -> [K,3]"""
    terms = monomials(colors.double().T, degree)
    weighted = terms * weights.double()
    normal = weighted @ terms.T + _RIDGE * weights.sum().double().clamp_min(1e-6) * torch.eye(len(terms))
    coefficients: Tensor = torch.linalg.solve(normal, weighted @ change.double())
    return coefficients.float()


def _bends_opacity(logits: Tensor, change: Tensor, weights: Tensor) -> bool:
    """Return True if straight logits differ visibly from straight opacities. [M,1], [M,1], [M]"""
    straight = (logits + 0.5 * change).sigmoid()
    even = 0.5 * (logits.sigmoid() + (logits + change).sigmoid())
    differences = (straight - even).abs()[:, 0] / even[:, 0].clamp_min(1e-6)
    return float((differences * weights).sum() / weights.sum()) >= MIN_BOW


def _fade(logits: Tensor, change: Tensor, strength: float) -> Tensor:
    """Return the change of logits at a strength by which opacities change evenly. [M,1], [M,1] -> [M,1]"""
    begin = logits.sigmoid()
    end = (logits + change).sigmoid()
    return torch.lerp(begin, end, strength).logit().clamp(-_MAX_LOGIT, _MAX_LOGIT) - logits
