"""Reader of training checkpoints of gsplat (.pt) and nerfstudio's splatfacto (.ckpt).

A checkpoint is a zip archive of torch: a pickle with names and shapes, and a file of raw numbers per tensor.
`torch.load` with `weights_only` reads it. It executes nothing from the file, and maps the numbers instead of
copying them. Two checks come first: the archive is not compressed, and the pickle names only plain tensors.
A tensor is only copied after a check that its numbers fit into the file.
"""

from __future__ import annotations

import errno
import io
import pickletools
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from progdf import sh
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.io.atomic import open_error, read_file
from progdf.io.file_rules import check_fields, damage_error, unsupported_error, variant_fields

from .containers import START_BYTES, check_foreign

LARGEST_PICKLE = 16 << 20  # bytes; the pickle of a checkpoint has about 100 kB
LEGACY_MAGIC = b"\x80\x02"  # start of a protocol 2 pickle; files since torch 1.6 are zip archives
MAX_TABLE_DEPTH = 4  # levels of nested tables that are searched for tensors
RESAVE = "load it with torch and save dense float tensors with torch.save"
EXPORT = (
    "export a .ply with the training program (nerfstudio: `ns-export gaussian-splat`, gsplat: `--save-ply`)"
)

_ALIASES = {
    "means": "means",
    "means3d": "means",  # gsplat 1.0
    "scales": "scales",
    "quats": "quats",
    "opacities": "opacities",
    "sh0": "sh0",
    "features_dc": "sh0",
    "shN": "shN",
    "features_rest": "shN",
}
"""Tensor names of gsplat and splatfacto → attributes."""

_WRAPPERS = {"splats", "pipeline", "state_dict", "module", "_model", "gauss_params"}
"""Name components of containers around the Gaussians, which are skipped; `module` comes from DDP."""

_TRAINING_STATE = {"optimizers", "optimizer", "schedulers", "scalers", "strategy_state"}
"""Tables that are only needed to resume training."""

_PLAIN_GLOBALS = {
    "collections.OrderedDict",
    "torch.Size",
    "torch.device",
    "torch._utils._rebuild_tensor_v2",
    "torch._utils._rebuild_parameter",
}
"""Globals in a pickle of plain tensors, besides storages and dtypes."""

_SPECIAL_TENSORS = {
    "torch._utils._rebuild_sparse_tensor": "sparse tensors",
    "torch._utils._rebuild_qtensor": "quantized tensors",
    "torch._utils._rebuild_meta_tensor_no_storage": "tensors without numbers (meta device)",
    "torch._utils._rebuild_nested_tensor": "nested tensors",
}

_COLOR_MODULE = re.compile(
    r"app_|appearance|embed|bil_?grid|bilateral|post_processing|ppisp|exposure|color_nn|color_net|mlp|bg_model"
)
"""Pattern for the names of modules that change colors, such as appearance networks."""


@dataclass(frozen=True)
class Checkpoint:
    """Gaussians of one checkpoint file, as stored."""

    scene: Gaussians
    step: object  # training step; None if the file states none
    ignored: tuple[str, ...]  # tensors and modules that do not change the scene


def read_checkpoint(path: Path) -> Checkpoint:
    """Read the Gaussians of a gsplat or nerfstudio checkpoint. Nothing in the file is executed.

    Raises:
        ProgdfError: the file is damaged, holds no Gaussians, or has a feature that is not supported.
    """
    content = _load_weights(path)
    if isinstance(content, tuple):
        raise _inria_error(path)
    tensors = dict(_find_tensors(content, "", set())) if isinstance(content, dict) else {}
    columns: dict[str, Tensor] = {}
    others: dict[str, None] = {}
    has_logit_colors = False
    for name, tensor in tensors.items():
        parts = [part for part in name.split(".") if part not in _WRAPPERS]
        column = _ALIASES.get(parts[0]) if len(parts) == 1 else None
        if column is None:
            others[parts[0] if parts else name] = None
            continue
        if column in columns:
            raise unsupported_error(path, f"two tensors '{column}' (one is '{name}')", EXPORT)
        columns[column] = tensor
        has_logit_colors |= parts[0] == "features_dc"
    refused = variant_fields(others)
    refused |= {name: "color corrections" for name in others if _COLOR_MODULE.search(name)}
    honored = {name for name in others if name in _TRAINING_STATE}
    ignored = check_fields(path, others, honored, refused, EXPORT)
    missing = [name for name in ("means", "quats", "scales", "opacities", "sh0") if name not in columns]
    if missing:
        found = ", ".join([*columns, *others][:6]) or "no tensors"
        raise ProgdfError(
            f"{path} is not a checkpoint of Gaussians from gsplat or nerfstudio: it holds no "
            f"{', '.join(missing)}, but {found}; {EXPORT}"
        )
    step = content.get("step")
    return Checkpoint(_gaussians(path, columns, has_logit_colors), step, ignored)


