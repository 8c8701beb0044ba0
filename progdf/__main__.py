"""The command `progdf`: a table of commands, each imported only when it is called."""

from __future__ import annotations

import atexit
import gc
import importlib
import io
import logging
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import NoReturn

from .errors import ProgdfError, is_out_of_memory
from .io.atomic import disk_full, state_folder, write_file
from .system.packages import broken_package, import_fault, install_again
from .system.processes import ENDINGS, handle_signals
from .terminal import PrintableFormatter, elide, escape_text

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("trainer.run.demo:main", "make a scene, train its edits, write previews, open the window"),
    "train": ("trainer.cli:train", "edit a region of a scene and write its .gdf file"),
    "batch": ("trainer.cli:batch", "train every edit of a catalogue, on this machine or a Ray cluster"),
    "region": ("trainer.cli:region", "show or save the Gaussians that a region selects"),
    "views": ("trainer.cli:views", "write views of a scene to draw masks or edits on"),
    "fit": ("trainer.cli:fit", "refit a field to a recorded trajectory"),
    "evaluate": ("trainer.cli:evaluate", "measure a run with the metrics of papers"),
    "view": ("viewer.commands.view:main", "open the window: splats, layers, sliders"),
    "render": ("viewer.commands.render:render", "write a picture, a sweep or a sheet without a window"),
    "rebind": ("progdf.cli.rebind:main", "carry an edit over to the same scene in another file or format"),
    "edit": ("progdf.cli.edit:main", "change or clean a scene by hand"),
    "export": ("viewer.commands.export:export", "write the edited scene as a 3DGS .ply file"),
    "info": ("progdf.cli.info:main", "show the contents of a scene or .gdf, repairs, strays and errors"),
    "doctor": (
        "progdf.cli.doctor:main",
        "print what a bug report needs; test drawing, training and a window",
    ),
}

HIDDEN = {
    "preview": "trainer.preview:serve",
    "window-test": "viewer.commands.window_test:main",
    "card-test": "progdf.cli.doctor:describe_card",
    "import-test": "progdf.cli.doctor:import_packages",
}
"""Internal commands, which the window and `progdf doctor` run → their entry points."""


def _usage() -> str:
    lines = ["usage: progdf COMMAND …   (progdf COMMAND --help lists its options)", ""]
    lines += [f"  {name:<9}{summary}" for name, (_, summary) in COMMANDS.items()]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status, see `run_guarded`."""
    if argv is None:  # run as the program; torch and numba create 500 000 permanent objects
        gc.set_threshold(5_000)  # fewer collections during imports save 0.3 s
        atexit.register(gc.freeze)  # skipping the collection at exit saves 0.7 s
    return run_guarded(_run, list(sys.argv[1:] if argv is None else argv))


def run_guarded(run: Callable[[Sequence[str]], int], arguments: Sequence[str]) -> int:
    """Run a command line, and report an error in one line.

    Returns:
        Exit status. 0: success; 2: an error that the user can correct; 70: an internal error, whose traceback
        is saved to a file; 130: interrupted.
    """
    _open_standard_streams()
    if logging.lastResort is not None:  # prints warnings if no program has configured logging
        logging.lastResort.setFormatter(PrintableFormatter())
    try:
        _check_current_folder()
        _check_arguments(arguments)
        with handle_signals((signal.SIGINT, *ENDINGS), _interrupt):
            try:
                status = run(arguments)
            except SystemExit as leaving:  # --help
                status = leaving.code if isinstance(leaving.code, int) else 0
            sys.stdout.flush()  # here, where a full disk or a closed pipe can still be reported
            return status
    except BaseException as error:
        status, line = _describe_failure(error)
        if line:
            _report_failure(line)
        return status
    finally:
        _drop_unwritable_output()


def _describe_failure(error: BaseException) -> tuple[int, str]:
    """Return the exit status and the message for an exception; an empty message prints nothing."""
    if isinstance(error, ProgdfError):
        return 2, str(error)
    if isinstance(error, BrokenPipeError):  # `progdf info … | head`
        return 0, ""
    if isinstance(error, KeyboardInterrupt):
        return 130, f"interrupted; {error}" if str(error) else "interrupted"
    if not isinstance(error, Exception):
        raise error
    if is_out_of_memory(error):
        return 2, "out of memory; close other programs or use a smaller scene"
    if package := broken_package(error):
        return 2, f"the package {package} cannot be imported ({import_fault(error)}); {install_again()}"
    if isinstance(error, UnicodeEncodeError) and error.reason == "surrogates not allowed":
        return 2, f"{error.object!r:.80} is not UTF-8, and cannot be written into a file; rename it"
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        remedy = "; free some space on the disk" if disk_full(error) else ""
        return 2, f"{where}{error.strerror or error}{remedy}"
    message = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return 70, f"internal error in progdf ({message[:200]}); {_save_traceback()}"


def _drop_unwritable_output() -> None:
    """Redirect streams that cannot be written to the null device; Python would fail again at exit."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):  # ValueError: the stream is closed
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _check_arguments(arguments: Sequence[str]) -> None:
    """Raise ProgdfError if an argument contains a NUL, which file names and text options cannot have."""
    for argument in arguments:
        if "\0" in argument:
            raise ProgdfError(f"the argument {argument!r:.80} holds a NUL character; leave it out")


def _run(arguments: Sequence[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0
    if arguments[0] == "--version":
        from . import __version__

        print(f"progdf {__version__}")
        return 0
    entry_points = {name: path for name, (path, _) in COMMANDS.items()} | HIDDEN
    if arguments[0] not in entry_points:
        raise ProgdfError(f"unknown command '{arguments[0]}'; use one of {', '.join(COMMANDS)}")
    module, function = entry_points[arguments[0]].split(":")
    return int(getattr(importlib.import_module(module), function)(arguments[1:]) or 0)


def _report_failure(line: str) -> None:
    with suppress(OSError):  # standard error is full or closed
        print(f"progdf: {elide(escape_text(' '.join(line.split())))}", file=sys.stderr, flush=True)


def _save_traceback() -> str:
    """Save the traceback of the current exception, and return the advice to report it with that file."""
    details = f"progdf {' '.join(map(repr, sys.argv[1:]))}\n\n{traceback.format_exc()}"
    for folder in (state_folder(), Path(tempfile.gettempdir())):
        path = folder / "crash.txt" if folder.name == "progdf" else folder / f"progdf-crash-{os.getpid()}.txt"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            write_file(path, details.encode(errors="backslashreplace"))
        except (OSError, ProgdfError):
            continue
        return f"please report it with {path}"
    return f"please report it; no file could be written with the details: {details}"


def _check_current_folder() -> None:
    """Raise ProgdfError if the current folder was removed; torch's libraries would abort the process."""
    try:
        os.getcwd()
    except FileNotFoundError:
        raise ProgdfError("the current folder was removed; change to one that exists") from None


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:
    """Raise KeyboardInterrupt, so that SIGTERM and a closed terminal end a command as Ctrl+C does."""
    raise KeyboardInterrupt


def _open_standard_streams() -> None:
    """Open closed standard streams on the null device.

    If descriptor 0, 1 or 2 is closed, the next opened file would get its number and receive the output.
    """
    for handle in range(3):
        try:
            os.fstat(handle)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a terminal that cannot encode “…” gets an escape sequence
            stream.reconfigure(errors="backslashreplace")


if __name__ == "__main__":
    sys.exit(main())
