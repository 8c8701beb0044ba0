"""RUN/state: what a run needs to go on after it was stopped at any moment, to the same bits.

    state/run.json                  which run it is: options, scene, region; from first moment to last
    state/PART.safetensors          one part of it, such as what trains: tensors, JSON values in the header
    state/PART/000012.safetensors   one entry of a list that only grows, such as the recordings

Every file is written beside its place, flushed to the disk and renamed, so that kill -9 leaves the last whole
one. Nothing in them is ever executed. Without run.json there is nothing to resume, whatever else lies there.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import sys
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
from progdf.terminal import ENDINGS, handle_signals


@contextmanager
def interrupt_on_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt at SIGTERM and SIGHUP too, so that all three end a run in the same way."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise KeyboardInterrupt

    with handle_signals((signal.SIGINT, *ENDINGS), stop):
        yield


@contextmanager
def defer_signals() -> Iterator[Callable[[], bool]]:
    """Hold Ctrl-C, SIGTERM and SIGHUP back; the yielded function says whether one came.

    Ask it where the state is whole, save, and raise KeyboardInterrupt. A second signal does not wait, and
    neither does one that nobody asked about.
    """
    came = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    with handle_signals((signal.SIGINT, *ENDINGS), note):
        yield lambda: came
    if came:
        raise KeyboardInterrupt


SHARE = 0.01
"""Of the time, at most, that saving the state may take."""
SAVE_EVERY = 3.0
"""Seconds between two saves, more where saving takes long; 0: after every step. A window that waits
for the run shows the newest recording."""


@dataclass(frozen=True)
class Saved:
    """What was saved of a part."""

    tensors: Mapping[str, Tensor]  # by name
    values: Mapping[str, Any]  # JSON values by name; floats come back bit for bit


class Resumable(Protocol):
    """Something that trains for many steps and can be stopped between any two.

    The members' optimization is one (`PgsState`). Whatever trains with it, such as a field fitted
    jointly, implements these two and is given to `PeriodicSave` under a name of its own: all members of
    one `PeriodicSave` go into one file, so that they are always of the same step. What they hold must decide
    every later bit: parameters, Adam moments and the step count, and the state of every random generator,
    which is a uint8 tensor as `Generator.get_state()` gives it. What can be computed again from the run's
    inputs and the recordings stays out. Dropout and the like must draw from a generator of their own.
    """

    def capture_state(self) -> Saved:
        """Everything that the next steps depend on; the tensors may be the live ones."""
        ...

    def restore(self, saved: Saved) -> None:
        """Take over what `capture_state` gave, of a run with the same options."""
        ...


_writing: dict[Path, Future[float]] = {}  # the last save of each folder that `wait` has not seen end


@cache
def _writer() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="state")


@dataclass(frozen=True)
class StateFolder:
    """RUN/state.

    A part that is short and repeats bit for bit need not be saved while it runs: `save` its result when it is
    done, and `load` it (None: not done yet) on the way back.
    """

    path: Path

    @property
    def _run(self) -> Path:
        return self.path / "run.json"

    def identity(self) -> dict[str, Any] | None:
        """What `begin` was given; None where no run was stopped."""
        try:
            return convert_json(decode_json(self._run.read_bytes()), dict[str, Any])
        except (FileNotFoundError, NotADirectoryError):
            return None
        except ValueError as error:
            raise self.damage_error(self._run, error) from error

    def begin(self, identity: Mapping[str, Any]) -> None:
        """Drop what is saved and start anew as the run that `identity`, JSON values, describes.

        Raises:
            ProgdfError: the folder is a link, behind which nothing of the run's can be.
        """
        if self.path.is_symlink():
            raise ProgdfError(f"{self.path} is a link, which is not followed; remove the link")
        self.clear()
        self.path.mkdir(exist_ok=True)
        with atomic_write(self._run) as temporary_file:
            temporary_file.write_text(
                json.dumps(identity, indent=2, ensure_ascii=False) + "\n", encoding="utf-8"
            )
            _flush(temporary_file)

    def save(
        self, part: str, tensors: Mapping[str, Tensor], values: Mapping[str, Any], index: int | None = None
    ) -> None:
        """Save a part of the run, or one entry of a growing list.

        Raises:
            OSError: the disk is full or the folder is gone; what was saved before is still whole.
        """
        self.save_later(part, tensors, values, index)
        self.wait()

    def save_later(
        self, part: str, tensors: Mapping[str, Tensor], values: Mapping[str, Any], index: int | None = None
    ) -> Future[float]:
        """Have a thread save it, after all that it was given before: a disk can take seconds to flush a file.

        Args:
            part, values, index: see `save`
            tensors: that nobody changes meanwhile

        Returns:
            How long it took, seconds. What it raises, `wait` and all later saves raise too.
        """
        path, before = self._file(part, index), _writing.get(self.path)
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
                _flush(temporary_file)
            return time.perf_counter() - begun

        _writing[self.path] = _writer().submit(write)
        return _writing[self.path]

    def wait(self) -> None:
        """Until all is saved. Raises OSError where something could not be, see `save`."""
        if (writing := _writing.pop(self.path, None)) is not None:
            writing.result()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Whatever happens, all is saved in the end; see `wait`."""
        try:
            yield
        finally:
            self.wait()

    def load(self, part: str, index: int | None = None) -> Saved | None:
        """What was saved of a part; None where nothing was.

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

    @contextmanager
    def restore_part(self, part: str) -> Iterator[None]:
        """Take over what was saved of a part; values that do not fit make one line, see `load`."""
        try:
            yield
        except (LookupError, TypeError, ValueError, RuntimeError, AttributeError, OverflowError) as error:
            raise self.damage_error(self._file(part, None), type(error).__name__) from error

    def clear(self) -> None:
        """Remove everything, run.json first: a rest of it is no run. Nothing behind a link is touched."""
        if self.path.is_symlink():
            return
        self._run.unlink(missing_ok=True)
        for entry in self.path.iterdir() if self.path.is_dir() else ():
            if entry.is_dir() and not entry.is_symlink():
                shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)

    def end(self) -> None:
        """The run is finished: remove the folder."""
        self.wait()
        self.clear()
        shutil.rmtree(self.path, ignore_errors=True)  # not if it is a link

    def damage_error(self, path: Path, reason: object) -> ProgdfError:
        """The line for a file of the state that is not what was saved."""
        return ProgdfError(f"{path} is damaged ({reason}); delete {self.path} and train again")

    def _file(self, part: str, index: int | None) -> Path:
        return self.path / (f"{part}.safetensors" if index is None else f"{part}/{index:06d}.safetensors")


class PeriodicSave:
    """Saves what trains together, in one file, every so often; training goes on while it is written.

    Args:
        folder: where to
        part: name of the file
        members: what trains, by name
        every_s: seconds between two saves, longer where saving would take more than a hundredth of the time;
            0 saves after every step; None: `SAVE_EVERY`
    """

    def __init__(
        self,
        folder: StateFolder,
        part: str,
        members: Mapping[str, Resumable],
        every_s: float | None = None,
    ) -> None:
        self.seconds = 0.0  # for which training stood still
        self.saves = 0
        self._folder = folder
        self._part = part
        self._members = members
        self._every_s = SAVE_EVERY if every_s is None else every_s
        self._last = time.perf_counter()
        self._writing: Future[float] | None = None
        self._written = 0.0  # seconds that the thread has written

    def restore(self) -> bool:
        """Give every member what was saved of it; False where nothing was."""
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
        """Save if it is time to."""
        if self._writing is not None and not self._writing.done():
            return
        self._look()
        cost = (self.seconds + self._written) / max(1, self.saves)
        if not self._every_s or time.perf_counter() - self._last >= max(self._every_s, cost / SHARE):
            self.save(waits=not self._every_s)

    def save(self, waits: bool = True) -> None:
        """Save now, and wait until it is on the disk. Raises OSError where it cannot; the last save stays."""
        begun = time.perf_counter()
        parts = {name: member.capture_state() for name, member in self._members.items()}
        tensors = {
            f"{n}/{key}": t.detach().clone() for n, part in parts.items() for key, t in part.tensors.items()
        }
        values = {name: part.values for name, part in parts.items()}
        self._writing = self._folder.save_later(self._part, tensors, values)
        if waits:
            self._look()
        self._last = time.perf_counter()
        self.seconds += self._last - begun
        self.saves += 1

    def _look(self) -> None:
        """Wait for what is written now, and raise what became of it."""
        if self._writing is not None:
            self._written += self._writing.result()
            self._writing = None


def generator(state: Tensor) -> torch.Generator:
    """A random generator that goes on where the one of this `get_state()` was. [n] uint8"""
    made = torch.Generator()
    made.set_state(state)
    return made


def _flush(path: Path) -> None:
    """What is renamed into place must be on the disk before its name is."""
    handle = os.open(path, os.O_RDONLY if sys.platform != "win32" else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
