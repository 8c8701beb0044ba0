"""What a .gdf file says of itself before its tensors are read: enough to list it and to refuse it.

A few kB at the file's beginning: the header and the table of tensors, with a SHA-256 of both. What the
tensors hold is checked when they are read (`checkpoint.load_gdf`), before anything of them is used.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from progdf.errors import ProgdfError
from progdf.files import open_failure

FORMAT = 2
"""Newest version of the file format; those down to 1 are read. A file states the oldest that can hold it: 1,
or 2 where it keeps a network."""

MOST_GAUSSIANS = 1 << 28
"""A header that claims a larger scene is not believed: the score would take gigabytes."""

_MOST_HEADER = 100_000_000
_BYTES = {"F64": 8, "I64": 8, "F32": 4, "I32": 4, "F16": 2, "I16": 2, "I8": 1, "U8": 1, "BOOL": 1}


@dataclass(frozen=True)
class SceneFingerprint:
    """What binds a .gdf to its scene: number of Gaussians and SHA-256 of the means (float32 bytes)."""

    count: int
    means_sha256: str


@dataclass(frozen=True)
class GdfHead:
    """An edit without its numbers.

    Args:
        path, size: the file, and its bytes
        verified: the header is what was saved; of files from before it had a checksum of its own, that is
            not known until the whole is read
        text: the JSON header as it stands in the file
        sha256: of the whole: header and tensors
        tensors: shape and type of each, as safetensors calls it
        name, region, instruction: the layer's, the region's, and what was asked for
        members: Gaussians of the region; None where an old file does not say
        scene: the scene it was made for
        field: kind, channels, attributes …, as `field_packing.packed_field` describes it
        options, report: of the training, JSON values
    """

    path: Path
    size: int
    verified: bool
    text: str
    sha256: str
    tensors: Mapping[str, tuple[tuple[int, ...], str]]
    name: str
    region: str
    instruction: str
    members: int | None
    scene: SceneFingerprint
    field: Mapping[str, Any]
    options: Mapping[str, Any]
    report: Mapping[str, Any]

    @property
    def bytes_per_member(self) -> float:
        """Bytes of the field's numbers that grow with the members, for one; of a network, its share."""
        if "network" in self.field:
            kept = [name for name in self.tensors if _of_network(name)]
        else:
            kept = [name for name in self.tensors if name.endswith((".full", ".rest"))]
        stored = sum(self.numbers(name) * _BYTES[self.tensors[name][1]] for name in kept)
        return stored / max(1, self.members or 0)

    @property
    def parameters(self) -> int:
        """Learned numbers of a network, its codes included."""
        learned = ("network.control", "network.layers.", "network.heads.")
        return sum(self.numbers(name) for name in self.tensors if name.startswith(learned) or name == "codes")

    @property
    def nodes(self) -> int:
        """At how many strengths the coefficients are given."""
        return self.numbers("nodes")

    def bases(self) -> dict[str, int]:
        """How many bases each attribute has, the full offset included."""
        if "network" in self.field:
            return {str(name): 1 + int(rank) for name, rank in self.field["network"]["ranks"].items()}
        return {str(name): 1 + self.tensors[f"{name}.rest"][0][0] for name in self.field["attributes"]}

    def numbers(self, tensor: str) -> int:
        """How many numbers a tensor holds."""
        return math.prod(self.tensors[tensor][0])


def _of_network(tensor: str) -> bool:
    return tensor.startswith("network.") or tensor in ("end", "codes", "code_step")


def read_head(path: str | os.PathLike[str]) -> GdfHead:
    """Open a .gdf: read its header, and see that it and the file's length are what was saved.

    Raises:
        ProgdfError: it is no .gdf, from a newer version, cut short, or its header is damaged.
    """
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
                    f"{name} is cut short: {length} bytes are not even its header; copy it again"
                )
            header = start[8:] + file.read(size - 1)
    except OSError as error:
        raise open_failure(path, error) from error
    return _head(Path(path), length, header)


def _head(path: Path, length: int, header: bytes) -> GdfHead:
    name = path.name
    try:
        outer = json.loads(header)
        metadata = outer.pop("__metadata__", {})
        text = metadata.get("progdf")
        needed = 8 + len(header) + max((entry["data_offsets"][1] for entry in outer.values()), default=0)
        tensors = {
            str(key): (tuple(int(side) for side in entry["shape"]), str(entry["dtype"]))
            for key, entry in outer.items()
        }
    except (ValueError, AttributeError, KeyError, IndexError, TypeError, RecursionError, OverflowError):
        raise damaged(name) from None
    if not isinstance(text, str):
        raise ProgdfError(
            f"{name} is a safetensors file, but not a .gdf; give one that progdf train has written"
        )
    version = _version(text)
    if version is None:
        raise damaged(name)
    if version > FORMAT:
        raise ProgdfError(f"{name} has format {version}, this progdf reads up to {FORMAT}; update progdf")
    if isinstance(needed, int) and needed > length:
        raise ProgdfError(
            f"{name} is cut short: it has {length} of {needed} bytes; copy it again or make it again"
        )
    own = metadata.get("header_sha256")
    if own is not None and own != head_checksum(text, tensors):
        raise damaged(name)
    try:
        return _described(path, length, own is not None, text, str(metadata.get("sha256")), tensors)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise contradiction(name, error) from error


def _described(
    path: Path,
    length: int,
    verified: bool,
    text: str,
    sha256: str,
    tensors: Mapping[str, tuple[tuple[int, ...], str]],
) -> GdfHead:
    header = json.loads(text)
    scene = SceneFingerprint(int(header["scene"]["count"]), str(header["scene"]["means_sha256"]))
    if not 0 <= scene.count <= MOST_GAUSSIANS:
        raise ValueError(f"a scene of {scene.count} Gaussians")
    for name, (shape, dtype) in tensors.items():
        if dtype not in _BYTES or any(side < 0 for side in shape):
            raise ValueError(f"{name} is {dtype} {list(shape)}")
    members = header.get("members")
    return GdfHead(
        path=path,
        size=length,
        verified=verified,
        text=text,
        sha256=sha256,
        tensors=tensors,
        name=str(header["name"]),
        region=str(header["region"]),
        instruction=str(header["instruction"]),
        members=None if members is None else int(members),
        scene=scene,
        field=dict(header["field"]),
        options=dict(header["options"]),
        report=dict(header["report"]),
    )


def head_checksum(text: str, tensors: Mapping[str, tuple[tuple[int, ...], str]]) -> str:
    """SHA-256 of the JSON header and of every tensor's name, type and shape."""
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass"))
    for name in sorted(tensors):
        shape, dtype = tensors[name]
        digest.update(f"\n{name} {dtype} {list(shape)}\n".encode("utf-8", "surrogatepass"))
    return digest.hexdigest()


def damaged(name: str) -> ProgdfError:
    """The line for a file that is not what was saved."""
    return ProgdfError(f"{name} is damaged: its checksum does not fit; copy it again or make it again")


def contradiction(name: str, error: Exception) -> ProgdfError:
    """The line for a file whose parts do not fit each other."""
    reason = " ".join(str(error).split()) or type(error).__name__
    return ProgdfError(f"{name} does not hold together ({reason}); make it again with progdf train")


def _version(text: str) -> int | None:
    """The format a header states; None where it states none."""
    try:
        version = json.loads(text)["format"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return version if isinstance(version, int) and version >= 1 else None
