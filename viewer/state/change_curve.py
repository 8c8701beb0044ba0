"""How much one edit shows at each strength: the curve that its row draws over the slider."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Protocol

import torch
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.metrics.slider import visible_change
from progdf.rasterize import render
from viewer.camera.view_camera import ViewCamera, bounds_of, frame, to_camera

from .view_state import OVERSHOOT

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
