"""Transformed surfaces of revolution, with samples spread evenly by area."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.system.equality import equal_fields

_GOLDEN = (math.sqrt(5) - 1) / 2
_PROFILE_POINTS = 513  # points along a profile
_ANGLE_STEPS = 64  # steps around the axis


@dataclass(frozen=True)
class Shape:
    """Surface of revolution about the local y axis, or a flat square."""

    __eq__ = equal_fields

    # radius and height along the profile, with the outside on the left; None is the flat square with x and z
    # from −1 to 1 that faces up. [P,2]
    profile: Tensor | None
    # function from local points [N,3] to a level [N]: below 1 inside, 1 on the surface, above 1 outside
    level: Callable[[Tensor], Tensor]
    nearest: Callable[[Tensor], Tensor]  # function from local points [N,3] to close surface points [N,3]
    girth: float = 1.0  # thickness of the body, as a share of its radius


def ball(exponent: float = 2.0) -> Shape:
    """Return the unit sphere, or with a higher exponent a rounded cylinder (a superellipse as profile)."""
    angle = torch.linspace(0, math.pi, _PROFILE_POINTS)
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
    """Return a torus about y of radius 1, with a tube of radius `tube`."""
    angle = torch.linspace(0, 2 * math.pi, _PROFILE_POINTS)
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
    """Return a round lawn of radius 1 that falls by `drop` to its edge. Points below it are inside."""
    radius = torch.linspace(0, 1, _PROFILE_POINTS)
    curve = torch.stack([radius, -drop * radius**2], dim=1)

    def level(local: Tensor) -> Tensor:
        return 1 + local[:, 1] + drop * (local[:, 0] ** 2 + local[:, 2] ** 2)

    def nearest(local: Tensor) -> Tensor:
        height = -drop * (local[:, 0] ** 2 + local[:, 2] ** 2)
        return torch.stack([local[:, 0], height, local[:, 2]], dim=1)

    return Shape(curve, level, nearest)


def lathe(radii: Sequence[float], heights: Sequence[float]) -> Shape:
    """Return a closed body with radii at descending heights and straight lines between them."""
    outline = torch.tensor([[0.0, heights[0]], *zip(radii, heights, strict=True), [0.0, heights[-1]]])
    lengths = (outline[1:] - outline[:-1]).norm(dim=1)
    starts = torch.cat([lengths.new_zeros(1), lengths.cumsum(0)])
    positions = torch.linspace(0, float(starts[-1]), _PROFILE_POINTS)
    index = (torch.searchsorted(starts, positions) - 1).clamp(0, len(lengths) - 1)
    curve = torch.lerp(
        outline[index], outline[index + 1], ((positions - starts[index]) / lengths[index])[:, None]
    )
    rising = torch.tensor(heights).flip(0)
    radius = torch.tensor(radii).flip(0)

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
    """Return a flat square, x and z from −1 to 1, that faces up. Points behind it are inside."""

    def level(local: Tensor) -> Tensor:
        beside = (local[:, 0].abs() >= 1) | (local[:, 2].abs() >= 1)
        return torch.where(beside & (local[:, 1] < 0), 2.0, 1 + local[:, 1])

    def nearest(local: Tensor) -> Tensor:
        return torch.stack([local[:, 0].clamp(-1, 1), torch.zeros(len(local)), local[:, 2].clamp(-1, 1)], 1)

    return Shape(None, level, nearest)


@dataclass(frozen=True)
class Part:
    """Shape with a transform and its sampling settings."""

    __eq__ = equal_fields

    name: str  # name of the part, which selects its paint
    label: str  # name of the label of its Gaussians
    shape: Shape  # the surface
    center: Tensor  # position of the shape's origin, world units. [3]
    matrix: Tensor  # local to world directions: rotation times stretch. [3,3]
    weight: float = 1.0  # Gaussians per area, relative to other parts
    # function from local radii to relative numbers of Gaussians per area; None is uniform
    density: Callable[[Tensor], Tensor] | None = None
    # blocks the key light, with the shadow of an ellipsoid
    casts_shadow: bool = True
    clears: float = 0.0  # margin without other parts' Gaussians, as a share of its size; keeps fur off an eye

    def to_local(self, points: Tensor) -> Tensor:
        """Convert world points to the shape's coordinates. [N,3] -> [N,3]"""
        inverse: Tensor = torch.linalg.inv(self.matrix)
        return (points - self.center) @ inverse.T

    def depth(self, points: Tensor) -> Tensor:
        """Return the approximate depth of points below the surface, 0 outside; world units. [N,3] -> [N]"""
        depth = torch.zeros(len(points))
        local = self.to_local(points)
        inside = (self.shape.level(local) < 1).nonzero()[:, 0]
        if len(inside):
            surface = self.shape.nearest(local[inside]) @ self.matrix.T + self.center
            depth[inside] = (surface - points[inside]).norm(dim=1)
        return depth

    def touches(self, other: Part) -> bool:
        """Return whether the bounding spheres of two parts overlap."""
        return float((self.center - other.center).norm()) < self.reach + other.reach

    @property
    def reach(self) -> float:
        """Radius of the bounding sphere about the center, world units."""
        profile = self.shape.profile
        farthest = math.sqrt(2) if profile is None else float(profile.norm(dim=1).max())
        return farthest * float(self.matrix.norm(dim=0).max())


