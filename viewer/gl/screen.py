"""Pixels back from a framebuffer."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray


def read_rgb(framebuffer: moderngl.Framebuffer, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Its lower left `size` pixels (width, height), upper row first. [H,W,3] uint8

    The size is asked for since a window's framebuffer does not know its own after a resize.
    """
    width, height = size
    packed = framebuffer.read((0, 0, width, height), components=3, alignment=1)
    return np.frombuffer(packed, np.uint8).reshape(height, width, 3)[::-1].copy()
