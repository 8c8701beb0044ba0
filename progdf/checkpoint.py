"""The .gdf file: one region's edit, bound to its scene. The only contract of trainer and viewer.

On disk it is a safetensors file whose metadata hold one JSON header, `progdf`, and a SHA-256 of that header
and of every tensor's name, type, shape and bytes. Nothing in it is ever executed, and a file that is not
exactly what was saved is refused with one line.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from progdf.errors import ProgdfError
from progdf.field.bake import rows_hash
from progdf.field.baked import BakedField
from progdf.field_packing import packed_field, unpacked_field
from progdf.files import open_failure, written_whole
from progdf.gaussians import BASE_CHANNELS, Gaussians, pack
from progdf.region import Region
from progdf.region_packing import packed_region, unpacked_region
from progdf.tensor_file import write_tensors

FORMAT = 2
"""Newest version of the file format; those down to 1 are read. A file states the oldest that can hold it: 1,
or 2 where it keeps a network."""

MOST_GAUSSIANS = 1 << 28
"""A header that claims a larger scene is not believed: the score would take gigabytes."""


@dataclass(frozen=True)
class SceneFingerprint:
    """What binds a .gdf to its scene: number of Gaussians and SHA-256 of the means (float32 bytes)."""

    count: int
    means_sha256: str


@dataclass(frozen=True)
class Gdf:
    """One region's edit.

    Args:
        name: the layer's name, e.g. "shirt"
        region: members and soft score
        field: the baked field of those members
        scene: the scene it was made for
        instruction: what was asked for, e.g. "recolor:#3060d0"
        options: the training options, JSON values
        report: the run's error report, JSON values (see report.json in the run folder)

    Raises:
        ValueError: region, field and scene differ in their numbers of Gaussians.
    """

    name: str
    region: Region
    field: BakedField
    scene: SceneFingerprint
    instruction: str = ""
    options: Mapping[str, Any] = default(default_factory=dict)
    report: Mapping[str, Any] = default(default_factory=dict)

    def __post_init__(self) -> None:
        if self.field.attributes and self.field.members != len(self.region):
            raise ValueError(f"the field has {self.field.members} members, the region {len(self.region)}")
        if len(self.region.score) != self.scene.count:
            raise ValueError(
                f"the region's score has {len(self.region.score)} rows, the scene {self.scene.count}"
            )


def fingerprint(scene: Gaussians) -> SceneFingerprint:
    """What a .gdf of this scene must carry."""
    means = scene.means.detach().to("cpu", torch.float32).contiguous()
    return SceneFingerprint(len(scene), hashlib.sha256(means.numpy().tobytes()).hexdigest())


def verify(gdf: Gdf, scene: Gaussians, gdf_name: str = "", scene_name: str = "the scene") -> None:
    """Make sure that an edit belongs to a scene.

    Args:
        gdf: the edit
        scene: the scene
        gdf_name: what to call the edit in the message; its layer name when empty
        scene_name: what to call the scene in the message

    Raises:
        ProgdfError: it was made for another scene.
    """
    name = gdf_name or gdf.name
    other = f"{name} was made for another scene"
    if gdf.scene.count != len(scene):
        raise ProgdfError(
            f"{other}: it has {_grouped(gdf.scene.count)} Gaussians, {scene_name} has {_grouped(len(scene))}"
        )
    if gdf.scene.means_sha256 != fingerprint(scene).means_sha256:
        raise ProgdfError(f"{other}: {scene_name} has as many Gaussians, but at other places")
    channels = BASE_CHANNELS + 3 * scene.shN.shape[1]
    if gdf.field.channels not in (BASE_CHANNELS, channels):
        raise ProgdfError(f"{other}: {scene_name} has SH degree {scene.sh_degree}, the edit another")


def save_gdf(path: str | os.PathLike[str], gdf: Gdf) -> None:
    """Write an edit, whole or not at all.

    Raises:
        ProgdfError: the place cannot be written.
        ValueError: a number of the field is not finite, or options or report hold something JSON cannot.
    """
    tensors, described = packed_field(gdf.field)
    tensors |= packed_region(gdf.region)
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} of {gdf.name} has a number that is not finite")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = json.dumps(
        {
            "format": 1 if gdf.field.origin is None else 2,
            "name": gdf.name,
            "instruction": gdf.instruction,
            "scene": {"count": gdf.scene.count, "means_sha256": gdf.scene.means_sha256},
            "region": gdf.region.name,
            "field": described,
            "options": _plain(gdf.options),
            "report": _plain(gdf.report),
        },
        ensure_ascii=False,
        allow_nan=False,
    )
    metadata = {"progdf": header, "sha256": _checksum(header, tensors)}
    try:
        with written_whole(path) as beside:
            write_tensors(beside, tensors, metadata)
    except OSError as error:
        raise ProgdfError(
            f"{path} cannot be written ({error.strerror or error}); choose another place"
        ) from error


def load_gdf(
    path: str | os.PathLike[str], scene: Gaussians | None = None, scene_name: str = "the scene"
) -> Gdf:
    """Read an edit. A network is baked here, for which the scene is needed.

    Args:
        path: a .gdf file
        scene: when given, the edit must belong to it
        scene_name: what to call the scene in the message

    Raises:
        ProgdfError: it is no .gdf, from a newer version, damaged, or made for another scene; or it keeps a
            network and no scene is given.
    """
    name = Path(path).name
    gdf = peek_gdf(path)
    if scene is not None:
        verify(gdf, scene, name, scene_name)
    if gdf.field.origin is None:
        return gdf
    if scene is None:
        raise ProgdfError(f"{name} keeps a neural field, which is baked on its scene; load it with the scene")
    rows = pack(scene[gdf.region.members])
    if gdf.field.origin.rows_sha256 not in ("", rows_hash(rows)):
        raise ProgdfError(
            f"{name} was made for another scene: {scene_name} has its Gaussians, but they look different"
        )
    try:
        return replace(gdf, field=gdf.field.origin.baked(rows))
    except (ValueError, RuntimeError) as error:
        raise _contradiction(name, error) from error


def peek_gdf(path: str | os.PathLike[str]) -> Gdf:
    """What a file holds, to be told and not to be run: a network stays as it is and moves nothing.

    Raises:
        ProgdfError: see `load_gdf`.
    """
    name = Path(path).name
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise open_failure(path, error) from error
    header, tensors = _parsed(name, content)
    try:
        return _assembled(json.loads(header), tensors)
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise _contradiction(name, error) from error


def _contradiction(name: str, error: Exception) -> ProgdfError:
    reason = " ".join(str(error).split()) or type(error).__name__
    return ProgdfError(f"{name} does not hold together ({reason}); make it again with progdf train")


def _parsed(name: str, content: bytes) -> tuple[str, dict[str, Tensor]]:
    """The JSON header and the tensors of a file that is what was saved."""
    damaged = ProgdfError(f"{name} is damaged: its checksum does not fit; copy it again or make it again")
    size = int.from_bytes(content[:8], "little")
    if len(content) < 8 or not 2 <= size <= 100_000_000 or content[8:9] != b"{":
        raise ProgdfError(f"{name} is not a .gdf file; give one that progdf train or progdf fit has written")
    if 8 + size > len(content):
        raise ProgdfError(f"{name} is cut short: {len(content)} bytes are not even its header; copy it again")
    try:
        outer = json.loads(content[8 : 8 + size])
        metadata = outer.get("__metadata__", {})
        header = metadata.get("progdf")
        ends = [entry["data_offsets"][1] for key, entry in outer.items() if key != "__metadata__"]
        needed = 8 + size + max(ends, default=0)
    except (ValueError, AttributeError, KeyError, IndexError, TypeError, RecursionError):
        raise damaged from None
    if not isinstance(header, str):
        raise ProgdfError(
            f"{name} is a safetensors file, but not a .gdf; give one that progdf train has written"
        )
    version = _version(header)
    if version is None:
        raise damaged
    if version > FORMAT:
        raise ProgdfError(f"{name} has format {version}, this progdf reads up to {FORMAT}; update progdf")
    if isinstance(needed, int) and needed > len(content):
        raise ProgdfError(
            f"{name} is cut short: it has {len(content)} of {needed} bytes; copy it again or make it again"
        )
    try:
        tensors: dict[str, Tensor] = safetensors.torch.load(content)
    except (safetensors.SafetensorError, ValueError, KeyError, RuntimeError, OverflowError):
        raise damaged from None
    if _checksum(header, tensors) != metadata.get("sha256"):
        raise damaged
    return header, tensors


def _version(header: str) -> int | None:
    """The format a header states; None where it states none."""
    try:
        version = json.loads(header)["format"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return version if isinstance(version, int) and version >= 1 else None


def _assembled(header: dict[str, Any], tensors: dict[str, Tensor]) -> Gdf:
    scene = SceneFingerprint(int(header["scene"]["count"]), str(header["scene"]["means_sha256"]))
    if not 0 <= scene.count <= MOST_GAUSSIANS:
        raise ValueError(f"a scene of {scene.count} Gaussians")
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} has a number that is not finite")
    field, form = unpacked_field(header["field"], tensors)
    region = unpacked_region(str(header["region"]), tensors, scene.count)
    if form is not None and form.network.members != len(region):
        raise ValueError(f"the network has {form.network.members} members, the region {len(region)}")
    return Gdf(
        name=str(header["name"]),
        region=region,
        field=field,
        scene=scene,
        instruction=str(header["instruction"]),
        options=dict(header["options"]),
        report=dict(header["report"]),
    )


def _checksum(header: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(header.encode("utf-8", "surrogatepass"))
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {list(tensor.shape)}\n".encode("utf-8", "surrogatepass"))
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    """The same as JSON knows it: tuples become lists, paths text, numbers that are not finite null."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    raise ValueError(f"{type(value).__name__} {value!r} cannot be written as JSON")


def _grouped(count: int) -> str:
    return f"{count:,}".replace(",", " ")
