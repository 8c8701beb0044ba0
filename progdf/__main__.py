"""The command `progdf`: a table of commands, each imported only when it is called."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence

from progdf.errors import ProgdfError
from progdf.files import disk_full

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("trainer.demo:main", "make a scene, train its region edits, write previews, open the window"),
    "train": ("trainer.cli:train", "edit a region of a scene and write its .gdf file"),
    "fit": ("trainer.cli:fit", "refit a field to a recorded trajectory"),
    "ablate": ("trainer.cli:ablate", "train a run again without each part of the method: one table"),
    "view": ("viewer.cli:view", "open the window: splats, layers, sliders"),
    "render": ("viewer.render:render", "write a picture, a sweep or a contact sheet without a window"),
    "export": ("viewer.cli:export", "write the edited scene as a 3DGS .ply file"),
    "check": ("progdf.check:main", "report what a .ply file holds and what had to be repaired"),
    "info": ("progdf.info:main", "tell what a .ply or .gdf file holds, with its error report"),
    "bench": ("progdf.bench:main", "measure speed against error"),
}

BENCHES: dict[str, str] = {
    "rasterize": "progdf.bench_rasterize:tables",
    "field": "progdf.bench_field:tables",
    "viewer": "viewer.bench:tables",
    "frames": "viewer.bench_frames:tables",
    "window": "viewer.bench_window:tables",
}

RECORDED = "trainer.bench_runs:recorded_course"
"""Reads a run folder for the benchmark of fields, which lies on a lower floor."""


def _usage() -> str:
    lines = ["usage: progdf COMMAND …   (progdf COMMAND --help tells its options)", ""]
    lines += [f"  {name:<8}{what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status: 0 done, 2 the user can mend it, 130 interrupted."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_usage())
        return 0
    if arguments[0] == "--version":
        from progdf import __version__

        print(f"progdf {__version__}")
        return 0
    if arguments[0] not in COMMANDS:
        print(
            f"progdf: there is no command '{arguments[0]}'; try one of {', '.join(COMMANDS)}", file=sys.stderr
        )
        return 2
    module, function = COMMANDS[arguments[0]][0].split(":")
    try:
        return int(getattr(importlib.import_module(module), function)(arguments[1:]) or 0)
    except ProgdfError as error:
        print(f"progdf: {_one_line(error)}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # `progdf info … | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        right = "; the disk takes no more, free some space" if disk_full(error) else ""
        print(f"progdf: {where}{error.strerror or _one_line(error)}{right}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interrupt:
        print(f"progdf: interrupted{'; ' + str(interrupt) if str(interrupt) else ''}", file=sys.stderr)
        return 130


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())


if __name__ == "__main__":
    sys.exit(main())
