"""Fit of a neural field to a trajectory: Adam on random samples of its snapshots (ProGDF, AAAI 2025).

The direct loss compares offsets, in units of their attribute's spread. It is weighted by the visibility of
the Gaussian and by the attribute's effect on pictures, and needs no rendering. The paper's loss compares
renders of a random snapshot. Weighting by the effect on pictures gains 3.5 dB (robot recolored: 33 dB instead
of 29).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor
from torch.nn.functional import linear

from . import neural
from .neural import LAYOUT, Bins, Inputs, NeuralField, NeuralShape, Size
from .separable import channel_weights, moving_attributes, quantize_bases


class PictureLoss(Protocol):
    """Difference between renders of the field and of the recording."""

    @property
    def views(self) -> int:
        """Number of views."""
        ...

    def __call__(self, offsets: Tensor, recorded: Tensor, view: int, /) -> Tensor:
        """Return the loss of the field's packed offsets against the recording, at one strength in one view.

        [M,C], [M,C] -> []
        """
        ...


EFFORT: Mapping[Size, tuple[int, int, float]] = {
    "tiny": (6000, 2048, 5e-3),
    "small": (1200, 2048, 2e-3),
    "paper": (2000, 1024, 5e-4),
}
"""Size → steps, members per step, largest learning rate."""

_SQUARE_DECAY = 0.999  # Adam's memory of squared gradients
_LEAST_SQUARE = 1e-16  # square of Adam's ε
_WARMUP_STEPS = 50


@dataclass(frozen=True)
class NeuralSettings:
    """Network and length of its training."""

    size: Size = "tiny"  # "tiny" and "small" take up to a minute on two cores, "paper" 15 minutes
    inputs: Inputs = "own"  # see `NeuralShape`
    code: int = 0  # length of each Gaussian's learned code; one byte per number in the file
    bins: Bins = "smooth"  # "smooth", or "hard" as in the paper
    steps: int = 0  # 0: the size's own value
    batch: int = 0  # members per step; 0: the size's own value
    seed: int = 0  # seed of the initial weights and of the samples

    def resolve(self) -> NeuralSettings:
        """Return the settings with every 0 replaced by the size's own value."""
        steps, batch, _ = EFFORT[self.size]
        return replace(self, steps=self.steps or steps, batch=self.batch or batch)


