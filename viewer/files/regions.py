"""Regions as files: NAME.region.npy, the rows of a selection, for `progdf train --region file:…`.

A session may be a stranger's: of what it names, nothing but regular files of that ending in the folders of
`region_folders` is ever written or removed.
"""

from __future__ import annotations

import filecmp
import os
import stat
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from progdf.errors import ProgdfError
from progdf.io.tensors import save_npy
from viewer.jobs.run_files import edits_folder
from viewer.state import selection
from viewer.state.selection import SUFFIX, NamedRegion, SelectionState, unpack


def keep(state: SelectionState, name: str, folder: Path, total: int) -> SelectionState:
    """The selection written into a folder, and kept as one more region.

    Args:
        name: its own, or with a number where a region or a file has it already
        total: Gaussians in the scene

    Raises:
        ProgdfError: nothing is selected, there are too many regions, or the folder cannot be written to.
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
    removes = path != region.path and _is_writable(region.path) and region.path.exists()
    # a file that holds other rows is not this region's, whatever the session says
    if removes and filecmp.cmp(region.path, path, shallow=False):
        region.path.unlink()
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
        ProgdfError: the folder does not exist or cannot be written to, or the path is not that of a region's
            file.
    """
    if not _is_writable(region.path):
        raise ProgdfError(
            f"{region.path} is not a regular file that ends in {SUFFIX}; rename the region to give it one"
        )
    save_npy(region.path, np.flatnonzero(unpack(region.members, total)).astype(np.int64))


def region_folders(session: Path, scene: Path, memory: Path | None = None) -> tuple[Path, ...]:
    """Where a session's regions have their files: its own folder, and those of new edits of its scene."""
    scene, edits = scene.resolve(), edits_folder(scene, memory)
    # the folder of edits itself may be a link out, and is not followed
    beside = scene.with_name(f"{scene.stem}.edits")
    return session.resolve().parent, beside, edits.parent.resolve() / edits.name


def claim(state: SelectionState, folders: Sequence[Path]) -> SelectionState:
    """Regions whose files may not be written get another place, in the first folder, and are unsaved.

    Args:
        folders: where files may be, at any depth; symbolic links do not lead out of them
    """
    for i, region in enumerate(state.regions):
        if not _is_inside(region.path, folders):
            path = _free_path(selection.change_region(state, i, None), region.name, folders[0])
            named = replace(region, name=path.name.removesuffix(SUFFIX), path=path)
            state = selection.change_region(state, i, named)
    return state


def _is_inside(path: Path, folders: Sequence[Path]) -> bool:
    """Whether a region's file may be there: in a folder that exists, below one of `folders`."""
    try:
        parent = Path(os.path.realpath(path.parent))
        return (
            os.path.isdir(parent)
            and any(parent.is_relative_to(folder) for folder in folders)
            and _is_writable(path)
        )
    except ValueError:  # a NUL in the name
        return False


def _is_writable(path: Path) -> bool:
    """Whether it is a regular file that is called as a region's, or nothing yet; a link is neither."""
    try:
        return path.name.endswith(SUFFIX) and stat.S_ISREG(os.lstat(path).st_mode)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):  # a name that no file can have
        return False


def _free_path(state: SelectionState, name: str, folder: Path, own: Path | None = None) -> Path:
    """A file in `folder` that no region and no other file has."""

    def path(free: str) -> Path:
        return folder / f"{free}{SUFFIX}"

    others = {region.path for region in state.regions}

    def is_taken(free: str) -> bool:
        return path(free) in others or (path(free) != own and os.path.lexists(path(free)))

    return path(selection.free_name(state, name, is_taken))
