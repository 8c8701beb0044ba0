"""What an image editor must do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import Crop
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.views.view import View


@dataclass(frozen=True)
class EditorInput:
    """What an editor is made from."""

    what: str  # the text after the colon
    scene: Gaussians  # the original
    region: Region
    views: Sequence[View]
    options: EditorOptions


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
    """Paints one picture as it was told, at any degree; of a view, the part around the region."""

    @property
    def references(self) -> int:
        """How many pictures beside the view's own one call can take."""
        ...

    def frame(self, view: View) -> tuple[Crop, Camera]:
        """The box of a view that is painted, in its pixels, and the camera that pictures it at the size that
        the model works at."""
        ...

    def original(self, view: View) -> Tensor:
        """The picture of that frame. [h,w,3]"""
        ...

    def paste(self, view: View, painted: Tensor) -> Tensor:
        """The view with what was changed in its frame. [h,w,3] -> [H,W,3]"""
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
