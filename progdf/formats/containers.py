"""Archives that hold one scene, and recognition of other file types by their first bytes.

A .zip (as exported by Luma) or .gz with any scene is unpacked into a temporary folder. The size of the
archive bounds the unpacked size. The error for any other file names its type and a remedy.
"""

from __future__ import annotations

import gzip
import os
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from progdf.errors import ProgdfError
from progdf.io.atomic import is_portable, open_error
from progdf.io.file_rules import damage_error, unsupported_error
from progdf.terminal import file_size

START_BYTES = 512
"""Number of bytes at the start of a file that are enough to recognize its type."""

ZIP = b"PK\x03\x04"
GZIP = b"\x1f\x8b"
_EMPTY_ZIP = b"PK\x05\x06"
_SCENE_ENDINGS = (".ply", ".spz", ".splat", ".ksplat", ".sog", ".glb", ".ckpt", ".pt", ".pth")
_SESSION_ENDING = ".session.json"
_MAX_UNPACKED = (64 << 20, 64)  # unpacked bytes: a base, and an increment per byte of the archive
_CHUNK_BYTES = 1 << 20
_MAX_LISTED = 20  # file names listed in an error

_DOWNLOAD = "download the file itself"
_TRAIN = "train a scene from it with a 3DGS trainer and give the scene's .ply"
_UNPACK = "unpack it and give the scene inside"
_OTHER_FILE_TYPES = (
    (
        b"version https://git-lfs",
        "is a Git LFS pointer, not the file itself",
        "run `git lfs pull` to fetch it",
    ),
    (b"\x89PNG\r\n", "is a picture (PNG), not a scene", _TRAIN),
    (b"\xff\xd8\xff\xe0", "is a picture (JPEG), not a scene", _TRAIN),
    (b"\xff\xd8\xff\xe1", "is a picture (JPEG), not a scene", _TRAIN),
    (b"\xff\xd8\xff\xdb", "is a picture (JPEG), not a scene", _TRAIN),
    (b"GIF8", "is a picture (GIF), not a scene", _TRAIN),
    (b"BM", "is a picture (BMP), not a scene", _TRAIN),
    (b"II*\0", "is a picture (TIFF), not a scene", _TRAIN),
    (b"MM\0*", "is a picture (TIFF), not a scene", _TRAIN),
    (b"\x1a\x45\xdf\xa3", "is a video (Matroska), not a scene", _TRAIN),
    (b"7z\xbc\xaf\x27\x1c", "is a 7z archive", _UNPACK),
    (b"Rar!\x1a\x07", "is a RAR archive", _UNPACK),
    (b"\xfd7zXZ\0", "is an xz archive", _UNPACK),
    (b"\x28\xb5\x2f\xfd", "is a zstd archive", _UNPACK),
    (b"PXR-USDC", "is a USD file, which is written but not read", "give the scene as .ply"),
    (b"#usda", "is a USD file, which is not read", "give the scene as .ply"),
    (b"\x93NUMPY", "is a NumPy array, not a scene", "give the scene as .ply"),
    (
        b"PAR1",
        "is a Parquet table, as taichi_3d_gaussian_splatting writes",
        "convert it with its parquet_to_ply.py",
    ),
    (b"%PDF", "is a PDF document, not a scene", "give the scene as .ply"),
    (b"BLENDER", "is a Blender file, not a scene", "export the Gaussians from it as .ply"),
)
_MAX_SAFETENSORS_HEADER = 100_000_000  # bytes, the limit of the format
_HTML_STARTS = (b"<!doctype", b"<html", b"<head", b"<body", b"<!--")
_TEXT_BYTES = frozenset(b"\t\n\r\f" + bytes(range(32, 127)))
_MIN_TEXT_LENGTH = 4  # bytes; the type of a shorter text is not guessed
_SCENE_MAGICS = (b"ply", b"glTF", b"NGSP")


def check_foreign(path: str | os.PathLike[str], start: bytes) -> None:
    """Refuse a file that starts like a known file type that is not a scene, whatever its name.

    Args:
        path: the file
        start: its first `START_BYTES` bytes

    Raises:
        ProgdfError: the file is empty, or of a type that is not read, such as a Git LFS pointer or a picture.
    """
    if not start:
        raise ProgdfError(f"{os.fspath(path)} is empty (0 bytes); copy or download it again")
    kind = _foreign_kind(start)
    if kind:
        raise ProgdfError(f"{os.fspath(path)} {kind}")


def _foreign_kind(start: bytes) -> str:
    """Return the type of a file that is not a scene and a remedy, or an empty text."""
    for magic, kind, remedy in _OTHER_FILE_TYPES:
        if start.startswith(magic) and not (magic == b"BM" and start[6:10] != b"\0\0\0\0"):
            return f"{kind}; {remedy}"
    if start[:4] == b"RIFF" and start[8:12] in (b"WEBP", b"AVI "):
        kind = "a picture (WebP)" if start[8:12] == b"WEBP" else "a video (AVI)"
        return f"is {kind}, not a scene; {_TRAIN}"
    if start[4:8] == b"ftyp":
        is_picture = start[8:12] in (b"heic", b"heix", b"mif1", b"avif")
        kind = "a picture (HEIC or AVIF)" if is_picture else "a video (MP4 or MOV)"
        return f"is {kind}, not a scene; {_TRAIN}"
    if start[:3] == b"BZh" and start[4:10] == b"1AY&SY":
        return f"is a bzip2 archive; {_UNPACK}"
    if start[8:10] == b'{"' and int.from_bytes(start[:8], "little") < _MAX_SAFETENSORS_HEADER:
        return "is a safetensors file, but no scene; export a .ply with the program that wrote it"
    if start[257:262] == b"ustar":
        return f"is a tar archive; {_UNPACK}"
    text = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if text[:16].lower().startswith(_HTML_STARTS):
        return f"is a web page, not a scene; {_DOWNLOAD}"
    if text.startswith(b"<?xml"):
        return f"is XML, not a scene; {_DOWNLOAD}"
    if len(text) < _MIN_TEXT_LENGTH or text.startswith(_SCENE_MAGICS) or not _TEXT_BYTES.issuperset(text):
        return ""
    if text[:1] in (b"{", b"["):
        if b'"lodLevels"' in text:
            return "is a streamed SOG scene; name it lod-meta.json and put its folders beside it"
        return "is JSON, not a scene; give the scene's own file"
    return "is a text file, not a scene; give a .ply or another scene file"


