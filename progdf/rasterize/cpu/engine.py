"""Fast engine: numba kernels behind one `torch.autograd.Function`, and color maps.

Projection is computed in float64 and pixels in float32, whatever the type of the inputs. Results are float32.
Image and gradients have the same bits in every run and for every number of threads.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.rasterize.engines import (
    FRUSTUM_MARGIN,
    ActivatedGaussians,
    RasterInfo,
    RasterView,
    check_intersections,
)
from progdf.threads import run_chunks, threads

from .backward import BLOCK, CAMERA, project_backward
from .backward import new_scratch as new_backward_scratch
from .blend import (
    SUMS,
    WEIGHT_SUMS,
    RenderBuffers,
    accumulate_weights,
    blend,
    blend_backward,
    new_scratch,
)  # fmt: skip
from .forward import (
    TILE_H,
    TILE_W,
    Pinhole,
    Scene,
    Splats,
    TileLists,
    bin_splats,
    depth_order,
    find_tiles,
    project,
    shade_rows,
)  # fmt: skip
from .jit import kernel
from .parts import PartBuffers, blend_part
from .weights import ListedWeights, ListSelection, Spans, join_spans, list_weights, new_spans, take_spans

Array = NDArray[Any]
_T = TypeVar("_T")

_MIN_TILES = 4  # tiles per chunk; fewer are not worth a call
_CHUNKS_PER_THREAD = 4  # more than 1, because tiles take unequal time
# Upper limits per chunk: a render that is cancelled stops between two chunks.
_MAX_TILES = 24
_MAX_GAUSSIANS = 32 * BLOCK
TILE_ROOM = 8  # tiles reserved per Gaussian; chunks that need more are listed a second time
ENTRY_ROOM = 16  # entries reserved per (Gaussian, tile) pair in a color map
_ALL_ROWS = np.empty(0, np.bool_)  # gradient mask that selects all rows


def rasterize(
    gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Draw an image, see `progdf.rasterize.render`."""
    inputs = [to_float32(tensor) for tensor in (*gaussians.tensors, background)]
    projected: list[Array] = []
    image, transmittance = _Rasterize.apply(  # type: ignore[no-untyped-call]
        make_pinhole(view), grad_rows, projected, *inputs, view.viewmat, view.K
    )
    return image, transmittance, RasterInfo(*map(torch.from_numpy, projected))


