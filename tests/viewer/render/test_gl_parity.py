"""OpenGL against the CPU engines: hard cases, the bear, a real scene and partial uploads."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import moderngl
import numpy as np
import pytest
import torch

from progdf.camera import Camera
from progdf.formats.ply import load_ply
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.rasterize import render
from progdf.rasterize.engines import depth_of, paint_depth, render_depth
from progdf.scene.orbit_rig import orbit_rig
from tests.helpers.demo_scenes import bear
from tests.helpers.scenes import front_camera, hard_cases, one_gaussian, orbit_camera, random_gaussians
from viewer.gl.scene_textures import SPLATS_PER_ROW, row_runs
from viewer.gl.splats import SplatRenderer
from viewer.render.gl_renderer import back_to_front

pytestmark = pytest.mark.gl
WHITE = (1.0, 1.0, 1.0)
CASES = hard_cases()
Image = np.ndarray
Draw = Callable[..., Image]


@pytest.fixture(scope="module")
def renderer(ctx: moderngl.Context) -> Iterator[SplatRenderer]:
    held = SplatRenderer(ctx)
    yield held
    held.release()


@pytest.fixture(scope="module")
def draw(renderer: SplatRenderer) -> Draw:
    def drawn(scene: Gaussians, camera: Camera) -> Image:
        renderer.upload(scene)
        renderer.set_order(back_to_front(scene.means.numpy(), camera))
        return read(renderer.draw(camera, WHITE))

    return drawn


@pytest.fixture
def without_early_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable the reference engine's early stop, which back-to-front blending lacks (see SplatRenderer)."""
    monkeypatch.setattr(importlib.import_module("progdf.rasterize.reference"), "TRANSMITTANCE_MIN", 0.0)


def read(texture: moderngl.Texture) -> Image:
    rgba = np.frombuffer(texture.read(), np.float32).reshape(texture.height, texture.width, 4)
    return rgba[..., :3]


def psnr(image: Image, target: Image) -> float:
    error = float(((image.astype(np.float64) - target) ** 2).mean())
    return math.inf if error == 0.0 else -10.0 * math.log10(error)


@pytest.mark.parametrize("name", CASES)
@pytest.mark.usefixtures("without_early_stop")
def test_hard_cases_match_the_reference(draw: Draw, name: str) -> None:
    case = CASES[name]
    image = draw(case.gaussians, case.camera)
    expected = render(case.gaussians, case.camera, WHITE, engine="reference").image.numpy()
    # float32 against float64 usually gives 120 dB; at a boundary one pixel may be off by 0.5/255
    peak = max(1.0, float(expected.max()))
    assert psnr(image / peak, expected / peak) >= 100.0
    assert float(np.abs(image - expected).max(initial=0.0)) <= 1.0 / 255.0


@pytest.mark.parametrize("name", CASES)
@pytest.mark.usefixtures("without_early_stop")
def test_depth_of_hard_cases_matches_the_reference(renderer: SplatRenderer, name: str) -> None:
    scene = CASES[name].gaussians
    camera = CASES[name].camera
    renderer.upload(paint_depth(scene, camera))
    renderer.set_order(back_to_front(scene.means.numpy(), camera))
    found = depth_of(torch.from_numpy(read(renderer.draw(camera, (0.0, 0.0, 0.0))).copy()))
    expected = render_depth(scene, camera, engine="reference")
    torch.testing.assert_close(found.alpha, expected.alpha, rtol=0, atol=1e-4)
    both = (found.alpha > 0) & (expected.alpha > 0)  # boundary pixels may differ
    torch.testing.assert_close(found.depth[both], expected.depth[both], rtol=1e-4, atol=1e-6)


@pytest.mark.usefixtures("without_early_stop")
def test_dense_scene_matches_without_the_early_stop(draw: Draw) -> None:
    scene = bear(6000).gaussians
    camera = orbit_rig(scene, 1, 200, 150)[0]
    assert psnr(draw(scene, camera), render(scene, camera, WHITE, engine="reference").image.numpy()) >= 115.0


def test_bear_matches_the_cpu(draw: Draw) -> None:
    demo = bear(24_000)
    for camera in demo.cameras[::16]:
        small = camera.resize(320, 320)
        # the early stop at 1e-4 leaves at most 0.01 of a color in a pixel: at least 76 dB
        assert psnr(draw(demo.gaussians, small), render(demo.gaussians, small, WHITE).image.numpy()) >= 70.0


def test_real_scene_matches_the_cpu(draw: Draw, shared_data: Path) -> None:
    scene = load_ply(shared_data / "playbot_31k.ply")
    for camera in orbit_rig(scene, 2, 400, 300):
        image = draw(scene, camera)
        expected = render(scene, camera, WHITE).image.numpy()
        assert psnr(image, expected) >= 70.0
        assert float(np.abs(image - expected).max()) <= 0.0101, "more than the early stop explains"


