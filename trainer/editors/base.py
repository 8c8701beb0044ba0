"""What an image editor must do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.views.view import Glance, View


@dataclass(frozen=True)
class EditorInput:
    """What an editor is made from."""

    what: str  # the text after the colon
    scene: Gaussians  # the original
    region: Region
    views: Sequence[View]
    options: EditorOptions
    # the region at a glance, the same whatever its views; where there are none its color is that of the views
    glances: Callable[[], Sequence[Glance]] = list


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