def rasterize_part(
    gaussians: ActivatedGaussians, view: RasterView, background: Tensor, rows: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Draw a view, and some Gaussians' part of it, without gradients and after one projection.

    Args:
        gaussians: the whole scene
        view: the camera
        background: rgb behind everything. [3]
        rows: the Gaussians of the part. [M] int64

    Returns:
        The image, with the bits of `rasterize`; the weight of the part, Σ αT over its Gaussians; and their
        contribution to the image, Σ αT·color. [H,W,3], [H,W], [H,W,3]
    """
    camera = make_pinhole(view)
    splats, lists = _project_scene(gaussians, camera)
    x0, y0, x1, y1 = camera.window
    image, share, part = (np.empty((y1 - y0, x1 - x0, *rest), np.float32) for rest in ((3,), (), (3,)))
    is_part = np.zeros(len(gaussians.means), np.bool_)
    is_part[rows.numpy()] = True
    out = PartBuffers(image, share, part)
    share_tiles(blend_part, camera, splats, lists, camera, to_float32(background).numpy(), is_part, out)
    return torch.from_numpy(image), torch.from_numpy(share), torch.from_numpy(part)


def rasterize_listed(
    gaussians: ActivatedGaussians, view: RasterView, background: Tensor, rows: Tensor,
    pixels: Tensor | None, lost: float,
) -> tuple[Tensor, Tensor, ListedWeights]:  # fmt: skip
    """Draw a view, without gradients, and list the weights of some Gaussians in it, after one projection.

    Returns:
        The image, with the bits of `rasterize`; the Gaussians visible in the window, see `RasterInfo`, [N]
        bool; and the map, see `progdf.rasterize.engines.color_map`.
    """
    camera = make_pinhole(view)
    splats, lists = _project_scene(gaussians, camera)
    out = _new_picture(camera, with_last=False)
    share_tiles(blend, camera, splats, lists, camera, to_float32(background).numpy(), out, out.last)
    listed = _list_view(splats, lists, camera, rows, pixels, lost)
    return torch.from_numpy(out.image), torch.from_numpy(splats.visible), listed


def draw_tiles(
    kernel: Any, gaussians: ActivatedGaussians, view: RasterView, background: Array
) -> RenderBuffers:
    """Project and bin Gaussians, and run another kernel than `blend` over the tiles, without gradients.

    Args:
        kernel: `kernel(begin, end, scratch, splats, lists, camera, background, out)`
        gaussians: the scene
        view: the camera
        background: rgb behind everything. [3] float32
    """
    camera = make_pinhole(view)
    splats, lists = _project_scene(gaussians, camera)
    out = _new_picture(camera, with_last=False)
    share_tiles(kernel, camera, splats, lists, camera, background, out)
    return out


def make_pinhole(view: RasterView) -> Pinhole:
    """Convert a view to the kernels' form."""
    rotation = view.viewmat.tolist()
    (fx, _, cx), (_, fy, cy), _ = view.K.tolist()
    x0, y0, x1, y1 = view.crop
    column = x0 // TILE_W
    row = y0 // TILE_H
    # Clamp like the original (Kerbl 2023, computeCov2D): off-screen Gaussians would blow up the Jacobian.
    # The limits are gsplat's.
    margin_x = FRUSTUM_MARGIN * 0.5 * view.width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * view.height / fy
    return Pinhole(
        rows=(tuple(rotation[0][:3]), tuple(rotation[1][:3]), tuple(rotation[2][:3])),
        shift=(rotation[0][3], rotation[1][3], rotation[2][3]),
        fx=fx, fy=fy, cx=cx, cy=cy,
        limits_x=(-(cx / fx + margin_x), (view.width - cx) / fx + margin_x),
        limits_y=(-(cy / fy + margin_y), (view.height - cy) / fy + margin_y),
        near=float(view.near),
        window=(x0, y0, x1, y1),
        grid=(column, row, -(-x1 // TILE_W) - column, -(-y1 // TILE_H) - row),
        degree=-1 if view.sh_degree is None else view.sh_degree,
        antialiased=view.antialiased,
        dilation=view.dilation,
    )  # fmt: skip


def to_float32(tensor: Tensor) -> Tensor:
    """Convert a tensor to contiguous float32 on the CPU, as the kernels require."""
    return tensor.to("cpu", torch.float32).contiguous()


def shade_view(gaussians: Gaussians, camera: Camera) -> Tensor:
    """Return each Gaussian's color from a camera, at least 0, with the bits that `rasterize` draws. [N,3]

    `progdf.sh.shade` is the plain version, which takes a copy of all coefficients and several of their size.
    """
    means = to_float32(gaussians.means).detach().numpy()
    sh0 = to_float32(gaussians.sh0).detach().numpy()
    shN = to_float32(gaussians.shN).detach().numpy()
    window = (0, 0, camera.width, camera.height)
    degree = min(gaussians.sh_degree, 3)
    pinhole = make_pinhole(
        RasterView(camera.viewmat, camera.K, camera.width, camera.height, window, sh_degree=degree)
    )
    colors = np.empty((len(gaussians), 3), np.float32)
    share_gaussians(
        lambda begin, end: shade_rows(begin, end, means, sh0, shN, pinhole, np.empty(16), colors), len(colors)
    )
    return torch.from_numpy(colors)


def bin_view(gaussians: ActivatedGaussians, camera: Pinhole) -> tuple[Splats, TileLists]:
    """Return the splats and tile lists of a view without drawing it. Colors are not read."""
    arrays = [to_float32(tensor).detach().numpy() for tensor in gaussians[:4]]
    arrays.append(np.zeros((len(gaussians.means), 1, 3), np.float32))
    return _project_and_bin(Scene(*arrays), camera._replace(degree=-1), with_slots=True)


def _project_scene(gaussians: ActivatedGaussians, camera: Pinhole) -> tuple[Splats, TileLists]:
    """Return the splats of a scene, with colors, and the tile lists."""
    arrays = [to_float32(tensor).detach().numpy() for tensor in gaussians.tensors]
    if camera.degree < 0:
        arrays[4] = arrays[4].reshape(-1, 1, 3)
    return _project_and_bin(Scene(*arrays), camera, with_slots=False)


def share_tiles(kernel: Any, camera: Pinhole, *arguments: Any) -> None:
    """Run `kernel(begin, end, scratch, *arguments)` over ranges that contain every tile once."""
    tiles = camera.grid[2] * camera.grid[3]
    _share(lambda begin, end: kernel(begin, end, new_scratch(), *arguments), tiles, _MIN_TILES, _MAX_TILES)


def share_gaussians(kernel: Callable[[int, int], _T], count: int) -> list[_T]:
    """Run `kernel(begin, end)` over ranges that contain every Gaussian once; return the results in order."""
    return _share(kernel, count, BLOCK, _MAX_GAUSSIANS)


def _share(kernel: Callable[[int, int], _T], count: int, block: int, most: int) -> list[_T]:
    """Run `kernel(begin, end)` over `count` items in ranges of whole blocks, at most `most` items each."""
    blocks = max(1, -(-count // block))
    min_chunks = _CHUNKS_PER_THREAD * threads() if threads() > 1 else 1
    chunks = min(blocks, max(min_chunks, count // most))
    cuts = [min(count, blocks * chunk // chunks * block) for chunk in range(chunks + 1)]
    return run_chunks(lambda chunk: kernel(cuts[chunk], cuts[chunk + 1]), chunks)


@cache
def _keep_freed_memory() -> None:
    """Allocate and free one large block once, so that glibc keeps freed blocks of up to this size for reuse.

    Otherwise every pass returns its memory to the system and takes it again page by page, which is a fifth of
    the time at 20 000 Gaussians. The block is never touched, so it costs nothing on any platform.
    """
    np.empty((32 << 20) - (64 << 10), np.uint8)


def _project_and_bin(scene: Scene, camera: Pinhole, with_slots: bool) -> tuple[Splats, TileLists]:
    _keep_freed_memory()
    n = len(scene.means)
    splats = Splats(
        np.empty((n, 2), np.float32), np.empty(n, np.float32), np.empty(n, np.bool_), np.empty((n, 8)),
        np.empty((n, 4), np.float32),
    )  # fmt: skip
    counts = np.empty(n, np.int32)

    def find(begin: int, end: int, room: int) -> Array:
        tiles = np.empty(room, np.int32)
        return tiles[: find_tiles(begin, end, splats, camera, tiles, counts)]

    def project_and_find(begin: int, end: int) -> Array:
        project(begin, end, scene, camera, splats, np.empty(16))
        return find(begin, end, TILE_ROOM * (end - begin))

    tiles = np.concatenate(share_gaussians(project_and_find, n))
    total = int(counts.sum(dtype=np.int64))
    check_intersections(int(splats.visible.sum()), total)
    if len(tiles) < total:  # some chunk had too little room
        again = share_gaussians(lambda begin, end: find(begin, end, int(counts[begin:end].sum())), n)
        tiles = np.concatenate(again)
    order = depth_order(splats.depths, splats.visible)
    return splats, bin_splats(order, tiles, counts, camera.grid[2] * camera.grid[3], with_slots)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, camera: Pinhole, grad_rows: Tensor | None, projected: list[Array], *tensors: Tensor
    ) -> tuple[Tensor, Tensor]:
        *arrays, background = (tensor.numpy(force=True) for tensor in tensors[:6])
        if camera.degree < 0:
            arrays[4] = arrays[4].reshape(-1, 1, 3)
        scene = Scene(*arrays)
        with_gradient = any(ctx.needs_input_grad)
        out = _new_picture(camera, with_gradient)
        splats, lists = _project_and_bin(scene, camera, with_gradient)
        share_tiles(blend, camera, splats, lists, camera, background, out, out.last)
        projected[:] = splats.means2d, splats.depths, splats.visible
        ctx.forward_pass = camera, grad_rows, scene, background, splats, lists, out
        results = torch.from_numpy(out.image), torch.from_numpy(out.transmittance)
        ctx.save_for_backward(*tensors, results[1])
        return results

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        camera, grad_rows, scene, background, splats, lists, out = ctx.forward_pass
        viewmat, K = ctx.saved_tensors[6:8]  # this also checks that none of them has been changed since
        by_image, by_transmittance = (np.ascontiguousarray(grad.numpy()) for grad in grads)
        by_out = RenderBuffers(by_image, by_transmittance, out.last)
        grad_mask = _ALL_ROWS
        if grad_rows is not None:
            grad_mask = np.bincount(grad_rows.numpy(force=True), minlength=len(scene.means)) > 0
        gradients = Scene(*(np.empty(array.shape, np.float32) for array in scene))
        sums = np.empty((len(lists.members), SUMS), np.float32)

        by_camera = np.zeros((-(-len(scene.means) // BLOCK), CAMERA))

        def backward_chunk(begin: int, end: int) -> None:
            project_backward(
                begin, end, scene, camera, lists.offsets, sums, grad_mask, gradients, by_camera,
                new_backward_scratch(),
            )  # fmt: skip

        share_tiles(blend_backward, camera, splats, lists, camera, background, out, by_out, grad_mask, sums)
        share_gaussians(backward_chunk, len(scene.means))
        results: list[Tensor | None] = [torch.from_numpy(array) for array in gradients]
        if camera.degree < 0:
            results[4] = torch.from_numpy(gradients.colors.reshape(-1, 3))
        by_background, by_viewmat, by_K = ctx.needs_input_grad[8:]
        through = partial(np.einsum, "hwc,hw->c", by_image, out.transmittance, dtype=np.float64)
        results.append(torch.from_numpy(through().astype(np.float32)) if by_background else None)
        results += _camera_gradients(by_camera, viewmat, K) if by_viewmat or by_K else (None, None)
        return None, None, None, *results


def _new_picture(camera: Pinhole, with_last: bool) -> RenderBuffers:
    x0, y0, x1, y1 = camera.window
    size = y1 - y0, x1 - x0
    last = np.empty(size, np.float32) if with_last else None
    return RenderBuffers(np.empty((*size, 3), np.float32), np.empty(size, np.float32), last)


def _camera_gradients(parts: Array, viewmat: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    camera = parts.sum(axis=0)
    by_viewmat = np.zeros((4, 4))
    by_K = np.zeros((3, 3))
    by_viewmat[:3] = camera[:12].reshape(3, 4)
    by_K[0, 0], by_K[1, 1], by_K[0, 2], by_K[1, 2] = camera[12:]
    return torch.from_numpy(by_viewmat).to(viewmat), torch.from_numpy(by_K).to(K)


def alpha_weights(gaussians: ActivatedGaussians, view: RasterView, mask: Tensor) -> Tensor:
    """Sum blending weights, see `progdf.rasterize.alpha_weights`."""
    camera = make_pinhole(view)
    splats, lists = bin_view(gaussians, camera)
    sums = np.zeros((len(lists.members), WEIGHT_SUMS))
    inside = to_float32(mask).numpy()
    share_tiles(accumulate_weights, camera, splats, lists, camera, inside, sums)
    totals = np.zeros((len(gaussians.means), WEIGHT_SUMS))
    sum_slots(lists.offsets, sums, totals)
    return torch.from_numpy(totals.astype(np.float32))


def color_map(
    gaussians: ActivatedGaussians, view: RasterView, rows: Tensor, pixels: Tensor | None, lost: float
) -> ListedWeights:
    """Return a color map, see `progdf.rasterize.engines.color_map`."""
    pinhole = make_pinhole(view)
    splats, lists = bin_view(gaussians, pinhole)
    return _list_view(splats, lists, pinhole, rows, pixels, lost)


def _list_view(
    splats: Splats, lists: TileLists, pinhole: Pinhole, rows: Tensor, pixels: Tensor | None, lost: float
) -> ListedWeights:
    """Return the color map of a projected view, see `progdf.rasterize.engines.color_map`."""
    x0, y0, x1, y1 = pinhole.window
    window = (y1 - y0) * (x1 - x0)
    chosen = np.arange(window) if pixels is None else pixels.numpy()
    positions = np.full(window, -1, np.int32)
    positions[chosen] = np.arange(len(chosen), dtype=np.int32)
    row_of = np.full(len(splats.visible), -1, np.int32)
    row_of[rows.numpy()] = np.arange(len(rows), dtype=np.int32)
    listed = ListSelection(row_of, positions, np.float32(lost))

    def list_tiles(begin: int, end: int) -> Spans:
        pairs = int(lists.starts[end] - lists.starts[begin])
        room = -1
        entry = ENTRY_ROOM * pairs
        while entry > room:
            room = entry
            out = new_spans(end - begin, pairs, entry)
            span, entry = list_weights(begin, end, new_scratch(), splats, lists, pinhole, listed, out)
        return take_spans(out, span, entry, is_exact=lost == 0.0)

    spans = join_spans(_share(list_tiles, len(lists.starts) - 1, _MIN_TILES, _MAX_TILES))
    size = (y1 - y0, x1 - x0) if pixels is None else (len(pixels),)
    return ListedWeights(len(rows), size, spans)


@kernel(cache=True)
def sum_slots(offsets: Array, sums: Array, totals: Array) -> None:
    """Sum each Gaussian's intersections in their fixed order. totals: out, [N,4] float64, zero on entry"""
    for i in range(totals.shape[0]):
        for slot in range(offsets[i], offsets[i + 1]):
            for k in range(WEIGHT_SUMS):
                totals[i, k] += sums[slot, k]
