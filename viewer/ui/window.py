"""glfw window: events, scale, title, full screen. It draws nothing."""

from __future__ import annotations

import ctypes
import math
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from imgui_bundle import imgui

from progdf.system.desktop import has_command_key

from .glfw_library import glfw
from .keys import FLY_KEYS, Keys, Press, end_frame_here, has_pending_input, next_event_id
from .placement import Box, Frame, fit_box, window_box, window_frame, work_areas
from .splash import MINIMUM_SIZE_PX, Splash

LONGEST_S = 0.3
"""Maximum time between the two presses of a double click, as in imgui, in seconds."""
_UNLIMITED_S = 1e6


class DoubleClicks:
    """Detection of double clicks of the left button for imgui.

    imgui handles one event of a button per frame and measures frame times. At 100 ms a frame, it would see a
    quick double click as two clicks.
    """

    def __init__(self) -> None:
        self._last = -math.inf
        self._waiting: deque[tuple[int, bool]] = deque()  # presses that no frame has handled yet

    def note_press(self, time: float, unheard: float, event_id: int) -> None:
        """Record a press of the button.

        Args:
            time: when the window received it, seconds of any clock
            unheard: seconds without event handling before that; the press may be older by this much
            event_id: index of the press in imgui's input events
        """
        self._waiting.append((event_id, time - self._last - unheard <= LONGEST_S))
        self._last = time

    def apply(self) -> None:
        """Set imgui's double-click time for the next press; call before `imgui.new_frame`."""
        queue = imgui.get_current_context().input_events_queue
        while self._waiting and (queue.empty() or queue[0].event_id > self._waiting[0][0]):
            self._waiting.popleft()
        limit = LONGEST_S
        if self._waiting:
            limit = _UNLIMITED_S if self._waiting[0][1] else 0.0
        io = imgui.get_io()
        io.mouse_double_click_time = limit
        io.mouse_single_click_delay = 2.0 * _UNLIMITED_S


_FLY_KEYS = {name: getattr(glfw, f"KEY_{name}") for name in FLY_KEYS}
_MODIFIERS = range(glfw.KEY_LEFT_SHIFT, glfw.KEY_RIGHT_SUPER + 1)
KEY_NAMES = {
    **{getattr(glfw, f"KEY_{c}"): c for c in "ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789"},
    **{getattr(glfw, f"KEY_F{i}"): f"F{i}" for i in range(1, 13)},
    **{
        getattr(glfw, f"KEY_{name.upper()}"): name
        for name in ("Left", "Right", "Up", "Down", "Escape", "Tab", "Enter", "Backspace", "Space", "Delete")
    },
    glfw.KEY_BACKSLASH: "\\",
    glfw.KEY_LEFT_BRACKET: "[",
    glfw.KEY_RIGHT_BRACKET: "]",
    glfw.KEY_COMMA: ",",
    glfw.KEY_PERIOD: ".",
    glfw.KEY_EQUAL: "=",
    glfw.KEY_MINUS: "-",
    glfw.KEY_KP_ADD: "=",
    glfw.KEY_KP_SUBTRACT: "-",
    glfw.KEY_KP_ENTER: "Enter",
    **{getattr(glfw, f"KEY_KP_{i}"): f"Num{i}" for i in range(10)},
    glfw.KEY_KP_DECIMAL: "Num.",
}


