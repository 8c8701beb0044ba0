"""Training cameras in the picture: their photographs, and the view through them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.ui_rig import Rig, rig
from viewer.app.inspect.frusta import find_photograph, thumbnails, viewpoints
from viewer.state.transient import Viewpoint
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
        camera = hand.main_view._pointer().camera(hand.main_view.work.view.camera)
        viewmat = camera.viewmat.double().numpy()
        middles = [np.mean(viewpoint.corners, axis=0) for viewpoint in found]
        inside = [viewmat[:3, :3] @ middle + viewmat[:3, 3] for middle in middles]
        nearest = min(range(3), key=lambda i: inside[i][2])
        x, y, z = camera.K.double().numpy() @ inside[nearest]
        hand.click(x / z, y / z)
        glide = hand.main_view.work.glide
        target = hand.main_view.work.view.camera if glide is None else glide.end
        assert target == found[nearest].view


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
