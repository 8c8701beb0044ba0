"""Small networks of one small scene, trained once and shared by tests."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from progdf.field import BakedField, NeuralField, NeuralSettings, bake_network
from progdf.field.neural_fit import NeuralFit, train_network
from progdf.field.separable import check_trajectory, moving_attributes
from progdf.gaussians import Gaussians, pack
from tests.helpers.edits import curved_trajectory, some_rows
from tests.helpers.scenes import random_gaussians

MEMBERS = 40
SHORT = NeuralSettings(steps=40, batch=64, code=3)
FORMS = {
    "own": SHORT,
    "own, hard bins": replace(SHORT, bins="hard"),
    "position": replace(SHORT, inputs="position", code=0),
    "position, hard bins": replace(SHORT, inputs="position", code=0, bins="hard"),
}


@cache
def scene() -> Gaussians:
    return random_gaussians(300, seed=1, sh_degree=1)


@cache
def members() -> Tensor:
    return some_rows(scene(), MEMBERS)


def rows() -> Tensor:
    return pack(scene()[members()])


def fit_neural(
    strengths: Tensor,
    offsets: Tensor,
    rows: Tensor,
    settings: NeuralSettings,
    visibility: Tensor | None = None,
) -> NeuralField:
    """Return a neural field of a finished trajectory.

    Args:
        strengths: strengths of the snapshots. [T]
        offsets: offsets of the members. [T,M,C]
        rows: raw rows of the members. [M,≥14]
        settings: settings of the network and its training
        visibility: weight of each member. [M]
    """
    check_trajectory(strengths, offsets)
    fit = NeuralFit(rows, offsets.shape[2], tuple(moving_attributes(offsets)), settings, visibility)
    fit.scale_to(offsets)
    train_network(fit, strengths, offsets, settings.steps)
    return fit.field(tuple(strengths.tolist()))


@cache
def network(form: str = "own", moving: tuple[str, ...] = ("means", "sh0")) -> NeuralField:
    strengths, offsets = curved_trajectory(MEMBERS, moving=moving)
    return fit_neural(strengths, offsets, rows(), FORMS[form])


@cache
def baked(form: str = "own") -> BakedField:
    return bake_network(network(form), rows())


def smooth_trajectory(places: Tensor) -> tuple[Tensor, Tensor]:
    """Return strengths and offsets of members whose colors change as a smooth function of position."""
    strengths = torch.linspace(0, 1, 9)
    offsets = torch.zeros(9, len(places), 14)
    wave = torch.sin(places)
    bend = torch.cos(places)
    offsets[:, :, 11:14] = (
        strengths[:, None, None] * wave + torch.sin(torch.pi * strengths)[:, None, None] * bend
    )
    offsets[0] = 0.0
    offsets[-1, :, 11:14] = wave
    return strengths, offsets
