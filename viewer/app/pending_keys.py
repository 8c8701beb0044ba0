"""Keys that imgui has not come to yet: it takes text and keys in over several frames."""

from __future__ import annotations

import itertools
from dataclasses import replace

from imgui_bundle import imgui

from viewer.ui.keys import Keys, Press, has_reached_imgui, opens_text

OPENING_FRAMES = 4
"""From the wish for a text field until imgui gives it the keyboard."""


class PendingKeys:
    """Hands keys on in step with imgui; while a text field opens they wait for it."""

    def __init__(self) -> None:
        self._waiting: tuple[Press, ...] = ()
        self._frames = 0
        self._asked_at = -OPENING_FRAMES  # the frame in which a text field was last asked for

    @property
    def opening(self) -> bool:
        """Whether a text field was asked for and has no keyboard yet."""
        return self._frames - self._asked_at < OPENING_FRAMES and not imgui.get_io().want_text_input

    def take(self, keys: Keys) -> Keys:
        """The keys of one frame that imgui has come to; call once a frame."""
        pressed = (*self._waiting, *keys.pressed)
        count = 0 if self.opening else sum(1 for _ in itertools.takewhile(has_reached_imgui, pressed))
        opener = next((i for i, press in enumerate(pressed[:count]) if opens_text(press)), None)
        self._frames += 1
        if opener is not None:
            count, self._asked_at = opener + 1, self._frames
        self._waiting = pressed[count:]
        return replace(keys, pressed=pressed[:count])