def inflate_start(start: bytes, length: int) -> bytes:
    """Return the first bytes inside a gzip file, at most `length`; no bytes if it is damaged."""
    try:
        return zlib.decompressobj(wbits=31).decompress(start, length)
    except zlib.error:
        return b""


@contextmanager
def unpacked_scene(path: Path) -> Iterator[Path]:
    """Unpack the only scene in a .zip or .gz into a temporary folder, and yield its file.

    The folder is removed when the block ends.

    Raises:
        ProgdfError: the archive holds no scene or several, is encrypted or damaged, or unpacks to more than
            a scene can.
    """
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        try:
            with path.open("rb") as file:
                start = file.read(START_BYTES)
            unpack = _unpack_gzip if start[:2] == GZIP else _unpack_zip
            inner = unpack(path, Path(folder))
        except OSError as error:
            raise open_error(path, error) from None
        try:
            yield inner
        except ProgdfError as error:
            raise ProgdfError(str(error).replace(str(inner), f"{path}, {inner.name}")) from None


def _unpack_zip(path: Path, folder: Path) -> Path:
    """Unpack the scene of a zip archive and return its file in the folder."""
    try:
        with zipfile.ZipFile(path) as archive:
            entry = _scene_entry(path, archive.infolist())
            _check_size(path, entry.file_size)
            name = PurePosixPath(entry.filename).name
            target = folder / (name if is_portable(name) else f"scene{PurePosixPath(name).suffix}")
            with archive.open(entry) as source, target.open("xb") as out:
                while chunk := source.read(_CHUNK_BYTES):
                    out.write(chunk)
            return target
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError) as error:
        if isinstance(error, ProgdfError):
            raise
        raise damage_error(path, f"as a zip archive ({str(error)[:80]})") from None


def _scene_entry(path: Path, entries: list[zipfile.ZipInfo]) -> zipfile.ZipInfo:
    """Return the entry of the only scene in an archive.

    Folders, hidden files and the copies that macOS adds do not count.
    """
    files = [entry for entry in entries if not entry.is_dir() and _is_visible(entry.filename)]
    names = [entry.filename for entry in files]
    if any(name.lower().endswith(_SESSION_ENDING) for name in names):
        raise ProgdfError(f"{path} holds a session; open it with `progdf view`, as NAME.progdf.zip")
    scenes = [entry for entry in files if entry.filename.lower().endswith(_SCENE_ENDINGS)]
    if not scenes:
        raise ProgdfError(
            f"{path} holds no scene, only {_join_names(names)}; give the archive of a .ply or another scene"
        )
    if len(scenes) > 1:
        listed = _join_names([entry.filename for entry in scenes])
        raise ProgdfError(f"{path} holds {len(scenes)} scenes: {listed}; unpack it and give one of them")
    entry = scenes[0]
    if entry.flag_bits & 1:
        raise unsupported_error(path, "encryption", "unpack it with its password and give the scene inside")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise unsupported_error(path, f"the zip compression method {entry.compress_type}", _UNPACK)
    return entry


def _is_visible(name: str) -> bool:
    """Return whether an archive entry is a regular user file: neither hidden nor a copy that macOS adds."""
    parts = PurePosixPath(name.replace("\\", "/")).parts
    return bool(parts) and "__MACOSX" not in parts and not parts[-1].startswith(".")


def _join_names(names: list[str]) -> str:
    """Return a list of names for an error, at most the first `_MAX_LISTED`."""
    if not names:
        return "nothing"
    listed = ", ".join(name[:80] for name in names[:_MAX_LISTED])
    omitted_count = len(names) - _MAX_LISTED
    return f"{listed} and {omitted_count} more" if omitted_count > 0 else listed


def _unpack_gzip(path: Path, folder: Path) -> Path:
    """Unpack a gzip file and return the file inside, named like the archive without .gz."""
    name = path.name[:-3] if path.name.lower().endswith(".gz") else f"{path.name}.unpacked"
    target = folder / name
    written = 0
    try:
        with gzip.open(path) as source, target.open("xb") as out:
            while chunk := source.read(_CHUNK_BYTES):
                written += len(chunk)
                _check_size(path, written)
                out.write(chunk)
    except (gzip.BadGzipFile, zlib.error, EOFError) as error:
        raise damage_error(path, f"as a gzip file ({str(error)[:80]})") from None
    return target


def _check_size(path: Path, unpacked: int) -> None:
    """Refuse an archive that unpacks to more than a scene of its size can.

    Args:
        path: the archive
        unpacked: bytes, as declared by the archive or as counted so far
    """
    base, each = _MAX_UNPACKED
    packed = path.stat().st_size
    if unpacked > base + each * packed:
        raise ProgdfError(
            f"{path} has {file_size(packed)} and unpacks to {file_size(unpacked)} or more, "
            "too much for a scene; unpack it yourself if you trust it"
        )
