"""Regions as files: NAME.region.npy, the rows of a selection, for `progdf train --region file:…`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from progdf.errors import ProgdfError
from progdf.io.npy import save_npy
from viewer.state import selection
from viewer.state.selection import SUFFIX, NamedRegion, SelectionState, unpack


def keep(state: SelectionState, name: str, folder: Path, total: int) -> SelectionState:
    """The selection written into a folder, and kept as one more region.

    Args:
        name: its own, or with a number where a region or a file has it already
        total: Gaussians in the scene

    Raises:
        ProgdfError: nothing is selected, or the folder cannot be written to.
    """
    if not state.count:
        raise ProgdfError("nothing is selected; select something first")
    path = _free_path(state, name, folder)
    kept = selection.add_region(state, path.name.removesuffix(SUFFIX), path)
    write(kept.regions[-1], total)
    return kept


def rename(state: SelectionState, index: int, name: str, total: int) -> SelectionState:
    """A region and its file under another name; as it was where there is no such region.

    Raises:
        ProgdfError: the file cannot be written.
    """
    if not 0 <= index < len(state.regions):
        return state
    region = state.regions[index]
    path = _free_path(selection.change_region(state, index, None), name, region.path.parent, region.path)
    write(replace(region, path=path), total)
    if path != region.path:
        region.path.unlink(missing_ok=True)
    return selection.change_region(
        state, index, replace(region, name=path.name.removesuffix(SUFFIX), path=path)
    )


def region_file(region: NamedRegion, total: int) -> Path:
    """Where the region is as a file, written again where it was taken away.

    Raises:
        ProgdfError: it cannot be written.
    """
    if not region.path.exists():
        write(region, total)
    return region.path


def write(region: NamedRegion, total: int) -> None:
    """Write the rows of a region. [M] int64

    Raises:
        ProgdfError: the folder does not exist or cannot be written to.
    """
    save_npy(region.path, np.flatnonzero(unpack(region.members, total)).astype(np.int64))


def _free_path(state: SelectionState, name: str, folder: Path, own: Path | None = None) -> Path:
    """A file in `folder` that no region and no other file has."""

    def path(free: str) -> Path:
        return folder / f"{free}{SUFFIX}"

    return path(selection.free_name(state, name, lambda free: path(free) != own and path(free).exists()))
