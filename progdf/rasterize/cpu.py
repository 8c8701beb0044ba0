"""The fast engine: numba kernels behind one `torch.autograd.Function`.

Projection is computed in float64, pixels in float32, whatever the type of the inputs; results are float32.
The picture and the gradients are the same bits in every run and for every number of threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.rasterize import binning, few, order, projection, weights
from progdf.rasterize.backward import backpropagate
from progdf.rasterize.binning import TILE_H, TILE_W
from progdf.rasterize.blend import blend
from progdf.rasterize.blend_backward import SUMS
from progdf.rasterize.conventions import RasterInfo
from progdf.rasterize.jit import running
from progdf.rasterize.projection_backward import CAMERA, PARTS
from progdf.rasterize.shares import Team, at_once
from progdf.rasterize.threads import threads

Array = NDArray[Any]

MOST_INTERSECTIONS = 100_000_000
"""(Gaussian, tile) pairs beyond which a view is refused: 1.2 GB forward, 3.6 GB more backward."""


FEW = 8192
"""Gaussians up to which one thread lists them: handing work to others would take longer than the work."""


@dataclass(frozen=True)
class _View:
    """The camera as the kernels want it."""

    viewmat: Array
    intrinsics: Array
    size: Array
    window: Array
    grid: Array
    near: float
    degree: int
    antialiased: bool


@dataclass(frozen=True)
class _Lists:
    """What a forward pass found out and the backward pass needs; layouts: `projection` and `binning`."""

    ids: Array
    ranks: Array
    splats: Array
    rgb: Array
    tile_starts: Array
    members: Array
    slots: Array
    per_splat: Array


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    background: Tensor,
    near: float,
    sh_degree: int | None,
    antialiased: bool,
    crop: tuple[int, int, int, int],
    grad_rows: Tensor | None,
) -> tuple[Tensor, Tensor, RasterInfo]:
    """See `progdf.rasterize.rasterize`."""
    view = _view(viewmat, K, width, height, near, sh_degree, antialiased, crop)
    inputs = [_float32(t) for t in (means, quats, scales, opacities, colors, background)]
    drawn = _Rasterize.apply(view, grad_rows, *inputs, viewmat, K)  # type: ignore[no-untyped-call]
    image, transmittance, centres, depths, visible = drawn
    return image, transmittance, RasterInfo(centres, depths, visible)


def alpha_weights(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    mask: Tensor,
    near: float,
) -> Tensor:
    """See `progdf.rasterize.alpha_weights`; activated units."""
    height, width = mask.shape
    view = _view(viewmat, K, width, height, near, None, False, (0, 0, width, height))
    gaussians = [_float32(tensor).detach().numpy() for tensor in (means, quats, scales, opacities)]
    gaussians.append(np.zeros((len(means), 1, 3), np.float32))
    totals = np.zeros((len(means), weights.SUMS))
    with running("weights", 2) as workers:
        team = Team(workers)
        lists, _ = _list_splats(view, gaussians, team, for_gradients=True)
        sums = np.zeros((len(lists.members), weights.SUMS))
        team.share(
            weights.weigh,
            lists.splats, lists.rgb, view.window, view.grid, lists.tile_starts, lists.members, lists.slots,
            _float32(mask).numpy(), sums,
        )  # fmt: skip
        weights.gather(lists.ids, lists.ranks, lists.per_splat, sums, totals)
    return torch.from_numpy(totals.astype(np.float32))


def _view(
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near: float,
    sh_degree: int | None,
    antialiased: bool,
    crop: tuple[int, int, int, int],
) -> _View:
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    x0, y0, x1, y1 = crop
    column, row = x0 // TILE_W, y0 // TILE_H
    return _View(
        viewmat=np.array(viewmat.tolist()),
        intrinsics=np.array([fx, fy, cx, cy]),
        size=np.array([width, height], np.int64),
        window=np.array(crop, np.int64),
        grid=np.array([column, row, -(-x1 // TILE_W) - column, -(-y1 // TILE_H) - row], np.int64),
        near=float(near),
        degree=-1 if sh_degree is None else sh_degree,
        antialiased=antialiased,
    )


def _float32(tensor: Tensor) -> Tensor:
    return tensor.to("cpu", torch.float32).contiguous()


def _list_splats(
    view: _View, gaussians: list[Array], team: Team, for_gradients: bool
) -> tuple[_Lists, list[Array]]:
    """Project, sort and bin; also the centres, depths and visibility of all Gaussians."""
    means, quats, scales, opacities, colors = gaussians
    n = len(means)
    centres, depths, candidates = np.empty((n, 2), np.float32), np.empty(n, np.float32), np.empty(n, np.bool_)
    visible = np.zeros(n, np.bool_)
    tile_starts = np.empty(int(view.grid[2] * view.grid[3]) + 1, np.int64)
    found = [centres, depths, visible]
    if n <= FEW:
        ids, ranks, splats, rgb, per_splat, members, slots, total = few.list_few(
            means, quats, scales, opacities, colors, view.degree, view.viewmat, view.intrinsics, view.size,
            view.window, view.near, view.antialiased, view.grid, MOST_INTERSECTIONS, for_gradients, centres,
            depths, candidates, visible, tile_starts,
        )  # fmt: skip
        _check_intersections(len(ids), total)
        return _Lists(ids, ranks, splats, rgb, tile_starts, members, slots, per_splat), found
    team.share(
        projection.cull,
        means, scales, opacities, view.viewmat, view.intrinsics, view.size, view.window, view.near,
        centres, depths, candidates,
    )  # fmt: skip
    ids, ranks = order.depth_order(depths, candidates, team)
    splats, rgb = np.empty((len(ids), 8)), np.empty((len(ids), 4), np.float32)
    team.share(
        projection.project,
        ids, ranks, means, quats, scales, opacities, colors, view.degree, view.viewmat, view.intrinsics,
        view.size, view.window, view.antialiased, splats, rgb, visible,
    )  # fmt: skip
    counts = np.empty((team.workers, len(tile_starts) - 1), np.int64)
    per_splat = np.empty(len(ids) + 1, np.int64)
    tiles = at_once(
        partial(
            binning.find_tiles, splats, part, view.window, view.grid, MOST_INTERSECTIONS, counts, per_splat
        )
        for part in range(team.workers)
    )
    total = binning.place_tiles(counts, tile_starts, per_splat)
    _check_intersections(len(ids), total)
    members, slots = np.empty(total, np.int32), np.empty(total if for_gradients else 0, np.int64)
    at_once(
        partial(binning.fill_tiles, tiles[part], part, counts, per_splat, members, slots)
        for part in range(team.workers)
    )
    return _Lists(ids, ranks, splats, rgb, tile_starts, members, slots, per_splat), found


def _check_intersections(splats: int, total: int) -> None:
    if total > MOST_INTERSECTIONS:
        raise ProgdfError(
            f"{splats} Gaussians meet {total} tiles of the image, more than {MOST_INTERSECTIONS}; "
            "draw a smaller image or a crop, or take giant Gaussians out of the scene"
        )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, view: _View, grad_rows: Tensor | None, *tensors: Tensor) -> tuple[Tensor, ...]:
        arrays = [tensor.detach().numpy() for tensor in tensors[:6]]
        *gaussians, background = arrays
        if view.degree < 0:
            gaussians[4] = gaussians[4].reshape(-1, 1, 3)
        x0, y0, x1, y1 = view.window.tolist()
        image = np.empty((y1 - y0, x1 - x0, 3), np.float32)
        transmittance, last = np.empty(image.shape[:2], np.float32), np.empty(image.shape[:2], np.float32)
        with running("forward", 12) as workers:
            team = Team(workers)
            team.call()
            lists, found = _list_splats(view, gaussians, team, any(ctx.needs_input_grad))
            team.share(
                blend,
                lists.splats, lists.rgb, view.window, view.grid, lists.tile_starts, lists.members,
                background, image, transmittance, last,
            )  # fmt: skip
        results = tuple(torch.from_numpy(array) for array in (image, transmittance, *found))
        ctx.mark_non_differentiable(*results[2:])
        ctx.set_materialize_grads(False)
        ctx.view, ctx.grad_rows, ctx.lists, ctx.last = view, grad_rows, lists, last
        ctx.save_for_backward(*tensors, results[1])
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        team = Team(threads())
        team.call()
        view, lists = ctx.view, ctx.lists
        *tensors, saved_transmittance = ctx.saved_tensors
        *gaussians, background = [tensor.detach().numpy() for tensor in tensors[:6]]
        shapes = [array.shape for array in gaussians]
        if view.degree < 0:
            gaussians[4] = gaussians[4].reshape(-1, 1, 3)
        transmittance = saved_transmittance.numpy()
        grad_image = _array(grads[0], (*transmittance.shape, 3))
        grad_transmittance = _array(grads[1], transmittance.shape)
        sums = np.empty((len(lists.members), SUMS), np.float32)
        gradients = [np.zeros(array.shape, np.float32) for array in gaussians]
        means, quats, scales, opacities, colors = gaussians
        by_means, by_quats, by_scales, by_opacities, by_colors = gradients
        grad_camera = np.zeros((PARTS, CAMERA))
        wanted = _wanted_splats(lists, len(means), ctx.grad_rows)
        with running("backward", 5):
            team.share(
                backpropagate,
                lists.splats, lists.rgb, view.window, view.grid, lists.tile_starts, lists.members,
                lists.slots, background, transmittance, ctx.last, grad_image, grad_transmittance,
                sums, wanted,
                lists.ids, lists.ranks, means, quats, scales, opacities, colors, view.degree,
                view.viewmat, view.intrinsics, view.size, view.antialiased, lists.per_splat,
                by_means, by_quats, by_scales, by_opacities, by_colors, grad_camera,
            )  # fmt: skip
        results: list[Tensor | None] = [
            torch.from_numpy(array.reshape(shape)) for array, shape in zip(gradients, shapes, strict=True)
        ]
        needs = ctx.needs_input_grad[7:]
        results.append(_background_gradient(transmittance, grad_image) if needs[0] else None)
        results += _camera_gradients(grad_camera, *tensors[6:]) if any(needs[1:]) else (None, None)
        return None, None, *results


def _array(grad: Tensor | None, shape: tuple[int, ...]) -> Array:
    """A gradient; None is zero."""
    return np.zeros(shape, np.float32) if grad is None else np.ascontiguousarray(grad.numpy())


def _camera_gradients(parts: Array, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    camera = parts.sum(axis=0)
    by_viewmat, by_K = np.zeros((4, 4)), np.zeros((3, 3))
    by_viewmat[:3] = camera[:12].reshape(3, 4)
    by_K[0, 0], by_K[1, 1], by_K[0, 2], by_K[1, 2] = camera[12:]
    return torch.from_numpy(by_viewmat).to(viewmat), torch.from_numpy(by_K).to(K)


def _wanted_splats(lists: _Lists, count: int, grad_rows: Tensor | None) -> Array:
    """Which splats belong to the rows that want gradients. [V] bool"""
    wanted = np.ones(len(lists.ids), np.bool_)
    if grad_rows is not None:
        rows = np.zeros(count, np.bool_)
        rows[grad_rows.detach().cpu().numpy()] = True
        wanted[lists.ranks] = rows[lists.ids]
    return wanted


def _background_gradient(transmittance: Array, grad_image: Array) -> Tensor:
    per_channel = (grad_image * transmittance[..., None]).astype(np.float64).sum(axis=(0, 1))
    return torch.from_numpy(per_channel.astype(np.float32))
