"""Every form of field on one edit: how large, how wrong, how long to fit and to step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf.field import choose_field, fit_keyframes
from progdf.field.baked import AttributeBases, BakedField
from progdf.field.separable import (
    channel_weights,
    check_trajectory,
    fit_amplitude,
    moving_attributes,
    principal_modes,
    quantize_bases,
)
from trainer.fit.fit import stored_numbers

from .courses import KnownEdit, edit_of, step_ms


def fit_joint(
    strengths: Tensor,
    offsets: Tensor,
    rank: int,
    weights: Tensor | None = None,
    recorded: Sequence[float] | None = None,
) -> BakedField:
    """The truncated SVD of all numbers at once, each attribute in units of what its end leaves unexplained.

    Args:
        strengths: of the snapshots, ascending from 0 to 1. [T]
        offsets: raw offsets of the members; the first row is 0, the last the recorded end. [T,M,C] float32
        rank: bases beside the full offset, the same for all attributes, ≥ 0; stored as int8
        weights: how much an error shows: visibility [M] or sensitivity [M,C]; None is evenly
        recorded: strengths for the slider's ticks; `strengths` when None

    Returns:
        A field with the snapshots as nodes, whose attributes share the coefficients of bases 1..R; attributes
        that never move are absent.

    Raises:
        ValueError: no trajectory, a negative rank, or weights that do not fit.
    """
    check_trajectory(strengths, offsets)
    if rank < 0:
        raise ValueError(f"rank is {rank}, expected 0 or more")
    spread = channel_weights(weights, offsets.shape[1], offsets.shape[2])
    courses = {
        name: fit_amplitude(offsets[:, :, columns], spread[:, columns])
        for name, columns in moving_attributes(offsets).items()
    }
    gram = torch.zeros(len(strengths), len(strengths), dtype=torch.float64)
    for course in courses.values():
        power = float(course.gram.diagonal().sum())
        gram += course.gram / power if power > 0 else 0.0
    mix = principal_modes(gram)[:, :rank]
    attributes = {}
    for name, course in courses.items():
        exact = (mix.T.float() @ course.residual.flatten(1)).reshape(-1, *course.offsets.shape[1:])
        rest, step = quantize_bases(exact, torch.int8)
        coefficients = torch.cat([course.amplitude[:, None], mix.float()], dim=1)
        coefficients[[0, -1]] = 0.0
        coefficients[-1, 0] = 1.0
        step = torch.cat([torch.ones(1, step.shape[1]), step])
        attributes[name] = AttributeBases(course.offsets[-1].contiguous(), rest, step, coefficients)
    ticks = strengths.tolist() if recorded is None else recorded
    return BakedField("separable", strengths.float(), attributes, offsets.shape[2], tuple(ticks))


COUNTS = (3, 4, 9)
"""Keyframes in int8, and the separable fields and joint factors of the same bytes beside them."""


@dataclass(frozen=True)
class Form:
    """One field of one edit, measured."""

    # edit, members: what was edited
    edit: str
    members: int
    kind: str  # as the plot tells them apart
    label: str  # what it is
    numbers: int  # stored
    bytes_per_member: float  # on disk
    curve: tuple[float, ...]  # PSNR over the slider between the snapshots, dB
    at_snapshots: float  # least PSNR at snapshots, dB
    seconds: float  # to fit it, with the pictures that this looks at
    step: tuple[float, float]  # ms for one change of the slider, with one thread and with two

    @property
    def worst(self) -> float:
        """Least PSNR over the slider, dB."""
        return min(self.curve)

    @property
    def mean(self) -> float:
        """Mean PSNR over the slider, dB."""
        return sum(self.curve) / len(self.curve)


def baked_forms(course: KnownEdit) -> list[Form]:
    """Keyframes, joint and separable factors of the same bytes, and what `auto` chooses; all judged alike."""
    strengths, offsets, judge, weights = course.strengths, course.offsets, course.judge, course.weights
    found: list[Form] = []

    def measure(kind: str, fit: Callable[[], tuple[BakedField, str]]) -> Form:
        begin = time.perf_counter()
        field, label = fit()
        seconds = time.perf_counter() - begin
        found.append(
            Form(
                course.name, len(course.members), kind, label, stored_numbers(field), field.bytes_per_member,
                judge.curve(field), course.worst_at_snapshots(field), seconds,
                step_ms(course.scene, edit_of(course.scene, course.members, field)),
            )
        )  # fmt: skip
        return found[-1]

    for count in (2, 4, 9):
        measure(
            "keyframes, float32",
            lambda c=count: (fit_keyframes(strengths, offsets, c), f"{c} keyframes, float32"),  # type: ignore[misc]
        )
    for count in COUNTS:
        measure(
            "keyframes, int8",
            lambda c=count: (  # type: ignore[misc]
                fit_keyframes(strengths, offsets, c, basis_type=torch.int8), f"{c} keyframes, int8"
            ),
        )  # fmt: skip
        size = found[-1].bytes_per_member
        measure(
            "joint SVD",
            lambda c=count: (fit_joint(strengths, offsets, c - 2, weights), f"joint SVD, rank {c - 2}"),  # type: ignore[misc]
        )

        def separable(size: float | None = size) -> tuple[BakedField, str]:
            best = choose_field(
                strengths, offsets, course.look, weights, budget=size, evaluator=course.chooser
            ).best
            return best.field, best.label

        measure("separable", separable)

    def auto() -> tuple[BakedField, str]:
        field, label = separable(None)
        return field, f"auto at 40 dB: {label}"

    measure("auto", auto)
    return found
