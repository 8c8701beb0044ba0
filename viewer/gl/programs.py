"""GLSL programs from the package `shaders`, with resolved includes and errors reported as file:line."""

from __future__ import annotations

import re

import moderngl

from shaders import ShaderError, Source, load_source

_LOCATIONS = (
    re.compile(r"^(?:ERROR|WARNING): (?P<file>\d+):(?P<line>\d+): ?(?P<text>.*)$"),  # macOS, Intel, AMD
    re.compile(r"^(?P<file>\d+):(?P<line>\d+)\(\d+\): ?(?P<text>.*)$"),  # Mesa
    re.compile(r"^(?P<file>\d+)\((?P<line>\d+)\) ?: ?(?P<text>.*)$"),  # NVIDIA
)


def load_program(
    ctx: moderngl.Context, vertex: str, fragment: str | None = None, varyings: tuple[str, ...] = ()
) -> moderngl.Program:
    """Compile and link `shaders/VERTEX` and, unless only `varyings` are captured, `shaders/FRAGMENT`.

    Raises:
        ShaderError: the driver rejects it; the message gives file:line of each error.
    """
    sources = [load_source(name) for name in (vertex, fragment) if name is not None]
    try:
        return ctx.program(
            vertex_shader=sources[0].text,
            fragment_shader=sources[1].text if len(sources) > 1 else None,
            varyings=varyings,
        )
    except moderngl.Error as error:
        raise ShaderError(_readable_log(str(error), vertex, fragment, sources)) from None


def _readable_log(log: str, vertex: str, fragment: str | None, sources: list[Source]) -> str:
    """Return the driver's log with its file numbers replaced by names."""
    stage = sources[-1] if "fragment_shader" in log else sources[0]
    errors = []
    for line in log.splitlines():
        for pattern in _LOCATIONS:
            match = pattern.match(line.strip())
            if match and int(match["file"]) < len(stage.files):
                name = stage.files[int(match["file"])]
                errors.append(f"shaders/{name}:{match['line']}: {match['text']}")
                break
    names = vertex if fragment is None else f"{vertex} + {fragment}"
    return "\n".join([f"{names} does not compile with this driver", *(errors or [log.strip()])])
