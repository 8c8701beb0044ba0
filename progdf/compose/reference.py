"""Several edits on one scene: Θ = Θ0 + blend over the enabled layers of m · gain · Δ(s) (method.md 6).

`compose` is the plain form that states the rules. `progdf.compose.composer.Composer` gives the same numbers
while a slider is dragged, in buffers that are made once.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import verify

from .coverage import coverage
from .layers import BLENDS, KINDS, Gains, Layer, check_layers

__all__ = ["BLENDS", "Gains", "Layer", "compose"]

NOTHING = -0.0
"""The number that added to any other, −0.0 included, leaves every bit as it was."""


def compose(scene: Gaussians, layers: Sequence[Layer], blend: str = "normalised") -> Gaussians:
    """The scene under a stack of edits.

    With m the layer's weights, g its gain for the kind of attribute, and Δ(s) its field at strength s:

    - "normalised": Σ m g Δ(s) / max(1, Σ m s). One layer alone is untouched, order does not matter, and it
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
    weights = [_weights(layer) for layer in active]
    reached = [layer.gdf.region.members[m != 0] for layer, m in zip(active, weights, strict=True)]
    rows = torch.unique(torch.cat(reached))
    crowd = torch.zeros(len(rows))  # Σ m s
    for layer, m in zip(active, weights, strict=True):
        index, selected = _places(rows, layer.gdf.region.members, m)
        crowd[index] += m[selected] * layer.cover

    hides = [coverage(scene, layer.gdf) if blend == "over" else {} for layer in active]
    changed: dict[str, Any] = {}
    for name in ATTRIBUTES:
        movers = [name in layer.gdf.field.attributes and layer.gain(name) != 0 for layer in active]
        if not any(movers):
            continue
        old: Tensor = getattr(scene, name)
        total = torch.full((len(rows), old[0].numel()), NOTHING)
        for layer, m, moves, covers in zip(active, weights, movers, hides, strict=True):
            if not moves:
                continue
            index, selected = _places(rows, layer.gdf.region.members, m)
            share = m[selected, None]
            below = total[index]
            if blend == "over":
                hidden = torch.tensor(layer.cover) * torch.tensor(min(abs(layer.gain(name)), 1.0))
                below = below * (1 - share * hidden * covers[KINDS[name]][selected, None])
            offsets = layer.gdf.field.attribute_offsets(name, layer.strength)[selected]
            total[index] = below + share * layer.gain(name) * offsets
        if blend == "normalised":
            total = total / crowd.clamp(min=1.0)[:, None]
        new = old[rows] + total.reshape(-1, *old.shape[1:]).to(old.dtype)
        changed[name] = old.index_copy(0, rows, new)
    return replace(scene, **changed)


def _weights(layer: Layer) -> Tensor:
    """Weight of every member. [M] float32"""
    if layer.weights is None:
        return torch.ones(len(layer.gdf.region))
    return layer.weights.float()


def _places(rows: Tensor, members: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Where in `rows` a layer's members of weight ≠ 0 lie, and which members these are. [m], [m] int64"""
    selected = weights.nonzero()[:, 0]
    return torch.searchsorted(rows, members[selected]), selected
