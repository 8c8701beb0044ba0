"""Several edits on one scene: Θ = Θ0 + blend over the enabled layers of m · gain · Δ(s)."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from progdf.checkpoint import Gdf

BLENDS = ("normalised", "sum", "over")


@dataclass(frozen=True)
class Gains:
    """How much of each kind of change a layer lets through; 1 is the edit as trained, 0 none."""

    geometry: float = 1.0
    opacity: float = 1.0
    colour: float = 1.0


@dataclass(frozen=True)
class Layer:
    """One edit in the stack.

    Args:
        gdf: the edit
        strength: slider value s, 0..1; above 1 is extrapolation
        enabled: a disabled layer does nothing at all
        gains: per-attribute gains
        weights: soft membership times painted weight per member, 0..1; None is 1 everywhere. [M] float32
    """

    gdf: Gdf
    strength: float = 1.0
    enabled: bool = True
    gains: Gains = Gains()
    weights: Tensor | None = None
