"""A picture as the bytes of a screen: rounded as saved pictures are, and stretched as torch stretches."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from progdf.rasterize.screen_bytes import fill_screen


@pytest.mark.parametrize("size", [(130, 90), (260, 180), (259, 179), (1, 1)])
def test_the_screen_has_the_picture_upside_down_in_any_size(size: tuple[int, int]) -> None:
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
