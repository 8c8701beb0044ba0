"""Training cameras in the picture: their photographs, and the view through them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.camera import Camera, Lens
from progdf.metrics.image import psnr
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.divided import BANNER
from tests.helpers.ui_rig import BACKGROUND, Rig, bear, rig
from viewer.app.inspect.frusta import find_photograph, look_through, thumbnails, viewpoints
from viewer.camera.photograph import in_view, load_photograph
from viewer.camera.view_camera import Bounds, ViewCamera, axes, eye, from_camera, to_camera
from viewer.pictures.film import to_pixels
from viewer.render.engine import ViewEngine
from viewer.state.transient import Viewpoint
from viewer.state.view_state import ViewState
from viewer.state.workspace import with_transient


def _shown(hand: Rig, folder: Path) -> tuple[Viewpoint, ...]:
    """Show three cameras around the bear."""
    view = hand.main_view
    cameras = [replace(c, name=f"a{i}.png") for i, c in enumerate(orbit_rig(view.engine.scene, 3, 40, 30))]
    found = viewpoints(cameras, folder, view.work.view.camera, view.facts.bounds)
    # from far away all frusta are in the picture
    far = replace(view.work.view.camera, distance=6.0 * view.work.view.camera.distance)
    work = with_transient(view.work, viewpoints=found)
    view.store.replace(replace(work, view=replace(work.view, camera=far)))
    hand.main_view.wake()
    hand.settle()
    return found


@pytest.mark.gl
def test_click_on_a_frustum_looks_through_its_camera(tmp_path: Path) -> None:
    with rig() as hand:
        found = _shown(hand, tmp_path)
        camera = hand.main_view.pointer().camera(hand.main_view.work.view.camera)
        viewmat = camera.viewmat.double().numpy()
        middles = [np.mean(viewpoint.corners, axis=0) for viewpoint in found]
        inside = [viewmat[:3, :3] @ middle + viewmat[:3, 3] for middle in middles]
        nearest = min(range(3), key=lambda i: inside[i][2])
        x, y, z = camera.K.double().numpy() @ inside[nearest]
        hand.click(x / z, y / z)
        glide = hand.main_view.work.glide
        target = hand.main_view.work.view.camera if glide is None else glide.end
        seen = found[nearest].view
        assert eye(target) == eye(seen)
        assert axes(target) == axes(seen)
        shown = to_camera(target, 340, 540)
        corners = shown.viewmat[:3, :3] @ torch.tensor(found[nearest].corners).T + shown.viewmat[:3, 3:]
        columns, rows, depth = shown.K @ corners
        assert (columns / depth).aminmax() == (pytest.approx(0.0, abs=0.01), pytest.approx(340.0, abs=0.01))
        assert float((rows / depth).min()) > 0.0


def _photographed(folder: Path, cameras: list[Camera], lens: Lens | None = None) -> list[Camera]:
    """Write the bear's picture in each camera as its photograph, at twice the camera's size."""
    (folder / "images").mkdir()
    engine = ViewEngine(None, bear().scene)
    named = [replace(camera, name=f"a{i}", lens=lens) for i, camera in enumerate(cameras)]
    for camera in named:
        large = camera.resize(2 * camera.width, 2 * camera.height)
        image = to_pixels(engine.image(ViewState(background=BACKGROUND), camera=large))
        Image.fromarray(image).save(folder / "images" / f"{camera.name}.png")
    return named


@pytest.mark.gl
def test_photograph_is_compared_until_the_view_moves(tmp_path: Path) -> None:
    cameras = _photographed(tmp_path, orbit_rig(bear().scene, 2, 160, 120))
    with rig() as hand:
        view = hand.main_view
        found = viewpoints(cameras, tmp_path, view.work.view.camera, view.facts.bounds)
        view.store.replace(with_transient(view.work, viewpoints=found))
        view.store.replace(look_through(view.work, found[0], view.pointer()))
        view.wake()
        hand.settle()
        assert (view.work.view.compare.mode, view.work.view.compare.against) == ("split", "photograph")
        words = view.canvas.comparer.labels(view.work.view)
        assert (words.left, words.right.split(" · ")[0]) == ("photograph", "splats")
        assert view.canvas.comparer.psnr > 30.0, "the photograph is a picture of the splats"
        assert words.note.startswith("PSNR ")
        assert words.note.endswith(" dB at 340 × 540 · photograph 320 × 240 · camera 160 × 120")
        split = hand.picture().astype(int)
        hand.key("\\")
        flipped = hand.picture().astype(int)
        assert np.abs(split[BANNER:, :150] - flipped[BANNER:, :150]).max() == 0
        assert np.abs(split[BANNER:500, 190:] - flipped[BANNER:500, 190:]).max() > 0
        hand.key("\\")
        assert not view.work.past.past, "looking through a camera is no change to undo"
        hand.wheel(100.0, 300.0, 1.0)
        assert view.work.transient.through is None
        assert view.work.view.compare == replace(view.work.view.compare, mode="off", against="original")


def test_photograph_of_a_lens_is_undistorted_in_any_turned_view(tmp_path: Path) -> None:
    (camera,) = _photographed(tmp_path, orbit_rig(bear().scene, 1, 160, 120), Lens(k1=0.05))
    photograph = load_photograph(tmp_path / "images" / "a0.png", camera)
    assert photograph.note == "photograph 320 × 240 · camera 160 × 120 · lens undistorted"
    turned = to_camera(from_camera(ViewCamera(up=(0.6, 0.8, 0.0)), camera, Bounds()), 200, 300)
    image, shown = in_view(photograph, turned)
    assert image.shape == (300, 200, 3)
    assert 0.9 < float(shown.float().mean()) < 1.0
    straight = load_photograph(tmp_path / "images" / "a0.png", replace(camera, lens=None))
    expected = ViewEngine(None, bear().scene).image(ViewState(background=BACKGROUND), camera=turned)
    image, shown = in_view(straight, turned)
    assert psnr(torch.from_numpy(expected.clip(0, 1)), image, shown) > 25.0


def test_photograph_of_another_shape_is_named(tmp_path: Path) -> None:
    Image.new("RGB", (300, 300)).save(tmp_path / "a.png")
    (camera,) = orbit_rig(bear().scene, 1, 160, 120)
    note = load_photograph(tmp_path / "a.png", camera).note
    assert note == "photograph 300 × 300 · camera 160 × 120 · shapes differ, stretched by 1.33"


def test_photographs_are_found_in_the_usual_folders(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    picture = tmp_path / "images" / "a.png"
    Image.new("RGB", (400, 300)).save(picture)
    assert find_photograph("a.png", tmp_path) == picture
    assert find_photograph("a", tmp_path) == picture
    assert find_photograph("b.png", tmp_path) is None
    assert find_photograph("", tmp_path) is None


@pytest.mark.gl
def test_broken_photograph_has_a_gray_thumbnail(tmp_path: Path) -> None:
    (tmp_path / "a0.png").write_bytes(b"no picture")
    with rig() as hand:
        found = _shown(hand, tmp_path)
    (load,) = thumbnails(found).values()
    assert load().shape == (2, 2, 3)
