"""What an image editor must do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from trainer.options import EditKind
from trainer.views.view import View


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
    def is_confined(self) -> bool:
        """Whether it leaves alone what is not the region; else its pictures may change anywhere."""
        ...

    def edit(self, view: View, strength: float) -> Tensor:
        """The edited view. Strength 0 gives `view.image` bit for bit. -> [H,W,3] 0..1"""
        ...


class Painter(Protocol):
    """Paints one picture as it was told, at any degree."""

    @property
    def references(self) -> int:
        """Pictures beside the view's own that one call can take."""
        ...

    def paint(
        self,
        picture: Tensor,
        references: Sequence[Tensor] = (),
        *,
        strength: float = 1.0,
        softness: float = 1.0,
        source: Tensor | None = None,
        seed: int | None = None,
    ) -> Tensor:
        """The picture as it was told.

        Args:
            picture: what is painted, and the condition of the painting. [H,W,3] 0..1
            references: further pictures to look at, at most as many as it can take. [h,w,3] each
            strength: 0 is `source`, 1 the finished edit
            softness: share of the painting over which the source is let go of; 1 all of it, small: first the
                source alone, then a free finish
            source: where strength 0 ends; None: `picture` itself. [H,W,3]
            seed: of the noise; None: the editor's own

        Returns:
            [H,W,3] 0..1
        """
        ...
