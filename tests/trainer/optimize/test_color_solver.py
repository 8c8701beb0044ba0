"""Color solver: a color map of the region plus a residual of single members."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians, pack
from progdf.metrics.image import LEVEL
from progdf.rasterize import activate, alpha_weights, render, set_threads
from progdf.rasterize.engines import color_map
from progdf.region import Region
from progdf.sh import rgb_to_sh0
from progdf.threads import map_threads
from tests.helpers.scenes import random_gaussians
from trainer.optimize.color_course import StrengthSchedule, Target, solve, thin_model
from trainer.optimize.color_solver import (
    Model,
    Solver,
    add_bands,
    choose_model,
    make_solver,
)
from trainer.optimize.color_views import ColorEvaluator, color_views, draw_color_views
from trainer.optimize.pgs import OnStep, ParameterSnapshot, PgsState, TargetStage
from trainer.quality import BALANCED
from trainer.views.crops import CropScene, crop_scene, render_all
from trainer.views.view import make_view

WHITE = torch.ones(3)


def orbit(count: int, size: int) -> list[Camera]:
    """Return cameras around the origin at horizontal distance 4, at heights 1 and 2 in turn."""
    cameras = []
    for i in range(count):
        angle = torch.tensor(2 * torch.pi * i / count)
        eye = torch.stack([4 * angle.cos(), torch.tensor(1.0 + i % 2), 4 * angle.sin()])
        viewmat = look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
        cameras.append(Camera(viewmat, intrinsics(0.6, size, size), size, size))
    return cameras


def dense_ball(
    count: int = 3000, bands: int = 0, scale: float = 0.05, colors: tuple[float, float] = (0.2, 0.8)
) -> Gaussians:
    """Return a ball of many Gaussians of one scale in random colors of a range."""
    low, high = colors
    rng = torch.Generator().manual_seed(3)
    means = torch.nn.functional.normalize(torch.randn(count, 3, generator=rng), dim=1)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.full((count, 3), scale).log(),
        torch.full((count,), 2.0),
        rgb_to_sh0(low + (high - low) * torch.rand(count, 3, generator=rng)),
        0.1 * torch.randn(count, bands, 3, generator=rng),
    )


def prepared(scene: Gaussians, cameras: list[Camera]) -> tuple[list[CropScene], Tensor]:
    members = torch.arange(len(scene))
    crops = [crop_scene(scene, members, c, (0, 0, c.width, c.height), WHITE, still=True) for c in cameras]
    return crops, pack(scene, with_shN=scene.sh_degree > 0)


def grainy(pictures: list[Tensor], sigma: float) -> list[Tensor]:
    """Add noise, so that the remaining error stays visible and no solve ends early."""
    rng = torch.Generator().manual_seed(5)
    return [picture + sigma * torch.randn(picture.shape, generator=rng) for picture in pictures]


def model_of(solver: Solver, targets: list[Tensor], steps: int = 40, bands: int = 4) -> Model:
    return choose_model(solver, (solver, ColorEvaluator(solver.views, targets)), targets, steps, bands)[1]


def solve_all(
    solver: Solver,
    model: Model,
    stages: list[TargetStage],
    state: PgsState,
    steps: int,
    on_step: OnStep = lambda step, left: None,
    made: list[ParameterSnapshot] | None = None,
) -> list[ParameterSnapshot]:
    """Return the recordings in half precision, like a run; all views decide when a stage is done."""
    targets = [(stage, ColorEvaluator(solver.views, stage.targets)) for stage in stages]
    course = StrengthSchedule(targets[:-1], targets[-1])
    made = [] if made is None else made
    for snapshot in solve(solver, model, course, made, state, on_step, steps):
        made.append(replace(snapshot, offsets=snapshot.offsets.half()))
    return made


def solved(scene: Gaussians, edited: Gaussians, cameras: list[Camera], steps: int = 40) -> Tensor:
    """Return the offsets that make `scene` look like `edited`."""
    crops, original = prepared(scene, cameras)
    targets = render_all(crops, pack(edited, with_shN=scene.sh_degree > 0))
    solver = make_solver(color_views(crops, original), original)
    stages = [TargetStage(1.0, targets, 1)]
    model = model_of(solver, targets, steps)
    return solve_all(solver, model, stages, PgsState(original), steps)[-1].offsets


def psnr(scene: Gaussians, edited: Gaussians, offsets: Tensor, cameras: list[Camera]) -> float:
    crops, original = prepared(scene, cameras)
    wide = scene.sh_degree > 0
    pairs = zip(render_all(crops, original + offsets), render_all(crops, pack(edited, wide)), strict=True)
    return float(-10 * torch.stack([(a - b).square().mean() for a, b in pairs]).mean().log10())


def test_color_map_matches_the_rasterizer_and_its_gradients() -> None:
    scene = random_gaussians(400, seed=2)
    scene = replace(scene, means=0.4 * scene.means / scene.means.norm(dim=1).max())
    camera = orbit(3, 80)[1]
    window = (7, 3, 77, 61)
    rows = torch.arange(0, 400, 3)
    colors = torch.zeros(400, 3)
    colors[rows] = torch.rand(len(rows), 3, generator=torch.Generator().manual_seed(5))
    colors.requires_grad_()
    image = render(scene, camera, (0.0, 0.0, 0.0), colors=colors, crop=window).image
    pull = torch.randn(image.shape, generator=torch.Generator().manual_seed(6))
    (image * pull).sum().backward()  # type: ignore[no-untyped-call]
    weighed = color_map(activate(scene), camera, window, rows)
    assert float(image.detach().amax()) > 0.1
    # float32 sums differ in order
    torch.testing.assert_close(weighed.picture(colors.detach()[rows]), image.detach(), atol=2e-5, rtol=0)
    assert colors.grad is not None
    torch.testing.assert_close(weighed.gradient(pull), colors.grad[rows], atol=2e-4, rtol=1e-4)


def test_solving_on_a_pixel_subset_is_as_good() -> None:
    scene = replace(dense_ball(600), sh0=0.5 * torch.rand(600, 3, generator=torch.Generator().manual_seed(7)))
    edited = replace(scene, sh0=scene.sh0.flip(1) + 0.3)
    cameras = orbit(8, 64)
    crops, original = prepared(scene, cameras)
    views = color_views(crops, original, 4)
    assert len({int(view.pixels[0]) for view in views}) == 4
    assert all(len(view.pixels) == view.size[0] * view.size[1] // 4 for view in views)
    targets = render_all(crops, pack(edited, False))
    solver = make_solver(views, original)
    model = model_of(solver, targets, 40)
    stages = [TargetStage(1.0, targets, 1)]
    offsets = solve_all(solver, model, stages, PgsState(original), 40)[-1].offsets
    assert psnr(scene, edited, offsets, cameras) > 45.0


def test_views_drawn_at_once_equal_views_of_crops() -> None:
    """A region with Gaussians in front of and behind it, in a box smaller than the picture."""
    scene = random_gaussians(800, seed=3, sh_degree=2)
    members = torch.arange(5, 800, 3)
    region = Region("part", members, torch.ones(800))
    cameras = orbit(2, 64)
    box = (7, 3, 60, 49)
    crops = [crop_scene(scene, members, camera, box, WHITE) for camera in cameras]
    views = [replace(make_view(scene, region, c, WHITE), box=box) for c in cameras]
    original = pack(scene[members], with_shN=True)
    drawn = draw_color_views(scene, members, views, WHITE, original, 2)
    for view, plain in zip(drawn, color_views(crops, original, 2), strict=True):
        assert view.size == plain.size
        assert torch.equal(view.pixels, plain.pixels)
        torch.testing.assert_close(view.share, plain.share, atol=2e-5, rtol=0)
        torch.testing.assert_close(view.others, plain.others, atol=2e-5, rtol=0)


def test_subpixel_members_learn_their_color() -> None:
    scene = dense_ball(9000)
    edited = replace(scene, sh0=scene.sh0.flip(1) + 0.3)
    cameras = orbit(6, 40)
    shown = torch.stack([alpha_weights(scene, camera, torch.ones(40, 40))[:, 2] for camera in cameras])
    weights = shown.sum(dim=0)
    assert float((weights[weights > 0.0] < 1.0).float().mean()) > 0.5
    offsets = solved(scene, edited, cameras)
    assert psnr(scene, edited, offsets, cameras) > 50.0
    assert not bool(offsets[:, :11].any())


def test_color_below_zero_is_reached_through_clamps() -> None:
    scene = dense_ball(500)
    dark = replace(scene, sh0=rgb_to_sh0(torch.full((500, 3), -0.2)))
    crops, original = prepared(dark, orbit(3, 32))
    targets = render_all(crops, pack(scene, with_shN=False))
    solver = make_solver(color_views(crops, original), original)
    nothing = torch.zeros(500, 1, 3)
    offsets, _ = solver.residual(nothing, nothing, targets, 20)
    assert float((offsets > 0.0).float().mean()) > 0.5


def test_global_color_change_is_a_map_that_holds_in_unseen_views() -> None:
    """Swap red and blue with SH degree 2; fit two views, evaluate a third."""
    scene = dense_ball(1200, bands=8)
    edited = replace(scene, sh0=scene.sh0.flip(1), shN=scene.shN.flip(2))
    cameras = orbit(8, 64)
    crops, original = prepared(scene, [cameras[0], cameras[4]])
    targets = render_all(crops, pack(edited, with_shN=True))
    solver = make_solver(color_views(crops, original), original)
    model = model_of(solver, targets)
    assert (model.degree, model.bands) == (1, 0)
    offsets = solved(scene, edited, [cameras[0], cameras[4]])
    assert psnr(scene, edited, offsets, cameras[1:2]) > 40.0
    assert "color map of degree 1. Candidates" in model.line


@pytest.mark.parametrize("profile", ["halves", "ramp"])
def test_partial_change_becomes_a_mask(profile: str) -> None:
    """Gray one half of a ball (SH degree 2), or a ramp across it; evaluate two of eight views."""
    scene = dense_ball(1500, bands=8)
    x = scene.means[:, 0]
    share = (x > 0).float() if profile == "halves" else (0.5 + 0.5 * x).clamp(0, 1)
    grays = [sh.mean(dim=2, keepdim=True).expand_as(sh) for sh in (scene.sh0[:, None], scene.shN)]
    edited = replace(
        scene,
        sh0=torch.lerp(scene.sh0, grays[0][:, 0], share[:, None]),
        shN=torch.lerp(scene.shN, grays[1], share[:, None, None]),
    )
    cameras = orbit(8, 64)
    crops, original = prepared(scene, cameras[:6])
    others, _ = prepared(scene, cameras[6:])
    targets, aside = (render_all(some, pack(edited, with_shN=True)) for some in (crops, others))
    solver = make_solver(color_views(crops, original), original)
    judge = ColorEvaluator(color_views(others, original), aside)
    solver, model = choose_model(solver, (solver, judge), targets, 40, 4)
    assert (model.degree, model.mask is None) == (1, False), model.line
    seen = solver.weights[:, 0, 0] > 0.2 * solver.typical
    alike = torch.corrcoef(torch.stack([model.mask.float()[seen], share[seen]]))[0, 1]
    assert float(alike) > 0.97, "the share of each, but for what all of it is"
    _, made = solver.fit_map(1, targets)
    assert judge.error(made) < 1e-4, "40 dB in views that nothing was fitted to"
    assert "color map of degree 1 + mask" in model.line


@pytest.mark.slow
def test_pattern_gets_a_residual_with_only_useful_bands() -> None:
    scene = dense_ball(1500, bands=3)
    side = (scene.means[:, :1] > 0).float()
    rng = torch.Generator().manual_seed(9)
    edited = replace(scene, sh0=scene.sh0 + 0.8 * torch.randn(1500, 3, generator=rng), shN=scene.shN)
    crops, original = prepared(scene, orbit(8, 64))
    others, _ = prepared(scene, orbit(16, 64)[1::2])

    def bands_of(edited: Gaussians, most: int = 4) -> int:
        rng = torch.Generator().manual_seed(5)  # noise of 0.01 between pictures, which must add no band
        rows = pack(edited, with_shN=True)
        targets, aside = (
            [p + 0.01 * torch.randn(p.shape, generator=rng) for p in render_all(some, rows)]
            for some in (crops, others)
        )
        judge = ColorEvaluator(color_views(others, original), aside)
        return choose_model(solver, (solver, judge), targets, 40, most)[1].bands

    solver = make_solver(color_views(crops, original), original)
    assert bands_of(edited) == 1
    turned = replace(edited, shN=scene.shN * (1.0 - 2.0 * side[..., None]))
    assert bands_of(turned) == 4
    assert bands_of(turned, most=1) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("turning", "spare"), [(0.1, 0.0), (1.0, 0.0), (1.0, 3e-4)])
def test_only_members_that_need_them_have_functions_beyond_dc(turning: float, spare: float) -> None:
    scene = dense_ball(1500, bands=3)
    some = torch.arange(1500) < 1500 * turning
    edited = replace(scene, shN=scene.shN * (1.0 - 2.0 * some[:, None, None]))
    crops, original = prepared(scene, orbit(8, 64))
    others, _ = prepared(scene, orbit(16, 64)[1::2])
    rows = pack(edited, with_shN=True)
    solver = make_solver(color_views(crops, original), original)
    targets = grainy(render_all(crops, rows), 0.0125)
    aside = grainy(render_all(others, rows), 0.0125)
    judge = ColorEvaluator(color_views(others, original), aside)
    solver, model = choose_model(solver, (solver, judge), targets, 40, 4)
    model = replace(model, limits=replace(BALANCED, max_price_ratio=math.inf))  # the gain alone decides
    thinner = thin_model(model, solver, [(TargetStage(1.0, targets, 1), judge)], 40, spare)
    mapped = solver.fit_map(model.degree, targets)[1]
    errors = [judge.error(add_bands(mapped, one.residual)) for one in (model, thinner)]
    assert errors[1] * 0.95 <= errors[0] + spare
    functions = thinner.residual[:, 1:].any(dim=2)
    share = float(functions[some].float().mean())
    if turning < 1.0:
        assert share > 30 * float(functions[~some].float().mean())
    assert share == 1.0 if turning == 1.0 and not spare else 0.0 < share < 0.5
    again = solver.only(thinner.residual).residual(mapped, model.residual, targets, 5)[0]
    assert torch.equal(again[:, 1:].any(dim=2), functions)


@pytest.mark.parametrize(("turned", "most"), [(False, 4), (True, 4), (True, 1)])
def test_band_is_added_for_the_path_if_the_end_has_no_error(turned: bool, most: int) -> None:
    scene = dense_ball(1000, bands=3)
    draws = 0.3 * torch.randn(1000, 3, generator=torch.Generator().manual_seed(9))
    (crops, original), (others, _) = (prepared(scene, c) for c in (orbit(8, 64), orbit(16, 64)[1::2]))
    solver = make_solver(color_views(crops, original), original)
    aside = color_views(others, original)

    def target(s: float, shn: Tensor) -> Target:
        rows = pack(replace(scene, sh0=scene.sh0 + s * draws, shN=shn), with_shN=True)
        return TargetStage(s, render_all(crops, rows), 1), ColorEvaluator(aside, render_all(others, rows))

    end = target(1.0, scene.shN)
    half = target(0.5, -scene.shN if turned else scene.shN)
    solver, model = choose_model(solver, (solver, end[1]), end[0].targets, 40, most)
    assert model.bands == 1
    assert model.error <= LEVEL
    thinner = thin_model(model, solver, [half, end], 40, 0.0)
    assert thinner.bands == (4 if turned and most == 4 else 1)
    assert ("with a residual of 4, also at other strengths" in thinner.line) == (most == 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bend", "asked"), [("straight", set()), ("bent", {0.25, 0.5, 0.75}), ("late", {0.5, 0.75})]
)
def test_strengths_are_added_where_the_solved_strengths_are_insufficient(
    bend: str, asked: set[float]
) -> None:
    """Cover a straight change, one with curved channels, and one that begins at strength 0.5.

    Each is also stopped after every stage and must resume to the same bits.
    """
    scene = dense_ball(800)
    side = torch.where(scene.means[:, :1] > 0, 1.0, -0.5)
    courses: dict[str, Callable[[float], list[float]]] = {
        "straight": lambda s: [s, s, s],
        "bent": lambda s: [math.sin(3 * s), s, math.cos(4 * s) - 1],
        "late": lambda s: [max(0.0, s - 0.5)] * 3,
    }
    (crops, original), (others, _) = (prepared(scene, c) for c in (orbit(6, 48), orbit(9, 48)[6:]))
    solver = make_solver(color_views(crops, original), original)
    aside = color_views(others, original)

    def pictures(some: list[CropScene], s: float) -> list[Tensor]:
        moved = replace(scene, sh0=scene.sh0 + side * torch.tensor(courses[bend](s)))
        return grainy(render_all(some, pack(moved, with_shN=False)), 0.01 * s)

    def look(s: float) -> ColorEvaluator:
        return ColorEvaluator(aside, pictures(others, s))

    rounds = [0]  # number of strengths requested by the end of each round

    def ask(strengths: Sequence[float]) -> list[Target]:
        rounds.append(rounds[-1] + len(strengths))
        return [(TargetStage(s, pictures(crops, s), 1), look(s)) for s in strengths]

    def course_of(asked: Sequence[float]) -> StrengthSchedule:
        return StrengthSchedule(ask(asked), ask([1.0])[0], look, ask)

    _, model = choose_model(solver, (solver, look(1.0)), pictures(crops, 1.0), 40, 1)
    course = course_of([])
    made = list[ParameterSnapshot]()
    state = PgsState(original)
    rounds[:] = [0]
    for snapshot in solve(solver, model, course, made, state, lambda step, left: None, 40):
        made.append(replace(snapshot, offsets=snapshot.offsets.half()))
    found = [stage.strength for stage, _ in course.targets]
    assert asked <= set(found), found
    assert len(found) <= len(asked) + 2, found
    assert len(made) == len(found) + 1
    ends = list(rounds)
    for at in range(1, len(found) + 1):
        asked_by_then = found[: min(end for end in ends if end >= at)]
        again = PgsState(original)
        kept = made[:at]
        known = course_of(asked_by_then)
        again.step, again.stage, again.running = at, at, kept[-1].means["left"]
        for snapshot in solve(solver, model, known, kept, again, lambda step, left: None, 40):
            kept.append(replace(snapshot, offsets=snapshot.offsets.half()))
        assert [stage.strength for stage, _ in known.targets] == found
        assert torch.equal(again.moved, state.moved)


@pytest.mark.parametrize(("members", "size", "most"), [(200, 64, 60), (6000, 40, 40)])
def test_steps_end_early_unless_members_are_dense(members: int, size: int, most: int) -> None:
    """Expect a few of 60 steps for members of many pixels, nearly all of 40 for members below a pixel."""
    scene = dense_ball(members)
    side = scene.means[:, :1] > 0
    edited = replace(scene, sh0=torch.where(side, scene.sh0.flip(1), scene.sh0 + 0.3))
    (crops, original), (others, _) = (prepared(scene, c) for c in (orbit(8, size), orbit(16, size)[1::2]))
    targets, aside = (render_all(some, pack(edited, with_shN=False)) for some in (crops, others))
    aside = grainy(aside, 0.0045)
    solver = make_solver(color_views(crops, original), original)
    _, mapped = solver.fit_map(1, targets)
    start = torch.zeros(members, 1, 3)
    judge = ColorEvaluator(color_views(others, original), aside)
    found, taken = solver.residual(mapped, start, targets, most, judge)
    assert taken > 0.9 * most if members == 6000 else taken < most / 2
    further, all_steps = solver.residual(mapped, start, targets, most)
    assert all_steps == most or members == 200
    assert judge.error(add_bands(mapped, found)) <= 1.02 * judge.error(add_bands(mapped, further))


def test_invisible_member_follows_the_map() -> None:
    scene = dense_ball(3000)
    hidden = replace(
        scene, means=torch.where(torch.arange(3000)[:, None] < 50, 0.01 * scene.means, scene.means)
    )
    blue = replace(hidden, sh0=hidden.sh0 * 0.5 + rgb_to_sh0(torch.tensor([0.2, 0.3, 0.8])) * 0.5)
    offsets = solved(hidden, blue, orbit(6, 64))
    wanted = (blue.sh0 - hidden.sh0)[:50]
    assert float((offsets[:50, 11:14] - wanted).abs().max()) < 0.02


def test_stopped_solve_resumes_to_the_same_bits() -> None:
    scene = dense_ball(300)
    crops, original = prepared(scene, orbit(3, 40))
    side = torch.where(scene.means[:, :1] > 0, -1.0, 0.5)
    stages = [
        TargetStage(
            s,
            grainy(render_all(crops, pack(replace(scene, sh0=scene.sh0 + s * side), with_shN=False)), 0.01),
            1,
        )
        for s in (0.3, 0.6, 1.0)
    ]
    solver = make_solver(color_views(crops, original), original)
    model = model_of(solver, list(stages[-1].targets))
    assert model.bands == 1
    whole = PgsState(original)
    solve_all(solver, model, stages, whole, 20)
    for at in (1, 2):  # between two rounds of a stage, and at its end
        stopped, again, calls, made = PgsState(original), PgsState(original), [0], list[ParameterSnapshot]()

        def stop(step: int, left: float, at: int = at, calls: list[int] = calls) -> None:
            calls[0] += step == at
            if calls[0] == (1 if at == 2 else 2):
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            solve_all(solver, model, stages, stopped, 20, stop, made)
        again.restore(stopped.capture_state())
        assert again.step == at
        assert len(made) == at
        solve_all(solver, model, stages, again, 20, made=made)
        assert torch.equal(again.moved, whole.moved)
        assert again.step == whole.step == 3


@pytest.mark.usefixtures("two_threads")
def test_torch_uses_one_thread_per_view_worker() -> None:
    """Guard reproducibility, because the order of torch's sums depends on its number of threads."""
    torch.set_num_threads(2)
    both = threading.Barrier(2, timeout=60)

    def look(_: int) -> int:
        both.wait()
        return torch.get_num_threads()

    assert map_threads(look, range(2)) == [1, 1]
    assert torch.get_num_threads() == 2


