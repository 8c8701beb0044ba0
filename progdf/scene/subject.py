"""Subject of a scene, the camera that frames it, and the selection of the subject of a view.

The subject of a scene is the group of objects that stand on the ground, without the ground and without far
floaters. A ground is a smooth surface under most of the scene, wider than the objects on it. Objects are
measured in cells of space, so that neither a lawn's many blades nor a sky's few giants decide.

The subject of a view is the one object in its middle, see `select_subject`.
"""

from __future__ import annotations

import logging
import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import alpha_weights
from progdf.terminal import format_count

from .bounds import front_direction, has_ceiling, has_long_tail, quantile
from .neighbors import CellGrid, Neighborhood, typical_spacing
from .orbit_rig import MIN_GAUSSIANS, OCCLUSION_SAMPLE, detailed_side, visible_points
from .point_tree import PointTree
from .scribbles import Rows
from .selection import Mask

_log = logging.getLogger(__name__)

_MAX_SAMPLED_ROWS = 60_000  # Gaussians; larger scenes are sampled evenly
_MIN_SOLID_OPACITY = 0.1  # opacity; less opaque Gaussians are haze
_CORE_RADIUS = 2.5  # median distances from the middle; Gaussians farther away are background

_PLAN_CELLS = 24  # cells along each side of the ground plan
_STANDING_HEIGHT = 0.05  # half diagonals of the plan; Gaussians higher above the ground stand on it

_MAX_SHARE_BELOW = 0.03  # largest share of the scene below a ground
_MIN_GROUND_CELLS = 0.5  # smallest share of the plan's cells in which the lowest Gaussians lie on the ground
_MAX_COVERED_CELLS = 0.6  # largest share of the plan's cells covered by Gaussians that stand on the ground

_GROUND_QUANTILE = 0.01  # share of a scene below its ground: strays, and the far side of soft surfaces

_MIN_CLEARANCE = 0.2  # smallest distance of the eye to any Gaussian in a room, in half widths of the room

# Share of the largest object's cells; smaller objects are tufts or strays. The toy robot's hands fill 0.11 of
# its body's, the largest tuft of its ground 0.03.
_MIN_OBJECT_SHARE = 0.06

_FIRST_AZIMUTH_DEG = 20.0
_FIRST_ELEVATION_DEG = 15.0
_FIRST_FOV_DEG = 45.0  # vertical
_ROOM_FOV_DEG = 60.0  # vertical, inside a room
_FIRST_FILLED = 0.72  # share of the first picture's width or height that the subject fills

_VIEW_PX = 160  # longer side of the picture in which the middle of a view is measured, pixels
_MIDDLE_SPREAD = 0.5  # standard deviation of the weight of the middle, in half shorter sides of the picture
_BORDER_SHARE = 0.03  # width of a picture's border, in shorter sides
_MIN_MIDDLE_SHARE = 1 / 256  # smallest share of a subject in the weighted middle: a 16th of each side
_MAX_SUPPORTS = 3  # supports on top of each other, such as a rug, a table and a tray
_MIN_RIM_SHARE = 0.8  # smallest share of the cells around the objects in which their support goes on


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
    if len(solid) < MIN_GAUSSIANS:
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


def first_view(scene: Gaussians, up: Tensor, size: tuple[int, int]) -> Camera:
    """Return the first camera of a scene: slightly above the subject's front, or inside a room.

    Args:
        scene: a scene of at least one Gaussian
        up: world direction that is up. [3]
        size: width and height, pixels
    """
    if is_room(scene, up):
        K = intrinsics(math.radians(_ROOM_FOV_DEG), *size)
        return Camera(look_at(*room_viewpoint(scene, up), up), K, *size)
    subject = scene[subject_rows(scene, up)]
    turn = _FIRST_AZIMUTH_DEG + detailed_side(subject, up, _FIRST_AZIMUTH_DEG, _FIRST_ELEVATION_DEG)
    fov = math.radians(_FIRST_FOV_DEG)
    return fit_camera(scene, up, (turn, _FIRST_ELEVATION_DEG), size, fov, _FIRST_FILLED)


