"""Recording of a trajectory: the choice of snapshots and their slider values.

The slider measures visible change, not time (docs/method.md 3). Equal slider steps change the pictures
equally, over the whole slider or between two pinned stages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from scipy.interpolate import CubicSpline
from torch import Tensor

from progdf.field.baked import interpolate, interpolate_at
from progdf.field.trajectory import Trajectory
from trainer.options import Slider

from .pgs import ParameterSnapshot

_MIN_GAP = 1e-4  # minimum distance of neighboring slider values


def resolve_slider(slider: Slider, strengths: Sequence[float]) -> Slider:
    """Return `slider`, with "auto" replaced by "stages" for several stage strengths, else by "even"."""
    if slider != "auto":
        return slider
    return "stages" if len(strengths) > 1 else "even"


def record(snapshots: Sequence[ParameterSnapshot], end: Tensor, strengths: Sequence[float]) -> Trajectory:
    """Build a trajectory with slider values proportional to the optimizer's steps.

    Args:
        snapshots: in order, in half precision; a recording of the original is added before them
        end: the last offsets in full precision. [M,C] float32
        strengths: strengths requested from the editor, one per stage
    """
    offsets = torch.stack([torch.zeros_like(snapshots[0].offsets), *(one.offsets for one in snapshots)])
    steps = torch.tensor([0, *(one.step for one in snapshots)])
    ends = tuple(i + 1 for i, one in enumerate(snapshots) if one.ends_stage)
    s = steps.float() / float(steps[-1])
    return Trajectory(s, offsets, end, steps, ends, tuple(strengths))


def smooth_weights(strengths: Sequence[float], known: Tensor) -> tuple[Tensor, Tensor]:
    """Return the given strengths with the middles between them, and the weights that interpolate each.

    A middle lies on the cubic spline through all values. If the spline deviates from the straight line by
    more than a quarter of the interval's change, the middle lies on the straight line: no monotone parabola
    deviates that far, so the spline is ringing, as beside a jump.

    Args:
        strengths: ascending. [n]
        known: values at these. [n,...]

    Returns:
        strengths [2n-1]; weights [2n-1,n], with a single 1 per row at the given strengths; float64
    """
    nodes = torch.tensor(strengths, dtype=torch.float64)
    unit = torch.eye(len(strengths), dtype=torch.float64)
    places = torch.stack([nodes, nodes + 0.5 * nodes.diff(append=nodes[-1:])], dim=1).flatten()[:-1]
    weights = torch.from_numpy(CubicSpline(nodes.numpy(), unit.numpy())(places.numpy()))
    weights[::2] = unit
    for left in range(len(nodes) - 1):
        straight = 0.5 * (unit[left] + unit[left + 1])
        bend = torch.tensordot((weights[2 * left + 1] - straight).to(known), known, 1)
        if float(bend.norm()) > 0.25 * float((known[left + 1] - known[left]).norm()):
            weights[2 * left + 1] = straight
    return places, weights


def smooth_course(trajectory: Trajectory) -> Trajectory:
    """Add a recording in the middle of every two stages of a color edit; return other trajectories unchanged.

    Map and residual are interpolated by a cubic spline, so only half as many strengths are solved for. Every
    recording lies at its strength.
    """
    if trajectory.maps is None or len(trajectory.strengths) == 1:
        return trajectory
    known = trajectory.nodes
    places, weights = smooth_weights((0.0, *trajectory.strengths), known)
    offsets = torch.stack([torch.tensordot(row.float(), known, 1).half() for row in weights])
    maps = torch.tensordot(weights.float(), trajectory.map_course[1], 1)
    return replace(
        trajectory,
        s=places.float(),
        offsets=offsets,
        steps=torch.arange(len(places)),
        stage_ends=tuple(range(2, len(places), 2)),
        maps=maps[1:],
    )


def retime(
    trajectory: Trajectory,
    pictures: Sequence[Tensor],
    slider: Slider = "stages",
    passes: int = 3,
    samples: int = 20,
) -> Trajectory:
    """Give every recording the slider value of its visible change.

    Change is measured by the chord between pictures. Arc length summed over recordings would count jitter.
    Each pass samples the trajectory at even slider values, measures the chords between the samples and
    stretches the slider accordingly. A chord spans one of 20 even slider steps, as a user makes them. Shorter
    chords count jitter that is invisible in such steps (a recolored robot's 20 steps: smallest over largest
    change 0.71 instead of 0.66; a bear's scarf 0.93 instead of 0.76, its hands 0.85).

    Args:
        trajectory: recordings with any slider values
        pictures: pictures of each recording, any fixed shape; interpolated linearly between recordings
        slider: "stages": even change between the stages' pinned strengths; "even": even change over the
            whole slider, nothing pinned; "time": the optimizer's steps; "auto": see `resolve_slider`
        passes: number of passes
        samples: chords over the whole slider; a pinned segment has its share, at least 3
    """
    slider = resolve_slider(slider, trajectory.strengths)
    if slider == "time":
        return replace(trajectory, s=_place_between(0.0, 1.0, trajectory.steps.double()).float())
    if slider == "stages":
        knots = [0, *trajectory.stage_ends]
        pins = [0.0, *trajectory.strengths]
    else:
        knots = [0, len(trajectory) - 1]
        pins = [0.0, 1.0]
    s = torch.zeros(len(trajectory), dtype=torch.float64)
    chords = _chords(pictures)
    spans = zip(pairwise(knots), pairwise(pins), strict=True)
    segments = [(slice(a, b + 1), low, high) for (a, b), (low, high) in spans]
    for nodes, low, high in segments:
        s[nodes] = _place_between(low, high, _cumulative(chords[nodes.start : nodes.stop - 1]))
    for _ in range(passes - 1):
        before = s.clone()
        for nodes, low, high in segments:
            count = max(3, round(samples * (high - low)))
            even = torch.linspace(low, high, count + 1, dtype=torch.float64)
            progress = _cumulative(_chords([interpolate_at(before, pictures, float(x)) for x in even]))
            s[nodes] = _place_between(low, high, interpolate(s[nodes], even, progress))
    return replace(trajectory, s=s.float())


def straight_recordings(
    trajectory: Trajectory, pictures: Sequence[Tensor], detour: float = 0.15
) -> list[int]:
    """Return the recordings without jitter: those that lengthen the path by at most `detour`.

    The recording with the largest detour is removed first, then its neighbors are measured again. The ends of
    the stages always stay. A gentle curve keeps its recordings. On a recolored robot this gains 0.7 dB on
    average against the editor's own pictures between the stages, with a third of the recordings.

    Args:
        trajectory: as recorded
        pictures: pictures of each recording, any fixed shape
        detour: maximum lengthening of the direct path by a recording, as a share, ≥ 0
    """
    nodes = list(range(len(trajectory)))
    fixed = {0, *trajectory.stage_ends}

    def length(a: int, b: int) -> float:
        return float((pictures[a] - pictures[b]).abs().mean())

    def excess(k: int) -> float:
        a, b, c = nodes[k - 1 : k + 2]
        return (length(a, b) + length(b, c)) / max(length(a, c), 1e-12) - 1.0

    cost = {k: excess(i) for i, k in enumerate(nodes) if k not in fixed}
    while cost:
        worst = max(cost, key=lambda k: cost[k])
        if cost[worst] <= detour:
            break
        index = nodes.index(worst)
        del nodes[index], cost[worst]
        for near in (index - 1, index):
            if nodes[near] in cost:
                cost[nodes[near]] = excess(near)
    return nodes


def select_recordings(trajectory: Trajectory, nodes: Sequence[int]) -> Trajectory:
    """Return the trajectory with these recordings only.

    They must be ascending and contain both ends and all stage ends.
    """
    rows = torch.tensor(nodes)
    return replace(
        trajectory,
        s=trajectory.s[rows],
        offsets=trajectory.offsets[rows],
        steps=trajectory.steps[rows],
        stage_ends=tuple(nodes.index(end) for end in trajectory.stage_ends),
    )


def _chords(pictures: Sequence[Tensor]) -> Tensor:
    """Return the mean absolute difference of neighbors. [n-1] float64"""
    pairs = pairwise(pictures)
    return torch.tensor([float((b - a).abs().mean()) for a, b in pairs], dtype=torch.float64)


def _cumulative(lengths: Tensor) -> Tensor:
    """Return the normalized cumulative lengths, 0 to 1; evenly spaced if all lengths are 0. [n] -> [n+1]"""
    total = float(lengths.sum())
    lengths = lengths if total > 0 else torch.ones_like(lengths)
    return torch.cat([lengths.new_zeros(1), lengths.cumsum(0) / lengths.sum()])


def _place_between(low: float, high: float, progress: Tensor) -> Tensor:
    """Return strictly ascending slider values from `low` to exactly `high`, spaced as `progress`.

    [n] -> [n]
    """
    gaps = progress.diff()
    gaps = gaps / float(gaps.sum()) * (high - low)
    gaps = gaps.clamp_min(min(_MIN_GAP, 0.5 * (high - low) / len(gaps)))
    rising = torch.cat([gaps.new_zeros(1), gaps.cumsum(0)])
    placed = low + (high - low) * rising / rising[-1]
    placed[-1] = high
    return placed
