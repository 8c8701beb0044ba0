"""Course of a pull: the region at several strengths along the handles' paths, each solved on its own.

A blend of both ends would shrink parts that turn. Here rigid parts stay rigid at every strength. A handle
that turns with its surroundings moves on an arc, otherwise on a straight line.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array, vstack
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import interpolate_at
from progdf.gaussians import Gaussians, pack
from progdf.quaternions import matrix_turns, rotation_matrices, turn_quats
from progdf.region import Region, from_mask
from progdf.system.equality import equal_fields

from .cuts import NO_CUTS, Cuts
from .follow import bind, follow, rest_frames, widen
from .graph import MAX_NODES, Floats, Mask, NodeGraph, Rows, build_graph
from .solve import Pose, Solver

MAX_PULL = 100.0
"""Largest pull, in diagonals of the scene."""
MAX_HANDLE_SCALE = 100.0
"""Largest scale of a handle, and largest inverse."""
Point = tuple[float, float, float]
_MIN_FRAME_NODES = 3  # connected nodes; fewer cannot be turned or scaled
_TOUCH_SIGMAS = 3.0  # standard deviations; a point on the region is at most so far from a Gaussian
_HELD_BELOW = 0.01  # falloff; nodes with less are held
_FALLOFF_STIFFNESS = 8.0  # stiffness of the falloff's springs, in edges per squared radius
_TRIAL_STRENGTHS = 4  # strengths of the solve that finds how far the handles turn
_KNOT_SPACING = 1 / 8  # rotation, radians, or log-stretch of the nodes between two strengths
_LARGEST_SHARE = 0.99  # quantile of the nodes' rotations and log-stretches that counts as the largest
_MIN_STRENGTHS = 4  # smallest number of solved strengths
_MAX_STRENGTHS = 24  # largest number of solved strengths
_STILL_NODE_SPACINGS = 1e-4  # a node that moves less, in node spacings, stays


@dataclass(frozen=True)
class Handle:
    """Point of a region, its displacement, and the rotation and scale of the surface around it."""

    region: Region  # the point pulls these Gaussians
    point: Point  # position relative to the origin of the scene, world units
    pull: Point  # displacement, world units
    falloff: float | None = None  # radius of the influence, world units; None: all that is connected
    turn: Point | None = None  # axis times angle in radians, below 2π; None: the surface rotates freely
    scale: float = 1.0  # above 0; other than 1 without a turn: the surface does not rotate
    follows: int | None = None  # index of a handle that this point shifts, turns and scales with

    @property
    def is_framed(self) -> bool:
        """True if the handle also gives the rotation and scale of the surface around it."""
        return self.turn is not None or self.scale != 1.0

    @property
    def moves(self) -> bool:
        """True if the handle moves, turns or scales anything."""
        return any(self.pull) or any(self.turn or ()) or self.scale != 1.0


@dataclass(frozen=True)
class PullCourse:
    """Offsets of a pulled region at several strengths."""

    __eq__ = equal_fields

    region: Region  # the M Gaussians that move
    strengths: Tensor  # from 0 to 1. [S]
    offsets: Tensor  # packed offsets from the scene, with higher bands if the scene has any. [S,M,C]
    node_count: int
    stretches: Tensor  # length of each edge at strength 1 per length at rest. [E]
    cut_count: int = 0  # number of links between Gaussians that cuts removed

    def offsets_at(self, strength: float) -> Tensor:
        """Return the packed offsets at a strength, linear between the solved ones. [M,C]"""
        return interpolate_at(self.strengths, self.offsets, strength)

    def describe(self) -> str:
        """Return the number of nodes and strengths, and the stretch of the edges, for the user."""
        text = f"{self.node_count} nodes, solved at {len(self.strengths) - 1} strengths"
        if self.cut_count:
            text = f"{text}, {self.cut_count} links cut"
        if not len(self.stretches):
            return text
        low, high = self.stretches.quantile(torch.tensor([0.01, 0.99], dtype=self.stretches.dtype)).tolist()
        return f"{text}, lengths times {low:.2f} to {high:.2f}"


@dataclass(frozen=True)
class Problem:
    """Graph and solver of a pull."""

    __eq__ = equal_fields

    members: Rows  # rows of the scene that the graph covers. [M]
    graph: NodeGraph
    held: Mask  # nodes that stay in place. [n]
    solver: Solver
    blends: csr_array  # weights of the nodes in each constrained point, the handles' points first. [P,n]
    points: Floats  # constrained points at rest. [P,3]
    owners: Rows  # handle of each constrained point; −1: pinned. [P]
    pulls: Floats  # displacements of the handles. [H,3]
    turns: Floats  # their rotation vectors, NaN if free. [H,3]
    scales: Floats  # [H]
    influence: Floats  # share of the handles' motion that each node may follow, 0 to 1. [n]

    def targets(self, pulls: Floats, turns: Floats, scales: Floats) -> Floats:
        """Return the positions of the constrained points. [P,3]

        Args:
            pulls: displacements of the handles. [H,3]
            turns: rotation vectors of the surfaces around them, without effect if free. [H,3]
            scales: factors of these surfaces, without effect if free. [H]
        """
        moving = self.owners >= 0
        owners = self.owners[moving]
        centers = self.points[: len(pulls)]
        rotations = rotation_matrices(turn_quats(torch.from_numpy(turns))).numpy()
        arms = self.points[moving] - centers[owners]
        turned = scales[owners, None] * np.einsum("pij,pj->pi", rotations[owners], arms)
        targets = self.points.copy()
        targets[moving] = centers[owners] + pulls[owners] + turned
        return targets

    def targets_at(self, strength: float, turns: Floats) -> Floats:
        """Return the targets on the way, for rotation vectors of the handles at strength 1. [H,3] -> [P,3]"""
        return self.targets(path(self.pulls, turns, strength), strength * turns, self.scales**strength)


def pull(
    scene: Gaussians,
    handles: Sequence[Handle],
    hold: Region | None = None,
    max_nodes: int = MAX_NODES,
    pins: Sequence[Point] = (),
    cuts: Cuts = NO_CUTS,
) -> PullCourse:
    """Return the course of pulled points.

    Args:
        scene: the original
        handles: at least one
        hold: Gaussians that stay as they are, bit for bit
        max_nodes: target number of nodes of the graph
        pins: points of the surface that stay, while it may rotate around them
        cuts: cuts between the Gaussians of the scene

    Raises:
        ProgdfError: a point is not on its region or is held, a pull is out of range, or nothing moves.
    """
    if not any(handle.moves for handle in handles):
        raise ProgdfError(f"the pull of the point {_world(scene, handles[0])} is 0; write how far it goes")
    problem = make_problem(scene, handles, hold, max_nodes, pins, cuts)
    strengths, poses = _solve_course(problem)
    graph = problem.graph
    kept = np.ones(len(scene), bool)
    if hold is not None:
        kept[hold.members.numpy()] = False
    moved_nodes = np.zeros(len(graph), bool)
    for pose in poses:
        moved_nodes |= (
            np.abs(pose.positions - graph.positions).max(axis=1) > _STILL_NODE_SPACINGS * graph.spacing
        )
    points = scene.means.detach().double().numpy()[problem.members]
    binding = bind(graph, points, graph.node_of)
    moves = (binding @ moved_nodes.astype(float) > 0.0) & kept[problem.members]
    members = problem.members[moves]
    if not len(members):
        raise ProgdfError(
            f"no Gaussian follows the pull of {_world(scene, handles[0])}; all near it are held, "
            "or several pulls of the same point cancel each other"
        )
    raw = pack(scene[torch.from_numpy(members)], with_shN=scene.sh_degree > 0).detach().float()
    kept_rows = np.flatnonzero(moves)
    wide = widen(graph, csr_array(binding[kept_rows]), raw, graph.node_of[kept_rows])
    frames = rest_frames(raw)
    offsets = torch.zeros(len(strengths), *raw.shape)
    for i, pose in enumerate(poses, start=1):
        packed, frames = follow(raw, wide, graph, pose, problem.solver.gradients(pose), frames)
        offsets[i] = packed - raw
    mask = torch.zeros(len(scene), dtype=torch.bool)
    mask[torch.from_numpy(members)] = True
    name = " + ".join(dict.fromkeys(handle.region.name for handle in handles))
    stretches = torch.from_numpy(problem.solver.stretches(poses[-1]))
    return PullCourse(
        from_mask(name, mask),
        torch.from_numpy(strengths).float(),
        offsets,
        len(graph),
        stretches,
        graph.cut_count,
    )


def make_problem(
    scene: Gaussians,
    handles: Sequence[Handle],
    hold: Region | None,
    max_nodes: int = MAX_NODES,
    pins: Sequence[Point] = (),
    cuts: Cuts = NO_CUTS,
) -> Problem:
    """Return the graph and the factorized solver of some handles.

    Args: see `pull`. A handle may have no displacement.

    Raises:
        ProgdfError: see `pull`.
    """
    means = scene.means.detach().double().numpy()
    nearest = _find_handles(scene, means, handles)
    points = np.array([handle.point for handle in handles], np.float64)
    members = _reachable_rows(means, handles)
    graph = build_graph(scene[torch.from_numpy(members)], max_nodes, cuts.of_rows(members))
    held_members = np.zeros(len(members), bool)
    if hold is not None:
        held_members = hold.mask.numpy()[members]
    at = np.searchsorted(members, nearest)
    for handle, row in zip(handles, at, strict=True):
        if held_members[row]:
            raise ProgdfError(f"the point {_world(scene, handle)} is held; pull a point outside --hold")
    nodes = graph.node_of[at]
    counts = np.bincount(graph.node_of, minlength=len(graph))
    held = 2 * np.bincount(graph.node_of, held_members, minlength=len(graph)) >= counts
    weights = _falloff_weights(graph, handles)
    held |= weights < _HELD_BELOW
    held |= ~np.isin(graph.part, graph.part[nodes])
    held[nodes] = False
    pinned = _pinned_rows(means, members, pins)
    pinned = pinned[~held[graph.node_of[pinned[:, 1]]]]
    pin_points = np.array(pins, np.float64).reshape(-1, 3)[pinned[:, 0]]
    blends = bind(graph, np.concatenate([points, pin_points]), np.append(nodes, graph.node_of[pinned[:, 1]]))
    leaders = [index if handle.follows is None else handle.follows for index, handle in enumerate(handles)]
    owners = np.append(np.array(leaders), np.full(len(pinned), -1))
    points = np.concatenate([points, pin_points])
    blends, points, owners = _add_frames(scene, graph, handles, blends, points, owners)
    solver = Solver(graph, blends, points, held, _springs(graph, handles, weights))
    pulls = np.array([handle.pull for handle in handles], np.float64)
    free = (math.nan, math.nan, math.nan)
    turns = [handle.turn or (0.0, 0.0, 0.0) if handle.is_framed else free for handle in handles]
    scales = np.array([handle.scale for handle in handles], np.float64)
    return Problem(
        members,
        graph,
        held,
        solver,
        blends=blends,
        points=points,
        owners=owners,
        pulls=pulls,
        turns=np.array(turns),
        scales=scales,
        influence=np.where(held, 0.0, weights),
    )


def _pinned_rows(means: Floats, members: Rows, pins: Sequence[Point]) -> Rows:
    """Return the pins on members, and the index of the nearest member of each. [K,2]

    Raises:
        ProgdfError: a number is not finite.
    """
    if not len(pins):
        return np.zeros((0, 2), np.int64)
    points = np.array(pins, np.float64)
    if not np.isfinite(points).all():
        raise ProgdfError("a number of a pin is not finite")
    nearest = np.array([np.square(means - point).sum(axis=1).argmin() for point in points])
    on_members = np.flatnonzero(np.isin(nearest, members))
    return np.stack([on_members, np.searchsorted(members, nearest[on_members])], axis=1)


def _add_frames(
    scene: Gaussians,
    graph: NodeGraph,
    handles: Sequence[Handle],
    blends: csr_array,
    points: Floats,
    owners: Rows,
) -> tuple[csr_array, Floats, Rows]:
    """Add the nodes around handles that turn or scale to the constrained points.

    Raises:
        ProgdfError: too few nodes are connected with such a handle.
    """
    parts = [blends]
    positions = [points]
    all_owners = [owners]
    sizes = np.bincount(graph.part)
    for index, handle in enumerate(handles):
        if not handle.is_framed:
            continue
        row = blends[[index]].tocoo()
        nodes = row.coords[1][row.data > 0.0].astype(np.int64)
        if sizes[graph.part[nodes[0]]] < _MIN_FRAME_NODES:
            raise ProgdfError(
                f"too few Gaussians are connected with {_world(scene, handle)} to turn or scale it; "
                "pull it without a turn, or use --rotate and --scale"
            )
        frame = csr_array(
            (np.ones(len(nodes)), (np.arange(len(nodes)), nodes)), shape=(len(nodes), len(graph))
        )
        parts.append(frame)
        positions.append(graph.positions[nodes])
        all_owners.append(np.full(len(nodes), index))
    return csr_array(vstack(parts)), np.concatenate(positions), np.concatenate(all_owners)


def _find_handles(scene: Gaussians, means: Floats, handles: Sequence[Handle]) -> Rows:
    """Return the row of the Gaussian nearest to each handle's point, in its region. [H]

    Raises:
        ProgdfError: a point is not on its region, or a number is out of range.
    """
    for handle in handles:
        _check_numbers(handle)
    largest = scene.scales.detach().double().amax(dim=1).numpy()
    extent = means.max(axis=0) - means.min(axis=0)
    diagonal = float(np.linalg.norm(extent)) + 2.0 * _TOUCH_SIGMAS * float(np.median(largest))
    parts = dict[int, tuple[Floats, float]]()  # by region: its points and their spacing
    nearest = []
    for handle in handles:
        _check_length(handle, diagonal)
        rows = handle.region.members.numpy()
        if id(handle.region) not in parts:
            points = means[rows]
            parts[id(handle.region)] = points, _point_spacing(points)
        points, spacing = parts[id(handle.region)]
        away = np.square(points - np.array(handle.point)).sum(axis=1)
        row = int(rows[away.argmin()])
        distance = math.sqrt(float(away.min()))
        allowed = max(_TOUCH_SIGMAS * float(largest[row]), spacing)
        if distance > allowed or (handle.falloff is not None and distance >= handle.falloff):
            there = ",".join(f"{value:.4g}" for value in means[row] + np.array(scene.origin))
            raise ProgdfError(
                f"the point {_world(scene, handle)} is {distance:.3g} from its region's Gaussians; "
                f"write a point on it, such as {there}"
            )
        nearest.append(row)
    return np.array(nearest)


def _check_numbers(handle: Handle) -> None:
    """Raise an error if a number is not finite, or a rotation or scale is out of range."""
    numbers = [*handle.point, *handle.pull, *(handle.turn or ()), handle.scale, handle.falloff or 0.0]
    if not all(math.isfinite(number) for number in numbers):
        raise ProgdfError("a number of a pull is not finite")
    if math.hypot(*(handle.turn or (0.0,))) >= 2.0 * math.pi:
        raise ProgdfError("a handle turns by less than 360°")
    if not 1.0 / MAX_HANDLE_SCALE <= handle.scale <= MAX_HANDLE_SCALE:
        raise ProgdfError(
            f"a handle scales by {1.0 / MAX_HANDLE_SCALE:g} to {MAX_HANDLE_SCALE:g}, not {handle.scale:g}"
        )
    if not len(handle.region):
        raise ProgdfError(f"the pulled region {handle.region.name} holds no Gaussian")


def _check_length(handle: Handle, diagonal: float) -> None:
    """Raise an error if a handle goes too far for the scene's diagonal."""
    length = math.hypot(*handle.pull)
    if length > MAX_PULL * diagonal:
        raise ProgdfError(
            f"a pull of {length:g} is more than {MAX_PULL:g} times the scene's diagonal of {diagonal:.3g}; "
            "pull less far"
        )


