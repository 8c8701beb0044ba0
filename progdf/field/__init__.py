"""Gaussian differential field: (member, slider value) → offset of every raw parameter."""

from __future__ import annotations

from .bake import bake_network
from .baked import AttributeBases, BakedField, NeuralForm
from .choose import Candidate, FieldChoice, FieldEvaluator, choose_field
from .neural import NeuralField
from .neural_fit import NeuralSettings
from .separable import fit_keyframes, fit_separable

__all__ = [
    "AttributeBases",
    "BakedField",
    "Candidate",
    "FieldChoice",
    "FieldEvaluator",
    "NeuralField",
    "NeuralForm",
    "NeuralSettings",
    "bake_network",
    "choose_field",
    "fit_keyframes",
    "fit_separable",
]
