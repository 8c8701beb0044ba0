"""What an image editor must do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

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


@runtime_checkable
class RepaintingEditor(Protocol):
    """An editor that looks at a picture and paints another, and so can look at a render again."""

    def edit_again(self, view: View, strength: float, current: Tensor | None, step: int) -> Tensor:
        """The edited view, painted from the render of training step `step`. [H,W,3] -> [H,W,3] 0..1

        None for the render stands for the one that was painted from at that step; ProgdfError if that picture
        is no longer there.
        """
        ...


class Painter(Protocol):
    """Paints one picture as it was told, at any degree."""

    @property
    def references(self) -> int:
        """How many pictures beside the view's own one call can take."""
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
        """The picture painted anew, at the size that the model works at. -> [H,W,3] 0..1

        Args:
            picture: what is painted over, the condition. [H,W,3] 0..1
            references: further pictures that the model looks at, at most `references`. [H,W,3] each
            strength: 0 gives `source`, 1 what the model makes of its condition
            softness: over which share of the steps the model's say grows from none to all of it
            source: where strength 0 ends; None: `picture`. As large as it. [H,W,3]
            seed: of the noise; None: the editor's
        """
        ...
