"""Several edits on one scene: Θ = Θ0 + blend over the enabled layers of m · gain · Δ(s) (docs/method.md 6).

`compose_layers` is the plain form that states the rules. `progdf.compose.composer.Composer` gives the same
numbers while a slider is dragged, in buffers that are made once.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import verify

from .coverage import coverage
from .layers import BLENDS, KINDS, Gains, Layer, check_layers

__all__ = ["BLENDS", "Gains", "Layer", "compose_layers"]

NEGATIVE_ZERO = -0.0
"""The number that added to any other, −0.0 included, leaves every bit as it was."""
_ALL = slice(None)


def compose_layers(scene: Gaussians, layers: Sequence[Layer], blend: str = "normalized") -> Gaussians:
    """The scene under a stack of edits.

    With m the layer's weights, g its gain for the kind of attribute, and Δ(s) its field at strength s:

    - "normalized": Σ m g Δ(s) / max(1, Σ m s). One layer alone is untouched, order does not matter, and it
      is the plain sum while the strengths on a Gaussian add up to no more than 1.
    - "sum": Σ m g Δ(s).
    - "over": in the order given, Δ ← Δ · (1 − m s c min(1, |g|)) + m g Δ(s), where c is how much the layer
      itself changes of that kind, see `progdf.compose.coverage`; the last layer lies on top, and what it
      leaves alone shows the layers below.

    In Σ m s and 1 − m s c, s is held to 0..1: an overshoot exaggerates its own edit and does not dim the
    others.

    Args:
        scene: the original
        layers: edits of this scene, the lowest first
        blend: one of `BLENDS`

    Returns:
        New Gaussians; attributes that no layer moves are the scene's own tensors. Rows outside all members,
        rows of weight 0, and everything at strength 0 keep their bytes. One layer at strength 1 gives Θ0 +
        full exactly.

    Raises:
        ProgdfError: an edit belongs to another scene, a strength is not a number, the blend rule is unknown.
        ValueError: weights do not fit.
    """
    check_layers(layers, blend)
    for layer in layers:
        verify(layer.gdf, scene)
    active = [layer for layer in layers if layer.active]
    if not active or not len(scene):
        return scene
    rows, parts = _parts(scene, active, blend)
    weight_sum = torch.zeros(len(rows))  # Σ m s
    for part in parts:
        weight_sum[part.rows] += part.weights * part.layer.clamped_strength

    changed: dict[str, Any] = {}
    for name in ATTRIBUTES:
        movers = [part for part in parts if part.moves(name)]
        if not movers:
            continue
        old: Tensor = getattr(scene, name)
        total = torch.full((len(rows), old[0].numel()), NEGATIVE_ZERO)
        for part in movers:
            layer, weight = part.layer, part.weights[:, None]
            below = total[part.rows]
            if blend == "over":
                hidden = torch.tensor(layer.clamped_strength) * torch.tensor(min(abs(layer.gain(name)), 1.0))
                below = below * (1 - weight * hidden * part.coverage[KINDS[name]][part.members, None])
            offsets = layer.gdf.field.attribute_offsets(name, layer.strength)[part.members]
            total[part.rows] = below + weight * layer.gain(name) * offsets
        if blend == "normalized":
            total = total / weight_sum.clamp(min=1.0)[:, None]
        new = old[rows] + total.reshape(-1, *old.shape[1:]).to(old.dtype)
        changed[name] = old.index_copy(0, rows, new)
    return replace(scene, **changed)


@dataclass(frozen=True)
class _Part:
    """A layer's members of weight ≠ 0, m in number.

    Args:
        layer: the layer
        members: which of its members these are, all of them as a slice. [m] int64
        rows: where they are among the rows that change, all of them as a slice. [m] int64
        weights: theirs. [m] float32
        coverage: how far it hides the layers below, by kind of attribute; empty but for "over". [M] float32
    """

    layer: Layer
    members: Tensor | slice
    rows: Tensor | slice
    weights: Tensor
    coverage: Mapping[str, Tensor]

    def moves(self, attribute: str) -> bool:
        """Whether it changes an attribute at all."""
        return attribute in self.layer.gdf.field.attributes and self.layer.gain(attribute) != 0


def _parts(scene: Gaussians, layers: Sequence[Layer], blend: str) -> tuple[Tensor, list[_Part]]:
    """The sorted rows of the scene that change, [U] int64, and each layer's part in them."""
    chosen: list[tuple[Tensor | slice, Tensor]] = []  # members and their weights
    for layer in layers:
        weights = torch.ones(len(layer.gdf.region)) if layer.weights is None else layer.weights.float()
        selected = weights.nonzero()[:, 0]
        chosen.append((_ALL, weights) if len(selected) == len(weights) else (selected, weights[selected]))
    reached = [layer.gdf.region.members[members] for layer, (members, _) in zip(layers, chosen, strict=True)]
    rows = reached[0] if len(reached) == 1 else torch.unique(torch.cat(reached))
    place = torch.empty(len(scene) if len(reached) > 1 else 0, dtype=torch.int64)
    if len(reached) > 1:
        place[rows] = torch.arange(len(rows))
    return rows, [
        _Part(
            layer,
            members,
            _ALL if len(own) == len(rows) else place[own],
            weights,
            coverage(scene, layer.gdf) if blend == "over" else {},
        )
        for layer, own, (members, weights) in zip(layers, reached, chosen, strict=True)
    ]
