"""Texture continued into a hole of a picture: shift maps, then one gradient-domain solve.

1. OpenCV's shift maps (extra `fill`) copy every missing pixel from a visible one, in Lab. Their seams run
   where the copies agree best.
2. Recover the source of each copied pixel from the result. This is possible because the copies are exact.
3. Solve one sparse least-squares problem for the final colors. The differences between neighbors come as
   close as possible to those at the sources, and visible pixels are fixed. This removes seams in tone.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from scipy.signal import fftconvolve
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu
from torch import Tensor

from progdf.color.oklab import srgb_to_oklab
from progdf.color.shading import JND
from progdf.surface.models import Array, Mask

from .membrane import membrane

VISIBLE_CONTRAST = JND
"""Contrast in OKLab from which texture continues: a just noticeable difference."""

_MIXED_PX = 3  # width of the border around the hole whose color is mixed with the removed region, pixels
_RECOVERY_PX = 5  # window in which a copied pixel and its source are compared, pixels
_MAX_SHIFTS = 200  # largest number of shifts to recover
_MIN_SHIFT_COUNT = 8  # pixels; shifts of fewer pixels are coincidences
_MIN_PIECE_PX = 9  # pixels; smaller pieces without a source are filled smoothly
_RING_PX = 6  # width of the compared ring around a piece, pixels
_UNKNOWN_WEIGHT = 0.01  # weight of a difference that no source has
_COLOR_WEIGHT = 1e-3  # weight of the copied colors; that of their differences is 1
_STEPS = ((0, 1), (1, 0))  # to the right neighbor, and to the lower one
_CORNERS = [(r, g, b) for r in (0, 1) for g in (0, 1) for b in (0, 1)]  # of the RGB cube


def can_continue_texture() -> bool:
    """Return True if OpenCV with its contributed modules (extra `fill`) is installed."""
    try:
        import cv2
    except ImportError:  # also if a library of the system is missing
        return False
    return hasattr(cv2, "xphoto")  # absent in OpenCV without contrib


def texture_contrast(image: Tensor, hole: Mask, known: Mask) -> float:
    """Return the contrast of the ground's texture around a hole, in OKLab.

    It is the root mean square difference of the colors from their own blur, whose standard deviation is half
    the hole's radius. A smooth patch in the hole could not have these differences.

    Args:
        image: [H,W,3], 0 to 1
        hole: missing pixels. [H,W]
        known: visible pixels. [H,W]
    """
    lab = srgb_to_oklab(image).double().numpy()
    radius = float(ndimage.distance_transform_edt(np.pad(hole, 1)).max())
    clean = known & ~ndimage.binary_dilation(hole, iterations=_MIXED_PX)
    near = clean & ndimage.binary_dilation(hole, iterations=_MIXED_PX + max(4, round(2 * radius)))
    if not near.any():
        return 0.0
    weight = ndimage.gaussian_filter(clean.astype(float), 0.5 * radius)
    smooth = [
        ndimage.gaussian_filter(lab[..., i] * clean, 0.5 * radius) / np.maximum(weight, 1e-6)
        for i in range(3)
    ]
    difference = (lab - np.stack(smooth, axis=2))[near]
    return float(np.sqrt((difference**2).sum(axis=1).mean()))


def continue_texture(image: Tensor, hole: Mask, known: Mask) -> Tensor:
    """Return the picture with the hole filled by texture of its surroundings. It needs the extra `fill`.

    Args:
        image: [H,W,3], 0 to 1
        hole: pixels to fill. [H,W]
        known: visible pixels, the only sources. [H,W]

    Returns:
        Pixels outside `area_to_fill` are unchanged. [H,W,3], 0 to 1
    """
    filled = area_to_fill(hole, known)
    sources = known & ~filled
    source = _copy_sources(image, filled, sources)
    colors = image.double().numpy().copy()
    exact = filled & (source[0] >= 0)
    colors[exact] = colors[source[0][exact], source[1][exact]]
    without_source = filled & ~exact
    if without_source.any():
        colors = membrane(torch.from_numpy(colors), torch.from_numpy(without_source)).numpy()
    return torch.from_numpy(_remove_seams(colors, filled, sources, source)).float().clamp(0.0, 1.0)


def _copy_sources(image: Tensor, filled: Mask, sources: Mask) -> NDArray[np.int64]:
    """Return row and column of the visible pixel that each filled pixel copies; −1 for none. [2,H,W]

    Shift maps leave pixels empty if none of their shifts leads to a source. Each connected piece of such
    pixels is copied as a whole, from the position whose surroundings agree best.
    """
    if not sources.any():
        return np.full((2, *filled.shape), -1)
    copied = _shift_map(image, filled, sources)
    origin = _recover_sources(copied, _to_lab(image), filled, sources)
    missing = filled & (origin[0] < 0)
    current = image.double().numpy().copy()
    found = filled & ~missing
    current[found] = current[origin[0][found], origin[1][found]]
    pieces, count = ndimage.label(missing)
    for piece in range(1, count + 1):
        rows, columns = np.nonzero(pieces == piece)
        if len(rows) < _MIN_PIECE_PX:
            continue
        place = _best_copy(current, pieces == piece, (sources | filled) & ~missing, sources)
        if place is None:
            continue
        origin[0][rows, columns] = rows + place[0]
        origin[1][rows, columns] = columns + place[1]
    return origin


def _best_copy(colors: Array, piece: Mask, valid: Mask, sources: Mask) -> tuple[int, int] | None:
    """Return the shift (rows, columns) to the sources whose surroundings agree best with those of a piece.

    None if no shift leads to sources alone.

    Args:
        colors: [H,W,3]
        piece: pixels to copy. [H,W]
        valid: pixels with a color. [H,W]
        sources: pixels that may be copied. [H,W]
    """
    rows, columns = np.nonzero(ndimage.binary_dilation(piece, iterations=_RING_PX))
    top = rows.min()
    left = columns.min()
    box = np.s_[top : rows.max() + 1, left : columns.max() + 1]
    inside = piece[box].astype(float)
    ring = (valid & ndimage.binary_dilation(piece, iterations=_RING_PX))[box].astype(float)
    usable = _correlate((~sources).astype(float), inside) < 0.5
    # pixels of the ring may lie on visible pixels only
    usable &= _correlate((~sources).astype(float), ring) < 0.5
    if not usable.any():
        return None
    error = np.zeros(usable.shape)
    for channel in range(3):
        picture = colors[..., channel]
        wanted = colors[box][..., channel] * ring
        error += _correlate(picture**2, ring) - 2.0 * _correlate(picture, wanted)
    error[~usable] = np.inf
    row, column = np.unravel_index(int(error.argmin()), error.shape)
    return int(row - top), int(column - left)


def _correlate(picture: Array, window: Array) -> Array:
    """Return the sums of products of a window with the picture at each of its places. [H-h+1,W-w+1]"""
    return np.asarray(fftconvolve(picture, window[::-1, ::-1], mode="valid"), np.float64)


def area_to_fill(hole: Mask, known: Mask) -> Mask:
    """Return the hole with the pixels at its edge, whose color is mixed with the region. [H,W] bool"""
    edge = ndimage.binary_dilation(hole, np.ones((3, 3)), iterations=_MIXED_PX)
    clean = known & ~edge
    gap = ndimage.binary_dilation(clean, np.ones((3, 3)), iterations=_MIXED_PX)
    return np.asarray(hole | (edge & (known | gap)))


def _to_lab(image: Tensor) -> NDArray[np.uint8]:
    """Convert a picture, 0 to 1, to OpenCV's 8-bit Lab. [H,W,3]"""
    import cv2

    pixels = (255.0 * image.clamp(0.0, 1.0)).round().byte().numpy()
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2LAB), np.uint8)