def _find_tensors(table: Mapping[Any, Any], prefix: str, seen: set[int]) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of nested tables with their dotted names; each table is visited once."""
    seen.add(id(table))
    for key, value in table.items():
        name = f"{prefix}{key}"
        if isinstance(value, Tensor):
            yield name, value
            continue
        is_new = isinstance(value, dict) and id(value) not in seen
        if is_new and key not in _TRAINING_STATE and name.count(".") < MAX_TABLE_DEPTH:
            yield from _find_tensors(value, f"{name}.", seen)


def _gaussians(path: Path, columns: Mapping[str, Tensor], has_logit_colors: bool) -> Gaussians:
    """Copy the columns out of the mapped file.

    Args:
        path: the checkpoint
        columns: means, quats, scales, opacities, sh0 and, above degree 0, shN
        has_logit_colors: at SH degree 0, sh0 is the logit of RGB, as in splatfacto
    """
    count = len(columns["means"]) if columns["means"].ndim else 0
    rest = columns.get("shN")
    bands = rest.shape[1] if rest is not None and rest.ndim == 3 else 0
    shapes: dict[str, list[tuple[int, ...]]] = {
        "means": [(count, 3)],
        "quats": [(count, 4)],
        "scales": [(count, 3)],
        "opacities": [(count,), (count, 1)],
        "sh0": [(count, 3), (count, 1, 3)],
        "shN": [(count, bands, 3)],
    }
    numbers = {}
    for name, tensor in columns.items():
        _check_tensor(path, name, tensor)
        if tuple(tensor.shape) not in shapes[name] or (name == "shN" and bands not in (0, 3, 8, 15, 24)):
            shape = "×".join(str(size) for size in tensor.shape) or "a single number"
            raise unsupported_error(path, f"'{name}' of shape {shape} beside {count} means", EXPORT)
        keeps_doubles = name == "means" and tensor.dtype == torch.float64
        dtype = torch.float64 if keeps_doubles else torch.float32
        numbers[name] = tensor.detach().to(dtype, copy=True).contiguous()
    base = numbers["sh0"].reshape(-1, 3)
    if has_logit_colors and not bands:
        base = sh.rgb_to_sh0(base.sigmoid())
    if not count:
        raise ProgdfError(f"{path} holds 0 Gaussians; a scene needs at least one: {EXPORT}")
    return Gaussians(
        means=numbers["means"],
        quats=numbers["quats"],
        log_scales=numbers["scales"],
        logit_opacities=numbers["opacities"].reshape(-1),
        sh0=base,
        shN=numbers.get("shN", torch.zeros(count, 0, 3)),
    )


def _check_tensor(path: Path, name: str, tensor: Tensor) -> None:
    """Refuse a tensor that has no plain floats, or that is an expanded view of a smaller storage."""
    kind = str(tensor.dtype).removeprefix("torch.")
    if tensor.layout != torch.strided or tensor.is_meta or tensor.is_quantized:
        raise unsupported_error(path, f"'{name}' as a special tensor ({kind}, {tensor.layout})", RESAVE)
    if not tensor.is_floating_point():
        raise unsupported_error(path, f"'{name}' as {kind} numbers", RESAVE)
    needed = tensor.numel() * tensor.element_size()
    stored = tensor.untyped_storage().nbytes()
    if needed > stored:
        feature = f"'{name}' as an expanded view ({needed} bytes from {stored} stored ones)"
        raise unsupported_error(path, feature, f"call .contiguous() on it, or {RESAVE}")


def _load_weights(path: Path) -> Any:
    """Load the content of a checkpoint with its tensors memory-mapped.

    Raises:
        ProgdfError: the archive or its pickle is damaged, or holds more than plain tensors.
    """
    _check_pickle(path, _read_pickle(path))
    try:
        with warnings.catch_warnings(action="ignore"):  # torch warns about pickles that it then refuses
            return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except OSError as error:
        raise open_error(path, error) from None
    except Exception as error:  # torch raises errors of many types for an inconsistent pickle
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise damage_error(path, f"its table of tensors is inconsistent ({reason})") from None


def _read_pickle(path: Path) -> bytes:
    """Return the pickle of torch's archive, after a check that its entries are uncompressed and fit."""
    start = read_file(path, START_BYTES)
    if start.startswith(LEGACY_MAGIC):
        raise unsupported_error(path, "the archive format of torch before 1.6", RESAVE)
    if not start.startswith(b"PK"):
        check_foreign(path, start)
        raise ProgdfError(f"{path} is not a checkpoint of torch, which is a zip archive; {EXPORT}")
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            _check_entries(path, entries)
            contents = {
                entry.filename.rpartition("/")[2]: archive.read(entry)
                for entry in entries
                if entry.filename.endswith(("/data.pkl", "/byteorder"))
            }
    except ProgdfError:
        raise
    except (zipfile.BadZipFile, ValueError, RuntimeError, NotImplementedError, EOFError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # EINVAL: negative offset
            raise open_error(path, error) from None
        raise damage_error(path, f"its archive cannot be read ({str(error)[:80]})") from None
    if contents.get("byteorder", b"little") != b"little":
        raise unsupported_error(path, "big-endian numbers", RESAVE)
    return contents["data.pkl"]


def _check_entries(path: Path, entries: Sequence[zipfile.ZipInfo]) -> None:
    """Refuse an archive that was not written by torch, or whose entries are larger than the file."""
    pickles = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
    if any(entry.filename.endswith("/constants.pkl") for entry in entries):
        raise unsupported_error(path, "a compiled program of torch (TorchScript)", EXPORT)
    if len(pickles) != 1:
        raise ProgdfError(f"{path} is a zip archive but not a checkpoint of torch; {EXPORT}")
    if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
        raise unsupported_error(path, "a compressed archive", "save it again with torch.save")
    if sum(entry.file_size for entry in entries) > path.stat().st_size:
        raise damage_error(path, "its entries are larger than the file")
    if pickles[0].file_size > LARGEST_PICKLE:
        feature = f"a table of {pickles[0].file_size >> 20} MB beside its tensors"
        raise unsupported_error(path, feature, EXPORT)


def _check_pickle(path: Path, pickled: bytes) -> None:
    """Refuse a pickle that names anything but plain tensors, before any object is built from it."""
    names = []
    protocol: object = 2
    last = ""
    try:
        for operation, value, _ in pickletools.genops(io.BytesIO(pickled)):
            if operation.name == "PROTO":
                protocol = value
            elif operation.name == "GLOBAL":
                names.append(str(value).replace(" ", ".", 1))
            elif operation.name != "STOP":
                last = operation.name
    except (ValueError, KeyError, IndexError, OverflowError) as error:
        raise damage_error(path, f"its pickle breaks off ({str(error)[:80]})") from None
    if protocol != 2:
        raise unsupported_error(path, f"pickle protocol {protocol}", RESAVE)
    for name in names:
        _check_global(path, name)
    if last.startswith("TUPLE"):
        raise _inria_error(path)


def _check_global(path: Path, name: str) -> None:
    if name in _SPECIAL_TENSORS:
        raise unsupported_error(path, _SPECIAL_TENSORS[name], RESAVE)
    is_type = re.fullmatch(r"torch\.([A-Za-z]+Storage|(b?float|u?int|bool|complex)\d*(_\w+)?)", name)
    if name not in _PLAIN_GLOBALS and not is_type:
        raise unsupported_error(path, f"more than weights (it would run {name[:80]})", EXPORT)


def _inria_error(path: Path) -> ProgdfError:
    return unsupported_error(
        path,
        "the training state of the original 3DGS code (chkpntN.pth)",
        "open point_cloud/iteration_N/point_cloud.ply of its run (written with `--save_iterations N`)",
    )
