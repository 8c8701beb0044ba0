"""Pictures as files: read upright in 8 bits, written whole; and contact sheets of them."""

from __future__ import annotations

import io
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image, ImageDraw, ImageFont
from PIL.JpegImagePlugin import JpegImageFile, get_sampling
from PIL.PngImagePlugin import PngImageFile
from torch import Tensor

from progdf.errors import ProgdfError

from .atomic import atomic_write, check_regular, make_folder

_PAPER = (250, 249, 246)
_INK = (38, 36, 34)
_PALE_INK = (118, 113, 107)
_Font = ImageFont.FreeTypeFont | ImageFont.ImageFont

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "GIF")
"""Pictures that are read; others of Pillow's many formats are programs, or need one."""

MAX_PIXELS = 1 << 26
"""67 million, more than cameras have: a picture of a few kilobytes can claim billions."""


_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What puts a picture upright, by its EXIF orientation; from 5 on width and height change places."""

_BYTES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "RGBa", "CMYK", "YCbCr", "HSV")
"""Pillow's modes of 8 bits a channel, or less."""

# tags of TIFF
_BITS = 258
_INTERPRETATION = 262
_WHITE_IS_ZERO = 0


def open_picture(
    path: str | os.PathLike[str],
    proportions: tuple[int, int] | None = None,
    calibrated: bool = False,
    two_values: bool = False,
) -> Image.Image:
    """A picture from a file, upright, in any mode of 8 bits a channel, any size up to `MAX_PIXELS`.

    Args:
        path: the file
        proportions: width and height of which it must be a multiple (to 2 %); found out before it is unpacked
        calibrated: it is a photograph of a camera whose pixels are known: what is stored turned is refused
        two_values: numbers of more than 8 bits that are 0 or one other value become black and white

    Raises:
        ProgdfError: it is missing, no picture, too large, of other proportions, or its numbers have no white.
    """
    with _open(path) as picture:
        stored = _orientation(picture)
        _check_proportions(path, _upright_size(picture, stored), proportions)
        picture.load()
        # Pillow turns a .tiff itself; a .png may say how it is stored behind its pixels
        turn = _orientation(picture, loaded=True)
        if calibrated and (stored > 1 or turn > 1):
            raise _orientation_error(path, max(stored, turn))
        upright = _to_bytes(path, picture, two_values)
        upright = upright.transpose(_TURNS[turn]) if turn in _TURNS else upright.copy()
        _check_proportions(path, upright.size, proportions)
        return upright


def picture_size(path: str | os.PathLike[str], calibrated: bool = False) -> tuple[int, int]:
    """Width and height of a picture that is upright. Arguments and errors are those of `open_picture`."""
    with _open(path) as picture:
        stored = _orientation(picture)
        if calibrated and stored >= 5:
            raise _orientation_error(path, stored)
        return _upright_size(picture, stored)


def _orientation(picture: Image.Image, loaded: bool = False) -> int:
    """The EXIF orientation, 1 (upright) to 8; of a .png that is not loaded only where it stands first."""
    if isinstance(picture, PngImageFile) and not loaded and "exif" not in picture.info:
        return 1  # Pillow would unpack it to look
    orientation = picture.getexif().get(ExifTags.Base.Orientation)
    return orientation if orientation in _TURNS else 1


def _upright_size(picture: Image.Image, orientation: int) -> tuple[int, int]:
    """Width and height once it is upright."""
    # Pillow's own size of a .tiff is that of one version as stored, of another upright
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
        f"{path} is stored turned (EXIF orientation {orientation}), and nothing says whether its camera was "
        "calibrated before or after turning it; save it upright, without that tag"
    )


def _to_bytes(path: str | os.PathLike[str], picture: Image.Image, two_values: bool) -> Image.Image:
    """Return the picture in 8 bits a channel; Pillow's own conversion of 16 cuts all above 255.

    `two_values`: see `open_picture`
    """
    if picture.mode in _BYTES:
        return picture
    if two_values and picture.mode.startswith(("I", "F")):
        numbers = np.asarray(picture)
        if set(np.unique(numbers).tolist()) <= {0, numbers.max()}:
            return Image.fromarray(np.where(numbers > 0, 255, 0).astype(np.uint8))
    # Pillow had a mode of 32 bits for .png files of 16
    if not picture.mode.startswith("I;16") and (picture.mode, picture.format) != ("I", "PNG"):
        kind = f"{picture.mode} colors"
        if picture.mode in ("I", "F"):
            kind = "32-bit or floating-point numbers, which have no white"
        raise ProgdfError(f"{path} holds {kind}; save it in gray or RGB with 8 or 16 bits per channel")
    stored = np.asarray(picture)
    tags = getattr(picture, "tag_v2", {})
    shades = np.arange(1 << 16) / ((1 << tags.get(_BITS, (16,))[0]) - 1)
    if tags.get(_INTERPRETATION) == _WHITE_IS_ZERO:
        shades = 1.0 - shades
    gray = Image.fromarray((shades.clip(0.0, 1.0) * 255.0).round().astype(np.uint8)[stored])
    if isinstance(clear := picture.info.get("transparency"), int):
        gray.putalpha(Image.fromarray(np.where(stored == clear, 0, 255).astype(np.uint8)))
    return gray


