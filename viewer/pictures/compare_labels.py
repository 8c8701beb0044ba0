"""What a comparison says, in the window and in files: what is on which side, and by how much they differ."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from viewer.render.renderers import Image
from viewer.state.view_state import Comparison

from .film import Pixels, to_pixels

ORIGINAL, EDITED, FIELD = "original", "edited", "field"
_SHADE, _INK = (22, 24, 27), (222, 225, 230)
_PLAIN = str.maketrans({"×": "x", "–": "-"})  # Pillow's own font has no others


@dataclass(frozen=True)
class Labels:
    """The words of one comparison.

    Args:
        left, right: the two sides
        line: over a difference
        notice: why it is not against what was asked for, "" where it is
    """

    left: str = ORIGINAL
    right: str = EDITED
    line: str = ""
    notice: str = ""


def labels(
    compare: Comparison,
    decibels: float,
    recorded: str = "",
    obstacle: str = "",
    names: tuple[str, str] | None = None,
) -> Labels:
    """What to say over a comparison.

    Args:
        compare: what is compared, and how
        decibels: PSNR of the two pictures; NaN where it was not taken
        recorded: which snapshots are on the other side, "" for the original
        obstacle: why the recording was asked for and is not shown
        names: of the snapshots on the two sides
    """
    if math.isinf(decibels):
        line, figure = "difference: none", " · no difference"
    else:
        figure = "" if math.isnan(decibels) else f" · PSNR {decibels:.1f} dB"
        line = f"difference × {compare.amplify:g}{figure}"
    if names is not None:
        return Labels(names[0], names[1] + figure, f"{line} · {names[0]} against {names[1]}")
    if recorded:
        return Labels(recorded, FIELD + figure, f"{line} · {recorded}")
    return Labels(line=line, notice=f"Against the original: {obstacle}" if obstacle else "")


def draw_labels(image: Image, compare: Comparison, said: Labels) -> Pixels:
    """A picture of `Comparer.image` for a file: with the divider and what is on which side."""
    pixels = to_pixels(image)
    if compare.mode == "off":
        return pixels
    page = Pillow.fromarray(pixels)
    draw = ImageDraw.Draw(page, "RGBA")
    if compare.mode == "difference":
        _tag(draw, page.width / 2, "m", said.line, page.size)
    else:
        at = column(compare, page.width)
        draw.line([(at, 0), (at, page.height)], (*_SHADE, 140), 3)
        draw.line([(at, 0), (at, page.height)], (255, 255, 255, 255), 1)
        _tag(draw, at, "r", said.left, page.size)
        _tag(draw, at, "l", said.right, page.size)
    return np.asarray(page)


def column(compare: Comparison, width: int) -> int:
    """Where in a picture of this width the edited side begins, pixels."""
    if compare.mode == "beside":
        return width // 2
    return max(0, min(width, round(compare.divider * width)))


def _tag(draw: ImageDraw.ImageDraw, x: float, side: str, text: str, size: tuple[int, int]) -> None:
    """A word at the top: left of x ("r" as it ends there), right of it ("l"), or around it; where it fits."""
    text = text.translate(_PLAIN)
    letters = max(11, round(size[1] / 28))
    font = ImageFont.load_default(size=letters)
    wide, pad, gap = draw.textlength(text, font), 0.5 * letters, 0.6 * letters
    left = {"r": x - gap - wide - 2 * pad, "l": x + gap, "m": x - wide / 2 - pad}[side]
    if left < 0 or left + wide + 2 * pad > size[0]:
        return
    box = (left, gap, left + wide + 2 * pad, gap + 1.6 * letters)
    draw.rounded_rectangle(box, 0.3 * letters, (*_SHADE, 200))
    draw.text((left + pad, gap + 0.8 * letters), text, _INK, font, anchor="lm")
