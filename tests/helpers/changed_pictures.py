"""Pictures of views as other programs save them: painted over, cropped, scaled and compressed."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class ChangedPicture:
    """Changed picture of a view."""

    pixels: Pixels  # [H,W,3]
    jpeg: bytes  # the same as a file
    area: tuple[float, float, float, float]  # left, top, width and height of the crop, shares of the view


def paint_over(image: Pixels, share: float, rng: np.random.Generator) -> Pixels:
    """Return a picture with boxes, ellipses and strokes of flat color, tint or texture over it.

    Args:
        image: [H,W,3]
        share: largest painted share of the pixels, 0 to 1; at least 5 % less is reached
        rng: source of shapes and colors
    """
    height, width = image.shape[:2]
    painted = np.zeros((height, width), bool)
    while painted.mean() < share - 0.05:
        inside = _shape(width, height, rng)
        if (painted | inside).mean() > share:
            continue
        color = rng.integers(0, 256, 3)
        paint = [
            np.broadcast_to(color, image.shape),
            0.4 * image + 0.6 * color,
            np.asarray(Image.fromarray(rng.integers(0, 256, (9, 12, 3), np.uint8)).resize((width, height))),
        ][rng.integers(3)]
        image = np.where(inside[..., None], paint, image).astype(np.uint8)
        painted |= inside
    return image


def _shape(width: int, height: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    mask = Image.new("L", (width, height))
    draw = ImageDraw.Draw(mask)
    left, top = rng.uniform(-0.1, 0.9, 2) * (width, height)
    box = (left, top, left + rng.uniform(0.1, 0.5) * width, top + rng.uniform(0.1, 0.5) * height)
    kind = rng.integers(3)
    if kind == 0:
        draw.rectangle(box, fill=255)
    elif kind == 1:
        draw.ellipse(box, fill=255)
    else:
        points = rng.uniform(0.0, 1.0, (4, 2)) * (width, height)
        draw.line([tuple(point) for point in points.tolist()], fill=255, width=int(0.04 * width))
    return np.asarray(mask) > 0


def save_elsewhere(image: Pixels, rng: np.random.Generator) -> ChangedPicture:
    """Return a picture cropped to at least 60 % of its area, scaled by 0.5 to 2 and saved as a JPEG."""
    height, width = image.shape[:2]
    across = rng.uniform(0.6, 1.0)
    down = min(1.0, rng.uniform(0.6, 1.0) / across)
    columns = int(across * width)
    rows = int(down * height)
    left = int(rng.integers(0, width - columns + 1))
    top = int(rng.integers(0, height - rows + 1))
    scale = 2.0 ** rng.uniform(-1.0, 1.0)
    cropped = Image.fromarray(image[top : top + rows, left : left + columns])
    file = io.BytesIO()
    cropped.resize((round(scale * columns), round(scale * rows)), Image.Resampling.BICUBIC).save(
        file, "JPEG", quality=int(rng.integers(70, 96))
    )
    area = (left / width, top / height, columns / width, rows / height)
    return ChangedPicture(np.asarray(Image.open(file)), file.getvalue(), area)
