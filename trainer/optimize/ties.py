"""Neighbors on one surface, tied: what stands in for views where a handful of pictures is all there is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import cg
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from trainer.regions.lift import HIDDEN, gather
from trainer.regions.surface import covered_rows, surface_likeness

_WEAKEST = 5e-3  # of all of a member's ties: most of its neighbors are hardly alike
_STEPS = 300  # of conjugate gradients from member to member
_EXACT = 1e-6  # what they leave


@dataclass(frozen=True)
class Ties:
    """What stands in for views where these are few: neighbors on one surface, whose residuals are alike."""

    graph: csr_matrix  # Laplacian. [M,M]
    clear: Tensor  # members that a view shows clearly; the others follow their surface alone. [M] bool

    def of(self, rows: Tensor) -> csr_matrix:
        """The Laplacian with the ties among some members alone. [M] bool -> [M,M] float32"""
        among = diags(rows.double().numpy())
        links = among @ (diags(self.graph.diagonal()) - self.graph) @ among
        return csr_matrix(diags(np.asarray(links.sum(axis=1)).ravel()) - links, dtype=np.float32)

    def spread(self, residual: Tensor, weights: Tensor, ridge: float) -> Tensor:
        """The residual where its members weigh enough, spread over those around them that do not.

        In a descent over the views it would take far too many steps to travel around a body.

        Args:
            residual: [M,b,3]
            weights: of the members, in units of a member's ties together; 0: the residual means nothing. [M]
            ridge: the pull to 0 in the same unit
        """
        weight = weights.double().numpy()[:, None]
        system = csr_matrix(self.graph + diags(weight[:, 0] + ridge))
        known = residual.flatten(1).double().numpy()
        scale = diags(1.0 / system.diagonal())
        columns = [
            cg(system, weight[:, 0] * column, column, rtol=_EXACT, maxiter=_STEPS, M=scale)[0]
            for column in known.T
        ]
        return torch.from_numpy(np.stack(columns, axis=1)).to(residual).view_as(residual)


def surface_ties(scene: Gaussians, members: Tensor, cameras: Sequence[Camera]) -> Ties:
    """The ties of a region's members, and which of them some camera sees clearly."""
    masks = [torch.ones(camera.height, camera.width) for camera in cameras]
    clear = gather(scene, cameras, masks).clearness[members] >= HIDDEN
    return Ties(surface_graph(scene[members], covered_rows(scene, cameras)[members]), clear)


def surface_graph(scene: Gaussians, covered: Tensor) -> csr_matrix:
    """The Laplacian of the graph of neighbors on one surface, each with ties of 1 on the mean. [N,N]

    `covered`: see `covered_rows`; there are no ties through what covers these. [N] bool
    """
    count = len(scene)
    if count < 3:
        return csr_matrix((count, count))
    near, likeness = surface_likeness(scene, torch.arange(count), covered)
    alike = (likeness >= _WEAKEST).numpy()
    rows = np.repeat(np.arange(count), alike.sum(axis=1))
    ties = csr_matrix((likeness.double().numpy()[alike], (rows, near.numpy()[alike])), (count, count))
    ties = 0.5 * (ties + ties.T)
    return csr_matrix(diags(np.asarray(ties.sum(axis=1)).ravel()) - ties)
