"""What a person stacks on a scene: edits, each with a strength, gains and weights; and what a change of the
stack makes another of."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import msgspec
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf

BLENDS = ("normalized", "sum", "over", "adjust")
"""How layers that share a Gaussian go together; see `progdf.compose.reference.compose_layers`."""

ORDERED = ("over", "adjust")
"""Those where it counts which layer lies on top."""

KINDS = {
    "means": "geometry",
    "log_scales": "geometry",
    "quats": "geometry",
    "logit_opacities": "opacity",
    "sh0": "color",
    "shN": "color",
}
"""Attribute name -> the gain that scales its change."""


_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


@dataclass(frozen=True)
class Gains:
    """How much of each kind of change a layer lets through; 1 is the edit as trained, 0 none."""

    geometry: _Share = 1.0
    opacity: _Share = 1.0
    color: _Share = 1.0


@dataclass(frozen=True)
class Layer:
    """One edit in the stack."""

    gdf: Gdf  # the edit
    strength: float = 1.0  # slider value s, 0..1; above 1 is extrapolation
    enabled: bool = True  # a disabled layer does nothing at all
    gains: Gains = Gains()  # per-attribute gains
    # soft membership times painted weight per member, 0..1; None is 1 everywhere. [M] float32
    weights: Tensor | None = None

    @property
    def active(self) -> bool:
        """Whether the layer can change anything: enabled, and its slider off the stop at 0."""
        return self.enabled and self.strength != 0.0

    @property
    def clamped_strength(self) -> float:
        """The strength without its overshoot, 0..1."""
        return min(max(self.strength, 0.0), 1.0)

    @property
    def kinds(self) -> frozenset[str]:
        """The kinds of change that the edit makes, see `KINDS`."""
        return frozenset(KINDS[name] for name in self.gdf.field.attributes)

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
    shape = list(layer.weights.shape)
    members = len(layer.gdf.region)
    if shape != [members]:
        raise ValueError(f"weights of {layer.gdf.name} has shape {shape}, expected [{members}]")
    if members and not (float(layer.weights.min()) >= 0.0 and float(layer.weights.max()) <= 1.0):
        raise ValueError(f"weights of {layer.gdf.name} has a number outside 0..1")


Effect = tuple[tuple[float, Gains, Tensor | None, int, int], ...]
"""An edit's part, per layer: strength, gains, weights, their version, place in the stack where it counts."""


@dataclass(frozen=True)
class Effects:
    """The parts of all edits under one blend rule; an edit that does nothing is absent."""

    blend: str = "normalized"
    of: Mapping[int, Effect] = field(default_factory=dict)


def effects_of(stack: Sequence[tuple[int, Layer]], blend: str) -> Effects:
    """The effects of active layers, lowest first, each with the index of its edit."""
    effects: dict[int, Effect] = {}
    for index, (edit, layer) in enumerate(stack):
        version = -1 if layer.weights is None else layer.weights._version
        order = index if blend in ORDERED else 0
        entry = (layer.strength, layer.gains, layer.weights, version, order)
        effects[edit] = (*effects.get(edit, ()), entry)
    return Effects(blend, effects)


def changed_edits(before: Effects, now: Effects) -> frozenset[int]:
    """Indices of the edits whose members may differ; weights are compared by identity and version."""
    return frozenset(
        edit
        for edit in {*before.of, *now.of}
        if now.blend != before.blend or not _same(before.of.get(edit, ()), now.of.get(edit, ()))
    )


def _same(before: Effect, now: Effect) -> bool:
    return len(before) == len(now) and all(
        a[:2] == b[:2] and a[2] is b[2] and a[3:] == b[3:] for a, b in zip(before, now, strict=True)
    )
