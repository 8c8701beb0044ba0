"""The grid on the ground: lines behind the splats, where these let the background shine through."""

from __future__ import annotations

import math
from dataclasses import dataclass

import moderngl
import numpy as np
import torch

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.scene.subject import ground_height
from viewer.camera.up_axis import Vec3
from viewer.camera.view_camera import add_scaled, bounds_of, cross, dot, front, unit

from .programs import load_program

HALF = 20
"""Lines to either side of the middle, each way."""
_CELLS_PER_RADIUS = 8.0
_NEAREST = 1e-3  # of a cell: what is nearer to the eye is not drawn
_LOWEST = 0.12  # sine of the elevation below which the lines are too close together to be told apart
_ALPHA = 0.34
_RED, _GREEN, _BLUE = (0.86, 0.20, 0.26), (0.36, 0.62, 0.10), (0.16, 0.44, 0.88)


@dataclass(frozen=True)
class GroundPlane:
    """A plane with two axes in it.

    Args:
        origin: the point of it that lies under or over the world's origin
        across, ahead: its axes, unit vectors
        middle: of the grid along these, cells from `origin`
        cell: side of a square, world units
    """

    origin: Vec3
    across: Vec3
    ahead: Vec3
    middle: tuple[int, int]
    cell: float


def ground_plane(scene: Gaussians, up: Vec3) -> GroundPlane:
    """The ground of a scene in which `up` is up, in squares of 1, 2 or 5 of a power of ten."""
    bounds, up = bounds_of(scene), unit(up, (0.0, 1.0, 0.0))
    height = ground_height(scene, torch.tensor(up)) if len(scene) else 0.0
    ahead = front(up)
    across = cross(up, ahead)
    wanted = bounds.radius / _CELLS_PER_RADIUS
    power = 10.0 ** math.floor(math.log10(wanted))
    cell = power * next(step for step in (10, 5, 2, 1) if step * power <= 1.0001 * wanted)
    middle = round(dot(bounds.center, across) / cell), round(dot(bounds.center, ahead) / cell)
    return GroundPlane(add_scaled((0.0, 0.0, 0.0), (height, up)), across, ahead, middle, cell)


class GroundGrid:
    """Draws the grid over a picture that is already in a framebuffer.

    Args:
        ctx: to draw in
    """

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._program = load_program(ctx, "grid.vert", "grid.frag")
        self._vao = ctx.vertex_array(self._program, [])

    def draw(
        self,
        plane: GroundPlane,
        camera: Camera,
        background: Vec3,
        coverage: moderngl.Texture,
        framebuffer: moderngl.Framebuffer,
        size: tuple[int, int],
        left: int = 0,
    ) -> None:
        """Draw it into the lower `size` pixels of `framebuffer` from the column `left` on.

        Args:
            camera: of the picture, which may have fewer pixels
            background: of the picture, so that the lines show on it
            coverage: what the scene covers of each pixel, in alpha; its first row is the upper one
        """
        viewmat, K = camera.viewmat.double().numpy(), camera.K.double().numpy()
        across, ahead = (
            plane.cell * viewmat[:3, :3] @ np.array(axis) for axis in (plane.across, plane.ahead)
        )
        origin = viewmat[:3, :3] @ np.array(plane.origin) + viewmat[:3, 3]
        middle = origin + plane.middle[0] * across + plane.middle[1] * ahead
        normal = np.cross(ahead, across) / plane.cell**2
        slope = abs(float(middle @ normal)) / max(float(np.linalg.norm(middle)), 1e-30)
        scale = size[0] / camera.width, size[1] / camera.height
        values = {
            "middle": tuple(middle),
            "across": tuple(across),
            "ahead": tuple(ahead),
            "first": plane.middle,
            "lines": HALF,
            "nearest": _NEAREST * plane.cell,
            "intrinsics": (K[0, 0] * scale[0], K[1, 1] * scale[1], K[0, 2] * scale[0], K[1, 2] * scale[1]),
            "shown_size": size,
            "left": left,
            "ink": (*_line_color(background), _ALPHA * min(slope / _LOWEST, 1.0)),
            "across_ink": _axis_color(plane.across),
            "ahead_ink": _axis_color(plane.ahead),
            "coverage": 0,
        }
        for name, value in values.items():
            self._program[name] = value
        framebuffer.use()
        self._ctx.viewport = (left, 0, *size)
        self._ctx.enable_only(moderngl.BLEND)
        self._ctx.blend_equation = moderngl.FUNC_ADD, moderngl.FUNC_ADD
        ways = (moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA, moderngl.ZERO, moderngl.ONE)
        self._ctx.blend_func = ways  # type: ignore[assignment]  # its annotation forgets that alpha has its own
        coverage.use(0)
        self._vao.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=2 * (2 * HALF + 1))

    def release(self) -> None:
        self._vao.release()
        self._program.release()


def _line_color(background: Vec3) -> Vec3:
    """Dark on a light background, light on a dark one."""
    light = 0.3 * background[0] + 0.6 * background[1] + 0.1 * background[2]
    return (0.25, 0.25, 0.27) if light > 0.4 else (0.75, 0.76, 0.78)


def _axis_color(axis: Vec3) -> Vec3:
    """Of the line through the origin: that of the world's axis along it; black where there is none."""
    colors = (_RED, _GREEN, _BLUE)
    return next((color for color, part in zip(colors, axis, strict=True) if abs(part) > 0.999), (0.0,) * 3)
