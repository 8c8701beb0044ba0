"""What is known of the open scene's edits: their rows in the panel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.layers import KINDS
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.rasterize import render
from progdf.sh import sh0_to_rgb
from viewer.camera.view_camera import Bounds, Fit, ViewCamera, bounds_of, fit, keep_camera, to_camera

Rgb = tuple[float, float, float]

THUMBNAIL_SIDE = 48
MAX_COUNTED_MEMBERS = 20_000
"""Of a larger region every so-manieth Gaussian is drawn, so that a row unfolds in a fraction of a second."""

_GROUND = 56  # of a thumbnail: the gray behind it, 0..255
_NEAR = 0.7  # the share of a framing distance


Thumbnail = Callable[[ViewCamera], NDArray[np.uint8]]


@dataclass(frozen=True)
class LayerRow:
    """One .gdf as the panel shows it."""

    count: int  # Gaussians in its region
    swatch: Rgb  # their mean color at full strength, 0..1
    recorded: tuple[float, ...]  # strengths of the recorded snapshots
    instruction: str  # what was asked for
    bounds: Bounds  # of the bulk of its members
    # per edit, in their order: how many Gaussians of this one are also in it (in itself: all)
    shared: tuple[int, ...] = ()
    kinds: frozenset[str] = frozenset(KINDS.values())  # which gains of `Gains` have something to scale
    # centers of its members in the original, world units. [M,3] float32
    points: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3), np.float32), compare=False)
    fit: Fit = keep_camera  # gives the camera that frames this layer
    region: str = ""  # its name
    region_spec: str = ""  # as it was given to the training, "" where that is not known
    # its rows of the scene that is drawn. [M] int64
    members: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64), compare=False)
    draft: bool = False  # a grade alone, until its training is done
    added: int = 0  # how many of its members the scene does not have
    from_others: int = 0  # how many of the last of them other edits add
    # its picture, see `draw_thumbnail`
    thumbnail: Thumbnail = field(default=lambda _: np.zeros((48, 48, 3), np.uint8), compare=False)


def layer_rows(scene: Gaussians, gdfs: Sequence[Gdf], added: Sequence[int] = ()) -> tuple[LayerRow, ...]:
    """One row per .gdf, in their order; `added`: how many Gaussians of its own each has, see `extend`."""
    return tuple(
        _row(scene, gdf, gdfs, count) for gdf, count in zip(gdfs, added or [0] * len(gdfs), strict=True)
    )


def _row(scene: Gaussians, gdf: Gdf, gdfs: Sequence[Gdf], added: int) -> LayerRow:
    members, given = gdf.region.members, gdf.options.get("region")
    return LayerRow(
        count=len(members),
        swatch=_mean_color(scene, gdf),
        recorded=gdf.field.recorded,
        instruction=gdf.instruction,
        bounds=bounds_of(scene[members]),
        shared=tuple(_in_both(gdf, other) for other in gdfs),
        kinds=frozenset(KINDS[name] for name in gdf.field.attributes),
        points=scene.means[members].numpy(),
        fit=lambda camera, aspect: fit(camera, scene[members], aspect),
        region=gdf.region.name,
        region_spec=str(given.get("region", "")) if isinstance(given, dict) else "",
        members=members.numpy(),
        draft="draft" in gdf.report,
        added=added,
        from_others=gdf.from_others,
        thumbnail=partial(draw_thumbnail, scene, gdf),
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
        sh0 = sh0 + bases.end
    weights = scene.opacities[members].nan_to_num()[:, None] + 1e-6
    color = (sh0_to_rgb(sh0).nan_to_num().clamp(0.0, 1.0) * weights).sum(0) / weights.sum()
    red, green, blue = (float(c) for c in color)
    return red, green, blue


def _finished_region(scene: Gaussians, gdf: Gdf) -> Gaussians:
    """The region alone at full strength, of many members every so-manieth."""
    every = max(-(-len(gdf.region.members) // MAX_COUNTED_MEMBERS), 1)
    region = scene[gdf.region.members[::every]]
    moved = dict[str, Any]()
    for name in gdf.field.attributes:
        old: Tensor = getattr(region, name)
        moved[name] = old + gdf.field.attribute_offsets(name, 1.0)[::every].reshape(old.shape)
    return replace(region, **moved)


def draw_thumbnail(scene: Gaussians, gdf: Gdf, camera: ViewCamera) -> NDArray[np.uint8]:
    """The region alone at full strength, from where `camera` looks. [THUMBNAIL_SIDE,THUMBNAIL_SIDE,3]"""
    side = THUMBNAIL_SIDE
    region = _finished_region(scene, gdf)
    if not len(region):
        return np.full((side, side, 3), _GROUND, np.uint8)
    with torch.no_grad():
        near = fit(camera, region, 1.0)
        taken = to_camera(replace(near, distance=_NEAR * near.distance), side, side)
        image = render(region, taken, (_GROUND / 255,) * 3).image
    pixels: NDArray[np.uint8] = (image.nan_to_num().clamp(0.0, 1.0) * 255).round().byte().numpy()
    return pixels


def describe_applied(gdf: Gdf) -> str:
    """What is not shown of a grade that was applied to a region, in one line; "" where all is."""
    parts = gdf.report.get("left_out") if gdf.applied else ""
    left_out = f"without its {parts}, which fits the scene it was trained on alone"
    return f"{gdf.name} on {gdf.region.name}: {left_out}" if parts else ""
