"""Scenes in every format that people have: .ply, .spz, .splat, .ksplat, .sog, .glb, .gltf, .ckpt.

Recognized by content, else by name. The code for .spz, .sog and .splat is that of gaussforge, in a process of
its own (see `native_child`), as native code may crash on a broken file.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import signal
import subprocess
import tempfile
import zipfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from progdf import sh
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians, concatenate
from progdf.io import native_child
from progdf.io.atomic import atomic_write, read_file, write_files_together
from progdf.io.json_values import decode_json
from progdf.io.part_files import part_files
from progdf.terminal import escape_text

from . import gltf, usd
from .axes import Axes
from .checkpoint import LEGACY_MAGIC, read_checkpoint
from .compressed_ply import is_compressed, morton_order, read_compressed_ply, write_compressed_ply
from .gltf_file import MAGIC
from .ksplat import read_ksplat
from .ply import load_ply_with_report, read_ply, save_ply, save_ply_checked
from .ply_file import read_header
from .repair import LoadReport, repair

FORMATS = ("ply", "spz", "splat", "ksplat", "sog", "glb", "gltf", "ckpt")
"""What a scene may be, by the ending of its name; a compressed .ply is a .ply."""

WRITTEN = (".ply", ".compressed.ply", ".spz", ".sog", ".splat", ".glb", usd.SUFFIX)
"""What `save_scene` writes, by the ending of the name."""

MOST_FRAMES = 1000
"""Of `save_frames`, which numbers files with three digits."""

SOG_META = "meta.json"
"""The file that represents an unpacked .sog: its folder's table of images."""

CHECKPOINT = "checkpoint of a training"
"""The format of .pt and .ckpt files in reports."""

_MOST_META = 1 << 20
"""Bytes of its table, which has some 20 kB; parsed, JSON takes thirty times as much."""
_MEMORY, _OUTPUT, SECONDS = (1 << 30, 64), (64 << 20, 64), (60, 2e-6)
"""What a reader of another's making gets: so much, and so much for each byte of its file."""
_PATIENCE = 30
"""Times as long for writing our own scenes: clustering the bands of a million for an .sog takes minutes."""


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
    if start[:4] == MAGIC:
        return "glb"
    if start[:4] == b"NGSP" or (start[:2] == b"\x1f\x8b" and _inflate(start)[:4] == b"NGSP"):
        return "spz"
    if suffix in ("ckpt", "pt", "pth") and start[:2] in (b"PK", LEGACY_MAGIC):
        return "ckpt"
    if start[:4] == b"PK\x03\x04":
        return "sog" if _sog_meta(path) is not None else None
    if path.name.lower() == SOG_META and start.lstrip()[:1] == b"{":
        return "sog" if _sog_meta(path) is not None else None
    if suffix == "gltf":
        return suffix
    if suffix in ("splat", "ksplat"):  # which begin with whatever comes first in the scene
        return suffix
    return suffix if suffix in FORMATS and start.lstrip()[:1] not in (b"{", b"[") else None


def scene_file(path: str | os.PathLike[str]) -> Path:
    """The file that a scene is read from: of an unpacked .sog's folder its meta.json."""
    path = Path(path)
    return path / SOG_META if os.path.isfile(path / SOG_META) else path


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
    parts = part_files(path)
    if len(parts) > 1:
        return _load_parts(path, parts)
    kind = scene_format(path)
    if kind == "ply" or kind is None:
        ply = read_header(path)  # which knows best what is wrong with a file that is no .ply
        if not is_compressed(ply):
            return load_ply_with_report(path)
        return _repair(path, read_compressed_ply(ply), "compressed .ply")
    if kind == "ksplat":
        scene, level = read_ksplat(path)
        return _repair(path, scene, f".ksplat, level {level}")
    if kind in ("glb", "gltf"):
        found = gltf.read_gltf(path, partial(_read_spz_part, path))
        content = {
            "file_bytes": found.file_bytes,
            "conversions": found.conversions,
            "ignored_properties": found.ignored,
        }
        return _repair(path, found.scene, ", ".join([f".{kind}", *found.storage]), content)
    if kind == "ckpt":
        checkpoint = read_checkpoint(path)
        return _repair(path, checkpoint.scene, CHECKPOINT, {"ignored_properties": checkpoint.ignored})
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
    """Return the scene after half a turn about x: y up and z back become y down and z forward."""
    turn = torch.tensor([1.0, -1.0, -1.0])
    x, y, z = scene.origin
    return replace(
        scene,
        means=scene.means * turn,
        origin=(x, 0.0 - y, 0.0 - z),
        quats=scene.quats * torch.tensor([1.0, 1.0, -1.0, -1.0]),
        shN=sh.half_turn(scene.shN, (1.0, -1.0, -1.0)),
    )


