"""Regions as files: named selections of the window, as `progdf train` reads them.

A region is NAME.region.npy, the rows of a selection. Sessions may come from untrusted sources. Therefore only
regular files with that suffix in the folders of `region_folders` are ever written or removed.
"""

from __future__ import annotations

import filecmp
import os
import stat
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.errors import ProgdfError
from progdf.io.atomic import make_folder
from progdf.io.tensors import save_npy
from progdf.scene.regions import check_region
from viewer.jobs.training import edits_folder
from viewer.state import selection
from viewer.state.forms import ALL, CHANGED, SELECTION, TYPED, NewEdit
from viewer.state.selection import NamedRegion, SelectionState, unpack

from .document import Document
from .scenes import OwnScene

_REGION_KINDS = ("masks", "photomasks", "text", "changed")
"""Kinds of regions, besides those that every command supports."""


def region_option(form: NewEdit, folder: Path, state: SelectionState, total: int, name: str = "") -> str:
    """Return a form's region as a value of `progdf train --region`; write a file if needed.

    Args:
        form: names the region
        folder: folder of the file
        state: the selection and the regions
        total: number of Gaussians in the scene
        name: name of the file; without one, a hash of the region names it, so that a reader can reuse the
            region it has loaded

    Raises:
        ProgdfError: it is empty, or it cannot be read or written.
    """
    if form.region in (ALL, CHANGED):
        return form.region
    if form.region == TYPED:
        spec = form.typed_region.strip()
        check_region(spec, {kind: lambda _: None for kind in _REGION_KINDS})
        return spec
    region = {region.name: region for region in state.regions}.get(form.region)
    if form.region != SELECTION and region is None:
        raise ProgdfError(f"the region {form.region} was deleted; choose another one")
    members = state.members if region is None else region.members
    check_members(members, total)
    if not unpack(members, total).any():
        raise ProgdfError("the region is empty; select something, or choose another region")
    make_folder(folder)
    path = folder / f"{name or f'{zlib.crc32(members):08x}'}{selection.SUFFIX}"
    write_region(NamedRegion(name, path, members, state.count), total)
    return f"file:{path}"


def region_rows(form: NewEdit, state: SelectionState, total: int) -> NDArray[np.int64] | None:
    """Return the rows of a form's region, ascending; None if only the trainer can find them. [M]

    Args:
        form: names the region
        state: the selection and the regions
        total: number of Gaussians in the original
    """
    if form.region == ALL:
        return np.arange(total)
    if form.region in (TYPED, CHANGED):
        return None
    regions = {region.name: region.members for region in state.regions}
    members = state.members if form.region == SELECTION else regions.get(form.region)
    return None if members is None else np.flatnonzero(unpack(members, total))


def own_scene(form: NewEdit, opened: Document, state: SelectionState) -> OwnScene:
    """Return the scene that holds a form's region.

    A region that only the trainer can find, and the whole scene, need a single visible scene.

    Raises:
        ProgdfError: the region spans several scenes.
    """
    rows = None if form.region == ALL else region_rows(form, state, len(opened.original))
    held = np.zeros(0, np.int64) if rows is None else rows
    return opened.own_scene(opened.scene_with(torch.from_numpy(held)))


def keep_region(
    state: SelectionState, name: str, folder: Path, total: int, counts: Sequence[int] = ()
) -> SelectionState:
    """Save the selection as a region, with a file in a folder.

    If training made a region of the same Gaussians, it gets the name and becomes a saved region.

    Args:
        state: the selection and the regions
        name: name of the region; it gets a number if a region or a file already has it
        folder: folder of the file
        total: number of Gaussians in the scene
        counts: number of Gaussians of each of several merged scenes

    Returns:
        The new state; the given state if a saved region already has the same Gaussians.

    Raises:
        ProgdfError: nothing is selected, there are too many regions, or the folder cannot be written to.
    """
    if not state.count:
        raise ProgdfError("nothing is selected; select something first")
    check_members(state.members, total)
    equal = selection.equal_region(state, state.members, total)
    if equal is not None:
        if not state.regions[equal].edit:
            return state
        state = rename_region(state, equal, name, total, counts)
        return selection.change_region(state, equal, replace(state.regions[equal], edit=""))
    path = _free_region_path(state, name, folder)
    state = selection.add_region(state, path.name.removesuffix(selection.SUFFIX), path)
    write_region(state.regions[-1], total, counts)
    return state


