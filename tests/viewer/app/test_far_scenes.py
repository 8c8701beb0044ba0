"""A scene far from 0 in the window: written files use world coordinates and restore the same view."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.gdf.file import fingerprint, save_gdf
from progdf.io.cameras import load_cameras
from progdf.io.picture_camera import find_picture_camera
from tests.helpers.null_app import null_app, press
from tests.helpers.ply_files import moved_columns, write
from tests.helpers.ui_rig import bear, first_view
from viewer.app import app as application
from viewer.camera.view_camera import to_camera
from viewer.files import document, session
from viewer.files.session import WindowSession
from viewer.state import snapshots, workspace
from viewer.state.view_state import Keyframe, Timeline, ViewState

FAR = (1e6, 2e6, -5e5)


def far_document(folder: Path) -> document.Document:
    """Write the bear and its scarf far from 0 and load them."""
    scene = write(folder / "far.ply", moved_columns(bear().scene, FAR))
    opened = document.load(scene)
    edit = replace(bear().gdfs[0], scene=fingerprint(opened.scene))
    save_gdf(folder / "scarf.gdf", edit)
    return document.load(scene, [folder / "scarf.gdf"])


def view() -> ViewState:
    """Return a view of the bear near 0, which is also a view of the far bear relative to its origin."""
    seen = first_view(bear(), 0.5)
    other = replace(seen.camera, azimuth=70.0)
    return replace(seen, timeline=Timeline((Keyframe(0), Keyframe(3, camera=other)), 3))


@pytest.fixture
def window(tmp_path: Path) -> Iterator[application.App]:
    with null_app(far_document(tmp_path), view(), tmp_path) as app:
        yield app


def test_far_session_stores_world_cameras_and_restores_them(tmp_path: Path) -> None:
    opened = far_document(tmp_path)
    seen = view()
    kept = snapshots.take((), seen)
    session.save(tmp_path / "far.session.json", WindowSession(opened, seen, kept))
    text = json.loads((tmp_path / "far.session.json").read_text())
    parts = (text["view"], text["view"]["timeline"]["keys"][1], text["snapshots"][0])
    for camera in (part["camera"] for part in parts):
        assert np.allclose(np.subtract(camera["pivot"], FAR), seen.camera.pivot, rtol=0, atol=1e-9)
    again = session.open_session(tmp_path / "far.session.json")
    for found in (again.view.camera, again.snapshots[0].camera, again.view.timeline.keys[1].camera):
        assert found is not None
        assert np.allclose(found.pivot, seen.camera.pivot, rtol=0, atol=1e-9)
    assert again.document.scene.origin == FAR
    assert again.view.timeline.keys[0].camera is None


def test_session_near_zero_is_unchanged(tmp_path: Path) -> None:
    bear().save(tmp_path)
    opened = document.load(tmp_path / "bear.ply")
    seen = replace(view(), layers=(), timeline=Timeline())
    session.save(tmp_path / "near.session.json", WindowSession(opened, seen))
    text = json.loads((tmp_path / "near.session.json").read_text())
    assert text["view"]["camera"]["pivot"] == list(seen.camera.pivot)
    assert session.open_session(tmp_path / "near.session.json").view == seen


@pytest.mark.gl
def test_f4_saves_world_cameras_that_restore_the_view(window: application.App, tmp_path: Path) -> None:
    shown = to_camera(window.main_view.work.view.camera, *window.main_view.picture_size)
    press(window, "F4")
    press(window, "F4")
    for camera in load_cameras(tmp_path / "far.cameras.json", FAR):
        assert torch.allclose(camera.viewmat, shown.viewmat, atol=1e-6)
    far = load_cameras(tmp_path / "far.cameras.json")[0]
    assert np.abs(far.position.numpy() - FAR).max() < 20.0
    before = window.main_view.work.view.camera
    window.main_view.store.replace(
        workspace.with_camera(window.main_view.work, replace(before, azimuth=200.0))
    )
    window.parts.file_actions.open(tmp_path / "far.cameras.json")
    found = window.main_view.work.view.camera
    assert torch.allclose(to_camera(found, 64, 48).viewmat, to_camera(before, 64, 48).viewmat, atol=1e-4)


@pytest.mark.gl
@pytest.mark.parametrize("key", ["F2", "Ctrl+F2"])
def test_picture_carries_a_world_camera_that_restores_the_view(
    window: application.App, tmp_path: Path, key: str
) -> None:
    before = window.main_view.work.view.camera
    press(window, key)
    (picture,) = tmp_path.glob("*.png")
    carried = json.loads(Image.open(picture).text["progdf:camera"])["cameras"][0]  # type: ignore[attr-defined]
    assert np.abs(np.array(carried["viewmat"])[:3, 3]).max() > 1e5
    shown = to_camera(before, *Image.open(picture).size)
    assert torch.allclose(find_picture_camera(picture, origin=FAR).viewmat, shown.viewmat, atol=1e-6)
    if key == "Ctrl+F2":
        window.main_view.store.replace(
            workspace.with_camera(window.main_view.work, replace(before, azimuth=200.0))
        )
        window.parts.file_actions.open(picture)
        found = window.main_view.work.view.camera
        assert torch.allclose(to_camera(found, 64, 48).viewmat, to_camera(before, 64, 48).viewmat, atol=1e-4)
