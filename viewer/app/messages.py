"""Messages and dialogs of the window, and reports of failures as messages and log lines."""

from __future__ import annotations

import logging
import platform
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from logging.handlers import RotatingFileHandler
from typing import Any, Protocol, TypeVar

from progdf import __version__
from progdf.errors import ProgdfError, without_commands
from progdf.io.atomic import state_folder
from viewer.state.commands import Action
from viewer.state.workspace import CANCEL, Dialog, Message, Store, on_one_line, with_message, with_question

LOG = "window.log"


class Messages:
    """Messages, dialogs and requests that the parts of the window put into its state.

    Args:
        store: state of the window
        clock: returns the time of the window's clock, in seconds
    """

    def __init__(self, store: Store, clock: Callable[[], float]) -> None:
        self._store = store
        self._clock = clock

    def show(
        self, text: str, error: bool = False, details: str = "", button: tuple[str, Action] | None = None
    ) -> None:
        """Show one line at the bottom of the picture for a while, with a button (label and command)."""
        work = self._store.get()
        self._store.replace(with_message(work, text, self._clock(), error, details, button=button))
        self._store.wake()

    @property
    def current(self) -> Message | None:
        """The message on screen."""
        return self._store.get().message

    def clear(self) -> None:
        """Remove the message on screen."""
        self._store.replace(replace(self._store.get(), message=None))
        self._store.wake()

    def offer(self, text: str, *buttons: tuple[str, Action], error: bool = False) -> None:
        """Show one line below the axes with buttons (label and command), until one of them is pressed."""
        self._store.replace(with_question(self._store.get(), text, buttons, error))
        self._store.wake()

    def ask(self, dialog: Dialog) -> None:
        """Open a dialog over the picture."""
        self._store.replace(replace(self._store.get(), dialog=dialog))
        self._store.wake()

    def request(self, request: Action) -> None:
        """Add a request that the window performs after the next frame."""
        work = self._store.get()
        self._store.replace(replace(work, requests=(*work.requests, request)))
        self._store.wake()


class WorkSign:
    """Message about work in progress. It stays until the work ends; other messages stay for their time.

    Args:
        messages: messages to the user
    """

    def __init__(self, messages: Messages) -> None:
        self._messages = messages
        self._shown = ""

    def show(self, text: str, cancel: Action | None = None) -> None:
        """Show the state of the work, with a button that cancels it if there is a command for that."""
        text = on_one_line(text)
        message = self._messages.current
        is_own = message is None or not self._shown or message.text == self._shown
        if is_own and (message is None or text != self._shown):
            self._shown = text
            self._messages.show(text, button=None if cancel is None else (CANCEL, cancel))

    def end(self) -> None:
        """Remove the message."""
        message = self._messages.current
        if message is not None and message.text == self._shown:
            self._messages.clear()
        self._shown = ""


_Made = TypeVar("_Made")


class WaitFor(Protocol):
    """Function that runs work in another thread while the window shows a text, and returns its result."""

    def __call__(self, work: Callable[[], _Made], text: str) -> _Made: ...


Requests = dict[str, Callable[[Any], object]]
"""Functions of the commands that one part of the application performs; they receive the `argument`."""


def attempt(messages: Messages, act: Callable[[], object]) -> None:
    """Run an action; show a failure as a message in the window."""
    if error := failure_line(act):
        messages.show(error, error=True)


def failure_line(act: Callable[[], object]) -> str:
    """Run an action and return its failure in one line, "" for success. Internal errors are raised."""
    try:
        act()
    except (ProgdfError, OSError) as error:
        return error_line(error)
    return ""


def error_line(error: Exception) -> str:
    """Return a user-facing error in one line without commands; "" for an internal error."""
    if isinstance(error, ProgdfError):
        return without_commands(str(error))
    if isinstance(error, OSError):
        return f"{error.filename or 'the file'} cannot be read or written: {error.strerror or error}"
    return ""


def error_details(error: Exception) -> str:
    """Return an internal error with everything that a bug report needs."""
    system = f"progdf {__version__}, Python {platform.python_version()}, {platform.platform()}"
    return f"{system}\n\n{''.join(traceback.format_exception(error))}"


def log_error(details: str) -> None:
    """Append the details to window.log in the program's state folder, which keeps the last 1 to 2 MB."""
    folder = state_folder()
    with suppress(OSError):  # if the log cannot be written, the message still has the details
        folder.mkdir(parents=True, exist_ok=True)
        file = RotatingFileHandler(
            folder / LOG, maxBytes=1 << 20, backupCount=1, encoding="utf-8", errors="backslashreplace"
        )
        file.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
        file.emit(logging.makeLogRecord({"msg": details}))
        file.close()


REPEAT_MESSAGE_S = 10.0
"""Seconds until an error that repeats in every frame is shown again."""


class ErrorReporter:
    """Reports of the errors that parts of the window's loop raise.

    Args:
        messages: messages to the user
        frame: returns the number of frames drawn
        keep_work: writes unsaved work to its recovery file; returns a line about the result
    """

    def __init__(self, messages: Messages, frame: Callable[[], int], keep_work: Callable[[], str]) -> None:
        self._messages = messages
        self._frame = frame
        self._keep_work = keep_work
        # by place: frame number of the last failure, time of its last message
        self._failures: dict[str, tuple[int, float]] = {}

    def report(self, error: Exception) -> None:
        """Show an error raised by a part of the loop as a message.

        An internal error is also logged, and unsaved work is written to its recovery file at once.
        """
        where = repr(
            (type(error), [(at.filename, at.lineno) for at in traceback.extract_tb(error.__traceback__)])
        )
        frame = self._frame()
        now = time.perf_counter()
        before, shown_at = self._failures.get(where, (-2, 0.0))
        repeats = frame - before <= 1 and now - shown_at < REPEAT_MESSAGE_S
        self._failures[where] = frame, shown_at if repeats else now
        if repeats:
            return  # an error that repeats in every frame requests no further frame
        line = error_line(error)
        details = ""
        if not line:
            details = error_details(error)
            if before < 0:
                log_error(details)
            summary = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            line = f"Internal error ({summary[:200]}); {self._keep_work()}"
        self._messages.show(line, True, details)

    @contextmanager
    def guard(self) -> Iterator[None]:
        """Report an error of the block instead of raising it."""
        try:
            yield
        except Exception as error:
            self.report(error)
