"""Network of the paper: its memory bank of snapshots, and its training jointly with PGS."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import accumulate

import torch
from torch import Tensor

from progdf.field import NeuralSettings
from progdf.field.baked import interpolate_at
from progdf.field.choose import Render
from progdf.field.neural_fit import NeuralFit, PictureLoss, rendered_importance
from progdf.field.separable import moving_attributes
from progdf.gaussians import BASE_CHANNELS, pack
from trainer.optimize.pgs import DescentTask, rated_attributes
from trainer.optimize.retime import resolve_slider
from trainer.options import FieldOptions
from trainer.store.state import Saved, StateFolder
from trainer.views.boxes import probe_views
from trainer.views.crops import render_all

from .losses import RenderedLoss

PART = "network"
"""Name of the saved part with a jointly trained network, after the trajectory is recorded."""
MAX_SNAPSHOTS = 64
"""Maximum number of snapshots in a bank. Above it, the one nearest to its neighbors is dropped."""


class MemoryBank:
    """Snapshots along the slider in half precision, including the original at 0.

    Args:
        members, channels: M and C of the offsets
        most: largest number of snapshots, ≥ 3; the original and the newest are always kept
    """

    def __init__(self, members: int, channels: int, most: int = MAX_SNAPSHOTS) -> None:
        self._strengths = [0.0]
        self._offsets = [torch.zeros(members, channels, dtype=torch.float16)]
        self._max_snapshots = most

    def __len__(self) -> int:
        return len(self._strengths)

    def add(self, strength: float, offsets: Tensor) -> None:
        """Add a snapshot. [M,C] Raises ValueError unless its strength is above all others."""
        if strength <= self._strengths[-1]:
            raise ValueError(f"a snapshot at {strength} after one at {self._strengths[-1]}")
        self._strengths.append(strength)
        self._offsets.append(offsets.detach().half())
        if len(self) > self._max_snapshots:
            s = self._strengths
            gaps = [s[i + 1] - s[i - 1] for i in range(1, len(self) - 1)]
            closest = 1 + gaps.index(min(gaps))
            del self._strengths[closest], self._offsets[closest]

    @property
    def strengths(self) -> Tensor:
        """Strengths of the snapshots, ascending from 0. [T] float32"""
        return torch.tensor(self._strengths)

    @property
    def offsets(self) -> Tensor:
        """Offsets of the snapshots. [T,M,C] float16"""
        return torch.stack(self._offsets)


class JointTraining:
    """Joint training of a network with PGS; a `state.Resumable`.

    Args:
        fit: the network, not yet trained
        channels: channels of the recordings
        strengths, steps: strength and number of steps of each stage, in order
        render: renders a small number of small views, to weight the attributes by their visible effect
        pictures: loss on pictures instead of offsets
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
        self._render = render
        self._pictures = pictures
        self.bank = MemoryBank(fit.members, channels)
        self._strengths = self.bank.strengths
        self._offsets = self.bank.offsets

    def strength(self, step: int) -> float:
        """Return the provisional slider value of a PGS step, linear in the steps of its stage."""
        return float(interpolate_at(self._after, self._at, step))

    def add(self, step: int, offsets: Tensor) -> None:
        """Add a recording of PGS. [M,C]"""
        self._keep(step, offsets)
        if moving_attributes(self._offsets):
            pictures = self._pictures is not None  # a loss on pictures needs no weights per attribute
            importance = None if pictures else rendered_importance(self._offsets, self._render)
            self.fit.scale_to(self._offsets, importance)

    def step(self) -> None:
        """Train the field for one step, after a step of PGS; does nothing before the first recording.

        Raises:
            FloatingPointError: the field's loss is no longer finite.
        """
        if len(self.bank) > 1:
            self.fit.step(self._strengths, self._offsets, pictures=self._pictures)

    def capture_state(self) -> Saved:
        """Return the state of the fit; the bank is rebuilt from the recordings."""
        return Saved(self.fit.capture_state(), {})

    def restore(self, saved: Saved) -> None:
        """Restore the fit; call `refill` afterwards."""
        self.fit.restore(saved.tensors)

    def refill(self, recordings: Sequence[tuple[int, Tensor]]) -> None:
        """Fill the bank with the recordings before the run was stopped: step, offsets [M,C]."""
        self.bank = MemoryBank(self.fit.members, self._channels)
        for step, offsets in recordings:
            self._keep(step, offsets)

    def _keep(self, step: int, offsets: Tensor) -> None:
        self.bank.add(self.strength(step), offsets)
        self._strengths = self.bank.strengths
        self._offsets = self.bank.offsets


def as_printed(settings: NeuralSettings) -> NeuralSettings:
    """Return the settings of a network with positions as input, hard bins of the slider, and no codes."""
    return replace(settings, inputs="position", code=0, bins="hard")


def begin_joint_training(
    options: FieldOptions, settings: NeuralSettings, task: DescentTask, seen: Tensor
) -> JointTraining:
    """Create the network that is trained jointly with PGS.

    Args:
        options: resolved
        settings: network and length of its training
        task: inputs of PGS
        seen: visibility of each member. [M]
    """
    setup = task.setup
    channels = len(task.rates)
    attributes = tuple(rated_attributes(task.rates))
    rows = pack(setup.scene[setup.region.members], with_shN=channels > BASE_CHANNELS)
    small = probe_views(setup)

    def render(offsets: Tensor) -> Tensor:
        images = render_all(small, rows + offsets, attributes)
        return torch.cat([image.reshape(-1, 3) for image in images])

    strengths = [stage.strength for stage in task.stages]
    steps = [stage.steps for stage in task.stages]
    if resolve_slider(task.options.slider, strengths) == "even":
        strengths = [(i + 1) / len(strengths) for i in range(len(strengths))]
    fit = NeuralFit(rows, channels, attributes, settings, seen)
    pictures = None
    if options.field_loss == "pictures":
        pictures = RenderedLoss(task.crops, rows, attributes, task.perceptual)
    return JointTraining(fit, channels, strengths, steps, render, pictures)


def save_network(joint: JointTraining, folder: StateFolder) -> None:
    """Save the network for the end of the run, when the trajectory is complete."""
    folder.save(PART, joint.fit.capture_state(), {"shape": asdict(joint.fit.shape)})
