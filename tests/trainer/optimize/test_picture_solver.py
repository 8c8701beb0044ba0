"""Colors from one picture: visible members are painted, hidden ones follow their surface or stay."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.metrics.image import decibels
from progdf.sh import C0, rgb_to_sh0
from tests.helpers.trained import edit_few
from trainer.optimize.color_solver import choose_model, make_solver, split_solver
from trainer.optimize.color_views import ColorEvaluator, color_views
from trainer.optimize.ties import Ties, surface_graph
from trainer.views.crops import crop_scene
from trainer.views.view import render_view

WHITE = torch.ones(3)
SIDE = 24


def wall(z: float, color: Tensor) -> Gaussians:
    """Return a wall of flat, opaque Gaussians at depth z, from -1 to 1."""
    line = torch.linspace(-1, 1, SIDE)
    means = torch.stack([*torch.meshgrid(line, line, indexing="xy"), torch.full((SIDE, SIDE), z)], dim=2)
    count = SIDE * SIDE
    scales = torch.tensor([0.07, 0.07, 0.002]).log().expand(count, 3).clone()
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, 4).clone()
    sh0 = rgb_to_sh0(color.expand(count, 3)).clone()
    return Gaussians(
        means.reshape(-1, 3), quats, scales, torch.full((count,), 6.0), sh0, torch.zeros(count, 0, 3)
    )


def two_walls() -> Gaussians:
    """Return an orange wall in front of a gray one, so close that both are in one region."""
    front = wall(0.0, torch.tensor([0.8, 0.5, 0.2]))
    back = wall(0.4, torch.tensor([0.5, 0.5, 0.5]))
    return Gaussians(**{name: torch.cat([getattr(front, name), getattr(back, name)]) for name in ATTRIBUTES})


def ahead(width: float = 0.6) -> Camera:
    """Return a camera in front of the walls; `width` (radians) is its field of view, 0.6 shows them whole."""
    viewmat = look_at(torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]))
    return Camera(viewmat, intrinsics(width, 96, 96), 96, 96)


def change_of(scene: Gaussians, camera: Camera, painted: Tensor) -> Tensor:
    """Return the change of the members' colors by one painted picture. [M,3]"""
    members = torch.arange(len(scene))
    crops = [crop_scene(scene, members, camera, (0, 0, 96, 96), WHITE, True)]
    return C0 * edit_few(scene, members, crops, [painted])[:, 0]


def test_hidden_wall_is_not_painted_with_the_front_wall() -> None:
    scene = two_walls()
    camera = ahead()
    painted = render_view(scene, camera, WHITE).clamp(0, 1)
    painted[24:72, 24:72] = torch.tensor([0.1, 0.2, 0.9])
    change = change_of(scene, camera, painted)
    middle = (scene.means[:, :2].abs() < 0.4).all(dim=1)
    front = middle & (scene.means[:, 2] == 0.0)
    back = middle & (scene.means[:, 2] > 0.0)
    assert float(change[front, 2].mean()) > 0.6  # 0.7 is fully blue
    assert float(change[back].abs().max()) < 0.05


def test_unclear_members_are_solved_only_with_a_second_picture() -> None:
    scene = wall(0.0, torch.zeros(3))
    cameras = (ahead(), ahead(0.8))
    crops = [crop_scene(scene, torch.arange(len(scene)), c, (0, 0, 96, 96), WHITE, True) for c in cameras]
    original = pack(scene, with_shN=False)
    none_clear = torch.zeros(len(scene), dtype=torch.bool)
    ties = Ties(surface_graph(scene, none_clear), none_clear)  # no picture shows a member clearly
    asked = [make_solver(color_views(crops[:n], original), original, ties).asked for n in (1, 2)]
    assert not bool(asked[0].any())
    assert float(asked[1].float().mean()) > 0.9


def test_members_beside_the_picture_follow_a_fill() -> None:
    scene = wall(0.0, torch.tensor([0.8, 0.5, 0.2]))
    camera = ahead(0.3)  # only the middle of the wall is visible
    painted = render_view(scene, camera, WHITE).clamp(0, 1) * 0.5
    change = change_of(scene, camera, painted)
    corner = (scene.means[:, :2].abs() > 0.9).all(dim=1)
    assert float((change[corner] - torch.tensor([-0.4, -0.25, -0.1])).abs().max()) < 0.05


def test_map_degree_for_few_pictures_is_chosen_by_maps_alone() -> None:
    rng = torch.Generator().manual_seed(0)
    camera = ahead(0.3)
    gray = 0.4 + 0.2 * torch.rand(SIDE * SIDE, 1, generator=rng).expand(-1, 3)
    scene = replace(wall(0.0, torch.zeros(3)), sh0=rgb_to_sh0(gray).clone())
    painted = [render_view(scene, camera, WHITE).clamp(0, 1) * 0.9]
    painted[0][:, 48:] *= 0.5  # a residual fits this better than any map
    crops = [crop_scene(scene, torch.arange(len(scene)), camera, (0, 0, 96, 96), WHITE, True)]
    original = pack(scene, with_shN=False)
    none_clear = torch.zeros(len(scene), dtype=torch.bool)
    solver = make_solver(
        color_views(crops, original), original, Ties(surface_graph(scene, none_clear), ~none_clear)
    )
    by, judge = split_solver(solver, painted)
    _, model = choose_model(solver, (by, judge), painted, 20, 1)
    found = dict(model.tried)
    assert found["with a residual held by 1e-08"] > found["map of degree 3"] + 1.0
    for degree in (1, 2, 3):
        assert found[f"map of degree {degree}"] == decibels(judge.error(by.fit_map(degree, painted)[1]))
    assert model.bands == 1


