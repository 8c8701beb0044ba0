"""What a layer row tells about its .gdf: how many Gaussians, which color, where recorded, how it grows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.layers import KINDS
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.metrics.slider import visible_change
from progdf.rasterize import render
from progdf.sh import sh0_to_rgb
from viewer.camera.view_camera import Bounds, Fit, ViewCamera, bounds_of, fit, frame, keep_camera, to_camera

from .view_state import OVERSHOOT

Rgb = tuple[float, float, float]

STEPS = 20
"""Of the slider from 0 to 1; the curve goes on to `OVERSHOOT` in steps of the same length."""

SIDE_PX = 72
MOST_MEMBERS = 20_000
"""Of a larger region every so-manieth Gaussian is drawn, so that a row unfolds in a fraction of a second."""

_FROM = (20.0, 200.0)  # degrees around the scene: from before and behind


class Curve(Protocol):
    """Gives the visible change at 0, 1/`STEPS`, … up to `OVERSHOOT`, as shares of that at 1."""

    def __call__(self) -> Sequence[float]: ...


def flat() -> Sequence[float]:
    """The curve of an edit of which nothing is known."""
    return ()


def curve_of(scene: Gaussians, gdf: Gdf) -> Curve:
    """The curve of one edit, drawn when it is first asked for."""

    @cache
    def measure() -> Sequence[float]:
        return visible_changes(scene, gdf)

    return measure


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
        region: its name
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
    region: str = ""


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
        region=gdf.region.name,
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


def visible_changes(scene: Gaussians, gdf: Gdf) -> tuple[float, ...]:
    """Mean absolute difference of small renders of the region alone, from two sides, to those at 0.

    Args:
        scene: the original
        gdf: the edit

    Returns:
        At 0, 1/`STEPS`, … up to `OVERSHOOT`; 1 at strength 1, or all 0 where the edit shows nothing.
    """
    members = gdf.region.members
    count = round(OVERSHOOT * STEPS) + 1
    if not len(members):
        return (0.0,) * count
    every = -(-len(members) // MOST_MEMBERS)
    region = scene[members[::every]]
    bounds = bounds_of(region)
    cameras = [to_camera(frame(ViewCamera(azimuth=azimuth), bounds), SIDE_PX, SIDE_PX) for azimuth in _FROM]

    def pictures(strength: float) -> list[Tensor]:
        moved: dict[str, Any] = {}
        for name in gdf.field.attributes:
            old: Tensor = getattr(region, name)
            moved[name] = old + gdf.field.attribute_offsets(name, strength)[::every].reshape(old.shape)
        edited = replace(region, **moved)
        with torch.no_grad():
            return [render(edited, camera, (0.5, 0.5, 0.5)).image for camera in cameras]

    original = pictures(0.0)
    changes = [visible_change(original, pictures(i / STEPS)) for i in range(count)]
    whole = changes[STEPS]
    return tuple(change / whole for change in changes) if whole > 0.0 else (0.0,) * count
