"""Completion of a typed path."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from viewer.files.user_files import complete_path, path_completions


@pytest.fixture
def scenes(tmp_path: Path) -> str:
    for name in ("Statue.ply", "statue_edited.ply", "room.ply", ".hidden.ply"):
        (tmp_path / name).touch()
    (tmp_path / "stage").mkdir()
    return f"{tmp_path}{os.sep}"


def test_folders_come_first_and_case_is_ignored(scenes: str) -> None:
    names = [f"stage{os.sep}", "Statue.ply", "statue_edited.ply"]
    assert path_completions(f"{scenes}ST") == tuple(scenes + name for name in names)
    assert path_completions(f"{scenes}.h") == (f"{scenes}.hidden.ply",)


def test_tab_completes_the_shared_part(scenes: str) -> None:
    assert complete_path(f"{scenes}s") == f"{scenes}sta"
    assert complete_path(f"{scenes}R") == f"{scenes}room.ply"
    assert complete_path(f"{scenes}x") == f"{scenes}x"


def test_unreadable_paths_have_no_completion(scenes: str) -> None:
    for typed in ("", " ", f"{scenes}missing/a", "\0", f"{scenes}room.ply/a"):
        assert path_completions(typed) == ()
        assert complete_path(typed) == typed
