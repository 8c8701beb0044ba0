"""Where the time of a picture went, and what worked out its attributes."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FrameTimings:
    """Where the time of one picture went: wall clock, milliseconds, the GPU's work waited for.

    Args:
        compose_ms: strengths → attributes, by the CPU
        upload_ms: attributes → where they are drawn from; or the GPU's edit pass, which does both there
        sort_ms: depth order (the CPU rasterizer sorts within `draw_ms`)
        draw_ms: the picture
        changed: Gaussians whose attributes were composed anew
        drawn: Gaussians in front of the camera; all of them where the CPU rasterizer draws
        share: of the picture's pixels that were drawn anew, 0..1
    """

    compose_ms: float = 0.0
    upload_ms: float = 0.0
    sort_ms: float = 0.0
    draw_ms: float = 0.0
    changed: int = 0
    drawn: int = 0
    share: float = 0.0

    @property
    def total_ms(self) -> float:
        return self.compose_ms + self.upload_ms + self.sort_ms + self.draw_ms


@dataclass(frozen=True)
class EditsBy:
    """What worked out the attributes on screen, and how well.

    Args:
        where: "gpu" (the edit pass) or "cpu"
        error: how far the attributes are from `progdf.compose`, in a sample that was read back: the largest
            difference of a raw number, relative to it where it is larger than 1
        obstacle: why the CPU does it though the GPU was wanted
    """

    where: str
    error: float = 0.0
    obstacle: str = ""

    @property
    def description(self) -> str:
        """In words that fit after "edited by"."""
        return f"CPU: {self.obstacle}" if self.where == "cpu" else f"GPU ±{self.error:.1g}"
