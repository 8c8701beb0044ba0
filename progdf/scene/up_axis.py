"""Up axis of a scene, from the user's choice, the cameras or the scene's shape.

The shape is evaluated for each axis, and for the normal of a tilted ground plane. Several kinds of evidence
and the usual conventions add up to a likelihood per direction, in nats.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.formats.ply_view import PlyView, stored_view
from progdf.gaussians import Gaussians
from progdf.gdf.file import fingerprint
from progdf.io.atomic import state_folder, write_file
from progdf.io.json_values import decode_json
from progdf.system.equality import equal_fields

from . import Axis
from .bounds import drop_background, front_direction, long_axes, normals_of
from .scene_cameras import scene_cameras_beside

MAX_REMEMBERED = 200
"""Number of scenes whose up axis is remembered; older entries are dropped."""


def find_chosen_up(scene: Gaussians) -> Tensor | None:
    """Return the up axis that the user chose for a scene earlier, or None. [3] unit length"""
    choices = _read_choices()
    numbers = choices.get(fingerprint(scene).means_sha256) if choices else None
    try:
        up = torch.tensor(numbers, dtype=torch.float32)
    except (TypeError, ValueError, RuntimeError):
        return None
    usable = up.shape == (3,) and bool(up.isfinite().all()) and float(up.norm()) > 1e-6
    return up / up.norm() if usable else None


def remember_chosen_up(scene: Gaussians, up: tuple[float, float, float]) -> None:
    """Remember the up axis chosen for a scene. A file that cannot be written is ignored."""
    key = fingerprint(scene).means_sha256
    remembered = {name: choice for name, choice in _read_choices().items() if name != key} | {key: list(up)}
    with contextlib.suppress(OSError):
        _choices_file().parent.mkdir(parents=True, exist_ok=True)
        write_file(_choices_file(), json.dumps(dict([*remembered.items()][-MAX_REMEMBERED:])))


def _read_choices() -> dict[str, object]:
    try:
        stored = decode_json(_choices_file().read_bytes())
    except (OSError, ValueError):
        return {}
    return stored if isinstance(stored, dict) else {}


def _choices_file() -> Path:
    return state_folder() / "up_axes.json"


AXES: tuple[Axis, ...] = get_args(Axis)

_LEVEL_COSINE = math.cos(math.radians(2.0))
"""Cosine of 2°. A mean camera up this close to an axis becomes that axis, as hand-held cameras are no
straighter."""

_AXIS_SHARES = {"-y": 0.66, "+y": 0.12, "+z": 0.10}
"""Share of 43 public captures with each axis up. The other three axes have 0.04 each."""

_MIN_ODDS = 6.0
"""Odds against the next direction, at least 45° away, from which the result is certain. They are more
than the convention alone can give."""

_MIN_REASON_NATS = 0.3
"""Smallest evidence in nats that is reported as a reason: a factor of 1.35."""

_WEIGHTS = {
    "vertical edges": 2.6,
    "symmetry": 2.0,
    "wider foot": 1.55,
    "blurred underside": 1.0,
    "faint strays below": 0.7,
    "ground plane": 20.0,
}
"""Weight in nats of each kind of evidence in `_Shape.evidence`. They come from a logistic regression over 21
public captures and the two demo scenes, which separates the up direction from the other five."""

_ROOM_EVIDENCE = 0.04
"""Ground plane evidence that, in all six directions, indicates a room. The other evidence assumes an object
seen from outside and is ignored there."""

_MAX_SAMPLED_ROWS = 20_000
"""Number of Gaussians in the even, deterministic sample."""

_SNAP_COSINE = math.cos(math.radians(5.0))
"""Cosine of 5°. A ground normal this close to an axis counts as that axis, because captured floors
are bent by up to this angle."""


@dataclass(frozen=True)
class UpAxis:
    """Up direction of a scene and the reason for it."""

    __eq__ = equal_fields

    direction: Tensor  # in the world, unit length. [3] float32
    reason: str  # text for the user, such as "from the cameras"
    certain: bool = True  # set by the user or cameras, or clear from the shape
    candidates: tuple[Tensor, ...] = ()  # all directions, likeliest first; only if the shape decided

    @property
    def name(self) -> str:
        """Name of the axis, such as "-y", or the three numbers of another direction."""
        return direction_name(self.direction)

    def to_json(self) -> dict[str, object]:
        """Return JSON values for reports and .gdf files."""
        return {"direction": [float(x) for x in self.direction], "reason": self.reason}


def axis_direction(axis: str) -> Tensor:
    """Return the unit vector of "+x" … "-z". [3] float32"""
    direction = torch.zeros(3)
    direction["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    return direction


def direction_name(direction: Tensor) -> str:
    """Return the axis along a unit vector, such as "-y", or else its three numbers. [3]"""
    axis = int(direction.abs().argmax())
    if float(direction.abs()[axis]) > 0.99999:
        return ("-" if float(direction[axis]) < 0 else "+") + "xyz"[axis]
    return " ".join(f"{round(float(x), 3) + 0.0:g}" for x in direction)  # + 0.0: not -0


def find_up(
    scene: Gaussians, cameras: Sequence[Camera] = (), choice: str = "auto", path: Path | None = None
) -> UpAxis:
    """Return the world direction that is up. The first of these decides:

    1. `choice`, unless it is "auto"
    2. the mean up of `cameras`, if they agree, as people hold cameras level
    3. the user's choice for this scene in an earlier session
    4. the header of the scene's .ply, then the camera stored in it
    5. cameras next to the file
    6. the shape of the scene

    Args:
        scene: N Gaussians
        cameras: requested together with the scene
        choice: one of `AXES`, or "auto"
        path: the scene's file
    """
    if choice != "auto":
        return UpAxis(axis_direction(choice), "set with --up")
    up = _mean_camera_up(cameras)
    if up is not None:
        return UpAxis(up, "from the cameras")
    chosen = find_chosen_up(scene)
    if chosen is not None:
        return UpAxis(chosen, "chosen for this scene earlier")
    view = PlyView() if path is None else stored_view(path, scene.origin)
    if view.up is not None:
        return UpAxis(_snap(view.up, _LEVEL_COSINE), f"from the comment '{view.up_comment}' in the file")
    up = None if view.camera is None else _mean_camera_up([view.camera])
    if up is not None:
        return UpAxis(up, "from the camera stored in the file")
    cameras_beside = [] if path is None or not len(scene) else scene_cameras_beside(path, scene)
    up = _mean_camera_up(cameras_beside)
    if up is not None:
        return UpAxis(up, f"from the {len(cameras_beside)} cameras beside the scene's file")
    return _up_by_shape(scene)


def guess_up(scene: Gaussians, cameras: Sequence[Camera] = ()) -> Tensor:
    """Return the direction of `find_up`. [3] float32, unit length"""
    return find_up(scene, cameras).direction


def _mean_camera_up(cameras: Sequence[Camera]) -> Tensor | None:
    """Return the mean up of cameras; None if there are none or they disagree. [3]"""
    if not cameras:
        return None
    mean = torch.stack([-camera.viewmat[1, :3] for camera in cameras]).mean(dim=0)
    return (
        _snap(torch.nn.functional.normalize(mean, dim=0), _LEVEL_COSINE) if float(mean.norm()) > 0.5 else None
    )


def _snap(direction: Tensor, cosine: float) -> Tensor:
    """Return the nearest axis if the cosine of its angle to `direction` exceeds `cosine`, else `direction`.

    direction: unit length. [3]
    """
    axis = direction.abs().argmax()
    if float(direction.abs()[axis]) <= cosine:
        return direction
    return torch.zeros(3).index_fill(0, axis, math.copysign(1.0, float(direction[axis])))


def _up_by_shape(scene: Gaussians) -> UpAxis:
    """Return the likeliest up direction by the scene's shape and by convention."""
    shape = _shape_of(scene)
    if shape is None:
        reason = "by convention, because the scene is too small to estimate it; set it with --up"
        axes_by_prior = sorted((axis_direction(axis) for axis in AXES), key=_log_prior, reverse=True)
        return UpAxis(axes_by_prior[0], reason, certain=False, candidates=tuple(axes_by_prior))
    directions = [axis_direction(axis) for axis in AXES]
    shape_signs = [shape.evidence(direction) for direction in directions]
    is_room = min(evidence["ground plane"] for evidence in shape_signs) >= _ROOM_EVIDENCE
    normal = _ground_normal(shape.places)
    if normal is not None:
        both = [shape.evidence(normal), shape.evidence(-normal)]
        planes = [evidence["ground plane"] for evidence in [*shape_signs, *both]]
        if planes[6] - planes[7] > max(abs(planes[i] - planes[i + 1]) for i in (0, 2, 4)):
            directions = [*directions, normal, -normal]
            shape_signs = [*shape_signs, *both]
    counted = ["ground plane"] if is_room else [*_WEIGHTS]
    terms = []
    for i, direction in enumerate(directions):
        signs = shape_signs[i] | {
            "ground plane": shape_signs[i]["ground plane"] - shape_signs[i ^ 1]["ground plane"]
        }
        term = {name: _WEIGHTS[name] * signs[name] for name in counted}
        terms.append(term | {"convention": _log_prior(direction)})
    totals = torch.tensor([sum(term.values()) for term in terms])
    likely = torch.softmax(totals, 0)
    order = likely.argsort(descending=True, stable=True).tolist()
    best = order[0]
    rival = next(i for i in order if float(directions[i] @ directions[best]) < math.sqrt(0.5))
    advantage = {name: value - terms[rival][name] for name, value in terms[best].items()}
    decisive = sorted(
        (name for name in advantage if abs(advantage[name]) >= _MIN_REASON_NATS),
        key=lambda n: -abs(advantage[n]),
    )
    reasons = ", ".join(f"{name} {advantage[name]:+.1f}" for name in decisive)
    other = direction_name(directions[rival])
    odds = float(likely[best] / likely[rival])
    reason = f"{100 * float(likely[best]):.0f} % likely; against {other}: {reasons}"
    # the convention alone never makes a direction certain: the shape must support it too
    certain = odds >= _MIN_ODDS and sum(advantage.values()) - advantage["convention"] >= _MIN_REASON_NATS
    if not certain:
        rival_percent = 100 * float(likely[rival])
        reason = (
            f"a guess, not certain: {reason}; {other} is {rival_percent:.0f} %: check it, or set it with --up"
        )
    candidates = tuple(directions[i] for i in order)
    return UpAxis(directions[best], reason, certain, candidates)


