"""Coordinate axes of scene formats, and half turns between them.

Three letters name the directions of x, y and z, as in the SPZ library: right or left, up or down, forward or
back. Any two of these systems differ by half a turn, which only permutes numbers and changes signs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, get_args

import torch

from progdf import sh
from progdf.gaussians import Gaussians

Axes = Literal["RDF", "RUB", "LUF"]
"""Axis systems. RDF: 3DGS .ply and this program. RUB: OpenGL and .spz. LUF: glTF."""

GlbAxes = Literal["LUF", "RUB"]
"""Axis systems for writing a .glb: the two with y up."""

AXES: tuple[Axes, ...] = get_args(Axes)

_SIGNS: dict[Axes, sh.Signs] = {
    "RDF": (1.0, 1.0, 1.0),
    "RUB": (1.0, -1.0, -1.0),
    "LUF": (-1.0, -1.0, 1.0),
}

_HALF_TURNS: dict[sh.Signs, tuple[list[int], list[float]]] = {
    (1.0, -1.0, -1.0): ([1, 0, 3, 2], [-1.0, 1.0, -1.0, 1.0]),
    (-1.0, 1.0, -1.0): ([2, 3, 0, 1], [-1.0, 1.0, 1.0, -1.0]),
    (-1.0, -1.0, 1.0): ([3, 2, 1, 0], [-1.0, -1.0, 1.0, 1.0]),
}
"""Order and signs of the components of a quaternion wxyz after half a turn about x, y or z."""


def convert_axes(scene: Gaussians, start: Axes, end: Axes) -> Gaussians:
    """Convert a scene from one axis system to another. Converting back gives the same bits.

    Args:
        scene: N Gaussians in the axes `start`
        start, end: the current and the requested axes
    """
    if start == end:
        return scene
    x, y, z = (a * b for a, b in zip(_SIGNS[start], _SIGNS[end], strict=True))
    order, signs = _HALF_TURNS[x, y, z]
    backwards = -1.0 if AXES.index(end) < AXES.index(start) else 1.0
    origin_x, origin_y, origin_z = scene.origin
    return replace(
        scene,
        means=scene.means * torch.tensor([x, y, z], dtype=scene.means.dtype),
        origin=(0.0 + x * origin_x, 0.0 + y * origin_y, 0.0 + z * origin_z),
        quats=backwards * scene.quats[:, order] * torch.tensor(signs, dtype=scene.quats.dtype),
        shN=sh.half_turn(scene.shN, (x, y, z)),
    )
