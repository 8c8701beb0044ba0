"""A run's neural field: trained while PGS runs, on the recorded trajectory, or both, and baked.

`--field auto` does not try it: at the default target it does not arrive (docs/experiments.md, Networks).
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
from trainer.setup import TrainingSetup, probe_views
from trainer.store.progress import RunLog
from trainer.store.state import Saved, StateFolder
from trainer.views.crops import CropScene, crop_scene, render_all

from .evaluate import Evaluator
from .fit import visibility

MAX_SNAPSHOTS = 64
"""Snapshots that a bank keeps; of more, those go that differ least in time from their neighbors."""


class MemoryBank:
    """Snapshots along the slider, in half precision; the original, at 0, is always among them.

    Args:
        members, channels: M and C of the offsets
        most: how many to keep, the original and the newest always, ≥ 3
    """

    def __init__(self, members: int, channels: int, most: int = MAX_SNAPSHOTS) -> None:
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
        self._render = render
        self._pictures = pictures
        self.bank = MemoryBank(fit.members, channels)
        self._strengths = self.bank.strengths
        self._offsets = self.bank.offsets

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
        self._strengths = self.bank.strengths
        self._offsets = self.bank.offsets


PART = "network"
"""Of the saved state: a network that was trained jointly, once the trajectory is recorded."""

_FINISHING = 0.5
"""Of the steps of a network that was not trained jointly: to follow the re-timed trajectory. One that was
trained on pictures is left as it is, as in the paper."""
PICTURE_STEPS = 1500
"""Of a network that is trained on pictures after the recording: as many as the paper's take beside it."""


@dataclass(frozen=True)
class NetworkFit:
    """A neural field as a run ships it."""

    field: BakedField  # baked, with the network as its origin
    unbaked: tuple[float, ...]  # PSNR of the network's own answers over the slider, its ends not pinned, dB

    def figures(self) -> dict[str, Any]:
        """For report.json."""
        curve = self.unbaked
        form = self.field.origin
        assert isinstance(form, NeuralForm)
        return {
            "unbaked": {"psnr_mean": round(sum(curve) / len(curve), 2), "psnr_worst": round(min(curve), 2)},
            "bake_error": dict(form.error or {}),
            "baked_bytes_per_gaussian": round(self.field.baked_bytes_per_member, 1),
        }


def network_settings(options: FieldOptions) -> NeuralSettings:
    """What the options say of the network, as it is trained."""
    steps = PICTURE_STEPS if options.field_loss == "pictures" else EFFORT[options.size][0]
    steps = steps // 3 if options.draft else steps
    if options.as_printed:
        return NeuralSettings(options.size, "position", 0, "hard", steps, seed=options.seed)
    # What the Gaussian looks like and where it ends, beside its position: 38 dB instead of 34 at no cost; a
    # byte each for eight learned numbers, for what its position does not tell; between hard bins edits jump.
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
    """The network that is trained jointly with PGS.

    Args:
        options, optimize: resolved
        setup: scene, region, views
        rates: learning rates of PGS; what has none does not move. [C]
        stages: of PGS
        crops: the training views, for a loss of pictures
        perceptual: for the same
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
    """Save the network for the end of the run, when the trajectory is whole."""
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
        trajectory: what was recorded
        setup: scene, region, views
        seen: training views, which tell how much each attribute shows
        reporting: held-out views on which errors are taken
        weights: how visible each member is. [M]
        options: resolved
        perceptual: for the loss of pictures
        log: of the run
        begun: what `save_network` saved

    Raises:
        ProgdfError: the edit moves nothing, or the training breaks down.
    """
    offsets = trajectory.nodes
    attributes = tuple(moving_attributes(offsets))
    if not attributes:
        raise ProgdfError("the edit moves nothing that a network could learn; use --field auto")
    rows = pack(setup.scene[setup.region.members])
    settings = network_settings(options)
    fit = NeuralFit(rows, offsets.shape[2], attributes, settings, weights)
    steps = fit.settings.steps
    if begun is not None:
        layout = begun.values["shape"]
        fit.adopt(NeuralShape(**layout | {"attributes": tuple(layout["attributes"])}), begun.tensors)
        steps = 0 if options.field_loss == "pictures" else round(_FINISHING * steps)
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
    """The loss of pictures in all training views."""
    members = setup.region.members
    crops = [crop_scene(setup.scene, members, v.camera, v.box, setup.background) for v in setup.train]
    rows = pack(setup.scene[members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    return RenderedLoss(crops, rows, tuple(moving_attributes(trajectory.end[None])), perceptual)


@dataclass(frozen=True)
class RenderedLoss:
    """L_GDF = L_pred + L_render: L1 + LPIPS between the renders of Θ0 + GDF(s) and of the snapshot at s, and
    −(∇²R)² of the former. A `PictureLoss`.
    """

    crops: Sequence[CropScene]  # the training views
    rows: Tensor  # raw values of the members before the edit, packed. [M,C]
    moving: Collection[str]  # attributes that differ from these
    perceptual: Perceptual  # LPIPS, or what stands in for it

    @property
    def views(self) -> int:
        """In how many views."""
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
    """How much an error of one spread in each attribute shows in pictures, half way; these add up to 1.

    Args:
        offsets: [T,M,C]
        render: pixels of some views
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
