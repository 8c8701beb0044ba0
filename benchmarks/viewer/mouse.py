"""Simulated mouse for the whole viewer without a window: mouse events in, finished pixels and times out."""

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
"""Size of the picture, pixels; the panel is beside it."""

_FRAME_S = 1.0 / 60.0
_POLL_INTERVAL_S = 0.02
# the panel's layout at 1×, pixels
_SLIDER_INSET = 12 + 10 + 7
_FIRST_SLIDER_Y = 131.0


def slider_at(width: float, layer: int, strength: float) -> tuple[float, float]:
    """Return the window position of a folded layer's slider handle at a strength, for a window at 1×."""
    x = width - panel.WIDTH_PX + _SLIDER_INSET + strength * (panel.WIDTH_PX - 2 * _SLIDER_INSET)
    return x, _FIRST_SLIDER_Y + card.CARD_PX * layer


class Mouse:
    """Simulated mouse on its own `MainView`, which measures each finished frame.

    Args:
        ctx: GL context of the window
        engine: draws the splats, with `scene` and `gdfs`
        view: first view state
        size: picture size, pixels
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
        self.processor_ms = 0.0  # processor time of the last frame, all cores together
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

    def frame(self, seconds: float = _FRAME_S, event: bool = True) -> float:
        """Draw a frame and return the milliseconds to its finished pixels.

        Args:
            seconds: time since the last frame on the main view's clock
            event: True if an input event causes the frame, False if only time has passed
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
        """Draw frames without input, with the button held, until the picture is at full resolution."""
        began = time.perf_counter()
        self.frame(seconds=2 * REST_S)
        while self.main_view.canvas.pixels != 1 and time.perf_counter() - began < at_most_s:
            time.sleep(_POLL_INTERVAL_S)
            self.frame(seconds=_POLL_INTERVAL_S, event=False)

    def wait_pyramid(self) -> Pyramid | None:
        """Wait for the LOD pyramid of moving pictures; None if OpenGL has not drawn one yet."""
        renderer = self.engine.renderer
        if isinstance(renderer, CpuRenderer):
            live = renderer._scene
        elif renderer._moving is None:
            return None
        else:
            live = renderer._moving[0]
        return (live._fitted or live._pyramid or live.begin_pyramid()).result()

    def learn_detail(self) -> None:
        """Orbit the picture and stop, so that the renderer calibrates its level of detail."""
        for _ in range(2):  # the first turn makes the OpenGL renderer start its LOD pyramid
            self.turn(1.0)
            self.wait_pyramid()
        self.wait_sharp()
        self.wait_pyramid()  # the stop begins the fit of the pyramid

    def rest(self, seconds: float) -> None:
        """Draw the frames that are due without input, for this long."""
        began = time.perf_counter()
        while time.perf_counter() - began < seconds:
            wait = self.main_view.next_frame_delay()
            if wait is None:
                return
            time.sleep(min(wait, seconds))
            self.frame(seconds=max(wait, _FRAME_S), event=False)

    def settle(self) -> None:
        """Draw frames until no further one is due immediately."""
        while self.main_view.next_frame_delay() == 0.0:
            self.main_view.frame(self._screen, _FRAME_S)

    def move(self, x: float, y: float) -> float:
        """Move the mouse to a window position in pixels; return the milliseconds to finished pixels."""
        self._io.add_mouse_pos_event(x, y)
        return self.frame()

    def press(self) -> float:
        self._io.add_mouse_button_event(0, True)
        return self.frame()

    def release(self) -> float:
        self._io.add_mouse_button_event(0, False)
        return self.frame()

    def grip_slider(self, layer: int = 0) -> None:
        """Press the mouse on the handle of a layer's slider."""
        self.move(*slider_at(self.pixels[0], layer, self.main_view.work.view.layers[layer].strength))
        self.press()

    def grip_picture(self) -> None:
        """Press the mouse on the middle of the picture, to orbit it."""
        self.move(self.size[0] / 2, self.size[1] / 2)
        self.frame(seconds=1.0)  # avoids a double click
        self.press()

    def turn(self, pixels: float) -> float:
        """Drag the picture sideways by `pixels`; return the milliseconds to finished pixels."""
        x, y = self._io.mouse_pos
        return self.move(x + pixels, y)

    def picture(self) -> NDArray[np.uint8]:
        """Return the picture on the screen, without the panel. [H,W,3] uint8"""
        return read_rgb(self._screen, self.pixels)[:, : self.size[0]]
