"""Two ways to bring the attributes under a stack of layers to where they are drawn from, one interface.

`CpuEditing` composes on the CPU and sends the changed rows: for any renderer, exact, the reference.
`GpuEditing` leaves the work to the edit pass (gl/edit_pass.py); the CPU composes the means alone, which the
depth order needs.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from progdf.compose.composer import Composer
from progdf.compose.layers import Effects, Layer, changed_edits, effects_of
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf

from .edit_sample import EditSample
from .renderers import GlRenderer, Renderer

Stack = Sequence[tuple[int, Layer]]
"""Layers with the indices of their edits, the lowest first."""


@dataclass(frozen=True)
class UpdateCost:
    """What it took to bring the attributes from one stack to the next.

    Args:
        compose_ms: on the CPU: of all attributes, or of the means alone
        upload_ms: sending them, or the edit pass, waited for
        changed: Gaussians that may differ from before
        moved: whether the depth order may have changed
    """

    compose_ms: float
    upload_ms: float
    changed: int
    moved: bool


class Editing(Protocol):
    """Keeps what is drawn under a changing stack."""

    where: str
    """What does it: "cpu" or "gpu"."""

    @property
    def means(self) -> NDArray[np.float32]:
        """Centers under the last stack. [N,3]"""

    def update(self, stack: Stack, blend: str) -> UpdateCost:
        """Make what is drawn the scene under `stack`.

        Raises:
            ProgdfError: a strength is not a number, the blend rule is unknown; nothing has changed then.
        """

    def gaussians(self, stack: Stack, blend: str) -> Gaussians:
        """The scene under `stack`, by the CPU; written in place by the next call or `update`."""

    def error(self, stack: Stack, blend: str) -> float:
        """How far what is drawn is from `progdf.compose`: see `EditSample.error`.

        Args:
            stack, blend: those of the last `update`
        """

    def release(self) -> None:
        """Give back what lives in a context, but for the renderer's."""


class CpuEditing:
    """`progdf.compose.composer`, whose bits are those of `progdf.compose`."""

    where = "cpu"

    def __init__(self, renderer: Renderer, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        self._renderer = renderer
        self._composer = Composer(scene, gdfs)
        renderer.upload(self._composer.gaussians)

    @property
    def means(self) -> NDArray[np.float32]:
        means: NDArray[np.float32] = self._composer.gaussians.means.numpy()
        return means

    def update(self, stack: Stack, blend: str) -> UpdateCost:
        started = time.perf_counter()
        change = self._composer.update([layer for _, layer in stack], blend)
        composed = time.perf_counter()
        self._renderer.update(self._composer.gaussians, change.attributes, change.rows)
        uploaded = time.perf_counter()
        return UpdateCost(
            1e3 * (composed - started), 1e3 * (uploaded - composed), len(change.rows), change.means_moved
        )

    def gaussians(self, stack: Stack, blend: str) -> Gaussians:
        return self._composer.gaussians

    def error(self, stack: Stack, blend: str) -> float:
        return 0.0

    def release(self) -> None:
        pass


class GpuEditing:
    """The edit pass.

    Raises:
        ProgdfError: an edit was made for another scene.
        EditPassError: the pass cannot run here.
    """

    where = "gpu"

    def __init__(self, renderer: GlRenderer, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        self._renderer, self._scene, self._gdfs = renderer, scene, tuple(gdfs)
        self._movers = tuple(_means_alone(gdf) for gdf in gdfs)
        self._means = Composer(scene, self._movers)
        renderer.upload(scene)
        self._pass = renderer.edit_pass(scene, gdfs)
        self._effects = Effects()
        self._composer: Composer | None = None  # made when somebody asks for the Gaussians
        self._sample: EditSample | None = None  # made when somebody asks for the error

    @property
    def means(self) -> NDArray[np.float32]:
        means: NDArray[np.float32] = self._means.gaussians.means.numpy()
        return means

    def update(self, stack: Stack, blend: str) -> UpdateCost:
        started = time.perf_counter()
        active = [(edit, layer) for edit, layer in stack if layer.active]
        moved = self._means.update([replace(layer, gdf=self._movers[edit]) for edit, layer in stack], blend)
        effects = effects_of(active, blend)
        changed = changed_edits(self._effects, effects)
        composed = time.perf_counter()
        rows = self._pass.run(active, blend, changed) if changed else ()
        self._renderer.finish()
        self._effects = effects
        done = time.perf_counter()
        return UpdateCost(1e3 * (composed - started), 1e3 * (done - composed), len(rows), moved.means_moved)

    def gaussians(self, stack: Stack, blend: str) -> Gaussians:
        self._composer = self._composer or Composer(self._scene, self._gdfs)
        self._composer.update([layer for _, layer in stack], blend)
        return self._composer.gaussians

    def error(self, stack: Stack, blend: str) -> float:
        self._sample = self._sample or EditSample(self._scene, self._gdfs)
        return self._sample.error(self._pass, stack, blend)

    def release(self) -> None:
        self._pass.release()


def _means_alone(gdf: Gdf) -> Gdf:
    """The edit without what the depth order does not need; it covers other edits as before."""
    attributes = {name: bases for name, bases in gdf.field.attributes.items() if name == "means"}
    return replace(gdf, field=replace(gdf.field, attributes=attributes))
