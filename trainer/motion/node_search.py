"""Search for the motion of a region's nodes that fits the training views.

The search is L-BFGS over all views at once, from blurred pictures to sharp ones. Its gradient is exact. Its
first Hessian is that of Gauss-Newton for optical flow: the picture moves with the surface, so a member's part
is the structure tensor of the picture at its place (Lucas and Kanade 1981), weighted by its visible weight.
Rigidity is the regularizer, and decreases from blurred to sharp.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csr_array, diags_array
from torch import Tensor
from torch.nn.functional import avg_pool2d

from progdf.gaussians import BASE_CHANNELS, attribute_slices
from progdf.quaternions import rotation_matrices, turn_quats
from progdf.sh import C0
from progdf.system.equality import equal_fields
from trainer.views.crops import CropScene

from .nodes import NodeMotion, NodePlacement, RegionNodes, make_nodes, map_members, settle_turns
from .parts import MOVING_ATTRIBUTES, OnStep, mean_distance

Floats = NDArray[np.float64]

_BLURS_PX = ((0.1, 0.05), (21, 9), (21, 9, 1))
"""Widths of the box blurs of each level, in pixels, or as shares of the box's longer side below 1."""
_RIGIDITY_WEIGHTS = (0.5, 0.1, 0.02)  # weight of the rigidity of each level, see `NodeSearch._rigidity`
_TETHER_SHARE = 1e-4  # weight of the current position, as a share of the mean diagonal of the system
_SMOOTH_L1 = 2 / 255  # color difference below which the distance of the pictures is a square
_TENSOR_BLUR_PX = 5  # width over which structure tensors are averaged
_DAMPING = 0.5  # share of the system's diagonal that is added to it
_MEMORY = 8  # steps that L-BFGS remembers
_MIN_DECREASE = 1e-4  # share of the predicted decrease that a step must reach
_SHORTENED = 0.3  # share of a rejected step that is tried next
_MIN_ROUNDS = 8  # minimum number of evaluations of all views per level
_MIN_VIEWS = 10  # with more views, the blurred levels use every other one
_COLUMNS = attribute_slices(BASE_CHANNELS)


class _Memory:
    """Memory of L-BFGS: the last steps and the changes of the gradient, over a factorized first Hessian."""

    def __init__(self, factor: tuple[Floats, bool]) -> None:
        self._factor = factor
        self._pairs: list[tuple[Floats, Floats, float]] = []

    def add(self, step: Floats, change: Floats) -> None:
        """Add a step and the change of the gradient along it, unless its curvature is not positive."""
        curvature = float(step @ change)
        if curvature > 0.0:
            self._pairs = [*self._pairs[1 - _MEMORY :], (step, change, 1.0 / curvature)]

    def direction(self, gradient: Floats) -> Floats:
        """Return the step towards the minimum."""
        left = gradient.copy()
        shares = []
        for step, change, inverse in reversed(self._pairs):
            share = inverse * float(step @ left)
            left -= share * change
            shares.append(share)
        found: Floats = cho_solve(self._factor, left)
        for (step, change, inverse), share in zip(self._pairs, reversed(shares), strict=True):
            found += (share - inverse * float(change @ found)) * step
        return -found


