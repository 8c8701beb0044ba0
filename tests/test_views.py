"""Views: which cameras an edit is trained from, and what of their pictures an edit can change."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from progdf.camera import Camera, intrinsics, look_at
from progdf.camera_files import save_cameras
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.lens import Lens, straightened
from progdf.pictures import write_image
from progdf.ply import save_ply
from progdf.region import from_mask
from progdf.scenes import room
from tests.trained import WHITE, Small, small
from trainer.editors import make_editor
from trainer.options import TrainOptions
from trainer.preparation import make_stand
from trainer.view_choice import Choice, choose_views, split_views
from trainer.views import named


def test_a_box_grows_to_what_an_edit_changes() -> None:
    view = small().views[0]
    moved = view.image.clone()
    moved[0, 0] = 1.0 - moved[0, 0]
    x0, y0, x1, y1 = view.widened([moved, view.image]).box
    rows, columns = (view.mask > 0.05).nonzero().unbind(dim=1)
    assert (x0, y0) == (0, 0)
    assert x1 > int(columns.max())
    assert y1 > int(rows.max())
    assert view.widened([view.image]).box == view.box


def test_the_rig_covers_a_small_region_with_pixels() -> None:
    case = small("scarf", size=1500)
    for view in case.views:
        x0, y0, x1, y1 = view.box
        width, height = view.camera.width, view.camera.height
        assert max((x1 - x0) / width, (y1 - y0) / height) > 0.4


def test_a_camera_that_looks_away_is_left_out() -> None:
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


def test_fewer_views_than_there_are_cameras_are_spread_around_the_region() -> None:
    case = small(count=6)
    chosen = choose_views(case.scene, case.region, [view.camera for view in case.views], 3, WHITE).views
    centre = case.scene.means[case.region.members].mean(dim=0)
    directions = torch.nn.functional.normalize(
        torch.stack([view.camera.position - centre for view in chosen]), dim=1
    )
    assert len(chosen) == 3
    assert float((directions @ directions.T - torch.eye(3)).max()) < 0.8


def test_view_names_are_distinct_and_can_be_file_names() -> None:
    camera = small().views[0].camera
    names = ["images/a.png", "a.jpg", "", "x/../..", "b c"]
    found = [c.name for c in named([replace(camera, name=name) for name in names])]
    assert len(set(found)) == len(found)
    assert found[0] == "a"
    assert not any("/" in name or name.startswith(".") for name in found)


def test_held_out_views_are_not_trained_on() -> None:
    case = small(count=6)
    train, held_out = split_views(choice_of(case), 2)
    assert len(train) == 4
    assert len(held_out) == 2
    assert not {v.camera.name for v in train} & {v.camera.name for v in held_out}


# ------------------------------------------------------------------------------------ many cameras


def around(case: Small, azimuths: list[float], name: str = "a", size: int = 64) -> list[Camera]:
    """Cameras at these azimuths (degrees) around the region, at three heights in turn."""
    centre = case.scene.means[case.region.members].mean(dim=0)
    up = torch.tensor([0.0, 1.0, 0.0])
    cameras = []
    for i, azimuth in enumerate(math.radians(a) for a in azimuths):
        eye = centre + 2.5 * torch.tensor([math.sin(azimuth), 0.3 + 0.2 * (i % 3), math.cos(azimuth)])
        viewmat = look_at(eye, centre, up)
        cameras.append(Camera(viewmat, intrinsics(0.6, size, size), size, size, f"{name}{i:03d}"))
    return cameras


def azimuths_of(case: Small, cameras: list[Camera]) -> list[float]:
    centre = case.scene.means[case.region.members].mean(dim=0)
    places = [camera.position - centre for camera in cameras]
    return sorted(math.degrees(math.atan2(float(p[0]), float(p[2]))) for p in places)


def widest_gap(azimuths: list[float]) -> float:
    return max(b - a for a, b in zip(azimuths, [*azimuths[1:], azimuths[0] + 360], strict=True))


def crowded(case: Small) -> list[Camera]:
    """Someone stood still for forty pictures, then walked around once."""
    return around(case, [0.1 * i for i in range(40)], "still") + around(case, [12.0 * i for i in range(30)])


def choice_of(case: Small) -> Choice:
    cameras = [view.camera for view in case.views]
    return choose_views(case.scene, case.region, cameras, len(cameras), WHITE)


@pytest.mark.parametrize("count", [8, 24])
def test_views_are_taken_from_all_around_and_not_from_the_beginning_of_the_list(count: int) -> None:
    case = small("head")
    chosen = choose_views(case.scene, case.region, crowded(case), count, WHITE)
    assert len(chosen.views) == count
    assert widest_gap(azimuths_of(case, [view.camera for view in chosen.views])) < 1.8 * 360 / count
    assert f"{70 - count} show what others show" in chosen.line()


def test_the_order_of_the_list_does_not_choose_the_views() -> None:
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


def test_held_out_views_stand_on_all_sides_whatever_the_order() -> None:
    case = small("head")
    azimuths = [15.0 * i for i in range(24)]
    order = torch.randperm(24, generator=torch.Generator().manual_seed(2)).tolist()
    cameras = around(case, [azimuths[i] for i in order])
    train, held_out = split_views(choose_views(case.scene, case.region, cameras, 24, WHITE), 4)
    assert len(train) == 20
    assert widest_gap(azimuths_of(case, [view.camera for view in held_out])) < 150
    assert widest_gap(azimuths_of(case, [view.camera for view in train])) < 50


def test_views_from_within_show_every_wall() -> None:
    """Cameras stand in a box and mostly look at one wall; few views are to show all four."""
    side = torch.linspace(-1, 1, 12)
    first, second = (axis.flatten() for axis in torch.meshgrid(side, side, indexing="ij"))
    walls = [torch.stack([first, second, torch.full_like(first, d)], dim=1)[:, order]
             for d in (-1.0, 1.0) for order in ([0, 1, 2], [2, 1, 0])]  # fmt: skip
    means = torch.cat(walls)
    n = len(means)
    scene = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).expand(n, 4).clone(), torch.full((n, 3), -2.5),
        torch.full((n,), 2.0), torch.zeros(n, 3), torch.zeros(n, 0, 3),
    )  # fmt: skip
    up, K = torch.tensor([0.0, 1.0, 0.0]), intrinsics(1.2, 64, 64)
    targets = [(0.02 * i, 0.0, 1.0) for i in range(30)] + [(1.0, 0, 0.1), (-1.0, 0, 0.1), (0.1, 0, -1.0)]
    cameras = [
        Camera(look_at(torch.tensor([0.0, 0.0, 0.01 * i]), torch.tensor(t), up), K, 64, 64, f"v{i}")
        for i, t in enumerate(targets)
    ]
    region = from_mask("walls", torch.ones(n, dtype=torch.bool))
    chosen = choose_views(scene, region, cameras, 6, WHITE)
    assert {"v30", "v31", "v32"} <= {view.camera.name for view in chosen.views}


# --------------------------------------------------------------------------- photographs, and rooms


def test_edited_photographs_are_straightened_before_they_are_targets(tmp_path: Path) -> None:
    case = small()
    lens = Lens(k1=2.5)
    view = replace(case.views[0], camera=replace(case.views[0].camera, lens=lens))
    (tmp_path / "p").mkdir()
    checks = (
        ((torch.arange(72)[:, None] // 6 + torch.arange(72) // 6) % 2).float()[..., None].expand(-1, -1, 3)
    )
    write_image(tmp_path / "p" / f"{view.camera.name}.png", checks)
    raw = make_editor(f"folder:{tmp_path / 'p'}", case.scene, case.region, [view]).edit(view, 1.0)
    straight = make_editor(f"photographs:{tmp_path / 'p'}", case.scene, case.region, [view]).edit(view, 1.0)
    assert torch.equal(raw, checks)
    expected, shown = straightened(checks, view.camera.K, lens)
    assert torch.equal(straight[shown], expected[shown])
    assert torch.equal(straight[~shown], view.image[~shown]), "what no photograph shows stays as it is"
    assert float((straight - raw).abs().mean()) > 0.01
    plain = replace(view, camera=replace(view.camera, lens=None))
    editor = make_editor(f"photographs:{tmp_path / 'p'}", case.scene, case.region, [plain])
    assert torch.equal(editor.edit(plain, 1.0), raw)


def test_a_scene_to_stand_inside_asks_for_its_cameras(tmp_path: Path) -> None:
    demo = room(1500)
    save_ply(tmp_path / "room.ply", demo.gaussians)
    options = TrainOptions(tmp_path / "room.ply", tmp_path / "run", "all", "night", views=6, image_size=48)
    region = from_mask("rug", torch.isin(torch.arange(1500), demo.members("rug")))
    with pytest.raises(ProgdfError, match="--cameras") as told:
        make_stand(options, demo.gaussians, region)
    assert "\n" not in str(told.value)
    save_cameras(tmp_path / "c.json", [replace(c, lens=Lens(k1=0.1)) for c in demo.cameras])
    stand = make_stand(replace(options, cameras=tmp_path / "c.json"), demo.gaussians, region)
    assert len(stand.train) + len(stand.held_out) == 6
    assert "6 of 32 cameras" in stand.notes[0]
    assert "photographs:DIR" in stand.notes[1]
