"""Double clicks on a slow machine: counted by when the presses arrived, not by the frames that took them."""

from __future__ import annotations

import math
from collections import deque

from imgui_bundle import imgui

LONGEST_S = 0.3
"""Between the two presses of a double click, as imgui has it."""
_ALWAYS_S = 1e6


class DoubleClicks:
    """Tells imgui which presses of the left button follow closely on the one before.

    imgui takes one event of a button a frame and measures in frame time: where a frame takes 100 ms, a quick
    double click is two clicks to it.
    """

    def __init__(self) -> None:
        self._last = -math.inf
        self._waiting: deque[tuple[int, bool]] = deque()  # presses that no frame has taken in yet

    def note_press(self, time: float, unheard: float, event_id: int) -> None:
        """The button went down.

        Args:
            time: when the window heard of it, seconds of any clock
            unheard: seconds before the window listened in which it drew: the press may be so much older
            event_id: the place of the press among imgui's input events
        """
        self._waiting.append((event_id, time - self._last - unheard <= LONGEST_S))
        self._last = time

    def apply(self) -> None:
        """Call before `imgui.new_frame`: the press that it takes in counts as noted."""
        queue = imgui.get_current_context().input_events_queue
        while self._waiting and (queue.empty() or queue[0].event_id > self._waiting[0][0]):
            self._waiting.popleft()
        limit = LONGEST_S
        if self._waiting:
            limit = _ALWAYS_S if self._waiting[0][1] else 0.0
        io = imgui.get_io()
        io.mouse_double_click_time, io.mouse_single_click_delay = limit, 2.0 * _ALWAYS_S