def _log_prior(direction: Tensor) -> float:
    """Return the log prior of a direction, that of its nearest axis, less 1 nat if it is slanted. [3]"""
    nearest = direction_name(_snap(direction, 0.0))
    return math.log(_AXIS_SHARES.get(nearest, 0.04)) - (float(direction.abs().max()) < _SNAP_COSINE)


@dataclass(frozen=True)
class _Shape:
    """Solid bulk of a scene, relative to its middle, in units of its radius."""

    __eq__ = equal_fields

    places: Tensor  # [Q,3]
    normals: Tensor  # shortest axes. [Q,3], unit length
    flatness: Tensor  # 1 for a disk, 0 for a ball or a needle. [Q]
    edges: Tensor  # longest axes. [Q,3], unit length
    edge_weights: Tensor  # visible elongated area, with sum 1. [Q]
    sizes: Tensor  # log of the longest axes. [Q]
    strays: Tensor  # positions of the large, faint Gaussians of the whole scene, clamped to ±5. [S,3]
    stray_weights: Tensor  # visible area, with sum S / (S + 100). [S]

    def evidence(self, up: Tensor) -> dict[str, float]:
        """Return the evidence for a direction, by the names of `_WEIGHTS`. [3]"""
        ahead = front_direction(up)
        side = torch.linalg.cross(up, ahead)
        height = self.places @ up
        plan = self.places @ torch.stack([ahead, side], dim=1)
        order = height.argsort()
        count = len(order)
        low = float(height[order[count // 200]])
        high = float(height[order[-1 - count // 200]])
        wide = (_quantiles(plan, 0.995) - _quantiles(plan, 0.005)).clamp_min(1e-6)
        band = 0.04 * max(high - low, 1e-6)
        foot = _extent(plan[height < low + band]) - _extent(plan[height > high - band])
        tenth = max(count // 10, 1)
        blurring = float(self.sizes[order[:tenth]].median() - self.sizes[order[-tenth:]].median())
        along = float(self.edge_weights[(self.edges @ up).abs() > 0.97].sum())
        angles = [math.pi * k / 6 for k in range(6)]
        level = max(self._symmetry(math.cos(angle) * ahead + math.sin(angle) * side) for angle in angles)
        return {
            "vertical edges": math.log(along + 0.02),
            "symmetry": level - self._symmetry(up),
            "wider foot": foot / float(wide.prod().sqrt()),
            "blurred underside": min(max(blurring, -1.5), 1.5),
            "faint strays below": -float((self.strays @ up) @ self.stray_weights),
            # a ground carries objects; a flat sheet is not a ground
            "ground plane": _ground_plane(
                height,
                (plan - _quantiles(plan, 0.02)) / wide,
                self.flatness * (self.normals @ up) ** 4 + 0.2 * (1 - self.flatness),
            )
            * min(1.0, 2 * (high - low) / float(wide.prod().sqrt())),
        }

    def _symmetry(self, normal: Tensor) -> float:
        """Return the overlap of the bulk with its mirror image across the middle plane, 0 to 1."""
        along = self.places @ normal
        ordered = along.sort().values
        middle = 0.5 * (ordered[len(along) // 50] + ordered[-1 - len(along) // 50])
        upright, mirrored = (
            _cell_counts(places).sqrt()
            for places in (self.places, self.places - 2 * (along - middle)[:, None] * normal)
        )
        return float(upright @ mirrored / (upright.norm() * mirrored.norm()))


def _shape_of(scene: Gaussians) -> _Shape | None:
    """Return the shape of a scene; None if too few Gaussians are solid."""
    solid = drop_background(scene)
    if solid is None:
        return None
    solid = solid[:: -(-len(solid) // _MAX_SAMPLED_ROWS)]
    middle = solid.means.median(dim=0).values
    places = solid.means - middle
    distances = places.norm(dim=1)
    radius = float(distances.sort().values[int(0.9 * len(distances))].clamp_min(1e-12))
    axes = solid.log_scales.sort(dim=1).values
    areas = axes[:, 1:].sum(dim=1).exp()
    areas = areas.clamp_max(float(areas.sort().values[int(0.9 * len(areas))]))
    elongated = solid.opacities * areas * (1 - (axes[:, 1] - axes[:, 2]).exp())
    sampled = scene[:: -(-len(scene) // (3 * _MAX_SAMPLED_ROWS))]
    sizes = sampled.log_scales.amax(dim=1).exp()
    is_stray = (sizes > 8 * sizes.median()) & (sampled.opacities < 0.5)
    weights = (sampled.opacities * sizes**2)[is_stray]
    return _Shape(
        places / radius,
        normals_of(solid),
        1 - (axes[:, 0] - axes[:, 1]).exp(),
        long_axes(solid),
        elongated / elongated.sum().clamp_min(1e-30),
        axes[:, 2] - math.log(radius),
        ((sampled.means[is_stray] - middle) / radius).clamp(-5.0, 5.0),
        weights / weights.sum().clamp_min(1e-30) * len(weights) / (len(weights) + 100),
    )


def _ground_plane(height: Tensor, plan: Tensor, facing: Tensor) -> float:
    """Return the score of the best slab across a direction, 0 to 1.

    The score is a product of three factors: the slab's share of the bulk, its share of the plan's cells, and
    the excess of the remainder above the slab over the remainder below it.

    Args:
        height: heights along the direction, in radii. [Q]
        plan: positions in the ground plan, 0 to 1. [Q,2]
        facing: weight of each Gaussian as a part of the slab. [Q]
    """
    slabs = 60
    cells = 10
    row = ((height + 1.5) / 0.05).long().clamp(0, slabs - 1)
    index = (plan * cells).long().clamp(0, cells - 1)
    cell = (row * cells + index[:, 0]) * cells + index[:, 1]
    table = torch.bincount(cell, minlength=slabs * cells**2).view(slabs, cells**2).float() / len(height)
    faced = torch.bincount(row, facing, minlength=slabs) / len(height)
    within = faced[:-1] + faced[1:]
    visible = table[:-1] + table[1:] > 0
    total = table.sum(dim=1).cumsum(0)
    below = torch.cat([torch.zeros(2), total[:-3]])  # excludes the row next to the slab
    above = 1 - torch.cat([total[2:], torch.ones(1)])
    side = (above - below) / (above + below).clamp_min(0.02)
    cover = visible.float().sum(dim=1) / (table.sum(dim=0) > 0).float().sum()
    return max(0.0, float((within * cover * side).max()))


def _ground_normal(places: Tensor) -> Tensor | None:
    """Return the upward normal of the plane that holds most of the bulk, with the remainder on one side.

    None if the normal is an axis already. [Q,3] -> [3]
    """
    sampled = places[:: max(1, len(places) // 2000)].double()
    draws = torch.from_numpy(np.random.default_rng(0).integers(0, len(sampled), (400, 3)))
    a, b, c = sampled[draws].unbind(1)
    normals = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=1)
    for _ in range(2):
        distances = sampled @ normals.T - (a * normals).sum(dim=1)
        within = (distances.abs() < 0.04).double().mean(dim=0)
        above, below = ((side > 0.08).double().mean(dim=0) for side in (distances, -distances))
        scores = within * (above - below).abs() / (above + below).clamp_min(0.02)
        best = int(scores.argmax())
        inside = sampled[distances[:, best].abs() < 0.04]
        a = inside.mean(dim=0)[None]
        normals = torch.linalg.svd(inside - a, full_matrices=False).Vh[2][None]
    up = normals[0].float() * (1.0 if float(above[best]) > float(below[best]) else -1.0)
    return None if float(up.abs().max()) > _SNAP_COSINE else up


def _quantiles(columns: Tensor, share: float) -> Tensor:
    ordered = columns.sort(dim=0).values
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]


def _extent(plan: Tensor) -> float:
    """Return the square root of the area that points fill, without strays. [P,2]"""
    if len(plan) < 6:
        return 0.0
    return float((_quantiles(plan, 0.95) - _quantiles(plan, 0.05)).prod().sqrt())


def _cell_counts(places: Tensor) -> Tensor:
    """Return the number of points in each cell of a centered grid of 20³ cells. [Q,3] -> [8000]"""
    cell = ((places + 2.5) * 4).long().clamp(0, 19)
    return torch.bincount((cell[:, 0] * 20 + cell[:, 1]) * 20 + cell[:, 2], minlength=8000).float()


def up_from_json(saved: object) -> Tensor | None:
    """Return the direction that `UpAxis.to_json` wrote, [3] unit length; None for anything else."""
    numbers = saved.get("direction") if isinstance(saved, dict) else None
    if not isinstance(numbers, list) or len(numbers) != 3:
        return None
    if not all(isinstance(x, (int, float)) and math.isfinite(x) and abs(x) < 1e6 for x in numbers):
        return None
    direction = torch.tensor([float(x) for x in numbers])
    return direction / direction.norm() if float(direction.norm()) > 1e-6 else None
