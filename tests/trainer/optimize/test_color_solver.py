"""Edits of colors alone are solved for: pictures are linear in the members' colors."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians, pack
from progdf.rasterize import activate, render, set_threads
from progdf.rasterize.cpu.engine import color_map
from progdf.region import Region
from progdf.sh import rgb_to_sh0
from tests.helpers.scenes import random_gaussians
from trainer.optimize.color_solver import iterations, make_solver, solve
from trainer.optimize.pgs import ParameterSnapshot, PgsState, TargetStage
from trainer.optimize.unseen import UnseenMembers
from trainer.options import QUICK_STEPS
from trainer.setup import unresolved_share
from trainer.views.crops import CropScene, crop_scene, render_all

WHITE = torch.ones(3)


def orbit(count: int, size: int) -> list[Camera]:
    """Cameras around the origin at distance 4, one of them from above."""
    cameras = []
    for i in range(count):
        angle = torch.tensor(2 * torch.pi * i / count)
        eye = torch.stack([4 * angle.cos(), torch.tensor(1.0 + i % 2), 4 * angle.sin()])
        viewmat = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        cameras.append(Camera(viewmat, intrinsics(0.6, size, size), size, size))
    return cameras


def dense_ball(count: int = 3000, bands: int = 0) -> Gaussians:
    """An opaque ball of many small Gaussians in all colors."""
    rng = torch.Generator().manual_seed(3)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count, 3), 0.05).log(),
        torch.full((count,), 2.0),
        rgb_to_sh0(0.2 + 0.6 * torch.rand(count, 3, generator=rng)),
        0.1 * torch.randn(count, bands, 3, generator=rng),
    )


def prepared(scene: Gaussians, cameras: list[Camera]) -> tuple[list[CropScene], Tensor]:
    members = torch.arange(len(scene))
    crops = [crop_scene(scene, members, c, (0, 0, c.width, c.height), WHITE, still=True) for c in cameras]
    return crops, pack(scene, with_shN=scene.sh_degree > 0)


def solved(scene: Gaussians, edited: Gaussians, cameras: list[Camera], steps: int) -> Tensor:
    """Offsets of the edit of `scene` whose pictures are those of `edited`."""
    crops, original = prepared(scene, cameras)
    targets = render_all(crops, pack(edited, with_shN=scene.sh_degree > 0))
    solver = make_solver(crops, original, scene.sh_degree > 0)
    found: list[ParameterSnapshot] = list(
        solve(
            original, solver, [TargetStage(1.0, targets, steps)], PgsState(original), lambda step, left: None
        )
    )
    return found[-1].offsets


def psnr(scene: Gaussians, edited: Gaussians, offsets: Tensor, cameras: list[Camera]) -> float:
    crops, original = prepared(scene, cameras)
    wide = scene.sh_degree > 0
    pairs = zip(render_all(crops, original + offsets), render_all(crops, pack(edited, wide)), strict=True)
    return float(-10 * torch.stack([(a - b).square().mean() for a, b in pairs]).mean().log10())


def test_a_color_map_draws_and_differentiates_as_the_rasterizer_does() -> None:
    scene = random_gaussians(400, seed=2)
    scene = replace(scene, means=0.4 * scene.means / scene.means.norm(dim=1).max())
    camera, window = orbit(3, 80)[1], (7, 3, 77, 61)
    rows = torch.arange(0, 400, 3)
    colors = torch.zeros(400, 3)
    colors[rows] = torch.rand(len(rows), 3, generator=torch.Generator().manual_seed(5))
    colors.requires_grad_()
    image = render(scene, camera, (0.0, 0.0, 0.0), colors=colors, crop=window).image
    pull = torch.randn(image.shape, generator=torch.Generator().manual_seed(6))
    (image * pull).sum().backward()  # type: ignore[no-untyped-call]
    weighed = color_map(activate(scene), camera, window, rows)
    assert float(image.detach().amax()) > 0.1
    # float32 sums in another order
    torch.testing.assert_close(weighed.picture(colors.detach()[rows]), image.detach(), atol=2e-5, rtol=0)
    assert colors.grad is not None
    torch.testing.assert_close(weighed.gradient(pull), colors.grad[rows], atol=2e-4, rtol=1e-4)


def test_members_smaller_than_a_pixel_learn_their_color() -> None:
    scene = dense_ball(6000)
    edited = replace(scene, sh0=scene.sh0.flip(1) + 0.3)
    cameras = orbit(6, 40)
    region = Region("all", torch.arange(len(scene)), torch.ones(len(scene)))
    assert unresolved_share(scene, region, cameras, 40, 6) > 0.5
    offsets = solved(scene, edited, cameras, 30)
    assert psnr(scene, edited, offsets, cameras) > 35.0
    assert not bool(offsets[:, :11].any())


def test_a_color_below_zero_is_reached_through_clamps_that_lead_back() -> None:
    scene = dense_ball(500)
    dark = replace(scene, sh0=rgb_to_sh0(torch.full((500, 3), -0.2)))
    crops, original = prepared(dark, orbit(3, 32))
    targets = render_all(crops, pack(scene, with_shN=False))
    solver, state = make_solver(crops, original, False), PgsState(original)
    *_, last = solve(original, solver, [TargetStage(1.0, targets, 5)], state, lambda step, left: None)
    assert bool(last.offsets.any())
    rows = original.clone().requires_grad_()
    image, _ = crops[0].render(rows, ["sh0"])
    (image - targets[0]).abs().mean().backward()  # type: ignore[no-untyped-call]
    assert rows.grad is not None
    assert bool(rows.grad.any())


def test_higher_bands_turn_with_dc_where_views_are_few() -> None:
    """Red and blue are exchanged: half the bands' old colors would be left where two views do not look."""
    scene = dense_ball(1200, bands=8)
    edited = replace(scene, sh0=scene.sh0.flip(1), shN=scene.shN.flip(2))
    cameras = orbit(8, 64)
    offsets = solved(scene, edited, [cameras[0], cameras[4]], 30)
    held = offsets.clone()
    held[:, 14:] = 0.0
    found = [psnr(scene, edited, o, cameras[1:2]) for o in (offsets, held)]
    assert found[0] > found[1] + 2.0


