"""Layer stack: edits with a strength, gains and weights, and detection of the edits that a change affects."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gdf.anchors import NOTHING
from progdf.gdf.file import Gdf
from progdf.gdf.texture import ColorSplit
from progdf.system.equality import equal_fields

BLENDS = ("normalized", "sum", "over", "adjust")
"""Blend rules for layers that share a Gaussian, see `progdf.compose.reference.compose_layers`."""

DEFAULT_BLEND = "adjust"
"""Blend rule of the window, the commands and the Python functions, unless another is named."""

ORDERED = ("over", "adjust")
"""Blend rules for which the order of the layers matters."""

KINDS = {
    "means": "geometry",
    "log_scales": "geometry",
    "quats": "geometry",
    "logit_opacities": "opacity",
    "sh0": "color",
    "shN": "color",
}
"""Kind of change for each attribute, which is the name of its gain. Colors have a second gain, `texture`."""


MAX_TEXTURE = 2.0
"""Largest gain of texture. Gains above 1 exaggerate it."""

_Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


@dataclass(frozen=True)
class Gains:
    """Factors on each kind of change of a layer, 0 to 1; 1 is the edit as trained."""

    geometry: _Share = 1.0
    opacity: _Share = 1.0
    color: _Share = 1.0  # of the map of the region's colors, see `progdf.gdf.texture`
    texture: Annotated[float, msgspec.Meta(ge=0.0, le=MAX_TEXTURE)] = 1.0  # of the remaining change of color


@dataclass(frozen=True)
class Layer:
    """One edit in the stack."""

    __eq__ = equal_fields

    gdf: Gdf  # the edit
    strength: float = 1.0  # slider value s, 0 to 1; values above 1 extrapolate
    enabled: bool = True  # a disabled layer has no effect
    gains: Gains = Gains()  # factors per kind of change
    # soft membership times painted weight per member, 0 to 1; None is 1 everywhere. [M] float32
    weights: Tensor | None = None
    blend: str = ""  # its own blend rule, one of `BLENDS`; "" for that of the stack

    @property
    def active(self) -> bool:
        """True if the layer can have an effect: it is enabled and its strength is not 0."""
        return self.enabled and self.strength != 0.0

    @property
    def clamped_strength(self) -> float:
        """Strength clamped to 0 to 1."""
        return min(max(self.strength, 0.0), 1.0)

    @property
    def kinds(self) -> frozenset[str]:
        """Kinds of change that the edit makes, see `KINDS`."""
        return frozenset(KINDS[name] for name in self.gdf.field.attributes)

    @property
    def pushed_kinds(self) -> frozenset[str]:
        """Kinds of change that only make way for the paint of the edit, see `Anchors.pushes`."""
        return NOTHING if self.gdf.anchors is None else self.gdf.anchors.pushes

    @property
    def leaves_paint(self) -> bool:
        """True if the paint of other edits stays behind, see `Anchors.leaves_paint`."""
        return self.gdf.anchors is not None and self.gdf.anchors.leaves_paint

    @property
    def blended_kinds(self) -> frozenset[str]:
        """Kinds of change that take part in the blend rule."""
        return self.kinds - self.pushed_kinds

    def gain(self, attribute: str) -> float:
        """Return the gain of an attribute."""
        return float(getattr(self.gains, KINDS[attribute]))


def rule_of(layer: Layer, blend: str) -> str:
    """Return the blend rule of a layer in a stack with the rule `blend`."""
    return layer.blend or blend


def is_averaged_alone(layers: Sequence[Layer], blend: str) -> bool:
    """Return whether "normalized" layers lie among layers with other rules, and are averaged alone."""
    rules = {rule_of(layer, blend) for layer in layers}
    return "normalized" in rules and len(rules) > 1


def color_factors(layer: Layer, name: str, split: ColorSplit | None) -> tuple[float, float]:
    """Return the factors of a layer's offsets of an attribute, and of their color part.

    Args:
        layer: the layer
        name: attribute
        split: see `color_split`; it may be None if the gains of color and texture are equal
    """
    gains = layer.gains
    if KINDS[name] != "color" or split is None:
        return layer.gain(name), 0.0
    return gains.texture, 0.0 if split.color is None else gains.color - gains.texture


def needs_split(layer: Layer) -> bool:
    """Return whether the gains of a layer divide its color from its texture."""
    repainted = layer.gdf.paints and (layer.gains.color, layer.gains.texture) != (1.0, 1.0)
    return layer.gains.color != layer.gains.texture or repainted


def disc_changes(layers: Sequence[Layer], splits: Sequence[ColorSplit | None]) -> list[tuple[Gdf, Tensor]]:
    """Return the changes that gains make to the discs of painted layers: the edit, and band 0. [B,3]

    Of two layers of one edit, the stronger one shows, see `progdf.compose.overlap`.

    Args:
        layers: active layers, lowest first
        splits: see `color_split`; None where `needs_split` is false
    """
    strongest: dict[int, tuple[float, Layer, ColorSplit | None]] = {}
    for layer, split in zip(layers, splits, strict=True):
        if not layer.gdf.paints:
            continue
        opacity = layer.clamped_strength * min(abs(layer.gains.opacity), 1.0)
        known = strongest.get(id(layer.gdf))
        if known is None or opacity >= known[0]:
            strongest[id(layer.gdf)] = opacity, layer, split
    changes = []
    for _, layer, split in strongest.values():
        if split is not None and split.discs is not None:
            color, texture = layer.gains.color, layer.gains.texture
            change = (texture - 1.0) * split.discs.change + (color - texture) * split.discs.color
            changes.append((layer.gdf, change))
    return changes


def check_layers(layers: Sequence[Layer], blend: str) -> None:
    """Check strengths, gains, weights and the blend rule.

    Raises:
        ProgdfError: a strength or gain is not finite, or the blend rule is unknown.
        ValueError: weights do not fit the members, or a weight is outside 0 to 1.
    """
    check_numbers(layers, blend)
    for layer in layers:
        check_weights(layer)


def check_numbers(layers: Sequence[Layer], blend: str) -> None:
    """Check strengths, gains and the blend rule, like `check_layers` without the slow check of weights."""
    for rule in (blend, *(layer.blend for layer in layers if layer.blend)):
        if rule not in BLENDS:
            raise ProgdfError(f"unknown blend rule '{rule}'; use one of {', '.join(BLENDS)}")
    for layer in layers:
        if not math.isfinite(layer.strength):
            raise ProgdfError(f"the strength of {layer.gdf.name} is {layer.strength}; use a number, 0 to 1")
        for kind, gain in vars(layer.gains).items():
            if not math.isfinite(gain):
                raise ProgdfError(f"the {kind} gain of {layer.gdf.name} is {gain}; use a number, 0 to 1")


def check_weights(layer: Layer) -> None:
    """Check the weights of one layer, see `check_layers`."""
    if layer.weights is None:
        return
    shape = list(layer.weights.shape)
    members = len(layer.gdf.region)
    if shape != [members]:
        raise ValueError(f"weights of {layer.gdf.name} has shape {shape}, expected [{members}]")
    if members and not (float(layer.weights.min()) >= 0.0 and float(layer.weights.max()) <= 1.0):
        raise ValueError(f"weights of {layer.gdf.name} has a number outside 0 to 1")


@dataclass(frozen=True)
class Change:
    """Rows and attributes that an update changed."""

    __eq__ = equal_fields

    rows: NDArray[np.int64]  # sorted indices of all Gaussians that may differ from before. [M]
    attributes: tuple[str, ...]  # names from `gaussians.ATTRIBUTES` that may differ in these rows
    largest_move: float  # largest movement of a center since the last update, world units

    @property
    def means_moved(self) -> bool:
        """True if the depth order may have changed."""
        return self.largest_move > 0


Effect = tuple[tuple[float, Gains, Tensor | None, int, int, str], ...]
"""Effect of an edit, per layer: strength, gains, weights, their version, position in the stack, and its rule.

