"""One row per method of training: ours, and the paper's as printed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

from torch import Tensor

from progdf.field import NeuralSettings
from trainer.fit.fit import visibility
from trainer.fit.network import network_settings
from trainer.optimize import losses, pgs
from trainer.optimize.pgs import DescentTask, OnStep, ParameterSnapshot, PgsState
from trainer.options import FieldOptions, Kind, OptimizeOptions, Preset
from trainer.paper import descent as paper_descent
from trainer.paper import losses as paper_losses
from trainer.paper.network import JointTraining, as_printed, begin_joint_training
from trainer.views.boxes import Pictures, widen_views
from trainer.views.setup import TrainingSetup


@dataclass(frozen=True)
class Method:
    """Answers to every question about a method of training.

    The color solver is no part of it: `trainer.resolve.resolve_kind` selects it instead of a descent.
    """

    # Returns the setup with training views whose boxes the loss covers, from the edited training views.
    box_views: Callable[[TrainingSetup, Pictures], TrainingSetup]
    # Returns the learning rate of each column: kind, number of columns, size of the moving object. [C]
    learning_rates: Callable[[Kind, int, float], Tensor]
    # Optimizes the members from a state that is changed in place, and yields recordings.
    descend: Callable[[DescentTask, PgsState, OnStep], Iterator[ParameterSnapshot]]
    # Returns a description of the loss. Second argument: name of the perceptual distance
    describe_loss: Callable[[OptimizeOptions, str], str]
    # Returns the network of --field neural, and the length of its training.
    network_settings: Callable[[FieldOptions], NeuralSettings]
    # Returns the network that is trained jointly with the descent, if any.
    begin_network: Callable[[FieldOptions, DescentTask], JointTraining | None]
    kinds_differ: bool  # the kind of an edit decides which attributes move, so an unknown kind needs a trial
    cleans: bool  # drop idle attributes and jitter of the recording, or take a straight line if it is as good


def _begin_no_network(options: FieldOptions, task: DescentTask) -> None:
    """Return None: the field is fitted to the finished recording."""


def _printed_network(options: FieldOptions) -> NeuralSettings:
    """Return the settings of the paper's network."""
    return as_printed(network_settings(options))


def _begin_printed_network(options: FieldOptions, task: DescentTask) -> JointTraining | None:
    """Return the paper's network, unless another field replaces it."""
    if options.field != "neural":
        return None
    setup = task.setup
    seen = visibility(setup.scene, setup.region.members, setup.train)
    return begin_joint_training(options, _printed_network(options), task, seen)


METHODS: Mapping[Preset, Method] = {
    "default": Method(
        box_views=widen_views,
        learning_rates=pgs.learning_rates,
        descend=pgs.descend,
        describe_loss=losses.describe_loss,
        network_settings=network_settings,
        begin_network=_begin_no_network,
        kinds_differ=True,
        cleans=True,
    ),
    "paper": Method(
        box_views=paper_descent.whole_views,
        learning_rates=paper_descent.learning_rates,
        descend=paper_descent.descend,
        describe_loss=paper_losses.describe_loss,
        network_settings=_printed_network,
        begin_network=_begin_printed_network,
        kinds_differ=False,
        cleans=False,
    ),
}
"""Methods by the preset that selects them."""
