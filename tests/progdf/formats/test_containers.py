"""Tests of archives with a scene inside, and of other files, which are named with a remedy."""

from __future__ import annotations

import gzip
import io
import tarfile
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from progdf.__main__ import main
from progdf.cli.info import kind_of
from progdf.formats.ply import save_ply
from progdf.formats.scene_file import load_scene, load_scene_with_report
from progdf.gaussians import Gaussians
from tests.helpers.refused import refusal
from tests.helpers.scene_files import write_compressed_ply, write_ksplat, write_scene, write_zip
from tests.helpers.scenes import random_gaussians

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345678\n"


def scene_of() -> Gaussians:
    """Return a small scene."""
    return random_gaussians(40, seed=4, sh_degree=0)


def ply_bytes(folder: Path) -> bytes:
    """Return the content of a .ply."""
    path = folder / "source.ply"
    save_ply(path, scene_of())
    content = path.read_bytes()
    path.unlink()
    return content


def test_luma_zip_opens_with_its_own_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content = ply_bytes(tmp_path)
    extras = {"__MACOSX/a/._b.ply": b"x", "a/.DS_Store": b"x", "a/readme.txt": b"x", "a/": b""}
    path = write_zip(tmp_path / "luma.zip", {"a/b.ply": content, **extras})
    assert kind_of(path) == "scene"
    scene, report = load_scene_with_report(path)
    assert torch.equal(scene.means, scene_of().means)
    assert (report.file, report.file_bytes) == ("luma.zip", path.stat().st_size)
    assert report.format == "binary little-endian, in a .zip"
    assert main(["info", str(path)]) == 0
    assert "luma.zip: 40 Gaussians" in capsys.readouterr().out
    assert main(["export", str(path), "-o", str(tmp_path / "b.ply")]) == 0


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.splat", "a.ksplat", "a.spz"])
@pytest.mark.parametrize("container", ["gz", "zip"])
def test_archive_of_any_scene_opens(name: str, container: str, tmp_path: Path) -> None:
    plain = tmp_path / name
    if name == "a.compressed.ply":
        write_compressed_ply(plain, scene_of())
    elif name == "a.ksplat":
        write_ksplat(plain, scene_of(), 1)
    elif name == "a.ply":
        save_ply(plain, scene_of())
    else:
        write_scene(plain, scene_of())
    path = tmp_path / f"{name}.{container}"
    if container == "gz":
        path.write_bytes(gzip.compress(plain.read_bytes()))
    else:
        write_zip(path, {name: plain.read_bytes()})
    assert torch.equal(load_scene(path).means, load_scene(plain).means)


def test_zip_with_several_scenes_names_them_all(tmp_path: Path) -> None:
    content = ply_bytes(tmp_path)
    path = write_zip(tmp_path / "a.zip", {"x/30000/p.ply": content, "x/7000/p.ply": content, "x/c.spz": b""})
    message = refusal(load_scene, path)
    assert "holds 3 scenes: x/30000/p.ply, x/7000/p.ply, x/c.spz; unpack it and give one" in message


@pytest.mark.parametrize(
    ("contents", "said"),
    [
        ({"a.txt": b"x", "b/c.jpg": b"x"}, "holds no scene, only a.txt, b/c.jpg"),
        ({}, "holds no scene, only nothing"),
        ({"work.session.json": b"{}", "a.ply": b"ply"}, "holds a session"),
        ({"a.ply": b"<!DOCTYPE html>"}, "a.zip, a.ply is a web page"),
        ({"a.ply": POINTER}, "a.zip, a.ply is a Git LFS pointer"),
        ({"a.ply": b"PK\3\4"}, "a.zip, a.ply is an archive too"),
        ({"a.spz": b"NGSP\7\0\0\0" + bytes(24)}, "a.zip, a.spz uses .spz version 7"),
    ],
)
def test_zip_without_a_readable_scene_is_named(contents: dict[str, bytes], said: str, tmp_path: Path) -> None:
    message = refusal(load_scene, write_zip(tmp_path / "a.zip", contents))
    assert said in message
    assert "progdf-" not in message


