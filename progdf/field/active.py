"""Members whose part in an edit no picture shows, and fields without them.

A member left out keeps its original numbers, at s = 1 too, so this is asked for and not done unasked; what it
brings is measured in `trainer.fit.active`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from .baked import AttributeBases, BakedField

PIXEL = 0.5 / 255
"""Change of a colour that 8 bits do not show, of 1."""

Pictures = Callable[[Tensor], Iterable[Tensor]]
"""Offsets of the members -> pictures, one a view, made as they are asked for. [M,C] -> [h,w,3] each"""


@dataclass(frozen=True)
class Invisible:
    """What may be left out.

    Args:
        gone: which members. [M] bool
        largest: largest change of a colour in any picture when they are left out, of 1
    """

    gone: Tensor
    largest: float


def invisible_members(
    field: BakedField, effect: Tensor, pictures: Pictures, strengths: Sequence[float], most: float = PIXEL
) -> Invisible:
    """The members of least effect, as many as can go without any picture changing by more than `most`.

    Args:
        field: of the edit
        effect: how much each member is expected to show, ≥ 0; the order in which they are tried. [M]
        pictures: of all views that count
        strengths: at which pictures are compared
        most: largest change of a colour, of 1

    Returns:
        Members whose leaving has been looked at as a whole: what all of them change together, not each alone.

    Raises:
        ValueError: not one effect for each member.
    """
    members = field.members
    if tuple(effect.shape) != (members,) and field.attributes:
        raise ValueError(f"effect is {list(effect.shape)}, expected [{members}]")
    if not members:
        return Invisible(torch.zeros(len(effect), dtype=torch.bool), 0.0)
    order = effect.argsort(stable=True)
    with torch.no_grad():
        whole = {s: list(pictures(field.offsets(s))) for s in strengths}

    def changed(count: int) -> float:
        """Largest change when the first `count` are left out; beyond `most`, as far as was looked."""
        largest = 0.0
        with torch.no_grad():
            for s, expected in whole.items():
                offsets = field.offsets(s)
                offsets[order[:count]] = 0.0
                for found, before in zip(pictures(offsets), expected, strict=True):
                    if found.numel():
                        largest = max(largest, float((found - before).abs().max()))
                    if largest > most:
                        return largest
        return largest

    # few can be left out as a rule: grow until it shows, then close in
    fits, largest, step = 0, 0.0, 1
    shows = members + 1
    while shows - fits > 1:
        count = min(fits + step, members) if shows > members else (fits + shows) // 2
        here = changed(count)
        if here <= most:
            fits, largest, step = count, here, 2 * step
            if fits == members:
                break
        else:
            shows = count
    gone = torch.zeros(members, dtype=torch.bool)
    gone[order[:fits]] = True
    return Invisible(gone, largest)


def resting(field: BakedField, gone: Tensor) -> BakedField:
    """The field in which these members stay as they were. `gone`: [M] bool"""
    kept = ~gone

    def still(bases: AttributeBases) -> AttributeBases:
        return replace(bases, full=bases.full * kept[:, None], rest=bases.rest * kept[:, None])

    return replace(field, attributes={name: still(bases) for name, bases in field.attributes.items()})


def without(field: BakedField, gone: Tensor) -> BakedField:
    """The field of the other members; theirs is as it was, bit for bit. `gone`: [M] bool

    Raises:
        ValueError: the field is baked from a network, which would give them back when it is loaded.
    """
    if field.origin is not None:
        raise ValueError("a network holds all its members; drop them from another kind of field")
    kept = ~gone

    def fewer(bases: AttributeBases) -> AttributeBases:
        return replace(bases, full=bases.full[kept].contiguous(), rest=bases.rest[:, kept].contiguous())

    return replace(field, attributes={name: fewer(bases) for name, bases in field.attributes.items()})
