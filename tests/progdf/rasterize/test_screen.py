"""Tests of a picture on the screen: bytes rounded as in saved files, scaled as in torch, lines behind it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from progdf.rasterize.screen import draw_lines_behind, fill_screen


@pytest.mark.parametrize("size", [(130, 90), (260, 180), (259, 179), (1, 1)])
def test_screen_has_the_flipped_picture_in_any_size(size: tuple[int, int]) -> None:
    image = torch.rand(90, 130, 3, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1
    screen = np.zeros((size[1], size[0], 4), np.uint8)
    fill_screen(image.numpy(), screen)
    stretched = torch.nn.functional.interpolate(
        image.permute(2, 0, 1)[None], size[::-1], mode="bilinear", align_corners=False
    )[0].permute(1, 2, 0)
    expected = (stretched.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
    apart = np.abs(screen[::-1, :, :3].astype(int) - expected)
    assert apart.max() <= (size != (130, 90)), "to the byte where it is not stretched"
    assert (screen[:, :, 3] == 255).all()


def line(x0: float, y0: float, x1: float, y1: float) -> list[float]:
    return [x0, y0, x1, y1, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]


def test_line_is_one_pixel_wide_transparent_and_removed_exactly() -> None:
    image = np.random.default_rng(0).random((20, 30, 3), np.float32) + 1.0
    through = np.ones((20, 30), np.float32)
    through[:, 15:] = 0.0
    before = image.copy()
    lines = np.array([line(-1e7, 10.5, 1e7, 10.5), line(5.5, -3, 5.5, 400), line(0, 0, 30, 20)], np.float32)
    with draw_lines_behind(image, through, lines, 0.5):
        assert (image[10, :15] == 0.0).all()
        assert (image[:, 5] == 0.0).all()
        assert np.array_equal(image[:, 15:], before[:, 15:]), "behind what covers it"
        assert np.array_equal(image[15:, :5], before[15:, :5])
        assert (image[4, 6] < before[4, 6]).all()
    assert np.array_equal(image, before)


def test_lines_fade_and_invisible_lines_draw_nothing() -> None:
    image = np.ones((8, 64, 3), np.float32)
    through = np.ones((8, 64), np.float32)
    fading = line(0, 4.5, 64, 4.5)
    fading[8] = 1.0
    with draw_lines_behind(image, through, np.array([fading], np.float32), 0.25):
        assert (np.diff(image[4, :, 0]) >= 0.0).all()
        assert image[4, 0, 0] == 0.0
        assert image[4, 63, 0] > 0.98
    nowhere = [line(3, 3, 3, 3), line(-9, -9, -5, 90), line(9, 100, 90, 100)]
    with draw_lines_behind(image, through, np.array(nowhere, np.float32), 0.5):
        assert (image == 1.0).all()


def test_last_bit_of_a_crossing_line_moves_no_pixel() -> None:
    """Let lines enter and leave at pixel borders, where the last bit would decide the number of pixels."""
    through = np.ones((24, 64), np.float32)
    drawn = []
    for shift in np.linspace(-2e-5, 2e-5, 21):
        image = np.ones((24, 64, 3), np.float32)
        lines = [line(-20.0 + shift, 3.3, 84.0 + shift, 16.1), line(12.3, -9.0 + shift, 18.4, 40.0 + shift)]
        with draw_lines_behind(image, through, np.array(lines, np.float32), 0.5):
            drawn.append(image.copy())
    # a pixel's share follows the line's position: 4e-5 px, where float32 has steps of 8e-6
    assert np.ptp(np.stack(drawn), axis=0).max() < 1e-4
