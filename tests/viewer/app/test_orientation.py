"""Axes, named views, ground grid, up axis, and moving the camera while a tool is active."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui
from PIL import Image

from progdf.formats.ply import save_ply
from progdf.scene.up_axis import find_up
from tests.helpers.null_app import null_app, press
from tests.helpers.scenes import random_gaussians
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.camera.view_camera import axes, first_camera, with_up
from viewer.files.document import load
from viewer.state import selection
from viewer.state.commands import Plain
from viewer.state.view_state import ViewState
from viewer.ui import overlay
from viewer.ui.keys import Keys, Press

pytestmark = pytest.mark.gl
CENTER = 340.0 - 56.5  # of the axes: x from the left, y is 56.5


def test_axes_are_clicked_and_dragged_and_hidden_with_the_panel() -> None:
    with rig(replace(first_view(bear(), 0.5), axes=True)) as hand:
        work = lambda: hand.main_view.work  # noqa: E731
        start = work().view.camera
        picture = axes(start)
        x = CENTER + overlay.LENGTH_PX * picture.right[0]
        y = 56.5 - overlay.LENGTH_PX * picture.up[0]
        hand.click(x, y)
        assert axes(work().view.camera).back == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
        assert (work().view.camera.pivot, work().view.camera.distance) == (start.pivot, start.distance)
        assert work().glide is None
        hand.click(CENTER, 56.5 - overlay.LENGTH_PX)
        assert (work().view.camera.azimuth, work().view.camera.elevation) == (0.0, 90.0)
        hand.drag((CENTER - 20.0, 70.0), (CENTER + 10.0, 40.0))
        assert work().view.camera.elevation < 90.0
        assert work().view.camera.pivot == start.pivot
        hand.key("B")
        hand.drag((CENTER - 20.0, 70.0), (CENTER + 10.0, 40.0))
        assert work().view.layers[0].paint == "", "the brush does not paint through them"
        hand.key("F12")
        turned = work().view.camera
        hand.click(640.0 - 56.5, 56.5 - overlay.LENGTH_PX)
        assert work().view.camera == turned


def test_number_keys_turn_smoothly_to_the_side_views() -> None:
    with rig() as hand:
        home = hand.main_view.work.view.camera
        seen = {
            "Num1": (0.0, 0.0),
            "Ctrl+Num1": (180.0, 0.0),
            "Num3": (90.0, 0.0),
            "Ctrl+Num3": (-90.0, 0.0),
            "Num7": (0.0, 90.0),
            "Ctrl+Num7": (0.0, -90.0),
        }
        for chord, angles in seen.items():
            hand.key(chord)
            camera = hand.main_view.work.view.camera
            assert (camera.azimuth, camera.elevation) == angles
        hand.frame(keys=Keys((Press("Num0"),)))
        hand.frame(4)
        under_way = hand.main_view.work.view.camera
        assert -90.0 < under_way.elevation < home.elevation
        hand.drag((170.0, 300.0), (180.0, 300.0))
        assert hand.main_view.work.glide is None, "the hand goes before"
        hand.key("Num0")
        assert hand.main_view.work.view.camera == home


def test_f_frames_the_selection_first() -> None:
    labels = bear().demo.labels.numpy()
    kept = selection.select(selection.SelectionState(), labels == 1)
    with rig(replace(first_view(bear(), 0.5, 0.5), selection=kept)) as hand:
        hand.key("F")
        some = hand.main_view.work.view.camera
        pivot = bear().scene.means[labels == 1].mean(0).numpy()
        assert np.linalg.norm(np.subtract(some.pivot, pivot)) < 0.3
        hand.key("Ctrl+Shift+A")
        hand.key("Num.")
        assert hand.main_view.work.view.camera != some


@pytest.mark.parametrize("chord", ["B", "L"])
def test_alt_orbits_the_camera_while_a_tool_is_active(chord: str) -> None:
    with rig() as hand:
        before = hand.main_view.work.view
        hand.key(chord)
        hand.modifier(imgui.Key.mod_alt)
        hand.drag((150.0, 250.0), (190.0, 300.0))
        hand.modifier(imgui.Key.mod_alt, False)
        after = hand.main_view.work.view
        assert after.camera.azimuth == pytest.approx(before.camera.azimuth - 12.0)
        assert (after.layers, after.selection) == (before.layers, before.selection)


def test_grid_is_occluded_by_splats_and_missing_from_saved_pictures(
    tmp_path: Path,
) -> None:
    head = selection.select(selection.SelectionState(), np.isin(bear().demo.labels.numpy(), (1, 2)))
    bare = selection.isolate(head, len(bear().scene))
    camera = first_view(bear()).camera
    lined = {}
    for draw in ("cpu", "gl"):
        view = replace(first_view(bear()), selection=bare, camera=replace(camera, elevation=60.0))
        with rig(view, draw=draw, pictures=tmp_path / draw) as hand:
            (tmp_path / draw).mkdir()
            plain = hand.picture().astype(int)
            hand.key("Shift+G")
            shown = hand.picture().astype(int)
            hand.key("F2")
            saved = np.asarray(Image.open(tmp_path / draw / "bear_001.png")).astype(int)
            assert np.abs(saved - plain).max() == 0
            sky = np.abs(plain - plain[0, 0]).max(axis=-1) == 0
            lines = np.abs(shown - plain).max(axis=-1) > 8
            assert lines[sky].sum() > 800
            covered = np.abs(plain - plain[0, 0]).max(axis=-1) > 60
            assert covered.sum() > 3000
            assert lines[covered].sum() < 0.02 * lines.sum()
            hand.drag((170.0, 300.0), (190.0, 300.0))
            hand.key("Shift+G")
            hand.key("Num0")
            assert np.abs(hand.picture().astype(int) - plain)[:300].max() == 0, "above the message"
            lined[draw] = shown
    assert np.abs(lined["cpu"] - lined["gl"]).mean() < 0.5


def test_guessed_up_axis_is_reported_until_the_user_sets_it(tmp_path: Path) -> None:
    save_ply(tmp_path / "cloud.ply", random_gaussians(300, scale=0.2))
    cloud = load(tmp_path / "cloud.ply")
    first = ViewState(camera=first_camera(cloud.scene, up=cloud.detected_up.direction))
    with null_app(cloud, first, tmp_path) as app:
        question = lambda: app.main_view.work.question  # noqa: E731
        app._wait_times()
        app._wait_times()
        line = question()
        assert line is not None
        assert line.text == "Guessed −Y as up"
        assert [label for label, _ in line.buttons] == ["Flip", "Choose…"]
        camera = with_up(app.main_view.work.view.camera, (0.0, 0.0, 1.0))
        app.main_view.store.change(replace(app.main_view.work.view, camera=camera))
        app._wait_times()
        assert question() is None, "the new axis answers it"
        assert find_up(cloud.scene).name == "+z", "what is chosen in the popover is remembered"
        press(app, "Ctrl+Z")
        app._wait_times()
        assert find_up(cloud.scene).name == "-y", "and follows an undo"
        press(app, "Ctrl+Shift+Z")
        app._wait_times()
        shutil.move(tmp_path / "cloud.ply", tmp_path / "other.ply")
        found = find_up(load(tmp_path / "other.ply").scene)
        assert (found.name, found.certain) == ("+z", True), "a training, which reads the file itself, agrees"
        app.parts.file_actions.open(tmp_path / "other.ply")
        app._wait_times()
        assert question() is None
        assert app.main_view.work.view.camera.up == (0.0, 0.0, 1.0)
        save_ply(tmp_path / "cloud.ply", random_gaussians(50, scale=0.2))
        app.parts.file_actions.open(tmp_path / "cloud.ply")
        app._wait_times()
        assert question() is not None
        up = app.main_view.work.view.camera.up
        app.main_view._perform(Plain("flip_up"))
        app.main_view.wake()
        app.draw()
        app._wait_times()
        assert app.main_view.work.view.camera.up == tuple(-c for c in up)
        assert question() is None
