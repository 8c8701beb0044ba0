"""Paint finer than the Gaussians, on a wall of large, soft, thick Gaussians."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers, edited_scene
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.gdf.file import load_gdf, save_gdf
from progdf.io.cameras import save_cameras
from progdf.metrics.image import psnr
from progdf.quaternions import rotate_vectors
from progdf.rasterize import render
from progdf.rasterize.engines import render_depth
from progdf.region import whole_scene
from progdf.surface.find import orbit
from tests.helpers.edits import bits
from tests.trainer.painted_wall import CAMERA, SIDE, edit_of, letters, paint_on, picture, wall
from trainer.editors.base import EditorInput
from trainer.editors.decal import DecalEditor, decal, parse_place
from trainer.options import EditorOptions
from trainer.paint.discs import merge_pixels, place_discs
from trainer.run.paint import choose_discs, make_goal
from trainer.run.pasted import train_decal
from trainer.views.view import BACKGROUND


def put(folder: Path, image: np.ndarray) -> EditorOptions:
    """Return options for a decal of this RGBA picture in the middle of the wall."""
    Image.fromarray(image).save(folder / "logo.png")
    save_cameras(folder / "camera.json", [CAMERA])
    return EditorOptions(f"decal:{folder / 'logo.png'}", at="64,64,40", camera=folder / "camera.json")


def make(options: EditorOptions, scene: Gaussians) -> DecalEditor:
    return decal(EditorInput(options.editor.partition(":")[2], scene, whole_scene(scene), (), options))


def test_letters_finer_than_the_gaussians_are_as_sharp_as_painted() -> None:
    scene = wall()
    paint = letters(scene)
    gdf, _ = edit_of(scene, paint)
    edited = picture(compose_layers(scene, [Layer(gdf, 1.0)]))
    assert psnr(edited, paint.picture, paint.mask) > 34.0
    near = torch.zeros_like(paint.mask)
    near[36:92, 34:92] = True
    assert psnr(edited, paint.picture, near & ~paint.mask) > 34.0


def test_strength_zero_and_rows_outside_the_region_are_bit_identical() -> None:
    scene = wall()
    gdf, laid = edit_of(scene, letters(scene))
    start = compose_layers(scene, [Layer(gdf, 0.0)])
    assert bits(start[: len(scene)]) == bits(scene)
    assert torch.equal(picture(start), picture(scene))
    finished = compose_layers(scene, [Layer(gdf, 1.0)])
    outside = torch.ones(len(scene), dtype=torch.bool).index_fill(0, laid.rows, False)
    assert bits(finished[: len(scene)][outside]) == bits(scene[outside])
    assert bits(finished) == bits(edited_scene(scene, gdf))


def test_visible_paint_is_linear_along_the_slider() -> None:
    scene = wall()
    paint = letters(scene)
    gdf, _ = edit_of(scene, paint)
    before = picture(scene)
    change = paint.picture - picture(scene)
    for s in (0.1, 0.25, 0.5, 0.75, 0.9):
        shown = picture(compose_layers(scene, [Layer(gdf, s)])) - before
        share = (shown * change)[paint.mask].sum() / change[paint.mask].square().sum()
        assert float(share) == pytest.approx(s, abs=0.05)


def test_gaussians_moved_back_keep_their_outline_in_the_view() -> None:
    scene = wall()
    discs = place_discs(scene, letters(scene), 0.02, 4.0)
    assert len(discs.moved) > 0
    row = discs.moved[:1]
    before, after = (render(some[row], CAMERA, (0.0, 0.0, 0.0)).image for some in (scene, discs.scene))
    assert float((before - after).abs().max()) < 1e-4  # float32 rounding of both


def test_hidden_gaussians_do_not_cover_the_paint(tmp_path: Path) -> None:
    scene = wall(count=20_000, size=0.035, rough=0.01)
    logo = np.full((32, 32, 4), (200, 30, 40, 255), np.uint8)
    discs = place_discs(scene, make(put(tmp_path, logo), scene).paints[0], 0.03, 4.0)
    assert float(discs.scene.means[discs.moved, 2].min()) > float(discs.added.means[:, 2].max())


def test_unpainted_picture_and_paint_off_the_surface_add_nothing() -> None:
    scene = wall()
    nothing = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    assert not len(place_discs(scene, paint_on(scene, nothing), 0.02, 4.0).added)
    small = scene[(scene.means[:, 0] < -1.0).nonzero()[:, 0]]
    beyond = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    beyond[60:70, 90:110] = True
    discs = place_discs(small, paint_on(small, beyond), 0.02, 4.0)
    assert not len(discs.added)
    assert discs.scene is small
    with pytest.raises(ProgdfError, match="opaque"):
        choose_discs(make_goal(small, [paint_on(small, beyond)]), None)


@pytest.mark.parametrize("seed", range(3))
def test_every_pixel_is_in_one_rectangle_and_flat_paint_needs_few(seed: int) -> None:
    random = np.random.default_rng(seed)
    mask = np.zeros((200, 220), bool)
    top, left = random.integers(5, 20, 2)
    mask[top : top + 160, left : left + 176] = True
    flat = np.full((200, 220, 3), 0.4, np.float32)
    cells = merge_pixels(flat, mask, 0.02, mask)
    covered = np.zeros(mask.shape, int)
    for x, y, width, height in cells:
        covered[
            round(y - height / 2) : round(y + height / 2), round(x - width / 2) : round(x + width / 2)
        ] += 1
    assert (covered == mask).all()
    assert len(cells) <= 0.065 * mask.sum()
    noise = random.random((200, 220, 3)).astype(np.float32)
    assert len(merge_pixels(noise, mask, 0.02, mask)) == mask.sum()


def test_paint_does_not_show_through_a_thin_wall() -> None:
    scene = replace(wall(), means=wall().means * torch.tensor([1.0, 1.0, 0.3]))
    paint = letters(scene)
    gdf, _ = edit_of(scene, paint)
    back = orbit(CAMERA, torch.zeros(3), 180.0)
    before, after = (
        render(some, back, BACKGROUND).image.clamp(0, 1) for some in (scene, edited_scene(scene, gdf))
    )
    shown = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    shown[50:78, 45:80] = True
    assert psnr(after, before, shown) > 24.0  # the bars differ from the wall by 12 dB


@pytest.mark.slow
def test_decal_lies_on_the_surface_from_the_sides_too(tmp_path: Path) -> None:
    scene = wall(count=20_000, size=0.035, rough=0.01)
    logo = np.zeros((32, 32, 4), np.uint8)
    logo[:, :, :] = (200, 30, 40, 255)
    logo[8:24, 8:24] = (250, 240, 90, 255)
    painted = train_decal(make(put(tmp_path, logo), scene), scene, "logo")
    assert painted.figures["own"] > 31.0
    assert min(painted.figures["turned"][degrees] for degrees in ("-30", "+30")) > 24.0
    save_gdf(tmp_path / "logo.gdf", painted.gdf)
    assert bits(load_gdf(tmp_path / "logo.gdf", scene).added) == bits(painted.gdf.added)


def test_transparent_pixels_leave_the_scene_unchanged(tmp_path: Path) -> None:
    scene = wall()
    logo = np.full((30, 30, 4), 255, np.uint8)
    logo[:, 15:, 3] = 0
    editor = make(put(tmp_path, logo), scene)
    assert not bool(editor.paints[0].mask[:, 70:].any())
    assert bool(editor.paints[0].mask[:, 50:60].any())
    logo[..., 3] = 0
    with pytest.raises(ProgdfError, match="is fully transparent"):
        make(put(tmp_path, logo), scene)


def test_decal_covers_thin_spots_of_the_surface(tmp_path: Path) -> None:
    solid = wall()
    center = solid.means[:, :2].norm(dim=1) < 0.12
    logits = torch.where(center, torch.tensor(-4.0), solid.logit_opacities)
    scene = replace(solid, logit_opacities=logits)
    alpha = render_depth(scene, CAMERA).alpha[44:84, 44:84]
    assert 0.9 < float(alpha.min()) < 0.95
    editor = make(put(tmp_path, np.full((32, 32, 4), (200, 30, 40, 255), np.uint8)), scene)
    assert editor.left_out == 0
    edited = train_decal(editor, scene, "logo")
    assert edited.figures["left_out"] == 0
    shown = picture(edited_scene(scene, edited.gdf))[46:82, 46:82]
    assert psnr(shown, editor.paints[0].picture[46:82, 46:82]) > 30.0


def test_paint_off_the_surface_is_counted(tmp_path: Path) -> None:
    scene = wall()
    half = scene[(scene.means[:, 0] < 0.1).nonzero()[:, 0]]
    editor = make(put(tmp_path, np.full((32, 32, 4), (200, 30, 40, 255), np.uint8)), half)
    painted = int(editor.paints[0].mask.sum())
    assert 500 < editor.left_out < 1100
    assert painted + editor.left_out == 1600


def test_angle_turns_a_decal_counterclockwise(tmp_path: Path) -> None:
    scene = wall()
    logo = np.full((20, 40, 4), (0, 0, 0, 255), np.uint8)
    logo[:, 20:] = (255, 0, 0, 255)
    options = replace(put(tmp_path, logo), at="64,64,40,90")
    red = make(options, scene).drawn[..., 0]
    assert float(red[:60].sum()) > 100.0
    assert float(red[68:].sum()) < 1.0


def test_decal_position_is_in_pixels_or_in_shares() -> None:
    wide = replace(CAMERA, width=2 * SIDE)
    assert parse_place("64,32,40", wide) == parse_place("0.25,0.25,0.15625", wide)


@pytest.mark.parametrize(
    "at",
    [
        "",
        "1",
        "1,2",
        "a,b,c",
        "1,2,3,4,5",
        "nan,1,1",
        "64,64,0",
        "64,64,-3",
        "900,64,10",
        "64,64,1e9",
        "inf,0,1",
    ],
)
def test_invalid_decal_position_is_a_one_line_error(at: str) -> None:
    with pytest.raises(ProgdfError, match="--at") as caught:
        parse_place(at, CAMERA)
    assert "\n" not in str(caught.value)


def test_decal_without_picture_or_camera_is_a_one_line_error(tmp_path: Path) -> None:
    from trainer.editors import check_new_editor

    good = put(tmp_path, np.full((8, 8, 4), 255, np.uint8))
    (tmp_path / "broken.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(64))
    save_cameras(tmp_path / "two.json", [CAMERA, replace(CAMERA, name="b")])
    bad = (
        replace(good, editor="decal:"),
        replace(good, editor=f"decal:{tmp_path / 'none.png'}"),
        replace(good, editor=f"decal:{tmp_path / 'broken.png'}"),
        replace(good, camera=None),
        replace(good, camera=tmp_path / "two.json"),
    )
    check_new_editor(good)
    for options in bad:
        with pytest.raises(ProgdfError) as caught:
            check_new_editor(options)
        assert "\n" not in str(caught.value)


def test_discs_avoid_depth_gaps_and_objects_in_front_stay() -> None:
    back, near = (wall(seed, count=20_000, size=0.035, rough=0.01) for seed in (0, 1))
    near = replace(near, means=near.means - torch.tensor([0, 0, 0.6]))
    near = near[(near.means[:, 0] > 0.0).nonzero()[:, 0]]
    scene = concatenate([back, near])
    painted = torch.zeros(SIDE, SIDE, dtype=torch.bool)
    painted[40:90, 40:90] = True
    discs = place_discs(scene, paint_on(scene, painted), 0.03, 4.0)
    depth = discs.added.means[:, 2]
    assert float(((depth > -0.5) & (depth < -0.1)).float().mean()) < 0.02
    across = rotate_vectors(torch.tensor([[0.0, 0.0, 1.0]]).expand(len(depth), 3), discs.added.quats)
    large = discs.added.log_scales.exp().amax(dim=1) > 0.02
    assert float(across[large, 2].abs().min()) > 0.5
    front = discs.moved[discs.moved >= len(back)]
    assert float(discs.scene.means[front, 2].max()) < -0.3
