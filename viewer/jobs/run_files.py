"""What a window reads of a training run's folder while it runs, and where the runs of a scene lie.

SCENE.edits/NAME/              the run's folder, see `progdf train --out`
SCENE.edits/NAME.train.json    what was asked for, so that a stopped run can go on another day
SCENE.edits/NAME.train.log     what it printed
SCENE.edits/NAME.train.lock    locked by the window that has it in its queue: it alone writes these files
SCENE.edits/NAME.region.npy    the selection that it was made for
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import msgspec
import torch

from progdf.errors import ProgdfError
from progdf.field.keyframes import fit_lossless
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.io.atomic import LOCK, LockedError, atomic_write, hold_lock, is_locked, make_folder, state_folder
from progdf.io.json_values import read_json
from progdf.io.tensors import read_tensors
from progdf.region import Region

from .training_job import EditOrder, Progress, progress_of

ORDER, LOG, WINDOW_LOCK = ".train.json", ".train.log", ".train.lock"


class _Said(msgspec.Struct):
    """What the trainer writes while it works, RUN/state/progress.json."""

    doing: str
    done: int
    total: int
    note: str = ""
    seconds: Annotated[float, msgspec.Meta(ge=0, le=1e9)] = 0.0  # of all sessions of the run


class _Paint(msgspec.Struct):
    """Of a run on painted pictures: why little of the paint is in the edit, "" if enough is."""

    warning: str = ""


class _Report(msgspec.Struct):
    """What a finished run says of itself, RUN/report.json."""

    paint: _Paint | None = None


class _Order(msgspec.Struct):
    """`NAME.train.json`"""

    scene: str
    name: str
    region: str
    editor: str
    quick: bool
    threads: int = 0


def warning_of(order: EditOrder) -> str:
    """What a finished run warns of, "" if of nothing."""
    try:
        report = read_json(order.out / "report.json", _Report)
    except ProgdfError:
        return ""
    return report.paint.warning if report.paint is not None else ""


def edits_folder(scene: Path, memory: Path | None = None) -> Path:
    """Where new edits of a scene are trained: beside it, or in the user's own folder if that is read-only.

    Args:
        scene: its file
        memory: folder of the program's state; the user's own if None
    """
    scene = scene.resolve()
    beside = scene.with_name(f"{scene.stem}.edits")
    if takes_files(beside if beside.is_dir() else scene.parent):
        return beside
    digest = hashlib.sha256(str(scene).encode("utf-8", "surrogateescape")).hexdigest()[:8]
    return (memory or state_folder()) / "edits" / f"{scene.stem}-{digest}"


def free_run(folder: Path, name: str) -> Path:
    """A folder for a run of this name: NAME, or NAME-2 where something has that."""
    free, number = folder / name, 2
    while free.exists() or free.with_name(free.name + ORDER).exists():
        free, number = folder / f"{name}-{number}", number + 1
    return free


def keep_order(order: EditOrder) -> None:
    """Write down what is asked for.

    Raises:
        ProgdfError: the folder cannot be made or written to.
    """
    make_folder(order.out.parent)
    kept = _Order(str(order.scene), order.name, order.region, order.editor, order.quick, order.threads)
    with atomic_write(_beside(order.out, ORDER)) as temporary_file:
        temporary_file.write_bytes(msgspec.json.format(msgspec.json.encode(kept)))


def log_of(order: EditOrder) -> Path:
    """What the run printed."""
    return _beside(order.out, LOG)


def stopped_orders(folder: Path, scene: Path) -> Iterator[EditOrder]:
    """Runs of this scene that were stopped and can go on."""
    for path in sorted(folder.glob(f"*{ORDER}")):
        name = path.name.removesuffix(ORDER)
        if not name.strip("."):  # "..", whose run would be the scene's own folder
            continue
        out = path.with_name(name)
        if out.is_symlink() or not is_begun(out):
            continue
        with contextlib.suppress(ProgdfError):
            kept = read_json(path, _Order)
            if Path(kept.scene) == scene.resolve():
                yield EditOrder(
                    Path(kept.scene), out, kept.name, kept.region, kept.editor, kept.quick, kept.threads
                )


def is_begun(out: Path) -> bool:
    """Whether a run has saved something that it can go on with."""
    return os.path.isfile(out / "state" / "run.json")  # False where it may not be looked at


@contextlib.contextmanager
def hold_run(order: EditOrder) -> Iterator[None]:
    """This window alone resumes, trains or discards the run meanwhile.

    Raises:
        LockedError: another window has it in its queue, or a process trains it.
        ProgdfError: its folder cannot be written to.
    """
    make_folder(order.out.parent)
    lock = _beside(order.out, WINDOW_LOCK)
    try:
        with hold_lock(lock):
            if is_locked(order.out / LOCK):  # by a command, or by the child of a window that was killed
                raise LockedError(str(lock))
            yield
    except LockedError:
        raise LockedError(f"{order.name} trains in another window; stop it there first") from None
    if not _beside(order.out, ORDER).exists():  # it was discarded
        with contextlib.suppress(OSError):
            lock.unlink(missing_ok=True)


def is_held(order: EditOrder) -> bool:
    """Whether another window, or a process, has the run; this one must not hold it itself."""
    return is_locked(_beside(order.out, WINDOW_LOCK)) or is_locked(order.out / LOCK)


def discard(order: EditOrder) -> None:
    """Remove a run that was not finished, and what was written down of it.

    Raises:
        ProgdfError: it cannot be removed, and is whole.
    """
    if order.gdf.exists():
        return
    run = order.out / "state" / "run.json"
    if order.out.is_symlink() or run.parent.is_symlink():
        raise ProgdfError(f"{order.out} is behind a link, which is not followed; remove the link")
    try:
        run.unlink(missing_ok=True)  # first: a rest without it is no run
    except OSError as error:
        reason = error.strerror or error
        raise ProgdfError(f"{order.out} cannot be removed ({reason}); check its permissions") from error
    shutil.rmtree(order.out, ignore_errors=True)
    for suffix in (ORDER, LOG):
        with contextlib.suppress(OSError):
            _beside(order.out, suffix).unlink(missing_ok=True)


def read_progress(order: EditOrder, before: Progress) -> Progress:
    """How far the run says that it is."""
    try:
        said = read_json(order.out / "state" / "progress.json", _Said)
    except ProgdfError:
        return before
    return progress_of(said.doing, said.done, said.total, said.note, before, said.seconds)


def newest_recording(order: EditOrder) -> Path | None:
    """The file of the last recording that a run has saved; None where there is none."""
    with contextlib.suppress(OSError):
        names = [e.name for e in os.scandir(order.out / "state" / "recordings") if e.name[:1].isdigit()]
        return order.out / "state" / "recordings" / max(names) if names else None
    return None


def recorded_edit(order: EditOrder, recording: Path, scene: Gaussians) -> Gdf | None:
    """A recording as an edit of the scene, at strength 1 what is trained so far; None while it changes."""
    try:
        region, _ = read_tensors(order.out / "state" / "region.safetensors")
        offsets = read_tensors(recording)[0]["offsets"].float()
        found = Region(order.name, region["members"], region["score"])
        if len(found.score) != len(scene) or len(offsets) != len(found):
            return None
        field = fit_lossless(torch.tensor([0.0, 1.0]), torch.stack([torch.zeros_like(offsets), offsets]))
        return Gdf(order.name, found, field, fingerprint(scene), order.editor)
    except (OSError, ValueError, KeyError, ProgdfError):
        return None


def takes_files(folder: Path) -> bool:
    """Whether a folder is meant to be written to: root may write into folders that are read-only for all."""
    try:
        return bool(folder.stat().st_mode & 0o222) and os.access(folder, os.W_OK)
    except OSError:
        return False


def _beside(out: Path, suffix: str) -> Path:
    return out.with_name(out.name + suffix)
