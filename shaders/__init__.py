"""GLSL sources, one file per stage, and a loader that resolves includes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import resources
from pathlib import PurePosixPath

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


class ShaderError(RuntimeError):
    """Shader of this package that the driver rejects. It is a bug; the message contains the location."""


@dataclass(frozen=True)
class Source:
    """GLSL of one stage."""

    text: str  # source with all includes, and #line directives that keep file and line
    files: tuple[str, ...]  # file names by their number in the driver's messages


def load_source(name: str) -> Source:
    """Load the stage `shaders/NAME`. Each include is inserted once; paths are relative to `shaders`.

    Raises:
        ShaderError: a file is missing; the message names the file that includes it.
    """
    files: list[str] = []
    lines: list[str] = []

    def append(file: str, wanted_by: str) -> None:
        if file in files:
            return
        path = resources.files("shaders") / str(PurePosixPath(file))
        if not path.is_file():
            raise ShaderError(f"shaders/{file} does not exist; {wanted_by} includes it")
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
