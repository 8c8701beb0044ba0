"""What a picture of a scene is about, and where to stand to see it.

The subject is what stands on the ground: neither the ground nor what floats far off. A ground is a smooth
surface under most of the scene, wider than what stands on it. Things are measured in cells of space, so that
neither a lawn's many blades nor a sky's few giants decide.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians

from .bounds import front_direction, has_ceiling, has_long_tail, quantile
from .neighbors import join_pairs

_SAMPLE = 60_000
_ENOUGH = 64
_SOLID = 0.1
"""Opacity below which a Gaussian is haze."""

_CORE = 2.5
"""Of the median distance: what lies farther is background, where a scene has any."""

_PLAN = 24
_ABOVE = 0.05
"""Of the plan's half diagonal: so far above the ground begins what stands on it."""

_UNDER = 0.03
_SHOWN = 0.5
_COVERED = 0.6
"""A ground has no more of the scene under it, shows in no fewer cells of the plan, and what stands on it
covers no more of them."""

_FEET = 0.01
"""Share of a scene that lies under its ground: strays, and the far side of what is soft."""

_LOOKED_AT = 8_000
"""Gaussians of which is asked what hides them."""

_FREE = 0.2
_RICHER = 1.5
"""One stands no nearer to anything than a fifth of the room's half width; and a first picture leaves the
front where another side shows half as much again."""

_ACROSS = 32
_MINIMUM = 0.06
"""Of the cells of the largest thing: what fills fewer is a tuft or a stray. The toy robot's hands fill .11 of
its body's, the largest tuft of its ground .03."""


def subject_rows(scene: Gaussians, up: Tensor) -> Tensor:
    """The Gaussians that the first picture of a scene should be filled by.

    Args:
        scene: N Gaussians, finite; of many an even sample is looked at
        up: see `up_axis.guess_up`. [3]

    Returns:
        Sorted rows, at least one where there is one at all. [M] int64
    """
    rows = _sample(scene)
    solid = rows[scene.opacities[rows] > _SOLID]
    if len(solid) < _ENOUGH:
        return rows
    rows = _without_background(scene, solid)
    height, plan = _heights_and_plan(scene.means[rows], up)
    standing = _rows_above_ground(height, plan)
    if standing is not None:
        rows = rows[standing]
        height = height[standing]
        plan = plan[standing]
    elif len(rows) < len(solid) and not has_long_tail(scene.means[solid]):
        rows = solid  # what is far out is no background, but a guitar's neck
        height, plan = _heights_and_plan(scene.means[rows], up)
    return rows[_rows_of_large_things(torch.cat([plan, height[:, None]], dim=1))]


def fit_eye(points: Tensor, radius: float, axes: Tensor, tangents: tuple[float, float]) -> Tensor:
    """Where the eye stands that looks along −back and has the points in its picture, as near as can be. [3]

    Args:
        points: to be seen, world units; all but a half per cent on each side are. [P,3], P ≥ 1
        radius: of a ball about each point, world units
        axes: rows right, up and back (from the scene to the eye) of the picture, unit vectors. [3,3]
        tangents: of half the angle that is to be filled, along the width and along the height
    """
    right, up, back = (points.double() @ axes.double().T).unbind(1)
    best = []
    away = -math.inf
    for along, tangent in ((right, tangents[0]), (up, tangents[1])):
        # |along − place| ≤ tangent · (away − back) for every point: two planes, which meet at the eye
        margin = radius * math.sqrt(1 + tangent**2)
        high = float(quantile(along + tangent * back, 0.995)) + margin
        low = float(quantile(tangent * back - along, 0.995)) + margin
        best.append(0.5 * (high - low))
        away = max(away, 0.5 * (high + low) / tangent)
    return torch.tensor([*best, away], dtype=torch.float64) @ axes.double()


def fit_camera(
    scene: Gaussians,
    up: Tensor,
    turn: tuple[float, float],
    size: tuple[int, int],
    fov: float,
    filled: float,
) -> Camera:
    """A camera that what the scene is about fills; as `progdf render --orbit`.

    Args:
        scene: what the picture is of
        up: [3]
        turn: azimuth and elevation of the eye, degrees, see `front_direction`
        size: width and height, pixels
        fov: vertical, radians
        filled: share of the picture, 0..1
    """
    ahead, (around, above) = front_direction(up), map(math.radians, turn)
    level = math.cos(around) * ahead + math.sin(around) * torch.linalg.cross(up, ahead)
    back = math.cos(above) * level + math.sin(above) * up
    axes = look_at(back, torch.zeros(3), up)[:3, :3] * torch.tensor([[1.0], [-1.0], [-1.0]])
    subject = scene[subject_rows(scene, up)]
    tangent = filled * math.tan(0.5 * fov)
    radius = 2 * float(subject.log_scales.amax(dim=1).median().exp())
    eye = fit_eye(subject.means, radius, axes, (tangent * size[0] / size[1], tangent)).float()
    return Camera(look_at(eye, eye - back, up), intrinsics(fov, *size), *size)


