"""What an image editor must do, and the settings of learned ones."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

from torch import Tensor

from trainer.views.view import View

EditKind = Literal["color", "style", "geometry"]
"""What an edit moves, which chooses learning rates and loss weights (docs/method.md 3)."""


@dataclass(frozen=True)
class EditorSettings:
    """How a learned editor is asked; what is None or empty is as its model was made for.

    Args:
        model: id on the Hugging Face hub, or folder of a saved pipeline
        guidance: how closely the instruction is followed, ≥ 1
        image_guidance: how closely the picture is followed, ≥ 1; not every model has it
        steps: denoising steps
        seed: of the noise, the same in every view
        size: longer side in pixels at which pictures are painted
        graded: edit at several strengths by rising guidance, not the finished edit alone
        kept: folder in which painted pictures are kept; None keeps nothing
    """

    model: str = ""
    guidance: float | None = None
    image_guidance: float | None = None
    steps: int | None = None
    seed: int = 0
    size: int | None = None
    graded: bool = False
    kept: Path | None = None


class ImageEditor(Protocol):
    """Edits pictures of one region.

    An editor with a strength control edits at any strength, one that only knows the finished edit only at 1.
    """

    @property
    def kind(self) -> EditKind:
        """What the edit moves."""
        ...

    @property
    def stages(self) -> tuple[float, ...]:
        """The strengths that it can picture, ascending, the last 1; empty: any."""
        ...

    @property
    def confined(self) -> bool:
        """Whether it leaves alone what is not the region; else its pictures may change anywhere."""
        ...

    def edit(self, view: View, strength: float) -> Tensor:
        """The edited view. Strength 0 gives `view.image` bit for bit. -> [H,W,3] 0..1"""
        ...


@runtime_checkable
class RepaintingEditor(Protocol):
    """An editor that looks at a picture and paints another, and so can look at a render again."""

    def edit_again(self, view: View, strength: float, current: Tensor | None, step: int) -> Tensor:
        """The edited view, painted from the render of training step `step`. [H,W,3] -> [H,W,3] 0..1

        None for the render stands for the one that was painted from at that step; ProgdfError if that picture
        is no longer there.
        """
        ...