def select_subject(scene: Gaussians, neighborhood: Neighborhood, camera: Camera, up: Tensor) -> Mask:
    """Select the object in the middle of a view, without networks and strokes.

    1. Object: of the connected groups that stand on the ground, the one with the largest visible share of the
       view's middle. A support under it, such as a plinth or a table, is removed like the ground.
    2. Boundary: a random walk from the object and from the ground decides every Gaussian, see `Scribbles`.
    3. Hovering parts: parts that touch neither join the object if they are nearer to it than to the
       background, and at most its radius away.

    Without a ground, the object is the connected group of solid Gaussians in the middle of the view. If such
    a scene has a far background, the walk starts from the middle and from the border of the view.

    Args:
        scene: N Gaussians as they are drawn
        neighborhood: neighborhood of the same N Gaussians, at any strength of their edits
        camera: the view
        up: world direction that is up. [3]

    Returns:
        Mask. [N]

    Raises:
        ProgdfError: the scene is a room, or nothing stands in the middle of the view.
    """
    no_subject = ProgdfError("no subject in the middle of the view; turn the view to an object")
    if not len(scene):
        raise no_subject
    if is_room(scene, up):
        raise ProgdfError("a room has no single subject; select with Scribble, or name a point with flood:")
    size = max(camera.width, camera.height)
    small = camera.resize(*(max(1, round(side * _VIEW_PX / size)) for side in (camera.width, camera.height)))
    middle, border = _middle_and_border(small)
    weights = alpha_weights(scene, small, middle).numpy()
    in_middle = weights[:, 0]
    solid, near, ground = _solid_near_and_ground(scene, up)
    if ground is not None:
        on, beside, reason = _object_on_ground(scene, up, near, ground, in_middle)
        beside = np.union1d(beside, np.setdiff1d(solid, near))
    elif has_long_tail(scene.means[solid]):
        on = near[2 * in_middle[near] > weights[near, 2]]
        at_border = alpha_weights(scene, small, border).numpy()
        beside = np.flatnonzero(2 * at_border[:, 0] > at_border[:, 2])
        beside = np.setdiff1d(np.union1d(beside, np.setdiff1d(solid, near)), on)
        reason = "no ground, but a far background"
    else:
        on, beside = _object_and_floaters(scene, solid, in_middle)
        reason = "no ground and no background"
    share = float(in_middle[on].sum() / middle.sum())
    if share < _MIN_MIDDLE_SHARE:
        raise no_subject
    mask = neighborhood.scribbles.select(on, beside)
    mask = _with_hovering_parts(scene, neighborhood, mask, beside)
    line = "subject: %s, %s; it covers %.0f %% of the middle of the view"
    _log.info(line, format_count(int(mask.sum())), reason, 100 * share)
    return mask


def _middle_and_border(camera: Camera) -> tuple[Tensor, Tensor]:
    """Return weights of a picture's pixels: a Gaussian around its middle, and 1 on its border. [H,W] each"""
    shorter = min(camera.width, camera.height)
    x = torch.arange(camera.width) + 0.5 - camera.width / 2
    y = torch.arange(camera.height) + 0.5 - camera.height / 2
    squared_radius = (x.square() + y[:, None].square()) / (0.5 * shorter) ** 2
    border = torch.ones(camera.height, camera.width)
    width = max(1, round(_BORDER_SHARE * shorter))
    border[width:-width, width:-width] = 0.0
    return torch.exp(-0.5 * squared_radius / _MIDDLE_SPREAD**2), border


def _solid_near_and_ground(scene: Gaussians, up: Tensor) -> tuple[Rows, Rows, tuple[Mask, Mask] | None]:
    """Return the solid rows of a sample, those without far background, and their `_split_ground`."""
    rows = _sample(scene)
    solid = rows[scene.opacities[rows] > _MIN_SOLID_OPACITY]
    if len(solid) < MIN_GAUSSIANS:
        return rows.numpy(), rows.numpy(), None
    near = _without_background(scene, solid)
    parts = _split_ground(*_heights_and_plan(scene.means[near], up))
    ground = None if parts is None else (parts[0].numpy(), parts[1].numpy())
    return solid.numpy(), near.numpy(), ground


