"""Qualities: gain and price of the steps to a larger model, and runs of every quality."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from tests.helpers.trained import quick_options, train
from trainer.options import Quality
from trainer.quality import QUALITIES, QualityLimits

MAP = (0.0, 39.0)
SMALLER = (3.0, 42.0)  # one function per dB


@pytest.mark.parametrize(
    ("quality", "gain", "too_dear"),
    [
        ("small", 0.7, False),
        ("small", 0.6, True),
        ("balanced", 0.21, False),
        ("balanced", 0.19, True),
        ("best", 0.01, False),
        ("best", 0.0, True),
    ],
)
def test_price_is_limited_by_that_of_the_step_before(quality: Quality, gain: float, too_dear: bool) -> None:
    larger = (5.0, 42.0 + gain)
    assert QUALITIES[quality].is_too_dear(MAP, SMALLER, larger) is too_dear


@pytest.mark.parametrize("base", [(0.0, -math.inf), (3.0, 40.0), (0.0, 42.5)])
def test_step_without_a_step_before_has_no_price(base: tuple[float, float]) -> None:
    assert not QUALITIES["small"].is_too_dear(base, SMALLER, (5.0, 42.001))


def test_better_qualities_have_looser_limits() -> None:
    limits = [QUALITIES[quality] for quality in ("small", "balanced", "best")]

    def loosen(name: str) -> list[float]:
        return [getattr(one, name) for one in limits]

    assert loosen("min_gain") == sorted(loosen("min_gain"), reverse=True)
    assert loosen("added_error") == sorted(loosen("added_error"), reverse=True)
    assert loosen("max_price_ratio") == sorted(loosen("max_price_ratio"))
    assert "10 times the bytes per dB" in limits[1].rule
    assert "bytes" not in QualityLimits(0.01, math.inf, 0.1).rule


def test_better_qualities_take_more_bytes(folder: Path) -> None:
    runs = [
        train(quick_options(folder, name, quality=name, views=10, image_size=72)).report
        for name in ("small", "balanced", "best")
    ]
    sizes = [run["field"]["bytes_per_gaussian"] for run in runs]
    assert sizes == sorted(sizes)
    assert sizes[0] < sizes[2]
