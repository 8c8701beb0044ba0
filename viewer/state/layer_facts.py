"""What a layer row tells about its .gdf: how many Gaussians, which color, where it was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from progdf.compose.layers import KINDS
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.sh import sh0_to_rgb
from viewer.camera.view_camera import Bounds, Fit, bounds_of, fit, keep_camera

from .change_curve import Curve, curve_of, flat

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class LayerRow:
    """One .gdf as the panel shows it.

    Args:
        count: Gaussians in its region
        swatch: their mean color at full strength, 0..1
        recorded: strengths of the recorded snapshots
        instruction: what was asked for
        bounds: of the bulk of its members
        shared: per edit, in their order: how many Gaussians of this one are also in it (in itself: all)
        kinds: which gains of `Gains` have something to scale
        curve: the visible change over the strength, measured when it is first asked for
        points: centers of its members in the original, world units. [M,3] float32
        fit: gives the camera that frames this layer
    """

    count: int
    swatch: Rgb
    recorded: tuple[float, ...]
    instruction: str
    bounds: Bounds
    shared: tuple[int, ...] = ()
    kinds: frozenset[str] = frozenset(KINDS.values())
    curve: Curve = flat
    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32), compare=False)
    fit: Fit = keep_camera


def layer_rows(scene: Gaussians, gdfs: Sequence[Gdf]) -> tuple[LayerRow, ...]:
    """One row per .gdf, in their order."""
    return tuple(_row(scene, gdf, gdfs) for gdf in gdfs)


def _row(scene: Gaussians, gdf: Gdf, gdfs: Sequence[Gdf]) -> LayerRow:
    members = gdf.region.members
    return LayerRow(
        count=len(members),
        swatch=_mean_color(scene, gdf),
        recorded=gdf.field.recorded,
        instruction=gdf.instruction,
        bounds=bounds_of(scene[members]),
        shared=tuple(_in_both(gdf, other) for other in gdfs),
        kinds=frozenset(KINDS[name] for name in gdf.field.attributes),
        curve=curve_of(scene, gdf),
        points=scene.means[members].numpy(),
        fit=lambda camera, aspect: fit(camera, scene[members], aspect),
    )


def _in_both(gdf: Gdf, other: Gdf) -> int:
    """How many Gaussians two regions share."""
    members = (gdf.region.members.numpy(), other.region.members.numpy())
    return len(np.intersect1d(*members, assume_unique=True))


def _mean_color(scene: Gaussians, gdf: Gdf) -> Rgb:
    """Mean of the edited colors, weighted by the original opacities."""
    members = gdf.region.members
    if not len(members):
        return 0.5, 0.5, 0.5
    sh0 = scene.sh0[members]
    bases = gdf.field.attributes.get("sh0")
    if bases is not None:
        sh0 = sh0 + bases.end_offset
    weights = scene.opacities[members].nan_to_num()[:, None] + 1e-6
    color = (sh0_to_rgb(sh0).nan_to_num().clamp(0.0, 1.0) * weights).sum(0) / weights.sum()
    red, green, blue = (float(c) for c in color)
    return red, green, blue
