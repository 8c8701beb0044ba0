"""Surfaces of revolution, stretched and turned, with points spread over them evenly by area."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_GOLDEN = (math.sqrt(5) - 1) / 2
_STEPS = 513
_TURNS = 64


@dataclass(frozen=True)
class Shape:
    """A surface of revolution about the local y axis."""

    # radius and height along the curve that turns, the outside on the left hand; None is the flat square x, z
    # in −1..1 that faces up. [P,2]
    profile: Tensor | None
    # [N,3] local points -> [N]: below 1 inside, 1 on the surface, above 1 outside
    level: Callable[[Tensor], Tensor]
    nearest: Callable[[Tensor], Tensor]  # [N,3] local points -> [N,3] a point of the surface close to each
    girth: float = 1.0  # how thick the body is, as a share of its radius


def ball(exponent: float = 2.0) -> Shape:
    """The unit sphere; a higher exponent makes it a rounded tin (the curve is a superellipse)."""
    angle = torch.linspace(0, math.pi, _STEPS)
    curve = torch.stack([angle.sin(), angle.cos()], dim=1)
    curve = curve / (curve.abs() ** exponent).sum(1, keepdim=True) ** (1 / exponent)

    def level(local: Tensor) -> Tensor:
        if exponent == 2:
            return torch.hypot(torch.hypot(local[:, 0], local[:, 1]), local[:, 2])
        radius = torch.hypot(local[:, 0], local[:, 2])
        return (radius**exponent + local[:, 1].abs() ** exponent) ** (1 / exponent)

    def nearest(local: Tensor) -> Tensor:
        return local / level(local).clamp_min(1e-6)[:, None]

    return Shape(curve, level, nearest)


def ring(tube: float) -> Shape:
    """A torus: the circle of radius 1 about y, with a tube of radius `tube`."""
    angle = torch.linspace(0, 2 * math.pi, _STEPS)
    curve = torch.stack([1 + tube * angle.cos(), -tube * angle.sin()], dim=1)

    def level(local: Tensor) -> Tensor:
        share: Tensor = torch.hypot(torch.hypot(local[:, 0], local[:, 2]) - 1, local[:, 1]) / tube
        return share

    def nearest(local: Tensor) -> Tensor:
        flat = local * torch.tensor([1.0, 0.0, 1.0])
        core: Tensor = flat / flat.norm(dim=1, keepdim=True).clamp_min(1e-6)
        return core + (local - core) / level(local).clamp_min(1e-6)[:, None]

    return Shape(curve, level, nearest, girth=tube)


def dome(drop: float) -> Shape:
    """A round lawn of radius 1 that falls by `drop` towards its edge; everything below it is inside."""
    radius = torch.linspace(0, 1, _STEPS)
    curve = torch.stack([radius, -drop * radius**2], dim=1)

    def level(local: Tensor) -> Tensor:
        return 1 + local[:, 1] + drop * (local[:, 0] ** 2 + local[:, 2] ** 2)

    def nearest(local: Tensor) -> Tensor:
        height = -drop * (local[:, 0] ** 2 + local[:, 2] ** 2)
        return torch.stack([local[:, 0], height, local[:, 2]], dim=1)

    return Shape(curve, level, nearest)


def lathe(radii: Sequence[float], heights: Sequence[float]) -> Shape:
    """A turned body: radii at descending heights, straight between them, closed at both ends."""
    outline = torch.tensor([[0.0, heights[0]], *zip(radii, heights, strict=True), [0.0, heights[-1]]])
    lengths = (outline[1:] - outline[:-1]).norm(dim=1)
    at = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    places = torch.linspace(0, float(at[-1]), _STEPS)
    index = (torch.searchsorted(at, places) - 1).clamp(0, len(lengths) - 1)
    curve = torch.lerp(outline[index], outline[index + 1], ((places - at[index]) / lengths[index])[:, None])
    rising, radius = torch.tensor(heights).flip(0), torch.tensor(radii).flip(0)

    middle = (heights[0] + heights[-1]) / 2
    half = (heights[0] - heights[-1]) / 2

    def width(local: Tensor) -> Tensor:
        above = torch.searchsorted(rising, local[:, 1].contiguous()).clamp(1, len(rising) - 1)
        share = ((local[:, 1] - rising[above - 1]) / (rising[above] - rising[above - 1])).clamp(0, 1)
        return torch.lerp(radius[above - 1], radius[above], share)

    def level(local: Tensor) -> Tensor:
        across = torch.hypot(local[:, 0], local[:, 2]) / width(local)
        return torch.maximum(across, (local[:, 1] - middle).abs() / half)

    def nearest(local: Tensor) -> Tensor:
        out = width(local) / torch.hypot(local[:, 0], local[:, 2]).clamp_min(1e-6)
        return torch.stack(
            [local[:, 0] * out, local[:, 1].clamp(heights[-1], heights[0]), local[:, 2] * out], 1
        )

    return Shape(curve, level, nearest)


def panel() -> Shape:
    """A flat square, x and z in −1..1, that faces up; what lies behind it is inside."""

    def level(local: Tensor) -> Tensor:
        beside = (local[:, 0].abs() >= 1) | (local[:, 2].abs() >= 1)
        return torch.where(beside & (local[:, 1] < 0), 2.0, 1 + local[:, 1])

    def nearest(local: Tensor) -> Tensor:
        return torch.stack([local[:, 0].clamp(-1, 1), torch.zeros(len(local)), local[:, 2].clamp(-1, 1)], 1)

    return Shape(None, level, nearest)


@dataclass(frozen=True)
class Part:
    """A shape placed in the world."""

    name: str  # which part it is; paint goes by it
    label: str  # name of the label its Gaussians carry
    shape: Shape  # the surface
    center: Tensor  # where the shape's origin lies, world units. [3]
    matrix: Tensor  # local -> world directions, stretch and rotation in one. [3,3]
    weight: float = 1.0  # Gaussians per area against other parts
    # relative Gaussians per area along the profile, by local radius; None is even
    density: Callable[[Tensor], Tensor] | None = None
    # whether the key light stops at it; a part that does is shadowed as an ellipsoid
    casts_shadow: bool = True
    clears: float = 0.0  # no other part's Gaussians within this share of its size: nothing grows over an eye

    def to_local(self, points: Tensor) -> Tensor:
        """World points in the shape's coordinates. [N,3] -> [N,3]"""
        inverse: Tensor = torch.linalg.inv(self.matrix)
        return (points - self.center) @ inverse.T

    def depth(self, points: Tensor) -> Tensor:
        """About how far below the surface points lie, world units, 0 outside. [N,3] world -> [N]"""
        depth = torch.zeros(len(points))
        local = self.to_local(points)
        inside = (self.shape.level(local) < 1).nonzero()[:, 0]
        if len(inside):
            surface = self.shape.nearest(local[inside]) @ self.matrix.T + self.center
            depth[inside] = (surface - points[inside]).norm(dim=1)
        return depth

    def touches(self, other: Part) -> bool:
        """Whether the spheres around the two parts meet."""
        return float((self.center - other.center).norm()) < self.reach + other.reach

    @property
    def reach(self) -> float:
        """Radius of a sphere about the center that holds the part, world units."""
        profile = self.shape.profile
        farthest = math.sqrt(2) if profile is None else float(profile.norm(dim=1).max())
        return farthest * float(self.matrix.norm(dim=0).max())


