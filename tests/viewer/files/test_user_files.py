"""Thumbnails of the start page: saved, read, and damaged in many ways."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from progdf.io.atomic import state_folder
from viewer.files import user_files


def test_damaged_thumbnail_is_ignored_and_made_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    width, height = user_files.THUMBNAIL_SIZE
    pixels = rng.integers(0, 256, (height, width, 3), np.uint8)  # noise takes several chunks of the file
    scene = tmp_path / "bear.ply"
    user_files.keep_thumbnail(scene, pixels)
    (file,) = (state_folder() / "thumbnails").iterdir()
    whole = file.read_bytes()
    cut = [whole[:size] for size in (0, 1, 8, 20, 33, 40, len(whole) // 2, len(whole) - 1)]
    flipped = []
    chunks = [at for at in range(len(whole)) if whole.startswith((b"IDAT", b"IEND"), at)]
    assert len(chunks) > 2
    for at in [
        *range(60),
        *(at + i for at in chunks for i in range(-8, 4)),
        *rng.integers(60, len(whole), 20),
    ]:
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(rng.integers(8))
        flipped.append(bytes(damaged))
    for content in (*cut, *flipped, b"\xff" * 100):
        file.write_bytes(content)
        found = user_files.load_thumbnail(scene)
        assert found is None or found.shape == (height, width, 3)
    file.write_bytes(whole[: len(whole) // 2])
    assert user_files.load_thumbnail(scene) is None
    user_files.keep_thumbnail(scene, pixels)
    found = user_files.load_thumbnail(scene)
    assert found is not None
    assert np.array_equal(found, pixels)
