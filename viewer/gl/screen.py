"""Framebuffers: the one that keeps the picture, its way to the screen, and back into an array."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray


class PictureTarget:
    """An RGBA8 framebuffer that keeps the last picture, so that a frame without a change draws no splats."""

    def __init__(self, context: moderngl.Context) -> None:
        self.context = context
        self.framebuffer = context.framebuffer([context.texture((1, 1), 4)])
        self.fresh = True

    def fit(self, size: tuple[int, int]) -> None:
        """Make it `size` pixels (width, height); `fresh` where that made a new, empty one."""
        if self.framebuffer.size != size:
            self.release()
            self.framebuffer = self.context.framebuffer([self.context.texture(size, 4)])
            self.fresh = True

    def show(self, screen: moderngl.Framebuffer) -> None:
        """Copy it to the lower left corner of `screen`, pixel by pixel."""
        self.context.copy_framebuffer(screen, self.framebuffer)

    def release(self) -> None:
        for attachment in self.framebuffer.color_attachments:
            attachment.release()
        self.framebuffer.release()


def read_rgb(framebuffer: moderngl.Framebuffer, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Its lower left `size` pixels (width, height), upper row first. [H,W,3] uint8

    The size is asked for since a window's framebuffer does not know its own after a resize.
    """
    width, height = size
    packed = framebuffer.read((0, 0, width, height), components=3, alignment=1)
    return np.frombuffer(packed, np.uint8).reshape(height, width, 3)[::-1].copy()
