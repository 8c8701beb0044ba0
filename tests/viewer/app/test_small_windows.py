"""Questions, timeline controls and the home view stay reachable in a small window."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from imgui_bundle import imgui

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.camera.view_camera import ViewCamera, first_camera, fit_subject, with_up
from viewer.files import user_files
from viewer.files.document import Document
from viewer.panel import panel
from viewer.state import workspace
from viewer.state.workspace import Dialog, with_transient
from viewer.ui import overlay

pytestmark = pytest.mark.gl
SMALLEST = (640, 400)
"""Smallest window size, points."""


def windows(name: str) -> list[imgui.internal.Window]:
    """Return imgui's active windows whose name contains a text."""
    found = imgui.get_current_context().windows
    return [window for window in found if name in window.name and window.active]


@pytest.mark.slow
@pytest.mark.parametrize("points", [SMALLEST, (800, 600), (1280, 800)])
@pytest.mark.parametrize("kind", ["open", "save", "leave", "overwrite", "restore", "replace"])
def test_every_question_fits_the_window_with_many_recent_files(points: tuple[int, int], kind: str) -> None:
    with rig(first_view(bear(), 0.5, 0.5), points) as hand:
        name = "a_scene_with_a_rather_long_name_indeed"
        hand.main_view.store.replace(
            with_transient(
                hand.main_view.work,
                recent=tuple(Path(f"/scenes/{name}_{i}.ply") for i in range(user_files.MAX_RECENT)),
            )
        )
        hand.main_view.messages.ask(
            Dialog(kind, f"/scenes/{name}.session.json", error="it cannot be read", notice="type it")
        )
        hand.frame(4)
        (dialog,) = [window for window in windows("##dialog") if "/" not in window.name]
        assert dialog.pos.x >= 0.0
        assert dialog.pos.y >= 0.0
        assert dialog.pos.x + dialog.size.x <= points[0] - panel.WIDTH_PX
        assert dialog.pos.y + dialog.size.y <= points[1]
        assert dialog.content_size.y <= dialog.size.y, "the buttons are not cut off"


@pytest.mark.parametrize("points", [SMALLEST, (800, 600)])
def test_timeline_controls_stay_in_a_narrow_window(points: tuple[int, int]) -> None:
    with rig(first_view(bear(), 0.5, 0.5), points) as hand:
        hand.key("K")
        assert hand.main_view.work.player.shown
        (bar,) = windows("timeline")
        assert bar.pos.y + bar.size.y <= points[1]
        assert bar.content_size.x <= bar.size.x
        hand.click(*hand.at("easing"))
        assert hand.main_view.work.view.timeline.keys[0].easing == "linear"
        hand.click(*hand.at("ping_pong"))
        assert hand.main_view.work.view.timeline.ping_pong


def test_home_view_is_upright_and_framed_for_any_up_axis() -> None:
    with rig(first_view(bear(), 0.5, 0.5), (700, 640)) as hand:
        first = hand.main_view.work.view.camera
        hand.key("Shift+F")
        assert hand.main_view.work.view.camera == first
        turned_by_hand(hand, (0.0, 0.0, 1.0))
        hand.key("Shift+F")
        home = hand.main_view.work.view.camera
        assert home.up == (0.0, 0.0, 1.0)
        fitted = fit_subject(home, bear().scene, 400 / 640)
        assert home.distance == pytest.approx(fitted.distance, rel=1e-4), (
            "as one would frame it under this axis"
        )
        assert home.pivot == pytest.approx(fitted.pivot, abs=1e-3)
        turned_by_hand(hand, first.up)
        hand.key("Shift+F")
        assert hand.main_view.work.view.camera == first


def turned_by_hand(hand: Rig, up: tuple[float, float, float]) -> None:
    camera = with_up(hand.main_view.work.view.camera, up)
    hand.main_view.store.replace(workspace.with_camera(hand.main_view.work, replace(camera, azimuth=70.0)))


def test_home_view_uses_the_first_camera_with_the_same_up_axis() -> None:
    scene = bear().scene
    first = first_camera(scene)
    assert Document("bear.ply", scene).facts().home(ViewCamera(up=first.up), 1.5) == first


def test_banner_breaks_between_words_where_it_is_too_wide() -> None:
    text = "200 px   Click: place. Shift+wheel: rotate, with Ctrl in steps"
    wrapped = overlay.wrap_words(text, 20.0, len)
    assert " ".join(wrapped).split() == text.split()
    assert max(map(len, wrapped)) <= 20
    assert overlay.wrap_words(text, 100.0, len) == [text]
    assert overlay.wrap_words(text, 0.0, len) == text.split()
