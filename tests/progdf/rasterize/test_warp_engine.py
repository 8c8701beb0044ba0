"""Tests of the GPU engine on Warp's CPU device: blocks of threads, code for GPUs, a quiet start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.rasterize.engines import ENGINES, Crop, activate, color_map, get_engine
from progdf.rasterize.sparse import SparseWeights
from tests.helpers.drawn import INPUTS, NEEDS_WARP, draw
from tests.helpers.scenes import orbit_camera, random_gaussians

ARCHITECTURES = (75, 86, 89, 90)
"""Compute capabilities from RTX 20 to H100. The oldest and the newest are in every test run."""


@NEEDS_WARP
def test_bits_are_the_same_in_every_run() -> None:
    scene = random_gaussians(1000, seed=6, sh_degree=1)
    camera = orbit_camera(64, 48)
    first = draw(scene, camera, "warp")
    second = draw(scene, camera, "warp")
    assert torch.equal(first.image, second.image)
    for name in INPUTS:
        assert torch.equal(first.gradients[name], second.gradients[name]), name


@pytest.mark.slow
@NEEDS_WARP
def test_block_of_threads_adds_up_like_single_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run 256 threads of a tile that meet at each sum, as on a GPU. A CPU runs them one by one by default."""
    import warp as wp

    scene = random_gaussians(300, seed=6, sh_degree=1)
    camera = orbit_camera(50, 40)
    single = draw(scene, camera, "warp")
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    block = draw(scene, camera, "warp")
    assert torch.equal(block.image, single.image)
    for name in INPUTS:
        torch.testing.assert_close(block.gradients[name], single.gradients[name], rtol=1e-5, atol=1e-5)


@NEEDS_WARP
@pytest.mark.parametrize("crop", [(0, 0, 64, 48), (5, 7, 50, 41)], ids=["whole", "window"])
def test_listed_weights_match_the_cpu_engine(crop: Crop) -> None:
    scene = activate(random_gaussians(600, seed=6, sh_degree=1))
    camera = orbit_camera(64, 48)
    rows = torch.arange(100, 500)
    area = (crop[2] - crop[0]) * (crop[3] - crop[1])
    for pixels in (None, torch.arange(0, area, 3)):
        for lost in (1e-9, 0.5 / 255):
            here = color_map(scene, camera, crop, rows, "cpu", pixels, lost)
            there = color_map(scene, camera, crop, rows, "warp", pixels, lost)
            assert isinstance(there, SparseWeights)
            colors = torch.rand(len(rows), 3)
            image = here.picture(colors)
            # the cpu engine rounds weights to 16 bits
            torch.testing.assert_close(there.picture(colors), image, rtol=0.0, atol=2e-4)
            torch.testing.assert_close(there.gradient(image), here.gradient(image), rtol=1e-4, atol=5e-4)


@NEEDS_WARP
@pytest.mark.parametrize(
    "architectures", [ARCHITECTURES[::3], pytest.param(ARCHITECTURES[1:3], marks=pytest.mark.slow)]
)
def test_kernels_compile_for_gpus_without_a_gpu(tmp_path: Path, architectures: tuple[int, ...]) -> None:
    import warp as wp

    from progdf.rasterize import warp_engine

    wp.compile_aot_module(warp_engine.__name__, arch=architectures, module_dir=tmp_path)
    compiled = [path.name for path in tmp_path.iterdir()]
    for architecture in architectures:
        (name,) = (name for name in compiled if f".sm{architecture}." in name)
        assert (tmp_path / name).stat().st_size > 10_000


@pytest.mark.slow
@NEEDS_WARP
def test_warp_is_loaded_on_demand_and_starts_quietly() -> None:
    code = (
        "import sys; import progdf, progdf.rasterize; assert 'warp' not in sys.modules;"
        "from tests.helpers.scenes import front_camera, one_gaussian;"
        "progdf.render(one_gaussian(), front_camera(), engine='warp'); assert 'warp' in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not done.stdout
    assert set(done.stderr.splitlines()) <= {NO_DRIVER}


def test_missing_warp_error_names_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "warp", None)
    monkeypatch.delitem(sys.modules, ENGINES["warp"], raising=False)
    with pytest.raises(ProgdfError, match=r"needs warp-lang; pip install 'progdf-studio\[gpu\]'"):
        get_engine.__wrapped__("warp")


NO_DRIVER = (
    "Warp CUDA warning: Could not find or load the NVIDIA CUDA driver. GPU execution will not be available."
)
"""Printed by Warp's native part on machines without a GPU; no setting suppresses it."""