@dataclass(frozen=True)
class NodeSearch:
    """Search for the motion of nodes that fits the training views."""

    __eq__ = equal_fields

    original: Tensor  # raw member rows. [M,C]
    crops: Sequence[CropScene]  # the training views
    steps: int = 120  # steps per level, each in one view

    @cached_property
    def nodes(self) -> RegionNodes:
        """Nodes of the region."""
        return make_nodes(self.original)

    def find(
        self,
        targets: Sequence[Tensor],
        start: NodeMotion,
        levels: Sequence[int] = (0, 1, 2),
        on_step: OnStep | None = None,
    ) -> NodeMotion:
        """Return the motion that brings the views close to their targets.

        Args:
            targets: edited box of each view. [h,w,3] each
            start: initial motion
            levels: blurs of the pictures, coarse to fine, see `_BLURS_PX`
            on_step: progress: steps done in one level; each level counts from 1 again

        Raises:
            FloatingPointError: the loss is no longer finite.
        """
        motion = start
        for level in levels:
            motion = self._descend(targets, motion, level, on_step)
        return motion

    def find_next(
        self, targets: Sequence[Tensor], before: NodeMotion, further: float, on_step: OnStep | None = None
    ) -> NodeMotion:
        """Return the motion for a strength `further` times that of the motion `before`."""
        shift = before.positions - self.nodes.positions
        beyond = NodeMotion(self.nodes.positions + further * shift, further * before.turn)
        start = min(
            (before, settle_turns(self.nodes, beyond)), key=lambda motion: self.distance(targets, motion)
        )
        return self.find(targets, start, (len(_BLURS_PX) - 1,), on_step)

    def distance(self, targets: Sequence[Tensor], motion: NodeMotion) -> float:
        """Return the mean distance of all views from their targets, at full sharpness and blurred."""
        return mean_distance(self.crops, self.original + self._carry(motion), targets)

    def _carry(self, motion: NodeMotion) -> Tensor:
        return NodePlacement(self.nodes, motion).carry(self.original, torch.zeros_like(self.original))

    def _descend(
        self, targets: Sequence[Tensor], start: NodeMotion, level: int, on_step: OnStep | None
    ) -> NodeMotion:
        """Minimize the distance of the pictures at one level by L-BFGS, preconditioned by `_factorize`."""
        views = range(len(self.crops))
        if level < len(_BLURS_PX) - 1 and len(views) > _MIN_VIEWS:
            views = range(0, len(views), 2)
        rounds = max(_MIN_ROUNDS, round(self.steps / len(views)))
        tensors = self._survey(targets, start, level, views)
        memory = _Memory(self._factorize(tensors, level))
        motion = start
        energy, gradient = self._differentiate(targets, motion, level, views)
        direction = memory.direction(gradient)
        length = self._first_length(direction)
        for step in range(rounds):
            shift = torch.from_numpy(length * direction.reshape(-1, 3)).to(motion.positions)
            moved = settle_turns(self.nodes, NodeMotion(motion.positions + shift, motion.turn))
            there, slope = self._differentiate(targets, moved, level, views)
            if not math.isfinite(there):
                raise FloatingPointError(f"the loss is {there} at step {step} of the search for nodes")
            if there <= energy + _MIN_DECREASE * length * float(gradient @ direction):
                memory.add(length * direction, slope - gradient)
                motion = moved
                energy = there
                gradient = slope
                direction = memory.direction(gradient)
                length = self._first_length(direction)
            else:
                length *= _SHORTENED
            if on_step is not None:
                on_step(min(self.steps, (step + 1) * len(views)), energy)
        return motion

    def _first_length(self, direction: Floats) -> float:
        """Return the share of a step that moves no node farther than the nodes' spacing."""
        return min(1.0, self.nodes.spacing / max(float(np.abs(direction).max()), 1e-30))

    def _survey(
        self, targets: Sequence[Tensor], motion: NodeMotion, level: int, views: Sequence[int]
    ) -> Tensor:
        """Return the second derivatives of the distance by each member's position, for flow. [M,3,3]"""
        rows = self.original + self._carry(motion)
        tensors = rows.new_zeros(len(rows), 3, 3)
        for view in views:
            crop = self.crops[view]
            leaf = rows.detach().requires_grad_()
            image = crop.render(leaf, MOVING_ATTRIBUTES)
            (seen,) = torch.autograd.grad(image.sum(), leaf)
            visible = seen[:, _COLUMNS["sh0"]].mean(dim=1).clamp_min(0.0) / C0
            tensor = _structure_tensor(image.detach(), targets[view], _widths(level, crop))
            tensors += _member_tensors(crop, rows, tensor, visible) / len(views)
        return tensors

    def _differentiate(
        self, targets: Sequence[Tensor], motion: NodeMotion, level: int, views: Sequence[int]
    ) -> tuple[float, Floats]:
        """Return the distance of some views with the rigidity, and its gradient by the positions [3n]."""
        positions = motion.positions.detach().clone().requires_grad_()
        maps = map_members(self.original, self.nodes, NodeMotion(positions, motion.turn))
        rows = self.original + maps.carry(self.original, torch.zeros_like(self.original))
        leaf = rows.detach().requires_grad_()
        energy = 0.0
        gradient = torch.zeros_like(leaf)
        for view in views:
            crop = self.crops[view]
            image = crop.render(leaf, MOVING_ATTRIBUTES)
            distance = _picture_distance(image, targets[view], _widths(level, crop)) / len(views)
            gradient += torch.autograd.grad(distance, leaf)[0]
            energy += float(distance.detach())
        (by_positions,) = torch.autograd.grad(rows, positions, gradient)
        rigidity, by_rigidity = self._rigidity(motion)
        weight = _RIGIDITY_WEIGHTS[level]
        total = by_positions + weight * by_rigidity
        return energy + weight * rigidity, total.cpu().double().flatten().numpy()

    def _factorize(self, tensors: Tensor, level: int) -> tuple[Floats, bool]:
        """Return the Cholesky factor of the Gauss-Newton system of all views."""
        hessian = self._picture_hessian(tensors) + _RIGIDITY_WEIGHTS[level] * self._rigid_hessian
        diagonal = np.diag(hessian)
        floor = _TETHER_SHARE * float(diagonal.mean()) + 1e-30
        factor: tuple[Floats, bool] = cho_factor(
            hessian + np.diag(_DAMPING * diagonal + floor), lower=True, overwrite_a=True
        )
        return factor

    @cached_property
    def _binding(self) -> csr_array:
        """Weights of the nodes that each member follows. [M,n]"""
        nodes = self.nodes
        nearest = nodes.nearest.cpu().numpy()
        weights = nodes.weights.cpu().double().numpy()
        rows = np.repeat(np.arange(len(nearest)), nearest.shape[1])
        return csr_array((weights.ravel(), (rows, nearest.ravel())), shape=(len(nearest), len(nodes)))

    def _picture_hessian(self, tensors: Tensor) -> Floats:
        """Return the second derivatives by the nodes from those by the members. [M,3,3] -> [3n,3n]"""
        blocks = tensors.cpu().double().numpy()
        binding = self._binding
        hessian = np.zeros((3 * len(self.nodes), 3 * len(self.nodes)))
        for i in range(3):
            for j in range(i, 3):
                scaled = csr_array(diags_array(blocks[:, i, j]) @ binding)
                block = (binding.T @ scaled).toarray()
                hessian[i::3, j::3] = block
                hessian[j::3, i::3] = block.T
        return hessian

    def _rigidity(self, motion: NodeMotion) -> tuple[float, Tensor]:
        """Return the mean squared error of edges, in squared spacings, and its gradient [n,3]."""
        nodes = self.nodes
        rotations = rotation_matrices(turn_quats(motion.turn))[nodes.starts]
        edges = motion.positions[nodes.ends] - motion.positions[nodes.starts]
        error = edges - (rotations @ nodes.arms[..., None])[..., 0]
        scale = 1.0 / (max(1, len(error)) * nodes.spacing**2)
        gradient = torch.zeros_like(motion.positions)
        gradient = gradient.index_add(0, nodes.ends, 2.0 * scale * error)
        gradient = gradient.index_add(0, nodes.starts, -2.0 * scale * error)
        return scale * float(error.square().sum()), gradient

    @cached_property
    def _rigid_hessian(self) -> Floats:
        """Hessian of the rigidity for constant rotations. [3n,3n]"""
        nodes = self.nodes
        count = len(nodes)
        starts = nodes.starts.cpu().numpy()
        ends = nodes.ends.cpu().numpy()
        ones = np.ones(len(starts))
        adjacency = csr_array((ones, (starts, ends)), shape=(count, count))
        both = (adjacency + adjacency.T).toarray()
        laplacian = np.diag(both.sum(axis=1)) - both
        scale = 2.0 / (max(1, len(starts)) * nodes.spacing**2)
        hessian: Floats = scale * np.kron(laplacian, np.eye(3))
        return hessian


