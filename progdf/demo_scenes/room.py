"""A small room to stand inside: walls, table, vase, lamp; for near planes, depth order and cameras within."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError

from .assemble import DemoScene, assemble
from .bear_parts import Triple, ellipsoid
from .light import KEY, Daylight
from .room_paint import paint
from .surface import Part, lathe, panel

LABELS = ("floor", "walls", "ceiling", "rug", "table", "vase", "lamp", "stool", "picture", "ball")
SMALLEST_ROOM = 1000
"""Fewer Gaussians than this are no room."""

_HALF, _HEIGHT = 2.0, 2.5
_WINDOW = ((1.45, 0.72), (0.75, 0.62))  # middle and half size along y and along z, in the wall at −x


def room(size: int = 40_000, seed: int = 0) -> DemoScene:
    """A room of exactly `size` Gaussians with cameras inside; the same seed gives the same room, bit for bit
    on the same kind of processor.

    Raises:
        ProgdfError: fewer than `SMALLEST_ROOM` Gaussians.
    """
    if size < SMALLEST_ROOM:
        raise ProgdfError(f"{size} Gaussians are too few for a room; use at least {SMALLEST_ROOM}")
    gaussians, labels = assemble(room_parts(), LABELS, paint, size, seed, Daylight(_sun, fill=1.9))
    return DemoScene(gaussians, labels, LABELS, _rig(), torch.tensor([0.0, 1.0, 0.0]), (0.05, 0.05, 0.06))


def room_parts() -> list[Part]:
    """Every part of the room; y is up, the floor at 0."""
    (window_y, window_z), (tall, wide) = _WINDOW
    table, vase, lamp, stool = (0.55, -0.35), (0.55, -0.35), (1.62, -1.62), (-0.45, 0.35)
    flowers = [
        (0.0, 0.0, 0.0),
        (0.13, -0.03, 0.05),
        (-0.12, -0.02, 0.06),
        (0.05, 0.05, -0.12),
        (-0.05, 0.07, 0.1),
    ]
    x, y, z = (_HALF, 0.0, 0.0), (0.0, _HEIGHT / 2, 0.0), (0.0, 0.0, _HALF)
    return [
        _flat("floor", "floor", (0, 0, 0), x, z, (0, 1, 0), 0.8),
        _flat("ceiling", "ceiling", (0, _HEIGHT, 0), x, z, (0, -1, 0), 0.3),
        _flat("wall", "walls", (-_HALF, _HEIGHT / 2, 0), z, y, (1, 0, 0), 0.5),
        _flat("wall", "walls", (_HALF, _HEIGHT / 2, 0), z, y, (-1, 0, 0), 0.5),
        _flat("wall", "walls", (0, _HEIGHT / 2, -_HALF), x, y, (0, 0, 1), 0.5),
        _flat("wall", "walls", (0, _HEIGHT / 2, _HALF), x, y, (0, 0, -1), 0.5),
        _flat(
            "window",
            "walls",
            (-_HALF + 0.015, window_y, window_z),
            (0, tall, 0),
            (0, 0, wide),
            (1, 0, 0),
            1.5,
        ),
        _flat("picture", "picture", (-0.35, 1.5, -_HALF + 0.015), (0.62, 0, 0), (0, 0.45, 0), (0, 0, 1), 4.0),
        ellipsoid(
            "rug",
            "rug",
            (-0.15, 0.012, 0.1),
            (1.15, 0.014, 1.15),
            weight=1.5,
            exponent=10,
            casts_shadow=False,
        ),
        ellipsoid("wood", "table", (table[0], 0.74, table[1]), (0.62, 0.028, 0.62), weight=1.8, exponent=8),
        ellipsoid("wood", "table", (table[0], 0.37, table[1]), (0.055, 0.36, 0.055), weight=1.5, exponent=6),
        ellipsoid("wood", "table", (table[0], 0.03, table[1]), (0.30, 0.03, 0.30), weight=1.5, exponent=4),
        _lathe_body(
            "vase",
            "vase",
            (vase[0], 0.765, vase[1]),
            (0.055, 0.045, 0.09, 0.125, 0.11, 0.07),
            (0.40, 0.33, 0.25, 0.16, 0.07, 0.0),
        ),
        *[
            ellipsoid(
                "stem",
                "vase",
                (vase[0] + 0.5 * x, 1.24 + 0.5 * y, vase[1] + 0.5 * z),
                (0.008, 0.15, 0.008),
                (130 * z, 0, -130 * x),
                4.0,
            )
            for x, y, z in flowers
        ],
        *[
            ellipsoid(
                "flower", "vase", (vase[0] + x, 1.40 + y, vase[1] + z), (0.072, 0.055, 0.072), weight=4.0
            )
            for x, y, z in flowers
        ],
        ellipsoid("metal", "lamp", (lamp[0], 0.02, lamp[1]), (0.17, 0.02, 0.17), weight=2.0, exponent=4),
        ellipsoid("metal", "lamp", (lamp[0], 0.75, lamp[1]), (0.016, 0.74, 0.016), weight=2.0, exponent=8),
        _lathe_body("shade", "lamp", (lamp[0], 1.42, lamp[1]), (0.14, 0.26), (0.36, 0.0)),
        ellipsoid(
            "cushion", "stool", (stool[0], 0.44, stool[1]), (0.24, 0.055, 0.24), weight=2.0, exponent=2.8
        ),
        *[
            ellipsoid(
                "wood",
                "stool",
                (stool[0] + 0.15 * c, 0.2, stool[1] + 0.15 * s),
                (0.022, 0.22, 0.022),
                (12 * s, 0, -12 * c),
                2.0,
                5.0,
            )
            for c, s in ((math.cos(a), math.sin(a)) for a in (0.5, 2.6, 4.7))
        ],
        ellipsoid("ball", "ball", (-1.05, 0.195, -0.75), (0.18, 0.18, 0.18), (30, 0, 25), 2.5),
    ]


def _flat(
    name: str, label: str, center: Triple, across: Triple, up: Triple, facing: Triple, weight: float
) -> Part:
    """A rectangle of half sides `across` and `up`, seen from the side that `facing` points to."""
    x, y, z = (torch.tensor(axis, dtype=torch.float32) for axis in (across, facing, up))
    z = z if float(torch.linalg.cross(z, x) @ y) > 0 else -z
    matrix = torch.stack([x, y, z], dim=1)
    return Part(name, label, panel(), torch.tensor(center, dtype=torch.float32), matrix, weight, None, False)


def _lathe_body(
    name: str, label: str, foot: Triple, radii: tuple[float, ...], heights: tuple[float, ...]
) -> Part:
    return Part(name, label, lathe(radii, heights), torch.tensor(foot), torch.eye(3), 3.0, None, False)


def _sun(points: Tensor) -> Tensor:
    """The share of the key light that the window lets in: where its ray came through the wall at −x. [N]"""
    ray = KEY.direction
    way = (points[:, 0] + _HALF).clamp_min(0) / -ray[0]
    inside = torch.ones(len(points))
    for axis, middle, half in zip((1, 2), *_WINDOW, strict=True):
        off = (points[:, axis] + way * ray[axis] - middle).abs()
        pane = ((off - 0.03) / 0.03).clamp(0, 1)  # the bars of the cross
        inside = inside * ((half - off) / (0.02 + 0.03 * way) + 0.5).clamp(0, 1) * pane
    return inside


def _rig(count: int = 32, width: int = 512, height: int = 384) -> tuple[Camera, ...]:
    """Cameras along the walls at eye height, each looking across the room."""
    K = intrinsics(math.radians(62), width, height)
    up = torch.tensor([0.0, 1.0, 0.0])
    cameras = []
    for i in range(count):
        turn = 2 * math.pi * i / count
        stand = 1.6 / max(abs(math.sin(turn)), abs(math.cos(turn))) ** 0.3
        eye = torch.tensor(
            [stand * math.sin(turn), 1.1 + 0.5 * ((0.3 + 0.618034 * i) % 1.0), stand * math.cos(turn)]
        )
        aside = 0.3 * math.sin(3 * turn)
        target = torch.tensor([aside * math.cos(turn), 0.75, -aside * math.sin(turn)])
        cameras.append(Camera(look_at(eye, target, up), K, width, height, name=f"room_{i:03d}"))
    return tuple(cameras)
