"""The desktop of each system: display, fonts, programs of other files, keys and libraries of the window."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path


def has_display() -> bool:
    """Return whether a window may open: on Linux, whether the environment names an X11 display.

    Wayland desktops name one, too, that of XWayland. The interface's glfw library speaks X11 only.
    """
    return sys.platform in ("win32", "darwin") or bool(os.environ.get("DISPLAY"))


def display_remedy() -> str:
    """Return how to get a display where `has_display` is False, as a part of a message; "" elsewhere."""
    if has_display():
        return ""
    if os.environ.get("WAYLAND_DISPLAY"):
        return "install XWayland (package xwayland) and log in again, as the window needs X11"
    return "log in to a desktop, or connect with ssh -X"


def has_file_dialog(programs: Sequence[str]) -> bool:
    """Return whether the system can show a file dialog.

    Args:
        programs: programs that show one on Linux
    """
    return sys.platform in ("win32", "darwin") or any(map(shutil.which, programs))


def has_command_key() -> bool:
    """Return whether the keyboard has a Command key, which then counts as Ctrl."""
    return sys.platform == "darwin"


def glfw_library_name() -> str:
    """Return the file name of the glfw library in the interface's package."""
    return {"darwin": "libglfw.3.dylib", "win32": "glfw3.dll"}.get(sys.platform, "libglfw.so.3")


def font_folders() -> tuple[Path, ...]:
    """Return the folders in which the system installs fonts."""
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA", "")
        folders = (os.path.join(os.environ.get("WINDIR", "C:\\Windows"), "Fonts"),)
        return tuple(map(Path, (*folders, os.path.join(local, "Microsoft", "Windows", "Fonts"))))
    if sys.platform == "darwin":
        return tuple(map(Path, ("/System/Library/Fonts", "/Library/Fonts", "~/Library/Fonts")))
    shared = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return tuple(map(Path, (f"{shared}/fonts", "~/.fonts", "/usr/local/share/fonts", "/usr/share/fonts")))


def open_in_program(path: Path) -> bool:
    """Open a file in the desktop's default program. Return False if the desktop provides no launcher."""
    try:
        if sys.platform == "win32":
            os.startfile(path, "edit")
        else:
            command = "open" if sys.platform == "darwin" else "xdg-open"
            subprocess.Popen([command, str(path)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    except OSError:
        return False
    return True
