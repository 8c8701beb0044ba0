"""An OpenGL context without a window, and what kind of renderer stands behind a context."""

from __future__ import annotations

import moderngl

from progdf.errors import ProgdfError

SOFTWARE = ("llvmpipe", "softpipe", "swiftshader", "microsoft basic render", "swrast")
"""Parts of GL_RENDERER, in lower case, of renderers that run on the processor."""


def headless_context() -> moderngl.Context:
    """A GL 3.3 core context of its own, through EGL where there is one. The caller releases it.

    Raises:
        ProgdfError: this machine has no OpenGL 3.3.
    """
    reasons = []
    for backend in ("egl", None):  # no EGL on Windows and macOS: their own way
        named = {} if backend is None else {"backend": backend}
        try:
            return moderngl.create_context(standalone=True, require=330, **named)  # type: ignore[arg-type]
        except Exception as error:  # each platform's loader raises its own kind
            reasons.append(" ".join(str(error).split()))
    raise ProgdfError(
        f"there is no OpenGL 3.3 here ({reasons[0]}); install libegl1 and libgl1, or use --engine cpu"
    )


def is_software(ctx: moderngl.Context) -> bool:
    """Whether the context draws on the processor; then the CPU rasterizer is several times faster."""
    renderer = str(ctx.info["GL_RENDERER"]).lower()
    return any(name in renderer for name in SOFTWARE)
