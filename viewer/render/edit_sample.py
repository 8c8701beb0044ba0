"""What the edit pass wrote, read back and held against `progdf.compose`: a sample small enough for a frame.

The sample is one row of the scene's textures for each edit, that of its middle member.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.compose.layers import Layer
from progdf.compose.reference import compose_layers
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf, fingerprint
from progdf.region import Region
from viewer.gl.edit_pass import EditPass
from viewer.gl.layout import SPLATS_PER_ROW


class EditSample:
    """Some of the Gaussians that edits change, with the parts of the edits that change them.

    Args:
        scene: the original
        gdfs: all its edits
    """

    def __init__(self, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        members = [gdf.region.members.numpy() for gdf in gdfs]
        self._texture_rows = sorted(
            {int(own[len(own) // 2]) // SPLATS_PER_ROW for own in members if len(own)}
        )
        everyone = np.unique(np.concatenate([np.zeros(0, np.int64), *members]))
        self._rows = everyone[np.isin(everyone // SPLATS_PER_ROW, self._texture_rows)]
        self._scene = scene[torch.from_numpy(self._rows)]
        self._index_array = [torch.from_numpy(np.flatnonzero(np.isin(own, self._rows))) for own in members]
        pairs = zip(gdfs, self._index_array, strict=True)
        self._gdfs = [_select_members(gdf, chosen, self._rows, self._scene) for gdf, chosen in pairs]

    def error(self, edit_pass: EditPass, stack: Sequence[tuple[int, Layer]], blend: str) -> float:
        """The largest difference of a raw number from `compose_layers`, relative where that is larger than 1.

        Args:
            edit_pass: has run with `stack` and `blend`
            stack: layers with the indices of their edits, the lowest first
            blend: one of `progdf.compose.layers.BLENDS`
        """
        if not len(self._rows):
            return 0.0
        layers = [
            replace(layer, gdf=self._gdfs[edit], weights=_some(layer.weights, self._index_array[edit]))
            for edit, layer in stack
        ]
        expected = compose_layers(self._scene, layers, blend)
        places = {texture_row: at for at, texture_row in enumerate(self._texture_rows)}
        at = np.array([places[row] for row in (self._rows // SPLATS_PER_ROW).tolist()], np.int64)
        worst = 0.0
        for name, texels in edit_pass.read(self._texture_rows).items():
            found = texels[at * SPLATS_PER_ROW + self._rows % SPLATS_PER_ROW]
            wanted = getattr(expected, name).reshape(len(found), -1).numpy()[:, : found.shape[1]]
            worst = max(worst, difference(found, wanted))
        return worst


def difference(found: NDArray[np.float32], wanted: NDArray[np.float32]) -> float:
    """The largest difference, relative to `wanted` where that is larger than 1.

    The same infinity or a NaN in both is no difference; anything else that is not finite is an infinite one.
    """
    same = (found == wanted) | (np.isnan(found) & np.isnan(wanted))
    with np.errstate(invalid="ignore", over="ignore"):
        apart = np.abs(found.astype(np.float64) - wanted) / np.maximum(1.0, np.abs(wanted))
    apart = np.where(same, 0.0, np.nan_to_num(apart, nan=np.inf))
    return float(apart.max(initial=0.0))


def _select_members(gdf: Gdf, chosen: Tensor, rows: NDArray[np.int64], scene: Gaussians) -> Gdf:
    """The edit of the sample: only its `chosen` members, counted within `rows`."""
    attributes = {
        name: replace(
            bases, end_offset=bases.end_offset[chosen], residual_basis=bases.residual_basis[:, chosen]
        )
        for name, bases in gdf.field.attributes.items()
    }
    members = torch.from_numpy(np.searchsorted(rows, gdf.region.members[chosen].numpy()))
    region = Region(gdf.region.name, members, gdf.region.score[torch.from_numpy(rows)])
    field = replace(gdf.field, attributes=attributes, origin=None)
    return replace(gdf, region=region, field=field, scene=fingerprint(scene))


def _some(weights: Tensor | None, chosen: Tensor) -> Tensor | None:
    return None if weights is None else weights[chosen]