def _widths(level: int, crop: CropScene) -> list[int]:
    """Return the widths of the box blurs in pixels."""
    longer = max(crop.size)
    widths = [round(width * longer) if width < 1 else int(width) for width in _BLURS_PX[level]]
    return [max(1, min(width, *crop.size)) for width in widths]


def _picture_distance(image: Tensor, target: Tensor, widths: Sequence[int]) -> Tensor:
    """Return the smooth L1 distance of a picture at several blurs; differentiable. [h,w,3] each"""
    planes = (image - target).permute(2, 0, 1)[None]
    distance = planes.new_zeros(())
    for width in widths:
        distance = distance + ((_blur(planes, width).square() + _SMOOTH_L1**2).sqrt() - _SMOOTH_L1).mean()
    return distance


def _structure_tensor(image: Tensor, target: Tensor, widths: Sequence[int]) -> Tensor:
    """Return the structure tensor xx, xy, yy per pixel, weighted like the distance's second derivatives.

    [h,w,3] each
    """
    planes = (image - target).permute(2, 0, 1)[None]
    picture = image.permute(2, 0, 1)[None]
    tensor = planes.new_zeros(3, *planes.shape[2:])
    for width in widths:
        size = (_blur(planes, width).square() + _SMOOTH_L1**2).sqrt()
        across, down = _slopes(_blur(picture, width))
        share = 1.0 / (size * planes.numel())
        tensor += torch.cat([across * across * share, across * down * share, down * down * share]).sum(dim=1)
    return _blur(tensor[None], _TENSOR_BLUR_PX)[0].permute(1, 2, 0)


