"""The benchmark `gains`: time of a slider step with a gain that divides color and texture.

Each row drags the slider of one edit, in turns with gains of 1 and with another gain of color.

    python -m benchmarks gains
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.courses import edit_of
from benchmarks.table import Table
from progdf.compose.composer import Composer
from progdf.compose.layers import Gains, Layer
from progdf.compose.reference import compose_layers
from progdf.field.separable import course_field
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.texture import color_split

COUNTS = (30_000, 300_000)
"""Numbers of members."""
STEPS = 40
"""Steps of a slider, in turns with gains of 1."""
_DIVIDED = Gains(color=0.5)
_BANDS = {"colors": 0, "colors and SH bands to degree 2": 8}  # SH coefficients above the first, by case
_BLEND = "adjust"  # the default blend rule


def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure slider steps of every case."""
    rows = [_row(count, case, bands) for count in COUNTS for case, bands in _BANDS.items()]
    return [
        Table.of(
            "gains",
            "A slider step with the gain of color at 0.5",
            rows,
            "Lower quartiles, measured in turns; processor time. Gains of 1: the edit as trained. Once: the "
            "map is fitted when a gain is first moved. Difference: largest one from `compose_layers`, of all "
            "colors.",
        )
    ]


def _row(count: int, case: str, bands: int) -> dict[str, str]:
    """Measure one case."""
    scene, gdf = _edit(count, bands)
    started = time.process_time()
    color_split(scene, gdf)
    once = 1e3 * (time.process_time() - started)
    composers = Composer(scene, [gdf]), Composer(scene, [gdf])
    times: tuple[list[float], list[float]] = ([], [])
    for step in range(STEPS):
        strength = 0.4 + 0.5 * step / STEPS
        for composer, gains, taken in zip(composers, (_DIVIDED, Gains()), times, strict=True):
            composer.update([Layer(gdf, strength, gains=gains)], _BLEND)
            layers = [Layer(gdf, strength + 0.01, gains=gains)]
            started = time.process_time()
            composer.update(layers, _BLEND)
            taken.append(1e3 * (time.process_time() - started))
    exact = compose_layers(scene, [Layer(gdf, strength + 0.01, gains=_DIVIDED)], _BLEND)
    found = composers[0].gaussians
    difference = max(
        float((getattr(found, name) - getattr(exact, name)).abs().max())
        if getattr(exact, name).numel()
        else 0.0
        for name in ("sh0", "shN")
    )
    divided, plain = (statistics.quantiles(taken, n=4)[0] for taken in times)
    return {
        "members": str(count),
        "the edit moves": case,
        "ms": f"{divided:.2f}",
        "gains of 1, ms": f"{plain:.2f}",
        "ratio": f"{divided / plain:.2f}",
        "once, ms": f"{once:.0f}",
        "difference": f"{difference:.0e}",
    }


def _edit(count: int, bands: int) -> tuple[Gaussians, Gdf]:
    """Return a scene and an edit of all its colors, on a straight path."""
    random = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=random)

    scene = Gaussians(
        means=draw(count, 3),
        quats=draw(count, 4),
        log_scales=draw(count, 3),
        logit_opacities=draw(count),
        sh0=draw(count, 3),
        shN=0.1 * draw(count, bands, 3),
    )
    offsets = torch.zeros(2, count, 14 + 3 * bands)
    offsets[1, :, 11:] = 0.3 * draw(count, 3 + 3 * bands)
    field = course_field(torch.tensor([0.0, 1.0]), offsets)
    return scene, edit_of(scene, torch.arange(count), field)