def _object_on_ground(
    scene: Gaussians, up: Tensor, near: Rows, ground: tuple[Mask, Mask], in_middle: NDArray[np.floating]
) -> tuple[Rows, Rows, str]:
    """Return the rows of the object in the middle of a view, those of the ground, and the reason as text.

    Args:
        scene: N Gaussians
        up: world direction that is up. [3]
        near: solid rows. [M]
        ground: masks of the rows that stand, and of the ground between them. [M] each
        in_middle: visible weight of each Gaussian in the middle of the view. [N]
    """
    standing = near[ground[0]]
    beside = near[ground[1]]
    reason = "on a ground"
    for supports in range(_MAX_SUPPORTS + 1):
        height, plan = _heights_and_plan(scene.means[standing], up)
        places = torch.cat([plan, height[:, None]], dim=1)
        _, cell_of_row, objects = CellGrid.around(places).find_objects(places)
        groups = objects[cell_of_row].numpy()
        standing = standing[groups == np.bincount(groups, in_middle[standing]).argmax()]
        if supports == _MAX_SUPPORTS or len(standing) < MIN_GAUSSIANS:
            break
        parts = _split_support(*_heights_and_plan(scene.means[standing], up))
        if parts is None:
            break
        visible = in_middle[standing]
        if 2 * visible[parts[0].numpy()].sum() <= visible.sum():
            break  # the view shows the support itself, or strays above a lid
        beside = np.concatenate([beside, standing[parts[1].numpy()]])
        standing = standing[parts[0].numpy()]
        reason = f"on {format_count(supports + 1, 'support')} on a ground"
    return standing, beside, reason


def _object_and_floaters(scene: Gaussians, solid: Rows, in_middle: NDArray[np.floating]) -> tuple[Rows, Rows]:
    """Return the solid rows of the object in the middle of a view, and the rows apart from it.

    Rows apart are solid rows of other objects, and haze in cells of space that no solid row touches.

    Args:
        scene: N Gaussians, without a ground and a far background
        solid: solid rows
        in_middle: visible weight of each Gaussian in the middle of the view. [N]
    """
    places = scene.means[solid]
    if len(solid) < MIN_GAUSSIANS:
        return solid, np.zeros(0, np.int64)
    grid = CellGrid.around(places, typical_spacing(places))
    _, cell_of_row, objects = grid.find_objects(places)
    groups = objects[cell_of_row].numpy()
    is_object = groups == np.bincount(groups, in_middle[solid]).argmax()
    on = solid[is_object]
    outside = np.flatnonzero(grid.outside(scene.means, scene.means[on]))
    return on, np.union1d(solid[~is_object], outside)


