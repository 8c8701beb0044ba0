"""Choice of the cameras for training and the held-out cameras."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.camera import Camera, Lens, intrinsics, look_at
from progdf.errors import ProgdfError
from progdf.formats.ply import save_ply
from progdf.gaussians import Gaussians
from progdf.io.cameras import save_cameras
from progdf.region import from_mask
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.demo_scenes import bear, room
from tests.helpers.nerfstudio import move_scene, write_frames, write_transforms
from tests.helpers.scenes import concatenate, front_camera, one_gaussian, orbit_camera, random_gaussians
from tests.helpers.trained import WHITE, Small, small
from trainer.options import TrainingViewOptions
from trainer.views.choose import (
    ViewChoice,
    Visibility,
    choose_views,
    in_frame,
    load_given_cameras,
    sample_members,
    split_held_out,
    split_views,
)
from trainer.views.setup import make_training_setup


def test_camera_facing_away_is_left_out() -> None:
    case = small()
    camera = case.views[0].camera
    turned = replace(
        camera, viewmat=torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ camera.viewmat, name="x"
    )
    cameras = [turned, *(view.camera for view in case.views)]
    chosen = choose_views(case.scene, case.region, cameras, 96, WHITE)
    assert "x" not in {view.camera.name for view in chosen.views}
    assert chosen.line() == "6 of 7 cameras; 1 do not see the region"
    with pytest.raises(ProgdfError, match="sees the region"):
        choose_views(case.scene, case.region, [turned], 96, WHITE)


def test_chosen_views_are_spread_around_the_region() -> None:
    case = small(count=6)
    chosen = choose_views(case.scene, case.region, [view.camera for view in case.views], 3, WHITE).views
    center = case.scene.means[case.region.members].mean(dim=0)
    directions = torch.nn.functional.normalize(
        torch.stack([view.camera.position - center for view in chosen]), dim=1
    )
    assert len(chosen) == 3
    assert float((directions @ directions.T - torch.eye(3)).max()) < 0.8


def test_held_out_views_are_not_trained_on() -> None:
    case = small(count=6)
    train, held_out = split_views(choice_of(case), 2)
    assert len(train) == 4
    assert len(held_out) == 2
    assert not {v.camera.name for v in train} & {v.camera.name for v in held_out}


def around(case: Small, azimuths: list[float], name: str = "a", size: int = 64) -> list[Camera]:
    """Return cameras at these azimuths (degrees) around the region, at three heights in turn."""
    center = case.scene.means[case.region.members].mean(dim=0)
    up = torch.tensor([0.0, 1.0, 0.0])
    cameras = []
    for i, azimuth in enumerate(math.radians(a) for a in azimuths):
        eye = center + 2.5 * torch.tensor([math.sin(azimuth), 0.3 + 0.2 * (i % 3), math.cos(azimuth)])
        viewmat = look_at(eye, center, up)
        cameras.append(Camera(viewmat, intrinsics(0.6, size, size), size, size, f"{name}{i:03d}"))
    return cameras


def azimuths_of(case: Small, cameras: list[Camera]) -> list[float]:
    center = case.scene.means[case.region.members].mean(dim=0)
    places = [camera.position - center for camera in cameras]
    return sorted(math.degrees(math.atan2(float(p[0]), float(p[2]))) for p in places)


def widest_gap(azimuths: list[float]) -> float:
    return max(b - a for a, b in zip(azimuths, [*azimuths[1:], azimuths[0] + 360], strict=True))


def crowded(case: Small) -> list[Camera]:
    """Return forty cameras at nearly one position, then thirty around the region."""
    return around(case, [0.1 * i for i in range(40)], "still") + around(case, [12.0 * i for i in range(30)])


def choice_of(case: Small) -> ViewChoice:
    cameras = [view.camera for view in case.views]
    return choose_views(case.scene, case.region, cameras, len(cameras), WHITE)


@pytest.mark.parametrize("count", [8, 24])
def test_views_are_chosen_from_all_around_not_in_list_order(count: int) -> None:
    case = small("head")
    chosen = choose_views(case.scene, case.region, crowded(case), count, WHITE)
    assert len(chosen.views) == count
    assert widest_gap(azimuths_of(case, [view.camera for view in chosen.views])) < 1.8 * 360 / count
    assert f"{70 - count} are redundant" in chosen.line()


def test_list_order_does_not_choose_the_views() -> None:
    case = small("head")
    cameras = around(case, [9.0 * i for i in range(40)])
    shuffled = [cameras[i] for i in torch.randperm(40, generator=torch.Generator().manual_seed(1)).tolist()]
    chosen, again, other = (
        choose_views(case.scene, case.region, some, 8, WHITE) for some in (cameras, cameras, shuffled)
    )
    names = [view.camera.name for view in chosen.views]
    assert names == [view.camera.name for view in again.views]
    assert len(set(names) & {view.camera.name for view in other.views}) >= 6, "ties go by the order"
    assert widest_gap(azimuths_of(case, [view.camera for view in other.views])) < 81
    order = [camera.name for camera in shuffled]
    assert sorted((v.camera.name for v in other.views), key=order.index) == [
        v.camera.name for v in other.views
    ]


def test_held_out_views_are_on_all_sides_for_any_order() -> None:
    case = small("head")
    azimuths = [15.0 * i for i in range(24)]
    order = torch.randperm(24, generator=torch.Generator().manual_seed(2)).tolist()
    cameras = around(case, [azimuths[i] for i in order])
    train, held_out = split_views(choose_views(case.scene, case.region, cameras, 24, WHITE), 4)
    assert len(train) == 20
    assert widest_gap(azimuths_of(case, [view.camera for view in held_out])) < 150
    assert widest_gap(azimuths_of(case, [view.camera for view in train])) < 50


def test_views_from_inside_show_every_wall() -> None:
    """Place cameras in a box, mostly facing one wall; six views must show all four."""
    side = torch.linspace(-1, 1, 12)
    first, second = (axis.flatten() for axis in torch.meshgrid(side, side, indexing="ij"))
    walls = [torch.stack([first, second, torch.full_like(first, d)], dim=1)[:, order]
             for d in (-1.0, 1.0) for order in ([0, 1, 2], [2, 1, 0])]  # fmt: skip
    unseen = torch.tensor([[0.0, 50.0, 0.0]]).expand(600, 3)
    means = torch.cat([unseen, *walls])
    n = len(means)
    scene = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4).clone(), torch.full((n, 3), -2.5),
        torch.full((n,), 2.0), torch.zeros(n, 3), torch.zeros(n, 0, 3),
    )  # fmt: skip
    up = torch.tensor([0.0, 1.0, 0.0])
    K = intrinsics(1.2, 64, 64)
    targets = [(0.02 * i, 0.0, 1.0) for i in range(30)] + [(1.0, 0, 0.1), (-1.0, 0, 0.1), (0.1, 0, -1.0)]
    cameras = [
        Camera(look_at(torch.tensor([0.0, 0.0, 0.01 * i]), torch.tensor(t), up), K, 64, 64, f"v{i}")
        for i, t in enumerate(targets)
    ]
    region = from_mask("walls", torch.arange(n) >= len(unseen))
    chosen = choose_views(scene, region, cameras, 6, WHITE)
    assert {"v30", "v31", "v32"} <= {view.camera.name for view in chosen.views}


def test_indoor_scene_uses_free_places_or_its_own_cameras(tmp_path: Path) -> None:
    demo = room(1500)
    save_ply(tmp_path / "room.ply", demo.gaussians)
    settings = TrainingViewOptions(views=6, image_size=48)
    region = from_mask("rug", torch.isin(torch.arange(1500), demo.members("rug")))
    placed = make_training_setup(settings, demo.gaussians, region)
    assert len(placed.train) >= 4
    assert placed.held_out
    assert any("at free places around the region (a guess" in note for note in placed.notes)
    save_cameras(tmp_path / "c.json", [replace(c, lens=Lens(k1=0.1)) for c in demo.cameras])
    setup = make_training_setup(replace(settings, cameras=tmp_path / "c.json"), demo.gaussians, region)
    assert len(setup.train) + len(setup.held_out) == 6
    assert "6 of 32 cameras" in setup.notes[1]
    assert "photographs:EDITED,ORIGINALS" in setup.notes[2]


def picked(visible: Tensor, held_out: int) -> list[int]:
    """Return the held-out views for this visibility [V,S], with all members seen from one side."""
    views = tuple(replace(small().views[0], box=(i, 0, 64, 64)) for i in range(len(visible)))
    toward = torch.tensor([0.0, 0.0, 1.0]).expand(*visible.shape, 3)
    train, held = split_views(ViewChoice(views, Visibility(visible, toward, 1.0), len(views), 0, 0), held_out)
    assert [view.box[0] for view in train] == [
        i for i in range(len(views)) if i not in {v.box[0] for v in held}
    ]
    return [view.box[0] for view in held]


def test_redundant_views_are_held_out_from_each_side() -> None:
    visible = torch.zeros(6, 4)
    visible[:3, 0] = visible[3:, 2] = 1.0
    visible[1, :2] = 1.0  # view 1 covers views 0 and 2, but they do not cover view 1
    visible[5, 2:] = 1.0
    visible[0, 2:] = 0.4  # adds nothing once view 5 is held out
    visible[5, 0] = 0.1
    assert picked(visible, 1) == [5]
    assert picked(visible, 2) == [1, 5], "in the order of the list"


def test_held_out_views_split_into_choosing_and_reporting_halves() -> None:
    assert split_held_out(range(6)) == (range(0, 6, 2), range(1, 6, 2))
    assert split_held_out("a") == ("a", "a")


def test_at_most_a_third_is_held_out_and_no_view_twice() -> None:
    assert picked(torch.ones(6, 3), 5) == [0, 1]
    assert picked(torch.ones(2, 3), 1) == []


def test_camera_that_shows_the_region_small_is_dropped_and_reported() -> None:
    case = small("head")
    near = around(case, [0.0, 90.0, 180.0, 270.0])
    far = replace(near[0], K=near[0].K * torch.tensor([[0.2, 1, 1], [1, 0.2, 1], [1, 1, 1]]), name="far")
    little = replace(near[1].resize(24, 24), name="little")
    chosen = choose_views(case.scene, case.region, [*near, far, little], 96, WHITE)
    assert [view.camera.name for view in chosen.views] == [*(c.name for c in near), "little"]
    assert chosen.line() == "5 of 6 cameras; 1 see too little of the region"


def test_region_behind_a_wall_is_seen_from_its_side() -> None:
    member = one_gaussian(mean=(0.0, 0.0, 0.0), scales=(0.1, 0.1, 0.1))
    layers = [
        one_gaussian((0.0, 0.0, -0.5 - 0.1 * i), (9.0, 9.0, 0.01), (1, 0, 0, 0), opacity=0.999)
        for i in range(6)
    ]
    scene = concatenate(member, *layers)
    region = from_mask("hidden", torch.arange(len(scene)) == 0)
    before = [orbit_camera(64, 64, azimuth=0.05 * i) for i in range(5)]
    behind = [orbit_camera(64, 64, azimuth=math.pi + 0.4 * i, elevation=0.2 * i) for i in range(2)]
    cameras = [replace(c, name=str(i)) for i, c in enumerate([*before, *behind])]
    chosen = choose_views(scene, region, cameras, 96, WHITE)
    assert [view.camera.name for view in chosen.views] == ["5", "6"]
    assert chosen.line() == "2 of 7 cameras; 5 do not see the region"


def test_gaussian_reaching_into_the_picture_is_seen() -> None:
    scene = one_gaussian(mean=(0.9, 0.0, 1.0), scales=(0.3, 0.3, 0.3))
    region = from_mask("all", torch.tensor([True]))
    camera = front_camera(64, 64, focal=50.0)
    assert len(choose_views(scene, region, [camera], 1, WHITE).views) == 1


def test_frame_extends_half_a_picture_beyond_its_edges() -> None:
    camera = replace(orbit_camera(60, 40, azimuth=0.8, elevation=0.5), name="odd")
    depth = torch.tensor(3.0)
    pixels = torch.tensor([[30.0, 20.0], [-29, 20], [-31, 20], [89, 59], [30, 61], [30, 20]])
    rays = torch.linalg.solve(camera.K, torch.cat([pixels, torch.ones(6, 1)], dim=1).T).T * depth
    rays[5] *= -1  # behind
    places = rays @ camera.c2w[:3, :3].T + camera.position
    assert in_frame(places, camera).tolist() == [True, True, False, True, False, False]


def test_requested_number_of_views_is_chosen_even_if_all_are_alike() -> None:
    case = small("head")
    same = [replace(case.views[0].camera, name=str(i)) for i in range(5)]
    assert len(choose_views(case.scene, case.region, same, 3, WHITE).views) == 3


def test_wide_view_covers_a_narrow_view_but_not_vice_versa() -> None:
    left, right = (one_gaussian(mean=(x, 0.0, 4.0), scales=(0.3, 0.3, 0.3)) for x in (-0.7, 0.7))
    scene = concatenate(left, right)
    wide = front_camera(64, 64, focal=80.0)
    narrow = replace(
        wide, K=wide.K + torch.tensor([[0.0, 0, 40], [0, 0, 0], [0, 0, 0]])
    )  # only the left Gaussian
    region = from_mask("both", torch.ones(2, dtype=torch.bool))
    shown = choose_views(scene, region, [wide, narrow], 2, WHITE).shown
    shares = [
        float((shown.visible * shown.coverage_by(k))[1 - k].sum() / shown.visible[1 - k].sum())
        for k in (0, 1)
    ]
    assert shares[0] > 0.9
    assert shares[1] < 0.6


def test_members_are_sampled_all_over_the_region() -> None:
    scene = random_gaussians(2000, scale=0.01)
    scene = replace(scene, log_scales=torch.full((2000, 3), -4.0), logit_opacities=torch.zeros(2000))
    rows = sample_members(scene, from_mask("half", torch.arange(2000) >= 1000))
    assert len(rows) == 256
    assert int(rows[0]) - 1000 <= 4
    assert 1999 - int(rows[-1]) <= 4
    assert int(rows.diff().max()) <= 5


def test_rig_has_the_requested_size_and_grows_if_views_see_nothing() -> None:
    """Use every camera of an even rig.

    The best cameras of a larger rig crowd where the region is most visible, and a removed one leaves a gap.
    """
    case = small("head")
    settings = TrainingViewOptions(views=10, image_size=48)
    setup = make_training_setup(settings, case.scene, case.region)
    assert [view.camera.name for view in setup.train] == [f"orbit_{i:03d}" for i in range(8)]
    assert [view.camera.name for view in setup.held_out] == ["between_000", "between_004"]
    azimuths = azimuths_of(case, [view.camera for view in setup.views])
    steps = [b - a for a, b in zip(azimuths, [*azimuths[1:], azimuths[0] + 360], strict=True)]
    assert sorted(steps) == pytest.approx([22.5] * 4 + [45.0] * 6, abs=2.0)
    wall = [
        one_gaussian((0.0, 0.2, -0.5 - 0.1 * i), (0.6, 0.6, 0.01), (1, 0, 0, 0), opacity=0.999)
        for i in range(6)
    ]
    member = one_gaussian(mean=(0.0, 0.0, 0.0), scales=(0.1, 0.1, 0.1))
    scene = concatenate(member, *wall)
    region = from_mask("hidden", torch.arange(len(scene)) == 0)
    hidden = make_training_setup(replace(settings, up="+y", dense=False), scene, region)  # not from above
    assert 4 < len(hidden.train) <= 8
    assert 1 <= len(hidden.held_out) <= 2
    offered = re.fullmatch(r"\d of (\d+) cameras; \d+ do not see the region.*", hidden.notes[-1])
    assert offered is not None, hidden.notes
    assert int(offered[1]) > 8, "a larger rig"


def test_tilted_cameras_are_reported(tmp_path: Path) -> None:
    scene = bear(3000).gaussians
    for up, is_reported in (("y", False), ("x", True)):
        direction = torch.tensor([float(axis == up) for axis in "xyz"])
        save_cameras(tmp_path / "c.json", orbit_rig(scene, 8, 48, 48, up=direction))
        found = load_given_cameras(TrainingViewOptions(tmp_path / "c.json"), scene)
        assert any("cameras are tilted by 9" in note for note in found.notes) == is_reported


def test_dataset_cameras_of_another_frame_are_refused(tmp_path: Path) -> None:
    scene = bear(3000).gaussians
    up = torch.tensor([0.0, 1.0, 0.0])
    cameras = write_frames(tmp_path / "transforms.json", orbit_rig(scene, 8, 48, 48, up=up))
    to_z_up = look_at(
        torch.tensor([0.3, 0.2, 0.1]), torch.tensor([0.3, 3.0, 0.1]), torch.tensor([0.0, 0.0, 1.0])
    )
    trained = move_scene(scene, to_z_up.double(), 0.23)
    options = TrainingViewOptions(cameras, scene=tmp_path / "point_cloud.ply")
    with pytest.raises(ProgdfError, match=r"not in the frame of .*point_cloud\.ply.*dataparser"):
        load_given_cameras(options, trained)
    assert len(load_given_cameras(replace(options, cameras_anyway=True), trained).cameras) == 8
    assert len(load_given_cameras(options, scene).cameras) == 8
    write_transforms(tmp_path, to_z_up.double(), 0.23)
    assert "nerfstudio's frame" in load_given_cameras(options, trained).notes[0]


def test_dataset_cameras_looking_straight_down_pass(tmp_path: Path) -> None:
    scene = room(3000).gaussians
    above = [
        Camera(
            look_at(torch.tensor([x, 1.5, 0.0]), torch.tensor([x, 0.0, 0.0]), up),
            intrinsics(1.0, 48, 48),
            48,
            48,
        )
        for x in (-0.5, 0.0, 0.5)
        for up in (torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.9, 0.0, 0.1]))
    ]
    cameras = write_frames(tmp_path / "transforms.json", above)
    options = TrainingViewOptions(cameras, scene=tmp_path / "s.ply")
    assert len(load_given_cameras(options, scene).cameras) == 6