def test_encrypted_zip_is_named(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.zip", {"a.ply": ply_bytes(tmp_path)})
    content = bytearray(path.read_bytes())
    content[6] |= 1
    content[content.index(b"PK\1\2") + 8] |= 1
    path.write_bytes(content)
    assert "uses encryption, which is not supported; unpack it with its password" in refusal(load_scene, path)


def test_unbounded_zip_compression_is_named(tmp_path: Path) -> None:
    path = write_zip(tmp_path / "a.zip", {"a.ply": ply_bytes(tmp_path)}, zipfile.ZIP_LZMA)
    assert "the zip compression method 14" in refusal(load_scene, path)


@pytest.mark.parametrize("container", ["gz", "zip"])
def test_zip_bomb_is_refused_by_its_size(container: str, tmp_path: Path) -> None:
    content = bytes(100 << 20)
    path = tmp_path / f"a.ply.{container}"
    if container == "gz":
        path.write_bytes(gzip.compress(content))
    else:
        write_zip(path, {"a.ply": content})
    del content
    tracemalloc.start()
    assert "too much for a scene; unpack it yourself" in refusal(load_scene, path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 16 << 20


@pytest.mark.parametrize("container", ["gz", "zip"])
def test_truncated_archive_is_damaged(container: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.ply.{container}"
    content = ply_bytes(tmp_path)
    if container == "gz":
        path.write_bytes(gzip.compress(content))
    else:
        write_zip(path, {"a.ply": content})
    path.write_bytes(path.read_bytes()[:-200])
    assert "is damaged" in refusal(load_scene, path)


def tar_bytes() -> bytes:
    """Return a tar archive of one file."""
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("a.ply"))
    return stream.getvalue()


def image_bytes(kind: str) -> bytes:
    """Return a small picture in the given format."""
    stream = io.BytesIO()
    Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(stream, kind)
    return stream.getvalue()


FOREIGN = {
    "empty": (b"", "is empty (0 bytes)"),
    "pointer": (POINTER, "is a Git LFS pointer, not the file itself; run `git lfs pull`"),
    "page": (b"\n<!DOCTYPE html><html><head>", "is a web page, not a scene; download the file itself"),
    "upper page": (b"<HTML>\n<BODY>", "is a web page"),
    "xml": (b'<?xml version="1.0"?><Error>AccessDenied</Error>', "is XML, not a scene"),
    "text": (b"404: Not Found", "is a text file, not a scene"),
    "json": (b'{"message": "Not Found"}', "is JSON, not a scene"),
    "lod": (b'{"lodLevels": 4, "filenames": []}', "is a streamed SOG scene; name it lod-meta.json"),
    "png": (image_bytes("PNG"), "is a picture (PNG)"),
    "jpeg": (image_bytes("JPEG"), "is a picture (JPEG)"),
    "webp": (image_bytes("WEBP"), "is a picture (WebP)"),
    "gif": (image_bytes("GIF"), "is a picture (GIF)"),
    "bmp": (image_bytes("BMP"), "is a picture (BMP)"),
    "tiff": (image_bytes("TIFF"), "is a picture (TIFF)"),
    "mp4": (b"\0\0\0\x20ftypisom" + bytes(60), "is a video (MP4 or MOV)"),
    "heic": (b"\0\0\0\x20ftypheic" + bytes(60), "is a picture (HEIC or AVIF)"),
    "mkv": (b"\x1a\x45\xdf\xa3" + bytes(60), "is a video (Matroska)"),
    "avi": (b"RIFF\0\0\0\0AVI LIST", "is a video (AVI)"),
    "tar": (tar_bytes(), "is a tar archive; unpack it"),
    "7z": (b"7z\xbc\xaf\x27\x1c" + bytes(60), "is a 7z archive"),
    "rar": (b"Rar!\x1a\x07\0" + bytes(60), "is a RAR archive"),
    "npy": (b"\x93NUMPY\1\0" + bytes(60), "is a NumPy array"),
    "usdc": (b"PXR-USDC" + bytes(60), "is a USD file"),
}


@pytest.mark.parametrize("ending", ["ply", "spz", "splat", "ksplat", "glb", "sog", "ply.gz"])
@pytest.mark.parametrize("kind", FOREIGN)
def test_foreign_file_is_named_under_every_ending(kind: str, ending: str, tmp_path: Path) -> None:
    content, said = FOREIGN[kind]
    path = tmp_path / f"scene.{ending}"
    path.write_bytes(gzip.compress(content) if ending.endswith("gz") else content)
    message = refusal(load_scene, path)
    assert said in message
    assert "damaged" not in message


def test_scene_in_an_archive_without_usable_rows_is_refused(tmp_path: Path) -> None:
    rows = np.zeros((30, 32), np.uint8)
    rows[:, :24].view("<f4")[:, 3:6] = np.nan
    splat = tmp_path / "a.splat"
    splat.write_bytes(rows.tobytes())
    reason = "30 of 30 Gaussians have a NaN scale"
    assert reason in refusal(load_scene, splat)
    assert reason in refusal(load_scene, write_zip(tmp_path / "a.zip", {"a.splat": rows.tobytes()}))
