"""Contact sheets: every picture is there unchanged, every word is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.pictures import contact_sheet, write_image


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


def test_an_image_is_written_whole_and_cut_to_what_a_file_can_hold(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.png"
    write_image(path, torch.tensor([[[-1.0, 0.5, 2.0]]]))
    assert np.asarray(Image.open(path)).tolist() == [[[0, 128, 255]]]
    assert [p.name for p in path.parent.iterdir()] == ["a.png"]


def test_an_image_for_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    with pytest.raises(ProgdfError, match="taken is a file; give the name of a folder"):
        write_image(tmp_path / "taken" / "a.png", torch.zeros(1, 1, 3))
