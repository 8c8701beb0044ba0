"""Interface of image editors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.region import Region
from trainer.options import EditKind, EditorOptions
from trainer.views.view import RegionThumbnail, View


@dataclass(frozen=True)
class EditorInput:
    """Arguments from which an editor is made."""

    what: str  # the text after the colon
    scene: Gaussians  # the original
    region: Region
    views: Sequence[View]
    options: EditorOptions
    # Small samples of the region, independent of the views. If there are none, the region's color is computed
    # from the views.
    glances: Callable[[], Sequence[RegionThumbnail]] = list


class ImageEditor(Protocol):
    """Editor of pictures of one region.

    An editor with a strength control edits at any strength. An editor without one edits only at strength 1.
    """

    @property
    def kind(self) -> EditKind:
        """Kind of change: color, style or geometry."""
        ...

    @property
    def stages(self) -> tuple[float, ...]:
        """Strengths at which the editor can edit, ascending, the last one 1. Empty: any strength."""
        ...

    @property
    def is_confined(self) -> bool:
        """True if the edit leaves pixels outside the region unchanged."""
        ...

    def edit(self, view: View, strength: float) -> Tensor:
        """Return the edited view. Strength 0 returns `view.image` bit for bit. -> [H,W,3] 0..1"""
        ...
