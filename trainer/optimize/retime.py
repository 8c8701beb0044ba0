"""Recording a trajectory: which snapshots stay, and at which slider value each of them lies.

The slider is visible change, not time (docs/method.md 3): equal steps of it change the pictures
equally, over the whole slider or between two stages that are pinned.
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

_MIN_GAP = 1e-4  # slider values of neighboring recordings stay apart by this


def resolve_slider(slider: Slider, strengths: Sequence[float]) -> Slider:
    """What slider values mean, given the strengths of the stages."""
    if slider != "auto":
        return slider
    return "stages" if len(strengths) > 1 else "even"


def record(snapshots: Sequence[ParameterSnapshot], end: Tensor, strengths: Sequence[float]) -> Trajectory:
    """Build a trajectory, its slider values still even in time.

    Args:
        snapshots: in order, in half precision; the original is added before them
        end: the last offsets in full precision. [M,C] float32
        strengths: what the editor was asked for, of each stage
    """
    offsets = torch.stack([torch.zeros_like(snapshots[0].offsets), *(one.offsets for one in snapshots)])
    steps = torch.tensor([0, *(one.step for one in snapshots)])
    ends = tuple(i + 1 for i, one in enumerate(snapshots) if one.ends_stage)
    s = steps.float() / float(steps[-1])
    return Trajectory(s, offsets, end, steps, ends, tuple(strengths))


def smooth_weights(strengths: Sequence[float], known: Tensor) -> tuple[Tensor, Tensor]:
    """The way through what is known at some strengths: these and the middles between them, and of which
    weights of the known each consists. A middle lies on the cubic through all; but on the straight line where
    the cubic is off that by more than a quarter of the interval's change, as no parabola is that only rises:
    there it rings, as beside a jump.

    Args:
        strengths: ascending. [n]
        known: the values there. [n,...]

    Returns:
        Strengths [2n-1], and weights [2n-1,n] with rows of one 1 at the given strengths; float64
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
    """A recording more between each two stages of an edit of colors, map and residual on the cubic through
    them, so that half as many are solved for; any other as it is. Each lies at its strength."""
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
    """Give every recording the slider value at which its visible change is due.

    The chord length between pictures is what counts: arc length summed over recordings would count jitter.
    Each pass samples the trajectory at even slider values, measures the chords between the samples and
    stretches the slider accordingly. Chords are as long as the steps that a user makes: shorter ones count
    jitter that no step shows (a recolored robot's 20 steps: least over largest .71 instead of .66; a bear's
    scarf .93 instead of .76, its hands .85).

    Args:
        trajectory: recordings with any slider values
        pictures: what is seen of each, any fixed shape; between two recordings it is taken to go straight
        slider: "stages": even change between the stages' pinned strengths; "even": over the whole slider,
            nothing pinned; "time": the optimizer's steps; "auto": see `resolve_slider`
        passes: how often to repeat
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
    """All but those that are jitter: by which the way is longer than past them by more than `detour`.

    The worst goes first and its neighbors are looked at anew; the stages' ends always stay. A gentle curve
    keeps its recordings. On a recolored robot this is worth 0.7 dB in the mean against the editor's own
    pictures between the stages, and a third of the recordings suffice.

    Args:
        trajectory: as recorded
        pictures: what is seen of each recording, any fixed shape
        detour: share of the direct way that a recording may cost, ≥ 0
    """
    nodes = list(range(len(trajectory)))
    fixed = {0, *trajectory.stage_ends}

    def length(a: int, b: int) -> float:
        return float((pictures[a] - pictures[b]).abs().mean())

    def excess(k: int) -> float:
        a, b, c = nodes[k - 1 : k + 2]
        return (length(a, b) + length(b, c)) / max(length(a, c), 1e-12) - 1.0

    cost = {k: excess(i) for i, k in enumerate(nodes) if k not in fixed}
    while cost and cost[worst := max(cost, key=lambda k: cost[k])] > detour:
        index = nodes.index(worst)
        del nodes[index], cost[worst]
        for near in (index - 1, index):
            if nodes[near] in cost:
                cost[nodes[near]] = excess(near)
    return nodes


def select_recordings(trajectory: Trajectory, nodes: Sequence[int]) -> Trajectory:
    """These recordings alone; ascending, both ends and the stages' ends among them."""
    rows = torch.tensor(nodes)
    return replace(
        trajectory,
        s=trajectory.s[rows],
        offsets=trajectory.offsets[rows],
        steps=trajectory.steps[rows],
        stage_ends=tuple(nodes.index(end) for end in trajectory.stage_ends),
    )


def _chords(pictures: Sequence[Tensor]) -> Tensor:
    """Mean absolute difference of neighbors. [n-1] float64"""
    pairs = pairwise(pictures)
    return torch.tensor([float((b - a).abs().mean()) for a, b in pairs], dtype=torch.float64)


def _cumulative(lengths: Tensor) -> Tensor:
    """0 … 1 along the lengths; even where all are 0. [n] -> [n+1]"""
    total = float(lengths.sum())
    lengths = lengths if total > 0 else torch.ones_like(lengths)
    return torch.cat([lengths.new_zeros(1), lengths.cumsum(0) / lengths.sum()])


def _place_between(low: float, high: float, progress: Tensor) -> Tensor:
    """Slider values from `low` to `high`, both exact, strictly ascending as `progress` does. [n] -> [n]"""
    gaps = progress.diff()
    gaps = gaps / float(gaps.sum()) * (high - low)
    gaps = gaps.clamp_min(min(_MIN_GAP, 0.5 * (high - low) / len(gaps)))
    rising = torch.cat([gaps.new_zeros(1), gaps.cumsum(0)])
    placed = low + (high - low) * rising / rising[-1]
    placed[-1] = high
    return placed
