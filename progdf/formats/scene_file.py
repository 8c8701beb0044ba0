"""Scenes in every format that people have: .ply, compressed .ply, .spz, .splat, .ksplat, .sog.

Recognized by content, else by name. Two readers are our own; .spz, .sog and .splat go through
gaussforge, in a process of its own (see `gaussforge_child`), as its native code may crash on a broken file.
"""

from __future__ import annotations

import importlib.util
import os
import signal
import subprocess
import sys
import tempfile
import zipfile
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from progdf import sh
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.atomic import read_file
from progdf.io.json_values import decode_json
from progdf.terminal import escape_text

from . import gaussforge_child
from .compressed_ply import is_compressed, read_compressed_ply
from .ksplat import read_ksplat
from .ply import load_ply_with_report, read_header
from .repair import LoadReport, repair

FORMATS = ("ply", "spz", "splat", "ksplat", "sog")
"""What a scene may be, by the ending of its name; a compressed .ply is a .ply."""

SOG_META = "meta.json"
"""The file that represents an unpacked .sog: its folder's table of images."""

_MOST_META = 1 << 20
"""Bytes of its table, which has some 20 kB; parsed, JSON takes thirty times as much."""
_MEMORY, _OUTPUT, SECONDS = (1 << 30, 64), (64 << 20, 64), (60, 2e-6)
"""What a reader of another's making gets: so much, and so much for each byte of its file."""


def scene_format(path: str | os.PathLike[str]) -> str | None:
    """One of `FORMATS`, by content, or by name where the content says nothing; None: it is no scene.

    Raises:
        ProgdfError: it cannot be read.
    """
    path = scene_file(path)
    start = read_file(path, 64)
    suffix = path.suffix.lower().lstrip(".")
    if start[:3] == b"ply":
        return "ply"
    if start[:4] == b"NGSP" or (start[:2] == b"\x1f\x8b" and _inflate(start)[:4] == b"NGSP"):
        return "spz"
    if start[:4] == b"PK\x03\x04":
        return "sog" if _sog_meta(path) is not None else None
    if path.name.lower() == SOG_META and start.lstrip()[:1] == b"{":
        return "sog" if _sog_meta(path) is not None else None
    if suffix in ("splat", "ksplat"):  # which begin with whatever comes first in the scene
        return suffix
    return suffix if suffix in FORMATS and start.lstrip()[:1] not in (b"{", b"[") else None


def scene_file(path: str | os.PathLike[str]) -> Path:
    """The file that a scene is read from: of an unpacked .sog's folder its meta.json."""
    path = Path(path)
    return path / SOG_META if (path / SOG_META).is_file() else path


def scene_name(path: Path) -> str:
    """What a scene is called: its file's name, of an unpacked .sog its folder's."""
    return path.parent.name if path.name.lower() == SOG_META else path.name


def load_scene(path: str | os.PathLike[str]) -> Gaussians:
    """The scene in a file of any known format; what had to be repaired or was lost is logged as a warning.

    Axes are those of the 3DGS .ply: an .spz, which has y up and z towards the viewer, is turned about x.

    Raises:
        ProgdfError: the file is missing, broken or no scene, or its reader is not installed.
    """
    scene, report = load_scene_with_report(path)
    report.log()
    return scene


def load_scene_with_report(path: str | os.PathLike[str]) -> tuple[Gaussians, LoadReport]:
    """As `load_scene`, with the report of what the file held and what was repaired."""
    path = scene_file(path)
    kind = scene_format(path)
    if kind == "ply" or kind is None:
        ply = read_header(path)  # which knows best what is wrong with a file that is no .ply
        if not is_compressed(ply):
            return load_ply_with_report(path)
        return _repair(path, read_compressed_ply(ply), "compressed .ply")
    if kind == "ksplat":
        scene, level = read_ksplat(path)
        return _repair(path, scene, f".ksplat, level {level}")
    scene, report = _through_gaussforge(path, kind)
    description, antialiased = f".{kind}", False
    if kind == "spz":
        version, antialiased = _spz_header(path)
        scene, description = rotate_about_x(scene), f".spz {version}, turned from y up to y down"
    elif kind == "sog":
        meta = _sog_meta(path) or {}
        antialiased = meta.get("model") == "antialiased" or meta.get("antialias") is True
    report = replace(
        report,
        file=scene_name(path),
        file_bytes=_size(path),
        format=description,
        antialiased=antialiased,
        origin=scene.origin,
    )
    return replace(scene, antialiased=antialiased), report


