"""GLSL programs from the package `shaders`: includes resolved, errors told as file:line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib import resources
from pathlib import PurePosixPath

import moderngl

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')
_LOCATIONS = (
    re.compile(r"^(?:ERROR|WARNING): (?P<file>\d+):(?P<line>\d+): ?(?P<text>.*)$"),  # macOS, Intel, AMD
    re.compile(r"^(?P<file>\d+):(?P<line>\d+)\(\d+\): ?(?P<text>.*)$"),  # Mesa
    re.compile(r"^(?P<file>\d+)\((?P<line>\d+)\) ?: ?(?P<text>.*)$"),  # NVIDIA
)


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


def load_program(
    ctx: moderngl.Context, vertex: str, fragment: str | None = None, varyings: tuple[str, ...] = ()
) -> moderngl.Program:
    """Compile and link `shaders/VERTEX` and, unless only `varyings` are captured, `shaders/FRAGMENT`.

    Raises:
        ShaderError: the driver refuses it; the message gives file:line of each complaint.
    """
    sources = [load_source(name) for name in (vertex, fragment) if name is not None]
    try:
        return ctx.program(
            vertex_shader=sources[0].text,
            fragment_shader=sources[1].text if len(sources) > 1 else None,
            varyings=varyings,
        )
    except moderngl.Error as error:
        raise ShaderError(_first_line(str(error), vertex, fragment, sources)) from None


def _first_line(log: str, vertex: str, fragment: str | None, sources: list[Source]) -> str:
    """The driver's log with its file numbers replaced by names."""
    stage = sources[-1] if "fragment_shader" in log else sources[0]
    complaints = []
    for line in log.splitlines():
        for pattern in _LOCATIONS:
            match = pattern.match(line.strip())
            if match and int(match["file"]) < len(stage.files):
                name = stage.files[int(match["file"])]
                complaints.append(f"shaders/{name}:{match['line']}: {match['text']}")
                break
    names = vertex if fragment is None else f"{vertex} + {fragment}"
    return "\n".join([f"{names} does not compile here", *(complaints or [log.strip()])])
