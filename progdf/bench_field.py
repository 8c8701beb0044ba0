"""`progdf bench field`: error against bytes and milliseconds for every kind of field; a slider step's cost.

Errors are those against the edit's true course, at and between the snapshots that the fields were fitted to,
in views that the choice of ranks has not seen, over the pixels that the edit changes.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from progdf.bench import Table
from progdf.bench_course import edit_of, known_course, milliseconds, step_ms
from progdf.bench_network import network_table
from progdf.camera import Camera
from progdf.checkpoint import Gdf
from progdf.compose import compose
from progdf.composer import Composer
from progdf.field import (
    Candidate,
    choose_field,
    fit_keyframes,
    fit_separable,
)
from progdf.field.choose import separable_within
from progdf.field.rendered import rendered_courses
from progdf.field.separable import channel_weights
from progdf.gaussians import ATTRIBUTES, Gaussians, pack
from progdf.layers import Layer
from progdf.rasterize import set_threads
from progdf.rasterize.threads import threads
from progdf.scenes import AnalyticEdit, bear, bear_edits

EDITS = ("gold", "stripes", "tilted ears")
BEAR, SIDE, SNAPSHOTS = 12_000, 160, 33
CLOUDS = ((3_000, 30_000), (100_000, 100_000))
"""Members and Gaussians of the scenes on which a slider step is timed."""


def tables() -> list[Table]:
    """Error against bytes; a slider step against copying as many bytes."""
    return [_field_table(), _network_table(), _compose_table()]


def _field_table() -> Table:
    scene = bear(BEAR)
    edits = bear_edits(scene)
    cameras = [camera.resized(SIDE, SIDE) for camera in scene.cameras]
    rows: list[tuple[str, ...]] = []
    for name in EDITS:
        edit, members = edits[name]
        for candidate in _candidates(scene.gaussians, edit, members, cameras):
            field = candidate.field
            step = step_ms(scene.gaussians, edit_of(scene.gaussians, members, field))
            rows.append(
                (
                    f"{name}, {len(members)} members",
                    candidate.label,
                    f"{field.bytes_per_member:.0f}",
                    f"{candidate.mean:.1f} / {candidate.worst:.1f}",
                    f"{step:.2f}",
                )
            )
    return Table(
        name="field",
        title="Fields: error against bytes and time",
        columns=("edit", "field", "bytes a member", "PSNR mean / worst, dB", "ms a slider step"),
        rows=tuple(rows),
        note=f"Bear of {BEAR} Gaussians, {SNAPSHOTS} snapshots; against the true course at 25 slider values, "
        f"3 views of {SIDE} px that the choice has not seen, pixels that the edit changes.",
    )


def _network_table() -> Table:
    scene = bear(BEAR)
    edit, members = bear_edits(scene)[EDITS[0]]
    cameras = [camera.resized(SIDE, SIDE) for camera in scene.cameras]
    stand = known_course(scene.gaussians, edit, members, cameras, SNAPSHOTS)
    return network_table(EDITS[0], scene.gaussians, members, stand)


def _candidates(
    scene: Gaussians, edit: AnalyticEdit, members: Tensor, cameras: Sequence[Camera]
) -> list[Candidate]:
    stand = known_course(scene, edit, members, cameras, SNAPSHOTS)
    strengths, offsets, judge, look, weights = (
        stand.strengths, stand.offsets, stand.judge, stand.look, stand.weights
    )  # fmt: skip
    found = [
        judge.candidate(fit_keyframes(strengths, offsets, count), f"{count} keyframes, float32")
        for count in (2, 4, 9)
    ]
    courses = rendered_courses(offsets, channel_weights(weights, *offsets.shape[1:]), look)
    for count in (4, 9):
        keyframes = judge.candidate(
            fit_keyframes(strengths, offsets, count, rest_type=torch.int8), f"{count} keyframes, int8"
        )
        found += [keyframes, separable_within(courses, strengths, keyframes.field.bytes_per_member, judge)]
    chosen = choose_field(strengths, offsets, look, weights, judge=judge).best
    return [*found, Candidate(chosen.field, chosen.curve, f"auto at 40 dB: {chosen.label}")]


def _compose_table() -> Table:
    rows = []
    for members, count in CLOUDS:
        rng = torch.Generator().manual_seed(0)
        scene = _cloud(count, rng)
        chosen = torch.randperm(count, generator=rng)[:members].sort().values
        offsets = torch.randn(9, members, 14, generator=rng).cumsum(dim=0)
        offsets -= offsets[:1].clone()
        field = fit_separable(torch.linspace(0, 1, 9), offsets, dict.fromkeys(ATTRIBUTES, 2))
        rows.append(_compose_row(scene, edit_of(scene, chosen, field)))
    return Table(
        name="compose",
        title="A slider step: new attributes of all members",
        columns=(
            "members / Gaussians",
            "compose, ms",
            "Composer 1 thread, ms",
            "2 threads, ms",
            "copying, ms",
            "ratio to copying",
            "largest difference",
        ),
        rows=tuple(rows),
        note="Medians, taken in turns. Copying: a NumPy copy that moves as many bytes as a step must. "
        "The plain compose also checks that the edit belongs to the scene.",
    )


def _compose_row(scene: Gaussians, edit: Gdf) -> tuple[str, ...]:
    composer = Composer(scene, [edit])
    # bases, the original and the last centres are read, row numbers too, 14 numbers written
    traffic = len(edit.region) * (edit.field.bytes_per_member + 56 + 12 + 8 + 56)
    source = np.ones(int(traffic) // 8, np.float32)
    target = source.copy()
    before = threads()
    times: dict[str, list[float]] = {"plain": [], "one": [], "two": [], "copy": []}
    difference = 0.0
    try:
        for i in range(25):
            layer = Layer(edit, 0.03 + 0.9 * i / 25)
            if i % 5 == 0:
                times["plain"].append(milliseconds(partial(compose, scene, [layer])))
            for key, count in (("one", 1), ("two", 2)):
                set_threads(count)
                composer.update([])
                times[key].append(milliseconds(partial(composer.update, [layer])))
            times["copy"].append(milliseconds(partial(np.copyto, target, source)))
            if i % 5 == 0:
                plain = pack(compose(scene, [layer]))
                difference = max(difference, float((pack(composer.gaussians) - plain).abs().max()))
    finally:
        set_threads(before)
    plain_ms, one, two, copied = (statistics.median(times[key]) for key in ("plain", "one", "two", "copy"))
    return (
        f"{len(edit.region)} / {len(scene)}",
        f"{plain_ms:.1f}",
        f"{one:.2f}",
        f"{two:.2f}",
        f"{copied:.2f}",
        f"{min(one, two) / copied:.1f}",
        f"{difference:g}",
    )


def _cloud(count: int, rng: torch.Generator) -> Gaussians:
    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    return Gaussians(
        means=normal(count, 3), quats=normal(count, 4), log_scales=normal(count, 3) - 4,
        logit_opacities=normal(count), sh0=normal(count, 3), shN=torch.zeros(count, 0, 3),
    )  # fmt: skip
