"""Which neighboring splats lie on the same surface, and how they vote on what no view shows."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from progdf.gaussians import Gaussians
from progdf.rasterize.cpu.parallel import threads
from progdf.scene.bounds import normals_of
from progdf.scene.neighbors import nearest_rows
from progdf.sh import sh0_to_rgb

_NEIGHBORS = 96
_ROUNDS = 100
_WEAKEST = 1e-4  # likelihood; together, weaker ones are a thousandth of a vote
_AT_ONCE = 1 << 16  # rows, for the memory's sake

# Standard deviations within one surface. The bear's parts lift back with IoU .977-.999, the worst without the
# normals with .905, without the sizes .871, without the planes .957. Colors and distance gain nothing there,
# but not everywhere do parts differ in size. The first three may be half as large again.
_NEAR = 8  # the distance to this neighbor is the unit of the next two
_ALONG, _OFF_PLANE = 2.0, 0.5
_TURN = 0.18  # radians between the normals
_COLOR = 0.16  # sRGB, length of the difference
_SIZE = 0.25  # natural logarithm of the three scales, length of the difference


class SurfaceVote:
    """Whether what surrounds each undecided Gaussian, on its own surface, belongs to the members.

    Nearness in space alone would give the lining of a scarf to the neck under it. What counts is nearness
    along the surface: neighbors in each other's tangent plane that face the same way and have the same
    color and size. Undecided neighbors vote as they are voted on themselves (the harmonic extension of the
    decided ones), so that a decision travels along a surface to where no view looks.

    What one call finds of the surface around a Gaussian serves the next.

    Args:
        scene: N Gaussians
    """

    def __init__(self, scene: Gaussians) -> None:
        self._scene = scene
        self._known = torch.zeros(len(scene), dtype=torch.bool)
        self._ties = csr_matrix((len(scene), len(scene)), dtype=np.float32)

    def __call__(self, member: Tensor, undecided: Tensor) -> Tensor:
        """Vote.

        Args:
            member: whether each decided Gaussian is a member; ignored for the undecided. [N] bool
            undecided: rows to decide. [U] int64

        Returns:
            −1 none does .. 1 all do, 0 where no decided Gaussian is in reach. [U]
        """
        for rows in torch.split(undecided[~self._known[undecided]], _AT_ONCE):
            near, likeness = surface_likeness(self._scene, rows)
            kept = (likeness >= _WEAKEST).numpy()
            of = np.repeat(rows.numpy(), kept.sum(axis=1))
            self._ties += csr_matrix((likeness.numpy()[kept], (of, near.numpy()[kept])), self._ties.shape)
            self._known[rows] = True
        open_, vote = undecided.numpy(), (2.0 * member.float() - 1.0).numpy()
        ties, vote[open_] = self._ties[open_], 0.0
        for _ in range(_ROUNDS):
            vote[open_] = ties @ vote
        return torch.from_numpy(vote[open_])


def surface_likeness(scene: Gaussians, rows: Tensor) -> tuple[Tensor, Tensor]:
    """The nearest others of some Gaussians [Q,k] int64, and how likely each lies on the same surface [Q,k].

    The likelihoods of each add up to 1; see `SurfaceVote` for what they go by.
    """
    near, distances = nearest_rows(scene.means, rows, _NEIGHBORS, threads())
    return near, _likeness(scene, rows, near, distances.float())


def _likeness(scene: Gaussians, rows: Tensor, near: Tensor, distances: Tensor) -> Tensor:
    """How likely each neighbor is of the same surface; sums to 1. [Q,k]"""
    unit = distances[:, min(_NEAR, distances.shape[1]) - 1, None].clamp_min(1e-12)
    normals, colors = normals_of(scene), sh0_to_rgb(scene.sh0)
    sizes = scene.log_scales.sort(dim=1).values
    across = scene.means[near] - scene.means[rows, None]
    off_plane = torch.maximum(
        (across * normals[rows, None]).sum(dim=2).abs(), (across * normals[near]).sum(dim=2).abs()
    )
    # 1 − cos is half the angle squared
    turned = (2 - 2 * (normals[rows, None] * normals[near]).sum(dim=2).abs()).clamp_min(0.0)
    unlike = (
        (distances / (_ALONG * unit)) ** 2
        + (off_plane / (_OFF_PLANE * unit)) ** 2
        + turned / _TURN**2
        + (colors[near] - colors[rows, None]).square().sum(dim=2) / _COLOR**2
        + (sizes[near] - sizes[rows, None]).square().sum(dim=2) / _SIZE**2
    )
    return torch.softmax(-0.5 * unlike, dim=1)
