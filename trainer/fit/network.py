"""A run's neural field: begun while PGS runs or after it, finished on the recorded trajectory, baked.

`--field auto` does not try it: at the default target it does not arrive (docs/experiments.md, Networks).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field import BakedField, NeuralSettings, bake_network
from progdf.field.evaluate import FieldEvaluator
from progdf.field.neural import Bins, Inputs, NeuralShape, Size
from progdf.field.neural_fit import EFFORT, NeuralFit, PictureLoss
from progdf.field.neural_training import train_network
from progdf.field.rendered import rendered_importance
from progdf.field.separable import moving_attributes
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, attribute_slices, pack
from trainer.optimize.losses import Perceptual, l1
from trainer.optimize.pgs import TargetStage
from trainer.optimize.settings import resolve_slider
from trainer.options import Slider
from trainer.setup.training_setup import TrainingSetup, probe_views
from trainer.store.progress import RunLog
from trainer.store.state import Saved, StateFolder
from trainer.views.crops import crop_scene, render_all

from .evaluate import Evaluator
from .fit import visibility
from .memory_bank import JointTraining

PART = "network"
"""Of the saved state: a network that was trained jointly, once the trajectory is recorded."""

_FINISHING = 0.5  # of the steps that a network takes which was not trained jointly


@dataclass(frozen=True)
class NetworkPlan:
    """The network of a neural field.

    Args:
        size, picture_loss: see `TrainOptions`
        inputs, bins, code: see `trainer.presets.Constants`
        draft: a third of the steps
        seed: of its weights and draws
    """

    size: Size
    inputs: Inputs
    bins: Bins
    code: int
    picture_loss: float
    draft: bool
    seed: int


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


def network_settings(plan: NetworkPlan) -> NeuralSettings:
    """What the plan says of the network, as it is trained."""
    steps = EFFORT[plan.size][0] // 3 if plan.draft else 0
    return NeuralSettings(plan.size, plan.inputs, plan.code, plan.bins, steps, seed=plan.seed)


def begin_joint_training(
    network: NetworkPlan,
    slider: Slider,
    setup: TrainingSetup,
    rates: Tensor,
    stages: Sequence[TargetStage],
) -> JointTraining:
    """The network that is trained jointly with PGS.

    Args:
        network: see `NetworkPlan`
        slider: what slider values will mean
        setup: scene, region, views
        rates: learning rates of PGS; what has none does not move. [C]
        stages: of PGS
    """
    channels = len(rates)
    slices = attribute_slices(channels)
    attributes = tuple(name for name, columns in slices.items() if bool((rates[columns] > 0).any()))
    rows = pack(setup.scene[setup.region.members], with_shN=channels > BASE_CHANNELS)
    settings = network_settings(network)
    seen = visibility(setup.scene, setup.region.members, setup.train)
    small = probe_views(setup)

    def render(offsets: Tensor) -> Tensor:
        return torch.cat(
            [picture.reshape(-1, 3) for picture in render_all(small, rows + offsets, attributes)]
        )

    strengths, steps = [stage.strength for stage in stages], [stage.steps for stage in stages]
    if resolve_slider(slider, strengths) == "even":
        strengths = [(i + 1) / len(stages) for i in range(len(stages))]
    return JointTraining(
        NeuralFit(rows, channels, attributes, settings, seen), channels, strengths, steps, render
    )


def save_network(joint: JointTraining, folder: StateFolder) -> None:
    """Save the network for the end of the run, when the trajectory is whole."""
    folder.save(PART, joint.fit.capture_state(), {"shape": asdict(joint.fit.shape)})


def fit_network(
    trajectory: Trajectory,
    setup: TrainingSetup,
    seen: Evaluator,
    evaluator: Evaluator,
    weights: Tensor,
    plan: NetworkPlan,
    perceptual: Perceptual,
    log: RunLog,
    begun: Saved | None = None,
) -> NetworkFit:
    """Train a network on a trajectory, or finish one that was trained jointly, and bake it.

    Args:
        trajectory: what was recorded
        setup: scene, region, views
        seen: training views, which tell how much each attribute shows
        evaluator: held-out views
        weights: how visible each member is. [M]
        plan: see `NetworkPlan`
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
    settings = network_settings(plan)
    fit = NeuralFit(rows, offsets.shape[2], attributes, settings, weights)
    steps = fit.settings.steps
    if begun is not None:
        layout = begun.values["shape"]
        fit.adopt(NeuralShape(**layout | {"attributes": tuple(layout["attributes"])}), begun.tensors)
        steps = round(_FINISHING * steps)
    fit.scale_to(offsets, rendered_importance(offsets, seen.counted_pixels))
    weight = plan.picture_loss
    pictures = _picture_loss(setup, trajectory, perceptual, weight, settings.seed) if weight > 0 else None
    try:
        with log.steps("field", steps) as advance:
            train_network(
                fit, trajectory.s, offsets, steps, pictures, lambda n, loss: advance(n, f"loss {loss:.5f}")
            )
    except FloatingPointError as error:
        raise ProgdfError(f"{error}; try another --size, or --field auto") from error
    network = fit.field(tuple(float(s) for s in trajectory.s))
    errors = FieldEvaluator(trajectory.s, offsets, evaluator.counted_pixels)
    return NetworkFit(
        bake_network(network, rows, trajectory.at, evaluator.counted_pixels),
        errors.curve(network.bind(rows)),
    )


def _picture_loss(
    setup: TrainingSetup, trajectory: Trajectory, perceptual: Perceptual, weight: float, seed: int
) -> PictureLoss:
    """L_pred of ProGDF: L1 + LPIPS between the field's and the recording's picture of a random view."""
    members = setup.region.members
    crops = [crop_scene(setup.scene, members, v.camera, v.box, setup.background) for v in setup.train]
    rows = pack(setup.scene[members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    moving = tuple(moving_attributes(trajectory.end[None]))
    draws = torch.Generator().manual_seed(seed)

    def loss(found: Tensor, recorded: Tensor) -> Tensor:
        view = crops[int(torch.randint(len(crops), (1,), generator=draws))]
        with torch.no_grad():
            expected, _ = view.render(rows + recorded, moving)
        image, _ = view.render(rows + found, moving)
        return weight * (l1(image, expected) + perceptual(image, expected))

    return loss