def test_members_beside_the_picture_take_the_nearest_of_two_paints() -> None:
    scene = wall(0.0, torch.zeros(3))
    camera = ahead(0.3)
    right = camera.viewmat[0, :3] @ scene.means.T  # outside the picture beyond 0.5
    gray = 0.4 + 0.2 * torch.rand(len(scene), generator=torch.Generator().manual_seed(0))
    scene = replace(scene, sh0=rgb_to_sh0(gray[:, None].expand(-1, 3)).clone())
    painted = torch.tensor([0.9, 0.2, 0.2]).expand(96, 96, 3).clone()
    painted[:, 48:] = torch.tensor([0.2, 0.2, 0.9])
    change = change_of(scene, camera, painted)
    colors = gray[:, None] + change
    for side, channel in ((right < -0.8, 0), (right > 0.8, 2)):
        found = colors[side].mean(dim=0)
        assert float(found[channel] - found[2 - channel]) > 0.15  # of 0.7, where the other paint is far
        assert abs(float(found[1]) - 0.2) < 0.03  # the value in both paints


def test_half_continues_beyond_the_picture_but_a_pattern_does_not() -> None:
    scene, camera = wall(0.0, torch.zeros(3)), ahead(0.3)
    right, down = (camera.viewmat[i, :3] @ scene.means.T for i in (0, 1))
    gray = 0.4 + 0.2 * torch.rand(len(scene), generator=torch.Generator().manual_seed(0))
    scene = replace(scene, sh0=rgb_to_sh0(gray[:, None].expand(-1, 3)).clone())
    paint = torch.tensor([0.2, 0.3, 0.6])

    def taken(masked: Tensor) -> Tensor:
        """Return each member's share of the paint, for a picture in which `masked` is painted. [M]"""
        colors = gray[:, None] + masked[:, None] * (paint - 0.5 * gray[:, None])
        truth = replace(scene, sh0=rgb_to_sh0(colors).clone())
        change = change_of(scene, camera, render_view(truth, camera, WHITE).clamp(0, 1))
        return change.sum(dim=1) / (paint - 0.5 * gray[:, None]).sum(dim=1)

    half = taken((right > 0.0).float())
    for side, low, high in ((right > 0.8, 0.8, 1.0), (right < -0.8, 0.0, 0.2)):
        assert low < float(half[side].mean()) < high
        assert float(half[side].std()) < 0.1
    stripes = taken(((down * 12.0).floor() % 2.0 == 0.0).float())
    assert 0.35 < float(stripes[right.abs() > 0.8].mean()) < 0.65
    assert float(stripes[right.abs() > 0.8].std()) < 0.1


def test_residual_without_held_out_gain_stays_close_to_its_neighbors() -> None:
    scene = wall(0.0, torch.tensor([0.8, 0.5, 0.2]))
    camera = ahead(0.3)
    crops = [crop_scene(scene, torch.arange(len(scene)), camera, (0, 0, 96, 96), WHITE, True)]
    original = pack(scene, with_shN=False)
    none_clear = torch.zeros(len(scene), dtype=torch.bool)
    solver = make_solver(
        color_views(crops, original), original, Ties(surface_graph(scene, none_clear), ~none_clear)
    )
    fill = torch.full((96, 96, 3), 0.3)
    two_paints = torch.eye(3)[torch.arange(96) // 48].expand(96, 96, 3)
    for paint, near in ((fill, True), (two_paints.contiguous(), False)):
        _, model = choose_model(solver, split_solver(solver, [paint]), [paint], 20, 1)
        assert (model.hold == 1e-3) is near
        assert "residual of 1 SH function. Candidates, held-out dB: " in model.line
        assert model.line.endswith("Rule: smallest error; with few pictures --quality sets the packing only")


def test_pixels_without_members_are_no_error() -> None:
    scene = wall(0.0, torch.tensor([0.8, 0.5, 0.2]))
    camera = ahead()
    members = (scene.means[:, 0] < 0.0).nonzero()[:, 0]
    crops = [crop_scene(scene, members, camera, (0, 0, 96, 96), WHITE, True)]
    original = pack(scene[members], with_shN=False)
    views = color_views(crops, original)
    same = render_view(scene, camera, WHITE)
    still = torch.zeros(len(members), 1, 3)
    share = views[0].share.view(96, 96, 1)
    assert ColorEvaluator(views, [same]).mean(still, 1.0) < 1e-3
    assert ColorEvaluator(views, [same.where(share > 0.0, torch.zeros(3))]).mean(still, 1.0) < 1e-3
    black = ColorEvaluator(views, [torch.zeros_like(same)]).mean(still, 1.0)
    assert abs(black - 0.5) < 0.05  # the mean of the wall's color
