"""The bear's anatomy: where each ellipsoid sits. The bear is two units high, y is up, it looks along +z."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from .surface import Part, ball, dome, ring

LABELS = ("body", "head", "ears", "arms", "legs", "scarf", "plinth", "grass")

Triple = tuple[float, float, float]


def rotation_matrix(degrees: Triple) -> Tensor:
    """Rotation about x, then y, then z, in degrees. [3,3]"""
    matrix = torch.eye(3)
    for axis, angle in enumerate(degrees):
        c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))
        one = torch.eye(3)
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        one[i, i], one[j, j], one[i, j], one[j, i] = c, c, -s, s
        matrix = one @ matrix
    return matrix


def ellipsoid(
    name: str,
    label: str,
    center: Triple,
    radii: Triple,
    turn: Triple = (0.0, 0.0, 0.0),
    weight: float = 1.0,
    exponent: float = 2.0,
    casts_shadow: bool = True,
    clears: float = 0.0,
) -> Part:
    """An ellipsoid of these radii, turned by degrees about x, then y, then z; see `Part` for the rest."""
    matrix = rotation_matrix(turn) @ torch.diag(torch.tensor(radii))
    return Part(name, label, ball(exponent), torch.tensor(center), matrix, weight, None, casts_shadow, clears)


def _detail(
    name: str,
    label: str,
    center: Triple,
    radii: Triple,
    turn: Triple = (0.0, 0.0, 0.0),
    weight: float = 7.0,
    clears: float = 0.16,
) -> Part:
    """A small part drawn finely, with no fur over it and no shadow of its own."""
    return ellipsoid(name, label, center, radii, turn, weight, casts_shadow=False, clears=clears)


def _eye(x: float) -> list[Part]:
    """An eye and the window it mirrors, up on the side that the lamp is on."""
    return [
        _detail("eye", "head", (x, 1.545, 0.432), (0.052, 0.060, 0.042)),
        _detail("glint", "head", (x - 0.017, 1.567, 0.468), (0.015, 0.016, 0.006), weight=30.0, clears=0.3),
    ]


def _pads(foot: Part) -> list[Part]:
    """The sole's big pad and four toes, set into the side of the foot that faces the viewer."""
    sizes = foot.matrix.norm(dim=0)
    turn = foot.matrix / sizes
    places = [((0.0, -0.055), (0.095, 0.085))]
    places += [
        ((0.132 * math.cos(angle), 0.012 + 0.135 * math.sin(angle)), (0.036, 0.036))
        for angle in (math.radians(28 + 124 / 3 * i) for i in range(4))
    ]
    pads = []
    for (x, y), (wide, tall) in places:
        z = float(sizes[2]) * math.sqrt(1 - (x / float(sizes[0])) ** 2 - (y / float(sizes[1])) ** 2)
        outward = torch.tensor([x, y, z]) / sizes**2
        outward = outward / outward.norm()
        side = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), outward)
        side = side / side.norm()
        frame = turn @ torch.stack([side, torch.linalg.cross(outward, side), outward], dim=1)
        matrix = frame @ torch.diag(torch.tensor([wide, tall, 0.022]))
        center = foot.center + turn @ torch.tensor([x, y, z])
        pads.append(Part("pad", foot.label, ball(), center, matrix, 3.0, None, False, 0.08))
    return pads


def _pair(
    name: str, label: str, center: Triple, radii: Triple, turn: Triple = (0, 0, 0), weight: float = 1.0
) -> list[Part]:
    """The part on the +x side and its mirror image; `turn` is that of the +x side."""
    x, y, z = center
    mirrored = (turn[0], -turn[1], -turn[2])
    return [
        ellipsoid(name, label, (x, y, z), radii, turn, weight),
        ellipsoid(name, label, (-x, y, z), radii, mirrored, weight),
    ]


def bear_parts() -> list[Part]:
    """Every part of the scene, the bear first, the lawn last."""
    feet = _pair("foot", "legs", (0.355, 0.235, 0.80), (0.195, 0.235, 0.115), (-12, 16, 0), weight=1.3)
    return [
        ellipsoid("body", "body", (0.0, 0.57, 0.0), (0.50, 0.60, 0.45)),
        ellipsoid("tail", "body", (0.0, 0.17, -0.44), (0.13, 0.13, 0.13)),
        ellipsoid("head", "head", (0.0, 1.47, 0.05), (0.47, 0.415, 0.42), weight=1.5),
        ellipsoid("muzzle", "head", (0.0, 1.365, 0.40), (0.215, 0.165, 0.19), weight=2.2),
        _detail("nose", "head", (0.0, 1.44, 0.575), (0.085, 0.060, 0.055)),
        _detail("mouth", "head", (0.0, 1.345, 0.588), (0.011, 0.052, 0.018)),
        _detail("mouth", "head", (0.05, 1.292, 0.568), (0.056, 0.011, 0.020), (0, 20, 26)),
        _detail("mouth", "head", (-0.05, 1.292, 0.568), (0.056, 0.011, 0.020), (0, -20, -26)),
        *_eye(0.17),
        *_eye(-0.17),
        *_pair("ear", "ears", (0.335, 1.815, 0.02), (0.175, 0.175, 0.085), (0, 18, -24), weight=1.5),
        *_pair("arm", "arms", (0.505, 0.72, 0.14), (0.155, 0.395, 0.17), (-24, 0, 16)),
        *_pair("leg", "legs", (0.285, 0.185, 0.44), (0.195, 0.40, 0.195), (84, 16, 0)),
        *feet,
        *[pad for foot in feet for pad in _pads(foot)],
        Part(
            "scarf",
            "scarf",
            ring(0.27),
            torch.tensor([0.0, 1.10, 0.03]),
            rotation_matrix((6.0, 0.0, 0.0)) @ torch.diag(torch.tensor([0.350, 0.42, 0.330])),
            weight=3.5,
            casts_shadow=False,
        ),
        ellipsoid("knot", "scarf", (0.13, 1.035, 0.405), (0.085, 0.075, 0.06), (0, 0, -15), 3.5, 2.6, False),
        ellipsoid("end", "scarf", (0.205, 0.825, 0.437), (0.088, 0.235, 0.027), (10, 8, 14), 3.5, 5.0, False),
        ellipsoid("end", "scarf", (0.075, 0.845, 0.462), (0.088, 0.200, 0.027), (10, 2, -8), 3.5, 5.0, False),
        ellipsoid("plinth", "plinth", (0.0, -0.15, 0.20), (1.20, 0.16, 1.20), exponent=7.0, weight=0.55),
        Part(
            "grass",
            "grass",
            dome(0.27),
            torch.tensor([0.0, -0.24, 0.20]),
            torch.diag(torch.tensor([3.6, 3.6, 3.6])),
            weight=0.35,
            density=lambda radius: 1 / (0.08 + radius) ** 1.1,
            casts_shadow=False,
        ),
    ]
