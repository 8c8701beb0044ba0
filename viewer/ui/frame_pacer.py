"""When the next frame is due: at once while things settle, never while nothing changes."""

from __future__ import annotations

from collections.abc import Sequence

SETTLE_FRAMES = 3  # imgui takes a frame or two until hovering and layout have followed an event
LINGER_S = 0.65
"""Seconds after which a resting mouse gets its tooltip: a little more than imgui's own two delays."""


class FramePacer:
    """Counts frames, and seconds of rest, since the last event."""

    def __init__(self) -> None:
        self._unsettled = SETTLE_FRAMES
        self._rest_left: float | None = LINGER_S  # None: the tooltip has had its frames

    def wake(self) -> None:
        """Something happened."""
        self._unsettled, self._rest_left = SETTLE_FRAMES, LINGER_S

    def rest(self) -> None:
        """Nothing can be drawn, as the window is minimized."""
        self._unsettled, self._rest_left = 0, None

    def step(self, seconds: float) -> None:
        """A frame begins, so long after the last one."""
        if self._unsettled > 0:
            self._unsettled -= 1
        elif self._rest_left is not None:
            self._rest_left -= seconds
            if self._rest_left <= 0.0:
                # imgui counts the delay up in this frame, opens the tooltip unseen in the next one to measure
                # it, and shows it in the one after
                self._unsettled, self._rest_left = SETTLE_FRAMES, None

    def next_frame_delay(self, others: Sequence[float]) -> float | None:
        """Seconds until the next frame is due without an event, or None: none is.

        Args:
            others: seconds until something else wants a frame
        """
        if self._unsettled > 0:
            return 0.0
        waits = [*others] if self._rest_left is None else [*others, self._rest_left]
        return min(waits, default=None)
