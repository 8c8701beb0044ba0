"""How the kernels are compiled: flags, the cache on disk, the message of a cold start."""

from __future__ import annotations

import atexit
import hashlib
import json
import logging
import os
import pickle
import pickletools
import shutil
import tempfile
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import cache as once
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock

from progdf.errors import ProgdfError
from progdf.io.atomic import atomic_write, cache_folder, is_private, temporary_folder

try:
    import numba
    from numba import config
except Exception as error:  # it reads its settings on import, and raises whatever is wrong with them
    raise ProgdfError(
        f"numba cannot be loaded ({type(error).__name__}: {error}); check the variables NUMBA_…, and "
        ".numba_config.yaml in the current folder"
    ) from error
if config.DISABLE_JIT:
    raise ProgdfError("without numba's compiler no kernel works; unset NUMBA_DISABLE_JIT")

log = logging.getLogger("progdf")

FAST = {"nnan", "ninf", "nsz", "contract", "reassoc", "afn"}
"""Float flags of the pixel loops: all but `arcp`, which costs gradients a decimal and buys no time."""

Number = Any
"""A number inside a kernel, of the type numba infers: python's int and float cannot say float32 or uint64."""

_F = TypeVar("_F", bound=Callable[..., Any])
_compiling_lock, _building_lock = threading.RLock(), threading.Lock()
_ready: set[str] = set()  # stages whose marker was seen


def _source_version() -> str:
    """Of all files that kernels are made of: numba's cache notices neither changed constants nor changed
    imported functions."""
    digest = hashlib.sha256(numba.__version__.encode())
    package = Path(__file__).parents[2]
    for path in sorted([*package.glob("rasterize/**/*.py"), *package.glob("compose/*.py")]):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def find_cache_folder() -> Path:
    """A folder that this user may write, for this version of the kernels; never in the source tree."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    root = Path(named) if named else cache_folder() / "kernels"
    temporary = temporary_folder()
    for place in (root, temporary / "kernels"):
        folder = place / _source_version()
        try:
            if place.parent == temporary:
                temporary.mkdir(mode=0o700, exist_ok=True)
                if not is_private(temporary):  # machine code of somebody else's is not run
                    continue
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return folder
        except OSError:
            continue
    log.warning("%s cannot be written; the kernels are compiled anew in every process", root)
    folder = Path(tempfile.mkdtemp(prefix="progdf-kernels-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


_SUMS = "checksums.json"


def record_cache(folder: Path) -> None:
    """Write down what the cache holds, for `drop_damaged`; where that cannot be written nothing happens."""
    with suppress(OSError, ProgdfError):
        sums = _checksums(folder)
        if sums != _read_record(folder):
            with atomic_write(folder / _SUMS) as temporary_file:
                temporary_file.write_text(json.dumps(sums, indent=0), encoding="utf-8")


def drop_damaged(folder: Path) -> bool:
    """Remove the files of the cache that are damaged; whether there were any.

    numba would fail over them at every call, or run what is in them. Files that were not recorded are of a
    process at work, or of one that was killed; of these, and of indices that have grown, those are dropped
    that end too early.
    """
    recorded, damaged = _read_record(folder), []
    with suppress(OSError):
        for name, checksum in _checksums(folder).items():
            known = recorded.get(name)
            if known != checksum and ((known and name.endswith(".nbc")) or not _is_whole(folder / name)):
                damaged.append(folder / name)
        for path in [*damaged, *(folder.glob("*.ready") if damaged else ())]:
            path.unlink(missing_ok=True)
    return bool(damaged)


def _is_whole(path: Path) -> bool:
    """Whether numba can take a file apart: an index is two pickles, machine code is one."""
    try:
        with path.open("rb") as file:
            if path.suffix == ".nbi":
                pickle.load(file)
                pickle.loads(file.read())
            else:
                for _ in pickletools.genops(file.read()):
                    pass
    except Exception:  # whatever a damaged pickle raises
        return False
    return True


def _checksums(folder: Path) -> dict[str, int]:
    """CRC-32 of the files of machine code, and of the indices that list them."""
    files = [path for path in folder.rglob("*.nb[ic]") if path.is_file()]
    return {path.relative_to(folder).as_posix(): zlib.crc32(path.read_bytes()) for path in files}


def _read_record(folder: Path) -> dict[str, int]:
    try:
        found = json.loads((folder / _SUMS).read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return found if isinstance(found, dict) else {}


@once
def kernel_cache() -> Path:
    """The folder of compiled kernels, made and checked when the first kernel is needed."""
    folder = find_cache_folder()
    if drop_damaged(folder):
        log.warning("kernels kept in %s were damaged and are compiled anew", folder)
    atexit.register(record_cache, folder)
    return folder


def kernel(
    *,
    fast: bool = False,
    contract: bool = False,
    cache: bool = False,
    inline: bool = False,
    allocates: bool = False,
) -> Callable[[_F], _F]:
    """Compile a function with numba; it releases the interpreter's lock.

    Args:
        fast: with the flags of the pixel loops (`FAST`); otherwise strict IEEE
        contract: strict but for fused multiply-adds
        cache: for functions that Python calls, not other kernels: the machine code is kept on disk, and the
            cache is looked for at the first call
        inline: always inline into the calling kernel
        allocates: may make arrays; one that may not leaves out to count references to those that it gets,
            for which threads that share them would wait at each call
    """
    flags = FAST if fast else {"contract"} if contract else False

    def compile_now(function: _F) -> _F:
        compiled: _F = numba.njit(
            fastmath=flags,
            cache=cache,
            nogil=True,
            error_model="numpy",
            forceinline=inline,
            _nrt=allocates,
        )(function)
        return compiled

    return _compile_when_called(compile_now) if cache else compile_now


def _compile_when_called(compile_now: Callable[[_F], _F]) -> Callable[[_F], _F]:
    def decorate(function: _F) -> _F:
        compiled: _F | None = None

        @wraps(function)
        def call(*arguments: Any) -> Any:
            nonlocal compiled
            if compiled is None:
                with _building_lock:
                    compiled = compiled or _with_cache_folder(compile_now, function)
            return compiled(*arguments)

        return call  # type: ignore[return-value]

    return decorate


def _with_cache_folder(compile_now: Callable[[_F], _F], function: _F) -> _F:
    before = config.CACHE_DIR  # read by the decorator; other packages' caches stay where they are
    config.CACHE_DIR = str(kernel_cache())
    try:
        return compile_now(function)
    finally:
        config.CACHE_DIR = before


def compilation(stage: str, seconds: int) -> AbstractContextManager[None]:
    """Say it when the kernels that run in this context have yet to be compiled.

    Args:
        stage: names the kernels, to tell a cold start from a warm one
        seconds: about how long these take to compile
    """
    return nullcontext() if stage in _ready else _first_run(stage, seconds)


@contextmanager
def _first_run(stage: str, seconds: int) -> Iterator[None]:
    marker = kernel_cache() / f"{stage}.ready"
    with _compiling_lock, nullcontext() if marker.exists() else compile_lock():
        cold = not marker.exists()
        if cold:
            log.warning(
                "compiling the rasterizer's %s kernels (about %d s, once per machine)", stage, seconds
            )
        yield
        if cold:
            record_cache(kernel_cache())
            with suppress(OSError):
                marker.touch()
        _ready.add(stage)


@once
def compile_lock() -> FileLock:
    """Between processes: two that compile the same kernel would replace each other's files."""
    return FileLock(kernel_cache() / "compiling.lock")
