"""A selection under way: where the hand has been, and what that selects. Pure: no imgui, no GL."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from progdf.scene.neighbors import Neighborhood, grow_along_surface
from progdf.scene.selection import (
    Centers,
    Mask,
    Surface,
    alike_in_color,
    inside_ball,
    inside_polygon,
    inside_rectangle,
    inside_stroke,
)
from viewer.camera.up_axis import Vec3
from viewer.render.picking import Seen, seen_at, surface_point

_SEEDS = 0.1  # of a pixel's color that a Gaussian gives to be a seed

Point = tuple[float, float]


@dataclass(frozen=True)
class Brushed:
    """What a brush can reach, and what it has touched.

    Args:
        centers: of all Gaussians
        reachable: those that are not behind others, or all. [N]
        touched: so far. [N]
    """

    centers: Centers
    reachable: Mask
    touched: Mask


@dataclass(frozen=True)
class Gesture:
    """A selection under way.

    Args:
        tool: of `SELECT_TOOLS`
        mode: of `SELECT_MODES`
        before: what was selected when it began, packed
        path: where the hand has been, pixels of the picture; the corners of a polygon
        brushed: of a brush
        center: of a sphere, world units
        scale: world units per pixel there
    """

    tool: str
    mode: str
    before: bytes
    path: tuple[Point, ...]
    brushed: Brushed | None = None
    center: Vec3 | None = None
    scale: float = 0.0

    @property
    def radius(self) -> float:
        """Of a sphere, world units."""
        return self.scale * float(np.hypot(*np.subtract(self.path[-1], self.path[0])))


@dataclass(frozen=True)
class Click:
    """A click of "flood" or "color", which follows its tolerance until something else is selected.

    Args:
        tool: of the two
        mode: of `SELECT_MODES`
        before: what was selected when it came, packed
        at: pixels of the picture
        surface: of the scene on screen then
        options: tolerance and depth by which it last selected
        after: what was selected by that, packed
        recorded: what undo knows of it, packed
    """

    tool: str
    mode: str
    before: bytes
    at: Point
    surface: Surface
    options: tuple[float, bool]
    after: bytes
    recorded: bytes


def begin(tool: str, mode: str, before: bytes, at: Point, surface: Surface, through: bool) -> Gesture | None:
    """What begins where the mouse was pressed; None for a sphere on the background.

    Args:
        surface: of the scene on screen
        through: also what lies behind the front surface
    """
    gesture = Gesture(tool, mode, before, (at,))
    if tool == "brush":
        front = np.isfinite(surface.centers.points[:, 0])
        if not through:
            front = surface.front(np.arange(len(front)))
        return replace(gesture, brushed=Brushed(surface.centers, front, np.zeros(len(front), bool)))
    if tool == "sphere":
        camera, center = surface.camera, surface_point(surface.scene, surface.camera, *at)
        if center is None:
            return None
        depth = float(camera.viewmat[2, :3] @ torch.tensor(center, dtype=camera.viewmat.dtype))
        scale = (depth + float(camera.viewmat[2, 3])) / float(camera.K[0, 0])
        return replace(gesture, center=center, scale=scale)
    return gesture


def extend(gesture: Gesture, at: Point, radius: float) -> Gesture:
    """With the hand at another place.

    Args:
        radius: of a brush, pixels of the picture
    """
    if gesture.tool in ("box", "sphere"):
        return replace(gesture, path=(gesture.path[0], at))
    if gesture.brushed is not None:
        brushed = gesture.brushed
        touched = inside_stroke(brushed.centers.points, (gesture.path[-1], at), radius) & brushed.reachable
        gesture = replace(gesture, brushed=replace(brushed, touched=brushed.touched | touched))
    return gesture if at == gesture.path[-1] else replace(gesture, path=(*gesture.path, at))


def enclosed(gesture: Gesture, surface: Surface, through: bool) -> Mask:
    """What the gesture selects as it is. Arguments as of `begin`. [N]"""
    if gesture.brushed is not None:
        return gesture.brushed.touched
    if gesture.center is not None:
        return inside_ball(surface.scene, gesture.center, gesture.radius)
    points = surface.centers.points
    if gesture.tool == "box":
        mask = inside_rectangle(points, gesture.path[0], gesture.path[-1])
    else:
        mask = inside_polygon(points, gesture.path)
    if not through:
        rows = np.flatnonzero(mask)
        mask[rows] = surface.front(rows)
    return mask


def clicked(
    tool: str,
    at: Point,
    surface: Surface,
    tolerance: float,
    through: bool,
    neighborhood: Callable[[], Neighborhood],
) -> Mask | None:
    """What a click of "flood" or "color" selects; None on the background. Arguments as of `begin`. [N]"""
    seen = seen_at(surface.scene, surface.camera, *at)
    if seen is None:
        return None
    colors = surface.colors
    color = np.average(colors[seen.rows], axis=0, weights=seen.shares)
    seeds = _seeds(seen)
    if tool == "flood":
        return grow_along_surface(neighborhood(), colors, seeds, color, tolerance)
    mask = alike_in_color(colors, color, tolerance)
    mask[seeds] = True
    if not through:
        rows = np.flatnonzero(mask)
        mask[rows] = surface.front(rows)
    return mask


def _seeds(seen: Seen) -> np.ndarray:
    """The Gaussians that make most of what one sees at a pixel."""
    return seen.rows[seen.shares >= min(_SEEDS, float(seen.shares.max()))]
