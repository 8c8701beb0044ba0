"""Recorded trajectory: exact ends, even visible change, robustness to jitter, round trips."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import identity_map
from progdf.field.trajectory import (
    Trajectory,
    load_trajectory,
    save_trajectory,
)
from progdf.io.tensors import write_tensors
from trainer.optimize.pgs import ParameterSnapshot
from trainer.optimize.retime import record, retime, select_recordings, smooth_course, straight_recordings
from trainer.options import Slider

CHANNELS = 14


def along(progress: list[float], stage_ends: list[int] | None = None, noise: float = 0.0) -> Trajectory:
    """Return a straight trajectory of three members, recorded at these shares; the original is added."""
    random = torch.Generator().manual_seed(0)
    end = torch.randn(3, CHANNELS, generator=random)
    ends = stage_ends or [len(progress)]
    snapshots = []
    for i, share in enumerate(progress):
        last = i + 1 in ends
        jitter = 0.0 if last else noise * torch.randn(3, CHANNELS, generator=random)
        snapshots.append(ParameterSnapshot(i + 1, last, (share * end + jitter).half(), {}))
    return record(snapshots, end, [(k + 1) / len(ends) for k in range(len(ends))])


def seen(offsets: Tensor) -> Tensor:
    """Return the visible change of offsets, here the offsets themselves."""
    return offsets.flatten()


def shown(trajectory: Trajectory) -> list[Tensor]:
    return [seen(trajectory.node(i)) for i in range(len(trajectory))]


def retimed(
    trajectory: Trajectory, slider: Slider = "stages", passes: int = 3, samples: int = 20
) -> Trajectory:
    return retime(trajectory, shown(trajectory), slider, passes, samples)


def even_chords(trajectory: Trajectory, steps: int = 20) -> Tensor:
    pictures = [seen(trajectory.at(i / steps)) for i in range(steps + 1)]
    return torch.stack([(b - a).abs().mean() for a, b in pairwise(pictures)])


def test_both_ends_are_exact_despite_half_precision() -> None:
    trajectory = along([0.2, 0.5, 1.0])
    assert not bool(trajectory.at(0.0).any())
    assert torch.equal(trajectory.at(1.0), trajectory.end)
    assert not torch.equal(trajectory.offsets[-1].float(), trajectory.end), (
        "half precision alone would not do"
    )


def test_path_between_two_recordings_is_straight() -> None:
    trajectory = along([0.5, 1.0])
    low = float(trajectory.s[1])
    high = float(trajectory.s[2])
    middle = trajectory.at(0.5 * (low + high))
    assert torch.allclose(middle, 0.5 * (trajectory.node(1) + trajectory.node(2)), atol=1e-6)


def test_retiming_makes_equal_slider_steps_look_equal() -> None:
    progress = [1 - (1 - i / 15) ** 4 for i in range(1, 16)]  # fast at first, slow at the end
    before = even_chords(along(progress))
    after = even_chords(retimed(along(progress)))
    assert float(before.min() / before.max()) < 0.05
    assert float(after.min() / after.max()) > 0.95


def test_jitter_does_not_count_as_change() -> None:
    progress = [i / 24 for i in range(1, 25)]
    noisy = along(progress, noise=0.02)
    arc = torch.cat([torch.zeros(1), _lengths(noisy).cumsum(0)])
    after = retimed(noisy)
    straight = (after.at(0.5) - 0.5 * after.end).abs().mean()
    assert float(straight) < 0.05
    assert float(arc[-1]) > 1.2 * float(noisy.end.abs().mean()), "the jitter is there"


def test_three_passes_are_more_even_than_one_with_jitter() -> None:
    noisy = along([1 - (1 - i / 20) ** 2 for i in range(1, 21)], noise=0.05)
    once, thrice = (even_chords(retimed(noisy, passes=passes), 6) for passes in (1, 3))
    assert float(thrice.min() / thrice.max()) > float(once.min() / once.max()) + 0.05


def test_chords_of_a_slider_step_are_robust_to_jitter() -> None:
    noisy = along([i / 60 for i in range(1, 61)], noise=0.02)
    ours, fine = (even_chords(retimed(noisy, "even", samples=samples)) for samples in (20, 60))
    assert float(ours.min() / ours.max()) > 0.7
    assert float(ours.min() / ours.max()) > float(fine.min() / fine.max()) + 0.05


@pytest.mark.parametrize("strengths", [(1.0,), (0.6, 1.0), (0.1, 0.35, 0.5, 0.8, 1.0)])
def test_smooth_path_meets_its_stages_and_reproduces_cubics(strengths: tuple[float, ...]) -> None:
    """Use a parabola for fewer than three stages."""
    random = torch.Generator().manual_seed(1)
    terms = (
        torch.randn(3, 3, CHANNELS, generator=random)
        * torch.tensor([1, 1, len(strengths) > 2])[:, None, None]
    )

    def offsets(s: float) -> Tensor:
        return s * terms[0] + s * s * terms[1] + s**3 * terms[2]

    def table(s: float) -> Tensor:
        return identity_map(2) + s * (1.0 - 0.4 * s) * torch.ones(10, 3)

    snapshots = [ParameterSnapshot(i + 1, True, offsets(s).half(), {}) for i, s in enumerate(strengths)]
    maps = torch.stack([table(s) for s in strengths])
    recorded = replace(record(snapshots, offsets(1.0), strengths), maps=maps, bands=1)
    smooth = smooth_course(recorded)
    if len(strengths) > 1:
        assert [float(smooth.s[end]) for end in smooth.stage_ends] == pytest.approx(strengths)
    assert smooth.maps is not None
    for i, s in enumerate(smooth.s.tolist()):
        torch.testing.assert_close(smooth.node(i), offsets(s), atol=4e-3, rtol=2e-3)
        if i:
            torch.testing.assert_close(smooth.maps[i - 1], table(s), atol=1e-5, rtol=1e-5)
    for index, end in enumerate(smooth.stage_ends, 1):
        assert torch.equal(smooth.node(end), recorded.node(index)), "stages are kept bit for bit"
    assert torch.equal(smooth_course(replace(recorded, maps=None)).offsets, recorded.offsets)


@pytest.mark.parametrize("jump", [1, 4, 8])
def test_smooth_path_does_not_ring_beside_a_jump(jump: int) -> None:
    strengths = [(i + 1) / 8 for i in range(8)]
    values = torch.tensor([0.0, *(float(i + 1 >= jump) for i in range(8))])[:, None].expand(-1, CHANNELS)
    snapshots = [ParameterSnapshot(i + 1, True, values[i + 1].expand(3, -1).half(), {}) for i in range(8)]
    maps = torch.stack([identity_map(1) + value[0] for value in values[1:]])
    recorded = replace(record(snapshots, values[-1].expand(3, -1), strengths), maps=maps, bands=1)
    smooth = smooth_course(recorded)
    offsets = torch.stack([smooth.node(i) for i in range(len(smooth))])
    assert -1e-3 <= float(offsets.min()) <= float(offsets.max()) <= 1 + 1e-3
    assert bool((offsets.diff(dim=0) >= -1e-3).all()), "it only rises"


def test_stage_ends_keep_their_strengths() -> None:
    progress = [0.01, 0.02, 0.05, 0.1, 0.3, 0.95, 1.0]
    trajectory = retimed(along(progress, [2, 4, 5, 7]), "stages")
    assert [float(trajectory.s[end]) for end in trajectory.stage_ends] == [0.25, 0.5, 0.75, 1.0]
    even = retimed(along(progress, [2, 4, 5, 7]), "even")
    assert float(even.s[even.stage_ends[0]]) == pytest.approx(0.02, abs=0.01)
    time = retimed(along(progress, [2, 4, 5, 7]), "time")
    assert torch.allclose(time.s, torch.linspace(0, 1, 8), atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-1.0, 2.0), min_size=1, max_size=12))
def test_slider_values_ascend_from_zero_to_one(progress: list[float]) -> None:
    trajectory = retimed(along([*progress, 1.0]))
    assert float(trajectory.s[0]) == 0.0
    assert float(trajectory.s[-1]) == 1.0
    assert bool((trajectory.s.diff() > 0).all())


def test_detours_are_dropped_and_stage_ends_stay() -> None:
    trajectory = along([0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0], [5, 10], noise=0.5)
    kept = select_recordings(trajectory, straight_recordings(trajectory, shown(trajectory)))
    assert len(kept) == 3
    assert kept.stage_ends == (1, 2)
    assert torch.equal(kept.node(1), trajectory.node(5))
    assert torch.equal(kept.end, trajectory.end)


def test_gentle_curve_keeps_its_recordings() -> None:
    angle = torch.linspace(0, 1.2, 12)
    offsets = torch.stack([angle.sin(), 1 - angle.cos()], dim=1)[:, None, :].repeat(1, 3, 7)
    snapshots = [ParameterSnapshot(i, i == 11, offsets[i].half(), {}) for i in range(1, 12)]
    curve = record(snapshots, offsets[-1], [1.0])
    assert len(straight_recordings(curve, shown(curve), detour=0.1)) > 6


def test_trajectory_round_trips_through_its_file(tmp_path: Path) -> None:
    trajectory = retimed(along([0.3, 0.6, 1.0], [1, 3]))
    extra = {"members": torch.tensor([3, 5, 8]), "score": torch.rand(10)}
    save_trajectory(tmp_path / "trajectory.safetensors", trajectory, extra, {"scene": "bär.ply"})
    found, tensors, about = load_trajectory(tmp_path / "trajectory.safetensors")
    assert torch.equal(found.s, trajectory.s)
    assert torch.equal(found.offsets, trajectory.offsets)
    assert torch.equal(found.end, trajectory.end)
    assert found.strengths == trajectory.strengths
    assert found.stage_ends == trajectory.stage_ends
    assert torch.equal(tensors["members"], extra["members"])
    assert torch.equal(tensors["score"], extra["score"])
    assert about == {"scene": "bär.ply"}


@pytest.mark.parametrize(
    "part", [("end", torch.zeros(2, CHANNELS)), ("s", torch.tensor([0.0, 0.9, 1.1])), ("s", torch.ones(3))]
)
def test_inconsistent_recordings_are_a_one_line_error(tmp_path: Path, part: tuple[str, Tensor]) -> None:
    trajectory = replace(along([0.5, 1.0]), **{part[0]: part[1]})
    save_trajectory(tmp_path / "trajectory.safetensors", trajectory, {}, {})
    with pytest.raises(ProgdfError, match=r"is damaged .*; train again"):
        load_trajectory(tmp_path / "trajectory.safetensors")


def test_trajectory_file_without_a_part_is_a_one_line_error(tmp_path: Path) -> None:
    path = tmp_path / "trajectory.safetensors"
    write_tensors(path, {"s": torch.zeros(2)}, {"format": "progdf-trajectory-1", "about": "{}"})
    with pytest.raises(ProgdfError, match="it has no offsets"):
        load_trajectory(path)


@pytest.mark.parametrize("content", [b"", b"no tensors", b"\x08\x00\x00\x00\x00\x00\x00\x00{}      "])
def test_invalid_trajectory_file_is_a_one_line_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "trajectory.safetensors"
    path.write_bytes(content)
    with pytest.raises(ProgdfError, match="; "):
        load_trajectory(path)


def _lengths(trajectory: Trajectory) -> Tensor:
    nodes = [trajectory.node(i) for i in range(len(trajectory))]
    return torch.stack([(b - a).abs().mean() for a, b in pairwise(nodes)])
