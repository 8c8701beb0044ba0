"""What actions on files need of the application, and how their failures are put."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from progdf.errors import ProgdfError
from viewer.files.document import Document
from viewer.state.snapshots import SliderSnapshot
from viewer.state.view_state import ViewState

from .main_view import MainView


class Application(Protocol):
    """What file actions need of the application."""

    document: Document
    main_view: MainView

    def show(self, document: Document) -> None:
        """Draw the same scene with other edits from now on."""

    def open_document(
        self, document: Document, view: ViewState, snapshots: tuple[SliderSnapshot, ...] = ()
    ) -> None:
        """Another scene takes the place of the open one."""

    def leave(self) -> None:
        """Close the window, without a question."""


def failure_line(act: Callable[[], None]) -> str:
    """Do it; what went wrong, in one line, "" for nothing."""
    try:
        act()
    except ProgdfError as error:
        return " ".join(str(error).split())
    except OSError as error:
        return f"{error.filename or 'the file'} cannot be read or written: {error.strerror}"
    return ""
