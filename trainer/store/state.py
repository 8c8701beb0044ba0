"""RUN/state: saved state of a run, which resumes bit for bit after a stop at any moment.

    state/run.json                  identity of the run: options, scene, region; exists during the whole run
    state/PART.safetensors          one part, such as the optimizer: tensors, and JSON values in the header
    state/PART/000012.safetensors   one entry of a growing list, such as the recordings

Every file is written under a temporary name, flushed to the disk and renamed, so that kill -9 leaves the last
complete one. No file is ever executed. Without run.json there is nothing to resume, whatever else exists.
"""

from __future__ import annotations

import json
import shutil
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, Protocol

import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write
from progdf.io.json_values import convert_json, decode_json
from progdf.io.tensors import read_tensors, write_tensors
from progdf.system.files import flush_to_disk
from progdf.system.processes import ENDINGS, handle_signals


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGTERM and SIGHUP too, so that they end a run like Ctrl-C."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    with handle_signals((signal.SIGINT, *ENDINGS), stop):
        yield


@contextmanager
def defer_signals() -> Iterator[Callable[[], bool]]:
    """Defer Ctrl-C, SIGTERM and SIGHUP; the yielded function returns True after one of them.

    Call it where the state is consistent. If it returns True, save and raise KeyboardInterrupt. A second
    signal raises at once, and a deferred signal raises at the end of the block.
    """
    received = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal received
        if received:
            raise KeyboardInterrupt
        received = True

    with handle_signals((signal.SIGINT, *ENDINGS), note):
        yield lambda: received
    if received:
        raise KeyboardInterrupt


SHARE = 0.01
"""Largest share of the time that saving the state may take."""
SAVE_EVERY = 3.0
"""Seconds between two saves, more if saving takes long; 0 saves after every step. A window that waits for the
run shows the newest recording."""


@dataclass(frozen=True)
class Saved:
    """Saved values of one part."""

    tensors: Mapping[str, Tensor]  # by name
    values: Mapping[str, Any]  # JSON values by name; floats come back bit for bit


class Resumable(Protocol):
    """Training that can be stopped and resumed between any two steps.

    One example is the members' optimization (`PgsState`). Everything that trains with it, such as a jointly
    fitted field, implements both methods and is passed to `PeriodicSave` under its own name. All members of
    one `PeriodicSave` are saved in one file, so that they are always of the same step.

    The saved values must determine every later bit: parameters, Adam moments, the step count, and the state
    of every random generator (a uint8 tensor, see `Generator.get_state()`). Values that can be computed again
    from the run's inputs and the recordings are left out. Dropout and similar layers need their own
    generator.
    """

    def capture_state(self) -> Saved:
        """Return everything that the next steps depend on; the tensors may be the live ones."""
        ...

    def restore(self, saved: Saved) -> None:
        """Restore the result of `capture_state` from a run with the same options."""
        ...


_writing: dict[Path, Future[float]] = {}  # last save of each folder that `wait` has not waited for


@cache
def _writer() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="state")


