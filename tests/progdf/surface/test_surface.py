"""Surface under paint, on surfaces with known depths."""

from __future__ import annotations

import numpy as np
import pytest

from progdf.surface.find import find_surface, fit_surface, light_thickness, surface_pixels
from progdf.surface.models import Samples, fit_planes, fit_quadric, fit_spline
from tests.trainer.painted_wall import CAMERA, SIDE, wall

FOCAL = 600.0
NOISE_PX = 3.0


def samples(inverse_depth: object, seed: int = 0, count: int = 900, outliers: float = 0.1) -> Samples:
    """Return noisy points of an inverse depth; some of them lie far in front."""
    random = np.random.default_rng(seed)
    x, y = random.uniform(-0.3, 0.3, (2, count))
    inverse = inverse_depth(x, y)  # type: ignore[operator]
    noisy = inverse * (1.0 + NOISE_PX / FOCAL * random.standard_normal(count))
    far = random.random(count) < outliers
    return Samples(x, y, np.where(far, 1.3 * noisy, noisy), FOCAL)


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 + 0.2 * x - 0.1 * y


def edge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.minimum(0.5 + 0.4 * x, 0.52 - 0.5 * x + 0.1 * y)


def round_edge(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return -0.02 * np.logaddexp(-(0.5 + 0.4 * x) / 0.02, -(0.52 - 0.5 * x + 0.1 * y) / 0.02)


def bowl(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 - 1.2 * x**2 - 0.8 * y**2 + 0.1 * x


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 0.5 + 0.03 * np.sin(14 * x) * np.cos(12 * y)


@pytest.mark.parametrize(
    ("shape", "name"),
    [
        (plane, "a plane"),
        pytest.param(edge, "2 planes that meet in an edge", marks=pytest.mark.slow),
        pytest.param(bowl, "a curved surface of degree 2", marks=pytest.mark.slow),
        pytest.param(waves, "a smooth surface", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("seed", range(2))
def test_simplest_model_within_the_noise_is_found(shape: object, name: str, seed: int) -> None:
    chosen = fit_surface(samples(shape, seed), 1.3 * NOISE_PX)
    assert chosen is not None
    model, residual = chosen
    assert model.name.startswith(name)
    assert residual == pytest.approx(NOISE_PX, rel=0.3)
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 30), np.linspace(-0.25, 0.25, 30))
    true = shape(x, y)  # type: ignore[operator]
    error_px = np.abs(model.inverse_depth(x, y) / true - 1.0) * FOCAL
    assert float(np.sqrt((error_px**2).mean())) < NOISE_PX


@pytest.mark.parametrize(("shape", "is_rounded"), [(edge, False), (round_edge, True)])
def test_edges_are_as_sharp_as_the_samples(shape: object, is_rounded: bool) -> None:
    model = fit_planes(samples(shape), 2)
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 40), np.linspace(-0.25, 0.25, 40))
    true = shape(x, y)  # type: ignore[operator]
    error_px = np.abs(model.inverse_depth(x, y) / true - 1.0) * FOCAL
    assert model.rounding > 0.0 or not is_rounded
    assert float(error_px.max()) < 2.0 * NOISE_PX
    assert float(np.sqrt((error_px**2).mean())) < 0.4 * NOISE_PX


def test_plane_is_found_to_a_fraction_of_the_noise() -> None:
    model = fit_planes(samples(plane))
    x, y = np.meshgrid(np.linspace(-0.3, 0.3, 30), np.linspace(-0.3, 0.3, 30))
    error_px = np.abs(model.inverse_depth(x, y) / plane(x, y) - 1.0) * FOCAL
    assert float(error_px.max()) < 0.8


def test_gradients_are_those_of_the_inverse_depth() -> None:
    some = samples(bowl)
    x, y = np.random.default_rng(1).uniform(-0.2, 0.2, (2, 50))
    box = (-0.3, -0.3, 0.3, 0.3)
    for model in (
        fit_planes(some),
        fit_planes(samples(edge), 2),
        fit_planes(some, 2),
        fit_quadric(some),
        fit_spline(some, 2, box),
    ):
        by_x, by_y = model.gradient(x, y)
        step = 1e-5
        near = model.part(x - step, y - step) == model.part(x + step, y + step)
        along_x = (model.inverse_depth(x + step, y) - model.inverse_depth(x - step, y)) / (2 * step)
        along_y = (model.inverse_depth(x, y + step) - model.inverse_depth(x, y - step)) / (2 * step)
        assert np.allclose(by_x[near], along_x[near], atol=1e-3)
        assert np.allclose(by_y[near], along_y[near], atol=1e-3)


def test_paint_on_a_rough_wall_lies_on_its_plane() -> None:
    scene = wall()
    painted = np.zeros((SIDE, SIDE), bool)
    painted[40:90, 35:95] = True
    surface = find_surface(scene, CAMERA, painted)
    assert [fit.model.name for fit in surface.fits] == ["a plane"]
    pixel = 3.0 / float(CAMERA.K[0, 0])
    off = (surface.depth[painted] - surface.depth[painted].mean()) / pixel
    assert float(off.std()) < 0.8
    assert surface.thickness >= pixel


def test_nothing_painted_has_no_model() -> None:
    surface = find_surface(wall(), CAMERA, np.zeros((SIDE, SIDE), bool))
    assert surface.fits == ()
    assert surface.thickness == 0.0


def test_paint_too_small_for_a_model_lies_at_the_smoothed_depth() -> None:
    painted = np.zeros((SIDE, SIDE), bool)
    painted[60:62, 60:62] = True
    surface = find_surface(wall(), CAMERA, painted)
    assert surface.fits == ()
    assert "too small for a model" in surface.describe()


def test_thickness_is_the_spread_of_the_light() -> None:
    scene = wall(rough=0.0)
    all_pixels = np.ones((SIDE, SIDE), bool)
    pixel = 3.0 / float(CAMERA.K[0, 0])
    assert light_thickness(scene, CAMERA, all_pixels) == pytest.approx(pixel, rel=0.1)
    assert 0.03 < light_thickness(wall(rough=0.1), CAMERA, all_pixels) < 0.1


def test_thin_spots_belong_to_the_surface_and_outlines_do_not() -> None:
    alpha = np.full((20, 20), 1.0, np.float32)
    alpha[:, 15:] = np.linspace(0.9, 0.1, 5)
    alpha[4:6, 4:7] = 0.8
    alpha[0, 2] = 0.6
    alpha[10:13, 6:9] = 0.7
    alpha[11, 7] = 0.2
    found = surface_pixels(alpha)
    expected = np.ones((20, 20), bool)
    expected[:, 15:] = False
    expected[10:13, 6:9] = False
    assert (found == expected).all()
    assert surface_pixels(np.full((3, 3), 0.8)).all(), "an evenly thin wall"
    assert not surface_pixels(np.full((3, 3), 0.4)).any()
