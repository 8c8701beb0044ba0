"""What a tool will ask of the picture under it, worked out by another thread before the hand needs it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache

from progdf.scene.selection import Surface

MANY = 100_000
"""Gaussians below which nothing is worked out ahead: it takes a hand's tenth of a second at once."""


class Surfaces:
    """The surface of the picture at rest."""

    def __init__(self) -> None:
        self._key: object = None
        self._surface: Surface | None = None
        self._colors = False

    def at(self, key: object) -> Surface | None:
        """That of a picture if it was looked at ahead, or is just being."""
        return self._surface if key == self._key else None

    def look(self, key: object, make: Callable[[], Surface], colors: bool) -> bool:
        """Look at the surface of another picture, unless it is the last one's; whether it is another.

        Args:
            key: what decides it
            make: gives it; it must stay as it is
            colors: whether colors will be asked for as well
        """
        if (key, colors) == (self._key, self._colors):
            return False
        self.drop()
        self._key, self._colors, self._surface = key, colors, make()
        beside(self._surface.prepare, colors)
        return True

    def drop(self) -> None:
        """Forget it."""
        if self._surface is not None:
            self._surface.drop()
        self._key = self._surface = None


def beside(work: Callable[..., object], *arguments: object) -> None:
    """Do it in another thread, after what was to be done there before."""
    _worker().submit(work, *arguments)


@cache
def _worker() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(1, thread_name_prefix="ahead")
