"""Which neighboring splats lie on the same surface, and how they vote on what no view shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from scipy.sparse import csr_matrix
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.quaternions import rotation_matrices
from progdf.rasterize import render
from progdf.scene.bounds import normals_of, scene_sphere
from progdf.scene.neighbors import nearest_rows
from progdf.sh import sh0_to_rgb
from progdf.threads import threads

_NEIGHBORS = 96
_ROUNDS = 100
_WEAKEST = 1e-4  # likelihood; together, weaker ones are a thousandth of a vote
_AT_ONCE = 1 << 16  # rows, for the memory's sake

# Standard deviations within one surface. The bear's parts lift back with IoU .977-.999, the worst without the
# normals with .905, without the sizes .871, without the planes .957. Colors and distance gain nothing there,
# but not everywhere do parts differ in size. The first three may be half as large again.
_NEAR = 8  # the distance to this neighbor is the unit of the next two
_ALONG = 2.0
_OFF_PLANE = 0.5
_TURN = 0.18  # radians between the normals
_COLOR = 0.16  # sRGB, length of the difference
_FLOAT32 = 1e-6  # of squares of about 1, summed over a pixel
_THICK = 3.0  # standard deviations: nearly all of a surface
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
        covered: see `covered_rows`; through what covers them these have no neighbors
    """

    def __init__(self, scene: Gaussians, covered: Tensor | None = None) -> None:
        self._scene = scene
        self._covered = covered
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
            near, likeness = surface_likeness(self._scene, rows, self._covered)
            alike = (likeness >= _WEAKEST).numpy()
            of = np.repeat(rows.numpy(), alike.sum(axis=1))
            self._ties += csr_matrix((likeness.numpy()[alike], (of, near.numpy()[alike])), self._ties.shape)
            self._known[rows] = True
        open_ = undecided.numpy()
        vote = (2.0 * member.float() - 1.0).numpy()
        ties = self._ties[open_]
        vote[open_] = 0.0
        for _ in range(_ROUNDS):
            vote[open_] = ties @ vote
        return torch.from_numpy(vote[open_])


def surface_likeness(scene: Gaussians, rows: Tensor, covered: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The nearest others of some Gaussians [Q,k] int64, and how likely each lies on the same surface [Q,k].

    The likelihoods of each add up to 1, or less where it is cut off from others; see `SurfaceVote` for what
    they go by. `covered`: see `covered_rows`. [N] bool
    """
    near, distances = nearest_rows(scene.means, rows, _NEIGHBORS, threads())
    likeness = _likeness(scene, rows, near, distances.float())
    if covered is not None and bool(covered.any()):
        across = covered[rows, None] != covered[near]
        likeness = likeness.masked_fill(across & ~_goes_on(scene, rows, near, distances.float()), 0.0)
    return near, likeness


def covered_rows(scene: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """Which Gaussians lie behind a surface in every picture in which they would be. [N] bool

    Behind is what lies deeper than the surface is thick: farther off what its pixel shows than three standard
    deviations of the centers of that, and of the Gaussian itself, in that direction.
    """
    covered = torch.zeros(len(scene), dtype=torch.bool)
    uncovered = torch.zeros(len(scene), dtype=torch.bool)
    center, radius = scene_sphere(scene)
    means = (scene.means - center) / radius  # of about 1, so that float32 can tell squares apart
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
        at = (y[rows].long(), x[rows].long())
        with torch.no_grad():
            drawn = [
                render(scene, camera, (0.0, 0.0, 0.0), colors=colors.contiguous())
                for colors in (means, squares[:, :3], squares[:, 3:])
            ]
        alpha = 1.0 - drawn[0].transmittance[at]
        first, *products = (found.image[at] / alpha.clamp_min(1e-6)[:, None] for found in drawn)
        moments = means.new_zeros(len(rows), 3, 3)
        moments[:, pairs[0], pairs[1]] = torch.cat(products, dim=1)
        moments[:, pairs[1], pairs[0]] = torch.cat(products, dim=1)
        spread = moments - first[:, :, None] * first[:, None, :] + axes[rows] @ axes[rows].transpose(1, 2)
        spread += _FLOAT32 * torch.eye(3)
        off = means[rows] - first
        deviations = (off * torch.linalg.solve(spread, off)).sum(dim=1)  # squared
        behind = (deviations > _THICK**2) & (off @ camera.viewmat[2, :3] > 0) & (alpha > 0.5)
        covered[rows[behind]] = True
        uncovered[rows[~behind]] = True
    return covered & ~uncovered


def _goes_on(scene: Gaussians, rows: Tensor, near: Tensor, distances: Tensor) -> Tensor:
    """Whether a surface may lead from one to the other: they lie off each other's planes by no more than an
    arc does that turns as they do, and than they are thick. [Q,k] bool"""
    off_plane, cosine = _off_plane(scene, rows, near)
    thick = scene.scales.amin(dim=1)
    arc = distances * ((1 - cosine) / 2).clamp_min(0.0).sqrt()  # of a chord: times the sine of half the turn
    return off_plane <= arc + _THICK * torch.maximum(thick[rows, None], thick[near])


def _off_plane(scene: Gaussians, rows: Tensor, near: Tensor) -> tuple[Tensor, Tensor]:
    """How far neighbors lie off each other's planes, world units, and the cosine between these. [Q,k] each"""
    normals = normals_of(scene)
    across = scene.means[near] - scene.means[rows, None]
    off_plane = torch.maximum(
        (across * normals[rows, None]).sum(dim=2).abs(), (across * normals[near]).sum(dim=2).abs()
    )
    return off_plane, (normals[rows, None] * normals[near]).sum(dim=2).abs()


def _likeness(scene: Gaussians, rows: Tensor, near: Tensor, distances: Tensor) -> Tensor:
    """How likely each neighbor is of the same surface; sums to 1. [Q,k]"""
    unit = distances[:, min(_NEAR, distances.shape[1]) - 1, None].clamp_min(1e-12)
    colors = sh0_to_rgb(scene.sh0)
    sizes = scene.log_scales.sort(dim=1).values
    off_plane, cosine = _off_plane(scene, rows, near)
    turned = (2 - 2 * cosine).clamp_min(0.0)  # 1 − cos is half the angle squared
    unlike = (
        (distances / (_ALONG * unit)) ** 2
        + (off_plane / (_OFF_PLANE * unit)) ** 2
        + turned / _TURN**2
        + (colors[near] - colors[rows, None]).square().sum(dim=2) / _COLOR**2
        + (sizes[near] - sizes[rows, None]).square().sum(dim=2) / _SIZE**2
    )
    return torch.softmax(-0.5 * unlike, dim=1)
