"""Procedural demo scenes with exact labels."""

from __future__ import annotations

from .assemble import DemoScene
from .bear import MIN_BEAR_GAUSSIANS, SKY, bear, paint_panda
from .room import MIN_ROOM_GAUSSIANS, room

__all__ = ["MIN_BEAR_GAUSSIANS", "MIN_ROOM_GAUSSIANS", "SKY", "DemoScene", "bear", "paint_panda", "room"]
