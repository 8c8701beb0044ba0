"""Dynamic resolution: coarse while the view moves, sharp at rest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.ui_rig import Rig, bear, first_view, rig
from viewer.render import dynamic_resolution
from viewer.render.dynamic_resolution import (
    COARSE_PIXELS,
    REST_S,
    SLOW_MS,
    DynamicResolution,
    FrameTimings,
    drawn_size,
)
from viewer.render.engine import ViewEngine
from viewer.ui.keys import Keys, Press

SLOW = FrameTimings(draw_ms=SLOW_MS + 1.0)
QUICK = FrameTimings(draw_ms=SLOW_MS - 1.0)
MIDDLE = (170.0, 270.0)


def twice(known: DynamicResolution, timings: FrameTimings, turned: bool) -> DynamicResolution:
    return dynamic_resolution.after_draw(
        dynamic_resolution.after_draw(known, timings, turned), timings, turned
    )


def test_slow_picture_is_coarse_while_the_camera_is_dragged() -> None:
    known = twice(DynamicResolution(), SLOW, turned=True)
    moving = dynamic_resolution.before_draw(known, "auto", held=True, turned=True, slid=False, now=1.0)
    assert moving.pixels == COARSE_PIXELS
    assert dynamic_resolution.next_frame_delay(moving, 1.0) == pytest.approx(REST_S)


def test_quick_picture_stays_sharp() -> None:
    known = twice(DynamicResolution(), QUICK, turned=True)
    assert (
        dynamic_resolution.before_draw(known, "auto", held=True, turned=True, slid=True, now=1.0).pixels == 1
    )


def test_single_slow_picture_changes_nothing() -> None:
    """The first picture is slow because the kernels are compiled."""
    known = dynamic_resolution.after_draw(DynamicResolution(), SLOW, turned=True)
    for then in (
        known,
        dynamic_resolution.after_draw(
            dynamic_resolution.after_draw(known, QUICK, turned=True), SLOW, turned=True
        ),
    ):
        assert (
            dynamic_resolution.before_draw(then, "auto", held=True, turned=True, slid=False, now=1.0).pixels
            == 1
        )


def test_quick_slider_stays_sharp_in_a_slow_scene() -> None:
    known = twice(twice(DynamicResolution(), SLOW, turned=True), QUICK, turned=False)
    assert (
        dynamic_resolution.before_draw(known, "auto", held=True, turned=False, slid=True, now=1.0).pixels == 1
    )


def test_slider_becomes_coarse_after_slow_steps() -> None:
    first = dynamic_resolution.before_draw(
        DynamicResolution(), "auto", held=True, turned=False, slid=True, now=1.0
    )
    assert first.pixels == 1, "nothing is known of it yet"
    second = twice(first, SLOW, turned=False)
    assert (
        dynamic_resolution.before_draw(second, "auto", held=True, turned=False, slid=True, now=1.1).pixels
        == COARSE_PIXELS
    )
    let_go = dynamic_resolution.before_draw(second, "auto", held=False, turned=False, slid=False, now=1.1)
    assert (
        dynamic_resolution.before_draw(let_go, "auto", held=True, turned=False, slid=True, now=1.2).pixels
        == 1
    )


def test_slider_stays_sharp_if_coarse_steps_are_not_faster() -> None:
    known = twice(DynamicResolution(coarse_ms=SLOW_MS + 2.0), SLOW, turned=False)
    for coarse_ms, pixels in ((SLOW_MS + 2.0, 1), (SLOW_MS, COARSE_PIXELS)):
        known = replace(known, coarse_ms=coarse_ms)
        assert (
            dynamic_resolution.before_draw(known, "auto", held=True, turned=False, slid=True, now=1.0).pixels
            == pixels
        )


def test_single_click_is_drawn_sharp_at_once() -> None:
    known = twice(DynamicResolution(), SLOW, turned=True)
    assert (
        dynamic_resolution.before_draw(known, "on", held=False, turned=True, slid=True, now=1.0).pixels == 1
    )


def test_drag_stays_coarse_between_steps_and_is_sharp_at_rest() -> None:
    moving = dynamic_resolution.before_draw(
        DynamicResolution(), "on", held=True, turned=True, slid=False, now=1.0
    )
    between = dynamic_resolution.before_draw(
        moving, "on", held=True, turned=False, slid=False, now=1.0 + 0.5 * REST_S
    )
    assert between.pixels == COARSE_PIXELS
    rested = dynamic_resolution.before_draw(
        between, "on", held=True, turned=False, slid=False, now=1.0 + REST_S
    )
    assert rested.pixels == 1
    assert dynamic_resolution.next_frame_delay(rested, 2.0) is None


def test_time_of_a_coarse_picture_is_not_recorded() -> None:
    moving = dynamic_resolution.before_draw(
        DynamicResolution(camera_ms=(90.0, 90.0)), "auto", held=True, turned=True, slid=False, now=1.0
    )
    assert dynamic_resolution.after_draw(moving, QUICK, turned=True).camera_ms == (90.0, 90.0)


def test_off_disables_coarse_pictures() -> None:
    moving = DynamicResolution(pixels=COARSE_PIXELS, rest_at=2.0, camera_ms=(500.0, 500.0))
    assert (
        dynamic_resolution.before_draw(moving, "off", held=True, turned=True, slid=True, now=1.0).pixels == 1
    )


@pytest.fixture
def hand() -> Iterator[Rig]:
    with rig(replace(first_view(bear(), 0.5, 0.5), dynamic_resolution="on")) as made:
        yield made


def shown(hand: Rig) -> tuple[int, int]:
    """Return the size of the drawn picture, pixels."""
    return drawn_size(hand.main_view.picture_size, hand.main_view.canvas.pixels)


def hold_and_orbit(hand: Rig) -> None:
    hand.move(*MIDDLE)
    hand.press()
    hand.move(MIDDLE[0] + 40.0, MIDDLE[1])


def wait(hand: Rig, seconds: float) -> None:
    hand.main_view.frame(hand.screen, seconds)


@pytest.mark.gl
def test_orbit_is_coarse_during_the_drag_and_sharp_at_rest(hand: Rig) -> None:
    assert shown(hand) == (340, 540)
    hold_and_orbit(hand)
    assert shown(hand) == (170, 270)
    coarse = hand.picture().astype(float)
    assert hand.main_view.next_frame_delay() == 0.0
    hand.settle()
    assert 0.0 < (hand.main_view.next_frame_delay() or 0.0) <= REST_S
    wait(hand, REST_S)
    assert shown(hand) == (340, 540)
    sharp = hand.picture()
    image = hand.main_view.engine.image(hand.main_view.work.view, (340, 540))
    assert np.abs(sharp - np.round(np.clip(image, 0.0, 1.0) * 255.0)).max() <= 1
    assert 0.05 < np.abs(coarse - sharp).mean() < 2.0, "the same bear in the same place, softer"
    hand.release()


@pytest.mark.gl
def test_slow_picture_is_drawn_beside_the_window_loop(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    for _ in range(2):  # two pictures to learn that drawing is slow
        hold_and_orbit(hand)
        hand.release()
        wait(hand, REST_S)
    monkeypatch.setattr(dynamic_resolution, "JUMP_MS", 0.0)
    before = hand.picture()
    with not_done(hand, monkeypatch):
        hand.main_view.store.change(replace(hand.main_view.work.view, background=(0.2, 0.3, 0.4)))
        hand.frame()
        assert (hand.picture() == before).all(), "the last picture stays"
        hand.settle()
        assert not hand.main_view.is_due(), "no frame takes the time from it"
        hand.main_view.wake()
        assert hand.main_view.is_due(), "but what comes in is seen at once"
    settle_sharply(hand)
    old = hand.picture()
    new = hand.main_view.engine
    other = ViewEngine(hand.main_view.context, new.scene, (), "cpu")
    hand.main_view.set_engine(other, hand.main_view.facts)
    with not_done(hand, monkeypatch):
        hand.main_view.store.change(replace(hand.main_view.work.view, layers=()))
        hand.frame()
        assert (hand.picture() == old).all(), "also that of another engine, as while an edit is trained"
    settle_sharply(hand)
    hand.main_view.set_engine(new, hand.main_view.facts)
    other.release()


@contextmanager
def not_done(hand: Rig, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Keep every picture unfinished, however fast the machine is."""
    with monkeypatch.context() as slow:
        slow.setattr(hand.main_view.canvas.comparer, "prepare", lambda *_: False)
        yield


