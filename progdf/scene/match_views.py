"""Search for the view that an edited picture shows, by the pixels that the edit left unchanged.

The picture may be scaled, cropped and saved as JPEG, and most of it may be repainted.

1. Coarse search: correlate the gradient directions of picture and view over all positions and scales. A
   repainted area adds noise to the sum, but no error.
2. Refinement: robust Gauss-Newton steps on position and scale, coarse to fine, to a fraction of a pixel.
3. Verification: compare blocks of the view that have texture. A block agrees if its difference is small
   against its own texture. It is displaced if it only agrees a few pixels away, as by the parallax of another
   camera. Repainted blocks do so by chance, as often as they agree at places far away, which is measured. A
   view is accepted if the agreeing blocks outnumber the displaced ones beyond chance by far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import fft, ndimage

from progdf.camera import Camera

Pixels = NDArray[np.uint8]
Plane = NDArray[np.float32]

VIEW_PX = 384
"""Longer side of the pictures that are compared, in pixels."""
MAX_PICTURE_PX = 4 * VIEW_PX
"""Longer side of an edited picture, in pixels; a larger one is reduced first."""
_COARSE_PX = 160  # longer side of a view in the coarse search
_FIRST_PX = 96  # longer side of a view at the first level of the refinement
_MIDDLE_PX = 192  # the same at the second level
_MIN_SHOWN = 0.55  # smallest share of a view's width or height that a cropped picture shows
_SCALE_STEP = 1.015  # ratio of neighboring scales in the coarse search
_MIN_TEMPLATE_PX = 16  # smallest width of the picture in the coarse search
_FLAT_GRADIENT = 0.02  # brightness per pixel; weaker gradients have no reliable direction
_EXPECTED_CHANCE = 4.0  # added to the variance of the coarse score, so that empty views have none
_REFINED_VIEWS = 4  # number of views that are refined and verified

_BLUR_PX = 0.8  # standard deviation; removes the differences between the filters of programs that scale
_MAX_STEPS = 12
_MIN_STEP_PX = 0.005
_FIRST_OUTLIER = 0.2  # brightness difference at which a pixel loses 3/4 of its weight, at the coarsest level
_LAST_OUTLIER = 0.03  # the same at the finest level
_OUTLIER_DECAY = 0.6  # factor from level to level

_BLOCK_PX = 8  # side of the compared blocks
_MIN_TEXTURE = 0.03  # standard deviation of color, 0 to 1, above JPEG's noise
_MAX_DIFFERENCE = 0.35  # of an agreeing block, as a share of its texture
_MAX_DISPLACEMENT_PX = 3  # displaced blocks are searched this far
_CHANCE_OFFSET_PX = 12  # chance is measured at displacements around this one, each way
_MIN_AGREEMENT = 0.08  # smallest share of textured blocks that agree
_MIN_BLOCKS = 24  # smallest number of agreeing blocks
_MAX_DISPLACED = 0.25  # largest ratio of displaced blocks, beyond chance, to agreeing blocks
_WHOLE_PX = 0.75  # a picture whose edges are this near to the view's edges shows the whole view


@dataclass(frozen=True)
class ViewMatch:
    """View that an edited picture shows or resembles most."""

    index: int  # of the view
    area: tuple[
        float, float, float, float
    ]  # left, top, width and height of the shown part, shares of the view
    agreement: float  # share of the view's textured blocks that agree with the picture, 0 to 1
    displaced: float  # share of the blocks that only agree a few pixels away, beyond chance, 0 to 1
    certain: bool  # the picture shows this view


@dataclass(frozen=True)
class _Placement:
    """Position of the picture in a view: center and width in shares of the view's width and height."""

    score: float  # of the coarse search; noise has about 1
    index: int
    x: float
    y: float
    width: float


