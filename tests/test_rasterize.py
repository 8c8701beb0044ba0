"""The rasteriser: both engines against each other, against finite differences, and on every hard case."""

from __future__ import annotations

import functools
import logging
import subprocess
import sys
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import torch
from scenes import concatenate, front_camera, hard_cases, one_gaussian, orbit_camera, random_gaussians
from torch import Tensor

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import ENGINES, RasterInfo, alpha_weights, rasterize, render, set_threads

INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmat", "K", "background")
CASES = hard_cases()


@dataclass(frozen=True)
class Drawn:
    """A picture and the gradients of a fixed random weighting of it, by input name."""

    image: Tensor
    transmittance: Tensor
    info: RasterInfo
    gradients: dict[str, Tensor]


def draw(
    gaussians: Gaussians,
    camera: Camera,
    engine: str,
    antialiased: bool = False,
    crop: tuple[int, int, int, int] | None = None,
) -> Drawn:
    dtype = torch.float64 if engine == "reference" else torch.float32
    inputs = (
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        gaussians.sh,
        camera.viewmat,
        camera.K,
        torch.tensor([0.2, 0.4, 0.6]),
    )
    leaves = {
        name: tensor.to(dtype).clone().requires_grad_() for name, tensor in zip(INPUTS, inputs, strict=True)
    }
    image, transmittance, info = rasterize(
        **leaves,
        width=camera.width,
        height=camera.height,
        sh_degree=gaussians.sh_degree,
        antialiased=antialiased,
        engine=engine,
        crop=crop,
    )
    rng = torch.Generator().manual_seed(11)
    weights = torch.randn(camera.height, camera.width, 4, generator=rng).to(dtype)
    if crop is not None:
        weights = weights[crop[1] : crop[3], crop[0] : crop[2]]
    ((image * weights[..., :3]).sum() + (transmittance * weights[..., 3]).sum()).backward()
    gradients = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}
    return Drawn(image.detach(), transmittance.detach(), info, gradients)


@functools.cache
def drawn_case(name: str, engine: str) -> Drawn:
    case = CASES[name]
    return draw(case.gaussians, case.camera, engine, case.antialiased)


def relative_errors(found: Drawn, expected: Drawn) -> dict[str, float]:
    """Largest gradient error over the largest gradient, by input; below 1e-6 a gradient counts as zero."""
    errors = {}
    for name, reference in expected.gradients.items():
        difference = (found.gradients[name] - reference).abs()
        errors[name] = (
            float(difference.max() / reference.abs().max().clamp_min(1e-6)) if len(reference) else 0.0
        )
    return errors


@pytest.fixture(autouse=True)
def _two_threads() -> object:
    set_threads(2)
    yield
    set_threads(None)


@pytest.mark.parametrize("name", CASES)
def test_the_cpu_engine_draws_each_hard_case_like_the_reference(name: str) -> None:
    found, expected = drawn_case(name, "cpu"), drawn_case(name, "reference")
    assert found.image.shape == expected.image.shape
    assert float((found.image - expected.image).abs().max()) <= 1e-5
    assert float((found.transmittance - expected.transmittance).abs().max()) <= 1e-5
    assert torch.equal(found.info.visible, expected.info.visible)
    torch.testing.assert_close(found.info.means2d, expected.info.means2d, rtol=1e-5, atol=1e-4)
    assert torch.equal(found.info.depths, expected.info.depths)


@pytest.mark.parametrize("name", CASES)
def test_the_cpu_engine_has_the_references_gradients_in_each_hard_case(name: str) -> None:
    errors = relative_errors(drawn_case(name, "cpu"), drawn_case(name, "reference"))
    assert set(errors) == set(INPUTS)
    assert max(errors.values()) <= 1e-4, errors


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if case.poisoned])
def test_a_gaussian_that_is_not_finite_leaves_all_others_untouched(name: str, engine: str) -> None:
    case = CASES[name]
    if "quats" in name:
        clean_quats = case.gaussians.quats.clone()
        clean_quats[list(case.poisoned)] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        without = draw(replace(case.gaussians, quats=clean_quats), case.camera, engine)
        kept = torch.arange(len(case.gaussians))
    else:
        kept = torch.tensor([i for i in range(len(case.gaussians)) if i not in case.poisoned])
        without = draw(case.gaussians[kept], case.camera, engine)
    found = drawn_case(name, engine)
    assert bool(found.image.isfinite().all())
    torch.testing.assert_close(found.image, without.image, rtol=0, atol=1e-12 if engine == "reference" else 0)
    others = torch.tensor([i for i in range(len(case.gaussians)) if i not in case.poisoned])
    assert bool(found.gradients["means"][others].isfinite().all())


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_scenes_meet_the_stated_errors(seed: int, antialiased: bool) -> None:
    scene, camera = random_gaussians(300, seed=seed, sh_degree=3), orbit_camera(90, 61)
    found, expected = (draw(scene, camera, engine, antialiased) for engine in ("cpu", "reference"))
    assert float((found.image - expected.image).abs().max()) <= 2e-6
    errors = relative_errors(found, expected)
    assert max(errors.values()) <= 2e-5, errors