def test_fused_pixel_pass_matches_torch_with_clamps() -> None:
    """Compare the fused pass over the pixels with torch, for colors and pixels beyond both range ends."""
    crops, original = prepared(dense_ball(400), orbit(1, 40))
    view = color_views(crops, original, 2)[0]
    rng = torch.Generator().manual_seed(5)
    view, _ = replace(view, others=view.others - 0.2).halves()
    colors = 3.0 * torch.rand(400, 3, generator=rng) - 1.0
    target = torch.rand(view.others.shape, generator=rng).sub(0.2).clamp(0.0, 1.0)
    pull, passed, squared = view.pull(colors, target)
    image = view.picture(colors)
    held = ((image <= 0.0) & (target <= 0.0)) | ((image >= 1.0) & (target >= 1.0))
    assert held.any()
    assert (image < 0.0).any()
    assert (image > 1.0).any()
    assert torch.equal(passed, view.counts & ~held)
    torch.testing.assert_close(pull, view.map.gradient((target - image) * passed))
    wanted = (((target - image.clamp(0.0, 1.0)) * view.counts).double() ** 2).sum()
    assert squared == pytest.approx(float(wanted), rel=1e-6)


def test_one_and_two_threads_solve_to_the_same_bits() -> None:
    scene = dense_ball(20_000, bands=3)
    cameras = orbit(3, 48)
    crops, original = prepared(scene, cameras)
    targets = render_all(crops, pack(replace(scene, sh0=-scene.sh0, shN=-scene.shN), with_shN=True))
    ends = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        set_threads(threads)
        solver = make_solver(color_views(crops, original), original)
        state = PgsState(original)
        stages = [TargetStage(1.0, targets, 1)]
        model = model_of(solver, targets, 6)
        solve_all(solver, model, stages, state, 6)
        ends.append(state.moved.detach())
    set_threads(None)
    assert bool(ends[0].any())
    assert torch.equal(*ends)


