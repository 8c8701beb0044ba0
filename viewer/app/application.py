"""What the parts of the application need of it, and how failures are put: as a message, and in the log."""

from __future__ import annotations

import logging
import platform
import traceback
from collections.abc import Callable
from contextlib import suppress
from logging.handlers import RotatingFileHandler
from pathlib import Path
from typing import Protocol, TypeVar

from progdf import __version__
from progdf.errors import ProgdfError, without_commands
from progdf.gdf.file import Gdf
from progdf.io.atomic import state_folder
from viewer.files.document import Document
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import LayerState, ViewState

from .main_view import MainView

LOG = "window.log"
_Made = TypeVar("_Made")


class Application(Protocol):
    """The application as its parts see it, which it imports: they cannot import it in turn."""

    document: Document
    main_view: MainView

    def open(self, path: Path) -> None:
        """A file, by what it is."""

    def wait_for(self, work: Callable[[], _Made], text: str) -> _Made:
        """What it makes in another thread; meanwhile the window says so."""

    def show(
        self, document: Document, live: tuple[Gdf, ...] = (), layers: tuple[LayerState, ...] = ()
    ) -> None:
        """Draw the same scene with other edits from now on, with what is being trained on top."""

    def open_document(
        self, document: Document, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()
    ) -> None:
        """Another scene takes the place of the open one."""

    def leave(self) -> None:
        """Close the window, without a question."""


Requests = dict[str, Callable[[str], object]]
"""What a part of the application does when asked: by the request's name, with what follows its colon."""


def attempt(main_view: MainView, act: Callable[[], object]) -> None:
    """Do it; what goes wrong is a line in the window."""
    if error := failure_line(act):
        main_view.show_message(error, error=True)


def failure_line(act: Callable[[], object]) -> str:
    """Do it; what went wrong, in one line, "" for nothing. Mistakes of ours go on."""
    try:
        act()
    except (ProgdfError, OSError) as error:
        return error_line(error)
    return ""


def error_line(error: Exception) -> str:
    """An error that the person can mend, in one line of no commands; "" for a mistake of ours."""
    if isinstance(error, ProgdfError):
        return without_commands(str(error))
    if isinstance(error, OSError):
        return f"{error.filename or 'the file'} cannot be read or written: {error.strerror or error}"
    return ""


def error_details(error: Exception) -> str:
    """A mistake of ours with all that a report of it needs."""
    system = f"progdf {__version__}, Python {platform.python_version()}, {platform.platform()}"
    return f"{system}\n\n{''.join(traceback.format_exception(error))}"


def log_error(details: str) -> None:
    """Add it to window.log in the folder of the program's state, which keeps the last 1-2 MB."""
    folder = state_folder()
    with suppress(OSError):  # where no log can be written, the message still has the details
        folder.mkdir(parents=True, exist_ok=True)
        file = RotatingFileHandler(
            folder / LOG, maxBytes=1 << 20, backupCount=1, encoding="utf-8", errors="backslashreplace"
        )
        file.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
        file.emit(logging.makeLogRecord({"msg": details}))
        file.close()
