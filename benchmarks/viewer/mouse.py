"""A hand at the whole window without a window: mouse events in, finished pixels out, a clock beside them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from types import TracebackType

import moderngl
import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.rasterize.cpu.pyramid import Pyramid
from viewer.app.main_view import MainView
from viewer.files.document import Document
from viewer.gl.present import read_rgb
from viewer.panel import card, panel
from viewer.render.cpu_renderer import CpuRenderer
from viewer.render.dynamic_resolution import REST_S
from viewer.render.engine import ViewEngine
from viewer.state.view_state import ViewState

SIZE = (640, 480)
"""Of the picture; the panel stands beside it."""

_STEP_S = 1.0 / 60.0
_POLL_S = 0.02
# the panel's layout at 1×
_INSET = 12 + 10 + 7
_FIRST = 131.0


def slider_at(width: float, layer: int, strength: float) -> tuple[float, float]:
    """Where on a window of this width, at 1×, the handle of a folded layer stands at a strength."""
    x = width - panel.WIDTH_PX + _INSET + strength * (panel.WIDTH_PX - 2 * _INSET)
    return x, _FIRST + card.CARD_PX * layer


class Mouse:
    """Moves the mouse on a main_view of its own and says how long each finished frame took.

    Args:
        ctx: the GL context that the window is drawn in
        engine: draws the splats, with `scene` and `gdfs`
        view: what is shown first
        size: of the picture, pixels
    """

    def __init__(
        self,
        ctx: moderngl.Context,
        engine: ViewEngine,
        scene: Gaussians,
        gdfs: Sequence[Gdf],
        view: ViewState,
        size: tuple[int, int] = SIZE,
    ) -> None:
        self.engine = engine
        self.size = size
        self.processor_ms = 0.0  # that the last frame took of all cores together
        self.pixels = (size[0] + round(panel.WIDTH_PX), size[1])
        self._ctx = ctx
        self.main_view = MainView(ctx, engine, Document("scene.ply", scene, tuple(gdfs)).facts(), view)
        self._screen = ctx.simple_framebuffer(self.pixels)
        self._io = imgui.get_io()
        self._io.display_size = imgui.ImVec2(*self.pixels)
        self.settle()

    def __enter__(self) -> Mouse:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.main_view.close()
        self._screen.release()

    def frame(self, seconds: float = _STEP_S, event: bool = True) -> float:
        """Milliseconds from now to a frame's finished pixels.

        Args:
            seconds: that have passed on the main view's clock since the last one
            event: whether something has happened; else time alone brings this frame
        """
        began = time.perf_counter()
        used = time.process_time()
        if event:
            self.main_view.wake()
        self.main_view.frame(self._screen, seconds)
        self._ctx.finish()
        self.processor_ms = 1e3 * (time.process_time() - used)
        return 1e3 * (time.perf_counter() - began)

    def wait_sharp(self, at_most_s: float = 20.0) -> None:
        """Frames, the hand at rest on the button, until the picture is in full."""
        began = time.perf_counter()
        self.frame(seconds=2 * REST_S)
        while self.main_view.canvas.pixels != 1 and time.perf_counter() - began < at_most_s:
            time.sleep(_POLL_S)
            self.frame(seconds=_POLL_S, event=False)

    def wait_pyramid(self) -> Pyramid | None:
        """What moving pictures are drawn of, once it is built; None where OpenGL has drawn none yet."""
        renderer = self.engine.renderer
        if isinstance(renderer, CpuRenderer):
            live = renderer._scene
        elif renderer._moving is None:
            return None
        else:
            live = renderer._moving[0]
        return (live._pyramid or live.begin_pyramid()).result()

    def learn_detail(self) -> None:
        """Turn the picture and let the hand rest on it, which tells how fine is fine enough."""
        for _ in range(2):  # OpenGL begins its pyramid with the first picture in motion
            self.turn(1.0)
            self.wait_pyramid()
        self.wait_sharp()

    def settle(self) -> None:
        """Frames until nothing is left to draw at once."""
        while self.main_view.next_frame_delay() == 0.0:
            self.main_view.frame(self._screen, _STEP_S)

    def move(self, x: float, y: float) -> float:
        """Move the mouse there, window pixels; milliseconds to finished pixels."""
        self._io.add_mouse_pos_event(x, y)
        return self.frame()

    def press(self) -> float:
        self._io.add_mouse_button_event(0, True)
        return self.frame()

    def release(self) -> float:
        self._io.add_mouse_button_event(0, False)
        return self.frame()

    def grip_slider(self, layer: int = 0) -> None:
        """Take the handle of a layer's slider where it stands."""
        self.move(*slider_at(self.pixels[0], layer, self.main_view.work.view.layers[layer].strength))
        self.press()

    def grip_picture(self) -> None:
        """Take the picture by its middle, to turn it."""
        self.move(self.size[0] / 2, self.size[1] / 2)
        self.frame(seconds=1.0)  # or it would be the second half of a double click
        self.press()

    def turn(self, pixels: float) -> float:
        """Drag the picture sideways by so many pixels; milliseconds to finished pixels."""
        x, y = self._io.mouse_pos
        return self.move(x + pixels, y)

    def picture(self) -> NDArray[np.uint8]:
        """The splats as they are on screen. [H,W,3] uint8"""
        return read_rgb(self._screen, self.pixels)[:, : self.size[0]]
