"""Scenes the product makes itself, with exact labels and edits whose true course is known."""

from __future__ import annotations

from .assemble import DemoScene
from .bear import SKY, SMALLEST, bear, paint_panda
from .edits import (
    AnalyticEdit,
    bear_edits,
    bend_edit,
    darken_edit,
    deform_edit,
    recolor_edit,
    scale_edit,
    stretch_edit,
    stripes_edit,
    swing_edit,
)
from .room import SMALLEST_ROOM, room

__all__ = [
    "SKY",
    "SMALLEST",
    "SMALLEST_ROOM",
    "AnalyticEdit",
    "DemoScene",
    "bear",
    "bear_edits",
    "bend_edit",
    "darken_edit",
    "deform_edit",
    "paint_panda",
    "recolor_edit",
    "room",
    "scale_edit",
    "stretch_edit",
    "stripes_edit",
    "swing_edit",
]
