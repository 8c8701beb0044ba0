"""The benchmark `packing`: weighed packings of a color edit against drawn ones, in time and error.

Each row is one packing of the same solution: a bear whose Gaussians take a map and a residual of their own.
Plain baked and drawn candidates (`FieldEvaluator.candidate`) are the reference.

    python -m benchmarks packing
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import torch

from benchmarks.table import Table
from progdf.demo_scenes import bear
from progdf.field.baked import identity_map
from progdf.field.choose import SAMPLES
from progdf.field.grade import bake_grade, map_colors, member_bands
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.region import whole_scene
from progdf.threads import one_thread
from trainer.fit.evaluate import Evaluator, make_evaluator
from trainer.fit.fit import field_evaluator
from trainer.fit.grades import PackingScale, grade_packing
from trainer.options import FieldOptions
from trainer.views.crops import crop_scene
from trainer.views.view import BACKGROUND, make_view, name_cameras, region_rig

MEMBERS = 20_000
"""Gaussians of the bear, all of them members."""
VIEWS = 3
SIDE = 224  # pixels
KNOTS = 6
PACKINGS = ((0, 0), (1, 0), (2, 0), (2, 12), (2, 24))
"""Number of bases, and index of the step size."""


@one_thread()
def tables(scenes: Sequence[Path] = (), plot: Path | None = None) -> list[Table]:
    """Measure every packing."""
    scene = bear(MEMBERS).gaussians
    trajectory = _trajectory(scene)
    views = _evaluator(scene, trajectory)
    rows = pack(scene, with_shN=scene.sh_degree > 0)
    packing = grade_packing(trajectory, rows, torch.ones(len(scene)))
    judge = field_evaluator(trajectory, views, FieldOptions())
    began = time.process_time()
    scale = PackingScale(packing, views, judge)
    once = time.process_time() - began
    found = []
    for rank, index in PACKINGS:
        form = packing.fit(rank, index)
        began = time.process_time()
        weighed = scale.candidate(form)
        between = time.process_time()
        drawn = judge.candidate(bake_grade(form, rows, packing.mapped.clone()), form.label)
        ended = time.process_time()
        found.append(
            {
                "packing": f"{form.label}, step {2 ** ((index - 8) / 8):.2g}",
                "weighed, ms": f"{1e3 * (between - began):.0f}",
                "drawn, ms": f"{1e3 * (ended - between):.0f}",
                "error, weighed": f"{weighed.excess:.3f}",
                "drawn": f"{drawn.excess:.3f}",
            }
        )
    caption = (
        f"Processor time on one thread; {len(scene)} members, {VIEWS} views of {SIDE} pixels. Errors are "
        "multiples of the allowed error; a packing is accepted up to 1. Weighed: one picture of each basis, "
        f"and {1e3 * once:.0f} ms once. Drawn: baked, and drawn at {SAMPLES + KNOTS - 1} strengths."
    )
    return [Table.of("packing", "Packings of one solution, weighed and drawn", found, caption)]


def _trajectory(scene: Gaussians) -> Trajectory:
    """Return recordings of a map and of a residual that bends on its way."""
    generator = torch.Generator().manual_seed(1)
    rows = pack(scene, with_shN=scene.sh_degree > 0)
    sh = member_bands(rows)
    first = BASE_CHANNELS - 3
    tables_at = []
    offsets = []
    residuals = 0.1 * torch.randn(2, len(rows), 3, generator=generator)
    strengths = torch.linspace(0.0, 1.0, KNOTS)
    for s in strengths.tolist():
        table = identity_map(1)
        table[1:4] *= 1.0 - 0.6 * s
        table[0] = s * torch.tensor([0.1, 0.2, 0.4])
        offset = torch.zeros_like(rows)
        offset[:, first : first + sh[0].numel()] = (map_colors(sh, table, 1) - sh).flatten(1)
        offset[:, first : first + 3] += s * residuals[0] + s * s * residuals[1]
        tables_at.append(table)
        offsets.append(offset)
    stages = tuple(range(1, KNOTS))
    return Trajectory(
        s=strengths,
        offsets=torch.stack(offsets).half(),
        end=offsets[-1],
        steps=torch.arange(KNOTS),
        stage_ends=stages,
        strengths=tuple(strengths[1:].tolist()),
        maps=torch.stack(tables_at[1:]),
        bands=1,
    )


def _evaluator(scene: Gaussians, trajectory: Trajectory) -> Evaluator:
    """Return views whose edited pictures differ from the solution by two levels of 255."""
    region = whole_scene(scene)
    background = torch.tensor(BACKGROUND)
    cameras = name_cameras(region_rig(scene, region, VIEWS, SIDE))
    views = [make_view(scene, region, camera, background) for camera in cameras]
    rows = pack(scene, with_shN=scene.sh_degree > 0)
    whole = [
        crop_scene(scene, region.members, v.camera, (0, 0, v.camera.width, v.camera.height), background, True)
        for v in views
    ]
    edited = {}
    for at, s in trajectory.stage_strengths:
        edited[s] = [(crop.render(rows + trajectory.at(at)) + 2 / 255).clamp(0.0, 1.0) for crop in whole]
    return make_evaluator(scene, region, views, edited, background, rows.shape[1], still=True)
