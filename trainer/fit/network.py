"""Neural field of a run: trained on the recorded trajectory, or adapted to it, then baked.

`--field auto` does not try it, as it misses the default target (docs/lab/experiments.md, Networks).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field import BakedField, NeuralSettings, bake_network
from progdf.field.baked import NeuralForm
from progdf.field.choose import FieldEvaluator
from progdf.field.neural import NeuralShape
from progdf.field.neural_fit import EFFORT, NeuralFit, rendered_importance, train_network
from progdf.field.separable import moving_attributes
from progdf.field.trajectory import Trajectory
from progdf.gaussians import BASE_CHANNELS, pack
from progdf.gdf.file import check_reach
from trainer.optimize.losses import Perceptual
from trainer.options import FieldOptions
from trainer.paper.losses import RenderedLoss
from trainer.store.progress import RunLog
from trainer.store.state import Saved
from trainer.views.crops import crop_scene
from trainer.views.setup import TrainingSetup

from .evaluate import Evaluator

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
    # "own": the Gaussian's appearance and endpoint as inputs beside its position give 38 dB instead of 34 at
    # no cost. 8: eight learned values, a byte each, for information that the position does not contain.
    # "smooth": edits jump between hard bins.
    return NeuralSettings(options.size, "own", 8, "smooth", steps, seed=options.seed)


def fit_network(
    trajectory: Trajectory,
    setup: TrainingSetup,
    seen: Evaluator,
    reporting: Evaluator,
    weights: Tensor,
    options: FieldOptions,
    settings: NeuralSettings,
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
        settings: network and length of its training
        perceptual: perceptual distance, for a loss on pictures
        log: log of the run
        begun: the state saved by `trainer.paper.network.save_network`

    Raises:
        ProgdfError: the edit moves nothing, or the training diverges.
    """
    offsets = trajectory.nodes
    attributes = tuple(moving_attributes(offsets))
    if not attributes:
        raise ProgdfError("the edit changes nothing that a network could learn; use --field auto")
    rows = pack(setup.scene[setup.region.members])
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
    baked = bake_network(network, rows, trajectory.at, reporting.counted_pixels)
    try:
        check_reach(baked)
    except ValueError as error:
        raise ProgdfError(
            f"the network has diverged ({error}); try another --seed, more --steps, or --field auto"
        ) from error
    return NetworkFit(baked, errors.curve(network.bind(rows)))


def _rendered_loss(setup: TrainingSetup, trajectory: Trajectory, perceptual: Perceptual) -> RenderedLoss:
    """Return the loss on pictures of all training views."""
    members = setup.region.members
    crops = [crop_scene(setup.scene, members, v.camera, v.box, setup.background) for v in setup.train]
    rows = pack(setup.scene[members], with_shN=trajectory.end.shape[1] > BASE_CHANNELS)
    return RenderedLoss(crops, rows, tuple(moving_attributes(trajectory.end[None])), perceptual)
