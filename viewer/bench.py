"""`progdf bench viewer`: milliseconds from a slider's change to finished pixels, beside the error.

The scene is the bear, so that anybody can repeat it; one edit recolours and moves its members, the other only
recolours them, which needs no new depth order. OpenGL and the CPU rasteriser take turns in one process.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from progdf.bench import Table
from progdf.checkpoint import Gdf, fingerprint
from progdf.errors import ProgdfError
from progdf.field.baked import AttributeBases, BakedField
from progdf.gaussians import Gaussians
from progdf.rasterize import render
from progdf.region import Region
from progdf.scenes import bear

from .engine import Engine, FrameTimings
from .headless import headless_context
from .state import LayerState, ViewState
from .turntable import first_camera, to_camera

SIZE = (640, 480)
WARM_UP = 2
RANKS = 3


@dataclass(frozen=True)
class Case:
    """One scene with an edit.

    Args:
        count: Gaussians in the scene
        members: Gaussians that the edit changes
        moves: whether it moves them too, so that they have to be sorted anew
    """

    count: int
    members: int
    moves: bool

    @property
    def title(self) -> str:
        return "colour and place" if self.moves else "colour"


CASES = (Case(31_000, 3_000, False), Case(31_000, 3_000, True), Case(125_000, 100_000, True))


@dataclass(frozen=True)
class Result:
    """What one way of drawing took, a timing per slider step, and how far it is from the CPU engine.

    Args:
        drawn_by: a key of `WAYS`
        slider: from a strength to finished pixels
        orbit: from a camera to finished pixels
        psnr_db: against `progdf.render`, the worst of three strengths
        apart: largest difference of a slider step's picture from the same drawn as a whole by the same engine
    """

    case: Case
    drawn_by: str
    slider: tuple[FrameTimings, ...]
    orbit: tuple[FrameTimings, ...]
    psnr_db: float
    apart: float = 0.0


WAYS = {"gl": "OpenGL", "cpu": "CPU", "cpu, whole": "CPU, whole picture"}
"""Ways to draw; "cpu" draws only the part of the picture that the slider touches, the last one all of it."""


def edit_for(scene: Gaussians, case: Case) -> Gdf:
    """A made-up edit, as large as a trained one: beside the full offset three int8 bases."""
    rng = torch.Generator().manual_seed(0)
    members = torch.arange(min(case.members, len(scene)))
    widths = {"means": 3, "log_scales": 3, "quats": 4, "sh0": 3} if case.moves else {"sh0": 3}
    nodes = torch.linspace(0, 1, 9)
    bumps = [torch.sin(math.pi * (k + 1) * nodes) for k in range(RANKS)]
    coefficients = torch.stack([nodes, *bumps], dim=1)
    coefficients[-1] = torch.tensor([1.0] + [0.0] * RANKS)
    attributes = {
        name: AttributeBases(
            full=(0.5 if name == "sh0" else 0.01) * torch.randn(len(members), width, generator=rng),
            rest=torch.randint(-127, 128, (RANKS, len(members), width), generator=rng, dtype=torch.int8),
            step=torch.full((RANKS, width), 1e-4),
            coefficients=coefficients.clone(),
        )
        for name, width in widths.items()
    }
    score = torch.zeros(len(scene)).index_fill(0, members, 1.0)
    return Gdf(
        "edit",
        Region("edit", members, score),
        BakedField("separable", nodes, attributes, 14),
        fingerprint(scene),
    )


def rows(cases: Sequence[Case] = CASES, steps: int = 20, size: tuple[int, int] = SIZE) -> list[Result]:
    """Measure every case with every way to draw that this machine has."""
    try:
        ctx = headless_context()
    except ProgdfError:
        ctx = None
    results = []
    for case in cases:
        scene = bear(case.count).gaussians
        gdf = edit_for(scene, case)
        ways = [way for way in WAYS if ctx or way != "gl"]
        engines = [Engine(ctx, scene, [gdf], "gl" if way == "gl" else "cpu") for way in ways]
        view = ViewState(first_camera(scene), (LayerState(0, "edit", 0.5),))
        slider: list[list[FrameTimings]] = [[] for _ in engines]
        orbit: list[list[FrameTimings]] = [[] for _ in engines]
        apart = 0.0
        for step in range(WARM_UP + steps):
            strength = 0.05 + 0.9 * step / (WARM_UP + steps)
            slid = _at(view, strength, 0.0)
            turned = _at(view, strength, 7.0 * (step + 1))
            images = {}
            for i, engine in enumerate(engines):
                if ways[i] == "cpu, whole":
                    engine.forget()
                images[ways[i]] = engine.image(slid, size)
                slider[i].append(engine.timings)
                engine.image(turned, size)
                orbit[i].append(engine.timings)
                engine.image(slid, size)
            apart = max(apart, float(np.abs(images["cpu"] - images["cpu, whole"]).max()))
        for way, engine, slides, turns in zip(ways, engines, slider, orbit, strict=True):
            error = _psnr(engine, view, size)
            results.append(Result(case, way, tuple(slides[WARM_UP:]), tuple(turns[WARM_UP:]), error, apart))
            engine.release()
    if ctx is not None:
        ctx.release()
    return results


def tables(results: Sequence[Result] | None = None) -> list[Table]:
    """The measurements for the README and for `progdf bench`."""
    measured = rows() if results is None else results
    cells = []
    for result in measured:
        totals = [timing.total_ms for timing in result.slider]
        middle, late = np.percentile(totals, (50, 95))
        split = [
            f"{np.median([getattr(timing, stage) for timing in result.slider]):.1f}"
            for stage in ("compose_ms", "upload_ms", "sort_ms", "draw_ms")
        ]
        orbit = np.median([timing.total_ms for timing in result.orbit])
        cells.append(
            (
                f"{result.case.count:,}".replace(",", " "),
                f"{result.case.members:,}".replace(",", " "),
                result.case.title,
                WAYS[result.drawn_by],
                *split,
                f"{100 * np.median([timing.share for timing in result.slider]):.0f} %",
                f"**{middle:.1f}** / {late:.1f}",
                f"{orbit:.1f}",
                "exact" if math.isinf(result.psnr_db) else f"{result.psnr_db:.0f}",
            )
        )
    return [
        Table(
            "viewer",
            "Slider change to finished pixels, 640×480, ms",
            (
                "Gaussians",
                "members",
                "edit of",
                "drawn by",
                "compose",
                "upload",
                "sort",
                "draw",
                "redrawn",
                "in all p50 / p95",
                "orbit p50",
                "PSNR to the CPU engine, dB",
            ),
            tuple(cells),
            "Wall clock, the GPU waited for; the parts are medians. The CPU rasteriser sorts as it draws "
            "and draws where the slider touches the picture; the largest difference from whole pictures: "
            f"{max(result.apart for result in measured):g}.",
        )
    ]


def _at(view: ViewState, strength: float, azimuth: float) -> ViewState:
    """`view` at another strength, turned by `azimuth` degrees."""
    camera = replace(view.camera, azimuth=view.camera.azimuth + azimuth)
    return replace(view, camera=camera, layers=(LayerState(0, "edit", strength),))


def _psnr(engine: Engine, view: ViewState, size: tuple[int, int]) -> float:
    worst = math.inf
    for strength in (0.0, 0.5, 1.0):
        slid = _at(view, strength, 0.0)
        image = engine.image(slid, size)
        target = render(engine.gaussians(slid), to_camera(slid.camera, *size)).numpy()
        error = float(((image.astype(np.float64) - target) ** 2).mean())
        worst = min(worst, math.inf if error == 0.0 else -10.0 * math.log10(error))
    return worst
