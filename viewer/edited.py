"""The scene under its edits, and what changed since the last time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from progdf.checkpoint import Gdf
from progdf.compose import Layer, compose
from progdf.gaussians import ATTRIBUTES, Gaussians


@dataclass(frozen=True)
class Change:
    """What a new set of strengths touched.

    Args:
        attributes: names of `ATTRIBUTES`
        rows: sorted indices. [M] int64
    """

    attributes: tuple[str, ...]
    rows: NDArray[np.int64]


class EditedScene:
    """Composes one scene again and again.

    Args:
        scene: the original
        gdfs: all edits that may come
    """

    def __init__(self, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        self.scene = scene
        self.gaussians = scene
        self._layers: Sequence[Layer] = ()

    def compose(self, layers: Sequence[Layer], blend: str) -> Change:
        """Make `gaussians` the scene under `layers`; see `progdf.compose.compose`."""
        before = self.gaussians
        self.gaussians = compose(self.scene, layers, blend)
        moved = tuple(
            name for name in ATTRIBUTES if getattr(before, name) is not getattr(self.gaussians, name)
        )
        members = [layer.gdf.region.members.numpy() for layer in (*self._layers, *layers)]
        self._layers = tuple(layers)
        return Change(moved, np.unique(np.concatenate(members)))
