"""Subject of a scene and the camera that frames it.

The subject is the group of objects that stand on the ground, without the ground and without far floaters. A
ground is a smooth surface under most of the scene, wider than the objects on it. Objects are measured in
cells of space, so that neither a lawn's many blades nor a sky's few giants decide.
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

_MAX_SAMPLED_ROWS = 60_000  # Gaussians; larger scenes are sampled evenly
_MIN_GAUSSIANS = 64  # Gaussians; fewer do not define a shape
_MIN_SOLID_OPACITY = 0.1  # opacity; less opaque Gaussians are haze
_CORE_RADIUS = 2.5  # median distances from the middle; Gaussians farther away are background

_PLAN_CELLS = 24  # cells along each side of the ground plan
_STANDING_HEIGHT = 0.05  # half diagonals of the plan; Gaussians higher above the ground stand on it

_MAX_SHARE_BELOW = 0.03  # largest share of the scene below a ground
_MIN_GROUND_CELLS = 0.5  # smallest share of the plan's cells in which the lowest Gaussians lie on the ground
_MAX_COVERED_CELLS = 0.6  # largest share of the plan's cells covered by Gaussians that stand on the ground

_GROUND_QUANTILE = 0.01  # share of a scene below its ground: strays, and the far side of soft surfaces

_OCCLUSION_SAMPLE = 8_000  # Gaussians that are tested for occlusion

_MIN_CLEARANCE = 0.2  # smallest distance of the eye to any Gaussian in a room, in half widths of the room
_MIN_VISIBILITY_RATIO = 1.5  # a first picture leaves the front if another side shows this many times as much

_CELLS_ACROSS = 32  # cells of space along the longest side of the scene
# Share of the largest object's cells; smaller objects are tufts or strays. The toy robot's hands fill 0.11 of
# its body's, the largest tuft of its ground 0.03.
_MIN_OBJECT_SHARE = 0.06


def subject_rows(scene: Gaussians, up: Tensor) -> Tensor:
    """Return the Gaussians of the subject, which the first picture of a scene should frame.

    Args:
        scene: N finite Gaussians; large scenes are sampled evenly
        up: see `up_axis.guess_up`. [3]

    Returns:
        Sorted rows, at least one unless the scene is empty. [M] int64
    """
    rows = _sample(scene)
    solid = rows[scene.opacities[rows] > _MIN_SOLID_OPACITY]
    if len(solid) < _MIN_GAUSSIANS:
        return rows
    rows = _without_background(scene, solid)
    height, plan = _heights_and_plan(scene.means[rows], up)
    standing = _rows_above_ground(height, plan)
    if standing is not None:
        rows = rows[standing]
        height = height[standing]
        plan = plan[standing]
    elif len(rows) < len(solid) and not has_long_tail(scene.means[solid]):
        rows = solid  # far Gaussians without a long tail are a part of the object, such as a guitar's neck
        height, plan = _heights_and_plan(scene.means[rows], up)
    return rows[_rows_of_large_objects(torch.cat([plan, height[:, None]], dim=1))]


def fit_eye(points: Tensor, radius: float, axes: Tensor, tangents: tuple[float, float]) -> Tensor:
    """Return the nearest eye position that looks along −back and has the points in its picture. [3]

    Args:
        points: points to frame, world units; 0.5 % on each side may lie outside. [P,3], P ≥ 1
        radius: radius of a ball around each point, world units
        axes: unit vectors right, up and back (from the scene to the eye) of the picture, as rows. [3,3]
        tangents: tangents of half the angle to fill, along the width and along the height
    """
    right, up, back = (points.double() @ axes.double().T).unbind(1)
    best = []
    eye_distance = -math.inf
    for along, tangent in ((right, tangents[0]), (up, tangents[1])):
        # |along − eye| ≤ tangent · (eye_distance − back) for every point: two planes that meet at the eye
        margin = radius * math.sqrt(1 + tangent**2)
        high = float(quantile(along + tangent * back, 0.995)) + margin
        low = float(quantile(tangent * back - along, 0.995)) + margin
        best.append(0.5 * (high - low))
        eye_distance = max(eye_distance, 0.5 * (high + low) / tangent)
    return torch.tensor([*best, eye_distance], dtype=torch.float64) @ axes.double()


def fit_camera(
    scene: Gaussians,
    up: Tensor,
    turn: tuple[float, float],
    size: tuple[int, int],
    fov: float,
    filled: float,
) -> Camera:
    """Return a camera that frames the subject of a scene, as for `progdf render --orbit`.

    Args:
        scene: the scene to frame
        up: world direction that is up. [3]
        turn: azimuth and elevation of the eye, degrees, see `front_direction`
        size: width and height, pixels
        fov: vertical field of view, radians
        filled: share of the picture's width or height that the subject fills, 0 to 1
    """
    ahead = front_direction(up)
    azimuth, elevation = map(math.radians, turn)
    level = math.cos(azimuth) * ahead + math.sin(azimuth) * torch.linalg.cross(up, ahead)
    back = math.cos(elevation) * level + math.sin(elevation) * up
    axes = look_at(back, torch.zeros(3), up)[:3, :3] * torch.tensor([[1.0], [-1.0], [-1.0]])
    subject = scene[subject_rows(scene, up)]
    tangent = filled * math.tan(0.5 * fov)
    radius = 2 * float(subject.log_scales.amax(dim=1).median().exp())
    eye = fit_eye(subject.means, radius, axes, (tangent * size[0] / size[1], tangent)).float()
    return Camera(look_at(eye, eye - back, up), intrinsics(fov, *size), *size)


def is_room(scene: Gaussians, up: Tensor) -> bool:
    """Return whether a ceiling hides the scene from outside. A far sky is background, not a ceiling."""
    return has_ceiling(scene[_without_background(scene, _sample(scene))], up)


def room_viewpoint(scene: Gaussians, up: Tensor) -> tuple[Tensor, Tensor]:
    """Return the eye and target inside a room that show the most, from free space at eye height.

    Returns:
        Eye [3] and target [3], world units.
    """
    means = scene.means[_sample(scene)]
    ahead = front_direction(up)
    axes = torch.stack([ahead, torch.linalg.cross(up, ahead), up])
    middle = means.median(dim=0).values
    inside = (means - middle) @ axes.T
    low, high = (torch.stack([quantile(c, q) for c in inside.unbind(1)]) for q in (0.02, 0.98))
    center = 0.5 * (low + high)
    half = 0.5 * (high - low)
    sampled = inside[:: -(-len(inside) // _OCCLUSION_SAMPLE)]
    clearance = _MIN_CLEARANCE * float(half[:2].min())
    best_score = -1.0
    view = (center, center + torch.tensor([float(half[0]), 0.0, 0.0]))
    for offset in torch.cartesian_prod(*[torch.linspace(-0.75, 0.75, 5)] * 2):
        candidate = center + half * torch.cat([offset, torch.tensor([0.2])])
        is_free = float((sampled - candidate).norm(dim=1).min()) > clearance
        for turn in range(12):
            angle = math.radians(30 * turn)
            back = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
            seen = _visible_points(sampled - candidate, back, wide=1.0).sum() / len(sampled) + float(is_free)
            if float(seen) > best_score:
                best_score = float(seen)
                view = (candidate, candidate - float(half[:2].min()) * back)
    eye, target = view
    return middle + eye @ axes, middle + (target - torch.tensor([0.0, 0.0, 0.1 * float(half[2])])) @ axes


def best_azimuth_offset(scene: Gaussians, up: Tensor, azimuth: float, elevation: float) -> float:
    """Return the angle from an azimuth to the side that shows most of the subject, degrees.

    It finds the side of subjects such as an alcove or a face, which are open or solid on one side only. It is
    0 unless that side shows at least 1.5 times as much.

    Args:
        scene: Gaussians of the subject
        up: world direction that is up. [3]
        azimuth, elevation: direction of the eye, degrees, see `front_direction`
    """
    if len(scene) < _MIN_GAUSSIANS:
        return 0.0
    means = scene.means[:: -(-len(scene) // _OCCLUSION_SAMPLE)]
    ahead = front_direction(up)
    points = (means - means.median(dim=0).values) @ torch.stack([ahead, torch.linalg.cross(up, ahead), up]).T
    above = math.radians(elevation)
    shares = []
    for turn in range(8):
        around = math.radians(azimuth + 45 * turn)
        level = math.cos(above)
        back = torch.tensor([level * math.cos(around), level * math.sin(around), math.sin(above)])
        shares.append(float(_visible_points(points, back).float().mean()))
    best = max(range(8), key=lambda turn: shares[turn])
    return 45.0 * ((best + 4) % 8 - 4) if shares[best] >= _MIN_VISIBILITY_RATIO * shares[0] else 0.0


def _visible_points(places: Tensor, back: Tensor, wide: float = 0.0) -> Tensor:
    """Return the points that are not occluded in a picture of 24 x 24 cells. [P,3] -> [P] bool

    Args:
        places: points with z up, relative to the eye, or to the middle for an orthographic picture
        back: unit vector from the scene to the eye, not straight up. [3]
        wide: tangent of half the field of view; 0 for an orthographic picture
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
    masked_depth = torch.where(within, depth, math.inf)
    nearest = torch.full((576,), math.inf).scatter_reduce(0, index, masked_depth, "amin")
    return within & (depth <= nearest[index] + 0.08 * size)


