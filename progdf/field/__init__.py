"""The Gaussian differential field: (member, slider value) → offset of every raw parameter."""

from __future__ import annotations

from progdf.field.baked import AttributeBases, BakedField

__all__ = ["AttributeBases", "BakedField"]