class NeuralFit:
    """Network in training. Its state is a set of named tensors, so that a run can be continued.

    Args:
        rows: raw values of the members before the edit, packed. [M,≥14]
        channels: width of a packed row, 14 or 14 + 3K
        attributes: attributes that change
        settings: network and length of its training
        visibility: visibility of each member. [M]; None: uniform
    """

    def __init__(
        self,
        rows: Tensor,
        channels: int,
        attributes: tuple[str, ...],
        settings: NeuralSettings,
        visibility: Tensor | None = None,
    ) -> None:
        self.settings = settings.resolve()
        self._rate = EFFORT[settings.size][2]
        width, layers = LAYOUT[settings.size]
        self.shape = NeuralShape(
            width, layers, attributes, channels, settings.inputs, settings.code, hard=settings.bins == "hard"
        )
        self.steps = 0
        self._rows = rows
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._frame = _initial_frame(self.shape, rows)
        self._learned = _initial_weights(self.shape, self._generator)
        if self.shape.code:
            self._learned["codes"] = 0.1 * torch.randn(len(rows), self.shape.code, generator=self._generator)
        for tensor in self._learned.values():
            tensor.requires_grad_()
        self._adam = torch.optim.Adam(
            list(self._learned.values()), lr=self._rate, betas=(0.9, _SQUARE_DECAY), fused=True
        )
        visible = channel_weights(visibility, len(rows), 1)[:, 0]
        self._visibility = visible / visible.mean().clamp_min(1e-12)
        self._importance = torch.full((len(self.shape.columns),), 1.0 / len(self.shape.columns))
        self._end = torch.zeros(len(rows), len(self.shape.columns))
        self._inputs = torch.zeros(0)

    @property
    def members(self) -> int:
        """Number of members M."""
        return len(self._rows)

    def scale_to(self, offsets: Tensor, importance: Mapping[str, float] | None = None) -> None:
        """Adapt the scales to a trajectory, or to its growth. The network's offsets stay the same.

        Args:
            offsets: offsets of the snapshots so far. [T,M,C]
            importance: visibility of an error in each attribute, with sum 1; None: the same for every number
        """
        columns = self.shape.columns
        self._end = offsets[-1][:, columns].float()
        before = self._frame["spread"]
        after = before.clone()
        for name, outputs in self.shape.outputs.items():
            trajectory = offsets[1:][:, :, columns[outputs]].float()
            power = (trajectory.square().mean(dim=(0, 2)) * self._visibility).mean()
            after[outputs] = float(power.sqrt().clamp_min(1e-12))
            if importance is not None:
                self._importance[outputs] = importance.get(name, 0.0) / (outputs.stop - outputs.start)
        self._importance /= self._importance.sum().clamp_min(1e-30)
        if self.steps:
            with torch.no_grad():
                for name in ("heads.weight", "heads.bias"):
                    factor = before / after
                    self._learned[name].mul_(factor[:, None] if name == "heads.weight" else factor)
        self._frame["spread"] = after
        if self.shape.inputs == "own" and len(self._rows):
            appearances = neural.appearance(self._rows, self._end)
            spread = appearances.std(dim=0, correction=0)
            self._frame["look_mean"] = appearances.mean(dim=0)
            self._frame["look_spread"] = torch.where(spread > 1e-6, spread, torch.ones_like(spread))
        self._inputs = neural.encode(self.shape, self._frame, self._rows, self._end)

    def step(
        self,
        strengths: Tensor,
        offsets: Tensor,
        factor: float = 1.0,
        pictures: PictureLoss | None = None,
    ) -> float:
        """Take one step of Adam on random samples of the snapshots. Call `scale_to` first.

        Args:
            strengths: strengths of the snapshots, ascending from 0. [T]
            offsets: offsets of the snapshots. [T,M,C], any floating type
            factor: factor of the learning rate
            pictures: compare renders instead of offsets: of one snapshot (not between two) in one view, both
                chosen at random

        Returns:
            The loss.

        Raises:
            FloatingPointError: the loss is not finite.
        """
        self.steps += 1
        if not len(self._rows):
            return 0.0
        if pictures is None:
            loss = self._offset_loss(strengths, offsets)
        else:
            loss = self._picture_loss(strengths, offsets, pictures)
        value = float(loss.detach())
        if not math.isfinite(value):
            raise FloatingPointError(f"the field's loss is {value} at step {self.steps}")
        for group in self._adam.param_groups:
            group["lr"] = self._rate * factor * min(1.0, self.steps / _WARMUP_STEPS)
        self._adam.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if pictures is not None:
            self._limit_gradients()
        self._adam.step()
        return value

    def _limit_gradients(self) -> None:
        """Scale down the gradient of a tensor that exceeds its usual size, as StableAdamW does
        (Wortsman et al., NeurIPS 2023).

        A step sees one picture. Without the limit, a few exceptional pictures move Gaussians out of sight,
        where no gradient brings them back.
        """
        for tensor in self._learned.values():
            state = self._adam.state[tensor]
            if tensor.grad is None or not state:
                continue
            usual = state["exp_avg_sq"] / (1.0 - _SQUARE_DECAY ** float(state["step"]))
            ratio = tensor.grad.square() / usual.clamp_min(_LEAST_SQUARE)
            tensor.grad /= ratio.mean().sqrt().clamp_min(1.0)

    def _offset_loss(self, strengths: Tensor, offsets: Tensor) -> Tensor:
        """Return the loss of random members, each at a random strength. []"""
        rows = torch.randint(len(self._rows), (self.settings.batch,), generator=self._generator)
        right = torch.randint(1, len(strengths), rows.shape, generator=self._generator)
        share = torch.rand(rows.shape, generator=self._generator)
        s = torch.lerp(strengths[right - 1], strengths[right], share)
        low = offsets[right - 1, rows].float()
        high = offsets[right, rows].float()
        recorded = torch.lerp(low, high, share[:, None])
        errors = (self._predict(rows, s) - recorded[:, self.shape.columns]) / self._frame["spread"]
        return (self._visibility[rows, None] * self._importance * errors.square()).sum(dim=1).mean()

    def _picture_loss(self, strengths: Tensor, offsets: Tensor, pictures: PictureLoss) -> Tensor:
        """Return the loss of all members, at one random snapshot except the original, in one view. []"""
        snapshot = int(torch.randint(1, len(strengths), (1,), generator=self._generator))
        view = int(torch.randint(pictures.views, (1,), generator=self._generator))
        rows = torch.arange(len(self._rows))
        moved_columns = self._predict(rows, strengths[snapshot].expand(len(rows)))
        recorded = offsets[snapshot].float()
        moved = torch.zeros_like(recorded).index_copy(1, self.shape.columns, moved_columns)
        return pictures(moved, recorded, view)

    def _predict(self, rows: Tensor, s: Tensor) -> Tensor:
        """Return the field's offsets for sampled members and strengths. [B], [B] -> [B,c]"""
        signal = neural.control_signal(self.shape, self._learned["control"], s)
        parts = [self._inputs[rows], signal]
        if self.shape.code:
            parts.insert(1, self._learned["codes"].index_select(0, rows))
        hidden = linear(
            torch.cat(parts, dim=1), self._learned["layers.0.weight"], self._learned["layers.0.bias"]
        )
        answer = neural.apply_later_layers(
            self.shape, {**self._learned, "spread": self._frame["spread"]}, hidden
        )
        return neural.offsets_of_answer(self.shape, s, answer, self._end[rows])

    def capture_state(self) -> dict[str, Tensor]:
        """Return everything that the next steps depend on, by name, except the snapshots."""
        state = {f"learned.{name}": tensor.detach() for name, tensor in self._learned.items()}
        state |= {f"frame.{name}": tensor for name, tensor in self._frame.items()}
        state |= {"end": self._end, "importance": self._importance, "steps": torch.tensor(self.steps)}
        for name, tensor in self._learned.items():
            for key, moment in self._adam.state[tensor].items():
                state[f"adam.{name}.{key}"] = moment
        return state | {"draws": self._generator.get_state()}

    def restore(self, saved: Mapping[str, Tensor]) -> None:
        """Restore the result of `capture_state` from a fit made with the same arguments."""
        for name, tensor in self._learned.items():
            tensor.data.copy_(saved[f"learned.{name}"])
            begin = f"adam.{name}."
            state = {key.removeprefix(begin): t.clone() for key, t in saved.items() if key.startswith(begin)}
            if state:
                self._adam.state[tensor] = state
        self._frame = {name: saved[f"frame.{name}"].clone() for name in self._frame}
        self._end = saved["end"].clone()
        self._importance = saved["importance"].clone()
        self.steps = int(saved["steps"])
        self._generator.set_state(saved["draws"])
        self._inputs = neural.encode(self.shape, self._frame, self._rows, self._end)

    def adopt(self, shape: NeuralShape, saved: Mapping[str, Tensor]) -> None:
        """Start from the weights of another fit of the same members, which may have more outputs.

        Args:
            shape: layout of the other fit
            saved: result of its `capture_state`
        """
        rows = torch.cat(
            [torch.arange(p.start, p.stop) for n, p in shape.outputs.items() if n in self.shape.outputs]
        )
        for name, tensor in self._learned.items():
            source = saved[f"learned.{name}"]
            tensor.data.copy_(source[rows] if name.startswith("heads.") else source)
        self._frame["spread"] = saved["frame.spread"][rows].clone()
        self.steps = 1  # from here on, `scale_to` preserves the network's offsets

    def field(self, recorded: tuple[float, ...] = ()) -> NeuralField:
        """Return the network in stored form: weights in float16, codes in int8."""
        learned = {name: tensor.detach().half() for name, tensor in self._learned.items() if name != "codes"}
        codes = self._learned.get("codes", torch.zeros(len(self._rows), 0)).detach()
        stored, step = quantize_bases(codes[None], torch.int8)
        return NeuralField(self.shape, {**learned, **self._frame}, self._end, stored[0], step[0], recorded)