def rotate_about_x(scene: Gaussians) -> Gaussians:
    """The scene after half a turn about x: y up and z towards the viewer become y down and z away from it."""
    turn = torch.tensor([1.0, -1.0, -1.0])
    x, y, z = scene.origin
    return replace(
        scene,
        means=scene.means * turn,
        origin=(x, 0.0 - y, 0.0 - z),
        quats=scene.quats * torch.tensor([1.0, 1.0, -1.0, -1.0]),
        shN=sh.rotate_about_x(scene.shN),
    )


def _repair(path: Path, stored: Gaussians, kind: str) -> tuple[Gaussians, LoadReport]:
    scene, counts = repair(stored)
    repairs: dict[str, Any] = dict(counts)
    report = LoadReport(
        file=scene_name(path),
        file_bytes=_size(path),
        format=kind,
        count=len(scene),
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        **repairs,
    )
    return scene, report


def _through_gaussforge(path: Path, kind: str) -> tuple[Gaussians, LoadReport]:
    """The scene as gaussforge reads it, repaired, in the axes of the file.

    Raises:
        ProgdfError: gaussforge is not installed, cannot read the file, crashes on it or takes too long.
    """
    if importlib.util.find_spec("gaussforge") is None:
        raise ProgdfError(f"{path}: .{kind} needs the package gaussforge; pip install progdf-studio[formats]")
    size = _size(path)
    memory, output, seconds = (int(base + each * size) for base, each in (_MEMORY, _OUTPUT, SECONDS))
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        target = Path(folder) / "scene.ply"
        words = [kind, str(path.resolve()), str(target), *map(str, (memory, output, seconds))]
        try:
            ended = subprocess.run(
                [sys.executable, "-P", gaussforge_child.__file__, *words],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=2 * seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise _read_error(path, kind, f"did not answer within {2 * seconds} s") from None
        if ended.returncode or not target.is_file():
            raise _read_error(path, kind, _reason(ended.returncode, ended.stderr))
        try:
            return load_ply_with_report(target)
        except ProgdfError:
            raise _read_error(path, kind, "returned no scene") from None


def _reason(status: int, stderr: bytes) -> str:
    """Why the reader gave nothing."""
    if status < 0:
        name = signal.Signals(-status).name if -status in set(signal.Signals) else str(-status)
        return "ran out of its time" if name in ("SIGXCPU", "SIGKILL") else f"crashed ({name})"
    lines = stderr.decode("utf-8", "replace").strip().splitlines()
    message = escape_text(lines[-1] if lines else "")
    if "bad_alloc" in message or message.startswith("MemoryError"):
        return "wanted more memory than such a file can need"
    return f"said: {message[:160]}" if message else "said nothing"


def _read_error(path: Path, kind: str, why: str) -> ProgdfError:
    return ProgdfError(
        f"{path} cannot be read as .{kind}: its reader {why}; it is damaged: copy or export it again"
    )


def _size(path: Path) -> int:
    """Bytes of the scene: of an unpacked .sog those of its folder's files."""
    if path.name.lower() != SOG_META:
        return path.stat().st_size
    return sum(
        file.stat().st_size for file in path.parent.iterdir() if file.is_file() and not file.is_symlink()
    )


def _inflate(start: bytes) -> bytes:
    """What the beginning of a gzip file holds, at most 16 bytes of it."""
    try:
        return zlib.decompressobj(wbits=31).decompress(start, 16)
    except zlib.error:
        return b""


def _spz_header(path: Path) -> tuple[int, bool]:
    """The version of an .spz, and whether it was trained with Mip-Splatting's 2D filter."""
    with path.open("rb") as file:
        start = file.read(4096)
    head = start if start[:4] == b"NGSP" else _inflate(start)
    if len(head) < 16:
        raise _read_error(path, "spz", "found no header")
    return int.from_bytes(head[4:8], "little"), bool(head[14] & 1)


def _sog_meta(path: Path) -> dict[str, object] | None:
    """The table of an .sog, bundled or not; None: it is none.

    Raises:
        ProgdfError: the table is larger than any.
    """
    try:
        if path.name.lower() == SOG_META:
            content = read_file(path, _MOST_META + 1)
        else:
            with zipfile.ZipFile(path) as bundle:
                if bundle.getinfo(SOG_META).compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    return None  # zipfile unpacks others whole, however little of them is read
                with bundle.open(SOG_META) as file:
                    content = file.read(_MOST_META + 1)
        table = decode_json(content) if len(content) <= _MOST_META else None
    except (OSError, KeyError, ValueError, RuntimeError, zipfile.BadZipFile, zlib.error):
        return None
    if len(content) > _MOST_META:
        raise ProgdfError(
            f"{path} holds a {SOG_META} of more than {_MOST_META >> 20} MB, an .sog's has some kB; "
            "it is damaged: copy or export it again"
        )
    known = isinstance(table, dict) and "means" in table and "quats" in table
    return table if known else None
