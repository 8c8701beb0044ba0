"""Engine for CUDA devices: Warp kernels, which need no compiler. On a CPU it is slow and only used for tests.

The projection is the reference's and tile lists are computed by torch. Three kernels blend, differentiate and
sum.

Decisions (offsets from a center, alpha ≥ 1/255) use float64, pixels use float32. A tile is a block of
threads. The backward pass sums a splat's gradients within the block and writes one row for each (splat, tile)
intersection, with the same moments as the cpu engine. No two blocks add to one number, so the bits are the
same in every run on the same device.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from progdf.errors import ProgdfError
from progdf.system.equality import equal_fields
from progdf.system.packages import install_extra

from .cpu.jit import find_cache_folder
from .engines import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    ActivatedGaussians,
    ColorMap,
    Crop,
    RasterInfo,
    RasterView,
    check_intersections,
)
from .reference import DrawnColors, ReferenceSplats, of_rows, project
from .sparse import SortedEntries, SparseWeights, sparse_weights

try:
    import warp as wp
except ImportError as error:
    raise ProgdfError(f"the warp engine needs warp-lang; {install_extra('gpu')}") from error

TILE = 16
"""Side of a tile, pixels."""

PIXELS = wp.constant(TILE * TILE)
ALPHA_LIMIT = wp.constant(ALPHA_MAX)
TRANSMITTANCE_LIMIT = wp.constant(TRANSMITTANCE_MIN)

SUMS = 9
"""Length of one intersection's row in the backward pass.

Gradient of the color (3), and with g = alpha · dL/dalpha: Σg, Σg·u, Σg·v, Σg·u², Σg·uv, Σg·v².
"""

_BOX_MARGIN_PX = 0.01  # margin of a box around the support, above float32's error on any screen
_Sums = wp.types.vector(length=SUMS, dtype=wp.float32)
_Shape = wp.types.vector(length=6, dtype=wp.float64)
_launching = threading.Lock()
_function: Callable[[Any], Any] = wp.func
_kernel: Callable[[Any], Any] = wp.kernel

wp.set_module_options({"enable_backward": False})


@cache
def _start() -> None:
    """Start Warp without log output. Compiled kernels are stored beside the cpu engine's."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    configured = wp.config.kernel_cache_dir or os.environ.get("WARP_CACHE_PATH")
    wp.config.kernel_cache_dir = configured or str(find_cache_folder() / "warp")
    wp.init()


