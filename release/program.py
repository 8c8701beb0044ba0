"""Entry point of the desktop bundle: the program, and the interpreter of its own child processes.

The program starts child processes as `sys.executable -P …`. In a bundle, `sys.executable` is this program.
Without arguments it opens the window, as after a double click.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Sequence


def run_as_python(arguments: Sequence[str]) -> None:
    """Run Python code like `python -P`: `-m MODULE …`, `-c CODE …` or `FILE …`.

    Args:
        arguments: command-line arguments after `-P`
    """
    kind, *rest = arguments
    if kind == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif kind == "-c":
        sys.argv = ["-c", *rest[1:]]
        exec(rest[0], {"__name__": "__main__"})
    else:
        sys.argv = list(arguments)
        runpy.run_path(kind, run_name="__main__")


def main(arguments: Sequence[str]) -> int:
    """Run the program or, after `-P`, Python code. Return the exit status."""
    if arguments[:1] == ["-P"]:
        run_as_python(arguments[1:])
        return 0
    from progdf.__main__ import main as run_program

    sys.argv[1:] = list(arguments) or ["view"]
    return run_program()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
