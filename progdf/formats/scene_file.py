"""Loading and saving of scenes: .ply, .spz, .splat, .ksplat, .sog, .glb, .gltf, .ckpt.

The format is recognized by content, otherwise by name, also inside a .zip or .gz. The library gaussforge
reads .spz and writes .splat. It runs in a separate process (see `native_child`) because
native code may crash on a broken file.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch

from progdf import sh
from progdf.errors import ProgdfError, check_first_argument
from progdf.gaussians import ZERO, Gaussians, concatenate
from progdf.io import native_child
from progdf.io.atomic import atomic_write, read_file, write_files_together
from progdf.io.file_rules import damage_error, unsupported_error
from progdf.io.part_files import part_files
from progdf.metrics.readback import FLOAT_ROUNDING, ReadBack, check_finite, compare
from progdf.system.packages import install_extra
from progdf.terminal import escape_text

from . import gltf, usd
from .axes import Axes
from .checkpoint import read_checkpoint
from .containers import GZIP, START_BYTES, ZIP, check_foreign, inflate_start, unpacked_scene
from .gltf_file import MAGIC
from .packed import spz
from .packed.compressed_ply import (
    is_compressed,
    morton_order,
    position_steps,
    read_compressed_ply,
    write_compressed_ply,
)
from .packed.ksplat import read_ksplat, read_splat
from .packed.sog import META as SOG_META
from .packed.sog import read_sog, read_table, scene_bytes
from .packed.sog_tree import INDEX, describe_levels, is_index, read_sog_tree
from .ply import load_ply_with_report, read_ply, save_ply, save_ply_checked
from .ply_file import read_header
from .repair import LoadReport, limit_logits, repair

CONTAINERS = ("zip", "gz")
"""Archive formats. An archive is read if it holds exactly one scene."""

FORMATS = ("ply", "spz", "splat", "ksplat", "sog", "glb", "gltf", "ckpt", *CONTAINERS)
"""Formats that are read, by the ending of the name. A compressed .ply counts as a .ply."""

WRITTEN_SUFFIXES = (".ply", ".compressed.ply", ".spz", ".sog", ".splat", ".glb", usd.SUFFIX)
"""Formats that `save_scene` writes, by the ending of the name."""

MAX_FRAMES = 1000
"""Largest number of scenes for `save_frames`, which numbers files with three digits."""

CHECKPOINT_SUFFIXES = ("ckpt", "pt", "pth")  # name endings of checkpoints, without the dot

CHECKPOINT = "checkpoint of a training"
"""Format name of .pt, .pth and .ckpt in a report."""

_SPZ_VERSIONS = (1, 2, 3, 4)
_SPZ_LAST_GZIP = b"\3"  # last version that is stored as gzip data
_SPZ_EXTENDED = 2  # flag: the file has extensions
_SPZ_MAX_DEGREE = 4  # largest SH degree
# limits of the gaussforge process: a base, and an increment per byte of the file
_MEMORY_LIMIT = (1 << 30, 64)  # bytes of memory
_OUTPUT_LIMIT = (64 << 20, 64)  # bytes of output
TIME_LIMIT_S = (60, 2e-6)  # seconds of processor time
_log = logging.getLogger(__name__)


def scene_format(path: str | os.PathLike[str]) -> str | None:
    """Return the format of a file, by content or otherwise by name; None if it is not a scene.

    Returns:
        One of `FORMATS`, or None.

    Raises:
        ProgdfError: the file cannot be read.
    """
    path = scene_file(path)
    start = read_file(path, START_BYTES)
    suffix = path.suffix.lower().lstrip(".")
    if start[:3] == b"ply":
        return "ply"
    if start[:4] == MAGIC:
        return "glb"
    if start[:4] == b"NGSP":
        return "spz"
    if start[:2] == GZIP:
        header = inflate_start(start, 8)  # an .spz up to version 3 is gzip data; later versions are plain
        return "spz" if header[:4] == b"NGSP" and header[4:5] <= _SPZ_LAST_GZIP else "gz"
    if suffix in CHECKPOINT_SUFFIXES:
        return "ckpt"
    if start[:4] == ZIP:
        return "sog" if suffix == "sog" or read_table(path) is not None else "zip"
    if path.name.lower() == SOG_META and start.lstrip()[:1] == b"{":
        return "sog" if read_table(path) is not None else None
    if suffix == "gltf":
        return suffix
    if is_index(path, start):
        return "sog"
    if suffix in ("splat", "ksplat"):  # no magic number: any first byte is valid
        return suffix
    return suffix if suffix in FORMATS and start.lstrip()[:1] not in (b"{", b"[") else None


def scene_file(path: str | os.PathLike[str]) -> Path:
    """Return the file that a scene is read from: the path itself, or the table or index in a .sog folder."""
    path = Path(path)
    for name in (INDEX, SOG_META):
        if os.path.isfile(path / name):
            return path / name
    return path


def scene_name(path: Path) -> str:
    """Return the name of a scene: the name of its file, or of the folder of an unpacked .sog."""
    return path.parent.name if path.name.lower() in (SOG_META, INDEX) else path.name


def load_scene(path: str | os.PathLike[str]) -> Gaussians:
    """Load a scene from a file of any known format; log repairs and losses as warnings.

    Axes are those of the 3DGS .ply (y down, z forward). An .spz, which has y up and z towards the viewer, is
    rotated by half a turn about x.

    Raises:
        ProgdfError: the file is missing, broken or not a scene, or its reader is not installed.
    """
    check_first_argument("load_scene(path)", path, (str, os.PathLike))
    scene, report = load_scene_with_report(path)
    report.log()
    return scene


def load_scene_with_report(path: str | os.PathLike[str]) -> tuple[Gaussians, LoadReport]:
    """Load a scene as `load_scene` does, and return it with the report on its content and repairs."""
    path = scene_file(path)
    parts = part_files(path)
    if len(parts) > 1:
        return _load_parts(path, parts)
    kind = scene_format(path)
    if kind not in CONTAINERS:
        return _load(path, kind)
    with unpacked_scene(path) as inner:
        inner_kind = scene_format(inner)
        if inner_kind in CONTAINERS:
            raise ProgdfError(f"{inner} is an archive too; unpack both and give the scene inside")
        scene, report = _load(inner, inner_kind)
    description = f"{report.format}, in a .{kind}"
    return scene, replace(report, file=path.name, file_bytes=path.stat().st_size, format=description)


def _load(path: Path, kind: str | None) -> tuple[Gaussians, LoadReport]:
    """Return the scene of a file that is not an archive, and the report.

    Args:
        path: the file
        kind: one of `FORMATS`; None if unknown, so that the .ply reader raises the error
    """
    start = read_file(path, START_BYTES)
    is_table = kind == "gltf" or path.name.lower() in (SOG_META, INDEX)
    if not (is_table and start.lstrip()[:1] in (b"{", b"[")):
        check_foreign(path, start)
    if kind == "sog" and is_index(path, start):
        tree = read_sog_tree(path)
        content = {"ignored_properties": tree.ignored, "file_bytes": tree.file_bytes}
        return _repair(path, tree.gaussians, describe_levels(tree), content)
    if kind == "sog":
        sog = read_sog(path)
        return _repair(path, sog.gaussians, f".sog {sog.version}", {"ignored_properties": sog.ignored})
    if kind == "ply" or kind is None:
        ply = read_header(path)
        if not is_compressed(ply):
            return load_ply_with_report(path)
        scene, ignored = read_compressed_ply(ply)
        return _repair(path, scene, "compressed .ply", {"ignored_properties": ignored})
    if kind == "splat":
        return _repair(path, read_splat(path), ".splat")
    if kind == "ksplat":
        scene, level = read_ksplat(path)
        return _repair(path, scene, f".ksplat, level {level}")
    if kind in ("glb", "gltf"):
        glb = gltf.read_gltf(path, partial(_read_spz_part, path))
        content = {
            "file_bytes": glb.file_bytes,
            "conversions": glb.conversions,
            "ignored_properties": glb.ignored,
        }
        return _repair(path, glb.scene, ", ".join([f".{kind}", *glb.storage]), content)
    if kind == "ckpt":
        checkpoint = read_checkpoint(path)
        return _repair(path, checkpoint.scene, CHECKPOINT, {"ignored_properties": checkpoint.ignored})
    version, flags = _check_spz(path)
    antialiased = bool(flags & spz.ANTIALIASED)
    content = {"ignored_properties": ("extensions",) if flags & _SPZ_EXTENDED else ()}
    scene = rotate_about_x(replace(_read_with_gaussforge(path, "spz"), antialiased=antialiased))
    return _repair(path, scene, f".spz {version}, turned from y up to y down", content)


def rotate_about_x(scene: Gaussians) -> Gaussians:
    """Rotate a scene by half a turn about x: y up and z back become y down and z forward."""
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
    """Join the files of a multi-GPU training, in the order of the GPUs.

    Args:
        path: one of the parts
        parts: all of them

    Raises:
        ProgdfError: a part cannot be read, or its training step, SH degree or antialiasing differs from the
            first part's.
    """
    is_checkpoint = scene_format(path) == "ckpt"
    scenes: list[Gaussians] = []
    traits: list[tuple[object, ...]] = []
    ignored: dict[str, None] = {}
    for part in parts:
        if is_checkpoint:
            checkpoint = read_checkpoint(part)
            scene = checkpoint.scene
            step = checkpoint.step
            names = checkpoint.ignored
        else:
            scene, stored = read_ply(read_header(part))
            step = None
            names = stored["ignored_properties"]
        scenes.append(scene)
        traits.append((step, scene.sh_degree, scene.antialiased))
        ignored |= dict.fromkeys(names)
        if traits[-1] != traits[0]:
            raise ProgdfError(
                f"{part} does not belong to {parts[0].name}: they differ in training step, SH degree or "
                "antialiasing; put the parts of one training into one folder"
            )
    format_name = CHECKPOINT if is_checkpoint else ".ply"
    content = {"ignored_properties": tuple(ignored), "file_bytes": sum(scene_bytes(part) for part in parts)}
    return _repair(path, concatenate(scenes), f"{format_name} in {len(parts)} parts, one per GPU", content)


def _repair(
    path: Path, stored: Gaussians, kind: str, content: Mapping[str, Any] = MappingProxyType({})
) -> tuple[Gaussians, LoadReport]:
    """Return the repaired scene, ready to render, and the report.

    Args:
        path: the scene's file
        stored: N Gaussians as stored, means in the world
        kind: the format as shown to the user
        content: further fields of the report

    Raises:
        ProgdfError: no Gaussian is usable.
    """
    scene, counts = repair(stored, path)
    fields = {"file_bytes": scene_bytes(path), **content, **counts}
    report = LoadReport(
        file=scene_name(path),
        format=kind,
        count=len(scene),
        sh_degree=scene.sh_degree,
        antialiased=scene.antialiased,
        **fields,
    )
    return scene, report


def _read_with_gaussforge(path: Path, kind: str) -> Gaussians:
    """Read a scene with gaussforge, as stored, in the axes of the file.

    Raises:
        ProgdfError: gaussforge is not installed, cannot read the file, crashes on it or takes too long.
    """
    _require_gaussforge(path, kind)
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        target = Path(folder) / "scene.ply"
        reason = _convert(path, kind, target, "ply")
        if reason:
            raise _read_error(path, kind, reason)
        try:
            scene = read_ply(read_header(target))[0]
        except ProgdfError:
            raise _read_error(path, kind, "returned no scene") from None
    logits = limit_logits(scene.logit_opacities.numpy())  # bytes of 0 and 255
    return replace(scene, logit_opacities=torch.from_numpy(logits))


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
            _, flags = _check_spz(part)
            scene = _read_with_gaussforge(part, "spz")
        except ProgdfError as error:
            raise ProgdfError(str(error).replace(str(part), f"{path}: its .spz part")) from None
    return replace(scene, antialiased=bool(flags & spz.ANTIALIASED))


def _convert(source: Path, kind: str, target: Path, to: str) -> str:
    """Convert a scene file with gaussforge; return the reason for a failure, or an empty text."""
    size = scene_bytes(source)
    memory, output, seconds = (
        int(base + each * size) for base, each in (_MEMORY_LIMIT, _OUTPUT_LIMIT, TIME_LIMIT_S)
    )
    words = "convert", kind, str(source.resolve()), to, str(target)
    try:
        result = native_child.run((memory, output, seconds), 2 * seconds, *words)
    except subprocess.TimeoutExpired:
        return f"did not finish within {2 * seconds} s"
    if result.returncode or not target.is_file():
        return _failure_reason(result.returncode, result.stderr)
    return ""


def save_scene(path: str | os.PathLike[str], scene: Gaussians, glb_axes: Axes = "LUF") -> ReadBack | None:
    """Write a scene in the format given by the name's ending; the file appears complete or not at all.

    The file is read back and compared before it appears. A .ply is exact. The other formats are smaller, or
    for other programs:

        .compressed.ply   16 bytes per Gaussian, 1 per SH coefficient; in Morton order (chunks share a range)
        .sog              8 bits per value, in Morton order; 65 536 rows of SH at most
        .spz              8 bits and less; .spz and .usdc are rotated to y up, as readers expect
        .splat            32 bytes, without SH bands
        .glb, .usdc       float32, KHR_gaussian_splatting and ParticleField3DGaussianSplat

    Args:
        path: ends in one of `WRITTEN_SUFFIXES`
        scene: N Gaussians, finite; SH bands above degree 3 are written to a .ply only
        glb_axes: axes of a .glb, LUF (glTF's own) or RUB (OpenGL's)

    Returns:
        The scene as read back, and the differences. None for .ply, which is exact, and for .usdc, which
        cannot be read back.

    Raises:
        ProgdfError: the ending is none of `WRITTEN_SUFFIXES`, a package is missing, or a position is out of
            range.
    """
    check_first_argument("save_scene(path, scene)", path, (str, os.PathLike))
    path = Path(path)
    ending = written_format(path)
    if ending == ".ply":
        save_ply_checked(path, scene)
        return None
    check_finite(path, scene)
    stored = replace(scene, shN=scene.shN[:, : (gltf.MAX_DEGREE + 1) ** 2 - 1])
    if ending in (".compressed.ply", ".sog"):
        stored = stored[morton_order(stored.means)]
    with atomic_write(path) as written:
        if ending == ".compressed.ply":
            write_compressed_ply(written, stored)
        elif ending == ".glb":
            gltf.write_glb(written, stored, glb_axes)
        elif ending == usd.SUFFIX:
            usd.write_usd(written, [rotate_about_x(stored)])
            return None
        elif ending == ".spz":
            _write_spz(path, written, stored)
        elif ending == ".sog":
            from .packed.sog_writer import write_sog  # loads numba

            write_sog(written, stored)
        else:
            _write_splat(path, written, stored)
        try:
            read = load_scene_with_report(written)[0]
        except ProgdfError as error:
            reason = str(error).replace(str(written), "the new file")
            raise ProgdfError(f"{path} was not written: {reason}") from None
        return compare(path, stored, read, _position_bounds(ending, stored))


def _write_spz(path: Path, written: Path, scene: Gaussians) -> None:
    """Write a scene as .spz, rotated to the axes of the format.

    Args:
        path: the file's name, for errors
        written: the file to write
        scene: N Gaussians, finite
    """
    _require_gaussforge(path, "spz")  # reads the file back
    bits = spz.position_bits(scene)
    if bits < 0:
        raise spz.range_error(path, scene)
    spz.write_spz(written, rotate_about_x(scene), bits)


def _write_splat(path: Path, written: Path, scene: Gaussians) -> None:
    """Write a scene as .splat with gaussforge, which reads no doubles, so positions are float32.

    Args:
        path: the file's name, for errors
        written: the file to write
        scene: N Gaussians, finite
    """
    _require_gaussforge(path, "splat")
    with tempfile.TemporaryDirectory(prefix="progdf-") as folder:
        source = Path(folder) / "scene.ply"
        target = Path(folder) / "scene.splat"
        save_ply(source, replace(scene, means=scene.world_means.float(), origin=ZERO))
        reason = _convert(source, "ply", target, "splat")
        if reason:
            raise ProgdfError(f"{path} was not written: the writer of .splat {reason}; write a .ply")
        shutil.copyfile(target, written)


def _position_bounds(ending: str, scene: Gaussians) -> torch.Tensor:
    """Return the largest rounding error of each coordinate in a format, world units. [N,3] float64

    Args:
        ending: an entry of `WRITTEN_SUFFIXES` whose format can be read back
        scene: the scene in the order of the file
    """
    means = scene.world_means
    rounding = means.abs() * FLOAT_ROUNDING + torch.finfo(torch.float32).tiny
    if ending == ".spz":
        return rounding + 0.5 * 2.0 ** -spz.position_bits(scene)
    if ending == ".sog":
        logs = means.abs().log1p() * means.sign()
        step = (logs.amax(dim=0) - logs.amin(dim=0)) / 65535
        return rounding * 4 + (1 + means.abs()) * (1.01 * step).expm1()
    if ending == ".compressed.ply":
        steps, largest = position_steps(scene)
        return rounding + 0.5 * steps + largest * FLOAT_ROUNDING
    return rounding


def save_frames(
    path: Path, scenes: Iterable[Gaussians], rate: float = 24.0, glb_axes: Axes = "LUF"
) -> list[Path]:
    """Write a sequence of scenes as numbered files (see `frame_path`), all or none.

    Existing frames of the same names are replaced once all are written, see `write_files_together`. A warning
    names attributes that the format cannot store, for the first scene that loses any.

    Args:
        path: ends in one of `WRITTEN_SUFFIXES`
        scenes: N Gaussians each; a .usdc needs the same rows in all scenes
        rate: samples per second of a .usdc
        glb_axes: see `save_scene`

    Returns:
        The files, in the order of the scenes.

    Raises:
        ProgdfError: see `save_scene`.
    """
    if written_format(path) == usd.SUFFIX:
        with atomic_write(path) as written:
            usd.write_usd(written, map(rotate_about_x, scenes), rate)
        return [path]
    if not path.parent.is_dir():
        raise ProgdfError(f"the folder {path.parent} does not exist; create it first")
    paths = []
    has_warned = False
    with write_files_together(path.parent) as folder:
        for number, scene in enumerate(scenes):
            frame = frame_path(path, number)
            read_back = save_scene(folder / frame.name, scene, glb_axes)
            paths.append(frame)
            if read_back is not None and read_back.notes and not has_warned:
                _log.warning("%s: %s", frame, "; ".join(read_back.notes))
                has_warned = True
    return paths


def frame_path(path: Path, number: int) -> Path:
    """Return the file name of one frame: NAME_000.ply and so on. A .usdc holds all frames in one file."""
    ending = written_format(path)
    stem = path.name[: -len(ending)]
    return path if ending == usd.SUFFIX else path.with_name(f"{stem}_{number:03d}{path.name[len(stem) :]}")


def written_format(path: Path) -> str:
    """Return the entry of `WRITTEN_SUFFIXES` that a file name ends in.

    Raises:
        ProgdfError: the name ends in none of them.
    """
    for ending in sorted(WRITTEN_SUFFIXES, key=len, reverse=True):
        if path.name.lower().endswith(ending):
            return ending
    *others, last = WRITTEN_SUFFIXES
    raise ProgdfError(f"{path} does not end in a known format; use {', '.join(others)} or {last}")


def _require_gaussforge(path: Path, kind: str) -> None:
    if importlib.util.find_spec("gaussforge") is None:
        raise ProgdfError(f"{path}: .{kind} needs the package gaussforge; {install_extra('formats')}")


def _failure_reason(status: int, stderr: bytes) -> str:
    """Return the reason why the gaussforge process failed.

    Args:
        status: exit status, or the negative number of the signal that ended the process
        stderr: its error output
    """
    if status < 0:
        name = signal.Signals(-status).name if -status in set(signal.Signals) else str(-status)
        return "exceeded its time limit" if name in ("SIGXCPU", "SIGKILL") else f"crashed ({name})"
    lines = stderr.decode("utf-8", "replace").strip().splitlines()
    message = escape_text(lines[-1] if lines else "")
    if "bad_alloc" in message or message.startswith("MemoryError"):
        return "requested more memory than such a file needs"
    return f"reported: {message[:160]}" if message else "reported nothing"


def _read_error(path: Path, kind: str, why: str) -> ProgdfError:
    """Return the error for a file that gaussforge did not read.

    Args:
        path: the file
        kind: its format
        why: see `_failure_reason`
    """
    if why.startswith(("reported", "returned")):
        return damage_error(path, f"the reader of .{kind} {why}")
    return ProgdfError(
        f"{path} cannot be read as .{kind}: its reader {why}; export it again, as .ply if possible"
    )


def _check_spz(path: Path) -> tuple[int, int]:
    """Return the version of an .spz, and its flags.

    Raises:
        ProgdfError: the version or the SH degree is not supported, or the header is damaged.
    """
    start = read_file(path, 4096)
    header = start if start[:4] == b"NGSP" else inflate_start(start, 16)
    if header[:4] != b"NGSP" or len(header) < 16:
        raise damage_error(path, "an .spz begins with 'NGSP', plain or as gzip data, and this file does not")
    version = int.from_bytes(header[4:8], "little")
    degree = header[12]
    remedy = "export it as .ply, or as .spz version 3"
    if version not in _SPZ_VERSIONS:
        raise unsupported_error(path, f".spz version {version}", remedy)
    if degree > _SPZ_MAX_DEGREE:
        raise unsupported_error(path, f"SH degree {degree}", remedy)
    return version, header[14]