def _shift_map(image: Tensor, filled: Mask, sources: Mask) -> NDArray[np.uint8]:
    """Return the picture in Lab with the filled pixels inpainted. [H,W,3]

    Pixels that are neither filled nor sources take the color that is farthest from all sources, so that no
    copy prefers them.
    """
    import cv2

    lab = _to_lab(image)
    corners = _to_lab(torch.tensor(_CORNERS).float()[None])[0]
    apart = np.abs(lab[sources].astype(int)[:, None] - corners.astype(int)).sum(axis=2).min(axis=0)
    lab[~sources] = corners[int(apart.argmax())]
    result = np.zeros_like(lab)
    mask = np.where(filled, np.uint8(0), np.uint8(255))
    cv2.setRNGSeed(0)
    cv2.xphoto.inpaint(lab, mask, result, cv2.xphoto.INPAINT_SHIFTMAP)
    return result


def _recover_sources(
    copied: NDArray[np.uint8], lab: NDArray[np.uint8], filled: Mask, sources: Mask
) -> NDArray[np.int64]:
    """Return row and column of the source of each filled pixel; −1 where it is not found. [2,H,W]

    A shift is a candidate if many filled pixels equal the visible pixel at it. Each pixel takes the candidate
    with which most of its neighbors agree.
    """
    height, width = filled.shape
    source = np.full((2, height, width), -1)
    found = np.zeros((height, width))
    rows, columns = np.nonzero(filled)
    for down, right in _candidate_shifts(copied, lab, filled, sources):
        from_rows = rows + down
        from_columns = columns + right
        inside = (from_rows >= 0) & (from_rows < height) & (from_columns >= 0) & (from_columns < width)
        to = rows[inside], columns[inside]
        origin = from_rows[inside], from_columns[inside]
        equal = np.zeros((height, width), np.float32)
        equal[to] = sources[origin] & (copied[to] == lab[origin]).all(axis=1)
        agreement = np.where(equal > 0, ndimage.uniform_filter(equal, _RECOVERY_PX), 0.0)
        better = agreement > found
        found[better] = agreement[better]
        source[0][better] = better.nonzero()[0] + down
        source[1][better] = better.nonzero()[1] + right
    return source