def match_views(picture: Pixels, views: Sequence[Pixels]) -> ViewMatch | None:
    """Return the view that a picture shows, else the nearest one; None without views.

    Args:
        picture: an edited picture of a view, scaled, or cropped to at least 60 % of each side. [H,W,3]
        views: pictures of the views, of about `VIEW_PX`. [h,w,3] each

    Returns:
        The accepted view with the largest agreement; else, not `certain`, the one with the largest agreement.
    """
    if max(picture.shape[:2]) > MAX_PICTURE_PX:
        picture = _resize(picture, *_fit(picture, MAX_PICTURE_PX))
    found = [
        _verify(picture, views[placement.index], _refine(picture, views[placement.index], placement))
        for placement in _search(picture, views)[:_REFINED_VIEWS]
    ]
    return max(found, key=lambda match: (match.certain, match.agreement), default=None)


def matched_camera(match: ViewMatch, camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the camera of a picture.

    Args:
        match: the view that the picture shows
        camera: camera of that view
        size: width and height of the picture
    """
    left, top, width, height = match.area
    scales = (size[0] / (width * camera.width), size[1] / (height * camera.height))
    K = camera.K.clone()
    K[0] = K[0] * scales[0]
    K[1] = K[1] * scales[1]
    K[0, 2] -= left * size[0] / width
    K[1, 2] -= top * size[1] / height
    return replace(camera, K=K, width=size[0], height=size[1], sampling=1.0)


def view_thumbnail(image: Pixels) -> Pixels:
    """Return a view's picture at the size to compare, no larger than it is. [H,W,3] to [h,w,3]"""
    return _resize(image, *_fit(image, min(VIEW_PX, max(image.shape[:2]))))


def _search(picture: Pixels, views: Sequence[Pixels]) -> list[_Placement]:
    """Return the best placement of the picture in each view, best first."""
    ratio = picture.shape[0] / picture.shape[1]
    templates: dict[tuple[int, int], NDArray[np.complex64]] = {}
    found = []
    for index, view in enumerate(views):
        width, height = _fit(view, _COARSE_PX)
        field = _directions(_resize(view, width, height))
        spectrum = fft.fft2(field)
        power = fft.fft2(np.abs(field) ** 2)
        best = _Placement(-1.0, index, 0.5, 0.5, 1.0)
        for size in _template_sizes(width, height, ratio):
            if size not in templates:
                templates[size] = _directions(_resize(picture, *size))
            template = templates[size]
            inside = (slice(0, height - size[1] + 1), slice(0, width - size[0] + 1))
            sums = _correlate(spectrum, template, (height, width))[inside]
            chance = _correlate(power, np.abs(template) ** 2, (height, width))[inside]
            scores = sums / np.sqrt(np.maximum(chance, 0.0) / 2.0 + _EXPECTED_CHANCE)
            top, left = np.unravel_index(int(scores.argmax()), scores.shape)
            score = float(scores[top, left])
            if score > best.score:
                x = (left + size[0] / 2) / width
                y = (top + size[1] / 2) / height
                best = _Placement(score, index, float(x), float(y), size[0] / width)
        found.append(best)
    return sorted(found, key=lambda placement: -placement.score)


def _template_sizes(width: int, height: int, ratio: float) -> list[tuple[int, int]]:
    """Return the sizes of the picture inside a view of `width` × `height` pixels. ratio: height to width"""
    largest = min(float(width), height / ratio)
    sizes = []
    template_width = largest
    while template_width >= _MIN_TEMPLATE_PX and (
        template_width >= _MIN_SHOWN * width or template_width * ratio >= _MIN_SHOWN * height
    ):
        size = (round(template_width), max(2, round(template_width * ratio)))
        if size[0] <= width and size[1] <= height:
            sizes.append(size)
        template_width /= _SCALE_STEP
    return sizes


def _correlate(
    spectrum: NDArray[np.complexfloating], template: NDArray[np.inexact], shape: tuple[int, int]
) -> NDArray[np.floating]:
    """Return the correlation with a template at each position; positions that wrap around are invalid."""
    correlation: NDArray[np.floating] = fft.ifft2(spectrum * np.conj(fft.fft2(template, shape))).real
    return correlation


def _directions(image: Pixels) -> NDArray[np.complex64]:
    """Return the direction of the brightness gradient as a complex number of length 0 to 1. [H,W]"""
    y, x = np.gradient(ndimage.gaussian_filter(_brightness(image), 1.0))
    gradient = (x + 1j * y).astype(np.complex64)
    directions: NDArray[np.complex64] = gradient / (np.abs(gradient) + np.float32(_FLAT_GRADIENT))
    return directions


def _refine(picture: Pixels, view: Pixels, placement: _Placement) -> _Placement:
    """Return the placement at a fraction of a pixel."""
    finest = _finest_px(picture, view, placement)
    outlier = _FIRST_OUTLIER
    for longer_side in (_FIRST_PX, _FIRST_PX, _MIDDLE_PX, _MIDDLE_PX, finest, finest):
        width, height = _fit(view, min(longer_side, finest))
        target = ndimage.gaussian_filter(_brightness(_resize(view, width, height)), _BLUR_PX)
        columns = max(2, round(placement.width * width))
        rows = max(2, round(columns * picture.shape[0] / picture.shape[1]))
        template = ndimage.gaussian_filter(_brightness(_resize(picture, columns, rows)), _BLUR_PX)
        values = np.array([placement.x * width, placement.y * height, placement.width * width])
        values = _descend(target, template, values, outlier)
        placement = replace(placement, x=values[0] / width, y=values[1] / height, width=values[2] / width)
        outlier = max(outlier * _OUTLIER_DECAY, _LAST_OUTLIER)
    return placement


def _descend(
    target: Plane, template: Plane, values: NDArray[np.floating], outlier: float
) -> NDArray[np.floating]:
    """Return center and width of a template in a picture, in pixels, by robust Gauss-Newton steps. [3]"""
    gradients: Any = np.gradient(target)
    across, down = _grid(template.shape)
    for _ in range(_MAX_STEPS):
        at: tuple[Plane, Plane] = (
            values[1] + down * values[2] - 0.5,
            values[0] + across * values[2] - 0.5,
        )
        slopes = (_sample(gradients[1], *at), _sample(gradients[0], *at))
        error = template - _sample(target, *at)
        weight = (1.0 + (error / outlier) ** 2) ** -2.0
        jacobian = np.stack([*slopes, slopes[0] * across + slopes[1] * down], axis=-1).reshape(-1, 3)
        weighted = jacobian * weight.reshape(-1, 1)
        normal = weighted.T @ jacobian
        normal += np.eye(3) * (1e-6 * np.trace(normal) + 1e-12)
        step = np.linalg.solve(normal, weighted.T @ error.ravel()).clip(-2.0, 2.0)
        values = values + step
        if np.abs(step).max() < _MIN_STEP_PX:
            break
    return values


def _verify(picture: Pixels, view: Pixels, placement: _Placement) -> ViewMatch:
    """Return the agreement of picture and view at a placement."""
    width, height = _fit(view, _finest_px(picture, view, placement))
    columns = max(_BLOCK_PX, round(placement.width * width))
    rows = max(_BLOCK_PX, round(columns * picture.shape[0] / picture.shape[1]))
    blur = (_BLUR_PX, _BLUR_PX, 0.0)
    target = ndimage.gaussian_filter(_resize(view, width, height).astype(np.float32) / 255, blur)
    shown = ndimage.gaussian_filter(_resize(picture, columns, rows).astype(np.float32) / 255, blur)
    across, down = _grid((rows, columns))
    span = placement.width * width
    y = placement.y * height + down * span - 0.5
    x = placement.x * width + across * span - 0.5
    expected = np.stack([_sample(target[..., channel], y, x) for channel in range(3)], axis=-1)
    means = _block_means(expected)
    texture = np.sqrt((_block_means(expected**2) - means**2).clip(0.0).mean(axis=2))
    textured = texture > _MIN_TEXTURE
    limit = (_MAX_DIFFERENCE * texture) ** 2
    agrees = textured & (_block_errors(shown, expected) < limit)
    count = max(1, int(textured.sum()))
    agreeing = int(agrees.sum())
    certain = agreeing >= max(_MIN_BLOCKS, _MIN_AGREEMENT * count)
    displaced = 0
    if certain:
        near = _agree_at(shown, expected, limit, (0, 0))
        far = _agree_at(shown, expected, limit, (_CHANCE_OFFSET_PX, _CHANCE_OFFSET_PX))
        others = textured & ~agrees
        displaced = max(0, int((others & near).sum()) - int((others & far).sum()))
        certain = displaced <= _MAX_DISPLACED * agreeing
    shown_height = placement.width * width * picture.shape[0] / (picture.shape[1] * height)
    area = (
        placement.x - placement.width / 2,
        placement.y - shown_height / 2,
        placement.width,
        shown_height,
    )
    if _is_whole(area, width, height):
        area = (0.0, 0.0, 1.0, 1.0)
    return ViewMatch(placement.index, area, agreeing / count, displaced / count, certain)


def _agree_at(shown: Plane, expected: Plane, limit: Plane, offset: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the blocks that agree at a displacement near `offset`, in pixels down and right. [H/8,W/8]"""
    agrees = np.zeros(limit.shape, bool)
    reach = range(-_MAX_DISPLACEMENT_PX, _MAX_DISPLACEMENT_PX + 1)
    for dy in reach:
        for dx in reach:
            moved = np.roll(expected, (offset[0] + dy, offset[1] + dx), (0, 1))
            agrees |= _block_errors(shown, moved) < limit
    return agrees


def _is_whole(area: tuple[float, float, float, float], width: int, height: int) -> bool:
    """Return whether an area of a view of `width` × `height` pixels is the whole view."""
    left, top, area_width, area_height = area
    sides = (left * width, top * height, (1 - left - area_width) * width, (1 - top - area_height) * height)
    return max(map(abs, sides)) < _WHOLE_PX


def _finest_px(picture: Pixels, view: Pixels, placement: _Placement) -> float:
    """Return the longer side of the view at which neither it nor the picture is enlarged."""
    longer = max(view.shape[:2])
    return float(min(longer, longer * picture.shape[1] / (placement.width * view.shape[1])))


def _grid(shape: tuple[int, ...]) -> tuple[Plane, Plane]:
    """Return the positions of pixels from the center, in widths of the picture. [H,W] each"""
    rows, columns = shape[:2]
    down, across = np.mgrid[:rows, :columns].astype(np.float32)
    return (across + 0.5) / columns - 0.5, ((down + 0.5) - rows / 2) / columns


def _sample(plane: Plane, y: Plane, x: Plane) -> Plane:
    """Return a picture's values at positions in pixels, linear between pixel centers. [H,W]"""
    values: Plane = ndimage.map_coordinates(plane, [y, x], order=1, mode="nearest")
    return values


def _block_means(image: Plane) -> Plane:
    """Return the means over blocks of `_BLOCK_PX`. [H,W,C] to [H/8,W/8,C]"""
    rows = image.shape[0] // _BLOCK_PX
    columns = image.shape[1] // _BLOCK_PX
    parts = image[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    means: Plane = parts.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX, -1).mean(axis=(1, 3))
    return means


def _block_errors(shown: Plane, expected: Plane) -> Plane:
    """Return the mean squared color difference of each block. [H/8,W/8]"""
    errors: Plane = _block_means((shown - expected) ** 2).mean(axis=2)
    return errors


def _brightness(image: Pixels) -> Plane:
    """Return the luma of a picture, 0 to 1. [H,W,3] to [H,W]"""
    return image.astype(np.float32) @ np.array([0.299, 0.587, 0.114], np.float32) / np.float32(255)


def _fit(image: Pixels, longer_side: float) -> tuple[int, int]:
    """Return width and height of a picture whose longer side gets a given length in pixels."""
    height, width = image.shape[:2]
    factor = longer_side / max(height, width)
    return max(2, round(width * factor)), max(2, round(height * factor))


def _resize(image: Pixels, width: int, height: int) -> Pixels:
    """Return a picture scaled by area when it shrinks, and bicubically when it grows. [height,width,3]"""
    shrinks = width < image.shape[1]
    method = Image.Resampling.BOX if shrinks else Image.Resampling.BICUBIC
    return np.asarray(Image.fromarray(image).resize((width, height), method))
