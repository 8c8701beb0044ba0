"""The one kind of error that a person at the keyboard can mend."""

from __future__ import annotations

import re
from itertools import takewhile

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


_NAMES = "demo|train|batch|region|views|fit|evaluate|view|render|rebind|edit|export|info"
_TYPED = re.compile(rf"(?<![\w/.-])(?:--(?=[a-z])|pip install\b|hf download\b|progdf (?:{_NAMES})\b)")


def without_commands(line: str) -> str:
    """An error or a warning for a window: without what one types on a command line.

    What is wrong stays, its options without dashes; of each advice, the ways before the first that is typed.
    """
    wrong, *advice = line.split("; ")
    parts = [_TYPED.sub(lambda typed: "ProGDF" * typed[0].startswith("progdf"), wrong)]
    for part in advice:
        ways = re.split(r", (?:or )?", part) if ", or " in part else [part]
        before = [*takewhile(lambda way: not _TYPED.search(way), ways)]
        parts += [part if before == ways else ", ".join(before)] * bool(before)
    return "; ".join(parts)