def _candidate_shifts(
    copied: NDArray[np.uint8], lab: NDArray[np.uint8], filled: Mask, sources: Mask
) -> list[tuple[int, int]]:
    """Return the shifts by which 3x3 patches of filled pixels equal sources, frequent ones first."""
    of_sources = _patch_codes(lab)
    of_copies = _patch_codes(copied)
    whole_sources = ndimage.binary_erosion(sources, np.ones((3, 3)))
    whole_fills = ndimage.binary_erosion(filled, np.ones((3, 3)))
    codes = of_sources[whole_sources]
    if not len(codes):  # all sources are narrow
        return []
    places = np.argwhere(whole_sources)
    order = codes.argsort(kind="stable")
    codes = codes[order]
    unique, first, count = np.unique(codes, return_index=True, return_counts=True)
    wanted = of_copies[whole_fills]
    at = np.searchsorted(unique, wanted).clip(max=len(unique) - 1)
    known = (unique[at] == wanted) & (count[at] == 1)
    shifts = places[order[first[at[known]]]] - np.argwhere(whole_fills)[known]
    if not len(shifts):
        return []
    distinct, counts = np.unique(shifts, axis=0, return_counts=True)
    ranked = (-counts).argsort(kind="stable")[:_MAX_SHIFTS]
    return [
        (int(a), int(b))
        for (a, b), n in zip(distinct[ranked], counts[ranked], strict=True)
        if n >= _MIN_SHIFT_COUNT
    ]


