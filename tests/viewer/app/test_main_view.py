"""Whole interface without a window: real widgets, real engine and scripted input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from imgui_bundle import imgui
from PIL import Image

from progdf.io.cameras import load_cameras
from progdf.io.picture_camera import edits_in_picture, find_picture_camera
from tests.helpers.ui_rig import BACKGROUND, Rig, rig
from viewer.camera.view_camera import to_camera
from viewer.ui.splash import SplashPicture

pytestmark = pytest.mark.gl
VIEW = (170.0, 270.0)  # the middle of the picture


def test_slider_drag_changes_the_picture_as_one_undo_entry(hand: Rig) -> None:
    before = hand.picture()
    hand.drag(hand.slider(0, 0.5), hand.slider(0, 1.0))
    assert hand.strengths == [1.0, 0.5]
    assert np.abs(hand.picture().astype(int) - before).max() > 20
    assert len(hand.main_view.work.past.past) == 1
    hand.key("Ctrl+Z")
    assert hand.strengths == [0.5, 0.5]
    hand.move(5.0, 5.0)
    hand.rest()  # until the undo message has disappeared
    assert np.array_equal(hand.picture(), before)
    hand.key("Ctrl+Shift+Z")
    assert hand.strengths == [1.0, 0.5]


def test_every_drag_step_is_on_screen_in_its_own_frame(hand: Rig) -> None:
    hand.move(*hand.slider(0, 0.5))
    hand.press()
    for strength in (0.6, 0.8, 0.3):
        hand.move(*hand.slider(0, strength))
        shown = hand.picture()
        image = hand.main_view.engine.image(hand.main_view.work.view, (340, 540))
        assert np.abs(shown - np.clip(image, 0, 1) * 255).max() <= 0.51
    hand.release()


def test_drag_within_one_slow_frame_ends_at_its_last_value(hand: Rig) -> None:
    hand.move(*hand.slider(0, 0.5))
    hand.io.add_mouse_button_event(0, True)
    for strength in (0.6, 0.7, 0.9):
        hand.io.add_mouse_pos_event(*hand.slider(0, strength))
    hand.io.add_mouse_button_event(0, False)
    drawn = hand.main_view.canvas.pictures_drawn
    hand.frame(4)
    assert hand.strengths[0] == pytest.approx(0.9, abs=0.005)
    assert hand.main_view.canvas.pictures_drawn <= drawn + 2, "values on the way are not drawn one by one"
    assert len(hand.main_view.work.past.past) == 1


def test_idle_window_draws_nothing_and_waits(hand: Rig) -> None:
    hand.rest()  # frames reserved for tooltips
    drawn = hand.main_view.canvas.pictures_drawn
    frames = hand.main_view.frames
    assert hand.main_view.next_frame_delay() is None
    assert (hand.main_view.canvas.pictures_drawn, hand.main_view.frames) == (drawn, frames)


def test_mouse_move_draws_the_interface_but_no_splats(hand: Rig) -> None:
    drawn = hand.main_view.canvas.pictures_drawn
    for x in range(20, 600, 40):
        hand.move(x, 100.0)
    assert hand.main_view.canvas.pictures_drawn == drawn == 1


def test_camera_is_not_in_the_undo_stack(hand: Rig) -> None:
    hand.drag(VIEW, (VIEW[0] + 40, VIEW[1] + 10))
    moved = hand.main_view.work.view.camera
    assert hand.main_view.work.past.past == ()
    hand.drag(hand.slider(0, 0.5), hand.slider(0, 0.8))
    hand.key("Ctrl+Z")
    assert hand.main_view.work.view.camera == moved


def test_f2_saves_the_picture_without_the_interface(tmp_path: Path) -> None:
    with rig(pictures=tmp_path) as hand:
        shown = hand.picture()
        hand.key("F2")
        hand.key("Shift+F2")
        first, second = sorted(tmp_path.iterdir())
        assert (first.name, second.name) == ("bear_001.png", "bear_002.png")
        assert np.array_equal(np.asarray(Image.open(first)), shown)
        taken = find_picture_camera(first)
        expected = to_camera(hand.main_view.work.view.camera, shown.shape[1], shown.shape[0])
        assert torch.allclose(taken.viewmat, expected.viewmat, atol=1e-6)
        assert torch.allclose(taken.K, expected.K, atol=1e-4)
        assert edits_in_picture(first) == ", ".join(layer.name for layer in hand.main_view.work.view.layers)
        assert np.asarray(Image.open(second)).shape == (540, 640, 3)
        message = hand.main_view.work.message
        assert message is not None
        assert str(second) in message.text


def test_view_saved_for_painting_shows_the_whole_original(tmp_path: Path) -> None:
    with rig(pictures=tmp_path) as hand:
        hand.drag(hand.slider(0, 0.5), hand.slider(0, 0.0))
        hand.drag(hand.slider(1, 0.5), hand.slider(1, 0.0))
        original = hand.picture()
        hand.drag(hand.slider(0, 0.0), hand.slider(0, 1.0))
        for key in ("Ctrl+A", "Ctrl+H", "Ctrl+F2"):
            hand.key(key)
        beside, taken = sorted(tmp_path.iterdir())
        assert np.array_equal(np.asarray(Image.open(taken)), original)
        assert edits_in_picture(taken) == ""
        assert beside.name == "bear_001.camera.json"
        assert torch.equal(load_cameras(beside)[0].viewmat, find_picture_camera(taken).viewmat)


def test_picture_that_cannot_be_saved_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "gone").touch()
    with rig(pictures=tmp_path / "gone") as hand:
        hand.key("F2")
        message = hand.main_view.work.message
        assert message is not None
        assert message.error
        assert "\n" not in message.text
        hand.frame()


def test_messages_disappear_by_themselves(hand: Rig) -> None:
    hand.main_view.messages.show("hello")
    hand.settle()
    assert hand.main_view.next_frame_delay() is not None
    hand.main_view.frame(hand.screen, 7.0)
    assert hand.main_view.work.message is None


def test_splash_shows_the_file_elapsed_seconds_and_progress(hand: Rig) -> None:
    drawn = hand.main_view.canvas.pictures_drawn
    images = []
    picture = SplashPicture(hand.screen.ctx)
    for seconds in (0.0, 1.0, 5.0):
        picture.draw(hand.screen, hand.pixels, 1.0, "Opening bear.ply …", seconds)
        images.append(hand.image().astype(int))
    picture.release()
    assert hand.main_view.canvas.pictures_drawn == drawn
    middle = [image[230:290] for image in images]
    assert len(np.unique(middle[0].reshape(-1, 3), axis=0)) > 10, "a word"
    assert len(np.unique(images[0][:200].reshape(-1, 3), axis=0)) == 1, "on the window's color alone"
    assert np.abs(middle[1] - middle[0])[40:].any(), "its bar moves"
    assert np.abs(middle[2] - middle[0])[:25].any(), "and its seconds are told"


def test_f12_gives_the_whole_window_to_the_picture(hand: Rig) -> None:
    hand.key("F12")
    assert hand.main_view.work.view.panel is False
    background = np.array(BACKGROUND) * 255
    assert np.abs(hand.image()[5, -5] - background).max() <= 1


@pytest.mark.parametrize(("points", "density", "scale"), [((640, 400), 2.0, 1.0), ((1280, 800), 1.0, 2.0)])
def test_picture_uses_the_framebuffer_pixels_on_a_dense_screen(
    points: tuple[int, int], density: float, scale: float
) -> None:
    with rig(points=points, density=density, scale=scale) as hand:
        image = hand.main_view.engine.image(hand.main_view.work.view, (680, 800))
        assert hand.image().shape == (800, 1280, 3)
        assert np.abs(hand.picture()[:, :680] - np.clip(image, 0, 1) * 255).max() <= 0.51


@pytest.mark.parametrize("draw", ["gl", "cpu"])
def test_interface_and_splats_keep_their_gl_states_apart(draw: str) -> None:
    with rig(draw=draw) as hand:
        panel_before = hand.image()[:480, 340:]
        hand.key("F1")
        hand.drag(VIEW, (VIEW[0] + 60, VIEW[1] + 20))
        hand.drag(hand.slider(0, 0.5), hand.slider(0, 1.0))
        hand.key("Ctrl+Z")
        hand.key("F1")
        hand.move(*VIEW)
        hand.settle()
        used = hand.image()
        view = hand.main_view.work.view
    with rig(view, draw=draw) as fresh:
        assert np.array_equal(used[:, :340], fresh.image()[:, :340])
    assert np.array_equal(used[:480, 340:], panel_before), "all but the undo buttons"


def test_resized_window_is_drawn_at_once(hand: Rig) -> None:
    hand.pixels = hand.points = (500, 300)
    hand.io.display_size = imgui.ImVec2(500, 300)
    hand.screen = hand.main_view.context.simple_framebuffer((500, 300))
    hand.frame()
    image = hand.main_view.engine.image(hand.main_view.work.view, (200, 300))
    assert np.abs(hand.picture()[:, :200] - np.clip(image, 0, 1) * 255).max() <= 0.51


def test_window_narrower_than_the_panel_survives(hand: Rig) -> None:
    hand.io.display_size = imgui.ImVec2(200, 100)
    hand.screen = hand.main_view.context.simple_framebuffer((200, 100))
    hand.pixels = (200, 100)
    hand.frame(3)


def test_view_without_layers_accepts_layer_keys(hand: Rig) -> None:
    hand.main_view.restart(replace(hand.main_view.work.view, layers=()))
    hand.settle()
    assert hand.main_view.work.focus is None
    hand.key("Right")
    hand.key("H")
    assert hand.strengths == []
