"""Where programs keep what is the user's own: caches, and what they remember. Never raises, makes nothing."""

from __future__ import annotations

import getpass
import os
import sys
import tempfile
from pathlib import Path

from platformdirs import user_cache_path, user_pictures_path, user_state_path


def cache_folder() -> Path:
    """For what can be made again: %LOCALAPPDATA%, ~/Library/Caches or $XDG_CACHE_HOME."""
    return _folder(user_cache_path("progdf", appauthor=False, opinion=False))


def state_folder() -> Path:
    """For what is remembered from one time to the next: %LOCALAPPDATA%, ~/Library or $XDG_STATE_HOME."""
    return _folder(user_state_path("progdf", appauthor=False))


def pictures_folder() -> Path:
    """The user's own pictures, as the desktop calls the folder."""
    return _folder(user_pictures_path())


def temporary_folder() -> Path:
    """One of the user's own where temporary files are, for who has no home or may not write there."""
    who = str(os.getuid()) if hasattr(os, "getuid") else getpass.getuser()
    return Path(tempfile.gettempdir()) / f"progdf-{who}"


def is_private(folder: Path) -> bool:
    """Whether nobody but the user could have put something into a folder."""
    if sys.platform == "win32":
        return True
    found = folder.lstat()
    return found.st_uid == os.getuid() and not folder.is_symlink() and not found.st_mode & 0o022


def _folder(found: Path) -> Path:
    try:
        Path.home()
    except RuntimeError:  # no HOME, and the system does not know the user
        return temporary_folder()
    return found