def _point_spacing(points: Floats) -> float:
    """Return the size of a part with as many points as a node has, from the extent of all."""
    extent = float(np.linalg.norm(points.max(axis=0) - points.min(axis=0)))
    return extent / math.sqrt(max(1, min(MAX_NODES, len(points))))


def _world(scene: Gaussians, handle: Handle) -> str:
    return ",".join(f"{value:.6g}" for value in np.array(handle.point) + np.array(scene.origin))


def _reachable_rows(means: Floats, handles: Sequence[Handle]) -> Rows:
    """Return the sorted rows that the pulls can move: the regions, up to the falloff of each handle. [M]"""
    covered: Mask = np.zeros(len(means), bool)
    for handle in handles:
        rows = handle.region.members.numpy()
        if handle.falloff is not None:
            rows = rows[np.linalg.norm(means[rows] - np.array(handle.point), axis=1) <= handle.falloff]
        covered[rows] = True
    return np.flatnonzero(covered)


def _falloff_weights(graph: NodeGraph, handles: Sequence[Handle]) -> Floats:
    """Return the influence of the handles on each node, 0 to 1, by Blender's smooth falloff. [n]"""
    weights = np.zeros(len(graph))
    for handle in handles:
        if handle.falloff is None:
            return np.ones(len(graph))
        distance = np.linalg.norm(graph.positions - np.array(handle.point), axis=1)
        share = (1.0 - distance / handle.falloff).clip(0.0, 1.0)
        weights = np.maximum(weights, share * share * (3.0 - 2.0 * share))
    return weights


