"""The run folder: what lies where, whose folder it is, and pictures of views out and in.

RUN/draft.gdf  a grade alone, until NAME.gdf is there
RUN/NAME.gdf  trajectory.safetensors  cameras.json  report.json  report.png  log.txt
RUN/views/original|mask|final/VIEW.png           the view before, where the region is, after
RUN/views/edited/VIEW.png, edited/0.25/VIEW.png  what the editor made of it: finished, at other strengths
RUN/views/painted/…                              what a learned editor painted, see editors/cache.py
RUN/segmented/PROMPT/VIEW.png                    where text:"…" found it; a folder for masks:DIR
RUN/state/…                                      what a stopped run needs to go on, see state.py
RUN/run.lock                                     locked while it is trained
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar, overload

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.color.edits import number_of
from progdf.errors import ProgdfError
from progdf.field.trajectory import FILE_NAME
from progdf.gaussians import Origin
from progdf.io import atomic
from progdf.io.cameras import load_cameras
from progdf.io.images import picture_size, read_picture, write_image
from progdf.io.json_values import convert_json, decode_json
from progdf.io.picture_files import is_view_name
from progdf.threads import map_threads

from .state import StateFolder

PICTURES_LIST = "pictures.txt"


def read_pictures_list(folder: Path) -> list[str]:
    """The lines of the folder's list."""
    try:
        return (folder / PICTURES_LIST).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []


def add_pictures(folder: Path, paths: Iterable[Path]) -> None:
    """Put files in the folder on its list."""
    lines = read_pictures_list(folder)
    new = dict.fromkeys(path.relative_to(folder).as_posix() for path in paths)
    if added := [line for line in new if line not in set(lines)]:
        _write(folder, [*lines, *added])


def remove_pictures_but_of(folder: Path, views: Collection[str]) -> None:
    """Delete the listed files that are not of one of these views; nothing behind a link is touched."""
    entries = []
    for line in read_pictures_list(folder):
        path = folder / line
        if _is_of_view(line, views) or not _is_inside(folder, line):
            entries.append(line)
        elif os.path.isfile(path):  # pathlib's raises where a name is too long
            path.unlink()
    if read_pictures_list(folder) != entries:
        _write(folder, entries)


def _is_of_view(line: str, views: Collection[str]) -> bool:
    """Return whether a listed file is a view's: VIEW.png, KIND/VIEW.png or KIND/0.25/VIEW.png."""
    path = PurePosixPath(line)
    parts = (*path.parent.parts, path.stem)
    folders = 1
    if len(parts) > 2 and math.isfinite(number_of(parts[1])):
        folders = 2
    return any("/".join(parts[first:]) in views for first in range(folders + 1))


def _is_inside(folder: Path, line: str) -> bool:
    """Whether a line leads to a place in the folder, through no link."""
    parts = PurePosixPath(line)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts:
        return False
    places = [folder / part for part in (parts, *parts.parents)]  # the last is the folder itself
    return not any(path.is_symlink() for path in places)


def _write(folder: Path, lines: Iterable[str]) -> None:
    atomic.write_file(folder / PICTURES_LIST, "".join(f"{line}\n" for line in lines))


_SIGNATURE = "progdf train"
_LOOK_S = 1.0  # a window that asks whether a run is locked holds the lock for a moment