@_function
def pixel_of(thread: int, window: wp.vec4i) -> wp.vec3i:
    """Return a thread's pixel: column and row in the full image, and index in the window, −1 if outside.

    Blocks of threads are the tiles of the window, in row-major order.
    """
    left = window[0] // TILE
    top = window[1] // TILE
    columns = (window[2] + TILE - 1) // TILE - left
    tile = thread // PIXELS
    place = thread % PIXELS
    x = (left + tile % columns) * TILE + place % TILE
    y = (top + tile // columns) * TILE + place // TILE
    if x < window[0] or y < window[1] or x >= window[2] or y >= window[3]:
        return wp.vec3i(x, y, -1)
    return wp.vec3i(x, y, (y - window[1]) * (window[2] - window[0]) + x - window[0])


@_function
def alpha_at(pixel: wp.vec3i, box: wp.vec4, shape: Any, opacity: float) -> wp.vec3:
    """Return alpha before the clamp, 0 below 1/255, and u and v, the whitened offset."""
    x = float(pixel[0]) + 0.5
    y = float(pixel[1]) + 0.5
    if x < box[0] or y < box[1] or x > box[2] or y > box[3]:  # in float32; most pairs end here
        return wp.vec3(0.0)
    dx = wp.float64(x) - shape[0]
    dy = wp.float64(y) - shape[1]
    u = shape[2] * dx + shape[3] * dy
    v = shape[4] * dy
    squared = u * u + v * v
    if squared > shape[5]:
        return wp.vec3(0.0)
    return wp.vec3(opacity * wp.exp(-0.5 * float(squared)), float(u), float(v))


@_kernel
def blend_kernel(
    window: wp.vec4i, starts: wp.array[int], members: wp.array[int], boxes: wp.array[wp.vec4],
    shapes: wp.array[_Shape], colors: wp.array[wp.vec4], image: wp.array[wp.vec3],
    transmittance: wp.array[float], last: wp.array[int], deepest: wp.array[int],
) -> None:  # fmt: skip
    """Blend front to back, on black.

    Args:
        last: out, index in `members` of a pixel's last contributor, −1 if none. [h·w]
        deepest: out, largest `last` of a tile, −1 on entry. [T]
    """
    thread = wp.tid()
    pixel = pixel_of(thread, window)
    p = pixel[2]
    if p < 0:
        return
    tile = thread // PIXELS
    rgb = wp.vec3(0.0)
    through = float(1.0)
    final = int(-1)
    for index in range(starts[tile], starts[tile + 1]):
        s = members[index]
        color = colors[s]
        alpha = wp.min(alpha_at(pixel, boxes[s], shapes[s], color[3])[0], ALPHA_LIMIT)
        if alpha > 0.0:
            after = through * (1.0 - alpha)
            if after <= TRANSMITTANCE_LIMIT:
                break
            rgb += (alpha * through) * wp.vec3(color[0], color[1], color[2])
            through = after
            final = index
    image[p] = rgb
    transmittance[p] = through
    last[p] = final
    wp.atomic_max(deepest, tile, final)


@_kernel
def blend_backward_kernel(
    window: wp.vec4i, starts: wp.array[int], members: wp.array[int], boxes: wp.array[wp.vec4],
    shapes: wp.array[_Shape], colors: wp.array[wp.vec4], transmittance: wp.array[float],
    last: wp.array[int], deepest: wp.array[int], slots: wp.array[int], by_image: wp.array[wp.vec3],
    by_transmittance: wp.array[float], sums: wp.array[_Sums],
) -> None:  # fmt: skip
    """Compute the gradients, back to front.

    Args:
        slots: row of `sums` for each of `members`, −1 if it needs no gradient
    """
    thread = wp.tid()
    pixel = pixel_of(thread, window)
    p = pixel[2]
    tile = thread // PIXELS
    g = wp.vec3(0.0)
    through = float(1.0)
    behind = float(0.0)
    final = int(-1)
    if p >= 0:
        g = by_image[p]
        through = transmittance[p]
        final = last[p]
        behind = through * by_transmittance[p]
    bottom = deepest[tile]
    for step in range(bottom + 1 - starts[tile]):
        index = bottom - step
        s = members[index]
        slot = slots[index]
        row = _Sums()
        if index <= final:
            color = colors[s]
            seen = alpha_at(pixel, boxes[s], shapes[s], color[3])
            if seen[0] > 0.0:
                alpha = wp.min(seen[0], ALPHA_LIMIT)
                inverse = 1.0 / (1.0 - alpha)
                front = color[0] * g[0] + color[1] * g[1] + color[2] * g[2]
                through *= inverse
                weight = alpha * through
                by_alpha = alpha * (through * front - behind * inverse)
                if seen[0] > ALPHA_LIMIT:
                    by_alpha = float(0.0)
                behind += weight * front
                first = wp.vec3(1.0, seen[1], seen[2])
                second = wp.vec3(seen[1] * seen[1], seen[1] * seen[2], seen[2] * seen[2])
                for k in range(3):
                    row[k] = weight * g[k]
                    row[3 + k] = by_alpha * first[k]
                    row[6 + k] = by_alpha * second[k]
        if slot >= 0:  # uniform within the block, which sums cooperatively
            wp.tile_atomic_add(sums, wp.tile_sum(wp.tile(row, preserve_type=True)), offset=slot)


@_kernel
def add_weights_kernel(
    window: wp.vec4i, starts: wp.array[int], members: wp.array[int], boxes: wp.array[wp.vec4],
    shapes: wp.array[_Shape], colors: wp.array[wp.vec4], last: wp.array[int], deepest: wp.array[int],
    slots: wp.array[int], mask: wp.array[float], sums: wp.array[wp.vec4],
) -> None:  # fmt: skip
    """Sum w·m, m, w and 1 of every intersection; w = αT."""
    thread = wp.tid()
    pixel = pixel_of(thread, window)
    p = pixel[2]
    tile = thread // PIXELS
    inside = float(0.0)
    through = float(1.0)
    final = int(-1)
    if p >= 0:
        inside = mask[p]
        final = last[p]
    for index in range(starts[tile], deepest[tile] + 1):
        s = members[index]
        row = wp.vec4(0.0)
        if index <= final:
            alpha = wp.min(alpha_at(pixel, boxes[s], shapes[s], colors[s][3])[0], ALPHA_LIMIT)
            if alpha > 0.0:
                weight = alpha * through
                through *= 1.0 - alpha
                row = wp.vec4(weight * inside, inside, weight, 1.0)
        wp.tile_atomic_add(sums, wp.tile_sum(wp.tile(row, preserve_type=True)), offset=slots[index])


@_kernel
def list_weights_kernel(
    window: wp.vec4i, starts: wp.array[int], members: wp.array[int], boxes: wp.array[wp.vec4],
    shapes: wp.array[_Shape], colors: wp.array[wp.vec4], listed: wp.array[int], places: wp.array[int],
    lost: float, offsets: wp.array[wp.int64], counts: wp.array[wp.int64], rows: wp.array[int],
    weights: wp.array[float],
) -> None:  # fmt: skip
    """List the weights of every selected pixel, nearest first. Without room for them, count them.

    Args:
        listed: index of each splat in the lists, −1: not listed. [V]
        places: index of each pixel of the window, −1: not selected. [h·w]
        lost: total weight of a pixel that may be omitted
        offsets: first entry of each selected pixel. [P], or [0] to count only
        counts: out, number of entries of each selected pixel. [P]
        rows: out, index of each entry's splat. [E]
        weights: out, αT of each entry. [E]
    """
    thread = wp.tid()
    pixel = pixel_of(thread, window)
    if pixel[2] < 0:
        return
    place = places[pixel[2]]
    if place < 0:
        return
    has_room = offsets.shape[0] > 0
    first = wp.int64(0)
    if has_room:
        first = offsets[place]
    tile = thread // PIXELS
    through = float(1.0)
    spare = float(lost)  # weight that may still be omitted
    count = wp.int64(0)
    for index in range(starts[tile], starts[tile + 1]):
        if through <= spare:
            break
        s = members[index]
        alpha = wp.min(alpha_at(pixel, boxes[s], shapes[s], colors[s][3])[0], ALPHA_LIMIT)
        if alpha > 0.0:
            after = through * (1.0 - alpha)
            if after <= TRANSMITTANCE_LIMIT:
                break
            weight = alpha * through
            through = after
            row = listed[s]
            if row >= 0:
                if 8.0 * weight <= spare:  # at most an eighth of the remaining allowance
                    spare -= weight
                else:
                    if has_room:
                        rows[int(first + count)] = row
                        weights[int(first + count)] = weight
                    count += wp.int64(1)
    counts[place] = count


@dataclass(frozen=True)
class DeviceTileLists:
    """Splats of a window's tiles, nearest first. Tiles are aligned to the full image, in row-major order."""

    __eq__ = equal_fields

    starts: Tensor  # first index of each tile in `members`, then their number. [T+1] int32
    members: Tensor  # rows of the splats. [I] int32
    slots: Tensor  # index of each member in an order splat by splat. [I] int64
    counts: Tensor  # number of tiles of each splat. [V] int64


def list_tiles(splats: ReferenceSplats, crop: Crop) -> DeviceTileLists:
    """Sort the splats into the tiles that their boxes touch."""
    x0, y0, x1, y1 = crop
    left = x0 // TILE
    top = y0 // TILE
    columns = -(-x1 // TILE) - left
    rows = -(-y1 // TILE) - top
    means2d = splats.means2d.detach()
    extents = splats.extents
    window = means2d.new_tensor([[x0, y0], [x1 - 1, y1 - 1]])
    # pixels whose centers are inside the boxes
    first = (means2d - extents - 0.5 - 1e-6).ceil().maximum(window[0])
    final = (means2d + extents - 0.5 + 1e-6).floor().minimum(window[1])
    low, high = (edge.div(TILE, rounding_mode="floor").long() for edge in (first, final))
    sides = torch.where((first <= final).all(dim=1, keepdim=True), high - low + 1, 0)
    counts = sides.prod(dim=1)
    total = int(counts.sum())
    check_intersections(len(counts), total)
    owners = torch.arange(len(counts), device=counts.device).repeat_interleave(counts, output_size=total)
    at = torch.arange(total, device=counts.device) - (counts.cumsum(0) - counts)[owners]
    wide = sides[owners, 0]
    column = low[owners, 0] + at % wide - left
    row = low[owners, 1] + at // wide - top
    tiles, slots = (row * columns + column).int().sort(stable=True)
    starts = pad(torch.bincount(tiles, minlength=columns * rows).cumsum(0), (1, 0))
    return DeviceTileLists(starts.int(), owners[slots].int(), slots, counts)


def rasterize(
    gaussians: ActivatedGaussians, view: RasterView, background: Tensor, grad_rows: Tensor | None
) -> tuple[Tensor, Tensor, RasterInfo]:
    """Draw an image, see `progdf.rasterize.render`."""
    splats, info = project(of_rows(gaussians.each(Tensor.double), grad_rows), view)
    image, transmittance = blend(
        splats, list_tiles(splats, view.crop), view.crop, is_listed(splats, info, grad_rows)
    )
    return image + transmittance[..., None] * background.to(image), transmittance, info


def color_map(
    gaussians: ActivatedGaussians, view: RasterView, rows: Tensor, pixels: Tensor | None, lost: float
) -> ColorMap:
    """Return a color map, see `progdf.rasterize.engines.color_map`.

    If weights may be omitted, the others are listed once. Otherwise every product draws the splats again.
    """
    with torch.no_grad():
        splats, info = project(gaussians.each(Tensor.double), view)
    lists = list_tiles(splats, view.crop)
    if lost > 0.0:
        listed = torch.full_like(info.visible, -1, dtype=torch.int32)
        listed[rows] = torch.arange(len(rows), dtype=torch.int32, device=listed.device)
        return _list_weights(splats, lists, view.crop, listed, len(rows), pixels, lost)
    wanted = is_listed(splats, info, rows)
    return DrawnColors(
        splats, rows, len(gaussians.means), pixels, lambda some: blend(some, lists, view.crop, wanted)[0]
    )


def _list_weights(
    splats: ReferenceSplats, lists: DeviceTileLists, crop: Crop, listed: Tensor, count: int,
    pixels: Tensor | None, lost: float,
) -> SparseWeights:  # fmt: skip
    """List the weights of the Gaussians of a color map.

    Args:
        listed: index of each Gaussian in the map, −1: not in it. [N] int32
        count: number of Gaussians in the map
        pixels, lost: see `progdf.rasterize.engines.color_map`
    """
    device = listed.device
    window = (crop[3] - crop[1], crop[2] - crop[0])
    size = window if pixels is None else (len(pixels),)
    area = window[0] * window[1]
    selected = torch.arange(area, device=device) if pixels is None else pixels.to(device)
    places = torch.full((area,), -1, dtype=torch.int32, device=device)
    places[selected] = torch.arange(len(selected), dtype=torch.int32, device=device)
    inputs = (*splat_arrays(splats), listed[splats.rows], places, lost)
    counts = torch.zeros(len(selected), dtype=torch.int64, device=device)
    columns = torch.empty(0, dtype=torch.int32, device=device)
    weights = torch.empty(0, device=device)
    _launch(list_weights_kernel, lists, crop, (*inputs, counts[:0], counts, columns, weights))
    entries = int(counts.sum())
    offsets = counts.cumsum(0) - counts
    columns = columns.new_empty(entries)
    weights = weights.new_empty(entries)
    _launch(list_weights_kernel, lists, crop, (*inputs, offsets, counts, columns, weights))
    return sparse_weights(size, count, SortedEntries(counts, columns, weights))


def alpha_weights(gaussians: ActivatedGaussians, view: RasterView, mask: Tensor) -> Tensor:
    """Sum blending weights, see `progdf.rasterize.alpha_weights`."""
    splats, _ = project(gaussians.each(Tensor.double), view)
    lists = list_tiles(splats, view.crop)
    arrays = splat_arrays(splats)
    _, _, last, deepest = _blend(arrays, lists, view.crop)
    sums = arrays[0].new_zeros(len(lists.members), 4)
    inside = mask.to(arrays[0]).flatten()
    _launch(add_weights_kernel, lists, view.crop, (*arrays, last, deepest, lists.slots.int(), inside, sums))
    return sums.new_zeros(len(gaussians.means), 4).index_copy(0, splats.rows, _add_slots(sums, lists))


def is_listed(splats: ReferenceSplats, info: RasterInfo, rows: Tensor | None) -> Tensor | None:
    """Return the splats that belong to these Gaussians; None for all. [V] bool"""
    return None if rows is None else torch.zeros_like(info.visible).index_fill(0, rows, True)[splats.rows]


def blend(
    splats: ReferenceSplats, lists: DeviceTileLists, crop: Crop, wanted: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Blend projected Gaussians on black, differentiable in the wanted splats.

    Returns:
        Image [h,w,3] and transmittance [h,w] of the window, float32.
    """
    leaves = splats.means2d, splats.whitening, splats.opacities, splats.colors
    drawn: tuple[Tensor, Tensor] = _Blend.apply(  # type: ignore[no-untyped-call]
        splats, lists, crop, wanted, *leaves
    )
    return drawn


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, splats: ReferenceSplats, lists: DeviceTileLists, crop: Crop, wanted: Tensor | None,
        *leaves: Tensor,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        arrays = splat_arrays(splats)
        image, *pixel_state = _blend(arrays, lists, crop)
        ctx.forward_pass = splats, lists, crop, wanted, arrays, pixel_state
        size = crop[3] - crop[1], crop[2] - crop[0]
        return image.view(*size, 3), pixel_state[0].view(size)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, by_image: Tensor, by_transmittance: Tensor) -> tuple[Tensor | None, ...]:
        splats, lists, crop, wanted, arrays, pixel_state = ctx.forward_pass
        slots = lists.slots.int()
        if wanted is not None:
            slots = slots.where(wanted[lists.members], -1)
        sums = by_image.new_zeros(len(lists.members), SUMS)
        gradients = by_image.flatten(0, 1).contiguous(), by_transmittance.flatten().contiguous()
        _launch(blend_backward_kernel, lists, crop, (*arrays, *pixel_state, slots, *gradients, sums))
        moments = _add_slots(sums, lists).double()
        g, gu, gv, guu, guv, gvv = moments[:, 3:].unbind(1)
        l11, l21, l22 = splats.whitening.unbind(1)
        # −Σ g·u·dx, −Σ g·u·dy, −Σ g·v·dy and so on: offsets are expressed by their whitened form
        by_center = torch.stack([l11 * gu, l21 * gu + l22 * gv], dim=1)
        by_whitening = torch.stack([(l21 / l22 * guv - guu) / l11, -guv / l22, -gvv / l22], dim=1)
        return None, None, None, None, by_center, by_whitening, g / splats.opacities, moments[:, :3]


def splat_arrays(splats: ReferenceSplats) -> tuple[Tensor, Tensor, Tensor]:
    """Return boxes [V,4], shapes [V,6] and colors with opacity [V,4], in the kernels' form."""
    means2d, whitening, opacities, colors, extents = (
        tensor.detach()
        for tensor in (splats.means2d, splats.whitening, splats.opacities, splats.colors, splats.extents)
    )
    boxes = torch.cat([means2d - extents - _BOX_MARGIN_PX, means2d + extents + _BOX_MARGIN_PX], dim=1).float()
    squared = 2.0 * (opacities / ALPHA_MIN).log()
    shapes = torch.cat([means2d, whitening, squared[:, None]], dim=1)
    return boxes, shapes, torch.cat([colors, opacities[:, None]], dim=1).float()


def _blend(
    arrays: Sequence[Tensor], lists: DeviceTileLists, crop: Crop
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return image on black [h·w,3], transmittance [h·w], last [h·w] and deepest [T], see `blend_kernel`."""
    pixels = (crop[3] - crop[1]) * (crop[2] - crop[0])
    image = arrays[0].new_empty(pixels, 3)
    transmittance = arrays[0].new_empty(pixels)
    last = torch.empty_like(transmittance, dtype=torch.int32)
    deepest = torch.full_like(lists.starts[1:], -1)
    _launch(blend_kernel, lists, crop, (*arrays, image, transmittance, last, deepest))
    return image, transmittance, last, deepest


def _add_slots(sums: Tensor, lists: DeviceTileLists) -> Tensor:
    """Sum each splat's intersections in their fixed order. [I,C] -> [V,C]"""
    return torch.segment_reduce(sums, "sum", lengths=lists.counts, unsafe=True)


def _launch(kernel: Any, lists: DeviceTileLists, crop: Crop, tensors: Sequence[Tensor | float]) -> None:
    """Run a kernel on torch's stream, with one block per tile of the window."""
    device = lists.starts.device
    with _launching:
        _start()
        wp.launch(
            kernel, dim=(len(lists.starts) - 1) * TILE * TILE,
            inputs=[wp.vec4i(*crop), lists.starts, lists.members, *tensors],
            block_dim=TILE * TILE, device=wp.device_from_torch(device),
            stream=wp.stream_from_torch(torch.cuda.current_stream(device)) if device.type == "cuda" else None,
        )  # fmt: skip
