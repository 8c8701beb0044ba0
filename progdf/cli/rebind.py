"""The command `progdf rebind EDIT.gdf --from A --to B -o C.gdf`: carry an edit over to another scene file.

Other formats change the numbers and the order of the Gaussians. Each Gaussian of B gets the offsets of the
matching Gaussian of A. The match minimizes the differences in position, color, opacity and shape among the
nearest candidates, and is one to one where possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from numpy.typing import NDArray

from progdf.errors import ProgdfError
from progdf.field.baked import AttributeBases, BakedField
from progdf.field.separable import fit_bands
from progdf.formats.scene_file import load_scene, rotate_about_x, scene_name
from progdf.gaussians import BASE_CHANNELS, Gaussians
from progdf.gdf.file import Gdf, anchor_added, fingerprint, load_gdf, save_gdf
from progdf.io.atomic import check_not_an_input
from progdf.region import Region
from progdf.scene.point_tree import PointTree
from progdf.sh import sh0_to_rgb
from progdf.system.equality import equal_fields
from progdf.terminal import print_line

from .options import parse_options

_CANDIDATE_COUNT = 8  # nearest Gaussians of A to consider for each Gaussian of B
_MIN_MATCHED = 0.9
"""Smallest share of B's Gaussians that must be found in A. With fewer, B is another scene."""

_COLOR_TOLERANCE = 0.1
"""Tolerance of color and opacity (0 to 1): five times the error of the coarsest format."""

Rows = NDArray[np.int64]


@dataclass(frozen=True)
class RebindOptions:
    """Carry an edit over to the same scene in another file or format."""

    edit: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="EDIT.gdf")]
    """Edit to carry over."""
    source: Annotated[Path, tyro.conf.arg(name="from", metavar="SCENE")]
    """Scene that the edit was made for."""
    target: Annotated[Path, tyro.conf.arg(name="to", metavar="SCENE")]
    """Same scene in another file."""
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="NEW.gdf")]
    """File to write, ending in .gdf."""


@dataclass(frozen=True)
class Match:
    """Assignment of A's Gaussians to those of B, with its quality."""

    __eq__ = equal_fields

    rows: Rows  # row of A for each row of B. [N] int64
    matched: float  # share of B's rows that match in position and color, 0 to 1
    once: float  # share of B's rows whose row of A is used only once, 0 to 1
    # median, p95: distance between matched Gaussians, in units of the median size of A's Gaussians
    median: float
    p95: float


def main(argv: Sequence[str]) -> int:
    """Write the edit for the other file.

    Raises:
        ProgdfError: the two scenes are not the same.
    """
    options = parse_options(RebindOptions, argv, "progdf rebind")
    if options.out.suffix.lower() != ".gdf":
        raise ProgdfError(f"{options.out} is not a .gdf file; give the edit a name that ends in .gdf")
    check_not_an_input(options.out, [options.edit, options.source, options.target])
    a = load_scene(options.source)
    b = load_scene(options.target)
    gdf = load_gdf(options.edit, a, scene_name(options.source))
    match = match_scenes(a, b)
    print_line(
        f"matched: {match.matched:.1%} of {scene_name(options.target)}, {match.once:.1%} one to one; "
        f"distance {match.median:.3g} (95 %: {match.p95:.3g}) of the median Gaussian's size"
    )
    if match.matched < _MIN_MATCHED:
        is_rotated = match_scenes(a, rotate_about_x(b)).matched >= _MIN_MATCHED
        fault = "is the same scene rotated by 180° about x" if is_rotated else "is another scene"
        raise ProgdfError(
            f"{options.target} {fault}: {match.matched:.0%} of its Gaussians are found in {options.source}, "
            f"{_MIN_MATCHED:.0%} are needed; give the same scene"
        )
    rebound = rebind_edit(gdf, a, b, match)
    save_gdf(options.out, rebound)
    print_line(f"wrote {options.out}: {len(rebound.region)} members, {len(gdf.region)} in the original")
    return 0


def match_scenes(a: Gaussians, b: Gaussians) -> Match:
    """Match each Gaussian of B to a Gaussian of A. Both scenes need at least one."""
    k = min(_CANDIDATE_COUNT, len(a))
    positions = b.means.numpy() + np.subtract(b.origin, a.origin)  # relative to A's origin, float64
    distances, candidates = PointTree(a.means.numpy(), k).query(positions, k)
    sizes = a.scales.amax(dim=1).numpy()
    typical = max(float(np.median(sizes)), 1e-12)
    color = np.abs(_colors(a)[candidates] - _colors(b)[:, None]).max(axis=2)
    log_scales = [s.log_scales.clamp(-10.0, 10.0).numpy() for s in (a, b)]
    shape = np.abs(log_scales[0][candidates] - log_scales[1][:, None]).mean(axis=2)
    opacity = np.abs(a.opacities.numpy()[candidates] - b.opacities.numpy()[:, None])
    costs = (
        (distances / typical) ** 2
        + (color / _COLOR_TOLERANCE) ** 2
        + shape**2
        + (opacity / _COLOR_TOLERANCE) ** 2
    )
    chosen = _assign_rows(candidates, costs, len(a))
    rows = np.take_along_axis(candidates, chosen[:, None], 1)[:, 0]
    distance = np.take_along_axis(distances, chosen[:, None], 1)[:, 0]
    is_near = distance <= np.maximum(sizes[rows], typical)
    is_alike = np.take_along_axis(color, chosen[:, None], 1)[:, 0] <= _COLOR_TOLERANCE
    use_counts = np.bincount(rows, minlength=len(a))
    return Match(
        rows=rows,
        matched=float((is_near & is_alike).mean()),
        once=float((use_counts[rows] == 1).mean()),
        median=float(np.median(distance)) / typical,
        p95=float(np.quantile(distance, 0.95)) / typical,
    )


