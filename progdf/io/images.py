"""Contact sheets: pictures in a grid, with words at the rows and columns that can be read at any size."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngImageFile
from torch import Tensor

from progdf.errors import ProgdfError

from .atomic import atomic_write, check_regular, make_folder

_PAPER, _INK, _PALE_INK = (250, 249, 246), (38, 36, 34), (118, 113, 107)
_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont


def contact_sheet(
    rows: Sequence[Sequence[Tensor]],
    row_labels: Sequence[str] = (),
    column_labels: Sequence[str] = (),
    title: str = "",
    caption: str = "",
    notes: Sequence[Sequence[str]] = (),
) -> Tensor:
    """Lay pictures out in a grid.

    Args:
        rows: the pictures, row by row, all of one size; rows may have different lengths. [H,W,3] in 0..1 each
        row_labels: a word to the left of each row, or none; further lines are smaller and paler
        column_labels: a word above each column, or none
        title: a line at the top
        caption: a smaller line at the bottom
        notes: a word under each picture, row by row, or none

    Returns:
        The sheet. [H',W',3] in 0..1

    Raises:
        ValueError: no picture, pictures of different sizes, more labels than rows or columns.
    """
    sizes = {tuple(image.shape) for row in rows for image in row}
    if len(sizes) != 1:
        raise ValueError(f"a contact sheet needs pictures of one size, got {sorted(sizes)}")
    height, width = next(iter(sizes))[:2]
    columns = max(len(row) for row in rows)
    if len(row_labels) > len(rows) or len(column_labels) > columns:
        raise ValueError(
            f"{len(row_labels)} row labels for {len(rows)} rows, "
            f"{len(column_labels)} column labels for {columns} columns"
        )
    text = max(12, round(height / 18))
    gap, font = max(4, round(text / 3)), _font(text)
    large, small = _font(round(1.4 * text)), _font(max(11, round(0.85 * text)))
    left = gap
    if row_labels:
        left += 4 * gap + max(_label_width(label, font, small) for label in row_labels)
    top = gap + (round(2.2 * text) if title else 0)
    grid_top = top + (round(1.6 * text) if column_labels else 0)
    full_width = max(
        left + columns * (width + gap),
        *(_width(line, f) + 4 * gap for line, f in ((title, large), (caption, small))),
    )
    step = height + gap + (round(1.4 * text) if notes else 0)
    full_height = grid_top + len(rows) * step + (round(1.8 * text) if caption else 0)

    page = Image.new("RGB", (full_width, full_height), _PAPER)
    draw = ImageDraw.Draw(page)
    if title:
        draw.text((left, gap + 0.8 * text), title, _INK, large, anchor="lm")
    for j, label in enumerate(column_labels):
        middle = left + j * (width + gap) + width / 2
        draw.text((middle, top + 0.75 * text), label, _INK, font, anchor="mm")
    for i, row in enumerate(rows):
        y = grid_top + i * step
        if i < len(row_labels):
            lines = row_labels[i].split("\n")
            for k, line in enumerate(lines):
                middle = y + height / 2 + (k - (len(lines) - 1) / 2) * 1.35 * text
                ink, letters = (_PALE_INK, small) if k else (_INK, font)
                draw.text((left - 2 * gap, middle), line, ink, letters, anchor="rm")
        for j, image in enumerate(row):
            page.paste(to_picture(image), (left + j * (width + gap), y))
        for j, note in enumerate(notes[i] if i < len(notes) else ()):
            below = (left + j * (width + gap) + width / 2, y + height + 0.75 * text)
            draw.text(below, note, _PALE_INK, small, anchor="mm")
    if caption:
        draw.text((left, full_height - 0.9 * text), caption, _PALE_INK, small, anchor="lm")
    return torch.from_numpy(np.asarray(page, dtype=np.float32) / 255.0)


FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF")
"""Pictures that are read; others of Pillow's many formats are programs, or need one."""

MOST_PIXELS = 1 << 26
"""67 million, more than cameras have: a picture of a few kilobytes can claim billions."""


def open_picture(path: str | os.PathLike[str], proportions: tuple[int, int] | None = None) -> Image.Image:
    """A picture from a file, as it is there: any mode, any size up to `MOST_PIXELS`.

    Args:
        path: the file
        proportions: width and height of which it must be a multiple (to 2 %); found out before it is unpacked

    Raises:
        ProgdfError: it is missing, no picture, too large, or of other proportions.
    """
    with _open(path) as picture:
        width, height = picture.size
        if proportions is not None and abs(width * proportions[1] / (height * proportions[0]) - 1) > 0.02:
            raise ProgdfError(
                f"{path} is {width}x{height} pixels, its view {proportions[0]}x{proportions[1]}; "
                "keep the proportions of the original view"
            )
        picture.load()
        return picture.copy()


def picture_size(path: str | os.PathLike[str]) -> tuple[int, int]:
    """Width and height of a picture. Raises ProgdfError as `open_picture` does."""
    with _open(path) as picture:
        return picture.size


def picture_text(path: str | os.PathLike[str], key: str) -> str | None:
    """A text that a .png carries under `key`, before its pixels or behind them; None where there is none.

    Raises ProgdfError as `open_picture` does.
    """
    with _open(path) as picture:
        if not isinstance(picture, PngImageFile):
            return None
        found = picture.text.get(key)
        return None if found is None else str(found)


@contextmanager
def _open(path: str | os.PathLike[str]) -> Iterator[Image.Image]:
    check_regular(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the limit here is lower
            opened = Image.open(path, formats=FORMATS)
        with opened:
            width, height = opened.size
            if width * height > MOST_PIXELS:
                raise ProgdfError(f"{path} has {width}x{height} pixels, too many; scale it down")
            yield opened
    except ProgdfError:
        raise
    except Exception as error:  # every format's reader raises its own when a file is damaged
        reason = "it does not exist" if isinstance(error, FileNotFoundError) else type(error).__name__
        raise ProgdfError(f"{path} cannot be read as a picture ({reason}); save it as PNG") from error


def flatten_onto(picture: Image.Image, color: str, size: tuple[int, int] | None = None) -> Image.Image:
    """The picture without transparency, on a paper of one color, scaled to `size`. RGB"""
    if not picture.has_transparency_data:
        plain = picture.convert("RGB")
        return plain if size in (None, plain.size) else plain.resize(size, Image.Resampling.LANCZOS)
    paper = Image.new("RGBA", picture.size, color)
    paper.alpha_composite(picture.convert("RGBA"))
    return flatten_onto(paper.convert("RGB"), color, size)


def to_picture(image: Tensor) -> Image.Image:
    """[H,W,3], 0..1 (what lies outside is cut) -> 8-bit picture, rounded."""
    return Image.fromarray((image.detach().clamp(0, 1) * 255.0).round().to(torch.uint8).cpu().numpy())


def write_image(path: str | os.PathLike[str], image: Tensor) -> None:
    """Write an image [H,W,3], 0..1, in the format of the file's ending; the folder is made if need be."""
    make_folder(Path(path).parent)
    with atomic_write(path) as temporary_file:
        # zlib's level 2 takes half the time of Pillow's own 6 for files 5 % larger
        to_picture(image).save(temporary_file, compress_level=2)


def _font(size: int) -> _Font:
    return ImageFont.load_default(size=size)


def _label_width(label: str, font: _Font, small: _Font) -> int:
    return max(_width(line, small if k else font) for k, line in enumerate(label.split("\n")))


def _width(line: str, font: _Font) -> int:
    return round(font.getlength(line))


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
