"""Tests of running the rasterizer: threads, compilation, limits and errors."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from progdf.errors import ProgdfError
from progdf.rasterize import ActivatedGaussians, activate, alpha_weights, render, set_threads
from progdf.rasterize.cpu.engine import rasterize_part
from progdf.rasterize.cpu.forward import depth_order
from progdf.rasterize.engines import RasterView
from progdf.sh import shade
from tests.helpers.drawn import FAST, INPUTS, Drawn, draw
from tests.helpers.scenes import front_camera, one_gaussian, orbit_camera, random_gaussians

pytestmark = pytest.mark.usefixtures("two_threads")


@pytest.mark.parametrize("room", [0, 1, 8])
def test_bits_do_not_depend_on_run_threads_or_tile_memory(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    from progdf.rasterize.cpu import engine

    scene = random_gaussians(4000, seed=6, sh_degree=1)
    camera = orbit_camera(128, 96)
    first = draw(scene, camera, "cpu")
    monkeypatch.setattr(engine, "TILE_ROOM", room)
    for threads in (1, 1, 2, 3, 7, 16):
        set_threads(threads)
        again = draw(scene, camera, "cpu")
        assert torch.equal(again.image, first.image)
        for name in INPUTS:
            assert torch.equal(again.gradients[name], first.gradients[name]), name


@pytest.mark.parametrize("bands", [0, 3])
def test_part_of_a_picture_is_drawn_as_by_single_pictures(bands: int) -> None:
    scene, camera = random_gaussians(500, seed=8, sh_degree=bands), orbit_camera(96, 48)
    rows = torch.arange(3, 500, 4)
    background = torch.tensor([0.2, 0.9, 0.4])
    activated = activate(scene)
    image, share, part = rasterize_part(activated, RasterView.of(camera, activated), background, rows)
    assert torch.equal(image, render(scene, camera, background).image)
    member = torch.zeros(500, 1)
    member[rows] = 1.0
    directions = torch.nn.functional.normalize(scene.means - camera.position, dim=1)
    colors = shade(bands, directions, scene.sh)
    plain_share = render(scene, camera, torch.zeros(3), colors=member.expand(-1, 3)).image[..., 0]
    assert torch.equal(share, plain_share)
    plain_part = render(scene, camera, torch.zeros(3), colors=colors * member).image
    assert torch.allclose(part, plain_part, atol=1e-6)


@pytest.mark.parametrize("engine", FAST)
def test_two_python_threads_may_draw_at_once(engine: str) -> None:
    scene, camera = random_gaussians(500, seed=7), orbit_camera(64, 48)
    expected = draw(scene, camera, engine)
    found: list[Drawn] = []

    def work() -> None:
        found.extend(draw(scene, camera, engine) for _ in range(5))

    workers = [threading.Thread(target=work) for _ in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(found) == 10
    assert all(torch.equal(drawn.image, expected.image) for drawn in found)
    assert all(torch.equal(drawn.gradients["means"], expected.gradients["means"]) for drawn in found)


def test_camera_gradients_of_some_rows_are_refused() -> None:
    scene = one_gaussian()
    camera = front_camera()
    free = replace(camera, viewmat=camera.viewmat.clone().requires_grad_())
    with pytest.raises(ValueError, match="gradients of viewmat or K, which need all rows"):
        render(scene, free, grad_rows=torch.tensor([0]))


@pytest.mark.parametrize("engine", FAST)
def test_too_many_intersections_are_refused_in_one_line(monkeypatch: pytest.MonkeyPatch, engine: str) -> None:
    from progdf.rasterize import engines

    monkeypatch.setattr(engines, "MAX_INTERSECTIONS", 100)
    with pytest.raises(ProgdfError, match="at most 100; draw a smaller image or a crop") as error:
        render(random_gaussians(200, seed=1), orbit_camera(100, 60), engine=engine)
    assert "\n" not in str(error.value)


def test_wrong_shapes_and_windows_are_refused_by_name() -> None:
    camera = front_camera()
    scene = one_gaussian()
    with pytest.raises(ValueError, match=r"crop \(0, 0, 41, 24\) is empty or leaves the image of 40x24"):
        render(scene, camera, crop=(0, 0, 41, 24))
    with pytest.raises(ValueError, match="unknown rasterizer 'gpu'; use one of reference, cpu, warp"):
        render(scene, camera, engine="gpu")
    with pytest.raises(ValueError, match=r"mask has shape \[3, 3\], expected \[24, 40\]"):
        alpha_weights(scene, camera, torch.ones(3, 3))
    with pytest.raises(ValueError, match=r"quats has shape \[1, 3\], expected \[1, 4\]"):
        render(activate(scene)._replace(quats=scene.quats[:, :3]), camera)


@pytest.mark.parametrize("shown", [0, 5, 400])
def test_invisible_rows_get_zero_gradients_in_uninitialized_memory(
    shown: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = random_gaussians(900, seed=3, sh_degree=1)
    scene.means[:, 2] -= 50.0
    rows = torch.randperm(900, generator=torch.Generator().manual_seed(1))[:shown]
    scene.means[rows, 2] += 54.0
    leaves = [tensor.clone().requires_grad_() for tensor in activate(scene).tensors]
    camera = front_camera()
    draw(scene, camera, "cpu")  # compiles the kernels
    monkeypatch.setattr(np, "empty", lambda shape, dtype=float: np.full(shape, 77, dtype))
    image, _, info = render(ActivatedGaussians(*leaves), camera)
    image.square().sum().backward()  # type: ignore[no-untyped-call]
    assert int(info.visible.sum()) <= shown
    for leaf in leaves:
        assert leaf.grad is not None
        assert not leaf.grad[~info.visible].any()
        assert bool(leaf.grad[info.visible].any()) == (shown > 0)


def test_inputs_changed_in_place_before_backward_are_noticed() -> None:
    gaussian = one_gaussian()
    camera = front_camera()
    means = gaussian.means.clone().requires_grad_()
    image = render(replace(gaussian, means=means), camera).image
    with torch.no_grad():
        means += 1.0
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.sum().backward()  # type: ignore[no-untyped-call]


def test_picture_with_gradients_has_the_same_bits_as_without() -> None:
    scene = activate(random_gaussians(300, seed=4))
    camera = orbit_camera()
    learned = scene._replace(means=scene.means.clone().requires_grad_())
    for plain, other in zip(render(scene, camera)[:2], render(learned, camera)[:2], strict=True):
        assert torch.equal(plain, other.detach())


@pytest.mark.parametrize("count", [0, 1, 1000, 200_000])
@pytest.mark.parametrize("values", ["equal", "many", "of all sizes"])
def test_depth_order_matches_numpy_stable_sort(count: int, values: str) -> None:
    rng = np.random.default_rng(0)
    kinds = {
        "equal": [3.0],
        "many": np.linspace(0.02, 90.0, 5000),
        "of all sizes": np.geomspace(1e-38, 3e38, 999),
    }
    depths = rng.choice(np.asarray(kinds[values], np.float32), count)
    visible = rng.random(count) < 0.9
    rows = np.flatnonzero(visible)
    expected = rows[np.argsort(depths[visible], kind="stable")]
    np.testing.assert_array_equal(depth_order(depths, visible), expected)


def test_kernels_are_cached_outside_the_source_tree() -> None:
    from progdf.rasterize.cpu.jit import kernel_cache

    render(one_gaussian(), front_camera())
    assert list(kernel_cache().rglob("*.nbi"))
    assert Path(__file__).parents[3] not in kernel_cache().parents
