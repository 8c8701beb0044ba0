"""Selected and hidden Gaussians, and the regions saved from selections.

A set of Gaussians is a boolean mask over the scene, packed into a few kilobytes (`pack`). States can
therefore be compared, undone and saved as values.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from progdf.errors import ProgdfError
from progdf.io.atomic import is_portable, numbered_names
from progdf.scene.neighbors import Neighborhood
from progdf.scene.selection import Mask, combine

from .commands import Action, OnItem, Plain, SelectRegion

SUFFIX = ".region.npy"
"""Suffix of a region's file name, after the region's name."""
LONGEST_NAME = 60  # characters in the name of a region
MAX_REGIONS = 1000
"""Largest number of regions of a scene, few enough to draw and save at once."""

EMPTY_MASK = b""
"""Packed mask without members."""

Share = Annotated[float, Meta(ge=0.0, le=1.0)]
Color = tuple[Share, Share, Share]

COLORS: tuple[Color, ...] = (
    (0.20, 0.65, 0.95),
    (0.95, 0.45, 0.20),
    (0.35, 0.80, 0.35),
    (0.85, 0.35, 0.75),
    (0.95, 0.80, 0.20),
    (0.30, 0.80, 0.75),
)
"""Colors assigned to new regions in turn."""


@dataclass(frozen=True)
class NamedRegion:
    """Selection saved under a name."""

    name: str  # unique among the regions
    path: Path  # file of its rows, for `progdf train --region file:PATH`
    members: bytes  # its packed mask
    count: Annotated[int, Meta(ge=0)]  # number of its members
    color: Color = COLORS[0]  # color of its swatch and tint
    visible: bool = False  # whether the picture shows its tint
    edit: str = ""  # name of the edit for whose training the region was made; "" for a saved region


@dataclass(frozen=True)
class SelectionState:
    """Current selection, hidden Gaussians and regions. Undo covers all of it."""

    members: bytes = EMPTY_MASK  # packed mask of the selection
    count: Annotated[int, Meta(ge=0)] = 0  # number of selected Gaussians
    hidden: bytes = EMPTY_MASK  # packed mask of Gaussians that are not drawn and cannot be selected
    # in the order of the panel's rows
    regions: Annotated[tuple[NamedRegion, ...], Meta(max_length=MAX_REGIONS)] = ()


def pack(mask: Mask) -> bytes:
    """Pack a mask [N] for storage in a state; `EMPTY_MASK` if it is empty."""
    return zlib.compress(np.packbits(mask).tobytes(), 1) if mask.any() else EMPTY_MASK


@lru_cache(maxsize=64)
def unpack(members: bytes, total: int) -> Mask:
    """Unpack a mask for a scene of `total` Gaussians.

    Rows beyond the end of the mask, which edits added later, are not members. Surplus rows of the mask are
    dropped.

    Returns:
        Read-only mask. [N] bool

    Raises:
        ProgdfError: the packed mask is damaged.
    """
    mask = np.zeros(total, bool)
    if members != EMPTY_MASK:
        unpacker = zlib.decompressobj()
        size = -(-total // 8)
        try:
            packed = unpacker.decompress(members, size) if size else b""
        except zlib.error:
            packed = b""
        if len(packed) < size and not unpacker.eof:
            raise ProgdfError("a selection is damaged; select it again")
        mask = np.unpackbits(np.frombuffer(packed.ljust(size, b"\0"), np.uint8), count=total).astype(bool)
    mask.flags.writeable = False
    return mask


def select(state: SelectionState, mask: Mask) -> SelectionState:
    """Replace the selection by `mask` [N] without the hidden Gaussians."""
    if state.hidden != EMPTY_MASK:
        mask = mask & ~unpack(state.hidden, len(mask))
    return replace(state, members=pack(mask), count=int(np.count_nonzero(mask)))


def select_none(state: SelectionState) -> SelectionState:
    """Clear the selection."""
    return replace(state, members=EMPTY_MASK, count=0)


def hide(state: SelectionState, mask: Mask) -> SelectionState:
    """Hide and deselect the Gaussians of `mask` [N]."""
    hidden = unpack(state.hidden, len(mask)) | mask
    return select(replace(state, hidden=pack(hidden)), unpack(state.members, len(mask)))


def isolate(state: SelectionState, total: int) -> SelectionState:
    """Hide everything but the selection. An empty selection changes nothing."""
    return replace(state, hidden=pack(~unpack(state.members, total))) if state.count else state


def show_all(state: SelectionState) -> SelectionState:
    """Show all hidden Gaussians."""
    return replace(state, hidden=EMPTY_MASK)


def change(
    state: SelectionState,
    action: Action,
    total: int,
    neighborhood: Callable[[], Neighborhood],
    paint_on: Callable[[Mask], Mask] = np.zeros_like,
) -> SelectionState:
    """Apply one of `CHANGES`.

    Args:
        state: the current state
        action: the command; its name is one of `CHANGES`
        total: number of Gaussians in the scene
        neighborhood: returns the neighborhood of the scene, computed on first use
        paint_on: returns the paint that lies on a mask. [N] -> [N]
    """
    mask = unpack(state.members, total)
    match action:
        case SelectRegion(index, mode):
            region = _region(state, index)
            if region is None:
                return state
            members = unpack(region.members, total)
            return select(state, combine(mask, members | paint_on(members), mode))
        case OnItem("show_region", index):
            region = _region(state, index)
            if region is None:
                return state
            return change_region(state, index, replace(region, visible=not region.visible))
        case OnItem("forget_region", index):
            return change_region(state, index, None)
        case Plain("select_with_paint"):
            return select(state, mask | paint_on(mask))
        case Plain("select_without_paint"):
            return select(state, mask & ~paint_on(np.ones_like(mask)))
        case Plain("select_paint"):
            only = (mask | paint_on(mask)) & paint_on(np.ones_like(mask))
            return select(state, only) if only.any() else state
    if action.name in _CHANGES:
        return _CHANGES[action.name](state, mask)
    change_mask = CHANGES_BY_NEIGHBORS[action.name]
    if not state.count:
        return state
    changed = change_mask(neighborhood(), mask)
    return select(state, changed | paint_on(changed))


def _region(state: SelectionState, index: int) -> NamedRegion | None:
    return state.regions[index] if 0 <= index < len(state.regions) else None


CHANGES_BY_NEIGHBORS: dict[str, Callable[[Neighborhood, Mask], Mask]] = {
    "select_grow": Neighborhood.grow,
    "select_shrink": Neighborhood.shrink,
    "select_smooth": Neighborhood.smooth,
    "select_largest": Neighborhood.largest_part,
    "select_refine": Neighborhood.refine,
    "refine_anyway": Neighborhood.refine,
}
_CHANGES: dict[str, Callable[[SelectionState, Mask], SelectionState]] = {
    "select_all": lambda state, mask: select(state, np.ones_like(mask)),
    "select_none": lambda state, _: select_none(state),
    "select_invert": lambda state, mask: select(state, ~mask),
    "hide_selected": hide,
    "isolate": lambda state, mask: isolate(state, len(mask)),
    "show_hidden": lambda state, _: show_all(state),
}
_PAINT_CHANGES = ("select_with_paint", "select_without_paint", "select_paint")
_REGION_CHANGES = ("region", "show_region", "forget_region")
CHANGES = (*_CHANGES, *_PAINT_CHANGES, *_REGION_CHANGES, *CHANGES_BY_NEIGHBORS)
"""Names of the commands on the selection. The file of a removed region is kept."""


def free_name(state: SelectionState, text: str, is_taken: Callable[[str], bool] = lambda name: False) -> str:
    """Return a valid region and file name made from `text`.

    It gets a number if a region already has it (ignoring case) or `is_taken` returns true.
    """
    cleaned = "".join(c if c.isalnum() or c in " -_." else "_" for c in " ".join(text.split()))
    name = cleaned.strip(" .")[:LONGEST_NAME].rstrip(" .") or "region"
    name = name if is_portable(name) else f"region {name}"
    taken = {region.name.lower() for region in state.regions}
    return next(free for free in numbered_names(name) if not (free.lower() in taken or is_taken(free)))


def equal_region(state: SelectionState, members: bytes, total: int) -> int | None:
    """Return the index of the region with the same Gaussians as a packed mask; None if there is none."""
    mask = unpack(members, total)
    for index, region in enumerate(state.regions):
        if np.array_equal(unpack(region.members, total), mask):
            return index
    return None


def add_region(state: SelectionState, name: str, path: Path, edit: str = "") -> SelectionState:
    """Add the selection as a region. The selection is unchanged.

    Args:
        state: the selection and the regions
        name: name of the region, unique
        path: file of its rows
        edit: name of the edit for whose training the region is made; "" for a saved region

    Raises:
        ProgdfError: there are already `MAX_REGIONS`.
    """
    if len(state.regions) >= MAX_REGIONS:
        raise ProgdfError(f"there are already {MAX_REGIONS} regions (the maximum); delete some first")
    color = COLORS[len(state.regions) % len(COLORS)]
    region = NamedRegion(name, path, state.members, state.count, color, edit=edit)
    return replace(state, regions=(*state.regions, region))


def change_region(state: SelectionState, index: int, region: NamedRegion | None) -> SelectionState:
    """Replace the region at `index`, or remove it if `region` is None. An invalid index changes nothing."""
    if not 0 <= index < len(state.regions):
        return state
    replacement: Sequence[NamedRegion] = () if region is None else (region,)
    return replace(state, regions=(*state.regions[:index], *replacement, *state.regions[index + 1 :]))


def check(state: SelectionState, total: int) -> None:
    """Raise ProgdfError if a mask does not fit a scene of `total` Gaussians."""
    for members in (state.members, state.hidden, *(region.members for region in state.regions)):
        unpack(members, total)
        size = -(-total // 8)
        if members != EMPTY_MASK and len(zlib.decompressobj().decompress(members, size + 1)) != size:
            raise ProgdfError(f"a selection does not fit the scene's {total} Gaussians; select it again")


def take_rows(state: SelectionState, total: int, rows: NDArray[np.int64]) -> SelectionState:
    """Convert the state to a scene that has only the given rows [R] of `total`."""

    def take(members: bytes) -> tuple[bytes, int]:
        mask = unpack(members, total)[rows]
        return pack(mask), int(np.count_nonzero(mask))

    masks = [take(region.members) for region in state.regions]
    regions = zip(state.regions, masks, strict=True)
    return SelectionState(
        *take(state.members),
        take(state.hidden)[0],
        tuple(replace(region, members=members, count=count) for region, (members, count) in regions),
    )
