"""Where the time of a picture went."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FrameTimings:
    """Where the time of one picture went: wall clock, milliseconds, the GPU's work waited for.

    Args:
        compose_ms: strengths → attributes, by the CPU
        upload_ms: attributes → where they are drawn from
        sort_ms: depth order (the CPU rasterizer sorts within `draw_ms`)
        draw_ms: the picture
        changed: Gaussians whose attributes were composed anew
        drawn: Gaussians in front of the camera; all of them where the CPU rasterizer draws
    """

    compose_ms: float = 0.0
    upload_ms: float = 0.0
    sort_ms: float = 0.0
    draw_ms: float = 0.0
    changed: int = 0
    drawn: int = 0

    @property
    def total_ms(self) -> float:
        return self.compose_ms + self.upload_ms + self.sort_ms + self.draw_ms
