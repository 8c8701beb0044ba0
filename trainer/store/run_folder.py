"""The run folder: its layout, the check that a folder belongs to the edit, and pictures of views.

RUN/draft.gdf                                    a color grade for use until NAME.gdf exists
RUN/NAME.gdf  trajectory.safetensors  cameras.json  report.json  report.png  log.txt
RUN/views/original|mask|final/VIEW.png           the view before the edit, the region's mask, after the edit
RUN/views/edited/VIEW.png, edited/0.25/VIEW.png  the editor's pictures at strength 1 and at other strengths
RUN/views/painted/…                              pictures of a learned editor, see editors/cache.py
RUN/segmented/PROMPT/VIEW.png                    masks of text:"…"; the folder can be used as masks:DIR
RUN/state/…                                      saved state of a stopped run, see state.py
RUN/run.lock                                     locked during training
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
"""Name of the file that lists the pictures that the program wrote into a folder."""


def read_pictures_list(folder: Path) -> list[str]:
    """Return the lines of the folder's list of pictures; none without a readable list."""
    try:
        return (folder / PICTURES_LIST).read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []


def add_pictures(folder: Path, paths: Iterable[Path]) -> None:
    """Add files of the folder to its list."""
    lines = read_pictures_list(folder)
    new = dict.fromkeys(path.relative_to(folder).as_posix() for path in paths)
    added = [line for line in new if line not in set(lines)]
    if added:
        _write(folder, [*lines, *added])


def remove_pictures_but_of(folder: Path, views: Collection[str]) -> None:
    """Delete the listed files that belong to none of these views; links are not followed."""
    entries = []
    for line in read_pictures_list(folder):
        path = folder / line
        if _is_of_view(line, views) or not _is_inside(folder, line):
            entries.append(line)
        elif os.path.isfile(path):  # pathlib's is_file raises if a name is too long
            path.unlink()
    if read_pictures_list(folder) != entries:
        _write(folder, entries)


def _is_of_view(line: str, views: Collection[str]) -> bool:
    """Return True if a listed file belongs to a view: VIEW.png, KIND/VIEW.png or KIND/0.25/VIEW.png."""
    path = PurePosixPath(line)
    parts = (*path.parent.parts, path.stem)
    folders = 1
    if len(parts) > 2 and math.isfinite(number_of(parts[1])):
        folders = 2
    return any("/".join(parts[first:]) in views for first in range(folders + 1))


def _is_inside(folder: Path, line: str) -> bool:
    """Return True if a line names a path inside the folder that passes through no link."""
    parts = PurePosixPath(line)
    if parts.is_absolute() or ".." in parts.parts or not parts.parts:
        return False
    paths = [folder / part for part in (parts, *parts.parents)]  # the last is the folder itself
    return not any(path.is_symlink() for path in paths)


def _write(folder: Path, lines: Iterable[str]) -> None:
    atomic.write_file(folder / PICTURES_LIST, "".join(f"{line}\n" for line in lines))


_SIGNATURE = "progdf train"  # start of log.txt, which marks a run folder
# files of the saved state of a run that has not trained yet
_STATE_BEFORE_TRAINING = {"run.json", "progress.json", "region.safetensors", "edited.safetensors"}
_LOCK_WAIT_S = 1.0  # a window that checks whether a run is locked holds the lock briefly


_A = TypeVar("_A")
_T = TypeVar("_T")