@dataclass(frozen=True)
class Samples:
    """Samples on the surface of one part."""

    __eq__ = equal_fields

    points: Tensor  # world positions. [N,3]
    local: Tensor  # the same positions in the shape's coordinates. [N,3]
    normals: Tensor  # outward unit vectors. [N,3]
    spacing: Tensor  # distance to the neighbors, world units. [N]

    def __getitem__(self, index: Tensor) -> Samples:
        return Samples(self.points[index], self.local[index], self.normals[index], self.spacing[index])

    def __len__(self) -> int:
        return int(self.points.shape[0])


def sample(part: Part, count: int) -> Samples:
    """Return `count` points on a part: a Fibonacci spiral, spaced evenly by (weighted) world area."""
    profile = part.shape.profile
    if profile is None:
        return _sample_panel(part, count)
    step = profile[1:] - profile[:-1]
    middle = 0.5 * (profile[1:] + profile[:-1])
    turns = torch.arange(_ANGLE_STEPS) * (2 * math.pi / _ANGLE_STEPS)
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
    angle = (turn * (2 * math.pi / _ANGLE_STEPS)).float()
    local = torch.stack([spot[:, 0] * angle.cos(), spot[:, 1], spot[:, 0] * angle.sin()], dim=1)

    tangent = step[whole]
    local_normals = torch.stack(
        [-tangent[:, 1] * angle.cos(), tangent[:, 0], -tangent[:, 1] * angle.sin()], 1
    )
    normals = local_normals @ torch.linalg.inv(part.matrix)
    element = _area_element(part.matrix, spot, tangent, angle)
    cell = element * (2 * math.pi / _ANGLE_STEPS) / (count * t_share * turn_share).float()
    return Samples(
        local @ part.matrix.T + part.center,
        local,
        normals / normals.norm(dim=1, keepdim=True),
        cell.sqrt(),
    )


def _sample_panel(part: Part, count: int) -> Samples:
    """Sample a flat square on a lattice of two irrational steps (Roberts 2018, the R2 sequence)."""
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
    """Return the world area of a profile step rotated by 1 rad about y. [...,2], [...,2], [...] -> [...]"""
    cos = angle.cos()
    sin = angle.sin()
    across = step[..., 0]
    radius = spot[..., 0]
    along = torch.stack([across * cos, step[..., 1] + 0 * cos, across * sin], dim=-1) @ matrix.T
    around = torch.stack([-radius * sin, 0 * radius * sin, radius * cos], dim=-1) @ matrix.T
    area: Tensor = torch.linalg.cross(along, around).norm(dim=-1)
    return area


def _spread(density: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    """Return the positions of quantiles in a histogram, in bins, and the shares of the bins they lie in."""
    portions = density.double() / density.double().sum()
    edges = torch.cat([portions.new_zeros(1), portions.cumsum(0)])
    bins = (torch.searchsorted(edges, shares, right=True) - 1).clamp(0, len(portions) - 1)
    inside = (shares - edges[bins]) / portions[bins].clamp_min(1e-12)
    return bins + inside.clamp(0, 1), portions[bins].clamp_min(1e-12)