_T = TypeVar("_T")


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    root: Path

    @property
    def trajectory(self) -> Path:
        """The recorded trajectory."""
        return self.root / FILE_NAME

    @property
    def cameras(self) -> Path:
        """All views' cameras, `progdf.load_cameras` reads them."""
        return self.root / "cameras.json"

    @property
    def report(self) -> Path:
        """Figures, JSON."""
        return self.root / "report.json"

    @property
    def picture(self) -> Path:
        """Figures, to look at."""
        return self.root / "report.png"

    @property
    def segment_masks(self) -> Path:
        """Masks of text:"…", a folder a prompt; they are made before the run begins."""
        return self.root / "segmented"

    @property
    def log(self) -> Path:
        """What happened."""
        return self.root / "log.txt"

    @property
    def progress(self) -> Path:
        """How far a run has come, JSON, for programs that wait for it; gone with the state when it ends."""
        return self.root / "state" / "progress.json"

    @property
    def state(self) -> StateFolder:
        """What a stopped run needs to go on."""
        return StateFolder(self.root / "state")

    def gdf(self, name: str) -> Path:
        """The edit."""
        return self.root / f"{name}.gdf"

    @property
    def draft(self) -> Path:
        """A grade alone of the edit, while it is trained."""
        return self.root / "draft.gdf"

    @property
    def views(self) -> Path:
        """Pictures of the views, a folder a kind, and the list of those that the run has written."""
        return self.root / "views"

    @property
    def paintings(self) -> Path:
        """What a learned editor painted, with a list of its own."""
        return self.views / "painted"

    def view(self, kind: str, name: str, strength: float = 1.0) -> Path:
        """A view's picture; `kind` is original, edited, mask or final."""
        folder = self.views / kind
        return (folder if strength == 1.0 else folder / f"{strength:g}") / f"{name}.png"


def check_folder(root: Path, edit: Mapping[str, str]) -> RunFolder:
    """The run's folder, if a run of this edit may be put there; nothing is made.

    Args:
        root: the folder
        edit: what identifies the edit (scene, region, editor)

    Raises:
        ProgdfError: it is a file, or holds no run, or the run of another edit.
    """
    if root.exists() and not root.is_dir():
        raise ProgdfError(f"{root} is a file; give --out a folder")
    folder = RunFolder(root)
    if root.is_dir() and not all(
        atomic.is_temporary(entry.name) or entry.name == atomic.LOCK or entry == folder.segment_masks
        for entry in root.iterdir()
    ):
        first = (
            folder.log.read_text(encoding="utf-8", errors="replace").split("\n", 1)[0]
            if folder.log.is_file()
            else ""
        )
        if not first.startswith(_SIGNATURE):
            raise ProgdfError(f"{root} is neither empty nor a run of progdf train; give --out another folder")
        earlier: dict[str, Any] = {}
        with contextlib.suppress(ValueError):
            earlier = convert_json(decode_json(first.removeprefix(_SIGNATURE)), dict[str, Any])
        for what, value in edit.items():
            if earlier.get(what) != value:
                raise ProgdfError(
                    f"{root} holds a run with another {what} ({earlier.get(what)}); "
                    "give --out another folder, or delete this one"
                )
    return folder


def open_run_folder(root: Path, edit: Mapping[str, str]) -> RunFolder:
    """Make the run's folder, or take over that of an earlier run of the same edit; see `check_folder`."""
    folder = check_folder(root, edit)
    atomic.make_folder(root)
    return folder


def begin_log(folder: RunFolder, edit: Mapping[str, str]) -> None:
    """A new log.txt; its first line says that the folder is a run, and of which edit."""
    atomic.write_file(folder.log, f"{_SIGNATURE} {json.dumps(dict(edit), ensure_ascii=False)}\n")


@contextlib.contextmanager
def lock_folder(folder: RunFolder) -> Iterator[None]:
    """Nobody else trains in this folder meanwhile.

    Raises:
        ProgdfError: somebody does, or the folder cannot be written to.
    """
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(atomic.hold_lock(folder.root / atomic.LOCK, _LOOK_S))
        except atomic.LockedError:
            raise ProgdfError(
                f"{folder.root} is being trained by another process; wait for it, or stop it first"
            ) from None
        yield


def remove_leftovers(folder: RunFolder) -> None:
    """Delete what a run that was killed was just about to write."""
    for directory, _, _ in os.walk(folder.root):
        atomic.remove_abandoned(Path(directory))


def write_views(folder: RunFolder, kind: str, pictures: Mapping[str, Tensor], strength: float = 1.0) -> None:
    """One PNG per view. Pictures by view name, [H,W,3] or [H,W]."""
    paths = [folder.view(kind, name, strength) for name in pictures]
    map_threads(lambda pair: write_image(*pair), list(zip(paths, pictures.values(), strict=True)))
    add_pictures(folder.views, paths)


