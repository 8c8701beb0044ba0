"""Pictures in files: 8-bit PNG out, any common format in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.files import written_whole


def write_picture(path: Path, image: Tensor) -> None:
    """Write an image [H,W,3] or a mask [H,W], 0..1, as PNG; the folder is made if need be."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path) as beside:
        to_pil(image).save(beside)


def read_picture(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """Read a picture as [H,W,3] float32 0..1; transparency counts as white.

    Args:
        path: the file
        size: width and height to scale to

    Raises:
        ProgdfError: `size` has other proportions (by more than 2 %).
        OSError: it cannot be read as a picture.
    """
    with Image.open(path) as opened:
        opened.load()
        picture = (
            opened.convert("RGBA")
            if opened.mode in ("RGBA", "LA", "PA") or "transparency" in opened.info
            else opened.convert("RGB")
        )
    if picture.mode == "RGBA":
        white = Image.new("RGBA", picture.size, "white")
        picture = Image.alpha_composite(white, picture).convert("RGB")
    if size is not None and picture.size != size:
        if abs(picture.width * size[1] / (picture.height * size[0]) - 1.0) > 0.02:
            raise ProgdfError(
                f"{path} is {picture.width}x{picture.height} pixels, its view {size[0]}x{size[1]}; "
                "keep the proportions of the original view"
            )
        picture = picture.resize(size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0)


def to_pil(image: Tensor) -> Image.Image:
    """[H,W,3] or [H,W], 0..1 -> 8-bit picture, rounded."""
    return Image.fromarray((image.detach().clamp(0, 1) * 255.0).round().to(torch.uint8).numpy())