def _springs(graph: NodeGraph, handles: Sequence[Handle], weights: Floats) -> Floats:
    """Return springs that hold the nodes as the falloff decreases, independent of the nodes' spacing. [n]"""
    radii = [handle.falloff for handle in handles if handle.falloff is not None]
    if len(radii) < len(handles):
        return np.zeros(len(graph))
    degree = np.bincount(graph.starts, minlength=len(graph))
    safe = np.maximum(weights, _HELD_BELOW)
    springs: Floats = _FALLOFF_STIFFNESS * (graph.spacing / min(radii)) ** 2 * degree * (1.0 - safe) / safe
    return springs


def _solve_course(problem: Problem) -> tuple[Floats, list[Pose]]:
    """Return the strengths [S] with 0, and the poses at all but the first."""
    is_free = np.isnan(problem.turns)
    straight = np.where(is_free, 0.0, problem.turns)
    trial = _solve_along(problem, straight, np.linspace(0.0, 1.0, 1 + _TRIAL_STRENGTHS))[-1]
    blended = (problem.blends[: len(straight)] @ trial.rotations.reshape(-1, 9)).reshape(-1, 3, 3)
    found = matrix_turns(torch.from_numpy(blended)).numpy()
    turns = np.where(is_free, found, straight)
    angles = matrix_turns(torch.from_numpy(trial.rotations)).norm(dim=1)
    largest = max(float(angles.quantile(_LARGEST_SHARE)), float(np.linalg.norm(straight, axis=1).max()))
    stretches = problem.solver.stretches(trial)
    if len(stretches):
        largest = max(largest, float(np.quantile(np.abs(np.log(stretches.clip(1e-6))), _LARGEST_SHARE)))
    count = min(max(math.ceil(largest / _KNOT_SPACING), _MIN_STRENGTHS), _MAX_STRENGTHS)
    strengths = np.linspace(0.0, 1.0, 1 + count)
    return strengths, _solve_along(problem, turns, strengths)


