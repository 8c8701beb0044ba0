"""Freed memory of the process: kept for reuse up to a limit, and returned to the system between stages."""

from __future__ import annotations

from progdf.system.processes import c_library, resident_bytes

LARGEST_REUSED_BLOCK = 1 << 28
"""Largest block that is reused, bytes."""

KEPT_MEMORY = 1 << 29
"""Free memory at the end of the heap that is kept for reuse, bytes."""

_MMAP_THRESHOLD = -3  # M_MMAP_THRESHOLD of glibc
_TRIM_THRESHOLD = -1  # M_TRIM_THRESHOLD of glibc

_GLIBC = c_library()
_MALLOPT = getattr(_GLIBC, "mallopt", None)
_MALLOC_TRIM = getattr(_GLIBC, "malloc_trim", None)


def reuse_memory() -> None:
    """Let glibc reuse freed blocks of up to `LARGEST_REUSED_BLOCK`. No effect with other C libraries.

    By default glibc returns a freed block of 32 MB or more to the system, which fills the next one with zeros
    page by page. From 160 000 members of SH degree 3 on, one tensor of their values is that large, and these
    pages were a quarter of a training's processor time.
    """
    if _MALLOPT is not None:
        _MALLOPT(_MMAP_THRESHOLD, LARGEST_REUSED_BLOCK)
        _MALLOPT(_TRIM_THRESHOLD, KEPT_MEMORY)


def release_memory() -> None:
    """Return freed memory to the system if the process has grown by 10 % since the last call.

    glibc keeps freed blocks that lie between used ones: 0.8 GB after the views of 200 000 members.
    """
    global _resident
    if _MALLOC_TRIM is not None and resident_bytes() > 1.1 * _resident:
        _MALLOC_TRIM(0)
        _resident = resident_bytes()


_resident = 0  # bytes after the last `release_memory`
