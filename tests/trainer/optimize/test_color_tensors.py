"""Color solver in torch on a simulated GPU beside the CPU's kernels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from unittest.mock import Mock

import pytest
import torch
from torch import Tensor

from progdf.gaussians import Gaussians, pack
from progdf.rasterize import set_threads
from progdf.rasterize.cpu.weights import ListedWeights
from progdf.rasterize.sparse import weights_of_entries
from tests.helpers.card import CARD, Card
from tests.trainer.optimize.test_color_solver import dense_ball, orbit
from trainer.optimize import color_kernels, color_tensors
from trainer.optimize.color_solver import Solver, choose_model, make_solver
from trainer.optimize.color_views import ColorEvaluator, ColorMembers, ColorView, add_bands, color_views
from trainer.views.crops import crop_scene, render_all

STEPS = 6


def ball(count: int = 400, bands: int = 8) -> Gaussians:
    """Return a ball of overlapping Gaussians, some with colors beyond the range of a screen."""
    return dense_ball(count, bands, scale=0.12, colors=(-0.1, 1.1))


def recolored(scene: Gaussians) -> Gaussians:
    """Return an edit that no map and no small number of steps reproduces."""
    rng = torch.Generator().manual_seed(4)
    grain = 0.5 * torch.randn(len(scene), 3, generator=rng)
    bands = 0.1 * torch.randn(scene.shN.shape, generator=rng)
    return replace(scene, sh0=scene.sh0.flip(1) + grain, shN=scene.shN + bands)


Prepared = tuple[list[ColorView], Tensor, list[Tensor]]


def views_of(scene: Gaussians, count: int = 5, size: int = 40) -> Prepared:
    """Return the views of a whole scene, its rows and the pictures of its edit."""
    members = torch.arange(len(scene))
    white = torch.ones(3)
    cameras = orbit(count, size)
    crops = [crop_scene(scene, members, c, (0, 0, size, size), white, still=True) for c in cameras]
    original = pack(scene, with_shN=True)
    return color_views(crops, original), original, render_all(crops, pack(recolored(scene), with_shN=True))


def on_card(views: list[ColorView]) -> list[ColorView]:
    """Return the views on the simulated GPU, with the same weights."""
    first = views[0].members
    members = ColorMembers(first.means.to(CARD), first.sh.to(CARD))
    moved = []
    for view in views:
        weights = view.map
        assert isinstance(weights, ListedWeights)
        entries = (torch.from_numpy(part) for part in weights.entries())
        moved.append(
            replace(
                view,
                map=weights_of_entries(weights.size, weights.count, *entries).to(CARD),
                others=view.others.to(CARD),
                members=members,
                position=view.position.to(CARD),
                pixels=view.pixels.to(CARD),
                counts=view.counts.to(CARD),
            )
        )
    return moved


@pytest.fixture
def card() -> Iterator[Card]:
    with Card() as made:
        yield made


def descend(solver: Solver, targets: list[Tensor], bands: int, steps: int) -> Tensor:
    """Return the change by the map and a residual. [M,B,3]"""
    mapped = solver.fit_map(1, targets)[1]
    start = torch.zeros_like(mapped[:, :bands])
    judge = ColorEvaluator(solver.views, targets)
    return add_bands(mapped, solver.residual(mapped, start, targets, steps, judge)[0])


@pytest.mark.parametrize("bands", [1, 4, 9])
def test_solution_on_a_gpu_matches_the_kernels(card: Card, bands: int) -> None:
    views, original, targets = views_of(ball())
    here = descend(make_solver(views, original), targets, bands, STEPS)
    solver = make_solver(on_card(views), original.to(CARD))
    there = descend(solver, [target.to(CARD) for target in targets], bands, STEPS)
    assert there.device == CARD
    # steps amplify the rounding of single values, which decides on clamps
    assert float((there.cpu() - here).norm()) < 1e-3 * float(here.norm())
    judge = ColorEvaluator(views, targets)
    assert judge.error(there.cpu()) == pytest.approx(judge.error(here), rel=1e-4)


def test_gradients_on_a_gpu_match_the_kernels(card: Card) -> None:
    views, original, targets = views_of(ball())
    for bands in (1, 4, 9):
        gradients = []
        for solver, pictures in (
            (make_solver(views, original), targets),
            (make_solver(on_card(views), original.to(CARD)), [t.to(CARD) for t in targets]),
        ):
            zeros = torch.zeros_like(solver.sh)
            picked = [view.pick(target) for view, target in zip(solver.views, pictures, strict=True)]
            gradients.append(solver._gradient(zeros, zeros[:, :bands], picked, 1e-3))
        here, there = gradients
        assert there.error == pytest.approx(here.error, rel=1e-6)
        difference = (there.descent.cpu() - here.descent).abs().max()
        assert float(difference) < 1e-5 * float(here.descent.abs().max())
        assert float((there.drawn.cpu() != here.drawn).float().mean()) < 1e-3


def test_model_chosen_on_a_gpu_is_the_same(card: Card) -> None:
    views, original, targets = views_of(ball())
    moved = [target.to(CARD) for target in targets]
    chosen = []
    for solver, pictures in (
        (make_solver(views[::2], original), targets),
        (make_solver(on_card(views)[::2], original.to(CARD)), moved),
    ):
        judged = views[1::2] if solver.sh.is_cpu else on_card(views)[1::2]
        judge = ColorEvaluator(judged, pictures[1::2])
        chosen.append(choose_model(solver, (solver, judge), pictures[::2], STEPS, 9)[1])
    here, there = chosen
    assert (there.degree, there.bands, there.steps) == (here.degree, here.bands, here.steps)
    for (name, decibels), (other, expected) in zip(there.tried, here.tried, strict=True):
        assert name == other
        assert decibels == pytest.approx(expected, abs=0.05)


def test_step_copies_only_the_errors_from_a_gpu(card: Card, monkeypatch: pytest.MonkeyPatch) -> None:
    """Count the copies of further steps: the error of each candidate, and that on held-out views."""
    views, original, targets = views_of(ball())
    solver = make_solver(on_card(views), original.to(CARD))
    moved = [target.to(CARD) for target in targets]
    gradients = Mock(side_effect=Solver._gradient)
    monkeypatch.setattr(Solver, "_gradient", lambda *arguments: gradients(*arguments))
    counts = []
    for steps in (1, 4):
        gradients.reset_mock()
        moved_before = card.moved
        read_before = card.read
        descend(solver, moved, 9, steps)
        counts.append((card.moved - moved_before, card.read - read_before, gradients.call_count))
    (moved_once, read_once, tried_once), (moved_later, read_later, tried_later) = counts
    assert moved_later == moved_once, "tensors are copied before the first step only"
    further = tried_later - tried_once
    assert read_later - read_once == further + 3, "one number per candidate, one per held-out error"


@pytest.fixture(autouse=True)
def one_worker() -> Iterator[None]:
    """Stay on this thread, where the simulated GPU counts copies."""
    set_threads(1)
    yield
    set_threads(None)


@pytest.mark.parametrize("bands", [1, 4, 9, 16])
def test_products_match_the_kernels(bands: int) -> None:
    rng = torch.Generator().manual_seed(bands)
    means, sh = torch.randn(90, 3, generator=rng), torch.randn(90, bands, 3, generator=rng)
    centers = 4.0 * torch.randn(3, 3, generator=rng)
    expected = color_kernels.shade_views(means.numpy(), centers.numpy(), sh.numpy(), 0.5, 0.0)
    colors = color_tensors.shade_views(means, centers, sh, 0.5, 0.0)
    torch.testing.assert_close(colors, torch.from_numpy(expected), rtol=1e-5, atol=5e-6)
    summed, plain = sh.clone(), sh.clone()
    color_kernels.add_gradients(means.numpy(), centers.numpy(), colors.numpy(), summed.numpy())
    color_tensors.add_gradients(means, centers, colors, plain)
    torch.testing.assert_close(plain, summed, rtol=1e-5, atol=5e-6)
    half = torch.randn(90, bands, bands, generator=rng)
    blocks = half @ half.transpose(1, 2)
    free = torch.rand(90, bands, generator=rng) > 0.2
    diagonal = 0.1 + torch.rand(90, generator=rng)
    inverse = color_kernels.invert_blocks(blocks.numpy(), free.numpy(), diagonal.numpy())
    plain_inverse = color_tensors.invert_blocks(blocks, free, diagonal)
    torch.testing.assert_close(plain_inverse, torch.from_numpy(inverse), rtol=1e-5, atol=1e-6)


def test_sparse_weights_match_the_lists() -> None:
    views, _, _ = views_of(ball())
    for view in views:
        weights = view.map
        assert isinstance(weights, ListedWeights)
        entries = [torch.from_numpy(part) for part in weights.entries()]
        sparse = weights_of_entries(weights.size, weights.count, *entries)
        colors = torch.rand(weights.count, 20)
        torch.testing.assert_close(sparse.picture(colors), weights.picture(colors), rtol=1e-5, atol=1e-6)
        image = torch.rand(*weights.size, 3) - 0.5
        torch.testing.assert_close(sparse.gradient(image), weights.gradient(image), rtol=1e-5, atol=1e-5)
