"""Small pictures of snapshots, drawn by the engine once each and kept as textures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import moderngl
import numpy as np

from progdf.errors import ProgdfError
from viewer.camera.view_camera import ViewCamera
from viewer.gl.present import picture_texture
from viewer.render.engine import ViewEngine
from viewer.state.snapshots import SliderSnapshot, restore
from viewer.state.view_state import Comparison, ViewState

from .film import to_pixels

SIZE = (168, 126)
"""Pixels of a small picture."""


class Thumbnails:
    """The pictures of the snapshots on show.

    Args:
        ctx: where textures live
        engine: draws them; stays the caller's
    """

    def __init__(self, ctx: moderngl.Context, engine: ViewEngine) -> None:
        self._ctx, self._engine = ctx, engine
        self._made: dict[tuple[object, ViewCamera], moderngl.Texture] = {}

    def update(self, shown: Sequence[SliderSnapshot], view: ViewState) -> tuple[tuple[int, ...], bool]:
        """Texture names of the snapshots, 0 where one is not drawn yet, and whether any is missing.

        One is drawn a call, so that a session of many does not stop the hand.
        """
        keys = [_key(i, snapshot) for i, snapshot in enumerate(shown)]
        for key in [key for key in self._made if key not in keys]:
            self._made.pop(key).release()
        for i, key in enumerate(keys):
            if key not in self._made:
                self._made[key] = self._draw(i, shown[i], view)
                break
        missing = any(key not in self._made for key in keys)
        return tuple(self._made[key].glo if key in self._made else 0 for key in keys), missing

    def release(self) -> None:
        for texture in self._made.values():
            texture.release()
        self._made.clear()

    def _draw(self, index: int, snapshot: SliderSnapshot, view: ViewState) -> moderngl.Texture:
        edited = replace(view, layers=()) if index == 0 else restore(view, snapshot)
        wanted = replace(edited, camera=snapshot.camera, compare=Comparison())
        try:
            pixels = to_pixels(self._engine.image(wanted, SIZE))
        except ProgdfError:  # an edit that is not open
            pixels = np.zeros((SIZE[1], SIZE[0], 3), np.uint8)
        return picture_texture(self._ctx, pixels)


def _key(index: int, snapshot: SliderSnapshot) -> tuple[object, ViewCamera]:
    """What decides the picture; the original has no edit, however its layers are active."""
    return (snapshot.edit if index else None), snapshot.camera
