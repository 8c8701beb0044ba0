"""Procedural demo scenes with exact labels."""

from __future__ import annotations

from .assemble import DemoScene
from .bear import SKY, SMALLEST, bear, paint_panda
from .room import SMALLEST_ROOM, room

__all__ = ["SKY", "SMALLEST", "SMALLEST_ROOM", "DemoScene", "bear", "paint_panda", "room"]
