"""The internal command `window-test`: open a window, draw one frame, and print the OpenGL driver."""

from __future__ import annotations

from collections.abc import Sequence

from progdf.terminal import print_line


def main(argv: Sequence[str]) -> int:
    """Open the window with its splash for one frame, and print the driver and the size in pixels."""
    from viewer.ui.splash import Splash

    splash = Splash()
    try:
        splash.draw("Testing …", 0.0)
        splash.context.finish()
        driver = splash.context.info
        width, height = splash.context.screen.size
        print_line(f"OpenGL {driver['GL_VERSION']} by {driver['GL_RENDERER']}, {width}×{height} pixels")
    finally:
        splash.close()
    return 0