def test_early_stop_explains_all_differences(draw: Draw, monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES["400 opaque ones stacked"]
    image = draw(case.gaussians, case.camera)
    stopped = render(case.gaussians, case.camera, WHITE, engine="reference").image.numpy()
    monkeypatch.setattr(importlib.import_module("progdf.rasterize.reference"), "TRANSMITTANCE_MIN", 0.0)
    through = render(case.gaussians, case.camera, WHITE, engine="reference").image.numpy()
    assert psnr(image, through) > psnr(image, stopped) + 20.0


@pytest.mark.parametrize(("length", "width"), [(1.5, 1e-3), (3.0, 1e-3), (3.0, 1e-4)])
@pytest.mark.usefixtures("without_early_stop")
def test_needle_of_thousands_of_pixels_keeps_its_width(draw: Draw, length: float, width: float) -> None:
    """ac − b² in float32 gives only 54 to 62 dB here."""
    camera = front_camera(120, 90, focal=2000.0)
    quat = (0.9238795, 0.1, 0.05, 0.3826834)
    scene = one_gaussian(scales=(length, width, width), quat=quat, mean=(0.005, 0.002, 2.0))
    expected = render(scene, camera, WHITE, engine="reference").image.numpy()
    assert (expected < 0.9).any(), "in the picture"
    assert psnr(draw(scene, camera), expected) >= 120.0


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.usefixtures("without_early_stop")
def test_every_sh_band_is_drawn(draw: Draw, degree: int) -> None:
    scene = random_gaussians(300, seed=degree, sh_degree=degree)
    camera = orbit_camera(80, 60)
    scene = replace(scene, shN=3.0 * scene.shN)
    expected = render(scene, camera, WHITE, engine="reference").image.numpy()
    assert psnr(draw(scene, camera), expected) >= 110.0


@pytest.mark.usefixtures("without_early_stop")
def test_sh_bands_above_3_are_ignored(draw: Draw) -> None:
    scene = random_gaussians(50, sh_degree=3)
    camera = orbit_camera()
    extended = replace(scene, shN=torch.cat([scene.shN, torch.ones(50, 9, 3)], dim=1))
    assert np.array_equal(draw(extended, camera), draw(scene, camera))


@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_uploading_changed_rows_equals_uploading_all(
    renderer: SplatRenderer, draw: Draw, attribute: str
) -> None:
    count = 4 * SPLATS_PER_ROW + 7
    before, other = (random_gaussians(count, seed=seed, sh_degree=1) for seed in (1, 2))
    rows = torch.tensor([0, 3, 511, 512, 700, count - 1])
    mixed = getattr(before, attribute).index_copy(0, rows, getattr(other, attribute)[rows])
    after = replace(before, **{attribute: mixed})
    camera = orbit_camera(80, 60)
    expected = draw(after, camera)
    assert not np.array_equal(draw(before, camera), expected)
    sent = renderer.update(after, [attribute], rows.numpy())
    renderer.set_order(back_to_front(after.means.numpy(), camera))
    assert np.array_equal(read(renderer.draw(camera, WHITE)), expected)
    assert sent > 0


def test_only_touched_texture_rows_are_uploaded(renderer: SplatRenderer) -> None:
    scene = random_gaussians(40 * SPLATS_PER_ROW)
    renderer.upload(scene)
    rows = np.array([5, 20 * SPLATS_PER_ROW])
    assert renderer.update(scene, ["means"], rows) == 2 * SPLATS_PER_ROW * 16
    assert renderer.update(scene, ["sh0", "means"], rows[:1]) == 2 * SPLATS_PER_ROW * 16
    assert renderer.update(scene, ["means"], rows[:0]) == 0


def test_nearby_rows_are_uploaded_together() -> None:
    rows = np.array([0, 1, 600, 511 * 512, 512 * 512 + 3])
    assert list(row_runs(rows)) == [(0, 2), (511, 513)]


def test_sort_order_is_back_to_front_by_depth_then_index() -> None:
    rng = np.random.default_rng(0)
    means = rng.normal(size=(500, 3)).astype(np.float32)
    means[100:200, 2] = 0.25  # many Gaussians at one depth
    means[7], means[8] = np.nan, np.inf
    camera = orbit_camera()
    camera = replace(camera, viewmat=torch.tensor(np.diag([1.0, 1, 1, 1]), dtype=torch.float32))
    order = back_to_front(means, camera).astype(int)
    depths = means[:, 2]
    expected = [i for i in np.lexsort((np.arange(500), depths)) if depths[i] > 0.01 and i not in (7, 8)]
    assert order[::-1].tolist() == expected


def test_smaller_scene_leaves_nothing_of_a_larger_one(draw: Draw) -> None:
    small = random_gaussians(20, seed=3)
    large = random_gaussians(3000, seed=4)
    camera = orbit_camera()
    alone = draw(small, camera)
    draw(large, camera)
    assert np.array_equal(draw(small, camera), alone)