class Window:
    """Window of the interface.

    Args:
        splash: opened the window, and is drawn again during long waits
    """

    def __init__(self, splash: Splash) -> None:
        self.splash = splash
        self.handle = splash.handle
        self.context = splash.context
        self._pointed: tuple[float, float] | None = None
        self._pressed: list[Press] = []
        self._down: dict[int, str] = {}  # names of the held keys
        self._chorded: set[int] = set()  # keys pressed with Ctrl, which do not fly after its release
        self._windowed: tuple[Box, Frame] | None = None  # the window's box before full screen
        self._clicks = DoubleClicks()
        self._heard_until = time.perf_counter()  # end of the last event handling, before drawing
        self._unheard_s = 0.0  # seconds without event handling before the last one

    def listen(
        self, wake: Callable[[], None], dropped: Callable[[Sequence[Path]], None], redraw: Callable[[], None]
    ) -> None:
        """Register the callbacks, also imgui's. Call with the imgui context current.

        Args:
            wake: called for every event
            dropped: called with the dropped files
            redraw: draws at once (some systems block the event loop while a window is resized)
        """

        def on_event(*_: object) -> None:
            wake()

        def on_key(_: object, key: int, scancode: int, action: int, mods: int) -> None:
            self._note_key(key, scancode, action, mods)
            wake()

        def on_button(_: object, button: int, action: int, __: int) -> None:
            if button == glfw.MOUSE_BUTTON_LEFT and action == glfw.PRESS:
                # imgui adds its own event after this one
                self._clicks.note_press(time.perf_counter(), self._unheard_s, next_event_id())
            wake()

        def on_drop(_: object, names: Sequence[str]) -> None:
            dropped([Path(name) for name in names])

        def on_refresh(_: object) -> None:
            redraw()

        for listen in (
            glfw.set_cursor_pos_callback,
            glfw.set_cursor_enter_callback,
            glfw.set_scroll_callback,
            glfw.set_char_callback,
            glfw.set_window_focus_callback,
            glfw.set_window_iconify_callback,
            glfw.set_framebuffer_size_callback,
        ):
            listen(self.handle, on_event)
        callback: Any = on_drop  # glfw's annotation has the arguments of the C function
        glfw.set_drop_callback(self.handle, callback)
        glfw.set_key_callback(self.handle, on_key)
        glfw.set_mouse_button_callback(self.handle, on_button)
        glfw.set_window_refresh_callback(self.handle, on_refresh)
        # imgui's callbacks call the ones installed before
        imgui.backends.glfw_init_for_opengl(ctypes.cast(self.handle, ctypes.c_void_p).value or 0, True)

    def wait(self, patience: float | None) -> None:
        """Handle events: at once (0), for this many seconds at most, or until the next one (None)."""
        self._unheard_s = time.perf_counter() - self._heard_until
        if patience is None:
            glfw.wait_events()
        elif patience > 0.0:
            glfw.wait_events_timeout(patience)
        else:
            glfw.poll_events()
        self._heard_until = time.perf_counter()

    def new_frame(self) -> None:
        """Begin an imgui frame with the received events."""
        imgui.backends.glfw_new_frame()
        self._clicks.apply()

    def ask_to_close(self) -> None:
        glfw.set_window_should_close(self.handle, True)

    def stay_open(self) -> None:
        """Withdraw a request to close."""
        glfw.set_window_should_close(self.handle, False)

    @property
    def closing(self) -> bool:
        return bool(glfw.window_should_close(self.handle))

    @property
    def pixels(self) -> tuple[int, int]:
        """Size of the framebuffer; (0, 0) while minimized."""
        width, height = glfw.get_framebuffer_size(self.handle)
        return int(width), int(height)

    @property
    def ui_scale(self) -> float:
        """Window coordinates per design pixel, at least 0.5.

        It is the scale of the screen without the part that the window coordinates include already. It is
        smaller in a window below `MINIMUM_SIZE_PX` at that scale, so that all tools stay in reach.
        """
        pixels = self.pixels[0]
        if not pixels:
            return 1.0
        width, height = glfw.get_window_size(self.handle)
        content = float(glfw.get_window_content_scale(self.handle)[0])
        fitting = min(width / MINIMUM_SIZE_PX[0], height / MINIMUM_SIZE_PX[1])
        return max(min(content * width / pixels, fitting), 0.5)

    def take_keys(self) -> Keys:
        """Return the keyboard input since the last call."""
        down = {n: key for n, key in _FLY_KEYS.items() if glfw.get_key(self.handle, key) == glfw.PRESS}
        fly = frozenset(n for n, key in down.items() if key not in self._chorded)
        keys = Keys(tuple(self._pressed), frozenset(self._down.values()), fly)
        self._pressed.clear()
        return keys

    def point(self, at: tuple[float, float] | None) -> None:
        """Move the mouse to `at`, the tool pointer that keys have moved, if the system allows it."""
        if at not in (None, self._pointed):
            glfw.set_cursor_pos(self.handle, *at)
        self._pointed = at

    def _note_key(self, key: int, scancode: int, action: int, mods: int) -> None:
        if action == glfw.RELEASE:
            self._down.pop(key, None)
            self._chorded.discard(key)
            if key in _MODIFIERS and has_pending_input():
                end_frame_here()  # imgui adds its own event after this one
            return
        name = key_name(key, scancode)
        pressed = chord(name, mods)
        if pressed.startswith("Ctrl+") and action == glfw.PRESS:
            self._chorded.add(key)
        self._down[key] = name
        # imgui adds its own event after this one
        self._pressed.append(Press(pressed, action == glfw.REPEAT, next_event_id()))

    def present(self) -> None:
        glfw.swap_buffers(self.handle)

    def rename(self, title: str) -> None:
        glfw.set_window_title(self.handle, title)

    def toggle_full_screen(self) -> None:
        """Fill the primary monitor, or restore the earlier position, moved onto a screen if needed."""
        if self._windowed is not None:
            no_monitor: Any = None
            box = fit_box(*self._windowed, work_areas())
            place = (box.x, box.y, box.width, box.height)
            glfw.set_window_monitor(self.handle, no_monitor, *place, glfw.DONT_CARE)
            self._windowed = None
            return
        monitor = glfw.get_primary_monitor()
        if monitor:
            self._windowed = (window_box(self.handle), window_frame(self.handle))
            mode = glfw.get_video_mode(monitor)
            glfw.set_window_monitor(
                self.handle, monitor, 0, 0, mode.size.width, mode.size.height, mode.refresh_rate
            )


def wake_window() -> None:
    """Make `Window.wait` return; callable from any thread."""
    glfw.post_empty_event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl+C in the terminal end a wait for events; Python alone would handle it after the next event."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    before = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)

    def listen() -> None:
        while receiver.recv(1):
            glfw.post_empty_event()

    listener = threading.Thread(target=listen, daemon=True)
    listener.start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        sender.close()
        listener.join()
        receiver.close()


def key_name(key: int, scancode: int) -> str:
    """Return the name of a glfw key in `keys.NAMES`: letters by the keyboard layout, others by position."""
    name = KEY_NAMES.get(key, "")
    if len(name) == 1 and name.isalpha():
        label = glfw.get_key_name(key, scancode) or ""
        return label.upper() if label.isascii() and label.isalpha() else name
    return name


def chord(name: str, mods: int) -> str:
    """Return a key with its modifiers, in the form of `keys.KEYS`; on a Mac, Command counts as Ctrl."""
    ctrl = glfw.MOD_CONTROL | (glfw.MOD_SUPER if has_command_key() else 0)
    modifiers = (("Ctrl+", ctrl), ("Shift+", glfw.MOD_SHIFT), ("Alt+", glfw.MOD_ALT))
    return "".join(prefix for prefix, bit in modifiers if mods & bit) + name
