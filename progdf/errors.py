"""The one kind of error that a person at the keyboard can mend."""

from __future__ import annotations

from .terminal import escape_text


class ProgdfError(ValueError):
    """Something the user can mend: a broken file, a wrong option, two files that do not belong together.

    The message is one line, `WHAT IS WRONG; WHAT WOULD BE RIGHT`, whatever names in files hold. Commands
    print it and exit with status 2.
    """

    def __str__(self) -> str:
        return escape_text(" ".join(super().__str__().split()))


def is_out_of_memory(error: Exception) -> bool:
    """Whether memory ran out; torch raises a RuntimeError of its allocator's."""
    message = str(error) if isinstance(error, RuntimeError) else ""
    words = ("allocate memory", "not enough memory", "out of memory")
    return isinstance(error, MemoryError) or any(word in message for word in words)
