"""Pictures along a path of colors that is linear between knots, in views in which nothing else changes.

A member's color in a view is then linear between its colors at the knots, except for the limit at black. So
the SH coefficients are evaluated at the knots alone, and between them three numbers per member and view are
interpolated. `trainer.views.crops.render_all` of the offsets is the plain form.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from progdf.field.baked import find_segment
from progdf.field.choose import Field
from progdf.field.grade import member_bands
from progdf.gaussians import attribute_slices
from progdf.threads import map_threads
from trainer.optimize.color_kernels import shade_views
from trainer.views.crops import GEOMETRY, CropScene

_VIEW_BATCH = 8  # views whose colors are computed at once, see `shade_views`


class StillPath:
    """Pictures of still views along a path of the members' colors.

    The colors at two knots are in memory, 12 bytes per member and view each. Ascending strengths therefore
    evaluate every knot once.

    Args:
        crops: still views on the CPU
        original: raw member rows, packed. [M,14] or [M,14+3K]
        knots: strengths, ascending from 0 to 1. [S]
        node: offsets at a knot, by its index. [M,C]
    """

    def __init__(
        self, crops: Sequence[CropScene], original: Tensor, knots: Tensor, node: Callable[[int], Tensor]
    ) -> None:
        columns = attribute_slices(original.shape[1])["means"]
        self._means = original[:, columns].float().contiguous().numpy()
        self._centers = torch.stack([crop.camera.position for crop in crops]).float().numpy()
        self._crops = crops
        self._knots = knots
        self._node = node
        sh = member_bands(original)
        if sh.shape[1] == 1:  # rows without the higher bands, which the views know
            sh = torch.cat([sh, crops[0].higher_bands], dim=1)[:, :16].contiguous()
        self._original = self._shade(sh, 0.5)
        self._colors: dict[int, Tensor] = {}  # colors at the last two knots, by index. [V,M,3]

    def pictures(self, s: float) -> list[Tensor]:
        """Render every view at a strength from 0 to 1. -> [h,w,3] each"""
        right, share = find_segment(self._knots, s)
        self._colors = {index: self._colors_at(index) for index in (right - 1, right)}
        before = self._colors[right - 1]
        after = self._colors[right]

        def draw(view: int) -> Tensor:
            colors = torch.lerp(before[view], after[view], share).clamp_min_(0.0)
            return self._crops[view].draw_colors(colors).detach()

        with torch.no_grad():
            return map_threads(draw, range(len(self._crops)))

    def _colors_at(self, index: int) -> Tensor:
        """Return the members' colors at a knot, without the limit at black. [V,M,3]"""
        if index in self._colors:
            return self._colors[index]
        return self._shade(member_bands(self._node(index)), 0.0).add_(self._original)

    def _shade(self, sh: Tensor, bias: float) -> Tensor:
        """Return the colors of coefficients in every view. [M,B,3] -> [V,M,3]"""
        batches = range(0, len(self._centers), _VIEW_BATCH)
        colors = [
            shade_views(self._means, self._centers[i : i + _VIEW_BATCH], sh.numpy(), bias, -math.inf)
            for i in batches
        ]
        return torch.from_numpy(np.concatenate(colors))


@runtime_checkable
class KnottedField(Field, Protocol):
    """Field whose path is straight between knots, or nearly so."""

    @property
    def knots(self) -> Tensor:
        """Strengths of the knots, ascending from 0 to 1. [S]"""
        ...


def still_path(
    crops: Sequence[CropScene], original: Tensor, field: Field
) -> Callable[[float], list[Tensor]] | None:
    """Return the pictures of a field by `StillPath`; None if it changes more than colors or has no knots.

    Args:
        crops: views
        original: raw member rows, packed. [M,C]
        field: any field
    """
    if not isinstance(field, KnottedField) or not field.attributes or set(field.attributes) & set(GEOMETRY):
        return None
    if not all(crop.still and crop.original.is_cpu for crop in crops):
        return None
    knots = field.knots
    return StillPath(crops, original, knots, lambda index: field.offsets(float(knots[index]))).pictures
