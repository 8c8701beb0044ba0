"""Tests of rules that every engine follows: crops, order, support, background and mask weights."""

from __future__ import annotations

import gc
from dataclasses import replace
from functools import partial

import pytest
import torch

from progdf.rasterize import ActivatedGaussians, activate, alpha_weights, render
from progdf.rasterize.cpu.weights import ListedWeights
from progdf.rasterize.engines import color_map
from tests.helpers.drawn import CASES, EVERY, FAST, draw, drawn_case
from tests.helpers.scenes import concatenate, front_camera, one_gaussian, orbit_camera, random_gaussians

pytestmark = pytest.mark.usefixtures("two_threads")


@pytest.mark.parametrize("crop", [(0, 0, 90, 61), (13, 7, 14, 8), (31, 8, 65, 40), (64, 33, 90, 61)])
@pytest.mark.parametrize("engine", EVERY)
def test_crop_is_the_slice_of_the_whole_picture(engine: str, crop: tuple[int, int, int, int]) -> None:
    camera = orbit_camera(90, 61)
    camera = replace(camera, K=camera.K + torch.tensor([[0.0, 0.0, 7.0], [0.0, 0.0, -5.0], [0.0, 0.0, 0.0]]))
    scene = concatenate(
        random_gaussians(150, seed=4), one_gaussian(mean=(2.0, 1.0, -2.5), scales=(1.0, 0.02, 0.5))
    )
    whole = draw(scene, camera, engine)
    part = draw(scene, camera, engine, crop=crop)
    x0, y0, x1, y1 = crop
    # bit for bit, except the reference: BLAS may add 151 products in another order, each rounded by 1.1e-16
    rounding = 2e-14 if engine == "reference" else 0.0
    for found, expected in ((part.image, whole.image), (part.transmittance, whole.transmittance)):
        torch.testing.assert_close(found, expected[y0:y1, x0:x1], atol=rounding, rtol=0.0)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("engine", EVERY)
def test_samples_are_pixels_of_the_larger_picture(engine: str, antialiased: bool) -> None:
    scene = replace(random_gaussians(200, scale=0.01), antialiased=antialiased)
    camera = orbit_camera(40, 30)
    sampled = render(scene, replace(camera, sampling=3.0), engine=engine).image
    whole = render(scene, camera.resize(120, 90), engine=engine).image[1::3, 1::3]
    assert float((sampled - render(scene, camera, engine=engine).image).abs().max()) > 0.05
    torch.testing.assert_close(sampled, whole, atol=2e-5, rtol=0.0)


@pytest.mark.parametrize("engine", FAST)
def test_row_order_does_not_matter_for_different_depths(engine: str) -> None:
    scene = random_gaussians(300, seed=8)
    camera = orbit_camera(50, 40)
    activated = activate(scene, scene.sh0.sigmoid())
    shuffle = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    first, second = (render(some, camera, engine=engine) for some in (activated, activated.select(shuffle)))
    assert torch.equal(first.image, second.image)


@pytest.mark.parametrize("engine", EVERY)
def test_equal_depths_are_drawn_in_row_order(engine: str) -> None:
    red = one_gaussian(rgb=(1.0, 0.0, 0.0), opacity=0.99)
    green = one_gaussian(rgb=(0.0, 1.0, 0.0), opacity=0.99)
    camera = front_camera()
    center = (camera.height // 2, camera.width // 2)
    assert float(render(concatenate(red, green), camera, engine=engine).image[center][0]) > 0.9
    assert float(render(concatenate(green, red), camera, engine=engine).image[center][1]) > 0.9


@pytest.mark.parametrize("engine", EVERY)
def test_support_ends_exactly_where_alpha_falls_below_1_255(engine: str) -> None:
    camera = front_camera(60, 40)
    gaussian = ActivatedGaussians(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.3),
        torch.tensor([0.7]), torch.ones(1, 3),
    )  # fmt: skip
    image, transmittance, _ = render(gaussian, camera, (0.0, 0.0, 0.0), engine=engine)
    x, y = torch.meshgrid(torch.arange(60) + 0.5 - 30, torch.arange(40) + 0.5 - 20, indexing="xy")
    variance = (0.3 * 30.0 / 2.0) ** 2 + 0.3
    alpha = 0.7 * torch.exp(-0.5 * (x.double() ** 2 + y.double() ** 2) / variance)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(image[..., 0].double(), alpha, rtol=0, atol=2e-6)
    assert torch.equal(transmittance == 1.0, alpha == 0.0)


@pytest.mark.parametrize("engine", EVERY)
def test_no_pixel_falls_below_the_minimum_transmittance(engine: str) -> None:
    drawn = drawn_case("400 opaque ones stacked", engine)
    assert 1e-4 < float(drawn.transmittance.min()) < 2e-3


@pytest.mark.parametrize("engine", EVERY)
def test_empty_scene_shows_the_background(engine: str) -> None:
    nothing = random_gaussians(5)[:0]
    image, transmittance, _ = render(nothing, front_camera(), (0.25, 0.5, 0.75), engine=engine)
    assert torch.equal(image, torch.tensor([0.25, 0.5, 0.75]).expand(24, 40, 3))
    assert bool((transmittance == 1.0).all())


