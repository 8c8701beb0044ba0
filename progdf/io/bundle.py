"""Bundles for sharing: NAME.progdf.zip with a session and all files that it refers to.

A bundle is unpacked once, into the folder NAME.progdf beside it. Its members are stored or deflated.
Encryption and other compression methods are refused, as their size cannot be bounded before unpacking. The
error names the method.
"""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PureWindowsPath

import msgspec

from progdf.errors import ProgdfError

from . import atomic
from .file_rules import damage_error, unsupported_error
from .part_files import part_files
from .session import SUFFIX, SessionFile, is_session, read_session, sha256, verify_files, write_session

BUNDLE = ".progdf.zip"
MAX_FILES = 1000  # largest number of members in a bundle
MAX_EXPANSION = 200  # largest ratio of unpacked size to bundle size; a bundle below 1 MB counts as 1 MB
_HASH_FILE = ".bundle.sha256"  # file in the unpacked folder with the hash of its bundle, hexadecimal
_REMEDY = "zip its files again, without a password and with deflate"
_READ_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_METHODS = {
    1: "shrink",
    6: "implode",
    9: "deflate64",
    12: "bzip2",
    14: "lzma",
    93: "zstd",
    95: "xz",
    98: "ppmd",
}
_ENCRYPTED = 0x1  # bit of a member's flags
_START_BYTES = 64  # enough for `is_session`
_CHUNK_BYTES = 1 << 20
_ZIP_ERRORS = (
    zipfile.BadZipFile,
    zipfile.LargeZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,  # a seek to a negative offset
    OverflowError,
    ValueError,
)


def write_bundle(path: Path, source: Path) -> int:
    """Write a session and all files that it needs into one bundle.

    Args:
        path: NAME.progdf.zip
        source: the saved session

    Returns:
        The number of files in the bundle.

    Raises:
        ProgdfError: see `verify_files`, or a scene has several files, such as an unpacked .sog or a .gltf.
    """
    session = read_session(source, SessionFile)
    scenes, edits = verify_files(source, session)
    for scene in scenes:
        _check_bundled(scene)
    names = _member_names((*scenes, *edits))
    for region in session.view.get("selection", {}).get("regions", ()):
        region["path"] = PureWindowsPath(region["path"]).name
    placed = msgspec.structs.replace(
        session,
        scene=msgspec.structs.replace(session.scene, file=names[scenes[0]]),
        added=tuple(
            msgspec.structs.replace(ref, file=names[file])
            for ref, file in zip(session.added, scenes[1:], strict=True)
        ),
        edits=tuple(
            msgspec.structs.replace(ref, file=names[file])
            for ref, file in zip(session.edits, edits, strict=True)
        ),
    )
    title = _plain_name(path.name.removesuffix(BUNDLE))
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder, atomic.atomic_write(path) as written:
        inner = Path(folder) / f"{title}{SUFFIX}"
        write_session(inner, placed)
        with zipfile.ZipFile(written, "w", zipfile.ZIP_DEFLATED) as archive:
            for file, name in {inner: inner.name, **names}.items():
                archive.write(file, name)
    return 1 + len(names)


def _check_bundled(scene: Path) -> None:
    """Raise ProgdfError if a scene consists of several files."""
    if scene.name.lower() in ("meta.json", "lod-meta.json"):
        raise ProgdfError(f"{scene.parent} is an unpacked .sog; export the scene as a .ply first")
    if scene.suffix.lower() == ".gltf":
        raise ProgdfError(f"{scene} keeps numbers in other files; export the scene as a .glb first")
    if len(part_files(scene)) > 1:
        raise ProgdfError(f"{scene} is one of several parts of a scene; export the scene as a .ply first")


def _member_names(files: Sequence[Path]) -> dict[Path, str]:
    """Return a unique member name for each file. Names that differ only in case count as equal."""
    names: dict[Path, str] = {}
    for file in files:
        taken = {name.lower() for name in names.values()}
        free = atomic.numbered_names(_plain_name(file.stem), file.suffix)
        names.setdefault(file, next(name for name in free if name.lower() not in taken))
    return names


def _plain_name(name: str) -> str:
    """Return a similar name that is valid on every system."""
    plain = "".join("-" if c in '<>:"/\\|?*' or not c.isprintable() else c for c in name)
    plain = plain.lstrip(".").rstrip(". ")
    return plain if plain and atomic.is_portable(plain) else f"file-{plain}"


def unpack_bundle(path: Path) -> Path:
    """Unpack a bundle into the folder NAME.progdf beside it, and return its session.

    A bundle that is already unpacked is not unpacked again. The returned session is always the bundle's own,
    never an autosave or another session in the folder. A renamed session with unchanged content is found. A
    deleted session is written again.

    Nothing is written outside that folder, which appears complete or not at all.

    Raises:
        ProgdfError: the file is damaged, not a bundle, or uses an unsupported feature of .zip. Or the folder
            was not unpacked from this bundle, or cannot be written.
    """
    folder = path.resolve().with_name(path.name.removesuffix(".zip"))
    with _open_archive(path) as archive:
        members = _check_members(path, archive)
        session = _find_session(path, archive, members)
        if not os.path.lexists(folder):
            _unpack(path, archive, members, folder)
        elif not _is_unpacked(path, folder):
            raise ProgdfError(f"{folder} exists and was not unpacked from {path.name}; move it elsewhere")
        opened = folder / session.filename
        if opened.is_file():
            return opened
        renamed = _find_copy(folder, session)
        if renamed is not None:
            return renamed
        with atomic.atomic_write(opened) as written, written.open("wb") as out:
            out.writelines(_read_chunks(path, archive, session))
        return opened


