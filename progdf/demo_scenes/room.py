"""Demo scene of a small furnished room, to test near planes, depth order and cameras inside a scene."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.color.oklab import smoothstep
from progdf.errors import ProgdfError

from .assemble import DemoScene, GaussianLayout, SurfacePaint, assemble, bumps, flat, mix, mix_colors, noise
from .bear import Triple, ellipsoid
from .light import KEY, Daylight
from .surface import Part, Samples, lathe, panel

_SHAG = GaussianLayout(standing=0.3, flat=(0.72, 0.66, 0.14), hair=(0.55, 0.26, 0.18), length=0.006, rise=1.2)
_BOARD = GaussianLayout(flat=(0.80, 0.70, 0.10), unruly=0.0)
_PETALS = ("#e8537a", "#f2b632", "#f4f0e6", "#c04a8c", "#f07f4f")


def paint(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    """Return the paint of a part at its samples; `table` is the noise table."""
    coat = _PAINTERS[part.name](part, at, table)
    if part.shape.profile is None:  # along the edges, for straight edges
        return replace(coat, flow=part.matrix[:, 0].expand_as(at.points), pelt=_BOARD)
    return coat


def _planks(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    plank = (p[:, 0] / 0.22).floor()
    along = p[:, 2] / 1.3 + 0.37 * plank
    board = torch.stack([7.3 * plank, 5.1 * along.floor(), 0 * plank], dim=1)
    tone = noise(board + 0.5, table, 1.7)
    grain = noise(p * torch.tensor([1.0, 1.0, 0.07]) + 0.3 * board, table, 26.0, 2)
    color = mix_colors("#7c4e2a", "#cf9a5f", 0.5 + 0.35 * tone + 0.35 * grain)
    side = _edge(p[:, 0] / 0.22) * 0.22
    end = _edge(along) * 1.3
    gap = 1 - smoothstep(side, 0.002, 0.008) * smoothstep(end, 0.002, 0.008)
    return SurfacePaint(mix(color, flat("#3a2314", p), 0.8 * gap), bumps(p, table, 6.0, 0.05), gloss=0.06)


def _wall(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    color = mix_colors("#9fc0b4", "#c3dccd", 0.5 + 0.5 * noise(p, table, 3.0, 3))
    across = p[:, 2] if float(part.matrix[0, 1].abs()) > 0.5 else p[:, 0]
    stripe = smoothstep(_edge(across / 0.25 + 0.5), 0.18, 0.22)
    color = mix(color, mix_colors("#e4e6d2", "#f8f6e4", 0.5 + 0.5 * noise(p, table, 3.0, 3)), stripe)
    board = smoothstep(0.14 - p[:, 1], -0.004, 0.004)
    return SurfacePaint(mix(color, flat("#f1ece0", p), board), bumps(p, table, 9.0, 0.06))


def _ceiling(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    return SurfacePaint(
        mix_colors("#ddd8cc", "#f2eee4", 0.5 + 0.5 * noise(at.points, table, 2.0, 2)), 0 * at.points
    )


def _window(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    up = at.local[:, 0]
    across = at.local[:, 2]
    clouds = smoothstep(noise(at.points, table, 3.5, 3), -0.05, 0.45)
    sky = mix(mix_colors("#cfe4f7", "#6da7e0", 0.5 + 0.5 * up), flat("#ffffff", at.points), clouds)
    hills = smoothstep(-0.45 + 0.22 * noise(at.points, table, 2.2, 2) - up, -0.03, 0.03)
    color = mix(sky, mix_colors("#4f7f3a", "#93b85a", 0.5 + noise(at.points, table, 9.0)), hills)
    frame = torch.maximum(up.abs(), across.abs()) > 0.93
    bars = torch.minimum(up.abs(), across.abs()) < 0.035
    return SurfacePaint(
        mix(color, flat("#fbf8f0", at.points), (frame | bars).float()), 0 * at.points, glows=True
    )


def _picture(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    x = at.local[:, 0]
    y = -at.local[:, 2]
    sky = mix_colors("#f6a54a", "#4a5fae", 0.5 + 0.75 * y)
    sun = smoothstep(0.22 - torch.hypot((x - 0.3) * 1.38, y - 0.12), -0.02, 0.02)
    color = mix(sky, flat("#fff0b8", p), sun)
    for i, tone in enumerate(("#8b5a8c", "#5a4478", "#33294f")):
        ridge = (
            -0.05
            - 0.26 * i
            + 0.22 * noise(torch.stack([p[:, 0] + 3.7 * i, 0 * x, 0 * x], 1), table, 2.5 + i, 2)
        )
        color = mix(color, flat(tone, p), smoothstep(ridge - y, -0.02, 0.02))
    mount = (torch.maximum((x.abs() - 0.80) * 1.38, y.abs() - 0.74) > 0).float()
    color = mix(color, flat("#f5f1e6", p), mount)
    frame = (torch.maximum((x.abs() - 0.93) * 1.38, y.abs() - 0.905) > 0).float()
    return SurfacePaint(mix(color, flat("#5b3a20", p), frame), 0 * p, gloss=0.03)


def _wood(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    rings = noise(p * torch.tensor([0.35, 0.35, 2.2]), table, 11.0, 3)
    return SurfacePaint(
        mix_colors("#5d351a", "#a86a37", 0.5 + 0.65 * rings), bumps(p, table, 9.0, 0.06), gloss=0.10
    )


def _rug(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    radius = torch.hypot(at.local[:, 0], at.local[:, 2])
    angle = torch.atan2(at.local[:, 2], at.local[:, 0])
    color = mix_colors("#8c2a31", "#b8454a", 0.5 + 0.5 * noise(p, table, 20.0))
    cream = mix_colors("#e2d3b0", "#f3e8cc", 0.5 + 0.5 * noise(p, table, 20.0))
    star = smoothstep(0.42 + 0.16 * (10 * angle).cos() - radius, -0.02, 0.02) * smoothstep(radius, 0.18, 0.22)
    bands = smoothstep(0.03 - (radius - 0.88).abs(), -0.008, 0.008) + smoothstep(
        0.015 - (radius - 0.78).abs(), -0.006, 0.006
    )
    color = mix(color, cream, torch.maximum(star, bands))
    blue = smoothstep(0.05 - (radius - 0.68).abs(), -0.008, 0.008)
    color = mix(color, mix_colors("#27496d", "#3b6a96", 0.5 + 0.5 * noise(p, table, 20.0)), blue)
    return SurfacePaint(color, bumps(p, table, 30.0, 0.25), velvet=0.05, pelt=_SHAG)


def _vase(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    y = at.local[:, 1]
    color = mix_colors("#e9eef2", "#ffffff", 0.5 + 0.5 * noise(at.points, table, 6.0))
    angle = torch.atan2(at.local[:, 2], at.local[:, 0])
    wave = smoothstep(0.035 - (y - 0.17 - 0.025 * (6 * angle).sin()).abs(), -0.005, 0.005)
    upper = 0.008 - (y - 0.25).abs()
    lower = 0.012 - (y - 0.05).abs()
    bands = smoothstep(upper, -0.003, 0.003) + smoothstep(lower, -0.003, 0.003)
    return SurfacePaint(
        mix(color, flat("#1d4e9e", at.points), torch.maximum(wave, bands)), 0 * at.points, gloss=0.14
    )


def _flower(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    kind = int(float(part.center.sum()) * 1000) % len(_PETALS)
    color = mix_colors(_PETALS[kind], "#ffffff", 0.15 + 0.25 * noise(at.points, table, 30.0))
    heart = smoothstep(at.local[:, 1], 0.80, 0.92)
    return SurfacePaint(
        mix(color, flat("#6b4a12", at.points), heart), bumps(at.points, table, 35.0, 0.45), velvet=0.08
    )


def _stem(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    return SurfacePaint(flat("#4f8a3a", at.points), 0 * at.points)


def _metal(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    return SurfacePaint(flat("#8a7448", at.points), 0 * at.points, gloss=0.22)


def _shade(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    bright = 1 - (at.local[:, 1] - 0.14).abs() / 0.3
    weave = 0.06 * noise(at.points * torch.tensor([1.0, 0.1, 1.0]), table, 60.0)
    return SurfacePaint(
        mix_colors("#d99a4e", "#fff3cf", 0.15 + 0.8 * bright + weave), 0 * at.points, glows=True
    )


def _cushion(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    p = at.points
    angle = torch.atan2(at.local[:, 2], at.local[:, 0])
    seams = 1 - smoothstep(_edge(angle / (math.pi / 4)), 0.03, 0.08)
    color = mix_colors("#1f6f78", "#3aa3a8", 0.5 + 0.5 * noise(p, table, 30.0, 2))
    return SurfacePaint(mix(color, flat("#124a52", p), 0.7 * seams), bumps(p, table, 30.0, 0.2), velvet=0.10)


def _ball(part: Part, at: Samples, table: Tensor) -> SurfacePaint:
    slice_ = torch.remainder((torch.atan2(at.local[:, 2], at.local[:, 0]) / (math.pi / 3)).floor(), 3).long()
    colors = torch.cat([flat(c, at.points[:1]) for c in ("#e23b34", "#f7f4ea", "#2c6fd1")])
    cap = smoothstep(at.local[:, 1].abs(), 0.93, 0.95)
    return SurfacePaint(mix(colors[slice_], flat("#f7c531", at.points), cap), 0 * at.points, gloss=0.12)


def _edge(turns: Tensor) -> Tensor:
    """Return the distance to the nearest whole number, 0 to 0.5. [N] -> [N]"""
    return (turns - turns.round()).abs()


_PAINTERS = {
    "floor": _planks,
    "ceiling": _ceiling,
    "wall": _wall,
    "window": _window,
    "picture": _picture,
    "rug": _rug,
    "wood": _wood,
    "vase": _vase,
    "stem": _stem,
    "flower": _flower,
    "metal": _metal,
    "shade": _shade,
    "cushion": _cushion,
    "ball": _ball,
}


LABELS = ("floor", "walls", "ceiling", "rug", "table", "vase", "lamp", "stool", "picture", "ball")
MIN_ROOM_GAUSSIANS = 1000
"""Smallest number of Gaussians for the room."""

_HALF_SIDE = 2.0  # half width and half length, world units
_HEIGHT = 2.5  # world units
_WINDOW = ((1.45, 0.72), (0.75, 0.62))  # middle (y, z) and half size (y, z), in the wall at −x


def room(size: int = 40_000, seed: int = 0) -> DemoScene:
    """Return a room of exactly `size` Gaussians with cameras inside.

    The same seed gives the same bits on the same kind of processor.

    Raises:
        ProgdfError: fewer than `MIN_ROOM_GAUSSIANS` Gaussians.
    """
    if size < MIN_ROOM_GAUSSIANS:
        raise ProgdfError(f"{size} Gaussians are too few for a room; use at least {MIN_ROOM_GAUSSIANS}")
    gaussians, labels = assemble(room_parts(), LABELS, paint, size, seed, Daylight(_sun, fill=1.9))
    return DemoScene(gaussians, labels, LABELS, _rig(), torch.tensor([0.0, 1.0, 0.0]), (0.05, 0.05, 0.06))


def room_parts() -> list[Part]:
    """Return all parts of the room; y is up, with the floor at 0."""
    toy = ellipsoid("ball", "ball", (-1.05, 0.195, -0.75), (0.18, 0.18, 0.18), (30, 0, 25), 2.5)
    return [
        *_shell(),
        *_table_with_flowers((0.55, -0.35)),
        *_lamp((1.62, -1.62)),
        *_stool((-0.45, 0.35)),
        toy,
    ]


def _shell() -> list[Part]:
    """Return the floor, ceiling and walls, with the window, the picture and the rug."""
    (window_y, window_z), (tall, wide) = _WINDOW
    x = (_HALF_SIDE, 0.0, 0.0)
    y = (0.0, _HEIGHT / 2, 0.0)
    z = (0.0, 0.0, _HALF_SIDE)
    pane = (-_HALF_SIDE + 0.015, window_y, window_z)
    return [
        _flat("floor", "floor", (0, 0, 0), x, z, (0, 1, 0), 0.8),
        _flat("ceiling", "ceiling", (0, _HEIGHT, 0), x, z, (0, -1, 0), 0.3),
        _flat("wall", "walls", (-_HALF_SIDE, _HEIGHT / 2, 0), z, y, (1, 0, 0), 0.5),
        _flat("wall", "walls", (_HALF_SIDE, _HEIGHT / 2, 0), z, y, (-1, 0, 0), 0.5),
        _flat("wall", "walls", (0, _HEIGHT / 2, -_HALF_SIDE), x, y, (0, 0, 1), 0.5),
        _flat("wall", "walls", (0, _HEIGHT / 2, _HALF_SIDE), x, y, (0, 0, -1), 0.5),
        _flat("window", "walls", pane, (0, tall, 0), (0, 0, wide), (1, 0, 0), 1.5),
        _flat(
            "picture",
            "picture",
            (-0.35, 1.5, -_HALF_SIDE + 0.015),
            (0.62, 0, 0),
            (0, 0.45, 0),
            (0, 0, 1),
            4.0,
        ),
        ellipsoid(
            "rug", "rug", (-0.15, 0.012, 0.1), (1.15, 0.014, 1.15), (0, 0, 0), 1.5, 10, casts_shadow=False
        ),
    ]


def _table_with_flowers(at: tuple[float, float]) -> list[Part]:
    """Return a round table at (x, z) with a vase of five flowers."""
    x, z = at
    flowers = (
        (0.0, 0.0, 0.0),
        (0.13, -0.03, 0.05),
        (-0.12, -0.02, 0.06),
        (0.05, 0.05, -0.12),
        (-0.05, 0.07, 0.1),
    )
    bowed = (0.055, 0.045, 0.09, 0.125, 0.11, 0.07), (0.40, 0.33, 0.25, 0.16, 0.07, 0.0)
    return [
        ellipsoid("wood", "table", (x, 0.74, z), (0.62, 0.028, 0.62), weight=1.8, exponent=8),
        ellipsoid("wood", "table", (x, 0.37, z), (0.055, 0.36, 0.055), weight=1.5, exponent=6),
        ellipsoid("wood", "table", (x, 0.03, z), (0.30, 0.03, 0.30), weight=1.5, exponent=4),
        _lathe_body("vase", "vase", (x, 0.765, z), *bowed),
        *[
            ellipsoid(
                "stem",
                "vase",
                (x + 0.5 * a, 1.24 + 0.5 * b, z + 0.5 * c),
                (0.008, 0.15, 0.008),
                (130 * c, 0, -130 * a),
                4.0,
            )
            for a, b, c in flowers
        ],
        *[
            ellipsoid("flower", "vase", (x + a, 1.40 + b, z + c), (0.072, 0.055, 0.072), weight=4.0)
            for a, b, c in flowers
        ],
    ]


def _lamp(at: tuple[float, float]) -> list[Part]:
    x, z = at
    return [
        ellipsoid("metal", "lamp", (x, 0.02, z), (0.17, 0.02, 0.17), weight=2.0, exponent=4),
        ellipsoid("metal", "lamp", (x, 0.75, z), (0.016, 0.74, 0.016), weight=2.0, exponent=8),
        _lathe_body("shade", "lamp", (x, 1.42, z), (0.14, 0.26), (0.36, 0.0)),
    ]


def _stool(at: tuple[float, float]) -> list[Part]:
    x, z = at
    legs = [(math.cos(angle), math.sin(angle)) for angle in (0.5, 2.6, 4.7)]
    return [
        ellipsoid("cushion", "stool", (x, 0.44, z), (0.24, 0.055, 0.24), weight=2.0, exponent=2.8),
        *[
            ellipsoid(
                "wood",
                "stool",
                (x + 0.15 * c, 0.2, z + 0.15 * s),
                (0.022, 0.22, 0.022),
                (12 * s, 0, -12 * c),
                2.0,
                5.0,
            )
            for c, s in legs
        ],
    ]


def _flat(
    name: str, label: str, center: Triple, across: Triple, up: Triple, facing: Triple, weight: float
) -> Part:
    """Return a rectangle of half sides `across` and `up`, visible from the side `facing`."""
    x, y, z = (torch.tensor(axis, dtype=torch.float32) for axis in (across, facing, up))
    z = z if float(torch.linalg.cross(z, x) @ y) > 0 else -z
    matrix = torch.stack([x, y, z], dim=1)
    return Part(name, label, panel(), torch.tensor(center, dtype=torch.float32), matrix, weight, None, False)


def _lathe_body(
    name: str, label: str, foot: Triple, radii: tuple[float, ...], heights: tuple[float, ...]
) -> Part:
    return Part(name, label, lathe(radii, heights), torch.tensor(foot), torch.eye(3), 3.0, None, False)


def _sun(points: Tensor) -> Tensor:
    """Return the share of the key light through the window in the wall at −x, 0 to 1. [N]"""
    ray = KEY.direction
    distance = (points[:, 0] + _HALF_SIDE).clamp_min(0) / -ray[0]
    inside = torch.ones(len(points))
    for axis, middle, half in zip((1, 2), *_WINDOW, strict=True):
        offset = (points[:, axis] + distance * ray[axis] - middle).abs()
        pane = ((offset - 0.03) / 0.03).clamp(0, 1)  # bars of the window
        inside = inside * ((half - offset) / (0.02 + 0.03 * distance) + 0.5).clamp(0, 1) * pane
    return inside


def _rig(count: int = 32, width: int = 512, height: int = 384) -> tuple[Camera, ...]:
    """Return cameras along the walls at eye height that look across the room."""
    K = intrinsics(math.radians(62), width, height)
    up = torch.tensor([0.0, 1.0, 0.0])
    cameras = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        distance = 1.6 / max(abs(math.sin(angle)), abs(math.cos(angle))) ** 0.3
        eye = torch.tensor(
            [distance * math.sin(angle), 1.1 + 0.5 * ((0.3 + 0.618034 * i) % 1.0), distance * math.cos(angle)]
        )
        sideways = 0.3 * math.sin(3 * angle)
        target = torch.tensor([sideways * math.cos(angle), 0.75, -sideways * math.sin(angle)])
        cameras.append(Camera(look_at(eye, target, up), K, width, height, name=f"room_{i:03d}"))
    return tuple(cameras)