@dataclass(frozen=True)
class Samples:
    """Points on one part's surface."""

    points: Tensor  # world positions. [N,3]
    local: Tensor  # the same in the shape's coordinates. [N,3]
    normals: Tensor  # unit, outwards. [N,3]
    spacing: Tensor  # distance to the neighbors, world units. [N]

    def __getitem__(self, index: Tensor) -> Samples:
        return Samples(self.points[index], self.local[index], self.normals[index], self.spacing[index])

    def __len__(self) -> int:
        return int(self.points.shape[0])


def sample(part: Part, count: int) -> Samples:
    """`count` points on the part, a Fibonacci spiral spaced evenly by (weighted) world area."""
    profile = part.shape.profile
    if profile is None:
        return _sample_panel(part, count)
    step = profile[1:] - profile[:-1]
    middle = 0.5 * (profile[1:] + profile[:-1])
    turns = torch.arange(_TURNS) * (2 * math.pi / _TURNS)
    along_area = _area_element(part.matrix, middle, step, turns[::8, None]).mean(0)
    if part.density is not None:
        along_area = along_area * part.density(middle[:, 0])
    widest = int(middle[:, 0].argmax())
    around_area = _area_element(part.matrix, middle[widest], step[widest], turns)

    index = torch.arange(count, dtype=torch.float64)
    t, t_share = _spread(along_area, (index + 0.5) / count)
    turn, turn_share = _spread(around_area, (index * _GOLDEN) % 1.0)
    whole = t.floor().long().clamp(0, len(step) - 1)
    spot = torch.lerp(profile[whole], profile[whole + 1], (t - whole).float()[:, None])
    angle = (turn * (2 * math.pi / _TURNS)).float()
    local = torch.stack([spot[:, 0] * angle.cos(), spot[:, 1], spot[:, 0] * angle.sin()], dim=1)

    tangent = step[whole]
    local_normals = torch.stack(
        [-tangent[:, 1] * angle.cos(), tangent[:, 0], -tangent[:, 1] * angle.sin()], 1
    )
    normals = local_normals @ torch.linalg.inv(part.matrix)
    element = _area_element(part.matrix, spot, tangent, angle)
    cell = element * (2 * math.pi / _TURNS) / (count * t_share * turn_share).float()
    return Samples(
        local @ part.matrix.T + part.center,
        local,
        normals / normals.norm(dim=1, keepdim=True),
        cell.sqrt(),
    )


