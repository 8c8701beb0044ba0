"""Tests of bundles changed by people, mail programs and other tools."""

from __future__ import annotations

import os
import random
import struct
import zipfile
from pathlib import Path

import pytest

from progdf.errors import ProgdfError
from progdf.io.bundle import unpack_bundle
from tests.helpers.full_disk import files_up_to
from tests.helpers.refused import refusal

SESSION = b'{"progdf_session": 1, "scene": {"file": "a.ply", "sha256": ""}, "view": {}}' + b" " * 3000
NUMBERS = random.Random(1).randbytes(4000)


def write_zip(
    path: Path, members: dict[str, bytes] | None = None, method: int = zipfile.ZIP_DEFLATED
) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in (members or {"a.session.json": SESSION, "a.ply": NUMBERS}).items():
            archive.writestr(name, content)
    return path


def with_central_field(path: Path, offset: int, value: int) -> Path:
    """Set a 16-bit field of the first entry in the archive's central directory."""
    content = bytearray(path.read_bytes())
    entry = content.index(b"PK\x01\x02")
    content[entry + offset : entry + offset + 2] = struct.pack("<H", value)
    path.write_bytes(content)
    return path


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return write_zip(tmp_path / "a.progdf.zip")


def assert_refused(path: Path, *words: str) -> None:
    message = refusal(unpack_bundle, path)
    for word in words:
        assert word in message, message
    assert [file.name for file in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    "name",
    ["a.autosave.session.json", "a.discarded.session.json", "0.session.json", "A.session.json", "z.json"],
)
def test_second_opening_opens_the_original_session(bundle: Path, name: str) -> None:
    first = unpack_bundle(bundle)
    (first.parent / name).write_bytes(SESSION + b"other work")
    os.rename(first, first.with_suffix(".moved"))  # changes the order of the folder
    os.rename(first.with_suffix(".moved"), first)
    assert unpack_bundle(bundle) == first
    assert first.name == "a.session.json"


def test_saved_work_is_opened_again(bundle: Path) -> None:
    first = unpack_bundle(bundle)
    first.write_bytes(b"saved")
    assert unpack_bundle(bundle).read_bytes() == b"saved"


def test_renamed_session_is_opened(bundle: Path) -> None:
    first = unpack_bundle(bundle)
    first.rename(first.with_name("mine.json"))
    (first.parent / "a.autosave.session.json").write_bytes(b"{}")
    assert unpack_bundle(bundle) == first.with_name("mine.json")


def test_removed_session_is_written_again(bundle: Path) -> None:
    first = unpack_bundle(bundle)
    first.rename(first.with_name("mine.session.json"))
    first.with_name("mine.session.json").write_bytes(b"other work")
    assert unpack_bundle(bundle) == first
    assert first.read_bytes() == SESSION
    assert first.with_name("mine.session.json").read_bytes() == b"other work"


@pytest.mark.parametrize("name", ["work.json", "WORK.SESSION.JSON", "my session", "a (1).session.json"])
def test_session_renamed_in_the_archive_is_found(tmp_path: Path, name: str) -> None:
    members = {"a.ply": NUMBERS, "cameras.json": b"[]", name: SESSION}
    opened = unpack_bundle(write_zip(tmp_path / "a.progdf.zip", members))
    assert opened.name == name
    assert unpack_bundle(tmp_path / "a.progdf.zip") == opened


def test_renamed_archive_unpacks_beside_itself(bundle: Path) -> None:
    unpack_bundle(bundle)
    other = bundle.rename(bundle.with_name("b.progdf.zip"))
    assert unpack_bundle(other) == bundle.parent / "b.progdf" / "a.session.json"


def test_several_sessions_are_named(tmp_path: Path) -> None:
    members = {"a.session.json": SESSION, "b.session.json": SESSION}
    assert_refused(
        write_zip(tmp_path / "a.progdf.zip", members), "2 sessions", "'a.session.json'", "keep one"
    )


@pytest.mark.parametrize("content", [b"\xff\xfe", b"", b"a" * 10**6])
def test_folder_with_an_unreadable_mark_is_not_touched(bundle: Path, content: bytes) -> None:
    folder = unpack_bundle(bundle).parent
    (folder / ".bundle.sha256").write_bytes(content)
    with pytest.raises(ProgdfError, match="was not unpacked from"):
        unpack_bundle(bundle)


def test_file_named_like_the_bundle_folder_is_kept(bundle: Path) -> None:
    bundle.with_name("a.progdf").write_text("mine")
    with pytest.raises(ProgdfError, match="was not unpacked from"):
        unpack_bundle(bundle)


@pytest.mark.parametrize(
    ("method", "word"),
    [(1, "shrink"), (9, "deflate64"), (12, "bzip2"), (14, "lzma"), (93, "zstd"), (99, "method 99")],
)
def test_other_compression_is_named(bundle: Path, method: int, word: str) -> None:
    assert_refused(with_central_field(bundle, 10, method), word, "not supported", "deflate")


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_large_member_of_another_compression_is_not_unpacked(tmp_path: Path, method: int) -> None:
    members = {"a.session.json": SESSION, "a.ply": bytes(1 << 20)}
    assert_refused(write_zip(tmp_path / "a.progdf.zip", members, method), "compression")


def test_encryption_is_named(bundle: Path) -> None:
    assert_refused(with_central_field(bundle, 8, 1), "encryption", "without a password")


def test_patched_member_is_named(bundle: Path) -> None:
    assert_refused(with_central_field(bundle, 8, 0x20), "not supported")


def test_later_zip_version_is_named(bundle: Path) -> None:
    assert_refused(with_central_field(bundle, 6, 99), "later .zip format")


def test_damaged_deflate_stream_is_damage(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.progdf.zip", {"a.session.json": SESSION})
    content = bytearray(path.read_bytes())
    content[44:52] = b"\xff" * 8  # directly after the first member's header
    path.write_bytes(content)
    assert_refused(path, "is damaged", "a.session.json")


def test_member_larger_than_its_entry_is_damage(bundle: Path) -> None:
    assert_refused(with_central_field(bundle, 24, 5), "is damaged")


def test_duplicate_member_is_damage(tmp_path: Path) -> None:
    members = {"a.session.json": SESSION, "b.ply": b"1", "B.ply": b"2"}
    assert_refused(write_zip(tmp_path / "a.progdf.zip", members), "is damaged", "twice")


@pytest.mark.parametrize("name", ["a\nb.ply", "a\x1b[2J.ply"])
def test_control_characters_in_names_are_refused(tmp_path: Path, name: str) -> None:
    members = {"a.session.json": SESSION, name: b"1"}
    assert_refused(write_zip(tmp_path / "a.progdf.zip", members), "not a plain file")


@pytest.mark.parametrize("content", [b"", b"P", b"not a zip file", b"PK\x03\x04 and no more"])
def test_file_that_is_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.progdf.zip"
    path.write_bytes(content)
    assert_refused(path)


@pytest.mark.skipif(os.name == "nt", reason="needs file size limits")
def test_full_disk_leaves_no_folder(bundle: Path) -> None:
    with files_up_to(2000), pytest.raises(ProgdfError, match=r"a\.progdf cannot be written"):
        unpack_bundle(bundle)
    assert [file.name for file in bundle.parent.iterdir()] == [bundle.name]