def is_room(scene: Gaussians, up: Tensor) -> bool:
    """Whether a ceiling, which a sky far above is not, covers most of it: it can be seen from inside only."""
    return has_ceiling(scene[_without_background(scene, _sample(scene))], up)


def standpoint(scene: Gaussians, up: Tensor) -> tuple[Tensor, Tensor]:
    """Where to stand inside a room, and what to look at: from free space, at the height of eyes, at the most.

    Returns:
        eye [3], target [3]
    """
    means = scene.means[_sample(scene)]
    ahead = front_direction(up)
    axes = torch.stack([ahead, torch.linalg.cross(up, ahead), up])
    middle = means.median(dim=0).values
    inside = (means - middle) @ axes.T
    low, high = (torch.stack([quantile(c, q) for c in inside.unbind(1)]) for q in (0.02, 0.98))
    center = 0.5 * (low + high)
    half = 0.5 * (high - low)
    some = inside[:: -(-len(inside) // _LOOKED_AT)]
    near = _FREE * float(half[:2].min())
    most = -1.0
    view = (center, center + torch.tensor([float(half[0]), 0.0, 0.0]))
    for offset in torch.cartesian_prod(*[torch.linspace(-0.75, 0.75, 5)] * 2):
        candidate = center + half * torch.cat([offset, torch.tensor([0.2])])
        free = float((some - candidate).norm(dim=1).min()) > near
        for turn in range(12):
            angle = math.radians(30 * turn)
            back = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
            seen = _visible(some - candidate, back, wide=1.0).sum() / len(some) + float(free)
            if float(seen) > most:
                most = float(seen)
                view = (candidate, candidate - float(half[:2].min()) * back)
    eye, target = view
    return middle + eye @ axes, middle + (target - torch.tensor([0.0, 0.0, 0.1 * float(half[2])])) @ axes


def richest_turn(scene: Gaussians, up: Tensor, azimuth: float, elevation: float) -> float:
    """By how many degrees to turn from an azimuth to where much more of the subject is seen: of what is open
    or solid on one side only, as an alcove or a face; 0 where no side shows half as much again.

    Args:
        scene: what the picture is to be filled by
        up: [3]
        azimuth, elevation: of the eye, degrees, see `front_direction`
    """
    if len(scene) < _ENOUGH:
        return 0.0
    means = scene.means[:: -(-len(scene) // _LOOKED_AT)]
    ahead = front_direction(up)
    places = (means - means.median(dim=0).values) @ torch.stack([ahead, torch.linalg.cross(up, ahead), up]).T
    above = math.radians(elevation)
    shares = []
    for turn in range(8):
        around = math.radians(azimuth + 45 * turn)
        level = math.cos(above)
        back = torch.tensor([level * math.cos(around), level * math.sin(around), math.sin(above)])
        shares.append(float(_visible(places, back).float().mean()))
    best = max(range(8), key=lambda turn: shares[turn])
    return 45.0 * ((best + 4) % 8 - 4) if shares[best] >= _RICHER * shares[0] else 0.0


def _visible(places: Tensor, back: Tensor, wide: float = 0.0) -> Tensor:
    """Which places nothing hides in a picture of 24 x 24 cells. [P,3] -> [P] bool

    Args:
        places: about the eye, or of a picture from infinitely far about the middle; z up
        back: from what is seen to the eye, unit length, not straight up. [3]
        wide: tangent of half the angle that is seen; 0 of a picture from infinitely far
    """
    right = torch.nn.functional.normalize(torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back), dim=0)
    x, y, depth = (places @ torch.stack([right, torch.linalg.cross(back, right), -back]).T).unbind(1)
    size = float(quantile(places.norm(dim=1), 0.95).clamp_min(1e-12))
    unit = wide * depth.clamp_min(1e-6 * size) if wide else torch.full_like(depth, size)
    cells = [((c / unit + 1) * 12).floor() for c in (x, y)]
    within = (depth > 0) if wide else torch.ones_like(depth, dtype=torch.bool)
    for cell in cells:
        within &= (cell >= 0) & (cell < 24)
    index = (cells[0] * 24 + cells[1]).clamp(0, 575).long()
    far = torch.where(within, depth, math.inf)
    nearest = torch.full((576,), math.inf).scatter_reduce(0, index, far, "amin")
    return within & (depth <= nearest[index] + 0.08 * size)


def ground_height(scene: Gaussians, up: Tensor) -> float:
    """How high along `up` a scene's ground lies, or the feet of what stands in it; world units.

    Strays below do not count; of a scene without anything solid, 0.
    """
    rows = _sample(scene)
    solid = rows[scene.opacities[rows] > _SOLID]
    if not len(solid):
        return 0.0
    visible = scene[_without_background(scene, solid)]
    height = float(quantile(visible.means @ up, _FEET))
    return height if math.isfinite(height) else 0.0


def _sample(scene: Gaussians) -> Tensor:
    return torch.arange(0, len(scene), max(1, -(-len(scene) // _SAMPLE)))


def _without_background(scene: Gaussians, rows: Tensor) -> Tensor:
    """Without shells of sky, mountains, strays; a scene that has none stays whole."""
    for _ in range(3):
        means = scene.means[rows]
        distances = (means - means.median(dim=0).values).norm(dim=1)
        core = distances <= _CORE * distances.median()
        if bool(core.all()):
            break
        rows = rows[core]
    return rows


def _heights_and_plan(means: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Heights [R] and places in plan [R,2], both over the plan's half diagonal, the plan about its middle."""
    ahead = front_direction(up)
    plan = means @ torch.stack([ahead, torch.linalg.cross(up, ahead)], dim=1)
    low, high = (torch.stack([quantile(c, q) for c in plan.unbind(1)]) for q in (0.01, 0.99))
    unit = (0.5 * (high - low)).norm().clamp_min(1e-12)
    height = means @ up
    return (height - height.median()) / unit, (plan - 0.5 * (low + high)) / unit


def _rows_above_ground(height: Tensor, plan: Tensor) -> Tensor | None:
    """Which rows stand above a ground. [R], [R,2] -> [R] bool; None where there is no ground to speak of."""
    cells = ((plan + 1.0) * 0.5 * _PLAN).long().clamp(0, _PLAN - 1)
    taken, cell, counts = torch.unique(
        cells[:, 0] * _PLAN + cells[:, 1], return_inverse=True, return_counts=True
    )
    form = _powers(plan)
    if len(taken) < form.shape[1]:
        return None
    order = torch.argsort(height, stable=True)
    order = order[torch.argsort(cell[order], stable=True)]  # by cell, from low to high in each
    lowest = order[counts.cumsum(0) - counts + counts // 10]
    ground = form @ _ground(height[lowest], form[lowest])
    above = height - ground
    standing = above > _ABOVE
    covered = torch.zeros(len(taken)).index_add(0, cell, standing.float()) > 0.1 * counts
    on_ground = (
        int(standing.sum()) >= _ENOUGH
        and float((above < -_ABOVE).float().mean()) <= _UNDER
        and float((above[lowest].abs() < _ABOVE).float().mean()) >= _SHOWN
        and float(covered.float().mean()) <= _COVERED
    )
    return standing if on_ground else None


def _ground(low: Tensor, form: Tensor) -> Tensor:
    """The surface through the low points of most cells of the plan. [Q], [Q,6] -> coefficients [6]

    Robust regression (Cauchy weights), in which what lies above the surface counts for less: under what
    stands no ground shows.
    """
    weights = torch.ones_like(low)
    for _ in range(20):
        # numpy's own: torch's threads spin over a few hundred rows, and this is in the way of a first picture
        fit = np.linalg.lstsq((form * weights[:, None]).numpy(), (low * weights).numpy(), rcond=None)
        surface = torch.from_numpy(fit[0])
        residual = low - form @ surface
        weights = 1.0 / (1.0 + (residual / torch.where(residual > 0, 0.5 * _ABOVE, _ABOVE)) ** 2)
    return surface


def _powers(plan: Tensor) -> Tensor:
    """Of the second order: level, slope (up is known to an axis only), hill or hollow. [R,2] -> [R,6]"""
    x, y = plan.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)


def _rows_of_large_things(places: Tensor) -> Tensor:
    """Which rows belong to large connected things. [R,3] -> [R] bool, at least one"""
    low, high = (torch.stack([quantile(c, q) for c in places.unbind(1)]) for q in (0.01, 0.99))
    side = float((high - low).amax().clamp_min(1e-9)) / _ACROSS
    span = 2 * _ACROSS + 2
    keys = ((places - low) / side + 0.5 * _ACROSS).clamp(0, span - 3).long() + 1
    boxes, box = torch.unique((keys[:, 0] * span + keys[:, 1]) * span + keys[:, 2], return_inverse=True)
    thing = _connected_cells(boxes, span)
    size = torch.zeros(len(boxes)).index_add(0, thing, torch.ones(len(boxes)))
    return (size[thing] >= _MINIMUM * size.max())[box]


def _connected_cells(boxes: Tensor, span: int) -> Tensor:
    """Which thing each cell belongs to; cells that touch, corners included, are one. [B] ascending -> [B]"""
    steps = torch.tensor([-1, 0, 1])
    around = boxes[:, None] + ((steps[:, None, None] * span + steps[:, None]) * span + steps).flatten()
    box = torch.searchsorted(boxes, around).clamp_max(len(boxes) - 1)
    cell, side = (boxes[box] == around).nonzero(as_tuple=True)
    return torch.from_numpy(join_pairs(cell.numpy(), box[cell, side].numpy(), len(boxes)))