class ResumableError(ProgdfError):
    """Error after which the run can continue with --resume, such as a full disk."""


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    root: Path

    @property
    def trajectory(self) -> Path:
        """Recorded trajectory."""
        return self.root / FILE_NAME

    @property
    def cameras(self) -> Path:
        """Cameras of all views, for `progdf.load_cameras`."""
        return self.root / "cameras.json"

    @property
    def report(self) -> Path:
        """Figures of the run, JSON."""
        return self.root / "report.json"

    @property
    def behind(self) -> Path:
        """Picture from behind of the edit as it could be carried on, with its camera; may be absent."""
        return self.root / "behind.png"

    @property
    def picture(self) -> Path:
        """Figures of the run as a picture."""
        return self.root / "report.png"

    @property
    def segment_masks(self) -> Path:
        """Masks of text:"…", one folder per prompt, made before the run begins."""
        return self.root / "segmented"

    @property
    def log(self) -> Path:
        """Log of the run."""
        return self.root / "log.txt"

    @property
    def progress(self) -> Path:
        """Progress of the run, JSON, for programs that wait for it; removed with the state at the end."""
        return self.root / "state" / "progress.json"

    @property
    def state(self) -> StateFolder:
        """Saved state for resuming a stopped run."""
        return StateFolder(self.root / "state")

    def gdf(self, name: str) -> Path:
        """Return the path of the edit."""
        return self.root / f"{name}.gdf"

    @property
    def draft(self) -> Path:
        """Color grade of the edit, for use during training."""
        return self.root / "draft.gdf"

    @property
    def views(self) -> Path:
        """Pictures of the views, one folder per kind, and the list of the pictures that the run wrote."""
        return self.root / "views"

    @property
    def paintings(self) -> Path:
        """Pictures of a learned editor, with their own list."""
        return self.views / "painted"

    def view(self, kind: str, name: str, strength: float = 1.0) -> Path:
        """Return the path of a view's picture; `kind` is original, edited, mask or final."""
        folder = self.views / kind
        return (folder if strength == 1.0 else folder / f"{strength:g}") / f"{name}.png"


def check_folder(root: Path, edit: Mapping[str, str]) -> RunFolder:
    """Return the run's folder if a run of this edit may use it; nothing is created.

    Args:
        root: the folder
        edit: values that identify the edit (scene, region, editor)

    Raises:
        ProgdfError: it is a file, is neither empty nor a run, or holds a run of another edit.
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
        for key, value in edit.items():
            if earlier.get(key) != value:
                raise ProgdfError(
                    f"{root} holds a run with another {key} ({earlier.get(key)}); "
                    "give --out another folder, or delete this one"
                )
    return folder


def open_run_folder(root: Path, edit: Mapping[str, str]) -> RunFolder:
    """Create the run's folder, or reuse the one of an earlier run of the same edit; see `check_folder`."""
    folder = check_folder(root, edit)
    atomic.make_folder(root)
    return folder


@contextlib.contextmanager
def remove_refused_run(folder: RunFolder) -> Iterator[None]:
    """Leave no files of a new run that is refused: it ends with a ProgdfError before any work is saved.

    Work is a painted picture of a learned editor, a mask of text:"…", or a part of the training. It stays, as
    it takes long to make. A folder that held a run before stays as it is.
    """
    root = folder.root
    is_new = not os.path.lexists(folder.log)
    missing = [path for path in (root, *root.parents) if not os.path.lexists(path)]
    try:
        yield
    except ResumableError:
        raise
    except ProgdfError:
        if is_new and not (os.path.isdir(root) and _has_work(folder)):
            with contextlib.suppress(OSError, ProgdfError):
                if os.path.isdir(root):
                    with lock_folder(folder):
                        _remove_refused_files(folder)
                    (root / atomic.LOCK).unlink(missing_ok=True)
                for path in missing:
                    if os.path.isdir(path):
                        path.rmdir()
        raise


def _has_work(folder: RunFolder) -> bool:
    """Return True if the folder holds work of a run that is not made again at once."""
    state = folder.state.path
    saved = {entry.name for entry in state.iterdir()} if state.is_dir() else set[str]()
    return bool(saved - _STATE_BEFORE_TRAINING) or bool(read_pictures_list(folder.paintings))


def _remove_refused_files(folder: RunFolder) -> None:
    """Delete the files of a run that has not trained yet; other files stay."""
    remove_pictures_but_of(folder.views, ())
    for path in (folder.views / PICTURES_LIST, *folder.paintings.glob("*.log")):
        path.unlink(missing_ok=True)
    for directory, _, _ in os.walk(folder.views, topdown=False):
        with contextlib.suppress(OSError):  # holds another file
            Path(directory).rmdir()
    for path in (folder.draft, folder.cameras, folder.log):
        path.unlink(missing_ok=True)
    folder.state.end()