def check_members(members: bytes, total: int) -> None:
    """Raise ProgdfError if a selection has only Gaussians that edits add, as no edit can refer to these.

    Args:
        members: packed mask of the selection
        total: number of Gaussians in the scene
    """
    if members != selection.EMPTY_MASK and not unpack(members, total).any():
        raise ProgdfError("only paint is selected, and no edit can change it; select its object too")


def rename_region(
    state: SelectionState, index: int, name: str, total: int, counts: Sequence[int] = ()
) -> SelectionState:
    """Rename a region and its file. An invalid index changes nothing.

    Raises:
        ProgdfError: the file cannot be written.
    """
    if not 0 <= index < len(state.regions):
        return state
    region = state.regions[index]
    path = _free_region_path(
        selection.change_region(state, index, None), name, region.path.parent, region.path
    )
    write_region(replace(region, path=path), total, counts)
    removes = path != region.path and _is_region_file(region.path) and region.path.exists()
    # a file with other rows does not belong to this region, even if the session names it
    if removes and filecmp.cmp(region.path, path, shallow=False):
        region.path.unlink()
    return selection.change_region(
        state, index, replace(region, name=path.name.removesuffix(selection.SUFFIX), path=path)
    )


def region_file(region: NamedRegion, total: int, counts: Sequence[int] = ()) -> Path:
    """Return the path of the region's file, written again if it is missing.

    Raises:
        ProgdfError: the file cannot be written.
    """
    if not region.path.exists():
        write_region(region, total, counts)
    return region.path


def write_region(region: NamedRegion, total: int, counts: Sequence[int] = ()) -> None:
    """Write the rows of a region. [M] int64

    Of several merged scenes, a region of one of them gets the rows of that scene, as a training reads them. A
    region of several keeps the rows of the merged scene.

    Raises:
        ProgdfError: the folder does not exist or cannot be written to, or the path is not valid for a region.
    """
    if not _is_region_file(region.path):
        raise ProgdfError(
            f"{region.path} is not a regular file that ends in {selection.SUFFIX}; "
            "rename the region to give it one"
        )
    rows = np.flatnonzero(unpack(region.members, total)).astype(np.int64)
    first = 0
    for count in counts:
        if len(rows) and first <= rows[0] and rows[-1] < first + count:
            rows = rows - first
            break
        first += count
    save_npy(region.path, rows)


def region_folders(session: Path, scene: Path) -> tuple[Path, ...]:
    """Return the folders that may hold a session's region files: its own, and those of edits of its scene."""
    edits = edits_folder(scene)
    scene = scene.resolve()
    # not resolved, as the folder of edits itself may be a symbolic link to elsewhere
    beside = scene.with_name(f"{scene.stem}.edits")
    return session.resolve().parent, beside, edits.parent.resolve() / edits.name


def claim_regions(state: SelectionState, folders: Sequence[Path]) -> SelectionState:
    """Move regions with disallowed paths to new paths in the first folder. Their files are not written yet.

    Args:
        state: the selection and the regions
        folders: allowed folders, at any depth; symbolic links that lead out of them are not allowed
    """
    for i, region in enumerate(state.regions):
        if not _is_inside(region.path, folders):
            path = _free_region_path(selection.change_region(state, i, None), region.name, folders[0])
            named = replace(region, name=path.name.removesuffix(selection.SUFFIX), path=path)
            state = selection.change_region(state, i, named)
    return state


def _is_inside(path: Path, folders: Sequence[Path]) -> bool:
    """Return whether a region's path is allowed: in an existing folder below one of `folders`."""
    try:
        parent = Path(os.path.realpath(path.parent))
        return (
            os.path.isdir(parent)
            and any(parent.is_relative_to(folder) for folder in folders)
            and _is_region_file(path)
        )
    except ValueError:  # a NUL in the name
        return False


def _is_region_file(path: Path) -> bool:
    """Return whether the path has a region's suffix and is a regular file, or does not exist.

    Links are neither.
    """
    try:
        return path.name.endswith(selection.SUFFIX) and stat.S_ISREG(os.lstat(path).st_mode)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):  # not a valid file name
        return False


def _free_region_path(state: SelectionState, name: str, folder: Path, current: Path | None = None) -> Path:
    """Return a path in `folder` that no region and no other file uses."""

    def path(free: str) -> Path:
        return folder / f"{free}{selection.SUFFIX}"

    others = {region.path for region in state.regions}

    def is_taken(free: str) -> bool:
        return path(free) in others or (path(free) != current and os.path.lexists(path(free)))

    return path(selection.free_name(state, name, is_taken))
