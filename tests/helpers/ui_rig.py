"""The whole window without a window: main view, engine and a hand, in a headless context."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from tests.helpers.stacks import Stack, bear_stack
from viewer.app.main_view import MainView
from viewer.files.document import Document
from viewer.gl.present import read_rgb
from viewer.panel import card, panel
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import LayerState, ViewState
from viewer.ui.keys import NO_KEYS, Keys, Press

STEP_S = 1.0 / 60.0
HEAD = 107.0
TRACK = 131.0
"""Heights of the middle of the name, and of the slider, on the top card."""
BACKGROUND = (0.749, 0.847, 0.945)


@cache
def bear(size: int = 1500) -> Stack:
    return bear_stack(size)


def first_view(stack: Stack, *strengths: float) -> ViewState:
    """The bear from the front, its edits at these strengths; never coarse, however slow the machine is, and
    without axes over it."""
    layers = tuple(LayerState(i, stack.gdfs[i].name, s) for i, s in enumerate(strengths))
    return ViewState(
        camera=stack.first_camera,
        layers=layers,
        background=BACKGROUND,
        dynamic_resolution="off",
        axes=False,
    )


_render = imgui.backends.opengl3_render_draw_data


class Rig:
    """A hand on the main view: each move, press and key is followed by one frame, as in the window.

    What imgui draws over the picture is painted when somebody looks: a software GPU takes longer for it than
    all else of a frame.
    """

    def __init__(self, main_view: MainView, points: tuple[int, int], density: float) -> None:
        self.main_view = main_view
        self.points = points
        self.pixels = (round(points[0] * density), round(points[1] * density))
        self.screen = main_view.context.simple_framebuffer(self.pixels)
        self._unpainted: imgui.ImDrawData | None = None
        self.io = imgui.get_io()
        self.io.display_size = imgui.ImVec2(*points)
        self.io.display_framebuffer_scale = imgui.ImVec2(density, density)
        self.settle()

    def frame(self, count: int = 1, keys: Keys = NO_KEYS) -> None:
        for _ in range(count):
            self.main_view.frame(self.screen, STEP_S, keys)

    def settle(self) -> None:
        """What the window's loop does while the main view has no patience."""
        while self.main_view.next_frame_delay() == 0.0:
            self.frame()

    def rest(self, seconds: float = 3.0) -> None:
        """What the window's loop does for so long while nothing comes in."""
        while seconds > 0.0 and (wait := self.main_view.next_frame_delay()) is not None:
            passed = max(min(wait, seconds), STEP_S)
            self.main_view.frame(self.screen, passed)
            seconds -= passed

    def pause(self, seconds: float) -> None:
        """One frame that comes so much later."""
        self.main_view.frame(self.screen, seconds)

    def event(self) -> None:
        """Something came in: the window wakes the main view and draws."""
        self.main_view.wake()
        self.frame()

    def move(self, x: float, y: float) -> None:
        self.io.add_mouse_pos_event(x, y)
        self.event()

    def press(self, button: int = 0) -> None:
        self.io.add_mouse_button_event(button, True)
        self.event()

    def release(self, button: int = 0) -> None:
        self.io.add_mouse_button_event(button, False)
        self.event()
        self.settle()

    def drag(self, start: tuple[float, float], end: tuple[float, float], button: int = 0) -> None:
        self.move(*start)
        self.press(button)
        for share in (0.25, 0.5, 0.75, 1.0):
            self.move(*(a + share * (b - a) for a, b in zip(start, end, strict=True)))
        self.release(button)

    def click(self, x: float, y: float) -> None:
        self.move(x, y)
        self.press()
        self.release()

    def double_click(self, x: float, y: float) -> None:
        self.move(x, y)
        for _ in range(2):
            self.press()
            self.release()

    def wheel(self, x: float, y: float, steps: float) -> None:
        self.move(x, y)
        self.io.add_mouse_wheel_event(0.0, steps)
        self.event()
        self.settle()

    def key(self, chord: str) -> None:
        """Press a chord of `keys.KEYS` and let go."""
        name = chord.rpartition("+")[2]
        self.main_view.wake()
        self.frame(keys=Keys((Press(chord),), frozenset({name})))
        self.frame()
        self.settle()

    def modifier(self, key: imgui.Key, down: bool = True) -> None:
        """Hold a modifier for the mouse, or let it go."""
        self.io.add_key_event(key, down)
        self.event()

    def render(self, data: imgui.ImDrawData) -> None:
        """In place of imgui's backend; what is written to a file is painted at once."""
        self._unpainted = data
        if self.main_view.work.requests:
            self._paint()

    def _paint(self) -> None:
        if self._unpainted is not None:
            self.screen.use()
            _render(self._unpainted)
            self._unpainted = None

    def image(self) -> NDArray[np.uint8]:
        """What is on screen. [H,W,3]"""
        self._paint()
        return read_rgb(self.screen, self.pixels)

    def picture(self) -> NDArray[np.uint8]:
        """The part of it that shows the splats, without what imgui draws over it."""
        if self._unpainted is None:
            self.frame()
        wide = self.pixels[0] - round(panel.WIDTH_PX * self.pixels[0] / self.points[0])
        return read_rgb(self.screen, self.pixels)[:, :wide]

    @property
    def strengths(self) -> list[float]:
        return [layer.strength for layer in self.main_view.work.view.layers]

    def slider(self, layer: int, strength: float) -> tuple[float, float]:
        """Where on the window (at 1×) the handle of a layer stands at a strength; the top one is the last."""
        inset = 12 + 10 + 7  # the panel's and the card's padding, the handle's radius
        span = panel.WIDTH_PX - 2 * inset
        row = len(self.main_view.work.view.layers) - 1 - layer
        return self.points[0] - panel.WIDTH_PX + inset + strength * span, TRACK + card.CARD_PX * row


@contextmanager
def rig(
    view: ViewState | None = None,
    points: tuple[int, int] = (640, 540),
    density: float = 1.0,
    scale: float = 1.0,
    stack: Stack | None = None,
    pictures: Path = Path(),
    draw: str = "cpu",
) -> Iterator[Rig]:
    """A main view on the bear.

    Args:
        view: the first state; the bear with both edits half way if None
        points: size of the window in its own coordinates
        density: framebuffer pixels per window coordinate, as on a Mac
        scale: window coordinates per design pixel, as on Windows and X11
        draw: what draws the splats, as for the engine
    """
    stack = stack or bear()
    context = headless_context()
    engine = ViewEngine(context, stack.scene, stack.gdfs, draw)
    facts = Document("bear.ply", stack.scene, stack.gdfs).facts()
    main_view = MainView(context, engine, facts, view or first_view(stack, 0.5, 0.5), scale, pictures)
    made = Rig(main_view, points, density)
    try:
        with patch.object(imgui.backends, "opengl3_render_draw_data", made.render):
            yield made
    finally:
        main_view.close()
        engine.release()
        context.release()
