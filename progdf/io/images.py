"""Picture files: read upright in 8 bits, written atomically; and contact sheets."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image, ImageDraw, ImageFont, UnidentifiedImageError
from PIL.JpegImagePlugin import JpegImageFile, get_sampling
from PIL.PngImagePlugin import PngImageFile
from torch import Tensor

from progdf.errors import ProgdfError

from .atomic import atomic_write, check_regular, make_folder

_SHEET_COLOR = (250, 249, 246)
_TEXT_COLOR = (38, 36, 34)
_NOTE_COLOR = (118, 113, 107)
_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF")
"""Pillow formats that are read. Some of Pillow's other formats are programs, or need an external one."""

MAX_PIXELS = 1 << 26
"""Largest number of pixels: 67 million, above any camera. A file of a few kilobytes can claim billions."""


_TRANSPOSES = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Transpose operation that makes a picture upright, by EXIF orientation. From 5 on, the sides are swapped."""

_BYTE_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "RGBa", "CMYK", "YCbCr", "HSV")
"""Pillow modes with at most 8 bits per channel."""

# TIFF tags
_BITS_TAG = 258
_INTERPRETATION_TAG = 262
_WHITE_IS_ZERO = 0


def open_picture(
    path: str | os.PathLike[str],
    proportions: tuple[int, int] | None = None,
    calibrated: bool = False,
    two_values: bool = False,
) -> Image.Image:
    """Open a picture upright, in any mode of 8 bits per channel and any size up to `MAX_PIXELS`.

    Args:
        path: the file
        proportions: required aspect ratio as width and height, within 2 %; checked before decoding
        calibrated: refuse a rotated photograph, as the camera calibration refers to one of its orientations
        two_values: map pixels of more than 8 bits to black and white if they are 0 or one other value

    Raises:
        ProgdfError: the file is missing, not a picture or too large, or its aspect ratio or number type is
            wrong. Number types without a defined white are refused.
    """
    with _open(path) as picture:
        stored_orientation = _orientation(picture)
        _check_proportions(path, _upright_size(picture, stored_orientation), proportions)
        picture.load()
        # Pillow rotates a .tiff itself; a .png may state its orientation after its pixels
        orientation = _orientation(picture, loaded=True)
        if calibrated and (stored_orientation > 1 or orientation > 1):
            raise _orientation_error(path, max(stored_orientation, orientation))
        upright = _to_bytes(path, picture, two_values)
        upright = (
            upright.transpose(_TRANSPOSES[orientation]) if orientation in _TRANSPOSES else upright.copy()
        )
        _check_proportions(path, upright.size, proportions)
        return upright


def picture_size(path: str | os.PathLike[str], calibrated: bool = False) -> tuple[int, int]:
    """Return the width and height of a picture when upright. Arguments and errors as in `open_picture`."""
    with _open(path) as picture:
        orientation = _orientation(picture)
        if calibrated and orientation >= 5:
            raise _orientation_error(path, orientation)
        return _upright_size(picture, orientation)


def _orientation(picture: Image.Image, loaded: bool = False) -> int:
    """Return the EXIF orientation, 1 (upright) to 8.

    Before a .png is loaded, only an orientation stored ahead of its pixels is found.
    """
    if isinstance(picture, PngImageFile) and not loaded and "exif" not in picture.info:
        return 1  # Pillow would decode the whole picture to find it
    orientation = picture.getexif().get(ExifTags.Base.Orientation)
    return orientation if orientation in _TRANSPOSES else 1


def _upright_size(picture: Image.Image, orientation: int) -> tuple[int, int]:
    """Return the width and height of a picture when upright."""
    # for a .tiff, some Pillow versions report the stored size and others the upright size
    tags = getattr(picture, "tag_v2", {})
    width = int(tags.get(256, picture.width))
    height = int(tags.get(257, picture.height))
    return (height, width) if orientation >= 5 else (width, height)


def _check_proportions(
    path: str | os.PathLike[str], size: tuple[int, int], proportions: tuple[int, int] | None
) -> None:
    if proportions is not None and abs(size[0] * proportions[1] / (size[1] * proportions[0]) - 1) > 0.02:
        raise ProgdfError(
            f"{path} is {size[0]}x{size[1]} pixels, its view {proportions[0]}x{proportions[1]}; "
            "keep the proportions of the original view"
        )


def _orientation_error(path: str | os.PathLike[str], orientation: int) -> ProgdfError:
    return ProgdfError(
        f"{path} is stored rotated (EXIF orientation {orientation}), so it is unclear which orientation its "
        "camera calibration refers to; save it upright, without that tag"
    )


def _to_bytes(path: str | os.PathLike[str], picture: Image.Image, two_values: bool) -> Image.Image:
    """Convert a picture to 8 bits per channel. Pillow's own conversion of 16 bits clips values above 255.

    Args:
        path: the file, for errors
        picture: the decoded picture
        two_values: see `open_picture`
    """
    if picture.mode in _BYTE_MODES:
        return picture
    if two_values and picture.mode.startswith(("I", "F")):
        values = np.asarray(picture)
        if set(np.unique(values).tolist()) <= {0, values.max()}:
            return Image.fromarray(np.where(values > 0, 255, 0).astype(np.uint8))
    # older Pillow versions open 16-bit .png files in a 32-bit mode
    if not picture.mode.startswith("I;16") and (picture.mode, picture.format) != ("I", "PNG"):
        kind = f"{picture.mode} colors"
        if picture.mode in ("I", "F"):
            kind = "32-bit or floating-point numbers, which have no white"
        raise ProgdfError(f"{path} holds {kind}; save it in gray or RGB with 8 or 16 bits per channel")
    stored = np.asarray(picture)
    tags = getattr(picture, "tag_v2", {})
    shades = np.arange(1 << 16) / ((1 << tags.get(_BITS_TAG, (16,))[0]) - 1)
    if tags.get(_INTERPRETATION_TAG) == _WHITE_IS_ZERO:
        shades = 1.0 - shades
    gray = Image.fromarray((shades.clip(0.0, 1.0) * 255.0).round().astype(np.uint8)[stored])
    transparent_value = picture.info.get("transparency")
    if isinstance(transparent_value, int):
        gray.putalpha(Image.fromarray(np.where(stored == transparent_value, 0, 255).astype(np.uint8)))
    return gray


def picture_text(path: str | os.PathLike[str], key: str) -> str | None:
    """Return the text chunk of a .png with the given key, before or after its pixels; None if missing.

    Raises:
        ProgdfError: see `open_picture`.
    """
    with _open(path) as picture:
        if not isinstance(picture, PngImageFile):
            return None
        text = picture.text.get(key)
        return None if text is None else str(text)


def saving_loss(path: str | os.PathLike[str]) -> Callable[[Tensor], Tensor]:
    """Return a function that applies the losses of saving an image in the format of a file.

    A JPEG is imitated with its quantization tables and subsampling, other formats with rounding to 8 bits.
    The function maps [H,W,3] to [H,W,3], 0 to 1.

    Raises:
        ProgdfError: see `open_picture`.
    """
    with _open(path) as picture:
        lossy = isinstance(picture, JpegImageFile) and picture.mode == "RGB"
        tables = dict(picture.quantization) if lossy else {}  # type: ignore[attr-defined]
        sampling = get_sampling(picture) if lossy else 0

    def save(image: Tensor) -> Tensor:
        saved = to_picture(image)
        if tables:
            file = io.BytesIO()
            saved.save(file, "JPEG", qtables=tables, subsampling=max(sampling, 0))
            saved = Image.open(file)
        return torch.from_numpy(np.asarray(saved, dtype=np.float32) / 255.0)

    return save


@contextmanager
def _open(path: str | os.PathLike[str]) -> Iterator[Image.Image]:
    check_regular(path)
    try:
        with warnings.catch_warnings():
            # the limit here is lower than Pillow's; a damaged file is read or refused, without a warning
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            warnings.simplefilter("ignore", UserWarning)
            with Image.open(path, formats=FORMATS) as opened:
                width, height = opened.size
                if width * height > MAX_PIXELS:
                    raise ProgdfError(f"{path} has {width}x{height} pixels, too many; scale it down")
                yield opened
    except ProgdfError:
        raise
    except Exception as error:  # each format's reader raises its own errors
        reason = _read_failure(error)
        raise ProgdfError(f"{path} cannot be read as a picture ({reason}); save it as PNG") from error


def _read_failure(error: Exception) -> str:
    """Return why a picture cannot be read, as a part of a message."""
    if isinstance(error, UnidentifiedImageError):
        return f"it is none of {', '.join(FORMATS)}"
    if isinstance(error, Image.DecompressionBombError):
        return f"it has more than {MAX_PIXELS // 1_000_000} million pixels"
    if isinstance(error, FileNotFoundError):
        return "it does not exist"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return " ".join(str(error).split())[:100] or type(error).__name__


def flatten_onto(picture: Image.Image, color: str, size: tuple[int, int] | None = None) -> Image.Image:
    """Composite a picture on a background color and scale it to `size`. Returns an RGB picture."""
    if not picture.has_transparency_data:
        opaque = picture.convert("RGB")
        return opaque if size in (None, opaque.size) else opaque.resize(size, Image.Resampling.LANCZOS)
    background = Image.new("RGBA", picture.size, color)
    background.alpha_composite(picture.convert("RGBA"))
    return flatten_onto(background.convert("RGB"), color, size)


def to_picture(image: Tensor) -> Image.Image:
    """Convert an image [H,W,3], clamped to 0 to 1, to an 8-bit picture, rounded."""
    return Image.fromarray((image.detach().clamp(0, 1) * 255.0).round().to(torch.uint8).cpu().numpy())


def write_image(path: str | os.PathLike[str], image: Tensor) -> None:
    """Write an image [H,W,3], 0 to 1, in the format of the file's ending. Missing folders are created."""
    make_folder(Path(path).parent)
    with atomic_write(path) as temporary_file:
        # zlib level 2 takes half the time of Pillow's default 6, and files are 5 % larger
        to_picture(image).save(temporary_file, compress_level=2)


