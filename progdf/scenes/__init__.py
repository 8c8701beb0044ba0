"""Scenes the product makes itself, with exact labels and edits whose true course is known."""

from __future__ import annotations

from progdf.scenes.bear import SMALLEST, DemoScene, bear

__all__ = ["SMALLEST", "DemoScene", "bear"]
