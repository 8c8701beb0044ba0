"""A transparent picture dropped on the window follows the pointer until it is placed on the surface."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui
from PIL import Image

from progdf.io.cameras import load_cameras
from tests.helpers.null_app import null_app, press
from tests.helpers.sessions import bear_files, opened_document
from tests.helpers.ui_rig import bear, first_view, rig
from viewer.app.app import App
from viewer.app.handles import decal_corners, is_decal, load_decal
from viewer.jobs.training import EditOrder
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


def test_decal_follows_the_pointer_and_scales_with_the_wheel(logo: Path) -> None:
    with rig(first_view(bear())) as hand:
        camera = hand.main_view.work.view.camera
        hand.main_view.store.replace(
            with_transient(hand.main_view.work, gizmo=load_decal(hand.main_view.context, logo))
        )
        hand.io.add_mouse_pos_event(200.0, 300.0)
        hand.frame(2)
        first = hand.main_view.work.transient.gizmo
        assert isinstance(first, Decal)
        assert first.at == (200.0, 300.0)
        assert first.size == 0.25 * hand.io.display_size.y
        for shift in (False, True):
            hand.modifier(imgui.Key.mod_shift, shift)
            hand.io.add_mouse_wheel_event(0.0, 1.0)
            hand.frame(2)
        hand.modifier(imgui.Key.mod_shift, False)
        now = hand.main_view.work.transient.gizmo
        assert isinstance(now, Decal)
        assert (now.size, now.angle) == (pytest.approx(1.08 * first.size), 5.0)
        assert hand.main_view.work.view.camera == camera
        hand.key("Escape")
        assert Plain("put_back") in hand.main_view.take_requests()


def test_enter_places_the_decal_at_its_position(
    app: App, logo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders: list[EditOrder] = []
    monkeypatch.setattr(app.parts.jobs.queue, "add", orders.append)
    app.parts.file_actions.open(logo)
    app.draw()
    x, y = app.main_view.picture_size
    press(app, "Enter")
    app.draw()
    assert app.main_view.work.transient.gizmo is None
    (order,) = orders
    words = dict(word.lstrip("-").split("=", 1) for word in order.arguments() if "=" in word)
    assert words["editor"] == f"decal:{logo}"
    assert words["at"] == f"{x / 2:.2f},{y / 2:.2f},{y / 4:.2f},0.00"
    (camera,) = load_cameras(Path(words["camera"]))
    assert (camera.width, camera.height) == app.main_view.picture_size


def test_decal_corners_turn_counterclockwise(app: App, logo: Path) -> None:
    app.parts.file_actions.open(logo)
    decal = in_hand(app)
    texture, size = decal.texture, decal.texture_size
    flat = decal_corners(Decal(logo, texture, size, 80.0, 0.0, (100.0, 100.0)))
    assert flat == [(60.0, 80.0), (140.0, 80.0), (140.0, 120.0), (60.0, 120.0)]
    turned = decal_corners(Decal(logo, texture, size, 80.0, 90.0, (100.0, 100.0)))
    assert np.allclose(turned, [(80.0, 140.0), (80.0, 60.0), (120.0, 60.0), (120.0, 140.0)])


@pytest.mark.parametrize(
    ("mode", "alpha", "expected"), [("RGBA", 0, True), ("RGBA", 255, False), ("RGB", 0, False)]
)
def test_picture_with_transparency_is_a_decal(tmp_path: Path, mode: str, alpha: int, expected: bool) -> None:
    picture = Image.new("RGBA", (8, 8), (9, 9, 9, 255))
    picture.putpixel((0, 0), (9, 9, 9, alpha))
    picture.convert(mode).save(tmp_path / "a.png")
    assert is_decal(tmp_path / "a.png") == expected
