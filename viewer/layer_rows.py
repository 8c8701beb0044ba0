"""What a layer row tells about its .gdf: how many Gaussians, which colour, where it was recorded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from progdf.checkpoint import Gdf
from progdf.gaussians import Gaussians
from progdf.sh import sh0_to_rgb

from .turntable import Bounds, bounds_of

Rgb = tuple[float, float, float]


@dataclass(frozen=True)
class LayerRow:
    """One .gdf as the panel shows it.

    Args:
        count: Gaussians in its region
        swatch: their mean colour at full strength, 0..1
        recorded: strengths of the recorded snapshots
        instruction: what was asked for
        bounds: what the camera frames for this layer
    """

    count: int
    swatch: Rgb
    recorded: tuple[float, ...]
    instruction: str
    bounds: Bounds


def layer_rows(scene: Gaussians, gdfs: Sequence[Gdf]) -> tuple[LayerRow, ...]:
    """One row per .gdf, in their order."""
    return tuple(_row(scene, gdf) for gdf in gdfs)


def _row(scene: Gaussians, gdf: Gdf) -> LayerRow:
    members = gdf.region.members
    return LayerRow(
        count=len(members),
        swatch=_mean_colour(scene, gdf),
        recorded=gdf.field.recorded,
        instruction=gdf.instruction,
        bounds=bounds_of(scene[members]),
    )


def _mean_colour(scene: Gaussians, gdf: Gdf) -> Rgb:
    """Mean of the edited colours, weighted by the original opacities."""
    members = gdf.region.members
    if not len(members):
        return 0.5, 0.5, 0.5
    sh0 = scene.sh0[members]
    bases = gdf.field.attributes.get("sh0")
    if bases is not None:
        sh0 = sh0 + bases.full
    weights = scene.opacities[members].nan_to_num()[:, None] + 1e-6
    colour = (sh0_to_rgb(sh0).nan_to_num().clamp(0.0, 1.0) * weights).sum(0) / weights.sum()
    red, green, blue = (float(c) for c in colour)
    return red, green, blue
