"""Ground grid: lines behind the splats, visible where the splats are transparent."""

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
"""Radius of the grid in cells, where the lines have faded out."""
CLEAR = 0.3
"""Share of the radius without fading. The same value is in shaders/grid.frag."""
_CELLS_PER_RADIUS = 5.5  # cells per radius of the scene before rounding the cell size
_MAJOR_LINE_PERIOD = 10  # every tenth line is a major line
_NEAR_CELLS = 1e-3  # near plane of the lines, in cells
_FADE_SINE = 0.12  # sine of the camera's elevation below which the dense lines fade
_ALPHA = 0.30  # opacity of a line
_MAJOR_LINE_FACTOR = 1.6  # factor on the opacity of major lines
_AXIS_LINE_FACTOR = 2.2  # factor on the opacity of axis lines
_RED = (0.86, 0.20, 0.26)  # line colors of the X, Y and Z axes
_GREEN = (0.36, 0.62, 0.10)
_BLUE = (0.16, 0.44, 0.88)

Lines = NDArray[np.void]


@dataclass(frozen=True)
class GroundPlane:
    """Ground plane with its axes and grid."""

    origin: Vec3  # its point below or above the world's origin
    across: Vec3  # first axis, unit vector
    ahead: Vec3  # second axis, unit vector
    middle: tuple[int, int]  # center of the grid along the axes, in cells from `origin`
    cell: float  # side of a square, world units


def ground_plane(scene: Gaussians, up: Vec3) -> GroundPlane:
    """Fit the ground plane of a scene with up axis `up`. The cell size is 1, 2 or 5 times a power of ten."""
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
    """Project the grid lines in front of a camera.

    Args:
        plane: the ground plane
        camera: the picture's camera
        background: rgb behind the scene, which decides between dark and light lines

    Returns:
        [L] `GRID_LINE`
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
    # clip the lines at the near plane
    near = _NEAR_CELLS * plane.cell
    run = ends[:, 2] - starts[:, 2]
    cut = (near - starts[:, 2]) / np.where(run == 0.0, 1.0, run)
    first = np.where(starts[:, 2] < near, cut, 0.0)[:, None]
    last = np.where(ends[:, 2] < near, cut, 1.0)[:, None]
    in_front = np.maximum(starts[:, 2], ends[:, 2]) > near
    span = ends - starts
    cell_span = cells[:, 2:] - cells[:, :2]
    lines = np.zeros(len(cells), GRID_LINE)
    for at, share in ((0, first), (1, last)):
        points = starts + share * span
        depth = np.maximum(points[:, 2], near)
        lines["ends"][:, 2 * at : 2 * at + 2] = points[:, :2] / depth[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
        lines["depths"][:, at] = depth
        lines["cells"][:, 2 * at : 2 * at + 2] = (cells[:, :2] + share * cell_span) / HALF
    normal = np.cross(*axes) / plane.cell**2
    slope = abs(float(middle @ normal)) / max(float(np.linalg.norm(middle)), 1e-30)
    alpha = _ALPHA * min(slope / _FADE_SINE, 1.0)
    lines["color"][:, :3] = _line_color(background)
    lines["color"][:, 3] = alpha * np.where(numbers % _MAJOR_LINE_PERIOD == 0, _MAJOR_LINE_FACTOR, 1.0)
    for axis, family in ((plane.ahead, slice(0, len(steps))), (plane.across, slice(len(steps), None))):
        color = _axis_color(axis)
        if color is not None:
            lines["color"][family][numbers[family] == 0.0] = (*color, _AXIS_LINE_FACTOR * alpha)
    visible: Lines = lines[in_front]
    return visible


def _line_color(background: Vec3) -> Vec3:
    """Return a dark color on a light background and a light one on a dark background."""
    light = 0.3 * background[0] + 0.6 * background[1] + 0.1 * background[2]
    return (0.25, 0.25, 0.27) if light > 0.4 else (0.75, 0.76, 0.78)


def _axis_color(axis: Vec3) -> Vec3 | None:
    """Return the color of the world axis along `axis`, or None if there is none."""
    colors = (_RED, _GREEN, _BLUE)
    return next((color for color, part in zip(colors, axis, strict=True) if abs(part) > 0.999), None)
