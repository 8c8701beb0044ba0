"""What a .gdf file says of itself before its tensors are read: enough to list it and to refuse it.

A few kB at the file's beginning: the header and the table of tensors, with a SHA-256 of both. What the
tensors hold is checked when they are read (`file.load_gdf`), before anything of them is used.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from progdf.errors import ProgdfError
from progdf.field.neural import NeuralShape
from progdf.io.atomic import check_regular, open_error
from progdf.io.json_values import convert_json, decode_json
from progdf.io.tensors import METADATA

FORMAT = 1
"""The version of the file format."""

MOST_GAUSSIANS = 1 << 26
"""A header that claims a larger scene is not believed: the score would take gigabytes."""

_MOST_HEADER = (
    1 << 24
)  # bytes; a report takes a few kilobytes, a gigabyte could be made of a hundred megabytes
_Type = Literal["F64", "I64", "F32", "I32", "F16", "I16", "I8", "U8", "BOOL"]
_BYTES: Mapping[_Type, int] = {
    "F64": 8,
    "I64": 8,
    "F32": 4,
    "I32": 4,
    "F16": 2,
    "I16": 2,
    "I8": 1,
    "U8": 1,
    "BOOL": 1,
}


@dataclass(frozen=True)
class SceneFingerprint:
    """What binds a .gdf to its scene: number of Gaussians, SHA-256 of the world means (float32 bytes)."""

    count: int
    means_sha256: str


class NetworkTable(msgspec.Struct, frozen=True):
    """A network in a header: its layout, how many bases each attribute is baked to, and what that costs."""

    shape: NeuralShape
    ranks: dict[str, int]
    rows_sha256: str
    bake_error: dict[str, float]


class FieldTable(msgspec.Struct, frozen=True):
    """A field in a header, see `BakedField`; `network` where one is kept in its place."""

    kind: str
    channels: int
    attributes: list[str]
    recorded: list[float]
    network: NetworkTable | None = None


class _Header(msgspec.Struct, frozen=True):
    """The JSON header."""

    format: int
    name: str
    region: str
    instruction: str
    scene: SceneFingerprint
    field: FieldTable
    options: dict[str, Any]
    report: dict[str, Any]
    members: Annotated[int, msgspec.Meta(ge=0)]


class _Signed(msgspec.Struct, frozen=True):
    """The metadata: the JSON header as it is in the file, and the checksums."""

    header: msgspec.Raw
    header_sha256: str
    sha256: str


class _Tensor(msgspec.Struct, frozen=True):
    """A tensor in the table of a safetensors file."""

    dtype: _Type
    shape: Annotated[list[Annotated[int, msgspec.Meta(ge=0)]], msgspec.Meta(max_length=8)]
    data_offsets: tuple[int, int]

    def __post_init__(self) -> None:
        first, last = self.data_offsets
        if not 0 <= first <= last or last - first != math.prod(self.shape) * _BYTES[self.dtype]:
            raise ValueError(f"{self.dtype} {self.shape} does not take the bytes {first} to {last}")


@dataclass(frozen=True)
class GdfHead:
    """An edit without its numbers.

    Args:
        path, size: the file, and its bytes
        text: the JSON header as stored in the file
        sha256: of the whole: header and tensors
        tensors: shape and type of each, as safetensors calls it
        name, region, instruction: the layer's, the region's, and what was asked for
        members: Gaussians of the region
        scene: the scene it was made for
        field: kind, channels, attributes …, see `field_packing.pack_field`
        options, report: of the training, JSON values
    """

    path: Path
    size: int
    text: str
    sha256: str
    tensors: Mapping[str, tuple[tuple[int, ...], _Type]]
    name: str
    region: str
    instruction: str
    members: int
    scene: SceneFingerprint
    field: FieldTable
    options: Mapping[str, Any]
    report: Mapping[str, Any]

    @property
    def bytes_per_member(self) -> float:
        """Bytes of the field's numbers that grow with the members, for one; of a network, its share."""
        if self.field.network is not None:
            kept = [name for name in self.tensors if _of_network(name)]
        else:
            kept = [name for name in self.tensors if name.endswith((".full", ".rest"))]
        stored = sum(self.numbers(name) * _BYTES[self.tensors[name][1]] for name in kept)
        return stored / max(1, self.members)

    @property
    def parameters(self) -> int:
        """Learned numbers of a network, its codes included."""
        learned = ("network.control", "network.layers.", "network.heads.")
        return sum(self.numbers(name) for name in self.tensors if name.startswith(learned) or name == "codes")

    @property
    def knots(self) -> int:
        """At how many strengths the coefficients are given."""
        return self.numbers("nodes")

    def bases(self) -> dict[str, int]:
        """How many bases each attribute has, the full offset included."""
        if self.field.network is not None:
            return {name: 1 + rank for name, rank in self.field.network.ranks.items()}
        return {name: 1 + self.tensors[f"{name}.rest"][0][0] for name in self.field.attributes}

    def numbers(self, tensor: str) -> int:
        """How many numbers a tensor holds."""
        return math.prod(self.tensors[tensor][0])