def _blur(planes: Tensor, width: int) -> Tensor:
    """Return planes averaged over boxes of an odd width, with the border repeated. [1,c,h,w] -> [1,c,h,w]"""
    half = min(width // 2, *(side - 1 for side in planes.shape[2:]))
    if half < 1:
        return planes
    return avg_pool2d(planes, 2 * half + 1, stride=1, padding=half, count_include_pad=False)


def _slopes(planes: Tensor) -> tuple[Tensor, Tensor]:
    """Return the change per pixel across and down. [1,c,h,w] -> [1,c,h,w] each"""
    down, across = torch.gradient(planes, dim=(2, 3))
    return across, down


def _member_tensors(crop: CropScene, rows: Tensor, tensor: Tensor, visible: Tensor) -> Tensor:
    """Return each member's part in the second derivatives of the distance by its position. [M,3,3]

    Args:
        crop: one view
        rows: raw member rows. [M,C]
        tensor: structure tensor of the box. [h,w,3]
        visible: summed blending weight of each member, pixels. [M]
    """
    camera = crop.camera
    x0, y0, x1, y1 = crop.box
    rotation = camera.viewmat[:3, :3].to(rows)
    seen = rows[:, _COLUMNS["means"]] @ rotation.T + camera.viewmat[:3, 3].to(rows)
    z = seen[:, 2].clamp_min(camera.near)
    fx = float(camera.K[0, 0])
    fy = float(camera.K[1, 1])
    column = fx * seen[:, 0] / z + float(camera.K[0, 2]) - x0
    row = fy * seen[:, 1] / z + float(camera.K[1, 2]) - y0
    inside = (column >= 0) & (column < x1 - x0) & (row >= 0) & (row < y1 - y0) & (seen[:, 2] > camera.near)
    at = tensor[row.long().clamp(0, y1 - y0 - 1), column.long().clamp(0, x1 - x0 - 1)]
    weight = visible * inside
    zero = torch.zeros_like(z)
    projection = torch.stack(
        [fx / z, zero, -fx * seen[:, 0] / z**2, zero, fy / z, -fy * seen[:, 1] / z**2], dim=1
    )
    jacobian = projection.view(-1, 2, 3) @ rotation
    flow = torch.stack([at[:, 0], at[:, 1], at[:, 1], at[:, 2]], dim=1).view(-1, 2, 2)
    return weight[:, None, None] * (jacobian.mT @ flow @ jacobian)