def begin_log(folder: RunFolder, edit: Mapping[str, str]) -> None:
    """Start a new log.txt; its first line marks the folder as a run and identifies the edit."""
    atomic.write_file(folder.log, f"{_SIGNATURE} {json.dumps(dict(edit), ensure_ascii=False)}\n")


@contextlib.contextmanager
def lock_folder(folder: RunFolder) -> Iterator[None]:
    """Hold an exclusive lock on the run folder.

    Raises:
        ProgdfError: another process trains in the folder, or the folder cannot be written to.
    """
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(atomic.hold_lock(folder.root / atomic.LOCK, _LOCK_WAIT_S))
        except atomic.LockedError:
            raise ProgdfError(
                f"{folder.root} is being trained by another process; wait for it, or stop it first"
            ) from None
        yield


def remove_leftovers(folder: RunFolder) -> None:
    """Delete the temporary files of a killed run."""
    for directory, _, _ in os.walk(folder.root):
        atomic.remove_abandoned(Path(directory))


def write_views(folder: RunFolder, kind: str, pictures: Mapping[str, Tensor], strength: float = 1.0) -> None:
    """Write one PNG per view. `pictures`: by view name, [H,W,3] or [H,W]"""
    paths = [folder.view(kind, name, strength) for name in pictures]
    map_threads(lambda pair: write_image(*pair), list(zip(paths, pictures.values(), strict=True)))
    add_pictures(folder.views, paths)


def read_views(
    folder: RunFolder, kind: str, cameras: Iterable[Camera], strength: float = 1.0
) -> Sequence[Tensor]:
    """Return the pictures of the cameras' views, see `stored_pictures`. [H,W,3] each

    Raises:
        ProgdfError: a picture is missing, broken, or differs in size from its camera.
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

    return stored_pictures(read, list(cameras))


def read_run_cameras(folder: RunFolder, held_out: Iterable[str], origin: Origin) -> list[Camera]:
    """Return the cameras of a run's views, checked against the pictures that the run wrote.

    Args:
        folder: a finished run
        held_out: names of the views that the edit was not trained on
        origin: the scene's, to which the cameras are relative

    Raises:
        ProgdfError: cameras.json is broken, or its views differ from the run's in names, number or size.
    """
    cameras = load_cameras(folder.cameras, origin)
    remedy = f"restore {folder.cameras}, or train again"
    names = [camera.name for camera in cameras]
    for name in names:
        if not is_view_name(name):
            raise ProgdfError(
                f"{folder.cameras} has a camera named '{name}', not a valid view name; {remedy}"
            )
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
    """Sequence of values too large to keep, which `make` computes from the items at every access."""

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


def stored_pictures(make: Callable[[_A], Tensor], items: Sequence[_A]) -> LazySequence[Tensor]:
    """Make the pictures of 8-bit files, and keep them in a quarter of their memory, without loss.

    Args:
        make: reads or cuts the picture of an item, on the threads of the cpu engine. [H,W,3] float32
        items: files, cameras or indices
    """
    return LazySequence(map_threads(lambda item: to_bytes(make(item)), items), from_bytes)


def to_bytes(image: Tensor) -> Tensor:
    """Quantize an image as an 8-bit file does. [H,W,3] 0 to 1 -> [H,W,3] uint8"""
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def from_bytes(stored: Tensor) -> Tensor:
    """Convert the result of `to_bytes` back. [H,W,3] uint8 -> [H,W,3] 0 to 1"""
    return stored.float() / 255.0


def quantize_image(image: Tensor) -> Tensor:
    """Return an image after rounding to 8 bits. [H,W,3] -> [H,W,3]"""
    return from_bytes(to_bytes(image))


def remove_stale_views(folder: RunFolder, names: Sequence[str]) -> None:
    """Delete pictures of views that only an earlier run of the same edit had."""
    for directory in (folder.views, folder.paintings):
        remove_pictures_but_of(directory, set(names))


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file atomically."""
    atomic.write_file(path, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
