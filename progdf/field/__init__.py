"""The Gaussian differential field: (member, slider value) → offset of every raw parameter."""

from __future__ import annotations

from progdf.field.baked import AttributeBases, BakedField
from progdf.field.choose import Choice, choose_field
from progdf.field.judge import Candidate, FieldJudge
from progdf.field.keyframes import fit_keyframes
from progdf.field.separable import fit_separable

__all__ = [
    "AttributeBases",
    "BakedField",
    "Candidate",
    "Choice",
    "FieldJudge",
    "choose_field",
    "fit_keyframes",
    "fit_separable",
]
