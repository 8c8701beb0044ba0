"""Reference search for strays without shortcuts: measures all neighborhoods again in each round."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.scene.strays import INVISIBLE

NEIGHBORS = 16
FEWEST = 64
SAMPLE = 20_000
KINDS = ("giants", "needles", "floaters")

Floats = NDArray[np.float64]
Rows = NDArray[np.int64]


def find_strays(scene: Gaussians) -> dict[str, list[int]]:
    """Return the rows of giants, needles and floaters; see `progdf.scene.strays.find_strays`."""
    remaining = np.flatnonzero((scene.opacities >= INVISIBLE).numpy())
    found: dict[str, list[int]] = {kind: [] for kind in KINDS}
    step = -(-len(remaining) // SAMPLE)
    sampled = remaining[::step]
    while len(remaining) >= FEWEST:
        kinds = find_once(scene[torch.from_numpy(remaining)], np.isin(remaining, sampled))
        for kind, rows in kinds.items():
            found[kind] += remaining[rows].tolist()
        strays = np.concatenate([*kinds.values()])
        if not len(strays):
            break
        remaining = np.delete(remaining, strays)
    return {kind: sorted(rows) for kind, rows in found.items()}


def find_once(scene: Gaussians, sampled: NDArray[np.bool_]) -> dict[str, Rows]:
    """Return the strays of one round. A suspect does not support other rows."""
    points = scene.means.double().numpy()
    order = scene.log_scales.argsort(dim=1)
    sizes = scene.log_scales.gather(1, order).double()
    axes = rotation_matrices(scene.unit_quats.double())
    longer = axes.gather(2, order[:, None, 1:].expand(-1, 3, -1)).transpose(1, 2)
    tips = (2.0 * sizes[:, 1:, None].exp() * longer).numpy()
    longest = sizes[:, 2].numpy()
    thinness = (sizes[:, 2] - sizes[:, 1]).numpy()
    giant = longest > fence(longest)
    suspect = giant | ((thinness > fence(thinness)) & (longest > np.median(longest)))
    body = np.flatnonzero(~suspect)
    suspects = np.flatnonzero(suspect)
    k = min(NEIGHBORS, len(body) - 1)
    tree = cKDTree(points[body])
    distances, near = tree.query(points[body], k + 1)
    distances = np.maximum(distances[:, 1:], 1e-30)
    near = near[:, 1:]
    spacing = distances[:, -1]
    extents = 2.0 * np.exp(longest[body])
    reach = np.maximum(spacing, extents)

    def emptiness(rows: Rows) -> Floats:
        center = points[rows, None]
        ends = np.concatenate([center + tips[rows], center - tips[rows]], axis=1)
        away, nearest = tree.query(ends)
        empty: Floats = np.log(np.maximum(away, 1e-30) / reach[nearest]).max(axis=1)
        return empty

    usual = emptiness(body[sampled[body]])
    outside = suspects[emptiness(suspects) > max(fence(usual), np.log(2.0))]
    lonely = np.log(spacing / np.median(spacing[near], axis=1))
    touches = distances <= extents[:, None] + extents[near]
    floaters = (lonely > max(fence(lonely), np.log(2.0))) & ~touches[:, k // 2 :].any(axis=1)
    return {
        "giants": outside[giant[outside]],
        "needles": outside[~giant[outside]],
        "floaters": body[floaters],
    }


def fence(values: Floats) -> float:
    """Return Tukey's upper fence."""
    low, high = np.quantile(values, (0.25, 0.75))
    return float(high + 1.5 * (high - low))
