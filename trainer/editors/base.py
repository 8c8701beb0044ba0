"""The one thing an image editor must do."""

from __future__ import annotations

from typing import Literal, Protocol

from torch import Tensor

from trainer.views import View

EditKind = Literal["colour", "style", "geometry"]
"""What an edit moves, which chooses learning rates and loss weights (method.md 3)."""


class ImageEditor(Protocol):
    """Edits pictures of one region.

    An editor with a dial of its own pictures any strength, one that only knows the finished edit only 1.
    """

    @property
    def kind(self) -> EditKind:
        """What the edit moves."""
        ...

    @property
    def stages(self) -> tuple[float, ...]:
        """The strengths that it can picture, ascending, the last 1; empty: any."""
        ...

    def edit(self, view: View, strength: float) -> Tensor:
        """The edited view. Strength 0 gives `view.image` bit for bit. -> [H,W,3] 0..1"""
        ...
