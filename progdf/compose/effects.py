"""What decides the part that each edit plays in a stack, and which edits a new stack makes another of.

`progdf.compose.composer` and the viewer's edit pass on the GPU rewrite the members of those edits only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from .layers import Gains, Layer

Effect = tuple[tuple[float, Gains, Tensor | None, int, int], ...]
"""An edit's part, per layer: strength, gains, weights, their version, place in the stack where it counts."""


@dataclass(frozen=True)
class Effects:
    """The parts of all edits under one blend rule; an edit that does nothing is absent."""

    blend: str = "normalized"
    of: Mapping[int, Effect] = field(default_factory=dict)


def effects_of(stack: Sequence[tuple[int, Layer]], blend: str) -> Effects:
    """The effects of active layers, lowest first, each with the index of its edit."""
    found: dict[int, Effect] = {}
    for place, (edit, layer) in enumerate(stack):
        version = -1 if layer.weights is None else layer.weights._version
        order = place if blend == "over" else 0
        entry = (layer.strength, layer.gains, layer.weights, version, order)
        found[edit] = (*found.get(edit, ()), entry)
    return Effects(blend, found)


def changed_edits(before: Effects, now: Effects) -> frozenset[int]:
    """Indices of the edits whose members may differ; weights are compared by identity and version."""
    return frozenset(
        edit
        for edit in {*before.of, *now.of}
        if now.blend != before.blend or not _same(before.of.get(edit, ()), now.of.get(edit, ()))
    )


def changed_gains(before: Effects, now: Effects, changed: frozenset[int]) -> set[str] | None:
    """Kinds of change whose gains alone tell the changed edits from before; None where more than gains do."""
    pairs = [(before.of.get(edit, ()), now.of.get(edit, ())) for edit in changed]
    if now.blend != before.blend or not all(_same(a, b, gains=False) for a, b in pairs):
        return None
    return {
        kind
        for effects in pairs
        for a, b in zip(*effects, strict=True)
        for kind, gain in vars(a[1]).items()
        if gain != getattr(b[1], kind)
    }


def _same(before: Effect, now: Effect, gains: bool = True) -> bool:
    return len(before) == len(now) and all(
        a[0] == b[0] and a[2] is b[2] and a[3:] == b[3:] and (not gains or a[1] == b[1])
        for a, b in zip(before, now, strict=True)
    )
