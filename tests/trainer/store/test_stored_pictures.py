"""Pictures of a run that are read or cut on several threads."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from progdf.errors import ProgdfError
from progdf.io.images import read_picture, write_image
from progdf.rasterize import set_threads
from trainer.store.run_folder import stored_pictures


@pytest.fixture(autouse=True)
def restore_threads() -> Iterator[None]:
    yield
    set_threads(None)


def test_pictures_are_the_same_on_any_number_of_threads(tmp_path: Path) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(9)]
    for i, path in enumerate(paths):
        write_image(path, torch.rand(12, 17 + i, 3, generator=torch.Generator().manual_seed(i)))
    set_threads(1)
    expected = list(stored_pictures(read_picture, paths))
    for count in (2, 5):
        set_threads(count)
        for picture, alone in zip(stored_pictures(read_picture, paths), expected, strict=True):
            assert torch.equal(picture, alone)


def test_missing_picture_is_reported_from_any_thread(tmp_path: Path) -> None:
    paths = [tmp_path / f"{i}.png" for i in range(6)]
    for path in paths[:-1]:
        write_image(path, torch.rand(4, 4, 3))
    set_threads(3)
    with pytest.raises(ProgdfError, match=r"5\.png"):
        stored_pictures(read_picture, paths)
