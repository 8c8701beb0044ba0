"""A transparent picture in the window: its ghost on the surface, its handles, and its training."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui
from PIL import Image

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.io.cameras import load_cameras
from progdf.threads import StoppedError
from tests.helpers.hostile import bomb
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from trainer.editors.decal import parse_place
from viewer.app.app import App
from viewer.app.decal import decal_corners, outline
from viewer.app.parts.pictures import DecalTextures, is_decal
from viewer.jobs.training import EditOrder
from viewer.render.decal_surfaces import DecalSurfaces
from viewer.state.commands import Plain
from viewer.state.transient import Decal
from viewer.state.workspace import with_transient

pytestmark = pytest.mark.gl


@pytest.fixture
def logo(tmp_path: Path) -> Path:
    pixels = np.zeros((40, 80, 4), np.uint8)
    pixels[10:30, 20:60] = 200, 30, 30, 255
    Image.fromarray(pixels).save(tmp_path / "logo.png")
    return tmp_path / "logo.png"


@pytest.fixture
def app(tmp_path: Path) -> Iterator[App]:
    with null_app(opened_document(bear_files(tmp_path)), first_view(bear()), tmp_path) as app:
        yield app


def in_hand(app: App) -> Decal:
    assert isinstance(app.main_view.work.transient.gizmo, Decal)
    return app.main_view.work.transient.gizmo


def shown(hand: Rig) -> Decal:
    decal = hand.main_view.work.transient.gizmo
    assert isinstance(decal, Decal)
    return decal


def middle(hand: Rig) -> tuple[float, float]:
    width, height = hand.main_view.picture_size
    return width / 2, height / 2


@contextmanager
def rig_with(logo: Path) -> Iterator[Rig]:
    """Open the bear with the decal at the pointer, in the middle of the picture."""
    with rig(first_view(bear())) as hand:
        decal = DecalTextures(hand.main_view.context).load(logo)
        hand.main_view.store.replace(with_transient(hand.main_view.work, gizmo=decal))
        hand.move(*middle(hand))
        at_once(hand)
        yield hand


def at_once(hand: Rig) -> None:
    """Draw a frame with the depth of the view, which the window computes in another thread."""
    view = hand.main_view
    pointer = view.pointer()
    view.decal_surfaces.depth(view.engine.scene, pointer.camera(pointer.shown.camera), at_once=True)
    hand.event()


def test_decal_follows_the_pointer_and_scales_with_the_wheel(logo: Path) -> None:
    with rig_with(logo) as hand:
        camera = hand.main_view.work.view.camera
        hand.move(200.0, 300.0)
        first = shown(hand)
        assert first.at == (200.0, 300.0)
        assert first.size == 0.25 * hand.io.display_size.y
        for shift in (False, True):
            hand.modifier(imgui.Key.mod_shift, shift)
            hand.io.add_mouse_wheel_event(0.0, 1.0)
            hand.frame(2)
        assert (shown(hand).size, shown(hand).angle) == (pytest.approx(1.08 * first.size), 5.0)
        hand.modifier(imgui.Key.mod_ctrl, True)
        hand.io.add_mouse_wheel_event(0.0, 1.0)
        hand.frame(2)
        assert shown(hand).angle == 15.0, "in steps"
        hand.modifier(imgui.Key.mod_ctrl, False)
        hand.modifier(imgui.Key.mod_shift, False)
        assert hand.main_view.work.view.camera == camera
        hand.key("Escape")
        assert Plain("put_back") in hand.main_view.take_requests()


def test_ghost_lies_on_the_surface_or_is_faint_off_it(logo: Path) -> None:
    with rig_with(logo) as hand:
        on = shown(hand)
        assert on.frame is not None
        assert on.mesh is not None
        assert on.frame.size_px == pytest.approx(on.size)
        assert on.mesh.shown.any()
        hand.move(3.0, 3.0)
        assert shown(hand).frame is None
        assert shown(hand).mesh is None
        hand.press()
        hand.release()
        assert not shown(hand).placed


def test_handles_remain_after_the_click_and_change_the_decal(logo: Path) -> None:
    with rig_with(logo) as hand:
        hand.click(*middle(hand))
        x, y = middle(hand)
        first = shown(hand)
        assert first.placed
        assert first.frame is not None
        assert not hand.main_view.take_requests()
        hand.drag((x, y), (x + 20.0, y))
        moved = shown(hand)
        assert moved.frame is not None
        assert moved.frame.center != first.frame.center
        assert moved.frame.size == pytest.approx(first.frame.size)
        corners, center, knob = outline(moved.frame, moved, hand.main_view.pointer())
        out = corners[1] + 0.5 * (corners[1] - center)
        hand.drag(tuple(corners[1]), tuple(out))
        scaled = shown(hand)
        assert scaled.frame is not None
        assert scaled.frame.size == pytest.approx(1.5 * first.frame.size, rel=0.05)
        corners, center, knob = outline(scaled.frame, scaled, hand.main_view.pointer())
        aside = center + np.array([-80.0, -80.0])
        hand.modifier(imgui.Key.mod_ctrl, True)
        hand.drag(tuple(knob), tuple(aside))
        hand.modifier(imgui.Key.mod_ctrl, False)
        assert shown(hand).angle % 15.0 == 0.0
        assert 30.0 <= shown(hand).angle <= 60.0


def test_camera_turns_beside_the_handles(logo: Path) -> None:
    with rig_with(logo) as hand:
        hand.click(*middle(hand))
        camera = hand.main_view.work.view.camera
        frame = shown(hand).frame
        hand.drag((100.0, 500.0), (140.0, 500.0))
        assert hand.main_view.work.view.camera != camera
        assert shown(hand).frame == frame


def test_decal_is_trained_with_the_camera_of_its_ghost(
    app: App, logo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders: list[EditOrder] = []
    monkeypatch.setattr(app.parts.jobs.queue, "add", orders.append)
    app.parts.file_actions.open(logo)
    app.draw()
    press(app, "Enter")
    app.draw()
    decal = in_hand(app)
    assert decal.placed
    assert decal.frame is not None
    assert not orders
    press(app, "Enter")
    app.draw()
    assert app.main_view.work.transient.gizmo is None
    (order,) = orders
    words = dict(word.lstrip("-").split("=", 1) for word in order.arguments() if "=" in word)
    assert words["editor"] == f"decal:{logo}"
    (camera,) = load_cameras(Path(words["camera"]))
    at = parse_place(words["at"], camera)
    assert (at.x, at.y) == (camera.width / 2, camera.height / 2)
    assert at.size == pytest.approx(decal.frame.size_px, abs=0.01)
    ahead = camera.viewmat[2, :3].double().numpy()
    assert np.allclose(ahead, -np.array(decal.frame.normal), atol=1e-5)


def test_ghost_stays_until_its_run_ends(app: App, logo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app.parts.jobs.queue, "_start", lambda _: None)
    app.parts.file_actions.open(logo)
    app.draw()
    press(app, "Enter", "Enter")
    app.draw()
    (ghost,) = app.main_view.work.transient.ghosts
    assert ghost.run == app.parts.jobs.queue.jobs[0].task.out
    app.parts.jobs.poll()
    assert app.main_view.work.transient.ghosts == (ghost,)
    app.parts.jobs.queue.jobs = ()
    app.parts.jobs.poll()
    assert app.main_view.work.transient.ghosts == ()


def test_texture_of_a_decal_is_freed_with_it(app: App, logo: Path) -> None:
    pictures = app.parts.pictures
    app.parts.file_actions.open(logo)
    pictures.poll()
    assert len(pictures.decals) == 1
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=None))
    pictures.poll()
    assert len(pictures.decals) == 0


def test_escape_leaves_a_decal_that_cannot_be_drawn(
    app: App, logo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise ProgdfError("no surface")

    app.parts.file_actions.open(logo)
    monkeypatch.setattr("viewer.app.main_view.draw_decal", fail)
    app.draw()
    assert in_hand(app)
    press(app, "Escape")
    app.draw()
    assert app.main_view.work.transient.gizmo is None


def test_surface_is_found_once_per_decal_in_a_bounded_picture(
    logo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sides = []

    def find(_: object, camera: Camera, painted: object) -> None:
        sides.append(max(camera.width, camera.height))
        raise StoppedError

    monkeypatch.setattr("viewer.render.decal_surfaces.find_surface", find)
    monkeypatch.setattr(
        "viewer.render.background.run_in_background", lambda work, *given, thread: work(*given)
    )
    with rig_with(logo) as hand:
        decal = shown(hand)
        assert decal.frame is not None
        frame = replace(decal.frame, pixel=decal.frame.size / 6000.0)
        scene = bear().scene
        surfaces = DecalSurfaces()
        for opaque in (decal.opaque, decal.opaque, decal.opaque.copy()):
            surfaces.laid(scene, frame, decal.texture_size, opaque, 0.01)
    assert len(sides) == 2
    assert max(sides) < 900


def test_decal_off_the_surface_is_refused(app: App, logo: Path) -> None:
    app.parts.file_actions.open(logo)
    decal = replace(in_hand(app), at=(3.0, 3.0), placed=True)
    app.main_view.store.replace(with_transient(app.main_view.work, gizmo=decal))
    with pytest.raises(ProgdfError, match="there is no surface under the decal"):
        app.main_view.decal_place()


def test_decal_corners_turn_counterclockwise(app: App, logo: Path) -> None:
    app.parts.file_actions.open(logo)
    decal = in_hand(app)
    texture, size = decal.texture, decal.texture_size
    opaque = decal.opaque
    flat = decal_corners(Decal(logo, texture, size, opaque, 80.0, 0.0, (100.0, 100.0)))
    assert flat == [(60.0, 80.0), (140.0, 80.0), (140.0, 120.0), (60.0, 120.0)]
    turned = decal_corners(Decal(logo, texture, size, opaque, 80.0, 90.0, (100.0, 100.0)))
    assert np.allclose(turned, [(80.0, 140.0), (80.0, 60.0), (120.0, 60.0), (120.0, 140.0)])


@pytest.mark.parametrize(
    ("mode", "alpha", "expected"), [("RGBA", 0, True), ("RGBA", 255, False), ("RGB", 0, False)]
)
def test_picture_with_transparency_is_a_decal(tmp_path: Path, mode: str, alpha: int, expected: bool) -> None:
    picture = Image.new("RGBA", (8, 8), (9, 9, 9, 255))
    picture.putpixel((0, 0), (9, 9, 9, alpha))
    picture.convert(mode).save(tmp_path / "a.png")
    assert is_decal(tmp_path / "a.png") == expected


def test_dropped_picture_with_too_many_pixels_is_refused(app: App, tmp_path: Path) -> None:
    app.parts.file_actions.open(bomb(tmp_path / "a.png", 100_000, 100_000))
    message = app.main_view.work.message
    assert message is not None
    assert "it has more than 67 million pixels" in message.text
