"""Views: the box that an edit can change, masks, names, and camera rigs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.camera import Lens, undistort
from progdf.errors import ProgdfError
from progdf.io.images import write_image
from progdf.rasterize import render
from progdf.region import from_mask
from progdf.scene.bounds import scene_sphere
from progdf.sh import shade
from tests.helpers.scenes import (
    ball,
    concatenate,
    front_camera,
    one_gaussian,
    orbit_camera,
    random_gaussians,
)
from tests.helpers.trained import small
from trainer.editors import check_new_editor, make_editor
from trainer.editors.pictures import FolderEditor, photographs_note
from trainer.options import EditorOptions
from trainer.views.view import fit_size, make_view, name_cameras, region_box, region_rig, seen_colors


def test_box_grows_to_the_edited_pixels() -> None:
    view = small().views[0]
    moved = view.image.clone()
    moved[0, 0] = 1.0 - moved[0, 0]
    x0, y0, x1, y1 = view.widen([moved, view.image]).box
    rows, columns = (view.mask > 0.05).nonzero().unbind(dim=1)
    assert (x0, y0) == (0, 0)
    assert x1 > int(columns.max())
    assert y1 > int(rows.max())
    assert view.widen([view.image]).box == view.box


def test_rig_fills_the_picture_with_a_small_region() -> None:
    case = small("scarf", size=1500)
    for view in case.views:
        x0, y0, x1, y1 = view.box
        width = view.camera.width
        height = view.camera.height
        assert max((x1 - x0) / width, (y1 - y0) / height) > 0.4


def test_view_names_are_distinct_and_valid_file_names() -> None:
    camera = small().views[0].camera
    names = ["images/a.png", "a.JPG", "", "../..", "b c", "../../e.tif", "C:\\d\\f.png", "/g/CON/h", "0.5/i"]
    found = [c.name for c in name_cameras([replace(camera, name=name) for name in names])]
    assert found == ["images/a", "a", "view_002", "view_003", "b_c", "e", "d/f", "view_007", "0_5/i"]


def test_view_names_are_distinct_files_on_windows_and_macos() -> None:
    camera = small().views[0].camera
    names = ["Front", "front", "caf\u00e9", "cafe\u0301", "CON", "nul.x", "a.", "LPT1.png"]
    found = [c.name for c in name_cameras([replace(camera, name=name) for name in names])]
    assert found == ["Front", "view_001", "caf\u00e9", *(f"view_{i:03d}" for i in range(3, 8))]


def test_name_too_long_for_a_file_is_cut() -> None:
    camera = small().views[0].camera
    first, second = (c.name for c in name_cameras([replace(camera, name="\U00020000" * 300)] * 2))
    assert len(f"{first}.png".encode()) < 250
    assert second == "view_001"


def test_edited_photographs_are_undistorted_before_training(tmp_path: Path) -> None:
    case = small()
    lens = Lens(k1=2.5)
    view = replace(case.views[0], camera=replace(case.views[0].camera, lens=lens))
    (tmp_path / "p").mkdir()
    checks = (
        ((torch.arange(72)[:, None] // 6 + torch.arange(72) // 6) % 2).float()[..., None].expand(-1, -1, 3)
    )
    write_image(tmp_path / "p" / f"{view.camera.name}.png", checks)
    raw = make_editor(EditorOptions(f"folder:{tmp_path / 'p'}"), case.scene, case.region, [view]).edit(
        view, 1.0
    )
    straight = make_editor(
        EditorOptions(f"photographs:{tmp_path / 'p'}"), case.scene, case.region, [view]
    ).edit(view, 1.0)
    assert torch.equal(raw, checks)
    expected, shown = undistort(checks, view.camera.K, lens)
    assert torch.equal(straight[shown], expected[shown])
    assert torch.equal(straight[~shown], view.image[~shown]), "what no photograph shows stays as it is"
    assert float((straight - raw).abs().mean()) > 0.01
    plain = replace(view, camera=replace(view.camera, lens=None))
    editor = make_editor(EditorOptions(f"photographs:{tmp_path / 'p'}"), case.scene, case.region, [plain])
    assert torch.equal(editor.edit(plain, 1.0), raw)


def test_only_the_change_from_the_original_photographs_is_trained(tmp_path: Path) -> None:
    case = small()
    view = case.views[0]
    sharp = (
        view.image + 0.2 * torch.rand(view.image.shape, generator=torch.Generator().manual_seed(0))
    ) / 1.2
    painted = sharp.clone()
    painted[20:40, 30:50] = torch.tensor([0.1, 0.3, 0.9])
    for folder, picture in (("before", sharp), ("after", painted)):
        write_image(tmp_path / folder / f"{view.camera.name}.png", picture)
    spec = f"photographs:{tmp_path / 'after'},{tmp_path / 'before'}"
    editor = make_editor(EditorOptions(spec), case.scene, case.region, [view])
    made = editor.edit(view, 1.0)
    untouched = torch.ones(made.shape[:2], dtype=torch.bool)
    untouched[20:40, 30:50] = False
    torch.testing.assert_close(made[untouched], view.image[untouched], atol=1e-6, rtol=0)
    expected = (view.image + painted - sharp).clamp(0, 1)
    torch.testing.assert_close(made, expected, atol=1.5 / 255, rtol=0)  # both files are rounded to 8 bits
    alone = make_editor(EditorOptions(f"photographs:{tmp_path / 'after'}"), case.scene, case.region, [view])
    torch.testing.assert_close(alone.edit(view, 1.0), painted, atol=0.6 / 255, rtol=0)
    assert isinstance(editor, FolderEditor)
    assert isinstance(alone, FolderEditor)
    assert photographs_note(spec.partition(":")[2]) == ""
    assert "photographs:EDITED,ORIGINALS" in photographs_note(str(tmp_path / "after"))


@pytest.mark.parametrize(
    "spec", ["photographs:", "photographs:{0},", "photographs:{0},{0}/no", "photographs:{0}/no"]
)
def test_missing_photographs_are_a_one_line_error(tmp_path: Path, spec: str) -> None:
    with pytest.raises(ProgdfError, match="; ") as caught:
        check_new_editor(EditorOptions(spec.format(tmp_path)))
    assert "\n" not in str(caught.value)


def test_missing_original_photograph_is_refused_before_training(tmp_path: Path) -> None:
    case = small(count=3)
    (tmp_path / "before").mkdir()
    for view in case.views:
        write_image(tmp_path / f"{view.camera.name}.png", view.image)
    with pytest.raises(ProgdfError, match=r"before has no picture .*; put the photographs there"):
        make_editor(
            EditorOptions(f"photographs:{tmp_path},{tmp_path / 'before'}"),
            case.scene,
            case.region,
            case.views,
        )


def test_blend_mixes_new_colors_like_the_original() -> None:
    view = small().views[0]
    assert float((view.blend(view.inside) - view.image).abs().max()) < 1e-6, "nothing changed"
    green = torch.tensor([0.1, 0.8, 0.2]).expand_as(view.image)
    expected = view.image + view.mask[..., None] * (green - view.inside)
    soft = (view.mask > 0.02) & (view.mask < 0.98)
    assert int(soft.sum()) > 20
    torch.testing.assert_close(view.blend(green)[soft], expected.clamp(0, 1)[soft])
    assert torch.equal(view.blend(green)[view.mask == 0], view.image[view.mask == 0])


def test_confine_restores_the_outside_and_keeps_masks_above_a_fifth() -> None:
    view = replace(small().views[0], mask=torch.tensor([0.0, 0.1, 0.2, 1.0]).repeat_interleave(18)[:, None])
    edited = 1 - view.image
    found = view.confine(edited)
    assert torch.equal(found[:18], view.image[:18])
    torch.testing.assert_close(found[18:36], torch.full_like(found[18:36], 0.5))
    torch.testing.assert_close(found[36:], edited[36:])


def test_box_grows_with_a_single_channel_but_not_with_invisible_change() -> None:
    view = small().views[0]
    faint = view.image.clone()
    blue = view.image.clone()
    faint[0, 0] += 0.04
    blue[0, 0, 2] -= 0.06
    assert view.widen([faint]).box == view.box
    assert view.widen([blue]).box[:2] == (0, 0)


def test_view_shows_the_scene_and_the_color_of_its_region() -> None:
    behind = one_gaussian(mean=(0.1, 0.0, 3.0), scales=(0.3, 0.3, 0.3), rgb=(0.1, 0.2, 0.9))
    scene = concatenate(
        behind, one_gaussian(mean=(-0.1, 0.0, 2.0), scales=(0.2, 0.2, 0.2), rgb=(0.8, 0.3, 0.1))
    )
    scene = replace(scene, shN=0.1 * torch.randn(2, 15, 3, generator=torch.Generator().manual_seed(0)))
    region = from_mask("front", torch.tensor([False, True]))
    camera = front_camera(96, 80, focal=90.0)
    background = torch.tensor([0.2, 0.9, 0.4])
    view = make_view(scene, region, camera, background)
    torch.testing.assert_close(view.image, render(scene, camera, background).image.clamp(0, 1))
    alone = view.mask > 0.05
    assert int(alone.sum()) > 100
    own = seen_colors(scene, camera)[1].clamp(0, 1)
    torch.testing.assert_close(view.inside[alone], own.expand(int(alone.sum()), 3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors_of_a_view_match_plain_sh_and_the_rasterizer(degree: int) -> None:
    scene = random_gaussians(2000, seed=degree, sh_degree=degree)
    scene.sh0[7] = torch.nan
    camera = orbit_camera(64, 40)
    colors = seen_colors(scene, camera)
    directions = torch.nn.functional.normalize(scene.means - camera.position, dim=1)
    expected = shade(degree, directions, scene.sh)
    torch.testing.assert_close(colors, expected, atol=1e-6, rtol=0, equal_nan=True)
    assert torch.equal(render(scene, camera, colors=colors).image, render(scene, camera).image)


@pytest.mark.parametrize(
    ("rows", "columns", "box"),
    [
        ((60, 140), (100, 250), (94, 54, 256, 146)),  # six pixels all around
        ((100, 101), (150, 151), (118, 68, 182, 132)),  # 64 pixels, the spot in the middle
        ((0, 1), (0, 1), (0, 0, 64, 64)),
        ((199, 200), (299, 300), (236, 136, 300, 200)),
        ((0, 200), (0, 300), (0, 0, 300, 200)),
        ((0, 0), (0, 0), (0, 0, 300, 200)),  # nothing is visible
    ],
)
def test_box_has_a_margin_and_64_pixels_and_stays_in_the_picture(
    rows: tuple[int, int], columns: tuple[int, int], box: tuple[int, int, int, int]
) -> None:
    mask = torch.full((200, 300), 0.02)
    mask[slice(*rows), slice(*columns)] = 0.03
    assert region_box(mask) == box


def test_picture_below_64_pixels_is_all_box() -> None:
    assert region_box(torch.ones(40, 50)) == (0, 0, 50, 40)


def test_rig_fills_half_to_four_fifths_of_the_picture() -> None:
    scene = ball(400)
    region = from_mask("piece", (scene.means - torch.tensor([0.3, 0.0, 0.0])).norm(dim=1) < 0.25)
    center, radius = scene_sphere(scene[region.members])
    radius += float(scene.scales[region.members].amax(dim=1).median())
    shares = []
    for camera in region_rig(scene, region, 24, 100):
        distance = float((camera.position - center).norm())
        shares.append(0.02 * float(camera.K[0, 0]) * math.tan(math.asin(radius / distance)))
        ahead = camera.viewmat[:3, :3] @ center + camera.viewmat[:3, 3]
        torch.testing.assert_close(ahead[:2], torch.zeros(2), atol=1e-5, rtol=0)
    for some in (shares, shares[:12], shares[12:]):
        assert sorted(some) == pytest.approx(np.linspace(0.5, 0.8, len(some)), abs=0.07)


@pytest.mark.parametrize("shape", [(0.25, 0.25, 0.25), (0.4, 0.05, 0.1), (0.08, 0.3, 0.08)])
def test_rig_fills_most_of_the_picture_with_the_region(shape: tuple[float, float, float]) -> None:
    scene = ball(20000)
    offset = (scene.means - torch.tensor([0.3, 0.0, 0.0])) / torch.tensor(shape)
    region = from_mask("piece", offset.abs().amax(dim=1) < 1.0)
    scene = replace(scene, log_scales=torch.full_like(scene.means, -9.0))
    shares = []
    for camera in region_rig(scene, region, 24, 100, fills=True):
        positions = scene.means[region.members] @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = positions @ camera.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        low, high = pixels.quantile(0.015, dim=0), pixels.quantile(0.985, dim=0)
        torch.testing.assert_close((low + high) / 2, torch.full((2,), 50.0), atol=5.0, rtol=0)
        shares.append(float((high - low).max()) / 100)
    for some in (shares, shares[:12], shares[12:]):
        assert sorted(some) == pytest.approx(np.linspace(0.75, 0.95, len(some)), abs=0.07)


@pytest.mark.parametrize(
    ("size", "found"),
    [((400, 100), (64, 16)), ((100, 400), (16, 64)), ((64, 20), (64, 20)), ((20, 9), (20, 9))],
)
def test_longer_side_is_fitted_and_nothing_is_enlarged(size: tuple[int, int], found: tuple[int, int]) -> None:
    camera = fit_size(front_camera(*size), 64)
    assert (camera.width, camera.height) == found
