"""The benchmark `exports`: time to write a scene in each smaller format, beside bytes and error.

python -m benchmarks exports --scenes statue.ply
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

from benchmarks.table import Table
from progdf.demo_scenes import bear
from progdf.formats.scene_file import load_scene, save_scene, scene_name
from progdf.gaussians import Gaussians
from progdf.scene.strays import find_strays, picture_difference
from progdf.terminal import group_digits

ENDINGS = (".compressed.ply", ".spz", ".sog")
"""Formats that round the numbers of a scene."""
DEMO_GAUSSIANS = 20_000
"""Gaussians of the bear, which is measured without `--scenes`."""


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure every format and the search for strays on every scene."""
    loaded = {scene_name(path): load_scene(path) for path in scenes} or {
        "demo bear": bear(DEMO_GAUSSIANS).gaussians
    }
    with tempfile.TemporaryDirectory() as folder:
        rows = [
            _row(name, scene, ending, Path(folder)) for name, scene in loaded.items() for ending in ENDINGS
        ]
    return [
        Table.of(
            "exports",
            "Scenes in smaller formats",
            rows,
            "Processor time of `progdf.save_scene` with its check of the written file. PSNR of pictures from "
            "8 sides to the exact scene: mean and worst.",
        ),
        Table.of(
            "strays",
            "Search for strays",
            [_stray_row(name, scene) for name, scene in loaded.items()],
            "Processor time of the search that `progdf info` and `progdf edit --clean` run.",
        ),
    ]


def _row(name: str, scene: Gaussians, ending: str, folder: Path) -> dict[str, str]:
    """Measure one format. The first 300 Gaussians are written before, which loads kernels and libraries."""
    path = folder / f"scene{ending}"
    save_scene(path, scene[:300])
    started = _processor_seconds()
    read_back = save_scene(path, scene)
    seconds = _processor_seconds() - started
    mean, worst = picture_difference(scene, scene if read_back is None else read_back.scene)
    return {
        "scene": name,
        "Gaussians": group_digits(len(scene)),
        "SH": str(scene.sh_degree),
        "format": ending,
        "s": f"{seconds:.1f}",
        "bytes a Gaussian": f"{path.stat().st_size / len(scene):.1f}",
        "dB": f"{mean:.1f} {worst:.1f}",
    }


def _stray_row(name: str, scene: Gaussians) -> dict[str, str]:
    """Measure the search for strays in a scene."""
    started = _processor_seconds()
    strays = find_strays(scene)
    seconds = _processor_seconds() - started
    return {
        "scene": name,
        "Gaussians": group_digits(len(scene)),
        "strays": strays.describe(),
        "s": f"{seconds:.1f}",
        "µs a Gaussian": f"{1e6 * seconds / len(scene):.1f}",
    }


def _processor_seconds() -> float:
    """Return the processor time of this process and of those that it has waited for."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system
