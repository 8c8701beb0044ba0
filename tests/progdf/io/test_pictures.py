"""Tests of contact sheets and of reading and writing pictures."""

from __future__ import annotations

import resource
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import ExifTags, Image, ImageOps
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import (
    _TRANSPOSES,
    contact_sheet,
    flatten_onto,
    open_picture,
    picture_size,
    read_picture,
    write_image,
)
from tests.helpers.hostile import bomb, chunk
from tests.helpers.refused import refusal


def _plain(red: float) -> Tensor:
    return torch.tensor([red, 0.2, 0.4]).expand(40, 50, 3)


def _found(sheet: Tensor, red: float) -> int:
    color = torch.tensor([red, 0.2, 0.4])
    return int(((sheet - color).abs().amax(dim=2) < 1 / 255).sum())


def test_contact_sheet_contains_every_picture_unchanged() -> None:
    shades = [0.0, 0.25, 0.5, 0.75, 1.0]
    sheet = contact_sheet([[_plain(r) for r in shades[:3]], [_plain(r) for r in shades[3:]]])
    assert [_found(sheet, red) for red in shades] == [40 * 50] * 5


def test_labels_do_not_cover_pictures() -> None:
    rows = [[_plain(0.3)], [_plain(0.6)]]
    bare = contact_sheet(rows)
    worded = contact_sheet(rows, ["one", "a longer word"], ["strength 0.5"], "Title", "caption")
    assert worded.shape[0] > bare.shape[0]
    assert worded.shape[1] > bare.shape[1]
    assert _found(worded, 0.3) == _found(worded, 0.6) == 40 * 50
    dark = (worded.amax(dim=2) < 0.5).sum() - (bare.amax(dim=2) < 0.5).sum()
    assert dark > 50


def test_long_title_widens_the_sheet() -> None:
    sheet = contact_sheet([[_plain(0.3)]], title="a title far longer than one small picture is wide")
    assert sheet.shape[1] > 300
    assert (sheet[:, -3:] - sheet[0, 0]).abs().max() < 1e-6


def test_pictures_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="pictures of one size"):
        contact_sheet([[_plain(0.1), torch.zeros(3, 3, 3)]])
    with pytest.raises(ValueError, match="pictures of one size"):
        contact_sheet([])


def test_more_labels_than_columns_are_refused() -> None:
    with pytest.raises(ValueError, match="2 column labels"):
        contact_sheet([[_plain(0.1)]], column_labels=["a", "b"])


