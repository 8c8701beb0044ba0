"""Removal of the modules and functions that Windows lacks, active with this folder on PYTHONPATH.

It happens at the first import of a ProGDF package. Other packages are imported before, as their Windows
builds do not need them. A file that the process itself has open cannot be replaced, and the first replacement
of any file in $BARE_FOLDER is refused, as by a virus scanner.
"""

from __future__ import annotations

import builtins
import ctypes
import importlib
import io
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

OURS = ("progdf", "trainer", "viewer")
MODULES = ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "curses", "readline", "syslog")
OS_NAMES = (
    *("fork", "forkpty", "nice", "kill_group", "killpg", "getuid", "geteuid", "getgid", "getegid", "setsid"),
    *("getpgid", "getpgrp", "setpgid", "register_at_fork", "mkfifo", "mknod", "sysconf", "statvfs", "uname"),
    *("O_NOFOLLOW", "O_DIRECTORY", "O_CLOEXEC", "chown", "lchown", "getloadavg", "WNOHANG"),
    *(name for name in dir(os) if name.startswith(("sched_", "SCHED_", "posix_", "POSIX_"))),
)
SIGNALS = ("SIGHUP", "SIGKILL", "SIGSTOP", "SIGCONT", "SIGUSR1", "SIGUSR2", "SIGQUIT", "SIGALRM", "SIGPIPE")
BEFORE = (
    *(
        "asyncio",
        "concurrent.futures",
        "ctypes.util",
        "getpass",
        "multiprocessing.pool",
        "platform",
        "shutil",
    ),
    *("tempfile", "urllib.request", "webbrowser", "zipfile", "torch", "torch._dynamo", "numba", "llvmlite"),
    *(
        "scipy.spatial",
        "scipy.sparse.csgraph",
        "scipy.optimize",
        "scipy.ndimage",
        "plyfile",
        "safetensors.torch",
    ),
    *("msgspec", "platformdirs", "filelock", "moderngl", "glfw", "imgui_bundle", "pyrr", "tyro", "rich.live"),
    *(
        "rich.console",
        "rich.progress",
        "rich.logging",
        "PIL.Image",
        "PIL.PngImagePlugin",
        "matplotlib.figure",
    ),
    *(
        "matplotlib.backends.backend_agg",
        "numba.core.caching",
        "numba.np.ufunc.workqueue",
        "numba.experimental",
    ),
)


def _refusing_replace(real: Any) -> Any:
    """Return an `os.replace` that refuses like that of Windows."""
    listdir, readlink, refused = os.listdir, os.readlink, set()

    def replace(source: Any, target: Any, **more: Any) -> None:
        own = os.path.realpath(target)
        if own.startswith(os.environ["BARE_FOLDER"]):
            handles = set()
            for handle in listdir("/proc/self/fd"):
                try:
                    handles.add(readlink(f"/proc/self/fd/{handle}"))
                except OSError:
                    continue  # handle of this check
            if own not in refused or own in handles:
                refused.add(own)
                error = PermissionError(13, "The process cannot access the file", str(target))
                error.winerror = 32  # type: ignore[attr-defined]
                raise error
        real(source, target, **more)

    return replace


def _without_proc(real: Any) -> Any:
    def opened(file: Any, *arguments: Any, **more: Any) -> Any:
        if isinstance(file, (str, os.PathLike)) and os.fspath(file).startswith("/proc/"):
            raise FileNotFoundError(2, "No such file or directory", os.fspath(file))
        return real(file, *arguments, **more)

    return opened


def bare() -> None:
    """Remove everything that Windows lacks."""
    for name in BEFORE:
        importlib.import_module(name)
    kill = os.kill
    nine = signal.SIGKILL
    for where in (subprocess.Popen,):
        where.kill = where.terminate = lambda self: None if self.poll() is not None else kill(self.pid, nine)  # type: ignore[method-assign]
    for name in ("CREATE_NEW_PROCESS_GROUP", "BELOW_NORMAL_PRIORITY_CLASS", "CREATE_NO_WINDOW"):
        setattr(subprocess, name, 0)
    kernel = SimpleNamespace(SetPriorityClass=lambda process, priority: 1)
    ctypes.windll = SimpleNamespace(kernel32=kernel)  # type: ignore[attr-defined]
    os.replace = _refusing_replace(os.replace)
    builtins.open = io.open = _without_proc(open)
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]
    for name in OS_NAMES:
        vars(os).pop(name, None)
    for name in SIGNALS:
        vars(signal).pop(name, None)
    sys.platform = "win32"
    with open(Path(os.environ["BARE_FOLDER"]) / "bare.txt", "a", encoding="utf-8") as file:
        file.write(" ".join(sys.argv) + "\n")


class _ImportHook:
    """Import hook that notices the first import of a ProGDF package."""

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name.partition(".")[0] in OURS:
            sys.meta_path.remove(self)  # type: ignore[arg-type]
            bare()


if "BARE_FOLDER" in os.environ:
    sys.meta_path.insert(0, _ImportHook())  # type: ignore[arg-type]