def test_the_reference_has_the_gradients_of_finite_differences() -> None:
    """Broad, faint Gaussians over the whole image, so that no pixel is near the 1/255 or 1e-4 cuts."""
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
        for_one = rasterize(**changed, width=7, height=5, sh_degree=1, antialiased=True, engine="reference")
        return (torch.cat([for_one[0], for_one[1][..., None]], dim=-1) * weights).sum()

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


@pytest.mark.parametrize("crop", [(0, 0, 90, 61), (13, 7, 14, 8), (31, 8, 65, 40), (64, 33, 90, 61)])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_crop_is_the_slice_of_the_whole_picture_bit_for_bit(
    engine: str, crop: tuple[int, int, int, int]
) -> None:
    camera = orbit_camera(90, 61)
    camera = replace(camera, K=camera.K + torch.tensor([[0.0, 0.0, 7.0], [0.0, 0.0, -5.0], [0.0, 0.0, 0.0]]))
    scene = concatenate(
        random_gaussians(150, seed=4), one_gaussian(mean=(2.0, 1.0, -2.5), scales=(1.0, 0.02, 0.5))
    )
    whole, part = draw(scene, camera, engine), draw(scene, camera, engine, crop=crop)
    x0, y0, x1, y1 = crop
    assert torch.equal(part.image, whole.image[y0:y1, x0:x1])
    assert torch.equal(part.transmittance, whole.transmittance[y0:y1, x0:x1])


def test_gradients_of_a_crop_match_the_references() -> None:
    scene, camera, crop = random_gaussians(200, seed=5, sh_degree=1), orbit_camera(90, 61), (21, 13, 70, 44)
    found, expected = (draw(scene, camera, engine, crop=crop) for engine in ("cpu", "reference"))
    errors = relative_errors(found, expected)
    assert max(errors.values()) <= 2e-5, errors
    assert torch.equal(found.info.visible, expected.info.visible)


@pytest.mark.parametrize("engine", ENGINES)
def test_only_the_wanted_rows_get_gradients_and_theirs_are_the_full_ones(engine: str) -> None:
    scene, camera = random_gaussians(200, seed=12, sh_degree=1), orbit_camera(90, 61)
    rows = torch.arange(3, 200, 7)
    inputs = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh)
    found = []
    for wanted in (None, rows):
        leaves = [tensor.double().requires_grad_() for tensor in inputs]
        image, _, _ = rasterize(
            *leaves, camera.viewmat, camera.K, 90, 61, sh_degree=1, engine=engine, grad_rows=wanted
        )
        (image[20:] ** 2).sum().backward()
        found.append([leaf.grad for leaf in leaves])
    others = torch.ones(200, dtype=torch.bool).index_fill(0, rows, False)
    for every, some in zip(*found, strict=True):
        assert float((every - some)[rows].abs().max()) <= 1e-6 * float(every.abs().max())
        assert float(some[rows].abs().max()) > 0
        assert not bool(some[others].any())


def test_camera_gradients_of_some_rows_only_are_refused() -> None:
    scene, camera = one_gaussian(), front_camera()
    with pytest.raises(ValueError, match="viewmat or K wants gradients, which need all rows"):
        rasterize(
            scene.means, scene.quats, scene.scales, scene.opacities, torch.ones(1, 3),
            camera.viewmat.clone().requires_grad_(), camera.K, 40, 24, grad_rows=torch.tensor([0]),
        )  # fmt: skip


