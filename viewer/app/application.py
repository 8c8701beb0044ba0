"""Application interface for the parts of the window, and reports of failures as messages and log lines."""

from __future__ import annotations

import logging
import platform
import traceback
from collections.abc import Callable
from contextlib import suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Any, Protocol, TypeVar

from progdf import __version__
from progdf.errors import ProgdfError, without_commands
from progdf.gdf.file import Gdf
from progdf.io.atomic import state_folder
from viewer.files.document import Document
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import LayerState, ViewState
from viewer.state.workspace import Store

from .main_view import MainView

LOG = "window.log"
_Made = TypeVar("_Made")


class Application(Protocol):
    """Interface of the application for its parts, which cannot import it without an import cycle."""

    document: Document
    main_view: MainView
    store: Store  # the window's state

    def open(self, path: Path) -> None:
        """Open a file according to its content."""

    def wait_for(self, work: Callable[[], _Made], text: str) -> _Made:
        """Run `work` in another thread, show `text` in the window meanwhile, and return the result."""

    def show(
        self, document: Document, live: tuple[Gdf, ...] = (), layers: tuple[LayerState, ...] = ()
    ) -> None:
        """Draw the same scene with other edits from now on, with the edits in training on top."""

    def open_document(
        self, document: Document, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()
    ) -> None:
        """Replace the open scene by another."""

    def leave(self) -> None:
        """Close the window without a question."""


Requests = dict[str, Callable[[Any], object]]
"""Functions of the commands that one part of the application performs; they receive the `argument`."""


def attempt(main_view: MainView, act: Callable[[], object]) -> None:
    """Run an action; show a failure as a message in the window."""
    if error := failure_line(act):
        main_view.show_message(error, error=True)


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
