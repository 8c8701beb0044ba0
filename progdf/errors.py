"""User-facing errors, and checks of the arguments of public functions."""

from __future__ import annotations

import errno
import re
from itertools import takewhile

from .terminal import elide, escape_text


class ProgdfError(ValueError):
    """Error that the user can correct: a broken file, a wrong option, or two files that do not match.

    The message is one line, `PROBLEM; REMEDY`, even if file names contain line breaks. `elide` shortens long
    values. Commands print the message and exit with status 2.
    """

    def __str__(self) -> str:
        return elide(escape_text(" ".join(super().__str__().split())))


def check_first_argument(call: str, value: object, kind: type | tuple[type, ...]) -> None:
    """Check the type of a public function's first argument.

    Args:
        call: the function with its arguments, such as "save_scene(path, scene)"
        value: the first argument
        kind: its type

    Raises:
        TypeError: the value has the wrong type, for example because the arguments are swapped.
    """
    if not isinstance(value, kind):
        raise TypeError(f"the first argument is of type {type(value).__name__}; call {call}")


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error, or the error that caused it, is an out-of-memory error.

    Torch's allocator raises a RuntimeError, the system an OSError, and its linker an ImportError for a
    library that cannot be mapped. Threads cannot start without memory for their stacks.
    """
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    message = str(error).lower()
    if isinstance(error, _MEMORY_ERRORS) and any(words in message for words in _MEMORY_MESSAGES):
        return True
    cause = error.__cause__
    if cause is None and not error.__suppress_context__:
        cause = error.__context__
    return cause is not None and is_out_of_memory(cause)


_MEMORY_ERRORS = (RuntimeError, ImportError, OSError)
_MEMORY_MESSAGES = (
    "allocate memory",
    "not enough memory",
    "out of memory",
    "failed to map segment",
    "can't start new thread",
)


_COMMAND_NAMES = "demo|train|batch|region|views|fit|evaluate|view|render|rebind|edit|export|info"
_COMMAND_LINE = re.compile(
    rf"(?<![\w/.-])(?:--(?=[a-z])|pip install\b|hf download\b|progdf (?:{_COMMAND_NAMES})\b)"
)


def without_commands(line: str) -> str:
    """Return an error or a warning without command line instructions, for a window.

    The description of the problem stays, with options written without dashes. Each remedy keeps the
    alternatives before its first command line instruction.
    """
    problem, *remedies = line.split("; ")
    parts = [_COMMAND_LINE.sub(_without_command, problem)]
    for remedy in remedies:
        alternatives = re.split(r", (?:or )?", remedy) if ", or " in remedy else [remedy]
        usable = [*takewhile(lambda text: not _COMMAND_LINE.search(text), alternatives)]
        if usable == alternatives:
            parts.append(remedy)
        elif usable:
            parts.append(", ".join(usable))
    return "; ".join(parts)


def _without_command(match: re.Match[str]) -> str:
    """Return the replacement for a command line word: the program's name for a command, otherwise nothing."""
    return "ProGDF" if match[0].startswith("progdf") else ""