def _initial_frame(shape: NeuralShape, rows: Tensor) -> dict[str, Tensor]:
    """Return the box of the region, and initial scales that `scale_to` replaces."""
    frame = {name: torch.zeros(size) for name, size in shape.frame().items()}
    extent = torch.tensor(1.0)
    if len(rows):
        low = rows[:, :3].amin(dim=0)
        high = rows[:, :3].amax(dim=0)
        frame["center"] = (low + high) / 2
        extent = (high - low).amax() / 2
    frame["extent"] = extent if float(extent) > 1e-12 else torch.tensor(1.0)
    frame["look_spread"] = torch.ones_like(frame["look_spread"])
    frame["spread"] = torch.ones(len(shape.columns))
    return frame


def _initial_weights(shape: NeuralShape, draws: torch.Generator) -> dict[str, Tensor]:
    """Return initial weights (He initialization, 2015).

    The heads are 0. So the field starts as the straight line to the end ("own"), or as no change
    ("position").
    """
    weights = {}
    for name, size in shape.weights().items():
        if name == "control":
            weights[name] = torch.randn(size, generator=draws)
        elif name.startswith("layers.") and len(size) == 2:
            weights[name] = torch.randn(size, generator=draws) * math.sqrt(2.0 / size[1])
        else:
            weights[name] = torch.zeros(size)
    return weights


def train_network(
    fit: NeuralFit,
    strengths: Tensor,
    offsets: Tensor,
    steps: int,
    pictures: PictureLoss | None = None,
    on_step: Callable[[int, float], None] | None = None,
) -> None:
    """Take `steps` steps with a learning rate that falls to 0 along half a cosine."""
    for done in range(steps):
        factor = 0.5 * (1.0 + math.cos(math.pi * done / steps))
        loss = fit.step(strengths, offsets, factor, pictures)
        if on_step is not None:
            on_step(done + 1, loss)


def rendered_importance(offsets: Tensor, render: Callable[[Tensor], Tensor]) -> dict[str, float]:
    """Return the visible effect of an error in each attribute at half strength; the values sum to 1.

    The error is proportional to the attribute's spread (root mean square of its offsets).

    Args:
        offsets: offsets along the slider. [T,M,C]
        render: renders the pixels of some views. [M,C] -> [P,3]
    """
    draws = torch.Generator().manual_seed(0)
    middle = offsets[len(offsets) // 2].float()
    importance = {}
    with torch.no_grad():
        expected = render(middle)
        for name, columns in moving_attributes(offsets).items():
            spread = float(offsets[1:, :, columns].float().square().mean().sqrt())
            moved = middle.clone()
            moved[:, columns] += 0.1 * spread * torch.randn(moved[:, columns].shape, generator=draws)
            importance[name] = float((render(moved) - expected).square().mean()) if len(expected) else 1.0
    total = sum(importance.values())
    return {name: value / total if total > 0 else 1.0 / len(importance) for name, value in importance.items()}
