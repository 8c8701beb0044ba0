"""What a segmenter must do, and its settings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from trainer.options import DETECTOR, SAM_MODEL


@dataclass(frozen=True)
class SegmenterSettings:
    """Which networks, and how sure they must be.

    Args:
        detector: id on the Hugging Face hub, downloaded before, or folder of a saved GroundingDINO
        sam_model: the same of a SAM
        box_threshold: confidence of a find, 0..1
    """

    detector: str = DETECTOR
    sam_model: str = SAM_MODEL
    box_threshold: float = 0.3


class Segmenter(Protocol):
    """Finds what a prompt names."""

    def __call__(self, image: Tensor, prompt: str) -> Tensor:
        """The mask of it, empty where there is none. [H,W,3] 0..1 -> [H,W] bool"""
        ...
