"""Neural field of a run: trained jointly with PGS, on the recorded trajectory, or both, then baked.

`--field auto` does not try it, as it misses the default target (docs/lab/experiments.md, Networks).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field import BakedField, NeuralSettings, bake_network
from progdf.field.baked import NeuralForm, interpolate_at
from progdf.field.choose import FieldEvaluator, Render
from progdf.field.neural import NeuralShape
from progdf.field.neural_fit import EFFORT, NeuralFit, PictureLoss, train_network
from progdf.field.separable import moving_attributes
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, attribute_slices, pack
from trainer.optimize.losses import Perceptual, l1, sharpness
from trainer.optimize.pgs import TargetStage
from trainer.optimize.retime import resolve_slider
from trainer.options import FieldOptions, OptimizeOptions
from trainer.store.progress import RunLog
from trainer.store.state import Saved, StateFolder
from trainer.views.boxes import probe_views
from trainer.views.crops import CropScene, crop_scene, render_all
from trainer.views.setup import TrainingSetup

from .evaluate import Evaluator
from .fit import visibility

MAX_SNAPSHOTS = 64
"""Snapshots that a bank keeps; beyond that, the one closest to its neighbors on the slider is dropped."""


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
        """Return the provisional slider value of a PGS step, linear in time within its stage."""
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


PART = "network"
"""Name of the saved part with a jointly trained network, after the trajectory is recorded."""

_FINISHING_SHARE = 0.5
"""Share of the usual steps that adapts a jointly trained network to the retimed trajectory. A network trained
on pictures stays unchanged, as in the paper."""
PICTURE_STEPS = 1500
"""Steps of a network trained on pictures after the recording, as many as the paper's joint training takes."""


@dataclass(frozen=True)
class NetworkFit:
    """Neural field as shipped by a run."""

    field: BakedField  # baked, with the network as its origin
    unbaked: tuple[float, ...]  # PSNR of the network's output over the slider, without pinned ends, dB

    def figures(self) -> dict[str, Any]:
        """Return the figures for report.json."""
        curve = self.unbaked
        form = self.field.origin
        assert isinstance(form, NeuralForm)
        return {
            "unbaked": {"psnr_mean": round(sum(curve) / len(curve), 2), "psnr_worst": round(min(curve), 2)},
            "bake_error": dict(form.error or {}),
            "baked_bytes_per_gaussian": round(self.field.baked_bytes_per_member, 1),
        }


def network_settings(options: FieldOptions) -> NeuralSettings:
    """Return the network settings that the options describe."""
    steps = PICTURE_STEPS if options.field_loss == "pictures" else EFFORT[options.size][0]
    steps = steps // 3 if options.draft else steps
    if options.as_printed:
        return NeuralSettings(options.size, "position", 0, "hard", steps, seed=options.seed)
    # "own": the Gaussian's appearance and endpoint as inputs beside its position give 38 dB instead of 34 at
    # no cost. 8: eight learned values, a byte each, for information that the position does not contain.
    # "smooth": edits jump between hard bins.
    return NeuralSettings(options.size, "own", 8, "smooth", steps, seed=options.seed)


def begin_joint_training(
    options: FieldOptions,
    optimize: OptimizeOptions,
    setup: TrainingSetup,
    rates: Tensor,
    stages: Sequence[TargetStage],
    crops: Sequence[CropScene],
    perceptual: Perceptual,
) -> JointTraining:
    """Create the network that is trained jointly with PGS.

    Args:
        options, optimize: resolved
        setup: scene, region, views
        rates: learning rates of PGS; channels with rate 0 do not move. [C]
        stages: stages of PGS
        crops: training views, for a loss on pictures
        perceptual: perceptual distance, for a loss on pictures
    """
    channels = len(rates)
    slices = attribute_slices(channels)
    attributes = tuple(name for name, columns in slices.items() if bool((rates[columns] > 0).any()))
    rows = pack(setup.scene[setup.region.members], with_shN=channels > BASE_CHANNELS)
    settings = network_settings(options)
    seen = visibility(setup.scene, setup.region.members, setup.train)
    small = probe_views(setup)

    def render(offsets: Tensor) -> Tensor:
        return torch.cat(
            [picture.reshape(-1, 3) for picture in render_all(small, rows + offsets, attributes)]
        )

    strengths = [stage.strength for stage in stages]
    steps = [stage.steps for stage in stages]
    if resolve_slider(optimize.slider, strengths) == "even":
        strengths = [(i + 1) / len(stages) for i in range(len(stages))]
    fit = NeuralFit(rows, channels, attributes, settings, seen)
    pictures = None
    if options.field_loss == "pictures":
        pictures = RenderedLoss(crops, rows, attributes, perceptual)
    return JointTraining(fit, channels, strengths, steps, render, pictures)


