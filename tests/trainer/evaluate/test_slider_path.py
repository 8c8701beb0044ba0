"""Figures of slider paths with known answers, and camera paths for measuring consistency."""

from __future__ import annotations

import math
from collections.abc import Hashable

import pytest
import torch
from torch import Tensor

from tests.helpers.scenes import orbit_camera
from trainer.evaluate.consistency import FRAMES, camera_path, neighbor_similarity
from trainer.evaluate.measures import SliderPath, slider_path
from trainer.fit.evaluate import Evaluator


class _Squared:
    """Squared distance, like LPIPS, for pictures of one color."""

    name = "squared"

    def __call__(self, image: Tensor, target: Tensor, key: Hashable = None) -> Tensor:
        return (image - target).square().mean()

    def forget(self) -> None:
        """Do nothing, because there is no cache."""


def _walked(course: list[float]) -> SliderPath:
    """Return the path of a slider that shows these gray values, interpolated linearly."""
    pixels = [torch.ones(4, 4, dtype=torch.bool)]
    evaluator = Evaluator(torch.zeros(0, 14), [], pixels, {}, ["a"])

    def pictures(s: float) -> list[Tensor]:
        at = min(int(s * (len(course) - 1)), len(course) - 2)
        share = s * (len(course) - 1) - at
        return [torch.full((4, 4, 3), (1 - share) * course[at] + share * course[at + 1])]

    return slider_path(evaluator, pictures, _Squared())


def test_straight_slider_is_even_monotone_without_triangle_excess() -> None:
    path = _walked([0.0, 1.0])
    assert path.evenness == pytest.approx(1.0, abs=1e-4)
    assert path.monotone == 1.0
    assert path.triangle_excess == pytest.approx(1.0, abs=1e-4)
    assert path.sum_over_ends == pytest.approx(1 / 20, abs=1e-4)
    assert path.mean == pytest.approx(path.largest, rel=1e-3)


def test_overshooting_slider_has_a_longer_path() -> None:
    path = _walked([0.0, 1.0, 0.5])
    assert path.monotone == pytest.approx(0.5)
    assert path.triangle_excess == pytest.approx((1.0 + 0.5) / 0.5, rel=1e-3)
    assert path.evenness == pytest.approx(0.5, rel=1e-3)


def test_slider_without_effect_has_no_triangle_excess() -> None:
    path = _walked([0.3, 0.3])
    assert math.isnan(path.triangle_excess)
    assert path.monotone == 0.0


def test_camera_path_passes_every_camera_and_turns_evenly() -> None:
    cameras = [orbit_camera(azimuth=a) for a in (0.0, 1.8, 0.9, 2.7)]
    path = camera_path(cameras)
    assert len(path) == 3 * FRAMES + 1
    for frame, camera in zip(path[::FRAMES], [cameras[i] for i in (0, 2, 1, 3)], strict=True):
        torch.testing.assert_close(frame.viewmat, camera.viewmat, rtol=0, atol=1e-5)
    for frame in path:
        turn = frame.viewmat[:3, :3]
        torch.testing.assert_close(turn @ turn.T, torch.eye(3), rtol=0, atol=1e-5)
        middle = frame.viewmat[:3, 3]  # orbit center in camera coordinates, straight ahead within 3 %
        assert float(middle[:2].abs().max()) < 0.03 * 4.0
        assert 3.5 < float(middle[2]) < 4.01


def test_equal_changes_between_frames_are_consistent() -> None:
    before = torch.nn.functional.normalize(
        torch.randn(5, 8, generator=torch.Generator().manual_seed(0)), dim=1
    )
    same = before + torch.tensor([0.3] + [0.0] * 7)
    turned = before + 0.3 * torch.eye(8)[:5]
    assert neighbor_similarity(before, same) == pytest.approx(1.0)
    assert neighbor_similarity(before, turned) == pytest.approx(0.0, abs=1e-6)
    assert neighbor_similarity(before, before) is None
