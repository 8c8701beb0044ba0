"""`python -m benchmarks field`, its neural part: networks as trained, and what the paper's size takes."""

from __future__ import annotations

import statistics
import time
from dataclasses import replace
from functools import partial

import torch

from progdf.field import NeuralField, NeuralSettings, fit_neural
from progdf.field.neural_fit import NeuralFit
from progdf.field.separable import moving_attributes
from progdf.gaussians import pack

from .courses import KnownEdit, milliseconds
from .field_forms import Form

STEPS = 600
"""Of training, a tenth of what `progdf fit --field neural` takes."""

NETWORKS = (
    ("neural, tiny", NeuralSettings("tiny")),
    ("neural, tiny, code of 8", NeuralSettings("tiny", code=8)),
)
"""What is trained for so many steps and judged."""

PAPER = NeuralSettings("paper", "position")


def network_forms(course: KnownEdit) -> list[Form]:
    """Networks before they are baked; the paper's last, timed but neither trained nor judged."""
    before = pack(course.scene[course.members])
    found = []
    for label, given in NETWORKS:
        begin = time.perf_counter()
        settings = replace(given, steps=STEPS)
        network = fit_neural(course.strengths, course.offsets, before, settings, course.weights, course.look)
        seconds = time.perf_counter() - begin
        bound = network.bind(before)
        curve = course.judge.curve(bound)
        at = course.worst_at_snapshots(bound)
        found.append(_form(course, network, label, curve, at, seconds))
    fit = NeuralFit(before, course.offsets.shape[2], tuple(moving_attributes(course.offsets)), PAPER)
    fit.scale_to(course.offsets)
    return [*found, _form(course, fit.field(), "neural, the paper's 6 M", (), None, None)]


def _form(
    course: KnownEdit,
    network: NeuralField,
    label: str,
    curve: tuple[float, ...],
    at: float | None,
    seconds: float | None,
) -> Form:
    bound = network.bind(pack(course.scene[course.members]))
    before = torch.get_num_threads()
    asked = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            bound.offsets(0.5)  # the first one makes the threads
            asked.append(statistics.median(milliseconds(partial(bound.offsets, s / 4)) for s in (1, 2, 3)))
    finally:
        torch.set_num_threads(before)
    kind = "neural, code" if network.shape.code else "neural"
    return Form(
        course.name, len(course.members), kind, label, network.parameters, network.bytes_per_member,
        curve, at, seconds, (asked[0], asked[1]),
    )  # fmt: skip
