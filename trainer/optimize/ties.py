"""Ties between neighbors on one surface, which replace missing views if there are few pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.sparse import csr_array, csr_matrix, diags
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.surface.graph_solver import GraphSolver
from progdf.system.equality import equal_fields
from progdf.terminal import format_count
from trainer.regions.lift import HIDDEN, gather
from trainer.regions.reach import drop_unsupported, find_fade, surface_reach
from trainer.regions.surface import covered_rows, surface_links

_ACCURACY = 1e-4  # see `GraphSolver.solve`; 99.9 % of the colors are exact within 1/255
_MIN_LIKENESS = 5e-3  # minimum share of a member's total likeness: most of its neighbors are hardly alike


@dataclass(frozen=True)
class Ties:
    """Ties between neighbors on one surface, whose residuals should be similar."""

    __eq__ = equal_fields

    graph: csr_matrix  # Laplacian. [M,M]
    clear: Tensor  # members that are not almost hidden in every view (`HIDDEN`). [M] bool
    covered: Tensor | None = None  # members behind a surface, see `covered_rows`; None: none. [M] bool
    # share of the change that each member may take, see `trainer.regions.reach`; None: all of it. [M] 0..1
    reach: Tensor | None = None

    @property
    def links(self) -> csr_matrix:
        """Ties between different members, ≥ 0. [M,M]"""
        return csr_matrix(diags(self.graph.diagonal()) - self.graph)

    @cached_property
    def solver(self) -> GraphSolver:
        """Solver of `spread`."""
        links = csr_array(self.links, dtype=np.float32)
        links.eliminate_zeros()
        return GraphSolver(links)

    def limit(self, values: Tensor) -> Tensor:
        """Return values of the members scaled by `reach`. [M,…]"""
        if self.reach is None:
            return values
        return self.reach.view(-1, *[1] * (values.ndim - 1)) * values

    def end_at_pictures(
        self,
        scene: Gaussians,
        members: Tensor,
        cameras: Sequence[Camera],
        changes: Sequence[Tensor],
    ) -> tuple[Ties, str]:
        """Return the ties of an edit that ends where its pictures end, and the decision as a log line.

        Args:
            scene: the original
            members: rows of the region. [M] int64
            cameras: cameras of the pictures
            changes: difference of each picture to the original. [H,W,3] each
        """
        visible = self.clear if self.covered is None else self.clear & ~self.covered
        links = self.links
        fade = find_fade(scene, members, cameras, changes)
        sources = drop_unsupported(links, visible)
        reach = surface_reach(links, scene.means[members], sources, fade.width)
        reason = "the paint ends at outlines"
        if fade.border_px:
            reason = f"the paint's own border is {fade.border_px:.0f} pixels wide"
        unchanged = format_count(int((reach == 0.0).sum()), "member")
        line = (
            f"the edit ends {fade.width:.3g} units beyond the parts that the pictures show ({reason}); "
            f"{unchanged} farther away keep their color"
        )
        return replace(self, clear=self.clear & (reach > 0.0), reach=reach), line

    def of(self, rows: Tensor) -> csr_matrix:
        """Return the Laplacian of the ties among some members. [M] bool -> [M,M] float32"""
        among = diags(rows.double().numpy())
        links = among @ self.links @ among
        return csr_matrix(diags(np.asarray(links.sum(axis=1)).ravel()) - links, dtype=np.float32)

    def spread(self, residual: Tensor, weights: Tensor, ridge: float) -> Tensor:
        """Return the residual, spread from members with enough weight to those around them.

        Descent over the views would take far too many steps to propagate around a body, see `GraphSolver`.

        Args:
            residual: [M,b,3]
            weights: weights of the members' residuals, where 1 is about the sum of a member's ties; 0: the
                residual is ignored. [M]
            ridge: weight that pulls every residual to 0, in the same unit
        """
        weight = weights.double().numpy()
        values = residual.flatten(1).double().numpy()
        columns = [self.solver.solve(weight + ridge, weight * column, _ACCURACY) for column in values.T]
        return torch.from_numpy(np.stack(columns, axis=1)).to(residual).view_as(residual)


def surface_ties(scene: Gaussians, members: Tensor, cameras: Sequence[Camera]) -> Ties:
    """Return the ties of a region's members. Covered and almost hidden members are found from the cameras."""
    masks = [torch.ones(camera.height, camera.width) for camera in cameras]
    clear = gather(scene, cameras, masks).clearness[members] >= HIDDEN
    covered = covered_rows(scene, cameras)[members]
    return Ties(surface_graph(scene[members], covered), clear, covered)


def surface_graph(scene: Gaussians, covered: Tensor) -> csr_matrix:
    """Return the Laplacian of the ties between neighbors on one surface. [N,N]

    The ties of a Gaussian add up to about 1. `covered`: see `SurfaceVote`. [N] bool
    """
    count = len(scene)
    if count < 3:
        return csr_matrix((count, count))
    ties = surface_links(scene, torch.arange(count), _MIN_LIKENESS, covered).astype(np.float64)
    ties = 0.5 * (ties + ties.T)
    return csr_matrix(diags(np.asarray(ties.sum(axis=1)).ravel()) - ties)
