"""Files that the window makes of its work: pictures, cameras, and regions for `progdf train`.

A region is NAME.region.npy, the rows of a selection. A session may be a stranger's: of what it names, nothing
but regular files of that ending in the folders of `region_folders` is ever written or removed.
"""

from __future__ import annotations

import filecmp
import os
import re
import stat
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from progdf.camera import Camera
from progdf.errors import ProgdfError
from progdf.gaussians import ZERO, Origin
from progdf.io.atomic import atomic_write, pictures_folder
from progdf.io.cameras import kind_of_cameras, load_cameras, save_cameras
from progdf.io.session import SUFFIX
from progdf.io.tensors import save_npy
from viewer.jobs.training import edits_folder, takes_files
from viewer.state import selection
from viewer.state.selection import NamedRegion, SelectionState, unpack

CAMERAS = ".cameras.json"

REQUESTS = ("picture", "take_view", "window_picture")
"""Those that the main view serves."""


def folder_of(scene: Path | None) -> Path:
    """Where files made of a scene go: beside it, or where that is read-only to the user's pictures."""
    beside = scene.resolve().parent if scene is not None else None
    return beside if beside is not None and takes_files(beside) else pictures_folder()


def picture(folder: Path, title: str, image: NDArray[np.uint8], info: PngInfo | None = None) -> Path:
    """Save `image` [H,W,3] under the scene's name as NAME_001.png, or the next free number; its file.

    Args:
        folder, title: where, and the scene's name
        image: pixels
        info: what the file carries, see `camera_chunk`; with a camera it can be changed and trained on

    Raises:
        ProgdfError: it cannot be written.
    """
    with _writable(folder, "picture"):
        path = free_path(folder, Path(title).stem, ".png")
        with atomic_write(path) as temporary_file:
            Image.fromarray(image).save(temporary_file, pnginfo=info)
        return path.resolve()


def camera(source: Path, viewpoint: Camera, origin: Origin = ZERO) -> tuple[Path, int]:
    """Add a camera to NAME.cameras.json beside a scene or session NAME; where that is, and how many it holds.

    Args:
        source: the scene or session
        viewpoint: the camera
        origin: of the scene, which it is relative to

    Raises:
        ProgdfError: it cannot be written, or holds something else.
    """
    name = source.name.removesuffix(SUFFIX) if source.name.endswith(SUFFIX) else source.stem
    path = source.with_name(f"{name}{CAMERAS}")
    if path.exists() and kind_of_cameras(path) != "own":
        raise ProgdfError(f"{path} was not made with F4; move it elsewhere, as it would be overwritten")
    cameras = load_cameras(path, origin) if path.exists() else []
    number = 1 + max((int(c.name[5:]) for c in cameras if re.fullmatch(r"view_\d{1,9}", c.name)), default=-1)
    save_cameras(path, [*cameras, replace(viewpoint, name=f"view_{number:03d}")], origin)
    return path, len(cameras) + 1


@contextmanager
def _writable(folder: Path, what: str) -> Iterator[None]:
    """The folder is there; what cannot be written is one line."""
    try:
        folder.mkdir(parents=True, exist_ok=True)  # a user may have had no pictures so far
        yield
    except OSError as error:
        raise ProgdfError(f"no {what} was saved in {folder.resolve()}: {error.strerror}") from None


def free_path(folder: Path, stem: str, suffix: str) -> Path:
    """STEM_001 with `suffix`, or the next number that no file has."""
    number = 1
    while (path := folder / f"{stem}_{number:03d}{suffix}").exists():
        number += 1
    return path


def keep_region(state: SelectionState, name: str, folder: Path, total: int) -> SelectionState:
    """The selection written into a folder, and kept as one more region.

    Args:
        name: its own, or with a number where a region or a file has it already
        total: Gaussians in the scene

    Raises:
        ProgdfError: nothing is selected, there are too many regions, or the folder cannot be written to.
    """
    if not state.count:
        raise ProgdfError("nothing is selected; select something first")
    path = _free_region_path(state, name, folder)
    state = selection.add_region(state, path.name.removesuffix(selection.SUFFIX), path)
    write_region(state.regions[-1], total)
    return state


def rename_region(state: SelectionState, index: int, name: str, total: int) -> SelectionState:
    """A region and its file under another name; as it was where there is no such region.

    Raises:
        ProgdfError: the file cannot be written.
    """
    if not 0 <= index < len(state.regions):
        return state
    region = state.regions[index]
    path = _free_region_path(
        selection.change_region(state, index, None), name, region.path.parent, region.path
    )
    write_region(replace(region, path=path), total)
    removes = path != region.path and _is_region_file(region.path) and region.path.exists()
    # a file that holds other rows is not this region's, whatever the session says
    if removes and filecmp.cmp(region.path, path, shallow=False):
        region.path.unlink()
    return selection.change_region(
        state, index, replace(region, name=path.name.removesuffix(selection.SUFFIX), path=path)
    )


def region_file(region: NamedRegion, total: int) -> Path:
    """Where the region is as a file, written again where it was taken away.

    Raises:
        ProgdfError: it cannot be written.
    """
    if not region.path.exists():
        write_region(region, total)
    return region.path


def write_region(region: NamedRegion, total: int) -> None:
    """Write the rows of a region. [M] int64

    Raises:
        ProgdfError: the folder does not exist or cannot be written to, or the path is not that of a region's
            file.
    """
    if not _is_region_file(region.path):
        raise ProgdfError(
            f"{region.path} is not a regular file that ends in {selection.SUFFIX}; "
            "rename the region to give it one"
        )
    save_npy(region.path, np.flatnonzero(unpack(region.members, total)).astype(np.int64))


def region_folders(session: Path, scene: Path) -> tuple[Path, ...]:
    """Where a session's regions have their files: its own folder, and those of new edits of its scene."""
    scene, edits = scene.resolve(), edits_folder(scene)
    # the folder of edits itself may be a link out, and is not followed
    beside = scene.with_name(f"{scene.stem}.edits")
    return session.resolve().parent, beside, edits.parent.resolve() / edits.name


def claim_regions(state: SelectionState, folders: Sequence[Path]) -> SelectionState:
    """Regions whose files may not be written get another place, in the first folder, and are unsaved.

    Args:
        folders: where files may be, at any depth; symbolic links do not lead out of them
    """
    for i, region in enumerate(state.regions):
        if not _is_inside(region.path, folders):
            path = _free_region_path(selection.change_region(state, i, None), region.name, folders[0])
            named = replace(region, name=path.name.removesuffix(selection.SUFFIX), path=path)
            state = selection.change_region(state, i, named)
    return state


def _is_inside(path: Path, folders: Sequence[Path]) -> bool:
    """Whether a region's file may be there: in a folder that exists, below one of `folders`."""
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
    """Whether it is a regular file that is called as a region's, or nothing yet; a link is neither."""
    try:
        return path.name.endswith(selection.SUFFIX) and stat.S_ISREG(os.lstat(path).st_mode)
    except FileNotFoundError:
        return True
    except (OSError, ValueError):  # a name that no file can have
        return False


def _free_region_path(state: SelectionState, name: str, folder: Path, current: Path | None = None) -> Path:
    """A file in `folder` that no region and no other file has."""

    def path(free: str) -> Path:
        return folder / f"{free}{selection.SUFFIX}"

    others = {region.path for region in state.regions}

    def is_taken(free: str) -> bool:
        return path(free) in others or (path(free) != current and os.path.lexists(path(free)))

    return path(selection.free_name(state, name, is_taken))