def _sample_panel(part: Part, count: int) -> Samples:
    """`sample` of a flat square: a lattice of two irrational steps (Roberts 2018, the R2 sequence)."""
    index = torch.arange(1, count + 1, dtype=torch.float64)[:, None]
    shares = (0.5 + index * torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64)) % 1.0
    spot = (2 * shares - 1).float()
    local = torch.stack([spot[:, 0], torch.zeros(count), spot[:, 1]], dim=1)
    normal = torch.linalg.cross(part.matrix[:, 2], part.matrix[:, 0])
    area = float(4 * normal.norm())
    return Samples(
        local @ part.matrix.T + part.center,
        local,
        (normal / normal.norm()).expand(count, 3),
        torch.full((count,), math.sqrt(area / count)),
    )


def _area_element(matrix: Tensor, spot: Tensor, step: Tensor, angle: Tensor) -> Tensor:
    """World area of a profile step turned by one radian about y. [...,2], [...,2], [...] -> [...]"""
    cos = angle.cos()
    sin = angle.sin()
    across = step[..., 0]
    radius = spot[..., 0]
    along = torch.stack([across * cos, step[..., 1] + 0 * cos, across * sin], dim=-1) @ matrix.T
    around = torch.stack([-radius * sin, 0 * radius * sin, radius * cos], dim=-1) @ matrix.T
    area: Tensor = torch.linalg.cross(along, around).norm(dim=-1)
    return area


def _spread(density: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Where shares 0..1 of the whole lie along a histogram, in bins, and each one's bin as a share."""
    portions = density.double() / density.double().sum()
    edges = torch.cat([portions.new_zeros(1), portions.cumsum(0)])
    bins = (torch.searchsorted(edges, shares, right=True) - 1).clamp(0, len(portions) - 1)
    inside = (shares - edges[bins]) / portions[bins].clamp_min(1e-12)
    return bins + inside.clamp(0, 1), portions[bins].clamp_min(1e-12)
