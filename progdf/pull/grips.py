"""Points around the handle of a soft pull that move with it, so that it has a round top and no spike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from progdf.gaussians import Gaussians
from progdf.region import Region

from .course import Handle
from .cuts import NO_CUTS, Cuts
from .graph import Floats, Rows, build_graph

MAX_GRIP_POINTS = 12
"""Largest number of points that move with a handle of a soft pull."""
_GRIP_SHARE = 0.35  # radius around a handle that moves with it, as a share of its radius of influence


def with_grips(
    scene: Gaussians, handles: Sequence[Handle], hold: Region | None = None, cuts: Cuts = NO_CUTS
) -> tuple[list[Handle], Rows]:
    """Return handles with the points around those of soft pulls.

    A point is displaced like its handle. If the handle turns or scales, the point turns and scales with it.

    Args:
        scene: the Gaussians
        handles: handles of the user
        hold: Gaussians that stay in place
        cuts: cuts between them

    Returns:
        K handles, those of the user among them; and the index of the user's handle of each. [K]
    """
    result = list[Handle]()
    owners = list[int]()
    for index, handle in enumerate(handles):
        leader = len(result)
        result.append(handle)
        owners.append(index)
        if handle.falloff is None:
            continue
        rows = handle.region.members.numpy()
        if hold is not None:
            rows = rows[~np.isin(rows, hold.members.numpy())]
        for x, y, z in grip_points(scene, handle.point, rows, handle.falloff, cuts)[1:].tolist():
            away = float(np.linalg.norm(np.array([x, y, z]) - np.array(handle.point)))
            follows = leader if handle.is_framed else None
            falloff = handle.falloff - away
            grip = replace(handle, point=(x, y, z), falloff=falloff, turn=None, scale=1.0, follows=follows)
            result.append(grip)
            owners.append(index)
    return result, np.array(owners)


def grip_points(
    scene: Gaussians, point: tuple[float, float, float], rows: Rows, radius: float, cuts: Cuts = NO_CUTS
) -> Floats:
    """Return points around a handle that move with it, so that a soft pull has a round top and no spike.

    They are well spread over the Gaussians within a share of the radius that are connected with the handle.

    Args:
        scene: the Gaussians. [N]
        point: the handle
        rows: Gaussians that may move. [M]
        radius: radius of the influence
        cuts: cuts between the Gaussians of the scene

    Returns:
        The handle's point and up to `MAX_GRIP_POINTS` − 1 others. [K,3]
    """
    means = scene.means.detach().double().numpy()
    first = np.array(point)
    distance = np.linalg.norm(means[rows] - first, axis=1)
    near = rows[distance <= _GRIP_SHARE * radius]
    points = [first]
    if len(near) > 1:
        seed = np.array([int(np.linalg.norm(means[near] - first, axis=1).argmin())])
        near = near[connected_rows(scene[torch.from_numpy(near)], seed, cuts.of_rows(near))]
    away = np.linalg.norm(means[near] - first, axis=1)
    while len(points) < min(MAX_GRIP_POINTS, len(near)):
        farthest = means[near[int(away.argmax())]]
        points.append(farthest)
        away = np.minimum(away, np.linalg.norm(means[near] - farthest, axis=1))
    return np.stack(points)


def connected_rows(scene: Gaussians, rows: Rows, cuts: Cuts = NO_CUTS) -> Rows:
    """Return the Gaussians that are connected with some of them, in ascending order.

    Args:
        scene: the Gaussians. [N]
        rows: indices. [K]
        cuts: cuts between them
    """
    graph = build_graph(scene, cuts=cuts)
    parts = graph.part[graph.node_of]
    connected: Rows = np.flatnonzero(np.isin(parts, parts[rows]))
    return connected
