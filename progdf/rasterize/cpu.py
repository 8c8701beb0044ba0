"""The fast engine: numba kernels behind one `torch.autograd.Function`.

Projection is computed in float64, pixels in float32, whatever the type of the inputs; results are float32.
The picture and the gradients are the same bits in every run and for every number of threads.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.errors import ProgdfError

from . import weights
from .backward import backpropagate
from .binning import TILE_H, TILE_W
from .blend_backward import SUMS
from .conventions import RasterInfo
from .forward import draw, list_splats, list_tiles
from .jit import running
from .order import new_sorting
from .projection_backward import CAMERA, PARTS
from .shares import Team
from .threads import threads

Array = NDArray[Any]

MOST_INTERSECTIONS = 100_000_000
"""(Gaussian, tile) pairs beyond which a view is refused: 1.2 GB forward, 3.6 GB more backward."""


_ALL = np.empty(0, np.bool_)
_TILES_WORTH_A_THREAD = 8
_ROOM = 8  # tiles of a splat that there is room for at once; a scene with more is gone through twice


class _View(NamedTuple):
    """The camera as the kernels want it."""

    viewmat: Array
    intrinsics: Array
    size: Array
    window: Array
    grid: Array
    tiles: int
    near: float
    degree: int
    antialiased: bool


class _Lists(NamedTuple):
    """What a forward pass found out and the backward pass needs; layouts: `projection` and `binning`."""

    ids: Array
    ranks: Array
    splats: Array
    rgb: Array
    tile_starts: Array
    members: Array
    slots: Array
    per_splat: Array


class _Unplaced(NamedTuple):
    """Tiles splat by splat, see `binning.find_tiles`; of no use once the lists are filled."""

    places: Array
    tiles: Array


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
    view = make_view(viewmat, K, width, height, near, sh_degree, antialiased, crop)
    inputs = [float32(t) for t in (means, quats, scales, opacities, colors, background)]
    found: list[Array] = []
    drawn = _Rasterize.apply(view, grad_rows, found, *inputs, viewmat, K)  # type: ignore[no-untyped-call]
    image, transmittance = drawn
    return image, transmittance, RasterInfo(*map(torch.from_numpy, found))


def alpha_weights(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    viewmat: Tensor,
    K: Tensor,
    mask: Tensor,
    near: float,
    antialiased: bool,
) -> Tensor:
    """See `progdf.rasterize.alpha_weights`; activated units."""
    height, width = mask.shape
    view = make_view(viewmat, K, width, height, near, None, antialiased, (0, 0, width, height))
    gaussians = [float32(tensor).detach().numpy() for tensor in (means, quats, scales, opacities)]
    gaussians.append(np.zeros((len(means), 1, 3), np.float32))
    totals = np.zeros((len(means), weights.SUMS))
    with running("weights", 2) as workers:
        team, lists = list_view(view, gaussians, workers, 1)
        sums = np.zeros((len(lists.members), weights.SUMS))
        team.share(
            weights.weigh,
            lists.splats, lists.rgb, view.window, view.grid, lists.tile_starts, lists.members, lists.slots,
            float32(mask).numpy(), sums,
        )  # fmt: skip
        weights.gather(lists.ids, lists.ranks, lists.per_splat, sums, totals)
    return torch.from_numpy(totals.astype(np.float32))


def _keep_freed_memory() -> None:
    """Free one large block: from then on glibc keeps blocks up to this size, the largest that it ever keeps.

    Otherwise every pass would hand its memory back to the system and take it anew page by page, which was a
    fifth of the time of 20 000 Gaussians. Nothing touches the block, so it costs nothing, there or elsewhere.
    """
    np.empty((32 << 20) - (64 << 10), np.uint8)


_keep_freed_memory()


def _team(view: _View, workers: int, launches: int) -> Team:
    return Team(min(workers, 1 + view.tiles // _TILES_WORTH_A_THREAD), launches)


def make_view(
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    near: float,
    sh_degree: int | None,
    antialiased: bool,
    crop: tuple[int, int, int, int],
) -> _View:
    """The camera as the kernels want it; see `progdf.rasterize.rasterize`."""
    (fx, _, cx), (_, fy, cy), _ = K.tolist()
    x0, y0, x1, y1 = crop
    column, row = x0 // TILE_W, y0 // TILE_H
    columns, rows = -(-x1 // TILE_W) - column, -(-y1 // TILE_H) - row
    whole = np.array([width, height, *crop, column, row, columns, rows], np.int64)
    return _View(
        viewmat=np.array(viewmat.tolist()),
        intrinsics=np.array([fx, fy, cx, cy]),
        size=whole[:2],
        window=whole[2:6],
        grid=whole[6:],
        tiles=columns * rows,
        near=float(near),
        degree=-1 if sh_degree is None else sh_degree,
        antialiased=antialiased,
    )


def float32(tensor: Tensor) -> Tensor:
    """As the kernels want it."""
    if tensor.dtype is torch.float32 and tensor.is_cpu and tensor.is_contiguous():
        return tensor
    return tensor.to("cpu", torch.float32).contiguous()


def list_view(view: _View, gaussians: list[Array], workers: int, launches: int) -> tuple[Team, _Lists]:
    """The tiles' lists without a picture, and the threads that made them, for so many launches more."""
    team = _team(view, workers, 2 + launches)
    lists, unplaced, _ = _list_splats(view, gaussians, team, for_gradients=True)
    team.share(
        list_tiles,
        lists.splats, view.window, view.grid, unplaced.places, lists.per_splat, unplaced.tiles,
        lists.members, lists.slots,
    )  # fmt: skip
    return team, lists


