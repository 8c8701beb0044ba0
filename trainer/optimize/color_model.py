"""Model of a color edit: its size, its solution for the finished edit, and the candidates of the choice."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from progdf.system.equality import equal_fields
from trainer.quality import BALANCED, QualityLimits

# ridges to try with ties: spread the residual everywhere, some way, or to neighbors only
TIED_RIDGES = (1e-8, 1e-5, 1e-3)


@dataclass(frozen=True)
class Model:
    """Size of the model of a color edit, and its solution for the finished edit."""

    __eq__ = equal_fields

    degree: int  # degree of the map; 0: no map
    hold: float  # ridge of the residual, as a share of a typical member's weight
    residual: Tensor  # residual of the finished edit with b = 0, 1, 4 or 9 functions. [M,b,3]
    mask: Tensor | None  # see `GradeForm.mask`
    error: float  # mean squared error of the finished edit in held-out views; smaller errors are not pursued
    tried: Sequence[tuple[str, float]]  # name of each candidate, and its PSNR on held-out views, dB
    steps: int  # steps of all candidates
    most_bands: int  # see `choose_model`; 1 if there are few pictures
    map_error: float = math.inf  # mean squared error of the map alone; infinite if not tried
    limits: QualityLimits = BALANCED
    begun: Mapping[float, Tensor] = field(default_factory=dict)  # strength → initial residual. [M,b,3]

    @property
    def bands(self) -> int:
        """Number of SH functions of the residual."""
        return self.residual.shape[1]

    @property
    def functions(self) -> float:
        """Mean number of nonzero SH functions per member."""
        return float(self.residual.any(dim=2).float().sum(dim=1).mean()) if self.bands else 0.0

    def figures(self) -> dict[str, Any]:
        """Return the model's figures for report.json."""
        return {
            "degree": self.degree,
            "mask": self.mask is not None,
            "sh_functions": self.bands,
            "functions_per_gaussian": round(self.functions, 2),
            "tried_psnr": {name: round(error, 2) for name, error in self.tried},
        }

    @property
    def line(self) -> str:
        """Description of the choice and its candidates, for the log."""
        parts = [f"color map of degree {self.degree}" if self.degree else "no color map"]
        if self.mask is not None:
            parts.append("mask")
        if self.bands:
            functions = f"{self.bands} SH functions" if self.bands > 1 else f"{self.bands} SH function"
            if self.bands > 1 and self.functions < self.bands:
                functions += f" ({self.functions:.1f} per Gaussian on average)"
            parts.append(f"residual of {functions}")
        candidates = ", ".join(f"{name} {error:.1f}" for name, error in self.tried)
        rule = self.limits.rule
        if self.hold in TIED_RIDGES:  # a mask or residual that gains little here may color the members beyond
            rule = "smallest error; with few pictures --quality sets the packing only"
        return f"{' + '.join(parts)}. Candidates, held-out dB: {candidates}. Rule: {rule}"
