"""Tests of the rasterizer: engines against each other and finite differences, on every hard case."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from progdf.gaussians import ATTRIBUTES
from progdf.rasterize import ActivatedGaussians, activate, render
from tests.helpers.drawn import (
    CASES,
    EVERY,
    FAST,
    INPUTS,
    draw,
    drawn_case,
    image_error,
    relative_errors,
    render_leaves,
)
from tests.helpers.scenes import front_camera, one_gaussian, orbit_camera, random_gaussians

pytestmark = pytest.mark.usefixtures("two_threads")


@pytest.mark.parametrize("engine", FAST)
@pytest.mark.parametrize("name", CASES)
def test_fast_engine_matches_the_reference_in_each_hard_case(name: str, engine: str) -> None:
    found = drawn_case(name, engine)
    expected = drawn_case(name, "reference")
    assert found.image.shape == expected.image.shape
    assert image_error(found, expected) <= 1e-5
    assert float((found.transmittance - expected.transmittance).abs().max()) <= 1e-5
    assert torch.equal(found.info.visible, expected.info.visible)
    torch.testing.assert_close(found.info.means2d, expected.info.means2d, rtol=1e-5, atol=1e-4)
    assert torch.equal(found.info.depths, expected.info.depths)


@pytest.mark.parametrize("engine", FAST)
@pytest.mark.parametrize("name", CASES)
def test_fast_engine_gradients_match_the_reference_in_each_hard_case(name: str, engine: str) -> None:
    errors = relative_errors(drawn_case(name, engine), drawn_case(name, "reference"))
    assert set(errors) == set(INPUTS)
    assert max(errors.values()) <= 1e-4, errors


@pytest.mark.parametrize("engine", EVERY)
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.poisoned])
def test_gaussian_that_is_not_finite_does_not_affect_others(name: str, engine: str) -> None:
    case = CASES[name]
    rows = list(CASES[name].poisoned)
    if "quats" in name:
        clean_quats = case.gaussians.quats.clone()
        clean_quats[rows] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        without = draw(replace(case.gaussians, quats=clean_quats), case.camera, engine)
    else:  # hidden, not removed: the exponential of a row may depend on its position in a vector
        other = next(i for i in range(len(case.gaussians)) if i not in case.poisoned)
        values = {name: getattr(case.gaussians, name).clone() for name in ATTRIBUTES}
        for value in values.values():
            value[rows] = value[other].clone()
        values["logit_opacities"][rows] = -100.0
        without = draw(replace(case.gaussians, **values), case.camera, engine)
    found = drawn_case(name, engine)
    assert bool(found.image.isfinite().all())
    torch.testing.assert_close(found.image, without.image, rtol=0, atol=1e-12 if engine == "reference" else 0)
    others = torch.tensor([i for i in range(len(case.gaussians)) if i not in case.poisoned])
    assert bool(found.gradients["means"][others].isfinite().all())


@pytest.mark.parametrize("engine", FAST)
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_scenes_meet_the_stated_errors(seed: int, antialiased: bool, engine: str) -> None:
    scene = replace(random_gaussians(300, seed=seed, sh_degree=3), antialiased=antialiased)
    camera = orbit_camera(90, 61)
    found, expected = (draw(scene, camera, name) for name in (engine, "reference"))
    assert float((found.image - expected.image).abs().max()) <= 2e-6
    errors = relative_errors(found, expected)
    assert max(errors.values()) <= 2e-5, errors


def test_reference_gradients_match_finite_differences() -> None:
    """Draw wide, faint Gaussians over the whole image, so that no pixel is near the 1/255 or 1e-4 cuts."""
    rng = torch.Generator().manual_seed(3)
    count = 6
    inputs = {
        "means": torch.randn(count, 3, generator=rng).double() * 0.1 + torch.tensor([0.0, 0.0, 3.0]),
        "quats": torch.randn(count, 4, generator=rng).double(),
        "scales": 1.5 + torch.rand(count, 3, generator=rng).double(),
        "opacities": 0.2 + 0.5 * torch.rand(count, generator=rng).double(),
        "colors": torch.randn(count, 4, 3, generator=rng).double() * 0.3,
        "viewmat": torch.eye(4).double(),
        "K": front_camera(7, 5, focal=9.0).K.double(),
        "background": torch.rand(3, generator=rng).double(),
    }
    weights = torch.randn(5, 7, 4, generator=rng).double()

    def loss(changed: dict[str, Tensor]) -> Tensor:
        drawn = render_leaves(changed, front_camera(7, 5), antialiased=True, engine="reference")
        return (torch.cat([drawn.image, drawn.transmittance[..., None]], dim=-1) * weights).sum()

    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    loss(leaves).backward()
    step = 1e-6
    for name, tensor in inputs.items():
        direction = torch.randn(tensor.shape, generator=rng).double()
        if name == "viewmat":
            direction[3] = 0.0
        if name == "K":  # no skew, and the last row is fixed
            direction = direction * torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
        up, down = (loss({**inputs, name: tensor + sign * step * direction}) for sign in (1, -1))
        measured = float((up - down) / (2 * step))
        claimed = float((leaves[name].grad * direction).sum())
        assert claimed == pytest.approx(measured, rel=1e-6, abs=1e-8), name


@pytest.mark.parametrize("engine", FAST)
def test_gradients_of_a_crop_match_the_reference(engine: str) -> None:
    scene = random_gaussians(200, seed=5, sh_degree=1)
    camera = orbit_camera(90, 61)
    crop = (21, 13, 70, 44)
    found, expected = (draw(scene, camera, name, crop=crop) for name in (engine, "reference"))
    errors = relative_errors(found, expected)
    assert max(errors.values()) <= 2e-5, errors
    assert torch.equal(found.info.visible, expected.info.visible)


@pytest.mark.parametrize("engine", EVERY)
def test_only_requested_rows_get_their_full_gradients(engine: str) -> None:
    scene = random_gaussians(200, seed=12, sh_degree=1)
    camera = orbit_camera(90, 61)
    rows = torch.arange(3, 200, 7)
    found = []
    for grad_rows in (None, rows):
        leaves = [tensor.double().requires_grad_() for tensor in activate(scene).tensors]
        image = render(ActivatedGaussians(*leaves), camera, grad_rows=grad_rows, engine=engine).image
        (image[20:] ** 2).sum().backward()
        found.append([leaf.grad for leaf in leaves])
    others = torch.ones(200, dtype=torch.bool).index_fill(0, rows, False)
    for every, some in zip(*found, strict=True):
        assert float((every - some)[rows].abs().max()) <= 1e-6 * float(every.abs().max())
        assert float(some[rows].abs().max()) > 0
        assert not bool(some[others].any())


@pytest.mark.parametrize("engine", FAST)
def test_double_precision_inputs_get_double_precision_gradients(engine: str) -> None:
    scene = one_gaussian().to(dtype=torch.float64)
    camera = front_camera()
    means = scene.means.requires_grad_()
    image = render(scene, camera, (0.0, 0.0, 0.0), engine=engine).image
    (image[:, :15] ** 2).sum().backward()
    assert image.dtype == torch.float32
    assert means.grad is not None
    assert means.grad.dtype == torch.float64
    assert float(means.grad.abs().max()) > 0


@pytest.mark.parametrize("engine", FAST)
def test_real_scene_matches_the_reference(shared_data: Path, engine: str) -> None:
    from progdf.formats.ply import load_ply

    scene = load_ply(shared_data / "playbot_8k.ply")
    low = scene.means.quantile(0.1, dim=0)
    high = scene.means.quantile(0.9, dim=0)
    scene = replace(scene, means=(scene.means - (low + high) / 2) / float((high - low).max()) * 2)
    scene = replace(scene, log_scales=scene.log_scales - torch.log((high - low).max() / 2))
    camera = orbit_camera(64, 48, distance=3.0)
    found, expected = (draw(scene, camera, name) for name in (engine, "reference"))
    assert float((found.image - expected.image).abs().max()) <= 1e-5
    errors = relative_errors(found, expected)
    assert max(errors.values()) <= 1e-4, errors