def picture_text(path: str | os.PathLike[str], key: str) -> str | None:
    """A text that a .png carries under `key`, before its pixels or behind them; None where there is none.

    Raises ProgdfError as `open_picture` does.
    """
    with _open(path) as picture:
        if not isinstance(picture, PngImageFile):
            return None
        text = picture.text.get(key)
        return None if text is None else str(text)


def save_as(path: str | os.PathLike[str]) -> Callable[[Tensor], Tensor]:
    """What saving leaves of an image [H,W,3] 0..1, in the way in which a file was saved: by a JPEG's tables
    and subsampling, else in 8 bits. Raises ProgdfError as `open_picture` does."""
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
            # the limit here is lower than Pillow's; what is damaged is read or refused, not both
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            warnings.simplefilter("ignore", UserWarning)
            with Image.open(path, formats=FORMATS) as opened:
                width, height = opened.size
                if width * height > MAX_PIXELS:
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


def read_picture(path: Path, size: tuple[int, int] | None = None, calibrated: bool = False) -> Tensor:
    """Read a picture as [H,W,3] float32 0..1; transparency counts as white.

    Args:
        path: the file
        size: width and height to scale to
        calibrated: see `open_picture`

    Raises:
        ProgdfError: as `open_picture`, whose proportions are those of `size`.
    """
    picture = flatten_onto(open_picture(path, size, calibrated), "white", size)
    return torch.from_numpy(np.asarray(picture, dtype=np.float32) / 255.0)


_OPAQUE = 128  # of 255
# of 255: within a tenth of black and of white
_BLACK = 26
_WHITE = 229
_DRAWN_SHARE = 0.001  # of the opaque pixels: fewer black or white ones are no drawing
_LABEL_BRIGHTNESS = 32  # of 255: the hue of darker pixels is noise
_MAX_LABEL_COLORS = 256  # a picture with more colors is no map of labels


def read_mask(path: Path, size: tuple[int, int], calibrated: bool = False) -> Tensor:
    """Return a mask, bright inside and black outside, scaled by area. [H,W] float32 0..1

    The brightest channel of a pixel counts, so that a mask may be red on black. Of two values, 0 and another,
    the other one is inside, whatever its number. Where transparency varies it is the mask, unless the opaque
    pixels are drawn in black and white themselves; then both count. Masks are never inverted.

    Args:
        path: the file
        size: width and height to scale to
        calibrated: see `open_picture`

    Raises:
        ProgdfError: as `open_picture`, or the picture is a map of labels in several colors.
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
        opaque = gray[alpha >= _OPAQUE]
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
    """Return a picture's transparency, [H,W] uint8; None where it is the same everywhere."""
    if not picture.has_transparency_data:
        return None
    alpha = np.asarray(picture.convert("RGBA").getchannel("A"))
    return None if alpha.min() == alpha.max() else alpha


def _is_drawn(opaque: np.ndarray) -> bool:
    """Return whether pixels are a drawing in black and white, with hardly anything else. [P] uint8"""
    black = float((opaque <= _BLACK).mean()) if len(opaque) else 0.0
    white = float((opaque >= _WHITE).mean()) if len(opaque) else 0.0
    return min(black, white) >= _DRAWN_SHARE and black + white >= 0.9


def _check_labels(path: Path, picture: Image.Image) -> None:
    """Raise ProgdfError where an RGB picture has few colors, and among them two hues: a map of labels."""
    colors = picture.getcolors(_MAX_LABEL_COLORS) or []
    hues = set()
    for _, color in colors:
        brightest = max(color)  # type: ignore[arg-type]
        if brightest < _LABEL_BRIGHTNESS:
            continue
        hues.add(tuple(round(4 * channel / brightest) for channel in color))  # type: ignore[union-attr]
    hues.discard((4, 4, 4))
    if len(hues) > 1:
        raise ProgdfError(
            f"{path} has {len(hues)} colors beside gray, as a map of labels has; "
            "save the one thing white on black"
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
    gap = max(4, round(text / 3))
    font = _font(text)
    large = _font(round(1.4 * text))
    small = _font(max(11, round(0.85 * text)))
    left = gap
    if row_labels:
        parts = [part for label in row_labels for part in enumerate(label.split("\n"))]
        left += 4 * gap + max(_width(line, small if k else font) for k, line in parts)
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


def _font(size: int) -> _Font:
    return ImageFont.load_default(size=size)


def _width(line: str, font: _Font) -> int:
    return round(font.getlength(line))
