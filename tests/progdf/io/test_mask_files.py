"""Tests of masks in the forms that programs write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.errors import ProgdfError
from progdf.io.images import read_mask

SHAPE = np.zeros((24, 32), bool)
SHAPE[6:18, 10:20] = True
BYTES = np.where(SHAPE, 255, 0).astype(np.uint8)
NOISE = np.random.default_rng(0).integers(0, 256, (24, 32, 3)).astype(np.uint8)


def with_alpha(color: np.ndarray, alpha: np.ndarray) -> Image.Image:
    rgb = np.broadcast_to(color, (24, 32, 3)).astype(np.uint8)
    return Image.fromarray(np.dstack([rgb, alpha.astype(np.uint8)]))


def palette(*colors: tuple[int, int, int], transparent: int | None = None) -> Image.Image:
    picture = Image.fromarray(SHAPE.astype(np.uint8)).convert("P")
    picture.putdata(SHAPE.astype(np.uint8).ravel().tolist())
    picture.putpalette([channel for color in colors for channel in color])
    if transparent is not None:
        picture.info["transparency"] = transparent
    return picture


FORMS: dict[str, Callable[[], Image.Image]] = {
    "gray": lambda: Image.fromarray(BYTES),
    "one bit": lambda: Image.fromarray(BYTES).convert("1"),
    "zeros and ones": lambda: Image.fromarray(SHAPE.astype(np.uint8)),
    "16 bits": lambda: Image.fromarray(SHAPE.astype(np.uint16) * 65535),
    "16 bits of zeros and ones": lambda: Image.fromarray(SHAPE.astype(np.uint16)),
    "red on black": lambda: Image.fromarray(np.dstack([BYTES, 0 * BYTES, 0 * BYTES])),
    "RGB": lambda: Image.fromarray(np.dstack([BYTES] * 3)),
    "palette": lambda: palette((0, 0, 0), (255, 255, 255)),
    "dark red palette": lambda: palette((0, 0, 0), (128, 0, 0)),
    "transparent palette": lambda: palette((255, 255, 255), (0, 0, 0), transparent=0),
    "black with the shape in alpha": lambda: with_alpha(np.array([0, 0, 0]), BYTES),
    "white with the shape in alpha": lambda: with_alpha(np.array([255, 255, 255]), BYTES),
    "a photograph with the shape in alpha": lambda: with_alpha(NOISE, BYTES),
    "gray and alpha": lambda: Image.merge("LA", [Image.new("L", (32, 24)), Image.fromarray(BYTES)]),
    "color with full alpha": lambda: with_alpha(BYTES[..., None], np.full((24, 32), 255)),
    "color with no alpha": lambda: with_alpha(BYTES[..., None], np.zeros((24, 32))),
    "drawn on a transparent layer": lambda: with_alpha(
        BYTES[..., None], np.where(np.arange(24)[:, None] < 20, 255, np.zeros((24, 32)))
    ),
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_mask_has_its_shape(tmp_path: Path, form: str) -> None:
    FORMS[form]().save(tmp_path / "m.png")
    assert torch.equal(read_mask(tmp_path / "m.png", (32, 24)), torch.from_numpy(SHAPE).float())


@pytest.mark.parametrize("kind", [np.int32, np.float32])
def test_tiff_masks_of_zeros_and_ones_are_read(tmp_path: Path, kind: type) -> None:
    Image.fromarray(SHAPE.astype(kind)).save(tmp_path / "m.tif")
    assert torch.equal(read_mask(tmp_path / "m.tif", (32, 24)), torch.from_numpy(SHAPE).float())


def test_soft_alpha_is_kept_and_other_sizes_are_averaged(tmp_path: Path) -> None:
    alpha = np.linspace(0, 255, 32).round() * np.ones((24, 1))
    with_alpha(np.array([9, 9, 9]), alpha).save(tmp_path / "m.png")
    half = torch.from_numpy(alpha.reshape(12, 2, 16, 2).mean(axis=(1, 3)).astype(np.float32) / 255)
    assert torch.allclose(read_mask(tmp_path / "m.png", (16, 12)), half, atol=1.1 / 255)


def test_label_map_is_refused(tmp_path: Path) -> None:
    colors = np.zeros((24, 32, 3), np.uint8)
    colors[SHAPE] = (128, 0, 0)
    colors[:4] = (0, 128, 0)
    Image.fromarray(colors).save(tmp_path / "m.png")
    with pytest.raises(
        ProgdfError, match=r"m\.png has 2 colors besides gray.*; save one object as white on black"
    ):
        read_mask(tmp_path / "m.png", (32, 24))