def _load_parts(path: Path, parts: Sequence[Path]) -> tuple[Gaussians, LoadReport]:
    """Join the files of a training on several GPUs, in the order of the GPUs.

    Args:
        path: one of the parts
        parts: all of them

    Raises:
        ProgdfError: a part cannot be read, or is of another training step or SH degree than the first.
    """
    is_checkpoint = scene_format(path) == "ckpt"
    scenes: list[Gaussians] = []
    traits: list[tuple[object, ...]] = []
    ignored: dict[str, None] = {}
    for part in parts:
        if is_checkpoint:
            checkpoint = read_checkpoint(part)
            scene, step, names = checkpoint.scene, checkpoint.step, checkpoint.ignored
        else:
            scene, stored = read_ply(read_header(part))
            step, names = None, stored["ignored_properties"]
        scenes.append(scene)
        traits.append((step, scene.sh_degree, scene.antialiased))
        ignored |= dict.fromkeys(names)
        if traits[-1] != traits[0]:
            raise ProgdfError(
                f"{part} does not belong to {parts[0].name}: they differ in training step, SH degree or "
                "antialiasing; put the parts of one training into one folder"
            )
    format_name = CHECKPOINT if is_checkpoint else ".ply"
    content = {"ignored_properties": tuple(ignored), "file_bytes": sum(_size(part) for part in parts)}
    return _repair(path, concatenate(scenes), f"{format_name} in {len(parts)} parts, one per GPU", content)


def _repair(
    path: Path, stored: Gaussians, kind: str, content: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Gaussians, LoadReport]:
    """Return the scene as it can be used, and the report of its file.

    Args:
        path: the file
        stored: N Gaussians as they were read, means in the world
        kind: the format, for a person
        content: further fields of the report
    """
    scene, counts = repair(stored)
    fields = {"file_bytes": _size(path), **content, **counts}
    report = LoadReport(
        file=scene_name(path),
        format=kind,
        count=len(scene),
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        **fields,
    )
    return scene, report


def _through_gaussforge(path: Path, kind: str) -> tuple[Gaussians, LoadReport]:
    """The scene as gaussforge reads it, repaired, in the axes of the file.

    Raises:
        ProgdfError: gaussforge is not installed, cannot read the file, crashes on it or takes too long.
    """
    _require_gaussforge(path, kind)
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        target = Path(folder) / "scene.ply"
        if reason := _convert(path, kind, target, "ply"):
            raise _read_error(path, kind, reason)
        try:
            return load_ply_with_report(target)
        except ProgdfError:
            raise _read_error(path, kind, "returned no scene") from None


def _read_spz_part(path: Path, content: bytes) -> Gaussians:
    """Read an .spz inside another file, in its own axes (RUB).

    Args:
        path: the file that holds it, for errors
        content: the bytes of the .spz
    """
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        part = Path(folder) / "part.spz"
        part.write_bytes(content)
        try:
            _, antialiased = _spz_header(part)
            scene, _ = _through_gaussforge(part, "spz")
        except ProgdfError as error:
            raise ProgdfError(str(error).replace(str(part), f"{path}: its .spz part")) from None
    return replace(scene, antialiased=antialiased)


def _convert(source: Path, kind: str, target: Path, to: str) -> str:
    """A scene file through gaussforge into another format; what went wrong, or nothing."""
    size, patience = _size(source), 1 if to == "ply" else _PATIENCE
    memory, output, seconds = (int(base + each * size) for base, each in (_MEMORY, _OUTPUT, SECONDS))
    words = "convert", kind, str(source.resolve()), to, str(target)
    try:
        ended = native_child.run((memory, output, patience * seconds), 2 * patience * seconds, *words)
    except subprocess.TimeoutExpired:
        return f"did not answer within {2 * patience * seconds} s"
    return _reason(ended.returncode, ended.stderr) if ended.returncode or not target.is_file() else ""


