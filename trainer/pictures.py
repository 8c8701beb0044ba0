"""Pictures from files, of any common format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from progdf.errors import ProgdfError


def read_picture(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """Read a picture as [H,W,3] float32 0..1; transparency counts as white.

    Args:
        path: the file
        size: width and height to scale to

    Raises:
        ProgdfError: it is missing or no picture, or `size` has other proportions (by more than 2 %).
    """
    try:
        with Image.open(path) as opened:
            picture = opened.convert("RGBA")
    except (OSError, UnidentifiedImageError, ValueError, Image.DecompressionBombError) as error:
        reason = "it does not exist" if isinstance(error, FileNotFoundError) else type(error).__name__
        raise ProgdfError(f"{path} cannot be read as a picture ({reason}); save it as PNG") from error
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
