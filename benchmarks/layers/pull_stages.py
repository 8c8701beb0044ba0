"""The benchmark `pull-stages`: time of each stage of a pull, by number of Gaussians and nodes.

A tube of small Gaussians is held at one end and bent by a handle at the other.

    python -m benchmarks pull-stages
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from benchmarks.table import Table
from progdf.gaussians import Gaussians, pack
from progdf.pull.course import Handle, Problem, make_problem
from progdf.pull.follow import Binding, bind, follow, rest_frames, widen
from progdf.pull.solve import DRAG_ROUNDS, Pose
from progdf.region import from_mask, whole_scene

CASES = ((1000, 500), (30_000, 500), (30_000, 1500), (300_000, 500), (300_000, 1500), (1_000_000, 1500))
"""Gaussians, and target number of nodes."""
STEPS = 60
"""Steps of the drag."""
_REPEATS = 5  # of a stage
_LENGTH = 4.0  # of the tube, world units
_RADIUS = 0.35  # of the tube, world units
_HELD_LENGTH = 0.4  # of the tube, world units
_SH_DEGREE = 3


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure every case."""
    columns = (
        "Gaussians",
        "nodes",
        "graph and factors, once, ms",
        "binding, once, ms",
        "step of a drag, ms",
        "settled, ms",
        "apply, ms",
        "apply with 3 SH bands, ms",
        "behind the settled pose, %",
        "edges p1 / p99",
    )
    return [
        Table(
            "pull-stages",
            "Stages of a pull",
            columns,
            tuple(_measure(count, nodes) for count, nodes in CASES),
            "Medians of processor time. The Gaussians follow on all cores, the rest runs on one. A tube "
            f"is bent by 90° in {STEPS} steps of {DRAG_ROUNDS} rounds each. Settled: the last step until "
            "no node moves. Behind: distance of the dragged nodes from the settled ones at the end, in "
            "lengths of the tube. Edges: their lengths when settled, per length at rest.",
        )
    ]


def tube(count: int) -> Gaussians:
    """Return a tube along x of flat Gaussians, which cover it evenly. [count]"""
    index = torch.arange(count, dtype=torch.float64)
    angle = index * math.pi * (3.0 - math.sqrt(5.0))
    x = (index + 0.5) / count * _LENGTH
    means = torch.stack([x, _RADIUS * angle.cos(), _RADIUS * angle.sin()], dim=1).float()
    half = 0.5 * angle
    quats = torch.stack([half.cos(), half.sin(), 0.0 * half, 0.0 * half], dim=1).float()
    spacing = math.sqrt(2.0 * math.pi * _RADIUS * _LENGTH / count)
    scales = torch.tensor([0.7 * spacing, 0.1 * spacing, 0.7 * spacing]).log()
    bands = torch.full((count, (_SH_DEGREE + 1) ** 2 - 1, 3), 0.05)
    return Gaussians(
        means, quats, scales.expand(count, 3), torch.full((count,), 3.0), torch.full((count, 3), 0.2), bands
    )


def bent_tube(scene: Gaussians, nodes: int) -> Problem:
    """Return the pull of the tube's free end; the other end is held."""
    tip = scene.means[-1]
    x, y, z = tip.tolist()
    # a quarter of a circle as long as the tube
    radius = 2.0 * _LENGTH / math.pi
    handle = Handle(whole_scene(scene), (x, y, z), (radius - _LENGTH, radius, 0.0))
    held = from_mask("held", scene.means[:, 0] < _HELD_LENGTH)
    return make_problem(scene, [handle], held, nodes)


def _measure(count: int, nodes: int) -> tuple[str, ...]:
    scene = tube(count)
    begin = time.process_time()
    problem = bent_tube(scene, nodes)
    graph_s = time.process_time() - begin
    graph = problem.graph
    solver = problem.solver
    begin = time.process_time()
    centers = bind(graph, scene.means.double().numpy()[problem.members], graph.node_of)
    rows = pack(scene)[torch.from_numpy(problem.members)]
    binding = widen(graph, centers, rows, graph.node_of)
    binding_s = time.process_time() - begin
    turns = np.where(np.isnan(problem.turns), 0.0, problem.turns)
    pose = solver.solve(problem.points, solver.rest())
    steps = []
    for step in range(1, 1 + STEPS):
        targets = problem.targets_at(step / STEPS, turns)
        begin = time.process_time()
        pose = solver.solve(targets, pose, DRAG_ROUNDS)
        steps.append(time.process_time() - begin)
    begin = time.process_time()
    settled = solver.solve(targets, pose)
    settled_s = time.process_time() - begin
    lag = float(np.linalg.norm(settled.positions - pose.positions, axis=1).max()) / _LENGTH
    low, high = np.quantile(solver.stretches(settled), [0.01, 0.99])
    applied = [_apply_ms(problem, scene, binding, settled, with_bands) for with_bands in (False, True)]
    return (
        str(count),
        str(len(graph)),
        f"{1e3 * graph_s:.0f}",
        f"{1e3 * binding_s:.0f}",
        f"{1e3 * statistics.median(steps):.2f}",
        f"{1e3 * settled_s:.1f}",
        f"{applied[0]:.2f}",
        f"{applied[1]:.2f}",
        f"{100.0 * lag:.2f}",
        f"{low:.3f} / {high:.3f}",
    )


def _apply_ms(problem: Problem, scene: Gaussians, binding: Binding, pose: Pose, with_bands: bool) -> float:
    """Return the time in which the Gaussians follow the nodes, ms."""
    rows = pack(scene, with_shN=with_bands)[torch.from_numpy(problem.members)]
    frames = rest_frames(rows)
    gradients = problem.solver.gradients(pose)
    moved, _ = follow(rows, binding, problem.graph, pose, gradients, frames)

    def once() -> None:
        follow(rows, binding, problem.graph, pose, problem.solver.gradients(pose), frames, moved)

    return _median_ms(once)


def _median_ms(work: Callable[[], None]) -> float:
    times = []
    for _ in range(_REPEATS):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return 1e3 * statistics.median(times)
