"""A run's neural field: trained while PGS runs, on the recorded trajectory, or both, and baked.

`--field auto` does not try it: at the default target it does not arrive (docs/experiments.md, Networks).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field import BakedField, NeuralSettings, bake_network
from progdf.field.evaluate import FieldEvaluator
from progdf.field.neural import NeuralShape
from progdf.field.neural_fit import EFFORT, NeuralFit
from progdf.field.neural_training import train_network
from progdf.field.rendered import rendered_importance
from progdf.field.separable import moving_attributes
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, attribute_slices, pack
from trainer.optimize.losses import Perceptual, l1, sharpness
from trainer.optimize.pgs import TargetStage
from trainer.optimize.retime import resolve_slider
from trainer.options import FieldOptions, OptimizeOptions
from trainer.setup.training_setup import TrainingSetup, probe_views
from trainer.store.progress import RunLog
from trainer.store.state import Saved, StateFolder
from trainer.views.crops import CropScene, crop_scene, render_all

from .evaluate import Evaluator
from .fit import visibility
from .memory_bank import JointTraining

PART = "network"
"""Of the saved state: a network that was trained jointly, once the trajectory is recorded."""

_FINISHING = 0.5
"""Of the steps of a network that was not trained jointly: to follow the re-timed trajectory. One that was
trained on pictures is left as it is, as in the paper."""
PICTURE_STEPS = 1500
"""Of a network that is trained on pictures after the recording: as many as the paper's take beside it."""


@dataclass(frozen=True)
class NetworkFit:
    """A neural field as a run ships it.

    Args:
        field: baked, with the network as its origin
        unbaked: PSNR of the network's own answers over the slider, its ends not pinned, dB
    """

    field: BakedField
    unbaked: tuple[float, ...]

    def figures(self) -> dict[str, Any]:
        """For report.json."""
        curve, form = self.unbaked, self.field.origin
        assert form is not None
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

    strengths, steps = [stage.strength for stage in stages], [stage.steps for stage in stages]
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
    offsets = torch.stack([trajectory.node(i) for i in range(len(trajectory))])
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
    −∇²R of the former. A `PictureLoss`.

    Args:
        crops: the training views
        rows: raw values of the members before the edit, packed. [M,C]
        moving: attributes that differ from these
        perceptual: LPIPS, or what stands in for it
    """

    crops: Sequence[CropScene]
    rows: Tensor
    moving: Collection[str]
    perceptual: Perceptual

    @property
    def views(self) -> int:
        """In how many views."""
        return len(self.crops)

    def __call__(self, found: Tensor, recorded: Tensor, view: int) -> Tensor:
        """See `PictureLoss`. [M,C], [M,C] -> []"""
        crop = self.crops[view]
        with torch.no_grad():
            expected, _ = crop.render(self.rows + recorded, self.moving)
        image, _ = crop.render(self.rows + found, self.moving)
        predicted = l1(image, expected) + self.perceptual(image, expected)
        return predicted + sharpness(image, expected, "paper")
