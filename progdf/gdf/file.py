"""The .gdf file: one region's edit, bound to its scene. The only contract of trainer and viewer.

On disk it is a safetensors file whose metadata hold one JSON header, `progdf`, a SHA-256 of that header and
of every tensor's name, type and shape, and another of these and of every tensor's bytes. So a file is opened
by its header alone, and its numbers are checked when they are read. Nothing in it is ever executed, and a
file that is not exactly what was saved is refused with one line.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from typing import Any

import msgspec
import safetensors
import safetensors.torch
import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from progdf.errors import ProgdfError
from progdf.field.bake import rows_hash
from progdf.field.baked import BakedField
from progdf.gaussians import BASE_CHANNELS, ZERO, Gaussians, Origin, pack
from progdf.io.atomic import atomic_write, read_file
from progdf.io.tensors import table_of, write_tensors
from progdf.region import Region

from .field_packing import pack_field, unpack_field
from .header import (
    FORMAT,
    GdfHead,
    SceneFingerprint,
    contradiction_error,
    damage_error,
    head_checksum,
    read_head,
)
from .region_packing import pack_region, unpack_region

_FINGERPRINTS: MutableMapping[Tensor, tuple[tuple[int, Origin] | None, str]] = WeakIdKeyDictionary()
"""Version, origin and hash of the centers of scenes that are alive."""
_FAR = 1e18
"""An offset that is larger is absurd, as a position is (see `progdf.formats.repair`)."""
_FARTHEST = {"log_scales": 80.0}
"""Where it is another number: e^80 fits into float32, with a scale of any scene too."""


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
    """What a .gdf of this scene must carry; hashed once while the means are the same, unwritten tensor.

    The means are those of the world, so the hash does not depend on the origin that loading has chosen.
    """
    means = scene.means
    state = None if means.is_inference() else (means._version, scene.origin)
    known_state, sha256 = _FINGERPRINTS.get(means, (None, ""))
    if state is None or state != known_state:
        world = means.detach() if scene.origin == ZERO else scene.world_means
        content = world.to("cpu", torch.float32).contiguous().numpy().tobytes()
        sha256 = hashlib.sha256(content).hexdigest()
        _FINGERPRINTS[means] = state, sha256
    return SceneFingerprint(len(scene), sha256)


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
    _verify(gdf.scene, scene, gdf_name or gdf.name, scene_name)
    _verify_channels(gdf, scene, gdf_name or gdf.name, scene_name)


def _verify_channels(gdf: Gdf, scene: Gaussians, name: str, scene_name: str) -> None:
    channels = BASE_CHANNELS + 3 * scene.shN.shape[1]
    if gdf.field.channels not in (BASE_CHANNELS, channels):
        raise ProgdfError(
            f"{name} was made for another scene: {scene_name} has SH degree {scene.sh_degree}, "
            "the edit another"
        )


def _verify(made_for: SceneFingerprint, scene: Gaussians, name: str, scene_name: str) -> None:
    other = f"{name} was made for another scene"
    carry = (
        f"if it is the same in another format, progdf rebind {name} --from SCENE --to {scene_name} -o NEW.gdf"
    )
    if made_for.count != len(scene):
        counts = f"it has {_grouped(made_for.count)} Gaussians, {scene_name} has {_grouped(len(scene))}"
        raise ProgdfError(f"{other}: {counts}; {carry}")
    if made_for.means_sha256 != fingerprint(scene).means_sha256:
        raise ProgdfError(f"{other}: {scene_name} has as many Gaussians, but at other places; {carry}")


def save_gdf(path: str | os.PathLike[str], gdf: Gdf) -> None:
    """Write an edit, whole or not at all.

    Raises:
        ProgdfError: the place cannot be written.
        ValueError: a number of the field is not finite, or options or report hold something JSON cannot.
    """
    tensors, described = pack_field(gdf.field)
    tensors |= pack_region(gdf.region)
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} of {gdf.name} has a number that is not finite")
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    header = json.dumps(
        {
            "format": FORMAT,
            "name": gdf.name,
            "instruction": gdf.instruction,
            "scene": {"count": gdf.scene.count, "means_sha256": gdf.scene.means_sha256},
            "region": gdf.region.name,
            "members": len(gdf.region),
            "field": described,
            "options": _to_json(gdf.options),
            "report": _to_json(gdf.report),
        },
        ensure_ascii=False,
        allow_nan=False,
    )
    try:
        with atomic_write(path) as temporary_file:
            write_tensors(temporary_file, tensors, file_metadata(header, tensors))
    except OSError as error:
        raise ProgdfError(
            f"{path} cannot be written ({error.strerror or error}); choose another place"
        ) from error


def file_metadata(header: str, tensors: Mapping[str, Tensor]) -> dict[str, str | msgspec.Raw]:
    """The metadata of a .gdf file with this JSON header and these tensors: the header, and both checksums."""
    return {
        "header": msgspec.Raw(header.encode()),
        "header_sha256": head_checksum(header, table_of(tensors)),
        "sha256": _checksum(header, tensors),
    }


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
    head = read_head(path)
    name = head.path.name
    if scene is not None:
        _verify(head.scene, scene, name, scene_name)
    gdf = _read(head)
    if scene is not None:
        _verify_channels(gdf, scene, name, scene_name)
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
        baked = gdf.field.origin.bake(rows)
        _check_reach(baked)
        return replace(gdf, field=baked)
    except (ValueError, RuntimeError) as error:
        raise contradiction_error(name, error) from error


def _read(head: GdfHead) -> Gdf:
    """The whole edit, every byte checked; a network stays as it is and moves nothing."""
    content = read_file(head.path)
    try:
        tensors: dict[str, Tensor] = safetensors.torch.load(content)
    except (safetensors.SafetensorError, ValueError, KeyError, RuntimeError, OverflowError):
        raise damage_error(head.path.name) from None
    if _checksum(head.text, tensors) != head.sha256:
        raise damage_error(head.path.name)
    try:
        return _assemble(head, tensors)
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise contradiction_error(head.path.name, error) from error


def _assemble(head: GdfHead, tensors: dict[str, Tensor]) -> Gdf:
    for name, tensor in tensors.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ValueError(f"{name} has a number that is not finite")
    field, form = unpack_field(head.field, tensors)
    region = unpack_region(head.region, tensors, head.scene.count, head.members)
    _check_reach(field)
    if head.members != len(region):
        raise ValueError(f"the header has {head.members} members, the region {len(region)}")
    if form is not None and form.network.members != len(region):
        raise ValueError(f"the network has {form.network.members} members, the region {len(region)}")
    return Gdf(
        name=head.name,
        region=region,
        field=field,
        scene=head.scene,
        instruction=head.instruction,
        options=head.options,
        report=head.report,
    )


def _check_reach(field: BakedField) -> None:
    """Raises ValueError where an offset, whatever the strength, is beyond any scene: sums would overflow."""
    for name, bases in field.attributes.items():
        most = bases.coefficients.abs().amax(0).double()
        reach = float(most[0]) * float(bases.end_offset.abs().max() if bases.end_offset.numel() else 0.0)
        if bases.residual_basis.numel():
            peaks = bases.residual_basis.abs().amax(1).double() * bases.scale.abs().double()
            reach += float(most[1:] @ peaks.amax(1))
        if not reach < _FARTHEST.get(name, _FAR):
            raise ValueError(f"{name} moves by up to {reach:.3g}, farther than any scene reaches")


def _checksum(header: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(header.encode("utf-8", "surrogatepass"))
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"\n{name} {tensor.dtype} {list(tensor.shape)}\n".encode("utf-8", "surrogatepass"))
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _to_json(value: Any) -> Any:
    """The same as JSON knows it: tuples become lists, paths text, numbers that are not finite null."""
    if isinstance(value, Mapping):
        return {str(key): _to_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_to_json(entry) for entry in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (str, int, float, bool)):
        return value
    raise ValueError(f"{type(value).__name__} {value!r} cannot be written as JSON")


def _grouped(count: int) -> str:
    return f"{count:,}".replace(",", " ")
