"""`compose_layers` while a slider is dragged: the same numbers, written in place, members only.

Bases are kept as they are stored (int8): a new slider value reads about 84 bytes a member, writes its
14 numbers, and allocates nothing that grows with the scene.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf, verify
from progdf.rasterize.cpu.parallel import threads

from .effects import Effects, changed_edits, changed_gains, effects_of
from .kernel import compose_rows
from .layers import KINDS, Layer, check_numbers, check_weights
from .plan import RowPlan, find_segment, flatten_edits, flatten_scene, plan_rows

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
        self._edits = flatten_edits(scene, gdfs, self._names)
        self._base, self._out, self._columns = flatten_scene(scene, self._names, self._edited_rows)
        tensors: dict[str, Any] = {}
        for name, (_, _, at) in zip(self._names, self._columns[:, :3].tolist(), strict=True):
            shape = getattr(scene, name).shape
            tensors[name] = torch.from_numpy(self._out[at : at + shape.numel()]).view(shape)
        self.gaussians = replace(scene, **tensors)
        """The scene under the layers of the last update; its tensors are written in place by the next."""
        self._effects = Effects()
        self._plans: dict[frozenset[int], RowPlan] = {}
        self._choices: dict[tuple[int, ...], NDArray[np.int64]] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._weights: tuple[list[Tensor], list[int], NDArray[np.float32]] = ([], [], np.zeros(0, np.float32))

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
        weights_at = self._weight_offsets(stack)
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
            plan, [stack[i] for i in concerned], [weights_at[i] for i in concerned], chosen, blend
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
        edits = self._edits
        layers, numbers, bounds = plan.stack_edits(tuple(edit for edit, _ in stack))
        strengths = 0.0
        for i, (edit, layer) in enumerate(stack):
            node, on_node, share = find_segment(edits.nodes[edit], layer.strength)
            layers[i, 3:] = weights_at[i], node, on_node
            gains = layer.gains
            numbers[i] = share, layer.clamped_strength, gains.geometry, gains.opacity, gains.color
            strengths += layer.clamped_strength
        # a little below 1: sums in float32 may round up to where the kernel has to look
        normalize = blend == "normalized" and strengths > 1 - 1e-6
        blocks = plan.blocks
        arguments = (
            self._base, self._out, plan.rows.view(np.uint64), plan.base_index, self._columns,
            self._index_array(chosen), layers, numbers, bounds, plan.members, plan.row_index, edits.edits,
            edits.parts, edits.floats, edits.bytes_, edits.tables, self._weights[2], blend == "over",
            normalize,
        )  # fmt: skip
        count = min(1 + len(plan.rows) // WORTH_A_THREAD, max(blocks, 1))
        count = min(count, threads()) if count > 1 else 1
        if count == 1:
            return float(compose_rows(*arguments, 0, blocks))
        if self._pool is None:
            self._pool = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="compose")
        cuts = [blocks * part // count for part in range(count + 1)]
        others = [self._pool.submit(compose_rows, *arguments, *cuts[i : i + 2]) for i in range(1, count)]
        mine = float(compose_rows(*arguments, cuts[0], cuts[1]))
        return max([mine, *(float(other.result()) for other in others)])

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

    def _weight_offsets(self, stack: Sequence[tuple[int, Layer]]) -> list[int]:
        """Where each layer's weights begin among those of all, laid back to back; −1 for a layer without."""
        given = [layer.weights for _, layer in stack if layer.weights is not None]
        versions = [tensor._version for tensor in given]
        kept, kept_versions, _ = self._weights
        if versions != kept_versions or any(a is not b for a, b in zip(given, kept, strict=True)):
            for _, layer in stack:
                check_weights(layer)
            flat = np.concatenate([np.zeros(0, np.float32), *(w.detach().float().numpy() for w in given)])
            self._weights = (given, versions, flat)
        begins, length = [], 0
        for _, layer in stack:
            begins.append(-1 if layer.weights is None else length)
            length += 0 if layer.weights is None else len(layer.weights)
        return begins

    def _edit_of(self, gdf: Gdf) -> int:
        try:
            return self._index[id(gdf)]
        except KeyError:
            raise ValueError(
                f"{gdf.name} is not one of the composer's edits; give it to Composer first"
            ) from None