def rebind_edit(gdf: Gdf, a: Gaussians, b: Gaussians, match: Match) -> Gdf:
    """Return the edit with the offsets of A's members on the matching Gaussians of B.

    A network or a grade becomes the separable field that it was baked to.

    Raises:
        ProgdfError: the edit has no members, or none of them is in B.
    """
    members = gdf.region.members.numpy()
    if not len(members):
        raise ProgdfError(f"{gdf.name} has no members; train it again")
    index = np.searchsorted(members, match.rows).clip(max=len(members) - 1)
    member_rows = np.flatnonzero(members[index] == match.rows)
    if not len(member_rows):
        raise ProgdfError(f"no member of {gdf.name} is in the other scene; give the same scene")
    rows = torch.from_numpy(member_rows)
    of_a = torch.from_numpy(match.rows)
    source = torch.cat([torch.from_numpy(index[member_rows]), torch.arange(len(members), gdf.members)])
    # q and −q are the same rotation, but their offsets have opposite signs
    flipped = torch.zeros(len(source), dtype=torch.bool)
    flipped[: len(rows)] = (a.quats[of_a[rows]] * b.quats[rows]).sum(dim=1) < 0
    attributes = {}
    for name, bases in gdf.field.attributes.items():
        full = bases.end_offset[source]
        basis = bases.residual_basis[:, source]
        step = bases.scale
        if name == "quats":
            full = torch.where(flipped[:, None], -full, full)
            basis = torch.where(flipped[None, :, None], -basis, basis)
        elif name == "shN":
            full, basis, step = (fit_bands(tensor, 3 * b.shN.shape[1]) for tensor in (full, basis, step))
        if full.shape[1]:
            attributes[name] = AttributeBases(full, basis, step, bases.coefficients)
    field = BakedField(
        kind="separable" if gdf.field.origin is not None else gdf.field.kind,
        knots=gdf.field.knots,
        attributes=attributes,
        channels=BASE_CHANNELS + (3 * b.shN.shape[1] if "shN" in attributes else 0),
        recorded=gdf.field.recorded,
    )
    quality = {"matched": match.matched, "one_to_one": match.once, "median": match.median, "p95": match.p95}
    motions = gdf.motions
    if motions is not None:
        motions = replace(motions, parts=motions.parts[torch.from_numpy(index[member_rows])])
    rebound = replace(
        gdf,
        motions=motions,
        region=Region(gdf.region.name, rows, gdf.region.score[of_a]),
        field=field,
        scene=fingerprint(b),
        report={**gdf.report, "rebound": quality},
        anchors=None,
    )
    if gdf.anchors is None:
        return rebound
    found = anchor_added(rebound, b, gdf.anchors.pushes, gdf.anchors.free)
    if found.anchors is None:
        return found
    kept = replace(found.anchors, rim=gdf.anchors.rim, leaves_paint=gdf.anchors.leaves_paint)
    return replace(found, anchors=kept)


def _assign_rows(candidates: Rows, costs: NDArray[np.float64], count: int) -> Rows:
    """Assign a candidate to each row of B, greedily by cost and one to one. [N,k] -> [N]

    A row whose candidates are all taken gets its cheapest one.
    """
    chosen = np.full(len(candidates), -1)
    free = np.ones(count, bool)
    open_rows = np.arange(len(candidates))
    for _ in range(candidates.shape[1]):
        open_costs = np.where(free[candidates[open_rows]], costs[open_rows], np.inf)
        best = open_costs.argmin(axis=1)
        cost = open_costs[np.arange(len(open_rows)), best]
        cheapest = candidates[open_rows, best]
        order = np.lexsort((cost, cheapest))
        order = order[np.isfinite(cost[order])]
        winners = order[np.unique(cheapest[order], return_index=True)[1]]
        chosen[open_rows[winners]] = best[winners]
        free[cheapest[winners]] = False
        open_rows = np.delete(open_rows, winners)
    chosen[open_rows] = costs[open_rows].argmin(axis=1)
    return chosen


def _colors(scene: Gaussians) -> NDArray[np.float32]:
    """Return the colors of band 0, clamped to 0 to 1, because some formats store only these. [N,3]"""
    rgb: NDArray[np.float32] = sh0_to_rgb(scene.sh0).clamp(0.0, 1.0).numpy()
    return rgb
