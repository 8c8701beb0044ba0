"""Tests of lens distortion: photographs are undistorted exactly inside their visible area."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from progdf.camera import Lens, undistort

BARREL = Lens(k1=-0.18, k2=0.03, p1=0.004, p2=-0.006, k3=0.002)
K = torch.tensor([[90.0, 0.0, 63.0], [0.0, 85.0, 49.5], [0.0, 0.0, 1.0]])
WIDTH = 128
HEIGHT = 96


def pattern(rays: Tensor) -> Tensor:
    """Return the color of each ray in a smooth world on the plane z = 1. [...,2] -> [...,3]"""
    x = rays[..., 0]
    y = rays[..., 1]
    return 0.5 + 0.4 * torch.stack([torch.sin(7 * x), torch.sin(6 * y), torch.cos(5 * (x + y))], dim=-1)


def pixel_rays() -> Tensor:
    rows, columns = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1).double()
    return (pixels - K[:2, 2].double()) / torch.stack([K[0, 0], K[1, 1]]).double()


def photograph(lens: Lens) -> Tensor:
    """Return `pattern` through a camera with this lens. Fixed-point iteration finds the ray of each pixel."""
    seen = pixel_rays()
    rays = seen.clone()
    for _ in range(200):
        rays = rays - 0.7 * (lens.distort(rays) - seen)
    assert float((lens.distort(rays) - seen).abs().max()) < 1e-9
    return pattern(rays).float()


def test_undistorted_photograph_matches_a_pinhole_camera() -> None:
    straight, shown = undistort(photograph(BARREL), K, BARREL)
    expected = pattern(pixel_rays()).float()
    assert float(shown.float().mean()) > 0.7
    inner = shown.clone()
    inner[:, :] &= torch.nn.functional.avg_pool2d(shown.float()[None], 3, 1, 1)[0] > 0.99
    error = (straight - expected)[inner].abs().max()
    assert float(error) < 0.004, "bilinear sampling of a pattern of 80 pixels' wavelength"
    bent = (photograph(BARREL) - expected)[inner].abs().max()
    assert float(bent) > 0.05, "the lens bends too little to test anything"


def test_area_outside_the_photograph_is_masked() -> None:
    pincushion = Lens(k1=0.4)
    straight, shown = undistort(photograph(Lens()), K, pincushion)
    for row, column in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        assert not bool(shown[row, column]), "a corner, which the lens pulls out of the photograph"
    assert bool(shown[HEIGHT // 2, WIDTH // 2])
    assert float(straight[~shown].abs().max()) == 0.0


def test_edge_of_a_photograph_is_not_darkened() -> None:
    straight, shown = undistort(torch.ones(HEIGHT, WIDTH, 3), K, Lens(k1=0.1))
    torch.testing.assert_close(straight[shown], torch.ones(int(shown.sum()), 3))


def test_identity_lens_changes_nothing() -> None:
    image = photograph(Lens())
    straight, shown = undistort(image, K, Lens())
    assert bool(shown.all())
    torch.testing.assert_close(straight, image, atol=2e-5, rtol=0)


def test_nothing_is_shown_beyond_the_fold_of_the_formula() -> None:
    folding = Lens(k1=-0.6)
    wide = torch.tensor([[40.0, 0.0, 64.0], [0.0, 40.0, 48.0], [0.0, 0.0, 1.0]])
    _, shown = undistort(torch.rand(HEIGHT, WIDTH, 3), wide, folding)
    assert not bool(shown[48, 0])
    assert bool(shown[48, 64])


@pytest.mark.parametrize(
    ("lens", "radius"),
    [
        (Lens(k1=-0.6), (1 / 1.8) ** (1 / 2)),  # r (1 - 0.6 r²) has its maximum where 1 - 1.8 r² is 0
        (Lens(k2=-0.3), (1 / 1.5) ** (1 / 4)),
        (Lens(k3=-0.2), (1 / 1.4) ** (1 / 6)),
        (Lens(k1=-0.05), (1 / 0.15) ** (1 / 2)),  # 69° off axis
        (Lens(k1=0.3), math.inf),
        (Lens(p1=0.1, p2=0.1), math.inf),
    ],
)
def test_valid_radius_is_at_most_the_maximum_of_the_radial_part(lens: Lens, radius: float) -> None:
    found = lens.valid_radius()
    assert found <= radius
    assert found == pytest.approx(radius, abs=2e-3)


def test_lens_without_distortion_is_false() -> None:
    assert not Lens()
    assert Lens(p2=1e-9)
    with pytest.raises(ValueError, match="finite"):
        Lens(k1=math.nan)
    with pytest.raises(ValueError, match="finite"):
        Lens(p1=math.inf)
