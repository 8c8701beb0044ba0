"""A field's error: its pictures against those of the trajectory, over the whole slider."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from progdf.interpolation import interpolate_at
from progdf.metrics.image import decibels

from .baked import BakedField
from .rendered import Render

SAMPLES = 13


class Field(Protocol):
    """Anything that gives the offsets of its members at any strength, baked or not."""

    @property
    def attributes(self) -> Collection[str]:
        """Names of the attributes that move."""
        ...

    def offsets(self, s: float) -> Tensor:
        """Packed raw-space offsets. [M,C] float32"""
        ...


@dataclass(frozen=True)
class Candidate:
    """A field and its error against the trajectory.

    Args:
        field: the field
        curve: PSNR at `sample_strengths()`, dB
        label: what it is, e.g. "separable (means 2, sh0 3)"
    """

    field: BakedField
    curve: tuple[float, ...]
    label: str

    @property
    def worst(self) -> float:
        """Least PSNR over the slider, dB."""
        return min(self.curve)

    @property
    def mean(self) -> float:
        """Mean PSNR over the slider, dB."""
        return sum(self.curve) / len(self.curve)


def sample_strengths() -> tuple[float, ...]:
    """Strengths at which errors are taken: even, the ends left out where the error is 0 by construction."""
    return tuple((i + 1) / (SAMPLES + 1) for i in range(SAMPLES))


class FieldEvaluator:
    """Renders fields and compares them with the trajectory, whose pictures are made once.

    Args:
        strengths: of the snapshots. [T]
        offsets: [T,M,C]
        render: the pixels that count; held-out views are the honest choice
        truth: the offsets at any strength, [M,C]; None is straight from snapshot to snapshot
    """

    def __init__(
        self,
        strengths: Tensor,
        offsets: Tensor,
        render: Render,
        truth: Callable[[float], Tensor] | None = None,
    ) -> None:
        course = truth or (lambda s: interpolate_at(strengths, offsets, s))
        self._render = render
        self._nothing = torch.zeros_like(offsets[0])
        with torch.no_grad():
            self._expected = [render(course(s)) for s in sample_strengths()]

    def curve(self, field: Field) -> tuple[float, ...]:
        """PSNR at `sample_strengths()`, dB."""
        with torch.no_grad():
            return tuple(
                decibels(float((self._render(self._offsets(field, s)) - expected).double().square().mean()))
                for s, expected in zip(sample_strengths(), self._expected, strict=True)
            )

    def _offsets(self, field: Field, s: float) -> Tensor:
        # a field that moves nothing does not know how many members it has
        return field.offsets(s) if field.attributes else self._nothing

    def candidate(self, field: BakedField, label: str) -> Candidate:
        """The field with its error."""
        return Candidate(field, self.curve(field), label)