def read_picture(path: Path, size: tuple[int, int] | None = None, calibrated: bool = False) -> Tensor:
    """Read a picture as [H,W,3] float32, 0 to 1. Transparent areas become white.

    Args:
        path: the file
        size: width and height to scale to; the picture must have this aspect ratio
        calibrated: see `open_picture`

    Raises:
        ProgdfError: see `open_picture`.
    """
    picture = flatten_onto(open_picture(path, size, calibrated), "white", size)
    return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0)


_MIN_OPAQUE = 128  # alpha of an opaque pixel, 0 to 255
_MAX_BLACK = 26  # within a tenth of black, 0 to 255
_MIN_WHITE = 229  # within a tenth of white, 0 to 255
_MIN_DRAWN_SHARE = 0.001  # smallest share of black and of white among the opaque pixels of a drawing
_MIN_LABEL_BRIGHTNESS = 32  # 0 to 255; the hue of darker pixels is noise
_MAX_LABEL_COLORS = 256  # a picture with more colors is not a label map


def read_mask(path: Path, size: tuple[int, int], calibrated: bool = False) -> Tensor:
    """Read a mask, bright inside and black outside, scaled by area. [H,W] float32, 0 to 1

    The brightest channel of a pixel counts, so a mask may be red on black. If a mask only has 0 and one other
    value, the other value is inside. If the alpha channel varies, it is the mask. If the opaque pixels are
    also a black and white drawing, the mask is the minimum of both. Masks are never inverted.

    Args:
        path: the file
        size: width and height to scale to; the picture must have this aspect ratio
        calibrated: see `open_picture`

    Raises:
        ProgdfError: see `open_picture`, or the picture is a label map in several colors.
    """
    picture = open_picture(path, size, calibrated, two_values=True)
    alpha = _varying_alpha(picture)
    if picture.mode not in ("1", "L", "LA"):
        picture = picture.convert("RGBA").convert("RGB")  # RGBA first, as palettes may be transparent
    elif picture.mode == "LA":
        picture = picture.getchannel("L")
    channels = np.asarray(picture.convert("RGB"))
    gray: np.ndarray = channels.max(axis=2)
    if alpha is not None:
        opaque = gray[alpha >= _MIN_OPAQUE]
        gray = alpha if not _is_drawn(opaque) else np.minimum(gray, alpha)
    else:
        _check_labels(path, picture.convert("RGB"))
    values = np.flatnonzero(np.bincount(gray.ravel(), minlength=256))
    if len(values) == 2 and values[0] == 0:
        gray = np.where(gray > 0, 255, 0).astype(np.uint8)
    mask = Image.fromarray(gray)
    if mask.size != size:
        mask = mask.resize(size, Image.Resampling.BOX)
    return torch.from_numpy(np.asarray(mask, dtype=np.float32) / 255.0)


