"""Pictures from files, of any common format."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from progdf.io.images import flatten_onto, open_picture


def read_picture(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """Read a picture as [H,W,3] float32 0..1; transparency counts as white.

    Args:
        path: the file
        size: width and height to scale to

    Raises:
        ProgdfError: it is missing or no picture, or `size` has other proportions (by more than 2 %).
    """
    picture = flatten_onto(open_picture(path, size), "white", size)
    return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0)
