"""Members that no view shows follow the seen ones on their own surface in an edit of colors."""

from __future__ import annotations

import pytest
import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import Gaussians, pack
from progdf.region import Region
from progdf.sh import rgb_to_sh0
from trainer.optimize.pgs import TargetStage
from trainer.optimize.unseen import UnseenMembers, find_unseen_members, least_visible, unseen_members_of
from trainer.options import EditKind, OptimizeOptions
from trainer.run.training import is_no_worse
from trainer.setup import TrainingSetup
from trainer.views.crops import crop_scene, render_all
from trainer.views.view import View, make_view

WHITE = torch.ones(3)
SIDE = 20


def two_boards() -> Gaussians:
    """A red board at z = 0 and a green one behind it at z = .3, 20 × 20 flat Gaussians each, y up."""
    at = torch.linspace(-1, 1, SIDE)
    plane = torch.cartesian_prod(at, at)
    count = 2 * len(plane)
    means = torch.cat([torch.cat([plane, torch.full((len(plane), 1), z)], dim=1) for z in (0.0, 0.3)])
    colors = torch.tensor([[0.8, 0.1, 0.1], [0.1, 0.7, 0.2]]).repeat_interleave(len(plane), dim=0)
    return Gaussians(
        means,
        torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(count, 1),
        torch.tensor([0.08, 0.08, 0.01]).log().repeat(count, 1),
        torch.full((count,), 3.0),
        rgb_to_sh0(colors),
        torch.zeros(count, 0, 3),
    )


def half_seen(scene: Gaussians) -> tuple[Region, list[View]]:
    """All of the scene, and views of the middle of each board's left half, from in front and from behind."""
    region = Region("all", torch.arange(len(scene)), torch.ones(len(scene)))
    up = torch.tensor([0.0, 1.0, 0.0])
    views = []
    for eye, target in (((-0.6, 0.0, -2.0), (-0.6, 0.0, 0.0)), ((-0.6, 0.0, 2.5), (-0.6, 0.0, 0.3))):
        viewmat = look_at(torch.tensor(eye), torch.tensor(target), up)
        camera = Camera(viewmat, intrinsics(0.5, 96, 96), 96, 96)
        views.append(make_view(scene, region, camera, WHITE))
    return region, views


def test_what_no_view_shows_follows_its_own_board_and_not_the_one_behind() -> None:
    scene = two_boards()
    region, views = half_seen(scene)
    found = find_unseen_members(scene, region.members, views)
    board = torch.arange(len(scene)) // (SIDE * SIDE)
    assert len(found.places) > 0.3 * len(scene), "the right halves are out of sight"
    in_sight = (scene.means[:, :2] - torch.tensor([-0.6, 0.0])).abs().amax(dim=1) < 0.3
    assert not bool(in_sight[found.places].any())
    assert bool((board[found.sources] == board[found.places, None])[found.weights > 0.01].all())
    counted = found.sources[found.weights > 0]
    assert not bool(torch.isin(counted, found.places).any()), "nobody follows a follower"
    torch.testing.assert_close(found.weights.sum(dim=1), torch.ones(len(found.places)))


def test_followers_take_on_colors_and_nothing_else() -> None:
    scene = two_boards()
    region, views = half_seen(scene)
    found = find_unseen_members(scene, region.members, views)
    board = torch.arange(len(scene)) // (SIDE * SIDE)
    offsets = torch.zeros(len(scene), 14)
    offsets[:, 11:] = torch.where(board == 0, 1.0, -2.0)[:, None]
    offsets[:, :11] = torch.randn(len(scene), 11, generator=torch.Generator().manual_seed(0))
    moved = offsets.clone()
    moved[found.places, 11:] = 0.0
    torch.testing.assert_close(found.propagate(moved), offsets, atol=1e-5, rtol=0)
    assert torch.equal(found.propagate(moved.half())[:, :11], moved.half()[:, :11])


def test_where_all_is_seen_or_nothing_nobody_follows() -> None:
    scene = two_boards()
    region, views = half_seen(scene)
    seen = find_unseen_members(scene, region.members, views)
    alone = torch.ones(len(scene), dtype=torch.bool)
    alone[seen.places] = False
    members = alone.nonzero()[:, 0]
    assert not len(find_unseen_members(scene, members, views).places)
    hidden = (scene.means[:, 0] > 0.5).nonzero()[:, 0]
    assert not len(find_unseen_members(scene, hidden, views).places)
    offsets = torch.ones(len(members), 14)
    assert find_unseen_members(scene, members, views).propagate(offsets) is offsets


@pytest.mark.parametrize(("kind", "followed"), [("color", True), ("geometry", False)])
def test_only_edits_of_colors_are_propagated(kind: EditKind, followed: bool) -> None:
    scene = two_boards()
    region, views = half_seen(scene)
    setup = TrainingSetup(scene, region, views, [], WHITE)
    assert bool(len(unseen_members_of(setup, OptimizeOptions(kind=kind)).places)) == followed


def test_what_counts_as_unseen_follows_the_density() -> None:
    """A region of large members has 3 pixels, one in which each has a tenth of a pixel far less."""
    large = torch.tensor([400.0] * 90 + [2.0] * 10)
    assert least_visible(large) == 3.0
    dense = torch.rand(10_000, generator=torch.Generator().manual_seed(1)) * 0.2
    assert float((dense < least_visible(dense)).float().mean()) < 0.02
    assert least_visible(torch.cat([dense, torch.zeros(10_000)])) == pytest.approx(least_visible(dense))


def test_following_that_makes_the_loss_worse_is_undone() -> None:
    """Members in plain sight of colors of their own are made to follow their neighbors."""
    scene = two_boards()
    _, views = half_seen(scene)
    members = torch.arange(SIDE * SIDE)
    crops = [crop_scene(scene, members, views[0].camera, views[0].box, WHITE, still=True)]
    original = pack(scene[members], with_shN=False)
    end = torch.zeros_like(original)
    end[:, 11:] = torch.randn(len(members), 3, generator=torch.Generator().manual_seed(2))
    targets = render_all(crops, original + end)
    in_sight = (scene.means[:, :2] - torch.tensor([-0.6, 0.0])).abs().amax(dim=1)[members] < 0.3
    places = in_sight.nonzero()[:, 0]
    sources = places.roll(3)[:, None]
    wrong = UnseenMembers(places, sources, torch.ones(len(places), 1))
    stages = [TargetStage(1.0, targets, 1)]
    assert not is_no_worse(wrong, end, original, crops, stages)
    right = UnseenMembers(places, places[:, None], torch.ones(len(places), 1))
    assert is_no_worse(right, end, original, crops, stages)
