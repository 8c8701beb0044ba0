"""Measure tool: two clicks give a distance, and its true length sets the unit of the window's lengths."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from imgui_bundle import imgui

from tests.helpers.sessions import opened_document
from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.app import typed
from viewer.files import session
from viewer.files.session import WindowSession
from viewer.state import actions
from viewer.state.commands import WithValue
from viewer.state.transient import Gizmo, Measure, TypedTransform
from viewer.state.view_state import ViewState

pytestmark = pytest.mark.gl
WINDOW = (700, 640)
FIRST = (200.0, 300.0)
SECOND = (200.0, 420.0)


def measured(hand: Rig) -> Measure:
    hand.key("Shift+M")
    hand.click(*FIRST)
    hand.rest(0.5)
    hand.click(*SECOND)
    measure = hand.main_view.work.transient.measure
    assert measure is not None
    return measure


def tap(hand: Rig, key: imgui.Key) -> None:
    """Press and release a key in imgui's fields."""
    for down in (True, False):
        imgui.get_io().add_key_event(key, down)
        hand.frame(2)


def set_length(hand: Rig, length: float) -> None:
    main_view = hand.main_view
    action = WithValue("true_length", length)
    main_view.store.replace(actions.perform(main_view.work, action, main_view.facts, 1.0))
    hand.frame(2)


def test_two_clicks_measure_the_distance_of_surface_points() -> None:
    with rig(first_view(bear()), WINDOW) as hand:
        camera = hand.main_view.work.view.camera
        measure = measured(hand)
        assert measure.distance == pytest.approx(float(np.linalg.norm(np.subtract(*measure.points))))
        assert measure.distance > 0.0
        pixels = [
            typed._project(np.array(p), hand.main_view.pointer().camera(camera)) for p in measure.points
        ]
        np.testing.assert_allclose(pixels, [FIRST, SECOND], atol=0.6)
        assert hand.main_view.work.view.camera == camera
        hand.rest(0.5)
        hand.click(*FIRST)
        again = hand.main_view.work.transient.measure
        assert again is not None
        assert len(again.points) == 1, "a third click begins anew"
        hand.key("Escape")
        assert hand.main_view.work.transient.measure is None


def test_true_length_sets_the_unit_and_undo_restores_it() -> None:
    with rig(first_view(bear()), WINDOW) as hand:
        measure = measured(hand)
        set_length(hand, 2.5)
        unit = hand.main_view.work.view.unit
        assert measure.distance is not None
        assert unit * measure.distance == pytest.approx(2.5)
        for invalid in (0.0, -1.0, float("nan"), float("inf")):
            set_length(hand, invalid)
            assert hand.main_view.work.view.unit == unit
        tap(hand, imgui.Key.escape)  # leaves the field, which has its own undo
        hand.key("Ctrl+Z")
        assert hand.main_view.work.view.unit == 1.0


def test_length_is_typed_right_after_the_second_click() -> None:
    with rig(first_view(bear()), WINDOW) as hand:
        measure = measured(hand)
        hand.frame(3)
        assert imgui.get_io().want_text_input
        imgui.get_io().add_input_characters_utf8("2.5")
        hand.frame(2)
        tap(hand, imgui.Key.enter)
        assert not imgui.get_io().want_text_input
        assert measure.distance is not None
        assert hand.main_view.work.view.unit * measure.distance == pytest.approx(2.5)


def test_click_beside_the_scene_measures_nothing() -> None:
    with rig(first_view(bear()), WINDOW) as hand:
        hand.key("Shift+M")
        hand.click(150.0, 75.0)
        assert hand.main_view.work.transient.measure == Measure()


def test_another_tool_ends_the_clicks_of_the_measure_tool() -> None:
    with rig(first_view(bear()), WINDOW) as hand:
        hand.key("Shift+M")
        hand.key("J")
        hand.click(*FIRST)
        assert hand.main_view.work.transient.measure == Measure()
        assert hand.main_view.work.view.selection.count


def test_session_keeps_the_unit(folder: Path) -> None:
    document = opened_document(folder)
    view = replace(ViewState(camera=bear().first_camera), unit=2.54)
    path = folder / "scaled.session.json"
    session.save(path, WindowSession(document, view))
    assert session.open_session(path).view.unit == 2.54


def test_typed_offset_is_in_the_unit_of_the_scene() -> None:
    gizmo = Gizmo("transform", (0.0, 0.0, 0.0), np.eye(4))
    with rig(first_view(bear()), WINDOW) as hand:
        camera = hand.main_view.pointer().camera(hand.main_view.work.view.camera)
    sight = typed.Sight(camera, (0.0, 0.0), (0.0, 0.0), unit=2.0)
    assert typed.value_of(gizmo, TypedTransform("move", np.eye(4), "X", "3"), sight) == [1.5, 0.0, 0.0]