def test_nonfinite_target_stops_before_the_step() -> None:
    scene = dense_ball(200)
    crops, original = prepared(scene, orbit(2, 40))
    pictures = render_all(crops, original)
    solver = make_solver(color_views(crops, original), original)
    state = PgsState(original)
    model = model_of(solver, pictures)
    broken = [TargetStage(1.0, [torch.full_like(picture, torch.nan) for picture in pictures], 1)]
    with pytest.raises(FloatingPointError, match="the loss is nan at step 0"):
        solve_all(solver, model, broken, state, 20)
    assert not bool(state.moved.any())


def test_unchanged_picture_gives_no_change() -> None:
    scene = dense_ball(500, bands=3)
    offsets = solved(scene, scene, orbit(4, 48))
    assert float(offsets.abs().max()) < 1e-4


@pytest.mark.parametrize(
    "case", ["one color", "black", "white", "beyond white", "hidden", "one member", "huge bands"]
)
def test_hard_regions_have_finite_offsets_and_no_larger_error(case: str) -> None:
    scene = dense_ball(400, bands=8)
    colors = {"one color": 0.4, "black": -0.2, "white": 1.0, "beyond white": 3.0}
    if case in colors:
        plain = torch.full((400, 3), colors[case])
        scene = replace(scene, sh0=rgb_to_sh0(plain), shN=torch.zeros_like(scene.shN))
    if case == "hidden":
        scene = replace(scene, logit_opacities=torch.full_like(scene.logit_opacities, -9.0))
    if case == "huge bands":
        scene = replace(scene, shN=20.0 * scene.shN)
    members = torch.arange(1 if case == "one member" else len(scene))
    cameras = orbit(3, 40)
    crops = [crop_scene(scene, members, c, (0, 0, c.width, c.height), WHITE, still=True) for c in cameras]
    original = pack(scene[members], with_shN=True)
    before = render_all(crops, original)
    targets = [torch.lerp(picture, torch.tensor([0.2, 0.3, 0.8]), 0.5) for picture in before]
    solver = make_solver(color_views(crops, original), original)
    model = model_of(solver, targets)
    stages = [TargetStage(1.0, targets, 1)]
    state = PgsState(original)
    solve_all(solver, model, stages, state, 40)
    moved = state.moved.detach()
    assert bool(moved.isfinite().all())
    assert float(moved.abs().max()) < 1e3
    after = render_all(crops, original + moved)
    errors = [
        sum(float((a - b).square().sum()) for a, b in zip(pictures, targets, strict=True))
        for pictures in (after, before)
    ]
    assert errors[0] <= errors[1] * 1.0001
