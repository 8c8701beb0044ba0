"""Painted strength of a layer as text: one weight per member, in 8 bits."""

from __future__ import annotations

import base64
import binascii
import zlib
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.gdf.file import Gdf

from .layers import Gains, Layer

FULL = ""
"""Paint of an unpainted layer: weight 1 everywhere."""

Floats = NDArray[np.float32]


def encode(weights: Floats) -> str:
    """Encode weights [M] (0 to 1) as the text stored in states and sessions; `FULL` if all are 1."""
    levels = np.round(np.clip(weights, 0.0, 1.0) * 255.0).astype(np.uint8)
    if (levels == 255).all():
        return FULL
    return base64.b64encode(zlib.compress(levels.tobytes(), 1)).decode()


@lru_cache(maxsize=48)  # the composer compares weights by identity
def decode(paint: str, members: int, from_others: int = 0) -> Tensor | None:
    """Decode the weight of every member.

    Args:
        paint: text from `encode`
        members: M
        from_others: number of members, at the end, that other edits add; those added after painting get
            weight 1

    Returns:
        [M] float32, 0 to 1, or None for `FULL`.

    Raises:
        ProgdfError: the text is damaged, or has more than M or fewer than M − `from_others` weights.
    """
    if paint == FULL:
        return None
    unpacker = zlib.decompressobj()
    try:
        levels = unpacker.decompress(base64.b64decode(paint, validate=True), members + 1)
    except (ValueError, binascii.Error, zlib.error):
        raise ProgdfError("the painted weights of a layer are damaged; paint it again") from None
    if not members - from_others <= len(levels) <= members:
        raise ProgdfError(f"a layer's painted weights do not fit its {members} members; paint it again")
    return torch.from_numpy(
        np.frombuffer(levels.ljust(members, b"\xff"), np.uint8).astype(np.float32) / 255.0
    )


def layer_of(gdf: Gdf, strength: float, gains: Gains, paint: str, blend: str = "") -> Layer:
    """Build the composer's layer, with the painted weights and its own blend rule, if any.

    Raises:
        ProgdfError: see `decode`.
    """
    weights = decode(paint, len(gdf.region), gdf.from_others)
    return Layer(gdf, strength, True, gains, weights, blend)
