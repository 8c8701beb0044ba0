"""The Gaussian differential field: (member, slider value) → offset of every raw parameter."""

from __future__ import annotations

from progdf.field.bake import NeuralForm, baked_neural
from progdf.field.baked import AttributeBases, BakedField
from progdf.field.choose import Choice, choose_field
from progdf.field.floor import PositionFloor, position_floor
from progdf.field.judge import Candidate, FieldJudge
from progdf.field.keyframes import fit_keyframes, fit_lossless
from progdf.field.neural import NeuralField
from progdf.field.neural_fit import NeuralSettings, fit_neural
from progdf.field.separable import fit_separable

__all__ = [
    "AttributeBases",
    "BakedField",
    "Candidate",
    "Choice",
    "FieldJudge",
    "NeuralField",
    "NeuralForm",
    "NeuralSettings",
    "PositionFloor",
    "baked_neural",
    "choose_field",
    "fit_keyframes",
    "fit_lossless",
    "fit_neural",
    "fit_separable",
    "position_floor",
]
