"""Image editors: exact at strength 0, soft at edges, consistent across views; folders of edited views."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io.images import write_image
from progdf.rasterize import render
from progdf.sh import rgb_to_sh0, sh0_to_rgb
from tests.helpers.trained import WHITE, small
from trainer.editors import EDITORS, check_editor, make_editor
from trainer.editors.procedural import StripesEditor
from trainer.options import EditorOptions
from trainer.views.view import make_view

PROCEDURAL = (
    "recolor:#3060d0",
    "recolor:#3060d0,path=hue",
    "tint:#d4af37",
    "stripes:#20a040",
    "darken:0.7",
    "night",
    "grade:exposure=-0.8,temperature=0.6,contrast=0.3,saturation=0.4",
    "grade:exposure=-0.8,clarity=0.6",
)


@pytest.mark.parametrize("spec", PROCEDURAL)
def test_strength_zero_is_the_original_view_bit_for_bit(spec: str) -> None:
    case = small()
    editor = make_editor(EditorOptions(spec), case.scene, case.region, case.views)
    for view in case.views:
        assert torch.equal(editor.edit(view, 0.0), view.image)


@pytest.mark.parametrize("spec", PROCEDURAL)
def test_pixels_outside_the_region_keep_their_color(spec: str) -> None:
    case = small()
    view = case.views[0]
    edited = make_editor(EditorOptions(spec), case.scene, case.region, case.views).edit(view, 1.0)
    assert torch.equal(edited[view.mask == 0], view.image[view.mask == 0])
    assert float((edited - view.image).abs().max()) > 0.1, "and the region changes"


@pytest.mark.parametrize("spec", PROCEDURAL)
def test_edit_grows_continuously_with_strength(spec: str) -> None:
    case = small()
    view = case.views[0]
    editor = make_editor(EditorOptions(spec), case.scene, case.region, case.views)
    pictures = [editor.edit(view, s / 50) for s in range(51)]
    steps = [float((b - a).abs().max()) for a, b in pairwise(pictures)]
    assert max(steps) < 0.25


def test_background_sharing_a_pixel_with_the_region_is_not_edited() -> None:
    case = small()
    view = replace(
        case.views[0],
        image=torch.tensor([[[0.8, 0.6, 0.5]]]),  # half orange region, half white background
        mask=torch.tensor([[0.5]]),
        inside=torch.tensor([[[0.6, 0.2, 0.0]]]),
    )
    blue = torch.tensor([0.1, 0.2, 0.9])
    assert torch.allclose(view.blend(blue.expand(1, 1, 3)), 0.5 * blue + 0.5, atol=1e-6)


def test_mask_and_inside_rebuild_the_view_without_the_region() -> None:
    case = small()
    view = case.views[1]
    rest = view.image - view.mask[..., None] * view.inside
    hidden = replace(case.scene, sh0=case.scene.sh0.clone(), shN=case.scene.shN.clone())
    hidden.sh0[case.region.members] = -0.5 / 0.28209479177387814  # the region in black
    hidden.shN[case.region.members] = 0.0
    assert torch.allclose(rest, render(hidden, view.camera).image.clamp(0, 1), atol=2e-3)


def test_stripes_are_consistent_across_views() -> None:
    case = small("body")
    matt = replace(case.scene, shN=case.scene.shN[:, :0])
    views = [make_view(matt, case.region, view.camera, WHITE) for view in case.views]
    editor = make_editor(EditorOptions("stripes:#20a040"), matt, case.region, views)
    assert isinstance(editor, StripesEditor)
    rows = case.region.members
    painted = editor.paint(sh0_to_rgb(matt.sh0[rows]).clamp_min(0))(1.0)
    scene = replace(matt, sh0=matt.sh0.index_copy(0, rows, rgb_to_sh0(painted)))
    for view in views:
        expected = render(scene, view.camera).image.clamp(0, 1)
        difference = (editor.edit(view, 1.0) - expected).abs().amax(dim=2)
        # pixel colors are clamped to 1 before the edit, member colors are not
        assert float(difference.max()) < 0.05
        assert float((difference > 0.02).float().mean()) < 0.001
    share = float((editor.pattern > 0.5).float().mean())
    assert 0.3 < share < 0.7, "stripes, with the old color between them"


@pytest.mark.parametrize(
    "spec",
    [
        "recolor:blue",
        "recolor:#3060d0,path=green",
        "tint:#3060d0,hue",
        "darken:2",
        "darken:much",
        "night:0",
        "paint:#fff",
        "folder:",
    ],
)
def test_invalid_editor_is_a_one_line_error_with_a_remedy(spec: str) -> None:
    case = small()
    with pytest.raises(ProgdfError, match="; ") as caught:
        make_editor(EditorOptions(spec), case.scene, case.region, case.views)
    assert "\n" not in str(caught.value)


def test_every_editor_is_known_by_its_name() -> None:
    assert {check_editor(name)[0] for name in EDITORS} == set(EDITORS)


def test_folder_of_edited_views_round_trips(tmp_path: Path) -> None:
    case = small()
    half = [(0.5 * view.image * 255).round() / 255 for view in case.views]
    for view, picture in zip(case.views, half, strict=True):
        write_image(tmp_path / f"{view.camera.name}.png", picture)
        write_image(tmp_path / "0.5" / f"{view.camera.name}.png", view.image)
    editor = make_editor(EditorOptions(f"folder:{tmp_path}"), case.scene, case.region, case.views)
    assert editor.stages == (0.5, 1.0)
    for view, picture in zip(case.views, half, strict=True):
        assert torch.allclose(editor.edit(view, 1.0), picture, atol=1e-6)
        assert torch.allclose(editor.edit(view, 0.5), view.image, atol=0.5 / 255 + 1e-6)
        assert torch.equal(editor.edit(view, 0.0), view.image)


@pytest.mark.parametrize("kind", ["folder", "photographs"])
def test_edited_views_are_found_in_subfolders_in_any_case_and_format(tmp_path: Path, kind: str) -> None:
    case = small(count=3)
    names = ("cam0/1", "1/IMG_2", "0_5/3")
    files = ("cam0/1.TIF", "1/IMG_2.PNG", "0.5/3.bmp")
    views = []
    for view, name, file in zip(case.views[:3], names, files, strict=True):
        (tmp_path / file).parent.mkdir()
        Image.new("RGB", (view.camera.width, view.camera.height), "red").save(tmp_path / file)
        views.append(replace(view, camera=replace(view.camera, name=name)))
    editor = make_editor(EditorOptions(f"{kind}:{tmp_path}"), case.scene, case.region, views)
    assert editor.stages == (1.0,)
    for view in views:
        red = torch.tensor([1.0, 0.0, 0.0]).expand_as(view.image)
        assert torch.equal(editor.edit(view, 1.0), red)


def test_larger_edited_view_is_scaled_and_transparency_is_white(tmp_path: Path) -> None:
    case = small(count=3)
    for view in case.views:
        side = 2 * view.camera.width
        Image.new("RGBA", (side, side), (255, 0, 0, 0)).save(tmp_path / f"{view.camera.name}.png")
    editor = make_editor(EditorOptions(f"folder:{tmp_path}"), case.scene, case.region, case.views)
    assert torch.equal(editor.edit(case.views[0], 1.0), torch.ones_like(case.views[0].image))


@pytest.mark.parametrize(
    "damage", ["missing view", "broken picture", "other proportions", "no folder", "bad strength"]
)
def test_unsuitable_folder_is_a_one_line_error(tmp_path: Path, damage: str) -> None:
    case = small(count=3)
    for view in case.views:
        write_image(tmp_path / f"{view.camera.name}.png", view.image)
    where = tmp_path
    first = tmp_path / f"{case.views[0].camera.name}.png"
    if damage == "missing view":
        first.unlink()
    elif damage == "broken picture":
        first.write_bytes(b"no picture")
    elif damage == "other proportions":
        Image.new("RGB", (90, 40)).save(first)
    elif damage == "no folder":
        where = tmp_path / "nowhere"
    else:
        (tmp_path / "1.5").mkdir()

    def edit_all() -> None:
        editor = make_editor(EditorOptions(f"folder:{where}"), case.scene, case.region, case.views)
        for view in case.views:
            editor.edit(view, 1.0)

    with pytest.raises(ProgdfError, match="; ") as caught:
        edit_all()
    assert "\n" not in str(caught.value)


def test_whole_picture_edit_is_confined_to_the_region() -> None:
    view = small().views[0]
    confined = view.confine(1.0 - view.image)
    assert torch.equal(confined[view.mask == 0], view.image[view.mask == 0])
    inside = view.mask > 0.5
    assert torch.allclose(confined[inside], 1.0 - view.image[inside], atol=1e-6)
