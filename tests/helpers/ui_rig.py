"""The whole user interface without a window: main view, engine and pointer, in a headless context."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
from imgui_bundle import imgui
from numpy.typing import NDArray

from tests.helpers.stacks import Stack, bear_stack
from viewer.app.main_view import MainView
from viewer.files.document import Document
from viewer.gl.present import read_rgb
from viewer.panel import card, panel
from viewer.panel.slider import RADIUS_PX
from viewer.render.engine import ViewEngine
from viewer.render.gl_renderer import headless_context
from viewer.state.view_state import LayerState, ViewState
from viewer.ui.context import LAYER_PADDING_PX, PANEL_PADDING_PX
from viewer.ui.keys import NO_KEYS, Keys, Press
from viewer.ui.tips import Box

STEP_S = 1.0 / 60.0
SLIDER_INSET = PANEL_PADDING_PX[0] + LAYER_PADDING_PX[0] + RADIUS_PX
"""Distance of a strength slider's ends from the panel's edges."""
HEAD = 102.0  # height of the name's center on the top card
TRACK = 127.0  # height of the slider's center on the top card
BACKGROUND = (0.749, 0.847, 0.945)


@cache
def bear(size: int = 1500) -> Stack:
    return bear_stack(size)


def first_view(stack: Stack, *strengths: float) -> ViewState:
    """Return a front view of the bear with its edits at these strengths.

    It is never coarse, however slow the machine is, and shows no axes.
    """
    layers = tuple(LayerState(i, stack.gdfs[i].name, s) for i, s in enumerate(strengths))
    return ViewState(
        camera=stack.first_camera,
        layers=layers,
        background=BACKGROUND,
        dynamic_resolution="off",
        axes=False,
    )


_render = imgui.backends.opengl3_render_draw_data
_ITEMS = (
    *("button", "small_button", "invisible_button", "checkbox", "selectable", "menu_item"),
    *("slider_float", "drag_int", "input_text", "input_text_with_hint", "color_button"),
)
"""Functions of imgui that draw the items which `item_box` finds."""


def center(box: Box) -> tuple[float, float]:
    """Return the center of a rectangle."""
    return (box.left + box.right) / 2, (box.top + box.bottom) / 2


def item_box(frame: Callable[[], None], name: str, number: int = 0) -> Box:
    """Draw a frame; return the rectangle of an item in window coordinates.

    Args:
        frame: draws the frame
        name: the item's text or its imgui id
        number: number of the item among the visible ones of this name, in the order of drawing
    """
    found = list[Box]()

    def recorded(draw: Callable[..., Any]) -> Callable[..., Any]:
        def record(label: str, *args: Any, **kwargs: Any) -> Any:
            result = draw(label, *args, **kwargs)
            if name in (label, *label.split("##")) and imgui.is_item_visible():
                low = imgui.get_item_rect_min()
                high = imgui.get_item_rect_max()
                found.append(Box(low.x, low.y, high.x, high.y))
            return result

        return record

    with ExitStack() as stack:
        for item in _ITEMS:
            stack.enter_context(patch.object(imgui, item, recorded(getattr(imgui, item))))
        frame()
    assert number < len(found), f"item {name!r}: {len(found)} are visible"
    return found[number]


class Rig:
    """Pointer and keys for the main view. One frame follows each move, press and key, as in the window.

    Imgui's drawing over the picture is painted on demand, as a software GPU takes longer for it than for the
    rest of a frame.
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
        """Draw frames as the window's loop does, until the main view needs no immediate frame."""
        while self.main_view.next_frame_delay() == 0.0:
            self.frame()

    def rest(self, seconds: float = 3.0) -> None:
        """Draw frames as the window's loop does for `seconds` without input."""
        while seconds > 0.0 and (wait := self.main_view.next_frame_delay()) is not None:
            passed = max(min(wait, seconds), STEP_S)
            self.main_view.frame(self.screen, passed)
            seconds -= passed

    def pause(self, seconds: float) -> None:
        """Draw one frame after `seconds`."""
        self.main_view.frame(self.screen, seconds)

    def event(self) -> None:
        """Wake the main view and draw a frame, as the window does for any input."""
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
        """Press and release a chord of `keys.KEYS`."""
        name = chord.rpartition("+")[2]
        self.main_view.wake()
        self.frame(keys=Keys((Press(chord),), frozenset({name})))
        self.frame()
        self.settle()

    def modifier(self, key: imgui.Key, down: bool = True) -> None:
        """Press or release a modifier for the mouse."""
        self.io.add_key_event(key, down)
        self.event()

    def render(self, data: imgui.ImDrawData) -> None:
        """Replace imgui's backend. A frame that is written to a file is painted at once."""
        self._unpainted = data
        if self.main_view.work.requests:
            self._paint()

    def _paint(self) -> None:
        if self._unpainted is not None:
            self.screen.use()
            _render(self._unpainted)
            self._unpainted = None

    def image(self) -> NDArray[np.uint8]:
        """Return the pixels on screen. [H,W,3]"""
        self._paint()
        return read_rgb(self.screen, self.pixels)

    def picture(self) -> NDArray[np.uint8]:
        """Return the area of the splats, without imgui's drawing over it."""
        if self._unpainted is None:
            self.frame()
        wide = self.pixels[0] - round(panel.WIDTH_PX * self.pixels[0] / self.points[0])
        return read_rgb(self.screen, self.pixels)[:, :wide]

    def box(self, name: str, number: int = 0) -> Box:
        """Draw a frame; return the rectangle of an item, see `item_box`."""
        return item_box(self.event, name, number)

    def at(self, name: str, number: int = 0) -> tuple[float, float]:
        """Draw a frame; return the center of an item in window coordinates, see `item_box`."""
        return center(self.box(name, number))

    @property
    def strengths(self) -> list[float]:
        return [layer.strength for layer in self.main_view.work.view.layers]

    def slider(self, layer: int, strength: float) -> tuple[float, float]:
        """Return the window position (at 1×) of a layer's handle at a strength. The last layer is on top."""
        inset = SLIDER_INSET
        span = panel.WIDTH_PX - 2 * inset
        row = len(self.main_view.work.view.layers) - 1 - layer
        return self.points[0] - panel.WIDTH_PX + inset + strength * span, TRACK + card.CARD_PX * row