@pytest.mark.parametrize("few", [0, 8192])
def test_bits_do_not_depend_on_the_run_or_the_number_of_threads(
    few: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    from progdf.rasterize import cpu

    scene, camera = random_gaussians(2000, seed=6, sh_degree=1), orbit_camera(128, 96)
    first = draw(scene, camera, "cpu")
    monkeypatch.setattr(cpu, "FEW", few)  # one thread lists few Gaussians, several list more
    set_threads(1)
    for again in (draw(scene, camera, "cpu"), draw(scene, camera, "cpu")):
        assert torch.equal(again.image, first.image)
        for name in INPUTS:
            assert torch.equal(again.gradients[name], first.gradients[name]), name


def test_two_python_threads_may_draw_at_once() -> None:
    scene, camera = random_gaussians(500, seed=7), orbit_camera(64, 48)
    expected = draw(scene, camera, "cpu")
    found: list[Drawn] = []

    def work() -> None:
        found.extend(draw(scene, camera, "cpu") for _ in range(5))

    workers = [threading.Thread(target=work) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(found) == 10
    assert all(torch.equal(drawn.image, expected.image) for drawn in found)
    assert all(torch.equal(drawn.gradients["means"], expected.gradients["means"]) for drawn in found)


def test_the_order_of_the_list_does_not_matter_where_depths_differ() -> None:
    scene, camera = random_gaussians(300, seed=8), orbit_camera(50, 40)
    activated = (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh0.sigmoid())
    shuffle = torch.randperm(300, generator=torch.Generator().manual_seed(1))
    pictures = [
        rasterize(*tensors, camera.viewmat, camera.K, 50, 40)[0]
        for tensors in (activated, [tensor[shuffle] for tensor in activated])
    ]
    assert torch.equal(*pictures)


def test_equal_depths_are_drawn_in_the_order_of_the_list() -> None:
    red, green = (
        one_gaussian(rgb=(1.0, 0.0, 0.0), opacity=0.99),
        one_gaussian(rgb=(0.0, 1.0, 0.0), opacity=0.99),
    )
    camera = front_camera()
    centre = (camera.height // 2, camera.width // 2)
    assert float(render(concatenate(red, green), camera)[centre][0]) > 0.9
    assert float(render(concatenate(green, red), camera)[centre][1]) > 0.9


@pytest.mark.parametrize("engine", ENGINES)
def test_the_support_ends_exactly_where_alpha_falls_below_1_255(engine: str) -> None:
    camera = front_camera(60, 40)
    image, transmittance, _ = rasterize(
        torch.tensor([[0.0, 0.0, 2.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.full((1, 3), 0.3),
        torch.tensor([0.7]), torch.ones(1, 3), camera.viewmat, camera.K, 60, 40, engine=engine,
    )  # fmt: skip
    x, y = torch.meshgrid(torch.arange(60) + 0.5 - 30, torch.arange(40) + 0.5 - 20, indexing="xy")
    variance = (0.3 * 30.0 / 2.0) ** 2 + 0.3
    alpha = 0.7 * torch.exp(-0.5 * (x.double() ** 2 + y.double() ** 2) / variance)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    torch.testing.assert_close(image[..., 0].double(), alpha, rtol=0, atol=2e-6)
    assert torch.equal(transmittance == 1.0, alpha == 0.0)


@pytest.mark.parametrize("engine", ENGINES)
def test_no_pixel_falls_below_the_least_transmittance(engine: str) -> None:
    drawn = drawn_case("400 opaque ones stacked", engine)
    assert 1e-4 < float(drawn.transmittance.min()) < 2e-3


@pytest.mark.parametrize("engine", ENGINES)
def test_no_gaussians_leave_the_background(engine: str) -> None:
    image, transmittance, _ = rasterize(
        *(torch.zeros(shape) for shape in ((0, 3), (0, 4), (0, 3), (0,), (0, 3))),
        torch.eye(4), front_camera().K, 40, 24, background=(0.25, 0.5, 0.75), engine=engine,
    )  # fmt: skip
    assert torch.equal(image, torch.tensor([0.25, 0.5, 0.75]).expand(24, 40, 3))
    assert bool((transmittance == 1.0).all())


def test_mask_weights_match_the_reference_and_the_picture() -> None:
    scene, camera = random_gaussians(200, seed=9), orbit_camera(90, 61)
    mask = torch.rand(61, 90, generator=torch.Generator().manual_seed(2)).round()
    found = alpha_weights(scene, camera, mask)
    expected = alpha_weights(scene.to(dtype=torch.float64), camera, mask, engine="reference")
    torch.testing.assert_close(found.double(), expected, rtol=2e-5, atol=2e-5)
    _, transmittance, _ = rasterize(
        scene.means, scene.quats, scene.scales, scene.opacities, torch.zeros(200, 3),
        camera.viewmat, camera.K, 90, 61,
    )  # fmt: skip
    assert float(found[:, 2].sum()) == pytest.approx(float((1 - transmittance).sum()), rel=1e-5)
    inside = float(((1 - transmittance) * mask).sum())
    assert float(found[:, 0].sum()) == pytest.approx(inside, rel=1e-5)


@pytest.mark.parametrize("engine", ENGINES)
def test_mask_weights_of_every_hard_case_are_finite(engine: str) -> None:
    for name, case in CASES.items():
        mask = torch.ones(case.camera.height, case.camera.width, dtype=torch.bool)
        weights = alpha_weights(case.gaussians.to(dtype=torch.float64), case.camera, mask, engine=engine)
        assert bool(weights.isfinite().all()), name
        assert torch.equal(weights[:, 1], weights[:, 3]), name


def test_too_many_intersections_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    from progdf.rasterize import cpu

    monkeypatch.setattr(cpu, "MOST_INTERSECTIONS", 100)
    with pytest.raises(ProgdfError, match="more than 100; draw a smaller image or a crop") as error:
        render(random_gaussians(200, seed=1), orbit_camera(100, 60))
    assert "\n" not in str(error.value)


def test_wrong_shapes_and_windows_are_refused_by_name() -> None:
    camera = front_camera()
    scene = one_gaussian()
    with pytest.raises(ValueError, match=r"crop \(0, 0, 41, 24\) is empty or leaves the image of 40x24"):
        render(scene, camera, crop=(0, 0, 41, 24))
    with pytest.raises(ValueError, match="no rasteriser 'gpu', expected one of reference, cpu"):
        render(scene, camera, engine="gpu")
    with pytest.raises(ValueError, match=r"mask has shape \[3, 3\], expected \[24, 40\]"):
        alpha_weights(scene, camera, torch.ones(3, 3))
    with pytest.raises(ValueError, match=r"quats has shape \[1, 3\], expected \[1, 4\]"):
        rasterize(
            scene.means, scene.quats[:, :3], scene.scales, scene.opacities, torch.ones(1, 3),
            camera.viewmat, camera.K, 40, 24,
        )  # fmt: skip


def test_double_precision_inputs_get_double_precision_gradients() -> None:
    scene, camera = one_gaussian().to(dtype=torch.float64), front_camera()
    means = scene.means.requires_grad_()
    image, _, _ = rasterize(
        means, scene.quats, scene.scales, scene.opacities, torch.ones(1, 3).double(),
        camera.viewmat, camera.K, 40, 24,
    )  # fmt: skip
    (image[:, :15] ** 2).sum().backward()
    assert image.dtype == torch.float32
    assert means.grad is not None
    assert means.grad.dtype == torch.float64
    assert float(means.grad.abs().max()) > 0


def test_importing_progdf_does_not_load_the_compiler() -> None:
    code = "import sys, progdf, progdf.rasterize; print('numba' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"


def test_a_cold_start_says_once_that_it_compiles(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from progdf.rasterize import jit

    monkeypatch.setattr(jit, "CACHE", tmp_path)
    with caplog.at_level(logging.WARNING, logger="progdf"):
        for _ in range(2):
            with jit.running("forward", 9):
                pass
    assert [record.getMessage() for record in caplog.records] == [
        "compiling the rasteriser's forward kernels (about 9 s, once per machine)"
    ]


def test_the_kernels_are_cached_outside_the_source_tree() -> None:
    from progdf.rasterize import jit

    render(one_gaussian(), front_camera())
    assert list(jit.CACHE.rglob("*.nbi"))
    assert Path(__file__).parents[1] not in jit.CACHE.parents


def test_a_real_scene_matches_the_reference(shared_data: Path) -> None:
    from progdf.ply import load_ply

    scene = load_ply(shared_data / "playbot_8k.ply")
    low, high = scene.means.quantile(0.1, dim=0), scene.means.quantile(0.9, dim=0)
    scene = replace(scene, means=(scene.means - (low + high) / 2) / float((high - low).max()) * 2)
    scene = replace(scene, log_scales=scene.log_scales - torch.log((high - low).max() / 2))
    camera = orbit_camera(64, 48, distance=3.0)
    found, expected = (draw(scene, camera, engine) for engine in ("cpu", "reference"))
    assert float((found.image - expected.image).abs().max()) <= 1e-5
    errors = relative_errors(found, expected)
    assert max(errors.values()) <= 1e-4, errors