def _of_network(tensor: str) -> bool:
    return tensor.startswith("network.") or tensor in ("end", "codes", "code_step")


def read_head(path: str | os.PathLike[str]) -> GdfHead:
    """Open a .gdf: read its header, and see that it and the file's length are what was saved.

    Raises:
        ProgdfError: it is no .gdf, from a newer version, truncated, or its header is damaged.
    """
    check_regular(path)
    try:
        with Path(path).open("rb") as file:
            start = file.read(9)
            size = int.from_bytes(start[:8], "little")
            length = os.fstat(file.fileno()).st_size
            name = Path(path).name
            if len(start) < 9 or not 2 <= size <= _MOST_HEADER or start[8:9] != b"{":
                raise ProgdfError(
                    f"{name} is not a .gdf file; give one that progdf train or progdf fit has written"
                )
            if 8 + size > length:
                raise ProgdfError(
                    f"{name} is truncated: {length} bytes are less than its header; copy it again"
                )
            header = start[8:] + file.read(size - 1)
    except OSError as error:
        raise open_error(path, error) from error
    return _head(Path(path), length, header)


def _head(path: Path, length: int, header: bytes) -> GdfHead:
    name = path.name
    try:
        outer = decode_json(header)
        metadata = (
            convert_json(outer.pop("__metadata__", {}), dict[str, str]) if isinstance(outer, dict) else {}
        )
        table = convert_json(outer, dict[str, _Tensor])
    except ValueError:
        raise damage_error(name) from None
    if METADATA not in metadata:
        raise ProgdfError(
            f"{name} is a safetensors file, but not a .gdf; give one that progdf train has written"
        )
    try:
        signed = msgspec.json.decode(metadata[METADATA], type=_Signed)
        text = bytes(signed.header).decode()
        content = decode_json(text)
        version = convert_json(content["format"], int)
    except (msgspec.MsgspecError, ValueError, KeyError, TypeError):
        raise damage_error(name) from None
    if version > FORMAT:
        raise ProgdfError(f"{name} has format {version}, this progdf reads format {FORMAT}; update progdf")
    needed = 8 + len(header) + max((tensor.data_offsets[1] for tensor in table.values()), default=0)
    if needed > length:
        raise ProgdfError(
            f"{name} is truncated: it has {length} of {needed} bytes; copy it again or make it again"
        )
    tensors = {key: (tuple(tensor.shape), tensor.dtype) for key, tensor in table.items()}
    if version < FORMAT or signed.header_sha256 != head_checksum(text, tensors):
        raise damage_error(name)
    try:
        found = convert_json(content, _Header)
        if found.field.network is not None:
            strange = set(content["field"]["network"]["shape"]) - {part.name for part in fields(NeuralShape)}
            if strange:  # of a later version, perhaps, which reads the network in another way
                raise ValueError(f"the network has an unknown {min(strange)}")
        _check(found, tensors)
    except ValueError as error:
        raise contradiction_error(name, error) from error
    return GdfHead(
        path=path,
        size=length,
        text=text,
        sha256=signed.sha256,
        tensors=tensors,
        name=found.name,
        region=found.region,
        instruction=found.instruction,
        members=found.members,
        scene=found.scene,
        field=found.field,
        options=found.options,
        report=found.report,
    )


def _check(header: _Header, tensors: Mapping[str, tuple[tuple[int, ...], _Type]]) -> None:
    """Whether the header fits the table of tensors, as far as they determine the file."""
    if not 0 <= header.scene.count <= MOST_GAUSSIANS:
        raise ValueError(f"a scene of {header.scene.count} Gaussians")
    sides = {"nodes": 1}
    if header.field.network is None:
        for name in header.field.attributes:
            sides |= {f"{name}.full": 2, f"{name}.rest": 3, f"{name}.step": 2, f"{name}.coefficients": 2}
    else:
        sides |= {"end": 2}
    for name, count in sides.items():
        if name not in tensors or len(tensors[name][0]) != count:
            raise ValueError(f"it has no tensor {name} of {count} sides")
    rows = {tensors[name][0][0] for name in sides if name.endswith((".full", "end"))}
    if any(count != header.members for count in rows) or header.members > header.scene.count:
        raise ValueError(
            f"the header has {header.members} members of {header.scene.count}, the tensors {sorted(rows)}"
        )


def head_checksum(text: str, tensors: Mapping[str, tuple[tuple[int, ...], str]]) -> str:
    """SHA-256 of the JSON header and of every tensor's name, type and shape."""
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass"))
    for name in sorted(tensors):
        shape, dtype = tensors[name]
        digest.update(f"\n{name} {dtype} {list(shape)}\n".encode("utf-8", "surrogatepass"))
    return digest.hexdigest()


def damage_error(name: str) -> ProgdfError:
    """The line for a file that is not what was saved."""
    return ProgdfError(f"{name} is damaged (checksum mismatch); copy it again or make it again")


def contradiction_error(name: str, error: Exception) -> ProgdfError:
    """The line for a file whose parts do not fit each other."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return ProgdfError(f"{name} is inconsistent ({reason}); make it again with progdf train")
