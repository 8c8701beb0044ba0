"""What a segmenter must do."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Segmenter(Protocol):
    """Finds what a prompt names."""

    def __call__(self, image: Tensor, prompt: str) -> Tensor:
        """The mask of it, empty where there is none. [H,W,3] 0..1 -> [H,W] bool"""
        ...
