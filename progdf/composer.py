"""`compose` while a slider is dragged: the same numbers, written in place, members only.

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
from numpy.typing import NDArray
from torch import Tensor

from progdf.checkpoint import Gdf, verify
from progdf.compose_effects import Effects, changed_edits, changed_gains, effects_of
from progdf.compose_kernel import BLOCK, LAYER, blend_rows
from progdf.compose_plan import Plan, factors, flat_bases, plan_rows
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.layers import KINDS, Layer, check_layers
from progdf.rasterize.threads import threads

WORTH_A_THREAD = 16_384
"""Rows below which a second thread costs more than it saves."""


@dataclass(frozen=True)
class Change:
    """What an update touched.

    Args:
        rows: sorted indices of all Gaussians that may differ from before. [M] int64
        attributes: names of `gaussians.ATTRIBUTES` that may differ in these rows
        largest_move: largest distance that a centre has moved since the last update, world units
    """

    rows: NDArray[np.int64]
    attributes: tuple[str, ...]
    largest_move: float

    @property
    def means_moved(self) -> bool:
        """Whether the depth order may have changed."""
        return self.largest_move > 0

    @property
    def covariance_moved(self) -> bool:
        """Whether scales or rotations may have changed."""
        return "log_scales" in self.attributes or "quats" in self.attributes


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
        self._gdfs = tuple(gdfs)
        self._members = [gdf.region.members.numpy() for gdf in gdfs]
        moving = {name for gdf in gdfs for name in gdf.field.attributes}
        copies = {name: getattr(scene, name).detach().float().contiguous().clone() for name in sorted(moving)}
        self.gaussians = replace(scene, **copies)
        """The scene under the layers of the last update; its tensors are written in place by the next."""
        self._base = {name: _rows_of(getattr(scene, name).detach().float().contiguous()) for name in copies}
        self._out = {name: _rows_of(tensor) for name, tensor in copies.items()}
        self._floats, self._bytes, self._bases = flat_bases(gdfs)
        self._nodes = [gdf.field.nodes.double().numpy() for gdf in gdfs]
        self._effects = Effects()
        self._plans: dict[frozenset[int], Plan] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._weights: tuple[list[Tensor], list[int], NDArray[np.float32]] = ([], [], np.zeros(0, np.float32))

    def update(self, layers: Sequence[Layer], blend: str = "normalised") -> Change:
        """Make `gaussians` the scene under `layers`: what `compose(scene, layers, blend)` gives.

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
        check_layers(layers, blend)
        stack = [(self._index(layer.gdf), layer) for layer in layers if layer.active]
        before, self._effects = self._effects, effects_of(stack, blend)
        changed = changed_edits(before, self._effects)
        if not changed:
            return Change(np.zeros(0, np.int64), (), 0.0)
        plan = self._plan(changed)
        attributes = {name for edit in plan.edits for name in self._bases[edit]}
        kinds = changed_gains(before, self._effects, changed)
        if kinds is not None:
            attributes = {name for edit in changed for name in self._bases[edit] if KINDS[name] in kinds}
        stack = [(edit, layer) for edit, layer in stack if edit in plan.edits]
        names = tuple(name for name in ATTRIBUTES if name in attributes)
        moves = [self._rewrite(name, plan, stack, blend) for name in names]
        return Change(plan.rows, names, math.sqrt(max(moves, default=0.0)))

    def _rewrite(self, name: str, plan: Plan, stack: Sequence[tuple[int, Layer]], blend: str) -> float:
        """Write one attribute of the plan's rows; the largest squared step of a centre."""
        described = np.zeros(len(stack), LAYER)
        scales: list[NDArray[np.float32]] = [np.zeros(0, np.float32)]
        weights, weights_at = self._flat_weights(stack)
        lines = 0
        for i, (edit, layer) in enumerate(stack):
            bases = self._bases[edit].get(name)
            gain = layer.gain(name)
            entry: Any = described[i]
            entry["places"], entry["dense"] = plan.begin[edit], edit in plan.dense
            entry["members"], entry["weights"] = len(self._members[edit]), weights_at[i]
            entry["gain"], entry["cover"] = gain, layer.cover
            if bases is None or gain == 0:
                continue
            entry["moves"], entry["rank"], entry["rest_is_float"] = 1, len(bases.step), bases.rest_is_float
            entry["full"], entry["rest"], entry["factors"] = bases.full, bases.rest, lines
            scales.append(factors(self._nodes[edit], bases.table, bases.step, layer.strength).reshape(-1))
            lines += 1 + len(bases.step)
        # a little below 1: sums in float32 may round up to where the kernel has to look
        crowded = blend == "normalised" and sum(layer.cover for _, layer in stack) > 1 - 1e-6
        base = self._base[name]
        blocks = -(-len(plan.rows) // BLOCK)
        bounds = np.array([plan.bounds[edit] for edit, _ in stack], np.int64).reshape(len(stack), blocks + 1)
        arguments = (
            base.reshape(-1), self._out[name].reshape(-1), base.shape[1], plan.rows, described, bounds,
            plan.members, plan.places, self._floats, self._bytes, np.concatenate(scales), weights,
            blend == "over", crowded, name == "means",
        )  # fmt: skip
        count = min(threads(), 1 + len(plan.rows) // WORTH_A_THREAD, max(blocks, 1))
        if count == 1:
            return float(blend_rows(*arguments, 0, blocks))
        if self._pool is None:
            self._pool = ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="compose")
        cuts = [blocks * part // count for part in range(count + 1)]
        others = [self._pool.submit(blend_rows, *arguments, *cuts[i : i + 2]) for i in range(1, count)]
        mine = float(blend_rows(*arguments, cuts[0], cuts[1]))
        return max([mine, *(float(other.result()) for other in others)])

    def _plan(self, changed: frozenset[int]) -> Plan:
        if changed not in self._plans:
            if len(self._plans) >= 32:  # a handful is in use while one drags
                self._plans.clear()
            self._plans[changed] = plan_rows(self._members, changed)
        return self._plans[changed]

    def _flat_weights(self, stack: Sequence[tuple[int, Layer]]) -> tuple[NDArray[np.float32], list[int]]:
        """The layers' weights back to back, and where each begins; −1 for a layer without."""
        given = [layer.weights for _, layer in stack if layer.weights is not None]
        versions = [tensor._version for tensor in given]
        kept, kept_versions, flat = self._weights
        if versions != kept_versions or any(a is not b for a, b in zip(given, kept, strict=True)):
            flat = np.concatenate([np.zeros(0, np.float32), *(w.detach().float().numpy() for w in given)])
            self._weights = (given, versions, flat)
        begins, length = [], 0
        for _, layer in stack:
            begins.append(-1 if layer.weights is None else length)
            length += 0 if layer.weights is None else len(layer.weights)
        return flat, begins

    def _index(self, gdf: Gdf) -> int:
        for i, own in enumerate(self._gdfs):
            if own is gdf:
                return i
        raise ValueError(f"{gdf.name} is not one of the composer's edits; give it to Composer first")


def _rows_of(tensor: Tensor) -> NDArray[np.float32]:
    """The tensor's memory as one row a Gaussian. [N,…] -> [N,c]"""
    return tensor.numpy().reshape(len(tensor), math.prod(tensor.shape[1:]))