def save_scene(path: Path, scene: Gaussians, glb_axes: Axes = "LUF") -> None:
    """Write a scene in the format that the name asks for; the file appears whole or not at all.

    A .ply is exact and is read back and compared. The others are smaller, or are what another program reads:

        .compressed.ply   16 bytes a Gaussian and 1 a coefficient; in Morton order, as chunks share a range
        .spz, .sog        8 bits and less; .spz and .usdc are turned to y up, as readers expect
        .splat            32 bytes, without SH bands
        .glb, .usdc       float32, KHR_gaussian_splatting and ParticleField3DGaussianSplat

    Args:
        path: ends in one of `WRITTEN`
        scene: N Gaussians, finite; bands above degree 3 are left out of all but the .ply
        glb_axes: axes of a .glb, LUF (glTF's own) or RUB (OpenGL's)

    Raises:
        ProgdfError: another ending, an absent package, or what cannot be written.
    """
    ending = written_format(path)
    if ending == ".ply":
        save_ply_checked(path, scene)
        return
    kind, scene = ending[1:], replace(scene, shN=scene.shN[:, : (gltf.MAX_DEGREE + 1) ** 2 - 1])
    with atomic_write(path) as written:
        if kind == "compressed.ply":
            write_compressed_ply(written, scene[morton_order(scene.means)])
        elif kind == "glb":
            gltf.write_glb(written, scene, glb_axes)
        elif ending == usd.SUFFIX:
            usd.write_usd(written, [rotate_about_x(scene)])
        else:
            _require_gaussforge(path, kind)
            with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
                source, target = Path(folder) / "scene.ply", Path(folder) / f"scene.{kind}"
                save_ply(source, rotate_about_x(scene) if kind == "spz" else scene)
                if reason := _convert(source, "ply", target, kind):
                    raise ProgdfError(f"{path} was not written: the writer of .{kind} {reason}")
                shutil.copyfile(target, written)


def save_frames(
    path: Path, scenes: Iterable[Gaussians], rate: float = 24.0, glb_axes: Axes = "LUF"
) -> list[Path]:
    """Write scenes one after the other, see `frame_path`; all appear or none.

    Earlier frames of the same names are replaced when all are written, see `write_files_together`.

    Args:
        path: ends in one of `WRITTEN`
        scenes: N Gaussians each; those of a .usdc have the same rows
        rate: of a .usdc, samples a second
        glb_axes: as `save_scene`

    Returns:
        The files, in the order of the scenes.

    Raises:
        ProgdfError: as `save_scene`.
    """
    if written_format(path) == usd.SUFFIX:
        with atomic_write(path) as written:
            usd.write_usd(written, map(rotate_about_x, scenes), rate)
        return [path]
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; create it first")
    paths = []
    with write_files_together(path.parent) as folder:
        for number, scene in enumerate(scenes):
            frame = frame_path(path, number)
            save_scene(folder / frame.name, scene, glb_axes)
            paths.append(frame)
    return paths


def frame_path(path: Path, number: int) -> Path:
    """The file of one of several scenes: NAME_000.ply and so on; a .usdc has all of them."""
    ending = written_format(path)
    stem = path.name[: -len(ending)]
    return path if ending == usd.SUFFIX else path.with_name(f"{stem}_{number:03d}{path.name[len(stem) :]}")


def written_format(path: Path) -> str:
    """Which of `WRITTEN` a name asks for.

    Raises:
        ProgdfError: none of them.
    """
    for ending in sorted(WRITTEN, key=len, reverse=True):
        if path.name.lower().endswith(ending):
            return ending
    raise ProgdfError(
        f"{path} names no format to write; end it in {', '.join(WRITTEN[:-1])} or {WRITTEN[-1]}"
    )


def _require_gaussforge(path: Path, kind: str) -> None:
    if importlib.util.find_spec("gaussforge") is None:
        raise ProgdfError(f"{path}: .{kind} needs the package gaussforge; pip install progdf-studio[formats]")


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
