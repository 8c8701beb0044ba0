"""`compose_layers` while a slider is dragged: the same numbers, written in place, members only.

Bases are kept as they are stored (int8): a new slider value reads about 84 bytes a member, writes its
14 numbers, and allocates nothing that grows with the scene.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf, verify
from progdf.interpolation import find_segment
from progdf.rasterize.cpu.parallel import run_chunks, threads

from .arrays import GAINS
from .kernel import compose_rows
from .layers import KINDS, Effects, Layer, changed_edits, changed_gains, check_numbers, effects_of
from .plan import FlatWeights, RowPlan, flatten_edits, flatten_scene, plan_rows

WORTH_A_THREAD = 16_384
"""Rows below which a second thread costs more than it saves."""


@dataclass(frozen=True)
class Change:
    """What an update touched.

    Args:
        rows: sorted indices of all Gaussians that may differ from before. [M] int64
        attributes: names of `gaussians.ATTRIBUTES` that may differ in these rows
        largest_move: largest distance that a center has moved since the last update, world units
    """

    rows: NDArray[np.int64]
    attributes: tuple[str, ...]
    largest_move: float

    @property
    def means_moved(self) -> bool:
        """Whether the depth order may have changed."""
        return self.largest_move > 0


class Composer:
    """Keeps one scene under a changing stack of edits.

    Args:
        scene: the original, float32; it is never written to
        gdfs: every edit that may appear in the stack

    Raises:
        ProgdfError: an edit was made for another scene.
    """

    def __init__(self, scene: Gaussians, gdfs: Sequence[Gdf]) -> None:
        for gdf in gdfs:
            verify(gdf, scene)
        self._index = {id(gdf): i for i, gdf in enumerate(gdfs)}
        self._gdfs = tuple(gdfs)  # held, so that their ids stay theirs
        self._members = [gdf.region.members.numpy() for gdf in gdfs]
        self._edited_rows = np.unique(np.concatenate([np.zeros(0, np.int64), *self._members]))
        self._names = tuple(n for n in ATTRIBUTES if any(n in gdf.field.attributes for gdf in gdfs))
        self._moving = [frozenset(gdf.field.attributes) for gdf in gdfs]
        self._bases = flatten_edits(scene, gdfs, self._names)
        self._target = flatten_scene(scene, self._names, self._edited_rows)
        tensors: dict[str, Any] = {}
        for name, at in zip(self._names, self._target.columns["out"].tolist(), strict=True):
            shape = getattr(scene, name).shape
            tensors[name] = torch.from_numpy(self._target.out[at : at + shape.numel()]).view(shape)
        self.gaussians = replace(scene, **tensors)
        """The scene under the layers of the last update; its tensors are written in place by the next."""
        self._effects = Effects()
        self._plans: dict[frozenset[int], RowPlan] = {}
        self._choices: dict[tuple[int, ...], NDArray[np.int64]] = {}
        self._weights = FlatWeights()

    def update(self, layers: Sequence[Layer], blend: str = "normalized") -> Change:
        """Make `gaussians` the scene under `layers`: what `compose_layers(scene, layers, blend)` gives.

        Args:
            layers: the stack, lowest first; every gdf is one of those given at the start (the same object).
                Weights are compared as tensors are: a new one, or one written to in place by torch, is seen
            blend: one of `BLENDS`

        Returns:
            What may differ from before; no rows where nothing does.

        Raises:
            ProgdfError: a strength is not a number, the blend rule is unknown.
            ValueError: weights do not fit, or an edit is not one of the composer's.
        """
        check_numbers(layers, blend)
        stack = [(self._edit_of(layer.gdf), layer) for layer in layers if layer.active]
        self._weights.update([layer for _, layer in stack])
        before, self._effects = self._effects, effects_of(stack, blend)
        changed = changed_edits(before, self._effects)
        if not changed:
            return Change(np.zeros(0, np.int64), (), 0.0)
        plan = self._plan(changed)
        moving = {name for edit in plan.edits for name in self._moving[edit]}
        kinds = changed_gains(before, self._effects, changed)
        if kinds is not None:
            moving = {name for edit in changed for name in self._moving[edit] if KINDS[name] in kinds}
        chosen = tuple(i for i, name in enumerate(self._names) if name in moving)
        if not chosen:
            return Change(plan.rows, (), 0.0)
        concerned = [i for i, (edit, _) in enumerate(stack) if edit in plan.edits]
        moved = self._rewrite(
            plan, [stack[i] for i in concerned], [self._weights.begins[i] for i in concerned], chosen, blend
        )
        return Change(plan.rows, tuple(self._names[i] for i in chosen), math.sqrt(moved))

    def _rewrite(
        self,
        plan: RowPlan,
        stack: Sequence[tuple[int, Layer]],
        weights_at: Sequence[int],
        chosen: tuple[int, ...],
        blend: str,
    ) -> float:
        """Write these attributes of the plan's rows; the largest squared step of a center."""
        prepared = plan.stack(tuple(edit for edit, _ in stack))
        strengths = 0.0
        for i, (edit, layer) in enumerate(stack):
            right, share = find_segment(self._gdfs[edit].field.knots, layer.strength)
            entry: Any = prepared.layers[i]
            entry["weights"], entry["clamped_strength"] = weights_at[i], layer.clamped_strength
            entry["right"], entry["at_knot"], entry["share"] = right, share == 1.0, share
            prepared.gains[i] = [getattr(layer.gains, kind) for kind in GAINS]
            strengths += layer.clamped_strength
        # a little below 1: sums in float32 may round up to where the kernel has to look
        normalize = blend == "normalized" and strengths > 1 - 1e-6
        prepared = prepared._replace(weights=self._weights.flat, over=blend == "over", normalize=normalize)
        blocks, attributes = plan.blocks, self._index_array(chosen)
        target, lists, bases = self._target, plan.lists, self._bases

        def compose(first: int, last: int) -> float:
            return float(compose_rows(target, lists, prepared, bases, attributes, first, last))

        count = min(1 + len(plan.rows) // WORTH_A_THREAD, max(blocks, 1))
        count = min(count, threads()) if count > 1 else 1
        cuts = [blocks * part // count for part in range(count + 1)]
        return max(run_chunks(lambda chunk: compose(cuts[chunk], cuts[chunk + 1]), count))

    def _plan(self, changed: frozenset[int]) -> RowPlan:
        if changed not in self._plans:
            if len(self._plans) >= 32:  # a handful is in use while one drags
                self._plans.clear()
            self._plans[changed] = plan_rows(self._members, changed, self._edited_rows)
        return self._plans[changed]

    def _index_array(self, chosen: tuple[int, ...]) -> NDArray[np.int64]:
        """These numbers as an array, made once."""
        if chosen not in self._choices:
            self._choices[chosen] = np.array(chosen, np.int64)
        return self._choices[chosen]

    def _edit_of(self, gdf: Gdf) -> int:
        try:
            return self._index[id(gdf)]
        except KeyError:
            raise ValueError(
                f"{gdf.name} is not one of the composer's edits; give it to Composer first"
            ) from None
