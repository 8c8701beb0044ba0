"""When the next frame is due: at once while things settle, never while nothing changes."""

from __future__ import annotations

from collections.abc import Sequence

SETTLE_FRAMES = 3  # imgui takes a frame or two until hovering and layout have followed an event
LINGER_S = 0.65  # one more frame after this, for tooltips


class Pace:
    """Counts frames since the last event."""

    def __init__(self) -> None:
        self._unsettled = SETTLE_FRAMES
        self._lingers = True

    def wake(self) -> None:
        """Something happened."""
        self._unsettled, self._lingers = SETTLE_FRAMES, True

    def rest(self) -> None:
        """Nothing can be drawn, as the window is minimised."""
        self._unsettled, self._lingers = 0, False

    def step(self) -> None:
        """A frame begins."""
        self._lingers = self._lingers and self._unsettled > 0
        self._unsettled = max(self._unsettled - 1, 0)

    def patience(self, others: Sequence[float]) -> float | None:
        """Seconds until the next frame is due without an event, or None: none is.

        Args:
            others: seconds until something else wants a frame
        """
        if self._unsettled > 0:
            return 0.0
        return min([*others, LINGER_S] if self._lingers else others, default=None)
