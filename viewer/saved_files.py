"""Files that the window makes by itself: the picture, the whole window, the timeline; and where they went."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from progdf.errors import ProgdfError

from . import timeline_file
from .pictures import free_path, save_picture
from .state import ViewState

REQUESTS = ("picture", "window_picture", "timeline_file")
"""Those of `workspace.REQUESTS` that end here."""


def picture(folder: Path, title: str, image: NDArray[np.uint8]) -> str:
    """Save `image` [H,W,3] under the scene's name; the line that says where.

    Raises:
        ProgdfError: it cannot be written.
    """

    def save() -> str:
        return f"Saved {save_picture(folder, Path(title).stem, image).resolve()}"

    return _saved("picture", folder, save)


def timeline(folder: Path, title: str, view: ViewState) -> str:
    """Save the keys of `view` under the scene's name; the line that says where, and what for.

    Raises:
        ProgdfError: it cannot be written.
    """
    path = free_path(folder, f"{Path(title).stem}_timeline", ".json")

    def save() -> str:
        timeline_file.save(path, view.timeline, view.layers)
        return f"Saved {path.resolve()}; progdf render … --timeline {path.name} makes a film of it"

    return _saved("timeline", folder, save)


def _saved(what: str, folder: Path, save: Callable[[], str]) -> str:
    try:
        return save()
    except OSError as error:
        raise ProgdfError(f"no {what} was saved in {folder.resolve()}: {error.strerror}") from None
