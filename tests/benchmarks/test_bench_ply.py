"""Benchmark of loading a .ply against reading its raw bytes.

    pytest tests/benchmarks/test_bench_ply.py -o addopts= --benchmark-enable

The methods are interleaved in one process, and the file is in the page cache. With benchmarks disabled (the
default), each method runs once on a small scene, which keeps the benchmark itself tested.
"""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median

import numpy as np
import pytest
import torch

from progdf.formats.ply import load_ply, save_ply
from progdf.gaussians import ATTRIBUTES, Gaussians


def sh3_scene(count: int) -> Gaussians:
    rng = torch.Generator().manual_seed(0)
    normal = lambda *shape: torch.randn(count, *shape, generator=rng)  # noqa: E731
    quats = torch.nn.functional.normalize(normal(4), dim=1)
    return Gaussians(normal(3), quats, normal(3) - 4, normal(), normal(3), 0.1 * normal(15, 3))


def seconds(work: object, path: Path) -> float:
    start = time.perf_counter()
    result = work(path)  # type: ignore[operator]
    taken = time.perf_counter() - start
    del result
    return taken


def test_load_ply_time_against_a_raw_read(
    tmp_path: Path, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    measuring = not request.config.getoption("benchmark_disable")
    count, rounds = (1_000_000, 9) if measuring else (2_000, 1)
    path = tmp_path / "scene.ply"
    scene = sh3_scene(count)
    save_ply(path, scene)
    loaded = load_ply(path)
    assert all(torch.equal(getattr(loaded, name), getattr(scene, name)) for name in ATTRIBUTES)
    del scene, loaded
    methods = {
        "read()": lambda path: path.read_bytes(),
        "numpy.fromfile": lambda path: np.fromfile(path, np.uint8),
        "load_ply": load_ply,
    }
    times: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(rounds):
        for name, method in methods.items():
            times[name].append(seconds(method, path))
    if measuring:
        with capsys.disabled():
            print(f"\n{count} SH3 rows, {path.stat().st_size / 1e6:.0f} MB, median of {rounds}:")
            for name, taken in times.items():
                ratios = [a / b for a, b in zip(times["load_ply"], taken, strict=True)]
                print(
                    f"  {name:<15} {1e3 * median(taken):6.1f} ms "
                    f"({1e3 * min(taken):.1f} to {1e3 * max(taken):.1f})   "
                    f"load_ply takes {median(ratios):.2f} times that"
                )
