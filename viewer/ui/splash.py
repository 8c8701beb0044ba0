"""Window and splash screen, drawn by OpenGL alone: imgui, torch and numba take seconds to import."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any, TypeVar

import moderngl
from PIL import Image, ImageDraw, ImageFont

from progdf.errors import ProgdfError
from progdf.system.desktop import display_remedy
from viewer.gl.programs import load_program

from .glfw_library import BUNDLE, glfw
from .placement import keep_on_screen

_Made = TypeVar("_Made")

SIZE = (1280, 800)
MINIMUM_SIZE_PX = (640, 400)
TITLE = "ProGDF Studio"
PANEL = 0x1E2024
FIELD = 0x383C43
TEXT = 0xDEE1E6
ACCENT = 0x5A9CF0
"""Colors of the palette, 0xRRGGBB."""
_INKS = [f"#{color:06x}" for color in (PANEL, FIELD, TEXT, ACCENT)]
TEXT_PX = 15.0
FONTS = BUNDLE / "assets" / "fonts"
REGULAR = FONTS / "Roboto" / "Roboto-Regular.ttf"
SPLASH_DELAY_S = 0.15
"""Delay before the splash is shown, in seconds."""
EVERY_S = 0.1
"""Time between two frames of the splash, in seconds."""
FIRST_S = 4.0
"""Delay before `FIRST_TEXT` is added, in seconds."""
FIRST_TEXT = "(the first start on a machine takes half a minute)"
"""Explanation of a long wait."""
_HINTS = (
    (glfw.CONTEXT_VERSION_MAJOR, 3),
    (glfw.CONTEXT_VERSION_MINOR, 3),
    (glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE),
    (glfw.OPENGL_FORWARD_COMPAT, True),
    (glfw.SCALE_TO_MONITOR, True),
    (glfw.VISIBLE, False),  # until it has its position on the screen
    (glfw.DEPTH_BITS, 0),
    (glfw.STENCIL_BITS, 0),
)


class Splash:
    """glfw window with a current OpenGL 3.3 context that shows a progress text.

    Args:
        title: text of the title bar
        size: width and height at 1×; less on a smaller screen

    Raises:
        ProgdfError: there is no display, or no OpenGL 3.3 on it.
    """

    def __init__(self, title: str = TITLE, size: tuple[int, int] = SIZE) -> None:
        errors: list[str] = []
        glfw.set_error_callback(lambda _, text: errors.append(_decode(text)))
        if not glfw.init():
            raise _no_window("no window can be opened here", errors)
        for hint, value in _HINTS:
            glfw.window_hint(hint, value)
        self.handle: Any = glfw.create_window(*size, title, None, None)
        if not self.handle:
            glfw.terminate()
            raise _no_window("no window with OpenGL 3.3 can be opened here", errors)
        keep_on_screen(self.handle, MINIMUM_SIZE_PX)
        glfw.show_window(self.handle)
        glfw.make_context_current(self.handle)
        glfw.swap_interval(1)
        # glfw's own loader works with GLX, EGL, WGL and Cocoa
        moderngl.init_context(_GlfwLoader())
        self.context: moderngl.Context = moderngl.get_context()
        self._picture = SplashPicture(self.context)

    def close(self) -> None:
        glfw.destroy_window(self.handle)
        glfw.terminate()

    def draw(self, text: str, seconds: float) -> None:
        """Draw a frame: the text, the elapsed seconds, and a moving bar."""
        size = glfw.get_framebuffer_size(self.handle)
        scale = glfw.get_window_content_scale(self.handle)[0]
        if 0 not in size:
            self._picture.draw(self.context.screen, size, scale, text, seconds)
            glfw.swap_buffers(self.handle)

    def wait(
        self,
        work: Future[_Made],
        text: str | Callable[[], str],
        listen: Callable[[], object] = glfw.poll_events,
    ) -> _Made:
        """Wait for the result of another thread; handle window events meanwhile, and show a splash after a
        delay.

        Args:
            work: runs in another thread
            text: the current work, or a function that returns it
            listen: handles the events
        """
        begun = time.perf_counter()
        patience = SPLASH_DELAY_S
        while not wait([work], patience).done:
            patience = EVERY_S
            seconds = time.perf_counter() - begun
            listen()
            words = text if isinstance(text, str) else text()
            self.draw(words if seconds < FIRST_S else f"{words} {FIRST_TEXT}", seconds)
        return work.result()


class SplashPicture:
    """Progress text drawn into a framebuffer; `release` it when done."""

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self._program = load_program(context, "present.vert", "present.frag")
        self._vao = context.vertex_array(self._program, [])

    def draw(
        self, screen: moderngl.Framebuffer, size: tuple[int, int], scale: float, text: str, seconds: float
    ) -> None:
        """Fill the framebuffer.

        Args:
            size: width and height of the framebuffer, pixels
            scale: pixels per design pixel
            text: the current work
            seconds: elapsed time, which moves the bar
        """
        panel, field, ink, accent = _INKS
        words = f"{text}  ·  {seconds:.0f} s" if seconds >= 2.0 else text
        font = ImageFont.truetype(REGULAR, TEXT_PX * scale)
        wide = 240.0 * scale
        tall = 4.0 * scale
        middle = size[1] // 2
        width = min(round(max(font.getlength(words), wide)), size[0])
        image = Image.new("RGBA", (width, middle + round(3.0 * TEXT_PX * scale)), panel)
        canvas = ImageDraw.Draw(image)
        y = image.height - middle
        x = (width - wide) / 2
        canvas.text((width / 2, y - 1.2 * TEXT_PX * scale), words, ink, font, anchor="mm")
        at = x + 0.7 * wide * (0.5 - 0.5 * math.cos(2.0 * seconds))
        for left, length, color in ((x, wide, field), (at, 0.3 * wide, accent)):
            canvas.rounded_rectangle((left, y, left + length, y + tall), tall / 2, color)
        screen.use()
        self._context.viewport = (0, 0, *size)
        red, green, blue = PANEL.to_bytes(3, "big")
        screen.clear(red / 255, green / 255, blue / 255)
        picture = self._context.texture(image.size, 4, image.tobytes())
        left = (size[0] - width) // 2
        picture.use(0)
        self._program["picture"] = 0
        self._program["left"] = left
        self._context.viewport = (left, 0, *image.size)
        self._context.enable_only(moderngl.NOTHING)
        self._vao.render(moderngl.TRIANGLES, vertices=3)
        picture.release()

    def release(self) -> None:
        self._vao.release()
        self._program.release()


class _GlfwLoader:
    """Loader of OpenGL functions for moderngl."""

    def load_opengl_function(self, name: str) -> int:
        return ctypes.cast(glfw.get_proc_address(name), ctypes.c_void_p).value or 0

    def release(self) -> None:
        """Release nothing; moderngl requires this method."""


def _no_window(what: str, errors: Sequence[str]) -> ProgdfError:
    why = f" ({errors[-1]})" if errors else ""
    remedy = f"; {display_remedy()}" if display_remedy() else ""
    return ProgdfError(f"{what}{why}{remedy}; `progdf render` and `progdf export` work without a window")


def _decode(text: str | bytes) -> str:
    return text.decode(errors="replace") if isinstance(text, bytes) else text
