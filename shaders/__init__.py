"""GLSL sources, one file a stage, and how they are read: includes resolved."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import resources
from pathlib import PurePosixPath

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


class ShaderError(RuntimeError):
    """A shader of ours that this driver refuses: a bug, with the place where it is."""


@dataclass(frozen=True)
class Source:
    """One stage's GLSL."""

    text: str  # everything included, with #line directives that keep file and line
    files: tuple[str, ...]  # file names by the number that the driver's messages use


def load_source(name: str) -> Source:
    """The stage `shaders/NAME` with its includes, each taken once, paths relative to `shaders`.

    Raises:
        ShaderError: a file is missing; the message says which file wanted it.
    """
    files: list[str] = []
    lines: list[str] = []

    def append(file: str, wanted_by: str) -> None:
        if file in files:
            return
        path = resources.files("shaders") / str(PurePosixPath(file))
        if not path.is_file():
            raise ShaderError(f"shaders/{file} does not exist; {wanted_by} asks for it")
        number = len(files)
        files.append(file)
        if number:
            lines.append(f"#line 1 {number}")
        for at, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
            included = _INCLUDE.match(line)
            if included:
                append(included.group(1), f"shaders/{file}:{at}")
                lines.append(f"#line {at + 1} {number}")
            else:
                lines.append(line)
                if line.startswith("#version"):
                    lines.append(f"#line {at + 1} {number}")

    append(name, "the program")
    return Source("\n".join(lines) + "\n", tuple(files))