@pytest.mark.parametrize("engine", FAST)
def test_mask_weights_match_the_reference_and_the_picture(engine: str) -> None:
    scene = random_gaussians(200, seed=9)
    camera = orbit_camera(90, 61)
    mask = torch.rand(61, 90, generator=torch.Generator().manual_seed(2)).round()
    found = alpha_weights(scene, camera, mask, engine)
    expected = alpha_weights(scene.to(dtype=torch.float64), camera, mask, engine="reference")
    torch.testing.assert_close(found.double(), expected, rtol=2e-5, atol=2e-5)
    transmittance = render(scene, camera, engine=engine).transmittance
    assert float(found[:, 2].sum()) == pytest.approx(float((1 - transmittance).sum()), rel=1e-5)
    inside = float(((1 - transmittance) * mask).sum())
    assert float(found[:, 0].sum()) == pytest.approx(inside, rel=1e-5)


@pytest.mark.parametrize("engine", EVERY)
def test_mask_weights_of_every_hard_case_are_finite(engine: str) -> None:
    for name, case in CASES.items():
        mask = torch.ones(case.camera.height, case.camera.width, dtype=torch.bool)
        weights = alpha_weights(case.gaussians.to(dtype=torch.float64), case.camera, mask, engine=engine)
        assert bool(weights.isfinite().all()), name
        assert torch.equal(weights[:, 1], weights[:, 3]), name


@pytest.mark.parametrize("engine", EVERY)
def test_color_map_draws_its_rows_and_its_gradient_is_the_transpose(engine: str) -> None:
    scene = random_gaussians(300, seed=11)
    camera = orbit_camera(90, 61)
    window = (21, 13, 70, 44)
    rng = torch.Generator().manual_seed(5)
    rows = torch.randperm(300, generator=rng)[:120]
    colors = torch.rand(120, 3, generator=rng)
    seen = torch.rand(31, 49, 3, generator=rng)
    activated = activate(scene)
    weighed = color_map(activated, camera, window, rows, engine)
    every = torch.zeros(300, 3).index_copy(0, rows, colors)
    drawn = render(activated, camera, (0.0, 0.0, 0.0), colors=every, crop=window, engine="reference").image
    picture = weighed.picture(colors)
    torch.testing.assert_close(picture, drawn, rtol=0, atol=2e-6)
    forth = (picture.double() * seen).sum()
    back = (colors.double() * weighed.gradient(seen)).sum()
    assert float(forth) == pytest.approx(float(back), rel=1e-6)


@pytest.mark.parametrize("channels", [1, 2, 4, 20])
@pytest.mark.parametrize("engine", EVERY)
def test_color_map_draws_any_number_of_channels(engine: str, channels: int) -> None:
    scene = random_gaussians(300, seed=11)
    camera = orbit_camera(90, 61)
    window = (21, 13, 70, 44)
    rows = torch.arange(0, 300, 2)
    pixels = torch.arange(31 * 49)[1::3]
    weighed = color_map(activate(scene), camera, window, rows, engine, pixels)
    values = torch.rand(150, channels, generator=torch.Generator().manual_seed(5))
    picture = weighed.picture(values)
    for c in range(channels):
        alone = weighed.picture(values[:, c : c + 1].expand(-1, 3))
        torch.testing.assert_close(picture[:, c], alone[:, 0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("engine", EVERY)
def test_color_map_of_some_pixels_matches_the_full_map(engine: str) -> None:
    scene = random_gaussians(300, seed=11)
    camera = orbit_camera(90, 61)
    window = (21, 13, 70, 44)
    rows = torch.arange(0, 300, 2)
    pixels = torch.arange(31 * 49)[1::3]
    whole = color_map(activate(scene), camera, window, rows, engine)
    some = color_map(activate(scene), camera, window, rows, engine, pixels)
    colors = torch.rand(150, 3)
    seen = torch.rand(len(pixels), 3)
    everywhere = torch.zeros(31 * 49, 3).index_copy(0, pixels, seen).view(31, 49, 3)
    torch.testing.assert_close(some.picture(colors), whole.picture(colors).flatten(0, 1)[pixels])
    torch.testing.assert_close(some.gradient(seen), whole.gradient(everywhere))


@pytest.mark.parametrize("lost", [0.0, 0.5 / 255.0, 0.3])
def test_color_map_omits_at_most_the_allowed_loss(lost: float) -> None:
    scene = random_gaussians(3000, seed=11)
    camera = orbit_camera(90, 61)
    window = (21, 13, 70, 44)
    rows = torch.arange(0, 3000, 2)  # the others only occlude
    all_of_it = color_map(activate(scene), camera, window, rows)
    listed = color_map(activate(scene), camera, window, rows, lost=lost)
    assert isinstance(listed, ListedWeights)
    assert isinstance(all_of_it, ListedWeights)
    left_out = all_of_it.picture(torch.ones(1500, 1)) - listed.picture(torch.ones(1500, 1))
    rounding = 1e-4 if lost else 1e-6  # a few dozen weights in steps of 1/65535
    assert float(left_out.min()) > -rounding
    assert float(left_out.max()) <= lost + rounding
    some = len(listed.entries()[2])
    every = len(all_of_it.entries()[2])
    assert some < 0.9 * every if lost else some == every
    values = torch.rand(1500, 3, generator=torch.Generator().manual_seed(5))
    away = (all_of_it.picture(values) - listed.picture(values)).abs().max()
    assert float(away) <= lost + rounding


def test_color_map_releases_its_inputs() -> None:
    scene = activate(random_gaussians(300, seed=11))
    camera = orbit_camera(90, 61)
    make = partial(color_map, scene, camera, (0, 0, 90, 61), torch.arange(300))
    make()  # loads kernels
    gc.collect()
    gc.disable()
    try:
        make()
        assert gc.collect() == 0, "a cycle would hold the lists of all views until the next collection"
    finally:
        gc.enable()
