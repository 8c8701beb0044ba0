"""The memory bank of snapshots, and the field that is trained on it while the edit is optimized.

ProGDF trains its field jointly with PGS: after each of its steps one of the field's, on a snapshot drawn from
those recorded so far. The slider values are not known before the whole way is, so a snapshot goes by its
stage's strength and its step until then; where these are not what the slider means in the end, the network is
finished on the trajectory as it was re-timed. The end of the way is not known either: until then a network
sees positions (and its codes) alone. Separable and keyframe fields have closed forms: they are solved once
the trajectory is whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate

import torch
from torch import Tensor

from progdf.field.neural_fit import NeuralFit, PictureLoss
from progdf.field.rendered import Render, rendered_importance
from progdf.field.separable import moving_attributes
from progdf.interpolation import interpolate_at
from trainer.store.state import Saved

MOST = 64
"""Snapshots that a bank keeps; of more, those go that differ least in time from their neighbors."""


class MemoryBank:
    """Snapshots along the slider, in half precision; the original, at 0, is always among them.

    Args:
        members, channels: M and C of the offsets
        most: how many to keep, the original and the newest always, ≥ 3
    """

    def __init__(self, members: int, channels: int, most: int = MOST) -> None:
        self._strengths = [0.0]
        self._offsets = [torch.zeros(members, channels, dtype=torch.float16)]
        self._most = most

    def __len__(self) -> int:
        return len(self._strengths)

    def add(self, strength: float, offsets: Tensor) -> None:
        """Keep one more; its strength is above all others. [M,C]"""
        if strength <= self._strengths[-1]:
            raise ValueError(f"a snapshot at {strength} after one at {self._strengths[-1]}")
        self._strengths.append(strength)
        self._offsets.append(offsets.detach().half())
        if len(self) > self._most:
            s = self._strengths
            gaps = [s[i + 1] - s[i - 1] for i in range(1, len(self) - 1)]
            least = 1 + gaps.index(min(gaps))
            del self._strengths[least], self._offsets[least]

    @property
    def strengths(self) -> Tensor:
        """Ascending from 0. [T] float32"""
        return torch.tensor(self._strengths)

    @property
    def offsets(self) -> Tensor:
        """[T,M,C] float16"""
        return torch.stack(self._offsets)


class JointTraining:
    """A network in joint training with PGS; a `state.Resumable`.

    Args:
        fit: the network, not yet trained
        channels: of the recordings
        strengths, steps: of the stages, in order
        render: of a few small views, tells how much each attribute shows
        pictures: the loss is of these instead of offsets
    """

    def __init__(
        self,
        fit: NeuralFit,
        channels: int,
        strengths: Sequence[float],
        steps: Sequence[int],
        render: Render,
        pictures: PictureLoss | None = None,
    ) -> None:
        self.fit = fit
        self._channels = channels
        self._at = torch.tensor([0.0, *strengths], dtype=torch.float64)
        self._after = torch.tensor([0, *accumulate(steps)], dtype=torch.float64)
        self._render, self._pictures = render, pictures
        self.bank = MemoryBank(fit.members, channels)
        self._strengths, self._offsets = self.bank.strengths, self.bank.offsets

    def strength(self, step: int) -> float:
        """Where on the slider a step of PGS is for now: even in time within its stage."""
        return float(interpolate_at(self._after, self._at, step))

    def add(self, step: int, offsets: Tensor) -> None:
        """A recording of PGS. [M,C]"""
        self._keep(step, offsets)
        if moving_attributes(self._offsets):
            pictures = self._pictures is not None  # which weigh the attributes themselves
            importance = None if pictures else rendered_importance(self._offsets, self._render)
            self.fit.scale_to(self._offsets, importance)

    def step(self) -> None:
        """One step of the field after one of PGS; none before the first recording.

        Raises:
            FloatingPointError: the field's loss is no longer finite.
        """
        if len(self.bank) > 1:
            self.fit.step(self._strengths, self._offsets, pictures=self._pictures)

    def capture_state(self) -> Saved:
        """The fit; the bank is made again from the recordings."""
        return Saved(self.fit.capture_state(), {})

    def restore(self, saved: Saved) -> None:
        """Take over the fit; `refill` comes after."""
        self.fit.restore(saved.tensors)

    def refill(self, recordings: Sequence[tuple[int, Tensor]]) -> None:
        """Fill the bank with what was recorded before the run was stopped: step, offsets [M,C]."""
        self.bank = MemoryBank(self.fit.members, self._channels)
        for step, offsets in recordings:
            self._keep(step, offsets)

    def _keep(self, step: int, offsets: Tensor) -> None:
        self.bank.add(self.strength(step), offsets)
        self._strengths, self._offsets = self.bank.strengths, self.bank.offsets