@contextmanager
def _open_archive(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a bundle as a .zip archive.

    Raises:
        ProgdfError: the file cannot be read, is not a .zip archive, or is damaged.
    """
    atomic.check_regular(path)
    try:
        file = path.open("rb")
    except (OSError, ValueError) as error:
        raise atomic.open_error(path, error) from error
    with file:
        if file.read(2) != b"PK":
            raise ProgdfError(f"{path} is not a bundle: it is not a .zip archive; copy or export it again")
        try:
            archive = zipfile.ZipFile(file)
        except NotImplementedError as error:  # a later version of the format
            raise unsupported_error(path, f"a later .zip format ({error})", _REMEDY) from None
        except _ZIP_ERRORS as error:
            raise damage_error(path, str(error) or type(error).__name__) from None
        with archive:
            yield archive


def _check_members(path: Path, archive: zipfile.ZipFile) -> list[zipfile.ZipInfo]:
    """Return the members of a bundle, after a check that each is a plain file within the limits.

    Raises:
        ProgdfError: a name is not a plain file name or appears twice, a member is encrypted or compressed
            with a method other than deflate, or the members are too many or too large.
    """
    members = archive.infolist()
    if len(members) > MAX_FILES:
        raise ProgdfError(
            f"{path} is not a bundle: it holds {len(members)} files; at most {MAX_FILES} are allowed"
        )
    names = set[str]()
    for member in members:
        name = member.filename
        if not atomic.is_portable(name) or name.startswith(".") or not name.isprintable():
            raise ProgdfError(
                f"{path} is not a bundle: it names {name!r:.80}, which is not a plain file; export it again"
            )
        if name.casefold() in names:
            raise damage_error(path, f"it holds {name!r:.80} twice")
        names.add(name.casefold())
        if member.flag_bits & _ENCRYPTED:
            raise unsupported_error(path, f"encryption ({name!r:.80})", _REMEDY)
        if member.compress_type not in _READ_METHODS:
            method = _METHODS.get(member.compress_type, f"method {member.compress_type}")
            raise unsupported_error(path, f"the compression {method} ({name!r:.80})", _REMEDY)
    unpacked = sum(member.file_size for member in members)
    if unpacked > MAX_EXPANSION * max(path.stat().st_size, 1 << 20):
        raise ProgdfError(
            f"{path} is not a bundle: it unpacks to more than {MAX_EXPANSION} times its size; export it again"
        )
    return members


def _find_session(
    path: Path, archive: zipfile.ZipFile, members: Sequence[zipfile.ZipInfo]
) -> zipfile.ZipInfo:
    """Return the only session among the members, by its name, or by its content if no name matches.

    Raises:
        ProgdfError: there is no session, or more than one.
    """
    sessions = [member for member in members if member.filename.lower().endswith(SUFFIX)]
    if not sessions:
        for member in members:
            start = next(_read_chunks(path, archive, member), b"")
            if is_session(start[:_START_BYTES]):
                sessions.append(member)
    if len(sessions) != 1:
        names = ", ".join(repr(member.filename) for member in sessions)
        found = f"it holds {len(sessions)} sessions in {len(members)} files"
        named = f" ({names:.80})" if names else ""
        raise ProgdfError(f"{path} is not a bundle: {found}{named}; keep one session in it")
    return sessions[0]


def _is_unpacked(path: Path, folder: Path) -> bool:
    """Return whether a folder was unpacked from exactly this bundle."""
    hash_file = folder / _HASH_FILE
    return hash_file.is_file() and atomic.read_file(hash_file, 65) == sha256(path).encode()


def _find_copy(folder: Path, session: zipfile.ZipInfo) -> Path | None:
    """Return a file in the folder with the content of the bundle's session under another name, or None."""
    for file in sorted(folder.glob("*.json")):
        if not file.is_file() or file.stat().st_size != session.file_size:
            continue
        if zlib.crc32(atomic.read_file(file)) == session.CRC:
            return file
    return None


def _unpack(path: Path, archive: zipfile.ZipFile, members: Sequence[zipfile.ZipInfo], folder: Path) -> None:
    """Write the members into a folder, which appears once all are written.

    Raises:
        ProgdfError: a member is damaged, or the folder cannot be written.
    """
    try:
        temporary = atomic.temporary_subfolder(folder.parent)
        try:
            for member in members:
                with (temporary / member.filename).open("xb") as out:
                    out.writelines(_read_chunks(path, archive, member))
            (temporary / _HASH_FILE).write_bytes(sha256(path).encode())
            temporary.rename(folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise atomic.write_error(folder, error) from error


def _read_chunks(path: Path, archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> Iterator[bytes]:
    """Yield the content of a member in pieces of at most 1 MB.

    Raises:
        ProgdfError: the member is damaged, or uses an unsupported feature of .zip.
    """
    try:
        with archive.open(member) as inner:
            while chunk := inner.read(_CHUNK_BYTES):
                yield chunk
    except NotImplementedError as error:
        raise unsupported_error(path, f"a feature of .zip ({error})", _REMEDY) from None
    except _ZIP_ERRORS as error:
        raise damage_error(path, f"{member.filename:.80}: {error or type(error).__name__}") from None