def _split_support(height: Tensor, plan: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the rows above a support of an object, and the rows of the support's free surface. [R] bool each

    A support is the object's widest level, wider than everything above it and on all sides of it.

    Args:
        height, plan: see `_heights_and_plan`

    Returns:
        The two masks; None without a support.
    """
    cell = _plan_cells(plan)
    level = _widest_level(height, cell)
    if level is None:
        return None
    above = height > level + _STANDING_HEIGHT
    surface = (height - level).abs() <= _STANDING_HEIGHT
    wide = _covered_cells(cell[surface])
    covered = _covered_cells(cell[above])
    around = binary_dilation(covered, np.ones((3, 3))) & ~covered
    is_support = (
        int(above.sum()) >= MIN_GAUSSIANS
        and covered.sum() <= _MAX_COVERED_CELLS * wide.sum()
        and (wide & around).sum() >= _MIN_RIM_SHARE * around.sum()
    )
    return (above, surface & ~torch.from_numpy(covered.ravel())[cell]) if is_support else None


def _widest_level(height: Tensor, cell: Tensor) -> float | None:
    """Return the height at which rows cover most cells of the plan; None if all heights are equal. [R], [R]

    Empty levels are skipped. A thin object can be many thousand times as high as wide, with as many levels.
    """
    low, high = (float(quantile(height, share)) for share in (_GROUND_QUANTILE, 1.0))
    order = height.argsort()
    ascending = height[order].double().numpy()
    cells = cell[order].numpy()
    steps = np.unique(np.floor((ascending[ascending >= low] - low) / _STANDING_HEIGHT))
    steps = np.union1d(steps, steps + 1.0)
    levels = low + _STANDING_HEIGHT * steps
    levels = levels[levels < high]
    if not len(levels):
        return None
    starts = np.searchsorted(ascending, levels - _STANDING_HEIGHT)
    ends = np.searchsorted(ascending, levels + _STANDING_HEIGHT, side="right")
    areas = [len(np.unique(cells[start:end])) for start, end in zip(starts, ends, strict=True)]
    return float(levels[int(np.argmax(areas))])


def _plan_cells(plan: Tensor) -> Tensor:
    """Return each row's cell of the plan. [R,2] -> [R] int64"""
    cells = ((plan + 1.0) * 0.5 * _PLAN_CELLS).long().clamp(0, _PLAN_CELLS - 1)
    return cells[:, 0] * _PLAN_CELLS + cells[:, 1]


def _covered_cells(cell: Tensor) -> Mask:
    """Return the cells of the plan that hold a row. [R] -> [C,C]"""
    counts = torch.bincount(cell, minlength=_PLAN_CELLS**2)
    return (counts > 0).reshape(_PLAN_CELLS, _PLAN_CELLS).numpy()


def _with_hovering_parts(scene: Gaussians, neighborhood: Neighborhood, mask: Mask, beside: Rows) -> Mask:
    """Return a selection extended by near parts that touch neither it nor the background. [N]

    Such a part joins if it is nearer to the selection than to the background, and at most the selection's
    radius away.

    Args:
        scene: N Gaussians
        neighborhood: see `select_subject`
        mask: the selection. [N]
        beside: rows of the background
    """
    rows, parts = neighborhood.touching_parts(~mask)
    inside = np.flatnonzero(mask)
    if not (len(rows) and len(inside)):
        return mask
    count = int(parts.max()) + 1
    tied = np.zeros(count, bool)
    tied[parts[np.isin(rows, beside)]] = True
    free = ~tied[parts]
    rows = rows[free]
    parts = parts[free]
    points = scene.means.double().nan_to_num().numpy()
    radius = float(np.sqrt(points[inside].var(axis=0).sum()))
    gaps = np.full(count, np.inf)
    np.minimum.at(gaps, parts, PointTree(points[inside], 1).query(points[rows], 1)[0][:, 0])
    others = np.full(count, np.inf)
    if len(beside):
        np.minimum.at(others, parts, PointTree(points[beside], 1).query(points[rows], 1)[0][:, 0])
    joins = (gaps < others) & (gaps <= radius)
    joined = mask.copy()
    joined[rows[joins[parts]]] = True
    return joined


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
    sampled = inside[:: -(-len(inside) // OCCLUSION_SAMPLE)]
    clearance = _MIN_CLEARANCE * float(half[:2].min())
    best_score = -1.0
    view = (center, center + torch.tensor([float(half[0]), 0.0, 0.0]))
    for offset in torch.cartesian_prod(*[torch.linspace(-0.75, 0.75, 5)] * 2):
        candidate = center + half * torch.cat([offset, torch.tensor([0.2])])
        is_free = float((sampled - candidate).norm(dim=1).min()) > clearance
        for turn in range(12):
            angle = math.radians(30 * turn)
            back = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
            seen = visible_points(sampled - candidate, back, wide=1.0).sum() / len(sampled) + float(is_free)
            if float(seen) > best_score:
                best_score = float(seen)
                view = (candidate, candidate - float(half[:2].min()) * back)
    eye, target = view
    return middle + eye @ axes, middle + (target - torch.tensor([0.0, 0.0, 0.1 * float(half[2])])) @ axes


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
    parts = _split_ground(height, plan)
    return None if parts is None else parts[0]


def _split_ground(height: Tensor, plan: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the rows above a ground, and those of the ground in cells without them. [R] bool each

    Args:
        height, plan: see `_heights_and_plan`

    Returns:
        The two masks; None if there is no ground.
    """
    taken, cell, counts = torch.unique(_plan_cells(plan), return_inverse=True, return_counts=True)
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
        int(standing.sum()) >= MIN_GAUSSIANS
        and float((above < -_STANDING_HEIGHT).float().mean()) <= _MAX_SHARE_BELOW
        and float((above[lowest].abs() < _STANDING_HEIGHT).float().mean()) >= _MIN_GROUND_CELLS
        and float(covered.float().mean()) <= _MAX_COVERED_CELLS
    )
    return (standing, ~standing & ~covered[cell]) if on_ground else None


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
    boxes, box, objects = CellGrid.around(places).find_objects(places)
    size = torch.zeros(len(boxes)).index_add(0, objects, torch.ones(len(boxes)))
    return (size[objects] >= _MIN_OBJECT_SHARE * size.max())[box]