@contextmanager
def rig(
    view: ViewState | None = None,
    points: tuple[int, int] = (640, 540),
    density: float = 1.0,
    scale: float = 1.0,
    stack: Stack | Document | None = None,
    pictures: Path | None = None,
    draw: str = "cpu",
) -> Iterator[Rig]:
    """Open a main view on the bear.

    Args:
        view: the first state; None is the bear with both edits at strength 0.5
        points: size of the window in its own coordinates
        density: framebuffer pixels per window coordinate, as on a Mac
        scale: window coordinates per design pixel, as on Windows and X11
        stack: scene and edits; None is the bear
        pictures: folder of saved pictures; None is a folder that is removed at the end
        draw: renderer of the splats, as for the engine
    """
    stack = stack or bear()
    context = headless_context()
    engine = ViewEngine(context, stack.scene, stack.gdfs, draw)
    document = stack if isinstance(stack, Document) else Document("bear.ply", stack.scene, stack.gdfs)
    facts = document.facts()
    spare = TemporaryDirectory()
    folder = pictures or Path(spare.name)
    main_view = MainView(context, engine, facts, view or first_view(stack, 0.5, 0.5), scale, folder)
    new_rig = Rig(main_view, points, density)
    try:
        with patch.object(imgui.backends, "opengl3_render_draw_data", new_rig.render):
            yield new_rig
    finally:
        main_view.close()
        engine.release()
        context.release()
        spare.cleanup()
