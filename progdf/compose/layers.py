"""What a person stacks on a scene: edits, each with a strength, gains and weights."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf

BLENDS = ("normalized", "sum", "over")
"""How layers that share a Gaussian go together; see `progdf.compose.reference.compose_layers`."""

KINDS = {
    "means": "geometry",
    "log_scales": "geometry",
    "quats": "geometry",
    "logit_opacities": "opacity",
    "sh0": "color",
    "shN": "color",
}
"""Attribute name -> the gain that scales its change."""


@dataclass(frozen=True)
class Gains:
    """How much of each kind of change a layer lets through; 1 is the edit as trained, 0 none."""

    geometry: float = 1.0
    opacity: float = 1.0
    color: float = 1.0


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

    @property
    def active(self) -> bool:
        """Whether the layer can change anything: enabled, and its slider off the stop at 0."""
        return self.enabled and self.strength != 0.0

    @property
    def clamped_strength(self) -> float:
        """The strength without its overshoot, 0..1."""
        return min(max(self.strength, 0.0), 1.0)

    def gain(self, attribute: str) -> float:
        """The gain for an attribute, by its kind."""
        return float(getattr(self.gains, KINDS[attribute]))


def check_layers(layers: Sequence[Layer], blend: str) -> None:
    """Refuse what has no meaning.

    Raises:
        ProgdfError: a strength or gain is not finite, or the blend rule is unknown.
        ValueError: weights do not fit the members, or one is not in 0..1.
    """
    check_numbers(layers, blend)
    for layer in layers:
        check_weights(layer)


def check_numbers(layers: Sequence[Layer], blend: str) -> None:
    """`check_layers` without a look at the weights, which takes no time."""
    if blend not in BLENDS:
        raise ProgdfError(f"unknown blend rule '{blend}'; use one of {', '.join(BLENDS)}")
    for layer in layers:
        if not math.isfinite(layer.strength):
            raise ProgdfError(f"the strength of {layer.gdf.name} is {layer.strength}; use a number, 0 to 1")
        for kind, gain in vars(layer.gains).items():
            if not math.isfinite(gain):
                raise ProgdfError(f"the {kind} gain of {layer.gdf.name} is {gain}; use a number, 0 to 1")


def check_weights(layer: Layer) -> None:
    """The part of `check_layers` that looks at one layer's weights."""
    if layer.weights is None:
        return
    found, members = list(layer.weights.shape), len(layer.gdf.region)
    if found != [members]:
        raise ValueError(f"weights of {layer.gdf.name} has shape {found}, expected [{members}]")
    if members and not (float(layer.weights.min()) >= 0.0 and float(layer.weights.max()) <= 1.0):
        raise ValueError(f"weights of {layer.gdf.name} has a number outside 0..1")
