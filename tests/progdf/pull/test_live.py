"""A live pull solves the problem of the course, and its edit in progress composes like a finished one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from progdf.compose.added import extend
from progdf.compose.composer import Composer
from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.gaussians import Gaussians, pack
from progdf.gdf.file import Gdf
from progdf.pull.course import Handle, pull
from progdf.pull.grips import MAX_GRIP_POINTS, connected_rows, grip_points, with_grips
from progdf.pull.live import (
    HandlePose,
    LivePull,
    edit_in_progress,
    has_kernels,
    warm_up,
    write_move,
    write_offsets,
)
from progdf.quaternions import rotation_matrices
from progdf.rasterize.cpu import compilation
from progdf.region import Region, whole_scene
from progdf.similarity import affine_motion, transform_rows
from progdf.tidy import Step, similarity, tidy
from tests.helpers.edits import painted
from tests.helpers.scenes import random_gaussians

LENGTH = 2.0


def bar(count: int = 1500, seed: int = 0) -> Gaussians:
    """Return Gaussians that fill a bar along x."""
    random = torch.Generator().manual_seed(seed)
    size = torch.tensor([LENGTH, 0.4, 0.4])
    means = (torch.rand(count, 3, generator=random) - 0.5) * size
    quats = torch.randn(count, 4, generator=random)
    return Gaussians(
        means=means,
        quats=quats,
        log_scales=torch.full((count, 3), -3.5),
        logit_opacities=torch.full((count,), 2.0),
        sh0=torch.rand(count, 3, generator=random) - 0.5,
        shN=0.1 * torch.randn(count, 3, 3, generator=random),
    )


def tip(scene: Gaussians) -> tuple[float, float, float]:
    x, y, z = scene.means[int(scene.means[:, 0].argmax())].tolist()
    return x, y, z


def handle_of(scene: Gaussians, by: tuple[float, float, float]) -> Handle:
    return Handle(whole_scene(scene), tip(scene), by, 0.8)


def settled(live: LivePull, by: tuple[float, float, float]) -> torch.Tensor:
    for _ in range(200):
        step = live.step(HandlePose.of_shifts(np.array([by])), 6)
        if step.is_settled:
            return step.offsets
    raise AssertionError("the pull does not settle")


def test_live_pull_ends_as_the_course_does() -> None:
    scene = bar()
    by = (0.1, 0.3, 0.0)
    handle = handle_of(scene, by)
    live = LivePull(scene, [handle])
    offsets = settled(live, by)
    course = pull(scene, [handle])
    both, at, of_course = np.intersect1d(live.members, course.region.members.numpy(), return_indices=True)
    assert len(both) == len(course.region.members)
    moved = offsets[at, :3] - course.offsets[-1][of_course, :3]
    assert float(moved.norm(dim=1).max()) < 0.02 * 0.3


def test_steps_return_to_rest() -> None:
    scene = bar()
    live = LivePull(scene, [handle_of(scene, (0.0, 0.0, 0.0))])
    settled(live, (0.2, 0.3, -0.1))
    offsets = settled(live, (0.0, 0.0, 0.0))
    assert float(offsets[:, :3].norm(dim=1).max()) < 0.01


def test_held_gaussians_are_no_members() -> None:
    scene = bar()
    left = scene.means[:, 0] < 0.6
    hold = Region("left", left.nonzero()[:, 0], left.float())
    live = LivePull(scene, [handle_of(scene, (0.0, 0.0, 0.0))], hold)
    assert not left[torch.from_numpy(live.members)].any()


def shifted(scene: Gaussians) -> Gdf:
    return tidy(scene, [Step("transform", whole_scene(scene), similarity((0.0, 0.5, 0.0)))], "moved")


@pytest.mark.parametrize("blend", ["adjust", "over", "sum"])
def test_edit_in_progress_adds_to_lower_layers(blend: str) -> None:
    scene = bar()
    moved = shifted(scene)
    live = LivePull(scene, [handle_of(scene, (0.0, 0.0, 0.0))])
    edit = edit_in_progress(scene, live.members, live.channels, "pulled")
    composer = Composer(scene, [moved, edit])
    layers = [Layer(moved), Layer(edit)]
    composer.update(layers, blend)
    before = composer.gaussians.means.clone()
    for by in ((0.1, 0.2, 0.0), (0.0, -0.2, 0.1)):
        offsets = live.step(HandlePose.of_shifts(np.array([by])), 20).offsets
        write_offsets(edit, offsets)
        composer.touch(edit)
        change = composer.update(layers, blend)
        assert np.array_equal(change.rows, live.members)
        added = composer.gaussians.means - before
        torch.testing.assert_close(added[torch.from_numpy(live.members)], offsets[:, :3], atol=1e-5, rtol=0)
        plain = compose_layers(scene, layers, blend)
        for name in ("means", "quats", "log_scales", "shN", "sh0"):
            assert torch.equal(getattr(plain, name), getattr(composer.gaussians, name)), name
        assert not len(composer.update(layers, blend).rows), "nothing was touched"


def test_finished_pull_adds_to_a_moved_and_recolored_scene() -> None:
    scene = bar()
    moved = shifted(scene)
    below = compose_layers(scene, [Layer(moved)], "adjust")
    course = pull(below, [handle_of(below, (0.0, 0.3, 0.0))])
    gdf = tidy(scene, [Step("pull", course.region, course=course)], "pulled")
    assert gdf.adds
    after = compose_layers(scene, [Layer(moved), Layer(gdf)], "adjust")
    expected = below.means[course.region.members] + course.offsets[-1][:, :3]
    torch.testing.assert_close(after.means[course.region.members], expected, atol=1e-3, rtol=0)


def test_grip_points_are_spread_around_the_handle() -> None:
    scene = bar()
    points = grip_points(scene, tip(scene), np.arange(len(scene)), 1.0)
    assert 1 < len(points) <= MAX_GRIP_POINTS
    assert tuple(points[0]) == tip(scene)
    away = np.linalg.norm(points - points[0], axis=1)
    assert away.max() <= 0.35
    assert away[1:].min() > 0.05
    alone = grip_points(scene, tip(scene), np.arange(len(scene)), 1e-6)
    assert len(alone) == 1


def test_turned_and_scaled_handle_ends_as_the_course_does() -> None:
    scene = bar()
    handle = replace(handle_of(scene, (0.0, 0.1, 0.0)), turn=(0.7, 0.0, 0.0), scale=1.5)
    handles, owners = with_grips(scene, [handle])
    assert len(handles) > 1
    assert not owners.any()
    assert {one.follows for one in handles[1:]} == {0}
    live = LivePull(scene, handles)
    count = len(handles)
    turns = np.tile([0.7, 0.0, 0.0], (count, 1))
    pose = HandlePose(np.tile([0.0, 0.1, 0.0], (count, 1)), turns, np.full(count, 1.5))
    step = live.step(pose, 2000)
    course = pull(scene, handles)
    both, at, of_course = np.intersect1d(live.members, course.region.members.numpy(), return_indices=True)
    assert len(both) == len(course.region.members)
    moved = step.offsets[at, :3] - course.offsets[-1][of_course, :3]
    assert float(moved.norm(dim=1).max()) < 0.01
    rotation = Rotation.from_rotvec([0.7, 0.0, 0.0]).as_matrix()
    near = np.linalg.norm(scene.means.numpy() - np.array(handle.point), axis=1) < 0.15
    arms = scene.means.numpy()[near] - np.array(handle.point)
    expected = np.array(handle.point) + np.array(handle.pull) + 1.5 * arms @ rotation.T
    rows = np.searchsorted(live.members, np.flatnonzero(near))
    found = scene.means.numpy()[near] + step.offsets[rows, :3].numpy()
    assert np.abs(found - expected).max() < 0.03


def test_connected_rows_leave_other_things_out() -> None:
    scene = bar(800)
    other = bar(800, seed=1)
    together = Gaussians(
        **{
            name: torch.cat([getattr(scene, name), getattr(other, name)])
            for name in vars(scene)
            if name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")
        }
    )
    together.means[800:, 1] += 3.0
    rows = connected_rows(together, np.array([0]))
    assert len(rows) > 700
    assert rows.max() < 800


def test_paint_follows_the_edit_in_progress() -> None:
    scene = random_gaussians(300, seed=5, sh_degree=1)
    logo = painted(scene, 25, 9, pushed=40)
    drawn, (extended,) = extend(scene, [logo])
    members = np.arange(100, 300)
    edit = edit_in_progress(drawn, members, 14 + 9, "pulled")
    composer = Composer(drawn, [extended, edit])
    layers = [Layer(extended), Layer(edit)]
    for seed in range(3):
        random = torch.Generator().manual_seed(seed)
        write_offsets(edit, 0.1 * torch.randn(200, 14 + 9, generator=random))
        composer.touch(edit)
        composer.update(layers, "adjust")
        plain = compose_layers(drawn, layers, "adjust")
        for name in ("means", "quats", "log_scales", "shN"):
            torch.testing.assert_close(getattr(composer.gaussians, name), getattr(plain, name))
        followed = composer.gaussians.means[300:] - compose_layers(drawn, layers[:1], "adjust").means[300:]
        assert followed.any()


def test_warm_up_marks_the_kernels_as_compiled(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(compilation, "kernel_cache", lambda: tmp_path)
    assert not has_kernels()
    warm_up()
    assert has_kernels()


_TURN = rotation_matrices(torch.tensor([[0.5, 0.5, -0.5, 0.5]], dtype=torch.float64))[0]
_MOVES = {
    "shift": torch.eye(3),
    "turn": _TURN,
    "turn and scale": 1.5 * _TURN,
    "stretch": torch.diag(torch.tensor([1.0, 2.0, 0.5])),
    "mirror": torch.diag(torch.tensor([-1.0, 1.0, 1.0])),
}


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("name", _MOVES)
def test_move_in_progress_equals_the_moved_rows(name: str, degree: int) -> None:
    random = torch.Generator().manual_seed(0)
    shN = torch.randn(50, (degree + 1) ** 2 - 1, 3, generator=random)
    scene = replace(random_gaussians(80)[torch.arange(50)], shN=shN)
    members = np.arange(10, 40)
    rows = pack(scene[torch.from_numpy(members)], with_shN=degree > 0)
    edit = edit_in_progress(scene, members, rows.shape[1], "moved")
    pivot = torch.tensor([0.1, -0.2, 0.3])
    turned = affine_motion(_TURN @ _TURN, torch.ones(3), pivot)
    motion = affine_motion(_MOVES[name], torch.tensor([3.0, -2.0, 0.5]), pivot)
    write_move(edit, rows, turned)  # a later move leaves nothing of an earlier one
    write_move(edit, rows, motion)
    moved = compose_layers(scene, [Layer(edit)])[torch.from_numpy(members)]
    expected = transform_rows(rows.double(), motion)
    torch.testing.assert_close(pack(moved, with_shN=degree > 0).double(), expected, rtol=1e-5, atol=1e-5)