def settle_sharply(hand: Rig) -> None:
    """Draw frames until the full picture is shown."""
    while hand.main_view.next_frame_delay() == 0.0 or hand.main_view.canvas.next_frame_delay(0.0) is not None:
        wait(hand, 0.02)
    image = hand.main_view.engine.image(hand.main_view.work.view, (340, 540))
    assert np.abs(hand.picture() - np.round(np.clip(image, 0.0, 1.0) * 255.0)).max() <= 1


@pytest.mark.gl
def test_slider_drag_is_coarse_too(hand: Rig) -> None:
    hand.move(*hand.slider(0, 0.5))
    hand.press()
    hand.move(*hand.slider(0, 0.8))
    assert hand.main_view.canvas.pixels == COARSE_PIXELS
    hand.release()
    wait(hand, REST_S)
    assert hand.main_view.canvas.pixels == 1


@pytest.mark.gl
def test_picture_at_rest_draws_nothing_more(hand: Rig) -> None:
    hold_and_orbit(hand)
    hand.release()
    wait(hand, REST_S)
    drawn = hand.main_view.canvas.pictures_drawn
    hand.event()
    wait(hand, 1.0)
    assert hand.main_view.canvas.pictures_drawn == drawn
    assert hand.main_view.next_frame_delay() in (0.0, None) or hand.main_view.next_frame_delay() > REST_S


@pytest.mark.gl
def test_split_is_coarse_on_both_sides_and_difference_never(hand: Rig) -> None:
    hand.key("Shift+Y")
    hand.move(60.0, 270.0)
    hand.press()
    hand.move(90.0, 270.0)
    assert hand.main_view.canvas.pixels == COARSE_PIXELS
    hand.release()
    wait(hand, REST_S)
    hand.key("Alt+Y")
    hold_and_orbit(hand)
    assert hand.main_view.canvas.pixels == 1
    hand.release()


@pytest.mark.gl
def test_key_cycles_through_the_modes(hand: Rig) -> None:
    modes = [hand.main_view.work.view.dynamic_resolution]
    for _ in range(3):
        hand.main_view.wake()
        hand.frame(keys=Keys((Press("Shift+F10"),), frozenset({"F10"})))
        modes.append(hand.main_view.work.view.dynamic_resolution)
    assert modes == ["on", "off", "auto", "on"]