def save_network(joint: JointTraining, folder: StateFolder) -> None:
    """Save the network for the end of the run, when the trajectory is complete."""
    folder.save(PART, joint.fit.capture_state(), {"shape": asdict(joint.fit.shape)})


def fit_network(
    trajectory: Trajectory,
    setup: TrainingSetup,
    seen: Evaluator,
    reporting: Evaluator,
    weights: Tensor,
    options: FieldOptions,
    perceptual: Perceptual,
    log: RunLog,
    begun: Saved | None = None,
) -> NetworkFit:
    """Train a network on a trajectory, or finish one that was trained jointly on offsets, and bake it.

    Args:
        trajectory: the recorded trajectory
        setup: scene, region, views
        seen: training views, to weight the attributes by their visible effect
        reporting: held-out views on which errors are measured
        weights: visibility of each member. [M]
        options: resolved
        perceptual: perceptual distance, for a loss on pictures
        log: log of the run
        begun: the state saved by `save_network`

    Raises:
        ProgdfError: the edit moves nothing, or the training diverges.
    """
    offsets = trajectory.nodes
    attributes = tuple(moving_attributes(offsets))
    if not attributes:
        raise ProgdfError("the edit changes nothing that a network could learn; use --field auto")
    rows = pack(setup.scene[setup.region.members])
    settings = network_settings(options)
    fit = NeuralFit(rows, offsets.shape[2], attributes, settings, weights)
    steps = fit.settings.steps
    if begun is not None:
        layout = begun.values["shape"]
        fit.adopt(NeuralShape(**layout | {"attributes": tuple(layout["attributes"])}), begun.tensors)
        steps = 0 if options.field_loss == "pictures" else round(_FINISHING_SHARE * steps)
    fit.scale_to(offsets, rendered_importance(offsets, seen.counted_pixels))
    pictures = None
    if options.field_loss == "pictures" and steps:
        pictures = _rendered_loss(setup, trajectory, perceptual)
    try:
        with log.steps("field", steps) as advance:
            train_network(
                fit, trajectory.s, offsets, steps, pictures, lambda n, loss: advance(n, f"loss {loss:.5f}")
            )
    except FloatingPointError as error:
        raise ProgdfError(f"{error}; try another --size, or --field auto") from error
    network = fit.field(tuple(float(s) for s in trajectory.s))
    errors = FieldEvaluator(trajectory.s, offsets, reporting.counted_pixels)
    return NetworkFit(
        bake_network(network, rows, trajectory.at, reporting.counted_pixels),
        errors.curve(network.bind(rows)),
    )


def _rendered_loss(setup: TrainingSetup, trajectory: Trajectory, perceptual: Perceptual) -> RenderedLoss:
    """Return the loss on pictures of all training views."""
    members = setup.region.members
    crops = [crop_scene(setup.scene, members, v.camera, v.box, setup.background) for v in setup.train]
    rows = pack(setup.scene[members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    return RenderedLoss(crops, rows, tuple(moving_attributes(trajectory.end[None])), perceptual)


@dataclass(frozen=True)
class RenderedLoss:
    """The paper's loss L_GDF = L_pred + L_render; a `PictureLoss`.

    L_pred is L1 + LPIPS between the renders of Θ0 + GDF(s) and of the snapshot at s. L_render is −(∇²R)² of
    the former render.
    """

    crops: Sequence[CropScene]  # the training views
    rows: Tensor  # raw values of the members before the edit, packed. [M,C]
    moving: Collection[str]  # attributes that the edit changes
    perceptual: Perceptual  # LPIPS or its substitute

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.crops)

    def __call__(self, found: Tensor, recorded: Tensor, view: int) -> Tensor:
        """See `PictureLoss`. [M,C], [M,C] -> []"""
        crop = self.crops[view]
        with torch.no_grad():
            expected = crop.render(self.rows + recorded, self.moving)
        image = crop.render(self.rows + found, self.moving)
        predicted = l1(image, expected) + self.perceptual(image, expected)
        return predicted + sharpness(image, expected, "paper")


def rendered_importance(offsets: Tensor, render: Render) -> dict[str, float]:
    """Return the visible effect of an error in each attribute at half strength; the values sum to 1.

    The error is proportional to the attribute's spread (root mean square of its offsets).

    Args:
        offsets: offsets along the slider. [T,M,C]
        render: renders the pixels of some views
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
