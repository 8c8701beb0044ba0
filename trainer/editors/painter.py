"""Base of editors that paint a larger picture of the region than the view has.

The region's box with a margin is the frame of a view. It is rendered again at the size that the model was
trained for. The painted frame is cached at that size and shrunk into the view.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize import Crop
from trainer.options import EditKind
from trainer.store.run_folder import from_bytes, to_bytes
from trainer.views.view import BACKGROUND, View, region_box, render_view, shrink_image

from .cache import PictureCache, Recipe

_BOX_MARGIN = 0.4  # share of the box's width and height that is added, half on each side


class RefusedError(Exception):
    """A picture that a model refuses to paint."""


@dataclass(frozen=True, eq=False)
class PaintRequest:
    """One picture to paint. A painter ignores the fields that its model has no use for."""

    picture: Tensor  # condition of the model, 0 to 1. [H,W,3]
    references: Sequence[Tensor] = ()  # further pictures, at most `FramePainter.references`. [H,W,3] each
    mask: Tensor | None = None  # the region, 1 inside. [H,W]
    strength: float = 1.0  # 0 returns `source`, 1 the model's output
    # share of the steps over which the weight of the model's prediction rises from 0 to 1
    softness: float = 1.0
    source: Tensor | None = None  # result at strength 0, as large as `picture`; None: `picture`. [H,W,3]
    seed: int | None = None  # seed of the noise; None: the editor's
    prompt: str = ""  # instruction instead of the editor's; "": the editor's


class FramePainter(ABC):
    """Editor that paints the frame of each view."""

    scene: Gaussians
    kept: PictureCache  # cache of the painted frames, at their own size
    stages: tuple[float, ...]
    kind: EditKind
    is_confined: bool
    has_start: bool  # True if `paint` heeds `softness` and `source`
    has_strength: bool  # True if `paint` heeds `strength`
    _renders: dict[str, Tensor]  # view's name → render of its frame

    @property
    @abstractmethod
    def size(self) -> int:
        """Longer side of a reference picture that the user gives, pixels."""

    @property
    @abstractmethod
    def references(self) -> int:
        """Number of reference pictures that one call accepts beside the view."""

    @property
    def degrees(self) -> tuple[str, ...]:
        """Instructions for weaker edits, in any order."""
        return ()

    @property
    def workers(self) -> int:
        """Number of pictures that are painted at the same time."""
        return 1

    @property
    @abstractmethod
    def recipe(self) -> Recipe:
        """All inputs of a picture except its source and strength."""

    @property
    @abstractmethod
    def note(self) -> str:
        """Description of the model and its cost, for the log."""

    @abstractmethod
    def paint_size(self, width: float, height: float) -> tuple[int, int]:
        """Return the width and height in pixels at which to paint a frame of these proportions."""

    @abstractmethod
    def paint(self, request: PaintRequest) -> Tensor:
        """Paint a picture at the model's size, in 8 bits. -> [H,W,3] 0..1

        Raises:
            RefusedError: the model refuses the picture.
        """

    def frame(self, view: View) -> tuple[Crop, Camera]:
        """Return the painted box of a view, in pixels, and the camera that renders it for the model."""
        x0, y0, x1, y1 = region_box(view.mask, margin=0)
        margin_x = round(_BOX_MARGIN / 2 * (x1 - x0))
        margin_y = round(_BOX_MARGIN / 2 * (y1 - y0))
        camera = view.camera
        x0 = max(0, x0 - margin_x)
        x1 = min(camera.width, x1 + margin_x)
        y0 = max(0, y0 - margin_y)
        y1 = min(camera.height, y1 + margin_y)
        width, height = self.paint_size(x1 - x0, y1 - y0)
        shift = torch.tensor([[0.0, 0.0, x0], [0.0, 0.0, y0], [0.0, 0.0, 0.0]])
        box = replace(camera, K=camera.K - shift, width=x1 - x0, height=y1 - y0)
        return (x0, y0, x1, y1), box.resize(width, height)

    def original(self, view: View) -> Tensor:
        """Return the render of the frame, in 8 bits. [h,w,3]"""
        name = view.camera.name
        if name not in self._renders:
            image = render_view(self.scene, self.frame(view)[1], torch.tensor(BACKGROUND))
            self._renders[name] = to_bytes(image)
        return from_bytes(self._renders[name])

    def paste(self, view: View, painted: Tensor) -> Tensor:
        """Add the change of the frame, shrunk by area averaging, to the view. [h,w,3] -> [H,W,3]

        The change is added because a shrunk large render has a PSNR of only about 32 dB to the small training
        render.
        """
        x0, y0, x1, y1 = self.frame(view)[0]
        edited = view.image.clone()
        edited[y0:y1, x0:x1] += shrink_image(painted - self.original(view), (y1 - y0, x1 - x0))
        return edited.clamp(0.0, 1.0)