def _list_splats(
    view: _View, gaussians: list[Array], team: Team, for_gradients: bool
) -> tuple[_Lists, _Unplaced, list[Array]]:
    """Project and sort, and count the tiles; also the centres, depths and visibility of all Gaussians."""
    n, tiles = len(gaussians[0]), view.tiles
    centres, depths, candidates = np.empty((n, 2), np.float32), np.empty(n, np.float32), np.empty(n, np.bool_)
    visible = np.zeros(n, np.bool_)
    ids, ranks, per_splat = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n + 1, np.int64)
    splats, rgb = np.empty((n, 8)), np.empty((n, 4), np.float32)
    places, tile_starts = np.empty((team.workers, tiles), np.int64), np.empty(tiles + 1, np.int64)
    listed = np.empty((team.workers, _ROOM * n // team.workers + _ROOM), np.int32)
    found = np.empty(2, np.int64)
    team.share(
        list_splats,
        *gaussians, view.degree, view.viewmat, view.intrinsics, view.size, view.window, view.near,
        view.antialiased, view.grid, MOST_INTERSECTIONS, centres, depths, candidates, visible,
        new_sorting(n, team.workers), ids, ranks, splats, rgb, places, per_splat, listed, tile_starts, found,
    )  # fmt: skip
    count, total = found.tolist()
    if total > MOST_INTERSECTIONS:
        raise ProgdfError(
            f"{count} Gaussians meet {total} tiles of the image, more than {MOST_INTERSECTIONS}; "
            "draw a smaller image or a crop, or take giant Gaussians out of the scene"
        )
    members, slots = np.empty(total, np.int32), np.empty(total if for_gradients else 0, np.int64)
    ids, ranks, splats, rgb = ids[:count], ranks[:count], splats[:count], rgb[:count]
    lists = _Lists(ids, ranks, splats, rgb, tile_starts, members, slots, per_splat[: count + 1])
    return lists, _Unplaced(places, listed), [centres, depths, visible]


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, view: _View, grad_rows: Tensor | None, found: list[Array], *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        *gaussians, background = (tensor.numpy(force=True) for tensor in tensors[:6])
        if view.degree < 0:
            gaussians[4] = gaussians[4].reshape(-1, 1, 3)
        x0, y0, x1, y1 = view.window.tolist()
        image = np.empty((y1 - y0, x1 - x0, 3), np.float32)
        transmittance, last = np.empty(image.shape[:2], np.float32), np.empty(image.shape[:2], np.float32)
        with running("forward", 12) as workers:
            team = _team(view, workers, 2)
            lists, unplaced, found[:] = _list_splats(view, gaussians, team, any(ctx.needs_input_grad))
            team.share(
                draw,
                lists.splats, lists.rgb, view.window, view.grid, unplaced.places, lists.per_splat,
                unplaced.tiles, lists.tile_starts, lists.members, lists.slots, background, image,
                transmittance, last,
            )  # fmt: skip
        ctx.set_materialize_grads(False)
        ctx.kept = view, grad_rows, gaussians, background, lists, transmittance, last
        results = torch.from_numpy(image), torch.from_numpy(transmittance)
        ctx.save_for_backward(*tensors, results[1])
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        view, grad_rows, gaussians, background, lists, transmittance, last = ctx.kept
        team = _team(view, threads(), 1)
        viewmat, K = ctx.saved_tensors[6:8]  # and that none of them has been changed since is checked
        grad_image = _array(grads[0], (*transmittance.shape, 3))
        grad_transmittance = _array(grads[1], transmittance.shape)
        sums = np.empty((len(lists.members), SUMS), np.float32)
        gradients = [np.empty(array.shape, np.float32) for array in gaussians]
        means, quats, scales, opacities, colors = gaussians
        by_means, by_quats, by_scales, by_opacities, by_colors = gradients
        grad_camera = np.zeros((PARTS, CAMERA))
        wanted = _wanted_splats(lists, len(means), grad_rows)
        with running("backward", 5):
            team.share(
                backpropagate,
                lists.splats, lists.rgb, view.window, view.grid, lists.tile_starts, lists.members,
                lists.slots, background, transmittance, last, grad_image, grad_transmittance,
                sums, wanted,
                lists.ids, lists.ranks, means, quats, scales, opacities, colors, view.degree,
                view.viewmat, view.intrinsics, view.size, view.antialiased, lists.per_splat,
                by_means, by_quats, by_scales, by_opacities, by_colors, grad_camera,
            )  # fmt: skip
        if view.degree < 0:
            gradients[4] = by_colors.reshape(-1, 3)
        results: list[Tensor | None] = [torch.from_numpy(array) for array in gradients]
        by_background, by_viewmat, by_K = ctx.needs_input_grad[8:]
        results.append(_background_gradient(transmittance, grad_image) if by_background else None)
        results += _camera_gradients(grad_camera, viewmat, K) if by_viewmat or by_K else (None, None)
        return None, None, None, *results


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
    """Which splats belong to the rows that want gradients; [0] where all do. [V] bool"""
    if grad_rows is None:
        return _ALL
    rows, wanted = np.zeros(count, np.bool_), np.empty(len(lists.ids), np.bool_)
    rows[grad_rows.numpy(force=True)] = True
    wanted[lists.ranks] = rows[lists.ids]
    return wanted


def _background_gradient(transmittance: Array, grad_image: Array) -> Tensor:
    per_channel = (grad_image * transmittance[..., None]).astype(np.float64).sum(axis=(0, 1))
    return torch.from_numpy(per_channel.astype(np.float32))
