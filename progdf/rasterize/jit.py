"""How the kernels are compiled: flags, the cache on disk, the message of a cold start, the lock."""

from __future__ import annotations

import hashlib
import logging
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba import config

from progdf.rasterize.threads import threads

log = logging.getLogger("progdf")

FAST = {"nnan", "ninf", "nsz", "contract", "reassoc", "afn"}
"""Float flags of the pixel loops: all but `arcp`, which costs gradients a decimal and buys no time."""

Number = Any
"""A number inside a kernel, of the type numba infers: python's int and float cannot say float32 or uint64."""

_F = TypeVar("_F", bound=Callable[..., Any])
_lock = threading.RLock()
_ready: set[str] = set()  # stages whose marker was seen


def _source_version() -> str:
    """Of all files here: numba's cache notices neither changed constants nor changed imported functions."""
    digest = hashlib.sha256(numba.__version__.encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """A folder that this user may write, for this version of the kernels; never in the source tree."""
    if "NUMBA_CACHE_DIR" in os.environ:
        root = Path(os.environ["NUMBA_CACHE_DIR"])
    elif sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "progdf" / "kernels"
    elif sys.platform == "darwin":
        root = Path.home() / "Library" / "Caches" / "progdf" / "kernels"
    else:
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "progdf" / "kernels"
    folder = root / _source_version()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError:
        log.warning("%s cannot be written; the kernels are compiled anew in every process", folder)
        return Path(tempfile.mkdtemp(prefix="progdf-kernels-"))


CACHE = _cache_folder()


def kernel(
    *,
    fast: bool = False,
    contract: bool = False,
    cache: bool = False,
    inline: bool = False,
    allocates: bool = False,
) -> Callable[[_F], _F]:
    """Compile a function with numba.

    Args:
        fast: with the flags of the pixel loops (`FAST`); otherwise strict IEEE
        contract: strict but for fused multiply-adds
        cache: keep the machine code on disk; for functions that Python calls
        inline: always inline into the calling kernel
        allocates: may make arrays; one that may not leaves out to count who uses the arrays that it gets, for
            which threads that share them would wait at each call
    """
    flags = FAST if fast else {"contract"} if contract else False

    def decorate(function: _F) -> _F:
        before = config.CACHE_DIR
        config.CACHE_DIR = str(
            CACHE
        )  # read when the decorator runs; other packages' caches stay where they are
        try:
            compiled: _F = numba.njit(
                fastmath=flags,
                cache=cache,
                nogil=True,
                error_model="numpy",
                forceinline=inline,
                _nrt=allocates,
            )(function)
        finally:
            config.CACHE_DIR = before
        return compiled

    return decorate


def running(stage: str, seconds: int) -> AbstractContextManager[int]:
    """Tell of kernels that have yet to be compiled, and give the number of threads to use.

    Args:
        stage: names the kernels that will run, to tell a cold start from a warm one
        seconds: about how long these take to compile
    """
    return nullcontext(threads()) if stage in _ready else _compiling(stage, seconds)


@contextmanager
def _compiling(stage: str, seconds: int) -> Iterator[int]:
    marker = CACHE / f"{stage}.ready"
    with _lock:
        cold = not marker.exists()
        if cold:
            log.warning(
                "compiling the rasteriser's %s kernels (about %d s, once per machine)", stage, seconds
            )
        yield threads()
        if cold:
            marker.touch()
        _ready.add(stage)