def test_image_is_written_atomically_and_clamped(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.png"
    write_image(path, torch.tensor([[[-1.0, 0.5, 2.0]]]))
    assert np.asarray(Image.open(path)).tolist() == [[[0, 128, 255]]]
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


def test_image_for_an_impossible_folder_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    with pytest.raises(ProgdfError, match="taken is a file; give the name of a folder"):
        write_image(tmp_path / "taken" / "a.png", torch.zeros(1, 1, 3))


@pytest.mark.parametrize("size", [(13_000, 13_000), (1_000_000_000, 1), (8_200, 8_200)])
def test_oversized_picture_is_refused_before_unpacking(size: tuple[int, int], tmp_path: Path) -> None:
    path = bomb(tmp_path / "a.png", *size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refusal(open_picture, path)
    refusal(picture_size, path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_picture_of_other_proportions_is_not_unpacked(tmp_path: Path) -> None:
    path = bomb(tmp_path / "a.png", 8_000, 8_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "proportions" in refusal(lambda p: open_picture(p, (40, 30)), path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_postscript_is_not_a_picture(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\n")
    assert "it is none of PNG, JPEG" in refusal(open_picture, path)


def test_damaged_picture_is_refused_with_its_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    Image.effect_noise((60, 60), 9.0).save(path)
    path.write_bytes(path.read_bytes()[:900])
    assert "image file is truncated" in refusal(open_picture, path)
    assert "it has more than 67 million pixels" in refusal(open_picture, bomb(path, 100_000, 100_000))
    assert "it does not exist" in refusal(open_picture, tmp_path / "b.png")


def test_transparency_becomes_the_background(tmp_path: Path) -> None:
    Image.new("RGBA", (4, 2), (255, 0, 0, 0)).save(tmp_path / "a.png")
    Image.new("L", (4, 2), 7).save(tmp_path / "b.png")
    assert flatten_onto(open_picture(tmp_path / "a.png"), "white").getpixel((0, 0)) == (255, 255, 255)
    assert flatten_onto(open_picture(tmp_path / "a.png"), "black", (8, 4)).getpixel((0, 0)) == (0, 0, 0)
    assert flatten_onto(open_picture(tmp_path / "b.png"), "white").getpixel((0, 0)) == (7, 7, 7)


RAMP = np.linspace(0.0, 1.0, 64)[None, :].repeat(16, axis=0)
"""Ramp from black on the left to white on the right. [16,64]"""


def write_png(path: Path, ramp: np.ndarray, color: int, *extra: tuple[bytes, bytes]) -> Path:
    """Write a .png with 16 bits per channel, more chunks last.

    `color` is 0 for gray, 2 for RGB, and 4 and 6 for the same with alpha.
    """
    gray = np.round(ramp * 65535).astype(np.uint16)[..., None]
    channels = [gray] * (1 if color in (0, 4) else 3) + [np.full_like(gray, 65535)] * (color >= 4)
    pixels = np.concatenate(channels, axis=2).astype(">u2")
    rows = b"".join(b"\0" + row.tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", *ramp.shape[::-1], 16, color, 0, 0, 0)
    chunks = [(b"IHDR", header), (b"IDAT", zlib.compress(rows)), *extra, (b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*parts) for parts in chunks))
    return path


def write_tiff(
    path: Path, pixels: bytes, bits: int, kind: int = 1, interpretation: int = 1, order: str = "<"
) -> Path:
    """Write a .tiff of one gray strip of the size of `RAMP`.

    `kind` is 1 for unsigned, 2 for signed and 3 for floating-point values.
    """
    height, width = RAMP.shape
    tags = {256: width, 257: height, 258: bits, 259: 1, 262: interpretation, 273: 8, 277: 1, 278: height}
    tags |= {279: len(pixels), 339: kind}
    entries = b"".join(struct.pack(f"{order}HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    start = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}I", 8 + len(pixels))
    path.write_bytes(start + pixels + struct.pack(f"{order}H", len(tags)) + entries + b"\0\0\0\0")
    return path


def twelve_bits(ramp: np.ndarray) -> bytes:
    """Pack two values into three bytes."""
    a, b = np.round(ramp * 4095).astype(np.uint16).reshape(-1, 2).T
    return np.stack([a >> 4, (a & 15) << 4 | b >> 8, b & 255], axis=1).astype(np.uint8).tobytes()


def whole_numbers(ramp: np.ndarray, form: str) -> bytes:
    return np.round(ramp * 65535).astype(form).tobytes()


RAMPS = {
    "8-bit gray .png": lambda p: Image.fromarray(np.round(RAMP * 255).astype(np.uint8)).save(p / "a.png"),
    "16-bit gray .png": lambda p: write_png(p / "a.png", RAMP, 0),
    "16-bit RGB .png": lambda p: write_png(p / "a.png", RAMP, 2),
    "16-bit gray .png with alpha": lambda p: write_png(p / "a.png", RAMP, 4),
    "16-bit RGB .png with alpha": lambda p: write_png(p / "a.png", RAMP, 6),
    "8-bit palette .gif": lambda p: Image.fromarray(np.round(RAMP * 255).astype(np.uint8)).save(p / "a.gif"),
    "8-bit CMYK .jpg": lambda p: (
        Image.fromarray(np.round(RAMP * 255).astype(np.uint8)).convert("CMYK").save(p / "a.jpg", quality=100)
    ),
    "12-bit .tiff": lambda p: write_tiff(p / "a.tiff", twelve_bits(RAMP), 12),
    "16-bit .tiff": lambda p: write_tiff(p / "a.tiff", whole_numbers(RAMP, "<u2"), 16),
    "16-bit .tiff, big-endian": lambda p: write_tiff(p / "a.tiff", whole_numbers(RAMP, ">u2"), 16, order=">"),
    "16-bit .tiff, white is zero": lambda p: write_tiff(
        p / "a.tiff", whole_numbers(1 - RAMP, "<u2"), 16, interpretation=0
    ),
}


@pytest.mark.parametrize("kind", RAMPS)
def test_ramp_of_any_depth_is_read(kind: str, tmp_path: Path) -> None:
    RAMPS[kind](tmp_path)
    found = read_picture(next(tmp_path.iterdir())).numpy()
    np.testing.assert_allclose(found, RAMP[..., None].repeat(3, axis=2), atol=1.01 / 255)


@pytest.mark.parametrize("form", ["<u4", "<i4", "<f4", "<i2"])
def test_values_without_a_white_level_are_refused(form: str, tmp_path: Path) -> None:
    kind = {"u": 1, "i": 2, "f": 3}[form[1]]
    path = write_tiff(tmp_path / "a.tiff", (RAMP * 1000).astype(form).tobytes(), 8 * int(form[2]), kind)
    assert "which have no white; save it in gray or RGB with 8 or 16 bits" in refusal(open_picture, path)
    Image.new("LAB", (4, 4)).save(tmp_path / "lab.tiff")
    assert "holds LAB colors; save it in gray or RGB" in refusal(open_picture, tmp_path / "lab.tiff")


def test_transparent_gray_of_16_bits_is_transparent(tmp_path: Path) -> None:
    path = write_png(tmp_path / "a.png", RAMP, 0)
    content = path.read_bytes()
    at = content.index(b"IDAT") - 4
    path.write_bytes(content[:at] + chunk(b"tRNS", b"\0\0") + content[at:])
    found = read_picture(path)
    assert found[:, 0].min() == 1.0, "white paper"
    assert found[:, 1].max() < 0.1


# Corners of a rotated picture: its upper left is red, its upper right green.
CORNERS = np.zeros((32, 64, 3), np.uint8)
CORNERS[:16, :32] = (255, 0, 0)
CORNERS[:16, 32:] = (0, 255, 0)
INVERSE = {**{i: i for i in range(1, 8)}, 6: 8, 8: 6}
"""EXIF orientation that undoes each orientation."""


def stored_turned(path: Path, orientation: int) -> Path:
    """Write `CORNERS` as a rotated camera would store it, with the orientation tag."""
    turn = _TRANSPOSES.get(INVERSE[orientation])
    picture = Image.fromarray(CORNERS)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    turned = picture.transpose(turn) if turn is not None else picture
    turned.save(path, exif=exif, **({"quality": 95} if path.suffix == ".jpg" else {}))
    with Image.open(path) as again:
        assert ImageOps.exif_transpose(again).getpixel((8, 8))[0] > 200, "as Pillow turns it, too"
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tiff"])
def test_rotated_picture_is_read_upright(orientation: int, suffix: str, tmp_path: Path) -> None:
    path = stored_turned(tmp_path / f"a{suffix}", orientation)
    assert picture_size(path) == (64, 32)
    found = read_picture(path, (64, 32)).numpy()
    assert np.abs(found[4:12, 4:28] - CORNERS[8, 8] / 255).max() < 0.1
    assert np.abs(found[4:12, 36:60] - CORNERS[8, 40] / 255).max() < 0.1
    if orientation == 1:
        assert open_picture(path, calibrated=True).size == (64, 32)
    else:
        message = refusal(lambda p: open_picture(p, calibrated=True), path)
        assert f"EXIF orientation {orientation}), so it is unclear which orientation" in message


def test_png_with_orientation_after_its_pixels_is_read_upright(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 3
    path = write_png(tmp_path / "a.png", RAMP[:, ::-1], 0, (b"eXIf", exif.tobytes()[6:]))
    assert torch.equal(read_picture(path), read_picture(write_png(tmp_path / "b.png", RAMP, 0)))
    assert "EXIF orientation 3" in refusal(lambda p: open_picture(p, calibrated=True), path)
    exif[ExifTags.Base.Orientation] = 6
    write_png(path, RAMP, 0, (b"eXIf", exif.tobytes()[6:]))
    assert "16x64 pixels, its view 64x16" in refusal(lambda p: open_picture(p, (64, 16)), path)