def ground_height(scene: Gaussians, up: Tensor) -> float:
    """Return the height of a scene's ground, or of its lowest objects, along `up`; world units.

    Strays below do not count. The height of a scene without solid Gaussians is 0.
    """
    rows = _sample(scene)
    solid = rows[scene.opacities[rows] > _MIN_SOLID_OPACITY]
    if not len(solid):
        return 0.0
    visible = scene[_without_background(scene, solid)]
    height = float(quantile(visible.means @ up, _GROUND_QUANTILE))
    return height if math.isfinite(height) else 0.0


def _sample(scene: Gaussians) -> Tensor:
    return torch.arange(0, len(scene), max(1, -(-len(scene) // _MAX_SAMPLED_ROWS)))


def _without_background(scene: Gaussians, rows: Tensor) -> Tensor:
    """Return the rows without background such as sky, mountains and strays, if there is any."""
    for _ in range(3):
        means = scene.means[rows]
        distances = (means - means.median(dim=0).values).norm(dim=1)
        core = distances <= _CORE_RADIUS * distances.median()
        if bool(core.all()):
            break
        rows = rows[core]
    return rows


def _heights_and_plan(means: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Return heights [R] and positions in plan [R,2], centered, in units of the plan's half diagonal."""
    ahead = front_direction(up)
    plan = means @ torch.stack([ahead, torch.linalg.cross(up, ahead)], dim=1)
    low, high = (torch.stack([quantile(c, q) for c in plan.unbind(1)]) for q in (0.01, 0.99))
    unit = (0.5 * (high - low)).norm().clamp_min(1e-12)
    height = means @ up
    return (height - height.median()) / unit, (plan - 0.5 * (low + high)) / unit


def _rows_above_ground(height: Tensor, plan: Tensor) -> Tensor | None:
    """Return the rows that stand above a ground. [R], [R,2] -> [R] bool; None if there is no ground."""
    cells = ((plan + 1.0) * 0.5 * _PLAN_CELLS).long().clamp(0, _PLAN_CELLS - 1)
    taken, cell, counts = torch.unique(
        cells[:, 0] * _PLAN_CELLS + cells[:, 1], return_inverse=True, return_counts=True
    )
    form = _monomials(plan)
    if len(taken) < form.shape[1]:
        return None
    order = torch.argsort(height, stable=True)
    order = order[torch.argsort(cell[order], stable=True)]  # by cell, ascending in each
    lowest = order[counts.cumsum(0) - counts + counts // 10]
    ground = form @ _fit_ground(height[lowest], form[lowest])
    above = height - ground
    standing = above > _STANDING_HEIGHT
    covered = torch.zeros(len(taken)).index_add(0, cell, standing.float()) > 0.1 * counts
    on_ground = (
        int(standing.sum()) >= _MIN_GAUSSIANS
        and float((above < -_STANDING_HEIGHT).float().mean()) <= _MAX_SHARE_BELOW
        and float((above[lowest].abs() < _STANDING_HEIGHT).float().mean()) >= _MIN_GROUND_CELLS
        and float(covered.float().mean()) <= _MAX_COVERED_CELLS
    )
    return standing if on_ground else None


def _fit_ground(low: Tensor, form: Tensor) -> Tensor:
    """Fit the surface through the low points of most cells of the plan. [Q], [Q,6] -> coefficients [6]

    A robust regression (Cauchy weights) gives points above the surface less weight, because objects hide the
    ground under them.
    """
    weights = torch.ones_like(low)
    for _ in range(20):
        # numpy: torch's threads spin over a few hundred rows, and the first picture waits for this
        fit = np.linalg.lstsq((form * weights[:, None]).numpy(), (low * weights).numpy(), rcond=None)
        surface = torch.from_numpy(fit[0])
        residual = low - form @ surface
        weights = 1.0 / (
            1.0 + (residual / torch.where(residual > 0, 0.5 * _STANDING_HEIGHT, _STANDING_HEIGHT)) ** 2
        )
    return surface


def _monomials(plan: Tensor) -> Tensor:
    """Return the monomials of degree 0 to 2. [R,2] -> [R,6]

    They model the level, the slope (up is known only to an axis), and a hill or hollow.
    """
    x, y = plan.unbind(1)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=1)


def _rows_of_large_objects(places: Tensor) -> Tensor:
    """Return the rows of large connected objects. [R,3] -> [R] bool, at least one"""
    low, high = (torch.stack([quantile(c, q) for c in places.unbind(1)]) for q in (0.01, 0.99))
    side = float((high - low).amax().clamp_min(1e-9)) / _CELLS_ACROSS
    span = 2 * _CELLS_ACROSS + 2
    keys = ((places - low) / side + 0.5 * _CELLS_ACROSS).clamp(0, span - 3).long() + 1
    boxes, box = torch.unique((keys[:, 0] * span + keys[:, 1]) * span + keys[:, 2], return_inverse=True)
    objects = _connected_cells(boxes, span)
    size = torch.zeros(len(boxes)).index_add(0, objects, torch.ones(len(boxes)))
    return (size[objects] >= _MIN_OBJECT_SHARE * size.max())[box]


def _connected_cells(boxes: Tensor, span: int) -> Tensor:
    """Return each cell's object; cells that touch, corners included, are one. [B] ascending -> [B]"""
    steps = torch.tensor([-1, 0, 1])
    around = boxes[:, None] + ((steps[:, None, None] * span + steps[:, None]) * span + steps).flatten()
    box = torch.searchsorted(boxes, around).clamp_max(len(boxes) - 1)
    cell, side = (boxes[box] == around).nonzero(as_tuple=True)
    return torch.from_numpy(join_pairs(cell.numpy(), box[cell, side].numpy(), len(boxes)))