def _patch_codes(lab: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return a 64-bit hash of the 3x3 patch around each pixel. [H,W]"""
    random = np.random.default_rng(0).integers(1, 2**63, size=(3, 3, 3), dtype=np.uint64) | np.uint64(1)
    padded = np.pad(lab.astype(np.uint64), ((1, 1), (1, 1), (0, 0)), mode="edge")
    height, width = lab.shape[:2]
    codes = np.zeros((height, width), np.uint64)
    for row in range(3):
        for column in range(3):
            for channel in range(3):
                part = padded[row : row + height, column : column + width, channel] + np.uint64(1)
                codes += part * part * random[row, column, channel]
    return codes


def _remove_seams(colors: Array, filled: Mask, sources: Mask, source: NDArray[np.int64]) -> Array:
    """Return the colors whose differences are closest to those of the sources, with the sources unchanged.

    Args:
        colors: picture with the copied colors. [H,W,3]
        filled: pixels to solve for. [H,W]
        sources: visible pixels. [H,W]
        source: row and column of the source of each filled pixel, −1 for none. [2,H,W]
    """
    height, width = filled.shape
    index = np.full((height, width), -1)
    count = int(filled.sum())
    index[filled] = np.arange(count)
    origin = source.copy()
    rows, columns = np.nonzero(sources)
    origin[0][sources] = rows
    origin[1][sources] = columns
    diagonal = np.full(count, _COLOR_WEIGHT)
    right = _COLOR_WEIGHT * colors[filled]
    entries = list[tuple[NDArray[np.int64], NDArray[np.int64], Array]]()
    for down, across in _STEPS:
        p = np.s_[: height - down, : width - across]
        q = np.s_[down:, across:]
        is_edge = (filled[p] | filled[q]) & (filled[p] | sources[p]) & (filled[q] | sources[q])
        a_rows, a_columns = np.nonzero(is_edge)
        b_rows = a_rows + down
        b_columns = a_columns + across
        before = (a_rows, a_columns)
        after = (b_rows, b_columns)
        step, weight = _source_step(colors, sources, origin, before, after, (down, across))
        a = index[a_rows, a_columns]
        b = index[b_rows, b_columns]
        for own, other, place, difference in (
            (a, b, (b_rows, b_columns), -step),
            (b, a, (a_rows, a_columns), step),
        ):
            free = own >= 0
            np.add.at(diagonal, own[free], weight[free])
            np.add.at(right, own[free], weight[free, None] * difference[free])
            fixed = free & (other < 0)
            known_colors = colors[place[0][fixed], place[1][fixed]]
            np.add.at(right, own[fixed], weight[fixed, None] * known_colors)
            both = free & (other >= 0)
            entries.append((own[both], other[both], weight[both]))
    i = np.concatenate([*(entry[0] for entry in entries), np.arange(count)])
    j = np.concatenate([*(entry[1] for entry in entries), np.arange(count)])
    values = np.concatenate([*(-entry[2] for entry in entries), diagonal])
    matrix: csc_matrix = coo_matrix((values, (i, j)), (count, count)).tocsc()
    result = colors.copy()
    result[filled] = splu(matrix).solve(right)
    return result


def _source_step(
    colors: Array,
    sources: Mask,
    origin: NDArray[np.int64],
    a: tuple[NDArray[np.int64], NDArray[np.int64]],
    b: tuple[NDArray[np.int64], NDArray[np.int64]],
    step: tuple[int, int],
) -> tuple[Array, Array]:
    """Return the color differences from pixels a to their neighbors b, and their weights. [E,3] and [E]

    The differences are those of the sources. Across a seam, the mean of both sources is used.
    """
    height, width = sources.shape
    total = np.zeros((len(a[0]), 3))
    count = np.zeros(len(a[0]))
    for place, sign in ((a, 1), (b, -1)):
        r = origin[0][place]
        c = origin[1][place]
        next_r = r + sign * step[0]
        next_c = c + sign * step[1]
        valid = (r >= 0) & (next_r >= 0) & (next_r < height) & (next_c >= 0) & (next_c < width)
        valid[valid] = sources[next_r[valid], next_c[valid]]
        total[valid] += sign * (colors[next_r[valid], next_c[valid]] - colors[r[valid], c[valid]])
        count[valid] += 1
    return total / np.maximum(count, 1.0)[:, None], np.where(count > 0, 1.0, _UNKNOWN_WEIGHT)
