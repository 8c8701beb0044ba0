"""Small networks of one small scene, trained once, that tests share."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import torch
from torch import Tensor

from progdf.field import BakedField, NeuralField, NeuralSettings, bake_network, fit_neural
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


@cache
def network(form: str = "own", moving: tuple[str, ...] = ("means", "sh0")) -> NeuralField:
    strengths, offsets = curved_trajectory(MEMBERS, moving=moving)
    return fit_neural(strengths, offsets, rows(), FORMS[form])


@cache
def baked(form: str = "own") -> BakedField:
    return bake_network(network(form), rows())


def smooth_trajectory(places: Tensor) -> tuple[Tensor, Tensor]:
    """Strengths and offsets of members whose colors change as a smooth function of their place."""
    strengths = torch.linspace(0, 1, 9)
    offsets = torch.zeros(9, len(places), 14)
    wave = torch.sin(places)
    bend = torch.cos(places)
    offsets[:, :, 11:14] = (
        strengths[:, None, None] * wave + torch.sin(torch.pi * strengths)[:, None, None] * bend
    )
    offsets[0], offsets[-1, :, 11:14] = 0.0, wave
    return strengths, offsets