The position is 0 for layers without an order: those that are not paint, under some blend rules.
"""


@dataclass(frozen=True)
class Effects:
    """Effects of all edits under one blend rule. An edit without effect is absent."""

    blend: str = DEFAULT_BLEND
    averaged_alone: bool = False  # see `is_averaged_alone`
    of: Mapping[int, Effect] = field(default_factory=dict)


def effects_of(stack: Sequence[tuple[int, Layer]], blend: str) -> Effects:
    """Return the effects of active layers, which are given lowest first with the index of their edit."""
    effects: dict[int, Effect] = {}
    layers = [layer for _, layer in stack]
    ordered = any(rule_of(layer, blend) in ORDERED for layer in layers)
    for index, (edit, layer) in enumerate(stack):
        version = -1 if layer.weights is None else layer.weights._version
        order = index if ordered or layer.pushed_kinds else 0
        entry = (layer.strength, layer.gains, layer.weights, version, order, rule_of(layer, blend))
        effects[edit] = (*effects.get(edit, ()), entry)
    return Effects(blend, is_averaged_alone(layers, blend), effects)


def changed_edits(before: Effects, now: Effects) -> frozenset[int]:
    """Return the indices of edits whose members may differ. Weights are compared by identity and version."""
    all_differ = (now.blend, now.averaged_alone) != (before.blend, before.averaged_alone)
    return frozenset(
        edit
        for edit in {*before.of, *now.of}
        if all_differ or not _same(before.of.get(edit, ()), now.of.get(edit, ()))
    )


def _same(before: Effect, now: Effect) -> bool:
    return len(before) == len(now) and all(
        a[:2] == b[:2] and a[2] is b[2] and a[3:] == b[3:] for a, b in zip(before, now, strict=True)
    )
