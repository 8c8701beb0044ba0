"""Inspection of the picture: the readout at the pointer, the histogram, and the status line."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest

from tests.helpers.ui_rig import Rig, rig
from viewer.app.inspect.readouts import describe
from viewer.app.main_view import FIT_POLL_S
from viewer.render.picking import PixelGaussians
from viewer.state.commands import Plain, WithText
from viewer.state.selection import unpack
from viewer.state.transient import Histogram
from viewer.state.workspace import with_transient


@pytest.mark.gl
def test_view_mode_changes_the_window_and_can_be_undone() -> None:
    with rig() as hand:
        hand.settle()
        before = hand.image()
        hand.key("Z")
        assert hand.main_view.work.view.mode == "centers"
        assert not np.array_equal(hand.image(), before)
        hand.key("Ctrl+Z")
        assert hand.main_view.work.view.mode == "splats"
        assert np.array_equal(hand.image()[100:400, 100:300], before[100:400, 100:300])


@pytest.mark.gl
def test_contribution_outlines_the_splats_of_the_pixel() -> None:
    with rig() as hand:
        _perform(hand, WithText("view_mode", "contribution"))
        hand.move(600, 20)
        off = hand.image()
        hand.move(160, 270)
        hand.settle()
        on = hand.image()
        assert (on[150:390, 70:300] != off[150:390, 70:300]).any(axis=2).mean() > 0.01


def test_readout_counts_splats_and_their_half() -> None:
    shares = np.array([0.5, 0.3, 0.0, 0.2])
    seen = PixelGaussians(np.arange(4), shares, np.array([1.0, 2.0, 9.0, 3.0]))
    assert describe(seen, 2.0) == ("3 splats, depth 3.4", "1 splat makes half of the color")


@pytest.mark.gl
def test_dragged_range_of_the_histogram_selects_as_one_undo_step() -> None:
    with rig() as hand:
        hand.key("Shift+I")
        left, top = _corner_of_bars(hand)
        hand.drag((left + 20, top + 30), (left + 120, top + 30))
        work = hand.main_view.work
        selected = unpack(work.view.selection.members, hand.main_view.facts.count)
        histogram = work.transient.histogram
        assert isinstance(histogram, Histogram)
        assert histogram.range is not None
        sizes = hand.main_view.engine.composer.gaussians.log_scales.max(dim=1).values.numpy() / np.log(10.0)
        low, high = histogram.range
        assert 0 < selected.sum() < len(selected)
        np.testing.assert_array_equal(selected, (sizes >= low) & (sizes <= high))
        hand.key("Ctrl+Z")
        assert hand.main_view.work.view.selection.count == 0
        hand.key("Shift+I")
        assert hand.main_view.work.transient.histogram is None


@pytest.mark.gl
def test_slow_histogram_is_computed_in_the_background(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting: list[Callable[[], object]] = []

    def keep(work: Callable[..., object], *given: object, thread: str) -> None:
        waiting.append(partial(work, *given))

    monkeypatch.setattr("viewer.app.inspect.readouts._DIRECT_MS", 0.0)
    monkeypatch.setattr("viewer.render.background.run_in_background", keep)
    with rig() as hand:
        hand.key("Shift+I")
        hand.main_view.store.replace(
            with_transient(hand.main_view.work, histogram=Histogram(property="surface"))
        )
        hand.event()
        hand.settle()
        assert len(waiting) == 2, "size, then the distance to the surface"
        assert hand.main_view.next_frame_delay() == FIT_POLL_S
        left, top = _corner_of_bars(hand)
        hand.drag((left + 60, top + 30), (left + 120, top + 30))
        assert hand.main_view.work.view.selection.count == 0
        for work in waiting:
            work()
        hand.event()
        hand.drag((left + 60, top + 30), (left + 120, top + 30))
        assert hand.main_view.work.view.selection.count > 0
        assert len(waiting) == 2, "it is computed once"


@pytest.mark.gl
def test_status_line_appears_on_demand() -> None:
    with rig() as hand:
        hand.move(200, 200)
        before = hand.image()
        hand.key("Shift+F1")
        assert hand.main_view.work.layout.status
        lower = hand.image()[-40:, :330] != before[-40:, :330]
        assert lower.any()


def _perform(hand: Rig, action: Plain | WithText) -> None:
    hand.main_view._perform(action)
    hand.settle()


def _corner_of_bars(hand: Rig) -> tuple[float, float]:
    """Return the upper left corner of the histogram's bars, found by its window."""
    from imgui_bundle import imgui

    window = imgui.internal.find_window_by_name("histogram")
    assert window is not None
    return window.pos.x + 8.0, window.pos.y + 8.0 + 30.0
