"""Contents of a .gdf file: a JSON header in the safetensors metadata, and the tensors.

The header ends with a SHA-256 over its own text without the checksum, and over every tensor's name, type,
shape and bytes. A file that differs from the saved one is refused. Nothing in it is executed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
import safetensors
import safetensors.numpy
import safetensors.torch
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.baked import (
    AttributeBases,
    BakedField,
    BakePlan,
    GradeForm,
    NeuralForm,
    SliderRemap,
    unpack_levels,
)
from progdf.field.neural import NeuralField, NeuralShape
from progdf.gaussians import ATTRIBUTES, ZERO, Gaussians, Origin
from progdf.io.json_values import convert_json, decode_json
from progdf.io.tensors import check_tensor, inflate
from progdf.region import Region

from .anchors import MAX_ANCHORS, PUSHED_SHAPE, Anchors
from .motions import MotionRecord, PartMotions, part_motions

FORMAT = 10
"""Version of the file format."""

MAX_GAUSSIANS = 1 << 26
"""Largest number of Gaussians that a header may state. The score of more would take gigabytes."""

_MAX_HEADER = 1 << 24  # bytes; a report takes a few kB, and 100 MB of JSON could take 1 GB when parsed
_METADATA = "progdf"  # only metadata key; safetensors writes several keys in varying order
_BASES_TENSORS = ("end_offset", "residual_basis", "scale", "coefficients")  # tensors of `AttributeBases`
_GRADE_TENSORS = ("knots", "table", "residual", "scale", "coefficients")  # tensors of `GradeForm`
_PACKED_SUFFIX = ".packed"  # ending of compressed per-member tensors, see `GradeForm.packed_levels`
_ADDED_PREFIX = "added."
_ANCHORED_FORMAT = 8  # first format that stores anchors of added rows
_KINDS = ("geometry", "opacity", "color")  # kinds of change, see `progdf.compose.layers.KINDS`
_NETWORK_PREFIX = "network."
_PARTS = "motions.parts"
_END_CORRECTION_PREFIX = "end_correction."
_OLDEST_FORMAT = 3  # oldest format that is read


class SceneFingerprint(msgspec.Struct, frozen=True):
    """Fingerprint that binds a .gdf to its scene."""

    count: int  # number of Gaussians
    means_sha256: str  # SHA-256 of the world means, float32


class NetworkHeader(msgspec.Struct, frozen=True):
    """Header of a stored network, with the number of bases per attribute and the error of baking."""

    shape: NeuralShape
    ranks: dict[str, int]
    rows_sha256: str
    bake_error: dict[str, float]


class FieldHeader(msgspec.Struct, frozen=True):
    """Header of a field, see `BakedField`. `network` is set if a network is stored in place of the field."""

    kind: str
    channels: int
    attributes: list[str]
    recorded: list[float]
    network: NetworkHeader | None = None
    grade: int | None = None  # degree of the map of a grade


class GdfHeader(msgspec.Struct, frozen=True):
    """JSON header of a .gdf file."""

    name: str
    instruction: str
    scene: SceneFingerprint
    region: str
    members: Annotated[int, msgspec.Meta(ge=0)]
    field: FieldHeader
    options: dict[str, Any]
    report: dict[str, Any]
    added: Annotated[int, msgspec.Meta(ge=0)] = 0  # rows that the scene does not have, see `Gdf.added`
    added_origin: Origin = ZERO
    anchored: bool = False  # the added rows have anchors, see `Gdf.anchors`
    # kinds of change, see `Anchors.pushes`; in format 8, True stands for geometry and opacity
    pushes: bool | list[str] = []
    leaves_paint: bool = False  # see `Anchors.leaves_paint`
    adds: bool = False  # see `Gdf.adds`
    rim: bool = False  # the added rows have shares of a rim, see `Anchors.rim`
    motions: list[list[MotionRecord]] = []  # motions of each part, see `Gdf.motions`; empty: none
    format: int = FORMAT
    sha256: str = ""


def pack_file(header: GdfHeader, tensors: Mapping[str, Tensor]) -> bytes:
    """Return the bytes of a .gdf file, with the checksum added to the header.

    Args:
        header: the header without checksum
        tensors: contiguous CPU tensors by name
    """
    sha256 = checksum(_encode(header), tensors)
    arrays = {name: tensor.numpy() for name, tensor in tensors.items()}
    text = _encode(msgspec.structs.replace(header, sha256=sha256))
    return safetensors.numpy.save(arrays, {_METADATA: text})


def unpack_file(content: bytes, name: str) -> tuple[GdfHeader, dict[str, Tensor]]:
    """Return the header and the tensors of a .gdf file, also of older formats; the inverse of `pack_file`.

    Args:
        content: bytes of the file
        name: name of the file for errors

    Raises:
        ProgdfError: the file is not a .gdf file, from a newer version, truncated, damaged or inconsistent.
    """
    size = int.from_bytes(content[:8], "little")
    if not 2 <= size <= _MAX_HEADER or content[8:9] != b"{":
        raise ProgdfError(f"{name} is not a .gdf file; give one that progdf train or progdf fit has written")
    try:
        tensors: dict[str, Tensor] = safetensors.torch.load(content)
        text = (decode_json(content[8 : 8 + size]).get("__metadata__") or {}).get(_METADATA)
    except (safetensors.SafetensorError, ValueError, KeyError, RuntimeError, OverflowError):
        raise ProgdfError(f"{name} is truncated or damaged; copy it again or train the edit again") from None
    if text is None:
        raise ProgdfError(
            f"{name} is a safetensors file, but not a .gdf; give one that progdf train has written"
        )
    damage = ProgdfError(f"{name} is damaged (checksum mismatch); copy it again or train the edit again")
    try:
        value = decode_json(text)
        sha256 = convert_json(value["sha256"], str)
        version = convert_json(value["format"], int)
        intact = checksum(text.replace(sha256, ""), tensors) == sha256 and version >= _OLDEST_FORMAT
    except (ValueError, KeyError, TypeError, RuntimeError):
        raise damage from None
    if version > FORMAT:
        raise ProgdfError(f"{name} has format {version}, this progdf reads format {FORMAT}; update progdf")
    if not intact:
        raise damage
    try:
        # an unknown key may come from a later version, in which the file has another meaning
        return convert_json(value, GdfHeader, closed=True), tensors
    except ValueError as error:
        raise contradiction_error(name, error) from error


def checksum(text: str, tensors: Mapping[str, Tensor]) -> str:
    """Return the SHA-256 of a header's text without its checksum, and of tensors."""
    digest = hashlib.sha256(text.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {list(tensor.shape)}\n".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def contradiction_error(name: str, error: Exception) -> ProgdfError:
    """Return the error for a file with inconsistent parts."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return ProgdfError(f"{name} is inconsistent ({reason}); train the edit again")


def _encode(header: GdfHeader) -> str:
    return msgspec.json.encode(header, enc_hook=_to_json).decode()


def _to_json(value: Any) -> str | float:
    return float(value) if isinstance(value, float) else os.fspath(value)


def pack_field(field: BakedField) -> tuple[FieldHeader, dict[str, Tensor]]:
    """Return the header and the tensors of a field, or of the network or grade that it was baked from."""
    header = FieldHeader(field.kind, field.channels, list(field.attributes), list(field.recorded))
    if field.origin is None:
        tensors = {"knots": field.knots}
        for name, bases in field.attributes.items():
            tensors |= {f"{name}.{part}": getattr(bases, part) for part in _BASES_TENSORS}
        return header, tensors
    form = field.origin
    if isinstance(form, GradeForm):
        tensors = {name: getattr(form, name) for name in _GRADE_TENSORS if name not in form.packed_levels}
        tensors |= {name + _PACKED_SUFFIX: levels for name, levels in form.packed_levels.items()}
        tensors["remap"] = torch.stack([form.remap.old, form.remap.new])
        return msgspec.structs.replace(header, attributes=[], grade=form.degree), tensors
    network = form.network
    plan = form.plan
    tensors = {_NETWORK_PREFIX + name: tensor for name, tensor in network.tensors.items()}
    tensors |= {"knots": plan.knots, "end": network.end}
    tensors |= {_END_CORRECTION_PREFIX + name: share for name, share in plan.end_correction.items()}
    if network.shape.code:
        tensors |= {"codes": network.codes, "code_step": network.code_step}
    part = NetworkHeader(network.shape, dict(plan.ranks), form.rows_sha256, dict(form.error or {}))
    return msgspec.structs.replace(header, network=part), tensors


def unpack_field(header: FieldHeader, tensors: Mapping[str, Tensor], members: int) -> BakedField:
    """Return the field of a header; the inverse of `pack_field`. Networks and grades are not baked yet.

    Args:
        header: header of the field
        tensors: tensors of the file
        members: number of the region's members, for the packed levels of a grade

    Raises:
        ValueError, KeyError, TypeError: the parts are inconsistent.
    """
    recorded = tuple(header.recorded)
    for name in header.attributes:
        if name not in ATTRIBUTES:
            raise ValueError(f"unknown attribute {name}")
    if header.grade is not None:
        old, new = tensors["remap"].double()
        parts = {name: tensors[name] for name in (*_GRADE_TENSORS, "mask") if name in tensors}
        bases, channels = tensors["scale"].shape
        levels = tensors.get("residual" + _PACKED_SUFFIX)  # since format 6
        if levels is not None:
            functions = tensors.get("functions" + _PACKED_SUFFIX)  # since format 7
            if functions is None:
                parts["residual"] = inflate(levels, (bases, channels, members), torch.int8).movedim(1, 2)
            else:
                parts["residual"] = unpack_levels(functions, levels, bases, members, channels)
        mask_levels = tensors.get("mask" + _PACKED_SUFFIX)
        if mask_levels is not None:
            parts["mask"] = inflate(mask_levels, (members,), torch.uint8)
        grade = GradeForm(header.grade, **parts, remap=SliderRemap(old, new))
        return BakedField("grade", torch.tensor([0.0, 1.0]), {}, header.channels, recorded, grade)
    if header.network is None:
        attributes = {
            name: AttributeBases(**{part: tensors[f"{name}.{part}"] for part in _BASES_TENSORS})
            for name in header.attributes
        }
        return BakedField(header.kind, tensors["knots"], attributes, header.channels, recorded)
    shape = header.network.shape
    end = tensors["end"]
    if shape.channels != header.channels:
        raise ValueError(f"the network has {shape.channels} channels, the field {header.channels}")
    network = NeuralField(
        shape,
        {
            name.removeprefix(_NETWORK_PREFIX): t
            for name, t in tensors.items()
            if name.startswith(_NETWORK_PREFIX)
        },
        end,
        tensors.get("codes", torch.zeros(len(end), 0, dtype=torch.int8)),
        tensors.get("code_step", torch.zeros(0)),
        recorded,
    )
    correction = {
        name.removeprefix(_END_CORRECTION_PREFIX): t
        for name, t in tensors.items()
        if name.startswith(_END_CORRECTION_PREFIX)
    }
    plan = BakePlan(tensors["knots"], header.network.ranks, correction)
    form = NeuralForm(network, plan, header.network.rows_sha256, header.network.bake_error)
    return BakedField("neural", torch.tensor([0.0, 1.0]), {}, header.channels, recorded, form)


def pack_added(added: Gaussians | None) -> dict[str, Tensor]:
    """Return the tensors of added rows by their names in the file."""
    if added is None:
        return {}
    return {_ADDED_PREFIX + name: getattr(added, name).float() for name in ATTRIBUTES}


def unpack_added(header: GdfHeader, tensors: Mapping[str, Tensor]) -> Gaussians | None:
    """Return the added rows, or None; the inverse of `pack_added`.

    Raises:
        ValueError, KeyError: the number of rows differs from the header, or they are not float32.
    """
    if not header.added:
        return None
    rows: dict[str, Any] = {name: tensors[_ADDED_PREFIX + name] for name in ATTRIBUTES}
    if any(values.dtype != torch.float32 for values in rows.values()):
        raise ValueError("an added row is not in float32")
    added = Gaussians(**rows, origin=header.added_origin)
    if len(added) != header.added:
        raise ValueError(f"the header has {header.added} added rows, the tensors {len(added)}")
    return added


def pack_anchors(anchors: Anchors | None) -> dict[str, Tensor]:
    """Return the tensors of anchors by their names in the file."""
    if anchors is None:
        return {}
    tensors = {"anchors.rows": anchors.rows.int(), "anchors.weights": anchors.weights}
    if anchors.rim is not None:
        tensors["anchors.rim"] = (anchors.rim * 255).round().to(torch.uint8)
    return tensors


def unpack_anchors(header: GdfHeader, tensors: Mapping[str, Tensor]) -> Anchors | None:
    """Return the anchors, or None; the inverse of `pack_anchors`.

    Raises:
        ValueError, KeyError: the tensors are no anchors of the added rows.
    """
    if not header.anchored:
        return None
    rows = tensors["anchors.rows"]
    check_tensor("anchors.rows", rows, (header.added, MAX_ANCHORS), torch.int32)
    rim = None
    if header.rim:
        check_tensor("anchors.rim", tensors["anchors.rim"], (header.added,), torch.uint8)
        rim = tensors["anchors.rim"].float() / 255
    pushes = header.pushes
    if isinstance(pushes, bool):
        pushes = sorted(PUSHED_SHAPE) if pushes else []
    unknown = set(pushes) - set(_KINDS)
    if unknown:
        raise ValueError(f"unknown kind of change {min(unknown)}")
    return Anchors(rows.long(), tensors["anchors.weights"], frozenset(pushes), rim, header.leaves_paint)


def pack_parts(motions: PartMotions | None) -> dict[str, Tensor]:
    """Return the tensor of the parts of moved members by its name in the file; a single part needs none."""
    if motions is None or len(motions.motions) < 2:
        return {}
    return {_PARTS: motions.parts.int()}


def unpack_motions(header: GdfHeader, tensors: Mapping[str, Tensor]) -> PartMotions | None:
    """Return the motions of the members, or None; the inverse of `pack_parts` and `motion_records`.

    Raises:
        ValueError, KeyError: there is no part for every member.
    """
    if not header.motions:
        return None
    parts = torch.zeros(header.members, dtype=torch.int32)
    if len(header.motions) > 1:
        parts = tensors[_PARTS]
        check_tensor(_PARTS, parts, (header.members,), torch.int32)
    return part_motions(header.motions, parts.long())


def is_before_anchors(header: GdfHeader) -> bool:
    """Return whether the file is of a format without anchors, although it adds rows."""
    return header.format < _ANCHORED_FORMAT and header.added > 0


def pack_region(region: Region) -> dict[str, Tensor]:
    """Return the tensors of a region: rows as bits, runs or indices, and the soft part of the score.

    The score is rounded to 1/255, and only stored where it differs from 1 (members) or 0 (all others).
    """
    members = region.members.cpu().numpy()
    count = len(region.score)
    levels = (region.score.cpu().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    crisp = np.zeros(count, np.uint8)
    crisp[members] = 255
    soft = np.flatnonzero(levels != crisp)
    tensors = _pack_rows("members", members, count)
    if len(soft):
        tensors |= _pack_rows("score", soft, count)
        tensors["score.levels"] = torch.from_numpy(levels[soft])
    return tensors


def unpack_region(
    name: str, tensors: Mapping[str, Tensor], count: int, expected: int | None = None
) -> Region:
    """Return the region of a file; the inverse of `pack_region`.

    Args:
        name: name of the region
        tensors: tensors of the file
        count: number of Gaussians in the scene
        expected: number of members; None if unknown

    Raises:
        ValueError, KeyError: the tensors do not describe rows of the scene.
    """
    members = _unpack_rows("members", tensors, count, expected)
    score = torch.zeros(count)
    score[members] = 1.0
    if "score.levels" in tensors:
        levels = tensors["score.levels"]
        soft = _unpack_rows("score", tensors, count, levels.numel())
        check_tensor("score.levels", levels, soft.shape, torch.uint8)
        score[soft] = levels.float() / 255
    return Region(name, members, score)


def _pack_rows(key: str, rows: np.ndarray, count: int) -> dict[str, Tensor]:
    """Store sorted unique rows below `count` in the shortest of three forms.

    The forms are `.bits` [⌈N/8⌉], `.runs` [R,2] (first row and length) and `.rows` [M].
    """
    breaks = np.flatnonzero(np.diff(rows) != 1) + 1
    starts = np.concatenate([rows[:1], rows[breaks]])
    ends = np.concatenate([rows[breaks - 1], rows[-1:]])
    sizes = {"runs": 8 * len(starts), "rows": 4 * len(rows), "bits": (count + 7) // 8}
    stored: np.ndarray
    shortest = min(sizes, key=lambda form: sizes[form])
    if shortest == "runs":
        stored = np.stack([starts, ends - starts + 1], axis=1).astype(np.int32)
    elif shortest == "rows":
        stored = rows.astype(np.int32)
    else:
        mask = np.zeros(count, np.bool_)
        mask[rows] = True
        stored = np.packbits(mask)
    return {f"{key}.{shortest}": torch.from_numpy(stored)}


def _unpack_rows(key: str, tensors: Mapping[str, Tensor], count: int, expected: int | None) -> Tensor:
    """Return the stored rows, sorted and unique. [M] int64

    The number of rows in runs is checked before they are expanded, as a run of 8 bytes can span millions.

    Raises:
        ValueError: rows are unsorted, repeated or outside the scene, or runs do not have `expected` rows.
    """
    if f"{key}.bits" in tensors:
        bits = tensors[f"{key}.bits"]
        check_tensor(f"{key}.bits", bits, ((count + 7) // 8,), torch.uint8)
        mask = np.unpackbits(bits.numpy())
        if mask[count:].any():
            raise ValueError(f"{key}.bits names rows beyond {count}")
        return torch.from_numpy(np.flatnonzero(mask[:count]).astype(np.int64))
    if f"{key}.runs" in tensors:
        runs = tensors[f"{key}.runs"]
        check_tensor(f"{key}.runs", runs, (None, 2), torch.int32)
        starts, lengths = runs.numpy().astype(np.int64).T
        ends = starts + lengths
        if len(runs) and (
            (lengths < 1).any() or starts[0] < 0 or ends[-1] > count or (starts[1:] < ends[:-1]).any()
        ):
            raise ValueError(f"{key}.runs leave the scene or overlap")
        if expected is not None and int(lengths.sum()) != expected:
            raise ValueError(f"{key}.runs name {int(lengths.sum())} rows of {expected}")
        before = np.repeat(np.cumsum(lengths) - lengths, lengths)
        return torch.from_numpy(np.repeat(starts, lengths) + np.arange(int(lengths.sum())) - before)
    rows = tensors[f"{key}.rows"]
    check_tensor(f"{key}.rows", rows, (None,), torch.int32)
    indices = rows.numpy().astype(np.int64)
    if len(indices) and (indices[0] < 0 or indices[-1] >= count or (np.diff(indices) <= 0).any()):
        raise ValueError(f"{key}.rows are not sorted rows of the scene")
    return torch.from_numpy(indices)
