"""`progdf bench field`, its neural part: the paper's field and ours, as trained and as baked."""

from __future__ import annotations

import statistics
import time
from functools import partial

from torch import Tensor

from progdf.bench import Table
from progdf.bench_course import KnownCourse, edit_of, milliseconds, step_ms
from progdf.field import NeuralSettings, baked_neural, fit_neural, position_floor
from progdf.gaussians import Gaussians, pack

NETWORKS = (
    ("position alone, 6 M (paper), a minute", NeuralSettings("paper", "position", steps=150, batch=512)),
    ("position alone, .5 M", NeuralSettings("small", "position")),
    ("position alone, hard bins", NeuralSettings("tiny", "position", bins="hard")),
    ("position alone", NeuralSettings("tiny", "position")),
    ("look and end too", NeuralSettings("tiny")),
    ("look, end and code of 8", NeuralSettings("tiny", code=8)),
)
"""What is trained, by what is said of it; the smallest size where no number is told."""


def network_table(name: str, scene: Gaussians, members: Tensor, stand: KnownCourse) -> Table:
    """Networks trained on one edit, as trained and as baked."""
    before = pack(scene[members])
    rows: list[tuple[str, ...]] = []
    for label, given in NETWORKS:
        begin = time.perf_counter()
        network = fit_neural(stand.strengths, stand.offsets, before, given, stand.weights, stand.look)
        seconds = time.perf_counter() - begin
        bound = network.bound(before)
        curve = stand.judge.curve(bound)
        field = baked_neural(network, before, stand.truth, stand.look)
        baked = stand.judge.candidate(field, label)
        asked = statistics.median(milliseconds(partial(bound.offsets, s / 6)) for s in range(1, 6))
        rows.append(
            (
                label,
                f"{network.parameters}",
                f"{network.bytes_per_member:.0f}",
                f"{sum(curve) / len(curve):.1f} / {min(curve):.1f}",
                f"{baked.mean:.1f} / {baked.worst:.1f}",
                f"{seconds:.0f}",
                f"{asked:.1f}",
                f"{step_ms(scene, edit_of(scene, members, field)):.2f}",
            )
        )
    floor = position_floor(stand.strengths, stand.offsets, before[:, :3], stand.weights, stand.judge)
    unpredictable = ", ".join(f"{name} {share:.0%}" for name, share in floor.unpredictable.items())
    return Table(
        name="network",
        title="Neural fields: before and after they are baked",
        columns=(
            "what the network sees",
            "numbers",
            "bytes a member",
            "PSNR as trained, mean / worst, dB",
            "baked",
            "s to fit",
            "ms a slider step as trained",
            "baked",
        ),
        rows=tuple(rows),
        note=f"{name}, {len(members)} members, as above; bytes with the recorded end. What "
        f"neighbours foretell of a member's movement: {floor.psnr_mean:.1f} / {floor.psnr_worst:.1f} dB; "
        f"what they do not: {unpredictable}.",
    )
