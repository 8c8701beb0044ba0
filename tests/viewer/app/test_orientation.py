"""Axes, named views, the grid on the ground, and moving while a tool is on: in one window each."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import bear, first_view, rig
from viewer.camera.view_camera import axes
from viewer.state import selection
from viewer.ui import axis_gizmo

pytestmark = pytest.mark.gl
CENTER = 340.0 - 56.5  # of the axes, from the left; and 56.5 from above


def test_axes_are_clicked_and_dragged_and_leave_with_the_panel() -> None:
    with rig(replace(first_view(bear(), 0.5), axes=True)) as hand:
        work = lambda: hand.main_view.work  # noqa: E731
        start = work().view.camera
        picture = axes(start)
        x = CENTER + axis_gizmo.LENGTH_PX * picture.right[0]
        y = 56.5 - axis_gizmo.LENGTH_PX * picture.up[0]
        hand.click(x, y)
        assert axes(work().view.camera).back == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
        assert (work().view.camera.pivot, work().view.camera.distance) == (start.pivot, start.distance)
        assert work().glide is None
        hand.click(CENTER, 56.5 - axis_gizmo.LENGTH_PX)
        assert (work().view.camera.azimuth, work().view.camera.elevation) == (0.0, 90.0)
        hand.drag((CENTER - 20.0, 70.0), (CENTER + 10.0, 40.0))
        assert work().view.camera.elevation < 90.0
        assert work().view.camera.pivot == start.pivot
        hand.key("B")
        hand.drag((CENTER - 20.0, 70.0), (CENTER + 10.0, 40.0))
        assert work().view.layers[0].paint == "", "the brush does not paint through them"
        hand.key("F12")
        turned = work().view.camera
        hand.click(640.0 - 56.5, 56.5 - axis_gizmo.LENGTH_PX)
        assert work().view.camera == turned


def test_numbers_look_from_the_sides_and_the_way_there_takes_a_moment() -> None:
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
        from viewer.camera.inputs import Keys, Press

        hand.frame(keys=Keys((Press("Num0"),)))
        hand.frame(4)
        under_way = hand.main_view.work.view.camera
        assert -90.0 < under_way.elevation < home.elevation
        hand.drag((170.0, 300.0), (180.0, 300.0))
        assert hand.main_view.work.glide is None, "the hand goes before"
        hand.key("Num0")
        assert hand.main_view.work.view.camera == home


def test_f_frames_what_is_selected_first() -> None:
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
def test_alt_turns_the_camera_while_a_tool_is_on(chord: str) -> None:
    with rig() as hand:
        before = hand.main_view.work.view
        hand.key(chord)
        hand.modifier(imgui.Key.mod_alt)
        hand.drag((150.0, 250.0), (190.0, 300.0))
        hand.modifier(imgui.Key.mod_alt, False)
        after = hand.main_view.work.view
        assert after.camera.azimuth == pytest.approx(before.camera.azimuth - 12.0)
        assert (after.layers, after.selection) == (before.layers, before.selection)