def read_views(
    folder: RunFolder, kind: str, cameras: Iterable[Camera], strength: float = 1.0
) -> Sequence[Tensor]:
    """Return the pictures of the cameras' views, see `stored_pictures`. [H,W,3] each

    Raises:
        ProgdfError: a picture is missing, broken, or of another size than its camera.
    """
    remedy = "train again, with --resume if the run was stopped"

    def read(camera: Camera) -> Tensor:
        path = folder.view(kind, camera.name, strength)
        try:
            picture = read_picture(path)
        except ProgdfError as error:
            fault = "is damaged" if path.is_file() else "is missing"
            raise ProgdfError(f"{path} {fault}; {remedy}") from error
        height, width = picture.shape[:2]
        if (width, height) != (camera.width, camera.height):
            expected = f"{camera.width}x{camera.height}"
            raise ProgdfError(f"{path} is {width}x{height} pixels, its view {expected}; {remedy}")
        return picture

    return stored_pictures(map(read, cameras))


def read_run_cameras(folder: RunFolder, held_out: Iterable[str], origin: Origin) -> list[Camera]:
    """Return the cameras of a run's views, after a comparison with the pictures that the run wrote.

    Args:
        folder: a finished run
        held_out: names of the views that the edit was not trained on
        origin: of the scene, which the cameras are relative to

    Raises:
        ProgdfError: cameras.json is broken, or its views differ from the run's in names, number or size.
    """
    cameras = load_cameras(folder.cameras, origin)
    remedy = f"restore {folder.cameras}, or train again"
    names = [camera.name for camera in cameras]
    for name in names:
        if not is_view_name(name):
            raise ProgdfError(f"{folder.cameras} has a camera named '{name}', which names no view; {remedy}")
        if names.count(name) > 1:
            raise ProgdfError(f"{folder.cameras} has {names.count(name)} cameras named {name}; {remedy}")
    originals = [
        PurePosixPath(line) for line in read_pictures_list(folder.views) if line.startswith("original/")
    ]
    written = [path.relative_to("original").with_suffix("").as_posix() for path in originals]
    for name in (*written, *held_out):
        if name not in names:
            raise ProgdfError(f"{folder.cameras} lacks the camera of the run's view {name}; {remedy}")
    for camera in cameras:
        path = folder.view("original", camera.name)
        if not path.is_file():
            continue
        width, height = picture_size(path)
        if (width, height) != (camera.width, camera.height):
            raise ProgdfError(
                f"{folder.cameras} has the view {camera.name} with {camera.width}x{camera.height} pixels, "
                f"{path} has {width}x{height}; {remedy}"
            )
    return cameras


class LazySequence(Sequence[_T]):
    """What `make` makes of each of some items, anew at each look: for what is too large to keep."""

    def __init__(self, items: Sequence[Any], make: Callable[[Any], _T]) -> None:
        self._items = items
        self._make = make

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, index: int) -> _T: ...
    @overload
    def __getitem__(self, index: slice) -> LazySequence[_T]: ...
    def __getitem__(self, index: int | slice) -> _T | LazySequence[_T]:
        if isinstance(index, slice):
            return LazySequence(self._items[index], self._make)
        return self._make(self._items[index])


def stored_pictures(pictures: Iterable[Tensor]) -> LazySequence[Tensor]:
    """Pictures of 8-bit files, kept in a quarter of their memory. [H,W,3] float32 each, as they were"""
    return LazySequence([to_bytes(picture) for picture in pictures], from_bytes)


def to_bytes(image: Tensor) -> Tensor:
    """What an 8-bit file keeps of an image. [H,W,3] 0..1 -> [H,W,3] uint8"""
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def from_bytes(stored: Tensor) -> Tensor:
    """The inverse of `to_bytes`, of what was kept."""
    return stored.float() / 255.0


def remove_stale_views(folder: RunFolder, names: Sequence[str]) -> None:
    """Delete pictures of views that an earlier run of the same edit had and this one has not."""
    for directory in (folder.views, folder.paintings):
        remove_pictures_but_of(directory, set(names))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write JSON, whole or not at all."""
    atomic.write_file(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