def test_what_was_stopped_goes_on_to_the_same_bits() -> None:
    scene = dense_ball(300)
    crops, original = prepared(scene, orbit(3, 40))
    targets = render_all(crops, pack(replace(scene, sh0=-scene.sh0), with_shN=False))
    stages = [TargetStage(0.5, targets, 4), TargetStage(1.0, targets, 6)]
    solver = make_solver(crops, original, trained_bands=False)
    whole = PgsState(original)
    list(solve(original, solver, stages, whole, lambda step, left: None))
    stopped, again = PgsState(original), PgsState(original)

    def stop(step: int, left: float) -> None:
        if step == 7:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        list(solve(original, solver, stages, stopped, stop))
    again.restore(stopped.capture_state())
    list(solve(original, solver, stages, again, lambda step, left: None))
    assert torch.equal(again.moved, whole.moved)
    assert again.step == whole.step == 10


def test_one_thread_and_two_solve_to_the_same_bits(one_thread: None) -> None:
    scene = dense_ball(40_000, bands=3)
    cameras = orbit(2, 48)
    crops, original = prepared(scene, cameras)
    targets = render_all(crops, pack(replace(scene, sh0=-scene.sh0, shN=-scene.shN), with_shN=True))
    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        set_threads(threads)
        solver, state = make_solver(crops, original, True), PgsState(original)
        list(solve(original, solver, [TargetStage(1.0, targets, 3)], state, lambda step, left: None))
        ends.append(state.moved.detach())
    set_threads(None)
    assert bool(ends[0].any())
    assert torch.equal(*ends)


def test_a_target_that_is_not_finite_stops_before_the_step() -> None:
    scene = dense_ball(200)
    crops, original = prepared(scene, orbit(2, 40))
    targets = [torch.full_like(picture, torch.nan) for picture in render_all(crops, original)]
    solver, state = make_solver(crops, original, trained_bands=False), PgsState(original)
    with pytest.raises(FloatingPointError, match="the loss is nan at step 0"):
        list(solve(original, solver, [TargetStage(1.0, targets, 2)], state, lambda step, left: None))
    assert not bool(state.moved.any())


def test_followers_are_tied_while_the_colors_are_solved_for() -> None:
    scene = dense_ball(300)
    crops, original = prepared(scene, orbit(3, 40))
    targets = render_all(crops, pack(replace(scene, sh0=-scene.sh0), with_shN=False))
    solver, state = make_solver(crops, original, trained_bands=False), PgsState(original)
    tied = UnseenMembers(torch.tensor([4]), torch.tensor([[7, 9]]), torch.tensor([[0.25, 0.75]]))
    end = list(solve(original, solver, [TargetStage(1.0, targets, 5)], state, lambda step, left: None, tied))[
        -1
    ]
    assert torch.allclose(end.offsets[4], 0.25 * end.offsets[7] + 0.75 * end.offsets[9], atol=1e-6)
    assert bool(end.offsets[7].any())


def test_a_draft_comes_as_near_to_its_colors_as_four_strengths_need() -> None:
    scene = dense_ball()
    blue = replace(scene, sh0=scene.sh0 * 0.5 + rgb_to_sh0(torch.tensor([0.2, 0.3, 0.8])) * 0.5)
    cameras = orbit(6, 96)
    steps = iterations(QUICK_STEPS)
    assert steps == 60
    assert iterations(800) == 100, "what has steps enough takes no more than it did"
    quarter = solved(scene, blue, cameras, steps // 4)
    # 53 dB; half as many reach 46
    assert psnr(scene, blue, quarter, cameras) > 50
