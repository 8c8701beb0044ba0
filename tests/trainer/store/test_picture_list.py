"""Cleanup of a run: it deletes only pictures that it has written."""

from __future__ import annotations

from pathlib import Path

import torch

from trainer.editors.cache import PictureCache
from trainer.store.run_folder import RunFolder, remove_stale_views, write_views

PICTURE = torch.zeros(2, 2, 3)


def written(root: Path) -> RunFolder:
    """Write the pictures of a run with the views a and b; return its folder."""
    folder = RunFolder(root)
    for kind, strength in (("original", 1.0), ("edited", 1.0), ("edited", 0.25)):
        write_views(folder, kind, {"a": PICTURE, "b": PICTURE}, strength)
    for name in "ab":
        PictureCache(folder.paintings).picture(name, PICTURE, {}, lambda image: image)
    return folder


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_pictures_of_dropped_views_are_deleted(tmp_path: Path) -> None:
    folder = written(tmp_path)
    remove_stale_views(folder, ["b"])
    expected = {"original/b.png", "edited/b.png", "edited/0.25/b.png", "painted/b.png", "painted/b.json"}
    assert files(folder.views) == expected | {"pictures.txt", "painted/pictures.txt"}
    remove_stale_views(folder, [])
    assert files(folder.views) == {"pictures.txt", "painted/pictures.txt"}


def test_pictures_in_subfolders_stay_with_their_view(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    for strength in (0.25, 1.0):
        write_views(folder, "edited", {"cam0/1": PICTURE, "cam1/1": PICTURE}, strength)
    write_views(folder, "edited", {"1": PICTURE})
    remove_stale_views(folder, ["cam1/1", "1"])
    kept = {"edited/1.png", "edited/cam1/1.png", "edited/0.25/cam1/1.png"}
    assert files(folder.views) == {*kept, "pictures.txt"}


def test_user_pictures_stay_under_any_name(tmp_path: Path) -> None:
    folder = written(tmp_path)
    own = {"edited/mine.png", "edited/mine.json", "edited/variants/a.png", "favorites/a.png"}
    for name in own:
        (folder.views / name).parent.mkdir(exist_ok=True)
        (folder.views / name).write_text("mine")
    remove_stale_views(folder, [])
    assert files(folder.views) == own | {"pictures.txt", "painted/pictures.txt"}


def test_nothing_behind_a_link_is_deleted(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    photographs = tmp_path / "photographs"
    (folder.views / "original").rename(photographs)
    (folder.views / "original").symlink_to(photographs)
    with (folder.views / "pictures.txt").open("a") as lines:
        lines.write(f"../../photographs/a.png\n{photographs}/a.png\n\n.\n")
    remove_stale_views(folder, [])
    assert files(photographs) == {"a.png", "b.png"}


def test_nothing_is_deleted_without_a_list(tmp_path: Path) -> None:
    folder = written(tmp_path)
    (folder.views / "pictures.txt").write_bytes(b"\xff\xfe")
    before = files(folder.views / "edited")
    remove_stale_views(folder, [])
    assert files(folder.views / "edited") == before