@dataclass(frozen=True)
class StateFolder:
    """The folder RUN/state.

    A short part of a run that gives the same bits when repeated need not be saved while it runs: `save` its
    result at the end, and `load` it when the run resumes (None: not finished yet).
    """

    path: Path

    @property
    def _run(self) -> Path:
        return self.path / "run.json"

    def identity(self) -> dict[str, Any] | None:
        """Return the identity passed to `begin`; None if there is no stopped run."""
        try:
            return convert_json(decode_json(self._run.read_bytes()), dict[str, Any])
        except (FileNotFoundError, NotADirectoryError):
            return None
        except ValueError as error:
            raise self.damage_error(self._run, error) from error

    def begin(self, identity: Mapping[str, Any]) -> None:
        """Delete the saved state and start a new run described by `identity` (JSON values).

        Raises:
            ProgdfError: the folder is a link; links are not followed.
        """
        if self.path.is_symlink():
            raise ProgdfError(f"{self.path} is a link, which is not followed; remove the link")
        self.clear()
        self.path.mkdir(exist_ok=True)
        with atomic_write(self._run) as temporary_file:
            temporary_file.write_text(
                json.dumps(identity, indent=2, ensure_ascii=False) + "\n", encoding="utf-8"
            )
            flush_to_disk(temporary_file)

    def save(
        self, part: str, tensors: Mapping[str, Tensor], values: Mapping[str, Any], index: int | None = None
    ) -> None:
        """Save a part of the run, or one entry of a growing list.

        Raises:
            OSError: the disk is full or the folder is gone; earlier saves remain intact.
        """
        self.save_later(part, tensors, values, index)
        self.wait()

    def save_later(
        self, part: str, tensors: Mapping[str, Tensor], values: Mapping[str, Any], index: int | None = None
    ) -> Future[float]:
        """Save in a thread, after all earlier saves: a disk can take seconds to flush a file.

        Args:
            part, values, index: see `save`
            tensors: must not change until the save ends

        Returns:
            The seconds that the save took. `wait` and all later saves raise its exception too.
        """
        path = self._file(part, index)
        before = _writing.get(self.path)
        header = {"values": json.dumps(dict(values), ensure_ascii=False)}
        tensors = {name: tensor.cpu() for name, tensor in tensors.items()}

        def write() -> float:
            if before is not None:
                before.result()
            begun = time.perf_counter()
            if index is not None and self.path.is_dir():
                path.parent.mkdir(exist_ok=True)
            with atomic_write(path) as temporary_file:
                write_tensors(temporary_file, tensors, header)
                flush_to_disk(temporary_file)
            return time.perf_counter() - begun

        _writing[self.path] = _writer().submit(write)
        return _writing[self.path]

    def wait(self) -> None:
        """Wait until everything is saved. Raises OSError if a save failed, see `save`."""
        writing = _writing.pop(self.path, None)
        if writing is not None:
            writing.result()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Wait for all saves at the end of the block, also after an exception; see `wait`."""
        try:
            yield
        finally:
            self.wait()

    def load(self, part: str, index: int | None = None) -> Saved | None:
        """Return the saved values of a part; None if there are none.

        Raises:
            ProgdfError: the file is damaged.
        """
        self.wait()
        path = self._file(part, index)
        if not path.is_file():
            return None
        try:
            tensors, metadata = read_tensors(path)
            return Saved(tensors, convert_json(decode_json(metadata["values"]), dict[str, Any]))
        except (OSError, KeyError, ValueError) as error:
            raise self.damage_error(path, error) from error

    def has(self, part: str) -> bool:
        """Return True if a part was saved."""
        self.wait()
        return self._file(part, None).is_file()

    @contextmanager
    def restore_part(self, part: str) -> Iterator[None]:
        """Turn exceptions of the block, which restores a part, into a one-line ProgdfError; see `load`."""
        try:
            yield
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError) as error:
            raise self.damage_error(self._file(part, None), type(error).__name__) from error

    def clear(self) -> None:
        """Remove everything, run.json first, so that leftovers are not a run. Links are not followed."""
        if self.path.is_symlink():
            return
        self._run.unlink(missing_ok=True)
        for entry in self.path.iterdir() if self.path.is_dir() else ():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)

    def end(self) -> None:
        """Remove the folder of a finished run."""
        self.wait()
        self.clear()
        shutil.rmtree(self.path, ignore_errors=True)  # not if it is a link

    def damage_error(self, path: Path, reason: object) -> ProgdfError:
        """Return the error for a damaged file of the state."""
        return ProgdfError(f"{path} is damaged ({reason}); delete {self.path} and train again")

    def _file(self, part: str, index: int | None) -> Path:
        return self.path / (f"{part}.safetensors" if index is None else f"{part}/{index:06d}.safetensors")


class PeriodicSave:
    """Periodic save of everything that trains together, in one file; training continues during the write.

    Args:
        folder: destination
        part: name of the file
        members: objects that train, by name
        every_s: seconds between two saves, longer if saving would take more than a hundredth of the time; 0
            saves after every step; None: `SAVE_EVERY`
    """

    def __init__(
        self,
        folder: StateFolder,
        part: str,
        members: Mapping[str, Resumable],
        every_s: float | None = None,
    ) -> None:
        self.seconds = 0.0  # during which training was blocked
        self.saves = 0
        self._folder = folder
        self._part = part
        self._members = members
        self._every_s = SAVE_EVERY if every_s is None else every_s
        self._last = time.perf_counter()
        self._writing: Future[float] | None = None
        self._written = 0.0  # seconds of writing in the thread

    def restore(self) -> bool:
        """Restore every member from the file; return False if nothing was saved."""
        saved = self._folder.load(self._part)
        if saved is None:
            return False
        with self._folder.restore_part(self._part):
            for name, member in self._members.items():
                tensors = {
                    key.removeprefix(f"{name}/"): tensor
                    for key, tensor in saved.tensors.items()
                    if key.startswith(f"{name}/")
                }
                member.restore(Saved(tensors, saved.values[name]))
        return True

    def step_done(self) -> None:
        """Save if a save is due."""
        if self._writing is not None and not self._writing.done():
            return
        self._finish_write()
        cost = (self.seconds + self._written) / max(1, self.saves)
        if not self._every_s or time.perf_counter() - self._last >= max(self._every_s, cost / SHARE):
            self.save(waits=not self._every_s)

    def save(self, waits: bool = True) -> None:
        """Save now and wait for the disk. Raises OSError on failure; the last save remains intact."""
        begun = time.perf_counter()
        parts = {name: member.capture_state() for name, member in self._members.items()}
        tensors = {
            f"{n}/{key}": t.detach().clone() for n, part in parts.items() for key, t in part.tensors.items()
        }
        values = {name: part.values for name, part in parts.items()}
        self._writing = self._folder.save_later(self._part, tensors, values)
        if waits:
            self._finish_write()
        self._last = time.perf_counter()
        self.seconds += self._last - begun
        self.saves += 1

    def _finish_write(self) -> None:
        """Wait for the current write and raise its exception."""
        if self._writing is not None:
            self._written += self._writing.result()
            self._writing = None


def generator(state: Tensor) -> torch.Generator:
    """Return a random generator in a state from `Generator.get_state()`. [n] uint8"""
    restored = torch.Generator()
    restored.set_state(state)
    return restored
