"""Neighboring Gaussians on the same surface, and their vote on Gaussians that no view shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.rasterize import render
from progdf.scene.bounds import normals_of, scene_sphere
from progdf.scene.neighbors import iterate_nearest_rows
from progdf.sh import sh0_to_rgb
from progdf.system.equality import equal_fields
from progdf.threads import threads

_NEIGHBORS = 96  # nearest neighbors that vote
_ROUNDS = 100  # propagation rounds of the vote
_MIN_LIKELIHOOD = 1e-4  # weaker neighbors do not vote; all of them together are less than 0.01 of a vote
_BLOCK_ROWS = 4096  # rows processed at once: 400 000 pairs, whose arrays stay in the processor's cache

# Standard deviations within one surface. The bear's parts lift back with IoU 0.977 to 0.999. The worst part
# has 0.905 without the normals, 0.871 without the sizes, and 0.957 without the planes. Colors and distance
# gain nothing there, but in other scenes parts may not differ in size. The first three deviations can be 1.5
# times as large without harm.
_UNIT_NEIGHBOR = 8  # the distance to this neighbor is the unit of the next two
_SIGMA_DISTANCE = 2.0
_SIGMA_OFF_PLANE = 0.5
_SIGMA_ANGLE = 0.18  # radians between the normals
_SIGMA_COLOR = 0.16  # sRGB, length of the difference
_FLOAT32_ERROR = 1e-6  # error of squares of about 1, summed over a pixel
_THICKNESS_SIGMAS = 3.0  # standard deviations that contain nearly all of a surface
_SIGMA_SIZE = 0.25  # natural logarithm of the three scales, length of the difference


class SurfaceVote:
    """Vote of the surrounding surface on undecided Gaussians.

    Distance in space alone would assign the lining of a scarf to the neck under it. Therefore neighbors count
    by their distance along the surface: they lie in each other's tangent plane, face the same way, and match
    in color and size. Undecided neighbors vote as their own neighbors do (the harmonic extension of the
    decided ones), so that a decision spreads along a surface to parts that no view shows.

    The neighbors found in one call are cached for the next.

    Args:
        scene: N Gaussians
        covered: see `covered_rows`. Covered and uncovered Gaussians are neighbors only if a continuous
            surface may connect them. [N] bool
    """

    def __init__(self, scene: Gaussians, covered: Tensor | None = None) -> None:
        self._scene = scene
        self._covered = covered
        self._known = torch.zeros(len(scene), dtype=torch.bool)
        self._ties = csr_matrix((len(scene), len(scene)), dtype=np.float32)

    def __call__(self, member: Tensor, undecided: Tensor) -> Tensor:
        """Vote on the undecided Gaussians.

        Args:
            member: membership of the decided Gaussians; ignored for the undecided. [N] bool
            undecided: rows to decide. [U] int64

        Returns:
            −1 (no neighbor is a member) to 1 (all are); 0 if no decided Gaussian is in reach. [U]
        """
        rows = undecided[~self._known[undecided]]
        self._ties += surface_links(self._scene, rows, _MIN_LIKELIHOOD, self._covered)
        self._known[rows] = True
        open_rows = undecided.numpy()
        vote = (2.0 * member.float() - 1.0).numpy()
        ties = self._ties[open_rows]
        vote[open_rows] = 0.0
        for _ in range(_ROUNDS):
            vote[open_rows] = ties @ vote
        return torch.from_numpy(vote[open_rows])


def surface_links(
    scene: Gaussians, rows: Tensor, min_likelihood: float, covered: Tensor | None = None
) -> csr_matrix:
    """Return the likelihoods of a common surface of some Gaussians and their nearest neighbors.

    The likelihoods of a Gaussian add up to 1, or to less if it is cut off from some or smaller ones are left
    out; see `SurfaceVote` for the criteria.

    Args:
        scene: N Gaussians
        rows: [Q] int64
        min_likelihood: smaller likelihoods are left out
        covered: see `covered_rows`. [N] bool

    Returns:
        entries in `rows`. [N,N] float32
    """
    count = len(scene)
    if count < 2 or not len(rows):
        return csr_matrix((count, count), dtype=np.float32)
    traits = _Traits.of(scene)
    parts = list[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float32]]]()
    for block, near, distances in iterate_nearest_rows(scene.means, rows, _NEIGHBORS, _BLOCK_ROWS, threads()):
        likeness = traits.likeness(block, near, distances.float())
        if covered is not None:
            across = covered[block, None] != covered[near]
            if bool(across.any()):
                connected = traits.is_continuous(block, near, distances.float())
                likeness = likeness.masked_fill(across & ~connected, 0.0)
        likely = (likeness >= min_likelihood).numpy()
        parts.append(
            (np.repeat(block.numpy(), likely.sum(axis=1)), near.numpy()[likely], likeness.numpy()[likely])
        )
    sources, neighbors, likelihoods = (np.concatenate(part) for part in zip(*parts, strict=True))
    return csr_matrix((likelihoods, (sources, neighbors)), (count, count))


def covered_rows(scene: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """Return the Gaussians behind a surface in every picture whose frame contains them. [N] bool

    A Gaussian is behind if its distance from the visible surface of its pixel exceeds the surface's
    thickness: three standard deviations of the visible centers and of the Gaussian itself, in that direction.
    """
    covered = torch.zeros(len(scene), dtype=torch.bool)
    uncovered = torch.zeros(len(scene), dtype=torch.bool)
    center, radius = scene_sphere(scene)
    means = (scene.means - center) / radius  # about 1, so that float32 resolves their squares
    axes = rotation_matrices(scene.unit_quats) * scene.scales[:, None, :] / radius
    pairs = torch.tensor([[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]])
    squares = means[:, pairs[0]] * means[:, pairs[1]]
    for camera in cameras:
        points = scene.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        x, y, depth = (points @ camera.K.T).unbind(1)
        x = (x / depth).floor()
        y = (y / depth).floor()
        framed = (depth > camera.near) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        rows = framed.nonzero()[:, 0]
        pixel = (y[rows].long(), x[rows].long())
        with torch.no_grad():
            outputs = [
                render(scene, camera, (0.0, 0.0, 0.0), colors=colors.contiguous())
                for colors in (means, squares[:, :3], squares[:, 3:])
            ]
        alpha = 1.0 - outputs[0].transmittance[pixel]
        surface, *products = (output.image[pixel] / alpha.clamp_min(1e-6)[:, None] for output in outputs)
        moments = means.new_zeros(len(rows), 3, 3)
        moments[:, pairs[0], pairs[1]] = torch.cat(products, dim=1)
        moments[:, pairs[1], pairs[0]] = torch.cat(products, dim=1)
        covariance = (
            moments - surface[:, :, None] * surface[:, None, :] + axes[rows] @ axes[rows].transpose(1, 2)
        )
        covariance += _FLOAT32_ERROR * torch.eye(3)
        offset = means[rows] - surface
        deviations = (offset * torch.linalg.solve(covariance, offset)).sum(
            dim=1
        )  # squared Mahalanobis distances
        behind = (deviations > _THICKNESS_SIGMAS**2) & (offset @ camera.viewmat[2, :3] > 0) & (alpha > 0.5)
        covered[rows[behind]] = True
        uncovered[rows[~behind]] = True
    return covered & ~uncovered


@dataclass(frozen=True)
class _Traits:
    """What is compared of two Gaussians of one surface. The rows of pairs are [Q] and [Q,k] int64."""

    __eq__ = equal_fields

    means: Tensor  # [N,3]
    normals: Tensor  # see `normals_of`. [N,3]
    colors: Tensor  # sRGB of the lowest SH function. [N,3]
    sizes: Tensor  # natural logarithms of the scales, ascending. [N,3]
    thickness: Tensor  # shortest standard deviation. [N]

    @classmethod
    def of(cls, scene: Gaussians) -> _Traits:
        """Return the traits of all Gaussians."""
        sizes = scene.log_scales.sort(dim=1).values
        return cls(scene.means, normals_of(scene), sh0_to_rgb(scene.sh0), sizes, scene.scales.amin(dim=1))

    def is_continuous(self, rows: Tensor, near: Tensor, distances: Tensor) -> Tensor:
        """Return True for pairs that a continuous surface may connect. [Q,k] bool

        Their distance from each other's planes is at most that of an arc with the angle of their normals,
        plus their thickness.
        """
        off_plane, cosine = self._off_plane(rows, near)
        arc = distances * ((1 - cosine) / 2).clamp_min(0.0).sqrt()  # chord length × sine of half the angle
        thickness = torch.maximum(self.thickness[rows, None], self.thickness[near])
        return off_plane <= arc + _THICKNESS_SIGMAS * thickness

    def likeness(self, rows: Tensor, near: Tensor, distances: Tensor) -> Tensor:
        """Return the likelihood that each neighbor lies on the same surface; sums to 1. [Q,k]"""
        unit = distances[:, min(_UNIT_NEIGHBOR, distances.shape[1]) - 1, None].clamp_min(1e-12)
        off_plane, cosine = self._off_plane(rows, near)
        squared_angle = (2 - 2 * cosine).clamp_min(0.0)  # 1 − cos is half the angle squared
        distance = (
            (distances / (_SIGMA_DISTANCE * unit)) ** 2
            + (off_plane / (_SIGMA_OFF_PLANE * unit)) ** 2
            + squared_angle / _SIGMA_ANGLE**2
            + (self.colors[near] - self.colors[rows, None]).square().sum(dim=2) / _SIGMA_COLOR**2
            + (self.sizes[near] - self.sizes[rows, None]).square().sum(dim=2) / _SIGMA_SIZE**2
        )
        return torch.softmax(-0.5 * distance, dim=1)

    def _off_plane(self, rows: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distance of either center from the other's plane, and the cosine of the planes.

        The larger distance counts, in world units. [Q,k] each
        """
        normals, near_normals = self.normals[rows, None], self.normals[near]
        across = self.means[near] - self.means[rows, None]
        off_plane = torch.maximum(
            (across * normals).sum(dim=2).abs(), (across * near_normals).sum(dim=2).abs()
        )
        return off_plane, (normals * near_normals).sum(dim=2).abs()
