"""Contact sheets: every picture is there unchanged, every word is there."""

from __future__ import annotations

import resource
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.io.images import contact_sheet, flatten_onto, open_picture, picture_size, write_image
from tests.helpers.refused import refusal


def _plain(red: float) -> Tensor:
    return torch.tensor([red, 0.2, 0.4]).expand(40, 50, 3)


def _found(sheet: Tensor, red: float) -> int:
    wanted = torch.tensor([red, 0.2, 0.4])
    return int(((sheet - wanted).abs().amax(dim=2) < 1 / 255).sum())


def test_every_picture_is_on_the_sheet_pixel_for_pixel() -> None:
    shades = [0.0, 0.25, 0.5, 0.75, 1.0]
    sheet = contact_sheet([[_plain(r) for r in shades[:3]], [_plain(r) for r in shades[3:]]])
    assert [_found(sheet, red) for red in shades] == [40 * 50] * 5


def test_words_take_room_beside_the_pictures_not_over_them() -> None:
    rows = [[_plain(0.3)], [_plain(0.6)]]
    bare = contact_sheet(rows)
    worded = contact_sheet(rows, ["one", "a longer word"], ["strength 0.5"], "Title", "caption")
    assert worded.shape[0] > bare.shape[0]
    assert worded.shape[1] > bare.shape[1]
    assert _found(worded, 0.3) == _found(worded, 0.6) == 40 * 50
    dark = (worded.amax(dim=2) < 0.5).sum() - (bare.amax(dim=2) < 0.5).sum()
    assert dark > 50


def test_a_long_title_widens_the_sheet() -> None:
    sheet = contact_sheet([[_plain(0.3)]], title="a title far longer than one small picture is wide")
    assert sheet.shape[1] > 300
    assert (sheet[:, -3:] - sheet[0, 0]).abs().max() < 1e-6


def test_pictures_of_different_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match="pictures of one size"):
        contact_sheet([[_plain(0.1), torch.zeros(3, 3, 3)]])
    with pytest.raises(ValueError, match="pictures of one size"):
        contact_sheet([])


def test_more_words_than_columns_are_refused() -> None:
    with pytest.raises(ValueError, match="2 column labels"):
        contact_sheet([[_plain(0.1)]], column_labels=["a", "b"])


def test_an_image_is_atomic_write_and_cut_to_what_a_file_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.png"
    write_image(path, torch.tensor([[[-1.0, 0.5, 2.0]]]))
    assert np.asarray(Image.open(path)).tolist() == [[[0, 128, 255]]]
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


def test_an_image_for_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    with pytest.raises(ProgdfError, match="taken is a file; give the name of a folder"):
        write_image(tmp_path / "taken" / "a.png", torch.zeros(1, 1, 3))


def bomb(path: Path, width: int, height: int) -> Path:
    """A PNG of a few kilobytes that claims many pixels."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))
        )

    header = struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0)
    rows = chunk(b"IDAT", zlib.compress(b"\0" * 2_000_000, 9))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + rows + chunk(b"IEND", b""))
    return path


@pytest.mark.parametrize("size", [(13_000, 13_000), (1_000_000_000, 1), (8_200, 8_200)])
def test_a_picture_that_claims_too_much_is_refused_before_it_is_unpacked(
    size: tuple[int, int], tmp_path: Path
) -> None:
    path = bomb(tmp_path / "a.png", *size)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refusal(open_picture, path)
    refusal(picture_size, path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_a_picture_of_other_proportions_is_not_unpacked(tmp_path: Path) -> None:
    path = bomb(tmp_path / "a.png", 8_000, 8_000)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert "proportions" in refusal(lambda p: open_picture(p, (40, 30)), path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_what_needs_a_program_to_be_read_is_no_picture(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 4 4\n%%EndComments\n")
    refusal(open_picture, path)


def test_transparency_counts_as_the_paper(tmp_path: Path) -> None:
    Image.new("RGBA", (4, 2), (255, 0, 0, 0)).save(tmp_path / "a.png")
    Image.new("L", (4, 2), 7).save(tmp_path / "b.png")
    assert flatten_onto(open_picture(tmp_path / "a.png"), "white").getpixel((0, 0)) == (255, 255, 255)
    assert flatten_onto(open_picture(tmp_path / "a.png"), "black", (8, 4)).getpixel((0, 0)) == (0, 0, 0)
    assert flatten_onto(open_picture(tmp_path / "b.png"), "white").getpixel((0, 0)) == (7, 7, 7)