def _varying_alpha(picture: Image.Image) -> np.ndarray | None:
    """Return the alpha channel of a picture, [H,W] uint8; None if it is constant."""
    if not picture.has_transparency_data:
        return None
    alpha = np.asarray(picture.convert("RGBA").getchannel("A"))
    return None if alpha.min() == alpha.max() else alpha


def _is_drawn(opaque: np.ndarray) -> bool:
    """Return whether at least 90 % of the pixels are black or white, and both occur. [P] uint8"""
    black = float((opaque <= _MAX_BLACK).mean()) if len(opaque) else 0.0
    white = float((opaque >= _MIN_WHITE).mean()) if len(opaque) else 0.0
    return min(black, white) >= _MIN_DRAWN_SHARE and black + white >= 0.9


def _check_labels(path: Path, picture: Image.Image) -> None:
    """Raise ProgdfError if an RGB picture has few colors and at least two hues, as label maps do."""
    colors = picture.getcolors(_MAX_LABEL_COLORS) or []
    hues = set()
    for _, color in colors:
        brightest = max(color)  # type: ignore[arg-type]
        if brightest < _MIN_LABEL_BRIGHTNESS:
            continue
        hues.add(tuple(round(4 * channel / brightest) for channel in color))  # type: ignore[union-attr]
    hues.discard((4, 4, 4))
    if len(hues) > 1:
        raise ProgdfError(
            f"{path} has {len(hues)} colors besides gray, like a label map; save one object as white on black"
        )


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
        rows: pictures of one size, row by row; rows may have different lengths. [H,W,3] each, 0 to 1
        row_labels: text to the left of each row; lines after the first are smaller and paler
        column_labels: text above each column
        title: line at the top
        caption: smaller line at the bottom
        notes: text under each picture, row by row

    Returns:
        The sheet. [H',W',3], 0 to 1

    Raises:
        ValueError: there are no pictures, their sizes differ, or labels outnumber rows or columns.
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
    gap = max(4, round(text / 3))
    font = _font(text)
    large = _font(round(1.4 * text))
    small = _font(max(11, round(0.85 * text)))
    left = gap
    if row_labels:
        parts = [part for label in row_labels for part in enumerate(label.split("\n"))]
        left += 4 * gap + max(_text_width(line, small if k else font) for k, line in parts)
    top = gap + (round(2.2 * text) if title else 0)
    grid_top = top + (round(1.6 * text) if column_labels else 0)
    full_width = max(
        left + columns * (width + gap),
        *(_text_width(line, f) + 4 * gap for line, f in ((title, large), (caption, small))),
    )
    step = height + gap + (round(1.4 * text) if notes else 0)
    full_height = grid_top + len(rows) * step + (round(1.8 * text) if caption else 0)

    page = Image.new("RGB", (full_width, full_height), _SHEET_COLOR)
    draw = ImageDraw.Draw(page)
    if title:
        draw.text((left, gap + 0.8 * text), title, _TEXT_COLOR, large, anchor="lm")
    for j, label in enumerate(column_labels):
        middle = left + j * (width + gap) + width / 2
        draw.text((middle, top + 0.75 * text), label, _TEXT_COLOR, font, anchor="mm")
    for i, row in enumerate(rows):
        y = grid_top + i * step
        if i < len(row_labels):
            lines = row_labels[i].split("\n")
            for k, line in enumerate(lines):
                middle = y + height / 2 + (k - (len(lines) - 1) / 2) * 1.35 * text
                color, line_font = (_NOTE_COLOR, small) if k else (_TEXT_COLOR, font)
                draw.text((left - 2 * gap, middle), line, color, line_font, anchor="rm")
        for j, image in enumerate(row):
            page.paste(to_picture(image), (left + j * (width + gap), y))
        for j, note in enumerate(notes[i] if i < len(notes) else ()):
            below = (left + j * (width + gap) + width / 2, y + height + 0.75 * text)
            draw.text(below, note, _NOTE_COLOR, small, anchor="mm")
    if caption:
        draw.text((left, full_height - 0.9 * text), caption, _NOTE_COLOR, small, anchor="lm")
    return torch.from_numpy(np.asarray(page, dtype=np.float32) / 255.0)


def _font(size: int) -> _Font:
    return ImageFont.load_default(size=size)


def _text_width(line: str, font: _Font) -> int:
    return round(font.getlength(line))
