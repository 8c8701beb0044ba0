"""The system's own file dialogs, beside the path field: started, looked at now and then, never waited for.

On Linux a dialog is a program of the desktop. Without one the library answers as if the person had canceled,
so it is looked for here, and the path field always stays.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from imgui_bundle import portable_file_dialogs as dialogs

from progdf.terminal import escape_text
from viewer.state.workspace import Dialog

PROGRAMS = ("zenity", "kdialog", "qarma", "matedialog")
"""Any of them shows a dialog on Linux."""

POLL_S = 0.05
"""How often to look whether the person has chosen."""

_OPEN = [
    "Scenes, edits, sessions, cameras",
    "*.ply *.spz *.splat *.ksplat *.sog *.gdf *.json",
    "All files",
    "*",
]
_SAVE = ["Sessions", "*.json", "All files", "*"]


def obstacle() -> str:
    """Why no dialog can be shown, in one line; "" where one can."""
    if sys.platform in ("win32", "darwin") or any(shutil.which(program) for program in PROGRAMS):
        return ""
    return f"No file dialog is installed ({PROGRAMS[0]} or {PROGRAMS[1]}); type the path"


class Browser:
    """The dialog of the desktop beside a question of ours, one at a time. `close` it before it is dropped:
    the library would wait for the person."""

    def __init__(self) -> None:
        self._shown: dialogs.open_file | dialogs.save_file | None = None

    @property
    def on_screen(self) -> bool:
        """Whether a dialog is shown, and worth another look after `POLL_S`."""
        return self._shown is not None

    def open(self, dialog: Dialog, near: Path) -> Dialog:
        """The question while the desktop's dialog is shown, or with the reason why there is none.

        Args:
            dialog: one that asks for a path
            near: a file beside which to begin where none is typed
        """
        if missing := obstacle():
            return replace(dialog, notice=missing)
        self.close()
        path = Path(dialog.text or near).expanduser().absolute()
        if dialog.kind in ("open", "replace"):
            folder = path if path.is_dir() else path.parent
            self._shown = dialogs.open_file("Open", escape_text(f"{folder}/"), _OPEN)
        else:
            filters = _SAVE if dialog.kind == "save" else ["All files", "*"]
            self._shown = dialogs.save_file("Save", escape_text(str(path)), filters)
        return replace(
            dialog, choosing=True, notice="Choose a file in the system dialog, or type a path here"
        )

    def poll(self, dialog: Dialog | None) -> Dialog | None:
        """The question after a look at the dialog: with the file, if one was chosen. Does not wait."""
        if self._shown is None or dialog is None or not dialog.choosing:
            self.close()  # the question was answered without it
            return dialog
        if not self._shown.ready(0):
            return dialog
        answer: Sequence[str] | str = self._shown.result()
        path = answer if isinstance(answer, str) else next(iter(answer), "")
        self._shown = None
        return replace(dialog, choosing=False, notice="", chosen=path)

    def close(self) -> None:
        """Take the dialog away, answered or not."""
        if self._shown is not None and not self._shown.ready(0):
            self._shown.kill()
        self._shown = None
