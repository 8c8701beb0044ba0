"""The grid on the ground: lines behind the splats, where these let the background shine through."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.scene.subject import ground_height
from viewer.camera.view_camera import Vec3, add_scaled, bounds_of, cross, dot, front, unit
from viewer.gl.scene_textures import GRID_LINE

HALF = 10
"""Cells from the middle to where the lines have faded."""
CLEAR = 0.3
"""Share of that within which they have not begun to; shaders/grid.frag has the same."""
_CELLS_PER_RADIUS = 5.5
_EVERY = 10  # lines there is a stronger one
_NEAREST = 1e-3  # of a cell: what is nearer to the eye is not drawn
_LOWEST = 0.12  # sine of the elevation below which the lines are too close together to be told apart
_ALPHA = 0.30
_STRONG = 1.6
_AXIS = 2.2
_RED = (0.86, 0.20, 0.26)
_GREEN = (0.36, 0.62, 0.10)
_BLUE = (0.16, 0.44, 0.88)

Lines = NDArray[np.void]


@dataclass(frozen=True)
class GroundPlane:
    """A plane with two axes in it."""

    origin: Vec3  # the point of it that lies under or over the world's origin
    across: Vec3  # across, ahead: its axes, unit vectors
    ahead: Vec3
    middle: tuple[int, int]  # of the grid along these, cells from `origin`
    cell: float  # side of a square, world units


def ground_plane(scene: Gaussians, up: Vec3) -> GroundPlane:
    """The ground of a scene in which `up` is up, in squares of 1, 2 or 5 of a power of ten."""
    bounds = bounds_of(scene)
    up = unit(up, (0.0, 1.0, 0.0))
    height = ground_height(scene, torch.tensor(up)) if len(scene) else 0.0
    ahead = front(up)
    across = cross(up, ahead)
    side = bounds.radius / _CELLS_PER_RADIUS
    power = 10.0 ** math.floor(math.log10(side))
    cell = power * next(step for step in (10, 5, 2, 1) if step * power <= 1.0001 * side)
    middle = round(dot(bounds.center, across) / cell), round(dot(bounds.center, ahead) / cell)
    return GroundPlane(add_scaled((0.0, 0.0, 0.0), (height, up)), across, ahead, middle, cell)


def grid_lines(plane: GroundPlane, camera: Camera, background: Vec3) -> Lines:
    """The lines in a camera's picture, those that are in front of it. [L] of `GRID_LINE`

    Args:
        background: of the picture, so that the lines show on it
    """
    viewmat = camera.viewmat.double().numpy()
    K = camera.K.double().numpy()
    axes = plane.cell * np.array([plane.across, plane.ahead]) @ viewmat[:3, :3].T
    middle = viewmat[:3, :3] @ np.array(plane.origin) + viewmat[:3, 3] + np.array(plane.middle) @ axes
    steps = np.arange(1 - HALF, HALF, dtype=np.float64)
    reach = np.sqrt(HALF**2 - steps**2)
    lengthwise = np.stack([steps, -reach, steps, reach], axis=1)
    cells = np.concatenate([lengthwise, lengthwise[:, [1, 0, 3, 2]]])
    numbers = np.concatenate([steps + plane.middle[0], steps + plane.middle[1]])
    starts, ends = (middle + cells[:, at : at + 2] @ axes for at in (0, 2))
    # what lies before the nearest depth is cut off
    nearest = _NEAREST * plane.cell
    run = ends[:, 2] - starts[:, 2]
    cut = (nearest - starts[:, 2]) / np.where(run == 0.0, 1.0, run)
    first = np.where(starts[:, 2] < nearest, cut, 0.0)[:, None]
    last = np.where(ends[:, 2] < nearest, cut, 1.0)[:, None]
    in_front = np.maximum(starts[:, 2], ends[:, 2]) > nearest
    way = ends - starts
    drift = cells[:, 2:] - cells[:, :2]
    lines = np.zeros(len(cells), GRID_LINE)
    for at, share in ((0, first), (1, last)):
        points = starts + share * way
        depth = np.maximum(points[:, 2], nearest)
        lines["ends"][:, 2 * at : 2 * at + 2] = points[:, :2] / depth[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
        lines["depths"][:, at] = depth
        lines["cells"][:, 2 * at : 2 * at + 2] = (cells[:, :2] + share * drift) / HALF
    normal = np.cross(*axes) / plane.cell**2
    slope = abs(float(middle @ normal)) / max(float(np.linalg.norm(middle)), 1e-30)
    alpha = _ALPHA * min(slope / _LOWEST, 1.0)
    lines["color"][:, :3] = _line_color(background)
    lines["color"][:, 3] = alpha * np.where(numbers % _EVERY == 0, _STRONG, 1.0)
    for axis, of in ((plane.ahead, slice(0, len(steps))), (plane.across, slice(len(steps), None))):
        color = _axis_color(axis)
        if color is not None:
            lines["color"][of][numbers[of] == 0.0] = (*color, _AXIS * alpha)
    visible: Lines = lines[in_front]
    return visible


def _line_color(background: Vec3) -> Vec3:
    """Dark on a light background, light on a dark one."""
    light = 0.3 * background[0] + 0.6 * background[1] + 0.1 * background[2]
    return (0.25, 0.25, 0.27) if light > 0.4 else (0.75, 0.76, 0.78)


def _axis_color(axis: Vec3) -> Vec3 | None:
    """Of the line through the origin: that of the world's axis along it, None where there is none."""
    colors = (_RED, _GREEN, _BLUE)
    return next((color for color, part in zip(colors, axis, strict=True) if abs(part) > 0.999), None)