def _solve_along(problem: Problem, turns: Floats, strengths: Floats) -> list[Pose]:
    """Return the poses at all strengths but the first, for handles that turn on their way. turns: [H,3]"""
    last = problem.solver.rest()
    start = last
    poses = []
    for strength in strengths[1:]:
        pose = problem.solver.solve(problem.targets_at(float(strength), turns), start)
        onward = pose.rotations @ np.swapaxes(last.rotations, 1, 2) @ pose.rotations
        start = Pose(2.0 * pose.positions - last.positions, onward)  # the same step once more
        last = pose
        poses.append(pose)
    return poses


def path(pulls: Floats, turns: Floats, strength: float) -> Floats:
    """Return displacements on screw motions, which are arcs, or straight lines without a turn. [H,3]

    Args:
        pulls: displacements at strength 1. [H,3]
        turns: rotation vectors of the whole way, shorter than 2π. [H,3]
        strength: 0 to 1
    """
    velocities = np.linalg.solve(_screw(turns), pulls[:, :, None])
    displaced: Floats = (_screw(strength * turns) @ velocities)[:, :, 0] * strength
    return displaced


def _screw(turns: Floats) -> Floats:
    """Return the matrices from the velocity of a screw motion to its displacement. [H,3] -> [H,3,3]"""
    angle = np.maximum(np.linalg.norm(turns, axis=1), 1e-6)[:, None, None]
    x, y, z = turns.T
    zero = np.zeros(len(turns))
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    first = (1.0 - np.cos(angle)) / angle**2
    second = (angle - np.sin(angle)) / angle**3
    matrices: Floats = np.eye(3) + first * cross + second * (cross @ cross)
    return matrices
