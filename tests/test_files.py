"""Outputs are whole or absent."""

from __future__ import annotations

from pathlib import Path

import pytest

from progdf.errors import ProgdfError
from progdf.files import written_whole
from tests.full_disk import files_up_to


def test_a_file_appears_when_it_is_complete_and_not_before(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    with written_whole(path) as beside:
        beside.write_text("half")
        assert not path.exists()
        beside.write_text("whole")
    assert path.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_interrupted_write_leaves_the_old_file_and_nothing_beside_it(
    error: type[BaseException], tmp_path: Path
) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")

    def write() -> None:
        with written_whole(path) as beside:
            beside.write_text("half")
            raise error

    with pytest.raises(error):
        write()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_told_with_the_name_of_the_file_and_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    told = pytest.raises(ProgdfError, match=r"/out\.txt cannot be written \(.*\); give a place")
    with told as caught, files_up_to(100), written_whole(path) as beside, written_whole(beside) as within:
        within.write_text("x" * 1000)
    assert isinstance(caught.value.__cause__, OSError), "training tells a full disk by it"
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_whoever_still_reads_the_old_file_keeps_it(tmp_path: Path) -> None:
    path = tmp_path / "out.txt"
    path.write_text("old")
    with path.open() as reader:
        with written_whole(path) as beside:
            beside.write_text("new")
        assert reader.read() == "old"
    assert path.read_text() == "new"


def test_permissions_are_those_of_an_ordinary_file_or_of_the_old_one(tmp_path: Path) -> None:
    ordinary, old = tmp_path / "ordinary.txt", tmp_path / "old.txt"
    ordinary.touch()
    old.touch()
    old.chmod(0o640)
    for path, expected in ((tmp_path / "new.txt", ordinary), (old, old)):
        mode = expected.stat().st_mode
        with written_whole(path) as beside:
            beside.write_text("x")
        assert path.stat().st_mode == mode


def test_the_suffix_is_kept_for_writers_that_go_by_it(tmp_path: Path) -> None:
    with written_whole(tmp_path / "picture.png") as beside:
        assert beside.suffix == ".png"


def test_a_missing_folder_and_a_folder_in_place_of_a_file_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(ProgdfError, match="does not exist"), written_whole(tmp_path / "no" / "a.txt"):
        pass
    with pytest.raises(ProgdfError, match="is a folder"), written_whole(tmp_path):
        pass


def test_a_place_that_cannot_be_written_to_is_told_by_the_name_that_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(**_: object) -> None:
        raise PermissionError(13, "Permission denied", str(tmp_path / ".out.x1y2.txt"))

    monkeypatch.setattr("progdf.files.tempfile.mkstemp", refused)
    path = tmp_path / "out.txt"
    with pytest.raises(ProgdfError) as told, written_whole(path):
        pass
    assert str(told.value).startswith(f"{path} cannot be written (Permission denied); ")
