"""A picture without its background: the same one on black and on white tells how much shines through."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from progdf.camera import Camera
from viewer.render.engine import ViewEngine
from viewer.render.renderers import Image
from viewer.state.view_state import ViewState


def transparent_image(engine: ViewEngine, view: ViewState, camera: Camera) -> NDArray[np.uint8]:
    """The view with its coverage as alpha, colors not multiplied by it. [H,W,4]"""
    black = engine.image(replace(view, background=(0.0, 0.0, 0.0)), camera=camera).copy()
    white = engine.image(replace(view, background=(1.0, 1.0, 1.0)), camera=camera)
    return unmix(black, white)


def unmix(black: Image, white: Image) -> NDArray[np.uint8]:
    """Color and alpha of what gives these two pictures on black and on white. [H,W,3] twice -> [H,W,4]"""
    alpha = np.clip(1.0 - (white - black).mean(axis=-1, keepdims=True), 0.0, 1.0)
    color = np.clip(black / np.maximum(alpha, 1e-6), 0.0, 1.0)
    rgba: NDArray[np.uint8] = np.round(255.0 * np.concatenate([color, alpha], axis=-1)).astype(np.uint8)
    return rgba
