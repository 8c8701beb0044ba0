"""The one thing a segmenter must do, and what it can be told."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from trainer.options import DETECTOR, OUTLINER


@dataclass(frozen=True)
class SegmenterSettings:
    """Which networks, and how sure they must be.

    Args:
        detector: id on the Hugging Face hub, downloaded before, or folder of a saved GroundingDINO
        outliner: the same of a SAM
        least: confidence of a find, 0..1
    """

    detector: str = DETECTOR
    outliner: str = OUTLINER
    least: float = 0.3


class Segmenter(Protocol):
    """Finds what a prompt names."""

    def __call__(self, image: Tensor, prompt: str) -> Tensor:
        """The mask of it, empty where there is none. [H,W,3] 0..1 -> [H,W] bool"""
        ...
