"""The .gdf file: one region's edit, bound to its scene. The only interface between trainer and viewer."""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass, replace
from dataclasses import field as default
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from progdf.errors import ProgdfError, check_first_argument
from progdf.field.bake import bake_form, rows_hash
from progdf.field.baked import BakedField, GradeForm, NeuralForm
from progdf.field.grade import bake_grade, lattice_form, map_alone
from progdf.formats.cube import SUFFIX as CUBE
from progdf.formats.cube import read_cube
from progdf.gaussians import ATTRIBUTES, BASE_CHANNELS, ZERO, Gaussians, Origin, pack
from progdf.io.atomic import read_file, write_error, write_file
from progdf.region import Region, whole_scene

from . import header
from .anchors import NOTHING, PUSHED_SHAPE, Anchors, choose_anchors, join_free
from .header import SceneFingerprint
from .motions import PartMotions, motion_records

_FINGERPRINTS: MutableMapping[Tensor, tuple[tuple[int, Origin] | None, str]] = WeakIdKeyDictionary()
"""Cache: means tensor → its version and the scene's origin, and the hash. Entries end with their tensor."""
ANY_SCENE = SceneFingerprint(0, "")
"""Fingerprint of a grade that is bound to no scene."""
_MAX_OFFSET = 1e18
"""Largest offset of an attribute, like the largest position (see `progdf.formats.repair`)."""
_MAX_OFFSETS = {"log_scales": 80.0}
"""Largest offset of attributes with another limit. e^80 fits into float32, also times any scene's scale."""

_SURFACE = ("means", "log_scales", "quats", "logit_opacities")  # attributes that decide on the anchors
UNSEEN_LOGIT = -math.log(254.0)
"""Opacity logit of 1/255. Renderers skip Gaussians below it."""
ADDED_LOGIT = -6.0
"""Opacity logit of added rows at strength 0."""


@dataclass(frozen=True)
class Gdf:
    """Edit of one region.

    Raises:
        ValueError: the counts of Gaussians in region, field and scene do not match.
    """

    name: str  # name of the layer, e.g. "shirt"
    region: Region
    field: BakedField  # offsets of the region's members, followed by the added rows
    scene: SceneFingerprint  # the scene it was made for
    instruction: str = ""  # instruction to the editor, e.g. "recolor:#3060d0"
    options: Mapping[str, Any] = default(default_factory=dict)  # training options, JSON values
    report: Mapping[str, Any] = default(default_factory=dict)  # errors of the run, see report.json
    applied: bool = False  # True for the map of a grade that `apply_grade` put on a region
    # B Gaussians that the scene does not have, at strength 0, where they are invisible; they are the last B
    # members of the field, see `progdf.compose.added`
    added: Gaussians | None = None
    anchors: Anchors | None = None  # rows of the scene on which the added rows lie; None: they follow nothing
    anchors_found: bool = False  # the anchors were chosen on load, as the file's format has none
    adds: bool = False  # its changes add to those of lower layers and never hide them, as a pull's do
    from_others: int = 0  # number of members, the last ones, that other edits add; see `extend`
    # motions of the region's members, by which the edit carries other layers; None: it carries none
    motions: PartMotions | None = None

    def __post_init__(self) -> None:
        if (self.field.attributes or self.added is not None) and self.field.members != self.members:
            raise ValueError(
                f"the field has {self.field.members} members, the region {len(self.region)}"
                + (f" and {self.members - len(self.region)} rows are added" if self.added is not None else "")
            )
        if self.added is not None:
            _check_added(self.added)
        if self.anchors is not None:
            self._check_anchors(self.anchors)
        if len(self.region.score) != self.scene.count:
            raise ValueError(
                f"the region's score has {len(self.region.score)} rows, the scene {self.scene.count}"
            )

    def _check_anchors(self, anchors: Anchors) -> None:
        """Raise ValueError if the anchors do not fit the added rows or the scene."""
        if self.added is not None and len(anchors) != len(self.added):
            raise ValueError(f"{len(anchors)} added rows have anchors, {len(self.added)} are added")
        if len(anchors) > self.members:
            raise ValueError(f"{len(anchors)} rows have anchors, the edit has {self.members} members")
        if len(anchors) and int(anchors.rows.max()) >= self.scene.count:
            raise ValueError(
                f"row {int(anchors.rows.max())} is an anchor, the scene has {self.scene.count} rows"
            )

    @property
    def members(self) -> int:
        """Number of members of the field: the region's members and the added rows."""
        return len(self.region) + (0 if self.added is None else len(self.added))

    @property
    def paints(self) -> bool:
        """True if the edit adds discs of paint, for which the scene's Gaussians make way."""
        return self.anchors is not None and bool(self.anchors.pushes) and len(self.anchors) > 0


def _check_added(added: Gaussians) -> None:
    """Raise ValueError if an added row is visible at strength 0, or has numbers beyond the limits."""
    if not bool((added.logit_opacities < UNSEEN_LOGIT).all()):
        raise ValueError("an added row is visible at strength 0")
    for name in ATTRIBUTES:
        values = getattr(added, name)
        if values.numel() and not float(values.abs().max()) < _MAX_OFFSETS.get(name, _MAX_OFFSET):
            raise ValueError(f"{name} of an added row is beyond any scene")


def fingerprint(scene: Gaussians) -> SceneFingerprint:
    """Return the fingerprint of a scene, which binds a .gdf to it.

    It is cached while the means tensor is not modified. It hashes world means, so it does not depend on the
    origin that was chosen when loading.
    """
    means = scene.means
    state = None if means.is_inference() else (means._version, scene.origin)
    known_state, sha256 = _FINGERPRINTS.get(means, (None, ""))
    if state is None or state != known_state:
        world = means.detach() if scene.origin == ZERO else scene.world_means
        content = world.to("cpu", torch.float32).contiguous().numpy().data
        sha256 = hashlib.sha256(content).hexdigest()
        _FINGERPRINTS[means] = state, sha256
    return SceneFingerprint(len(scene), sha256)


def verify(gdf: Gdf, scene: Gaussians, gdf_name: str = "", scene_name: str = "the scene") -> None:
    """Check that an edit belongs to a scene.

    Args:
        gdf: the edit
        scene: the scene
        gdf_name: name of the edit in the message; empty for its layer name
        scene_name: name of the scene in the message

    Raises:
        ProgdfError: the edit was made for another scene.
    """
    other = f"{gdf_name or gdf.name} was made for another scene"
    rebind = (
        f"if it is the same in another format, progdf rebind {gdf_name or gdf.name} --from SCENE "
        f"--to {scene_name} -o NEW.gdf"
    )
    count, scene_count = (f"{n:,}".replace(",", " ") for n in (gdf.scene.count, len(scene)))
    if isinstance(gdf.field.origin, GradeForm):
        rebind = (
            f"its grade can be applied to any scene with --region {gdf.name}=all, or another region; {rebind}"
        )
    if gdf.scene.count != len(scene):
        counts = f"it has {count} Gaussians, {scene_name} has {scene_count}"
        raise ProgdfError(f"{other}: {counts}; {rebind}")
    if gdf.scene.means_sha256 != fingerprint(scene).means_sha256:
        raise ProgdfError(f"{other}: {scene_name} has as many Gaussians, but at other positions; {rebind}")
    if gdf.field.channels not in (BASE_CHANNELS, BASE_CHANNELS + 3 * scene.shN.shape[1]):
        raise ProgdfError(f"{other}: {scene_name} has SH degree {scene.sh_degree}, unlike the edit")


def save_gdf(path: str | os.PathLike[str], gdf: Gdf) -> None:
    """Write an edit, complete or not at all.

    Raises:
        ProgdfError: the file cannot be written.
        ValueError: a number of the field is not finite, or an offset exceeds the limit of `check_reach`.
        TypeError: options or report contain a value that JSON cannot store.
    """
    check_first_argument("save_gdf(path, gdf)", path, (str, os.PathLike))
    field, tensors = header.pack_field(gdf.field)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    tensors |= header.pack_region(gdf.region) | header.pack_added(gdf.added)
    tensors |= header.pack_anchors(gdf.anchors) | header.pack_parts(gdf.motions)
    broken = _find_non_finite(tensors)
    if broken:
        raise ValueError(f"{broken} of {gdf.name} has a number that is not finite")
    check_reach(gdf.field)
    head = header.GdfHeader(
        name=gdf.name,
        instruction=gdf.instruction,
        scene=gdf.scene,
        region=gdf.region.name,
        members=len(gdf.region),
        field=field,
        options=dict(gdf.options),
        report=dict(gdf.report),
        added=gdf.members - len(gdf.region),
        added_origin=ZERO if gdf.added is None else gdf.added.origin,
        anchored=gdf.anchors is not None,
        pushes=[] if gdf.anchors is None else sorted(gdf.anchors.pushes),
        rim=gdf.anchors is not None and gdf.anchors.rim is not None,
        leaves_paint=gdf.anchors is not None and gdf.anchors.leaves_paint,
        adds=gdf.adds,
        motions=[] if gdf.motions is None else motion_records(gdf.motions),
    )
    content = header.pack_file(head, tensors)
    try:
        write_file(path, content)
    except OSError as error:
        raise write_error(path, error) from error


def load_gdf(
    path: str | os.PathLike[str],
    scene: Gaussians | None = None,
    scene_name: str = "the scene",
    place: Callable[[Gdf], Region | None] = lambda stored: None,
) -> Gdf:
    """Load an edit, and bake it if the file stores a network or a grade. Baking needs the scene.

    Args:
        path: a .gdf file, or a .cube file, which is a grade bound to no scene
        scene: the scene that the edit must belong to; None to skip the check
        scene_name: name of the scene in messages
        place: function from the stored edit to the region that a grade is applied to; a result of None means
            the trained region, or the whole scene for a .cube file

    Raises:
        ProgdfError: see `read_gdf` and `apply_grade`; or the edit was made for another scene, or must be
            baked and no scene is given.
    """
    check_first_argument("load_gdf(path, scene)", path, (str, os.PathLike))
    gdf = read_gdf(path)
    name = Path(path).name
    if scene is not None:
        region = place(gdf)
        if region is not None or gdf.scene == ANY_SCENE:
            return apply_grade(gdf, scene, whole_scene(scene) if region is None else region)
        verify(gdf, scene, name, scene_name)
        if gdf.anchors_found:
            pushes = NOTHING if gdf.report.get("paint") is None else PUSHED_SHAPE
            gdf = replace(anchor_added(gdf, scene, pushes), anchors_found=True)
    form = gdf.field.origin
    if form is None:
        return gdf
    if scene is None:
        kind = gdf.field.kind
        raise ProgdfError(f"{name} keeps a {kind} field, which is baked on its scene; load it with the scene")
    rows = pack(scene[gdf.region.members], with_shN=scene.sh_degree > 0)
    if isinstance(form, NeuralForm) and form.rows_sha256 not in ("", rows_hash(rows)):
        raise ProgdfError(
            f"{name} was made for another scene: {scene_name} has its positions, but other attributes"
        )
    try:
        baked = bake_grade(form, rows) if isinstance(form, GradeForm) else bake_form(form, rows)
        check_reach(baked)
        return replace(gdf, field=replace(baked, recorded=gdf.field.recorded))
    except (ValueError, RuntimeError) as error:
        raise header.contradiction_error(name, error) from error


def anchor_added(gdf: Gdf, scene: Gaussians, pushes: frozenset[str] = NOTHING, free: int = 0) -> Gdf:
    """Return the edit with its added rows anchored to the scene's surface, see `progdf.gdf.anchors`.

    Args:
        gdf: an edit of the scene that adds rows; any other is returned unchanged
        scene: the original
        pushes: see `Anchors.pushes`
        free: number of added rows, the last ones, that follow nothing, such as copies
    """
    added = gdf.added
    if added is None:
        return gdf
    members = len(gdf.region)
    parts: dict[str, Any] = {}
    offsets = {name: bases.end for name, bases in gdf.field.attributes.items() if name in _SURFACE}
    for name, change in offsets.items():
        old: Tensor = getattr(scene, name).float()
        new = old[gdf.region.members] + change[:members].reshape(-1, *old.shape[1:])
        parts[name] = old.index_copy(0, gdf.region.members, new)
    to_scene = torch.tensor(added.origin, dtype=torch.float64) - torch.tensor(
        scene.origin, dtype=torch.float64
    )
    means = (added.means.double() + to_scene).float()
    if "means" in offsets:
        means = means + offsets["means"][members:]
    end = replace(scene, **parts) if parts else scene
    chosen = choose_anchors(end, means[: len(means) - free], UNSEEN_LOGIT, pushes)
    return replace(gdf, anchors=join_free(chosen, free), anchors_found=False)


def apply_grade(gdf: Gdf, scene: Gaussians, region: Region) -> Gdf:
    """Apply the color map of a grade to a region of any scene.

    The grade's mask, residual and report are left out, as they belong to the scene it was trained on.

    Raises:
        ProgdfError: the edit is not a grade, its color offsets exceed the limits, or the region is empty.
    """
    stored = gdf.field.origin
    if not isinstance(stored, GradeForm):
        raise ProgdfError(f"{gdf.name} is not a grade: its field is {gdf.field.kind}; give a grade")
    if not len(region):
        raise ProgdfError(f"the region for {gdf.name} has no Gaussians; give another")
    rows = pack(scene[region.members], with_shN=scene.sh_degree > 0)
    field = replace(bake_grade(map_alone(stored, len(region)), rows), recorded=())
    try:
        check_reach(field)
    except ValueError as error:
        raise header.contradiction_error(gdf.name, error) from error
    parts = {"mask": stored.mask is not None, "residual": len(stored.residual) > 0}
    report = {"left_out": " and ".join(name for name, there in parts.items() if there)}
    return Gdf(gdf.name, region, field, fingerprint(scene), gdf.instruction, report=report, applied=True)


def read_gdf(path: str | os.PathLike[str]) -> Gdf:
    """Read an edit as stored, and verify its checksum. A network is not baked yet and has no offsets.

    A .cube file gives a grade without members, for `apply_grade`.

    Raises:
        ProgdfError: the file is not a .gdf file, from a newer version, truncated, damaged or inconsistent;
            see also `read_cube`.
    """
    name = Path(path).name
    if Path(path).suffix.lower() == CUBE:
        empty_region = Region("any", torch.zeros(0, dtype=torch.int64), torch.zeros(0))
        ends = torch.tensor([0.0, 1.0])
        form = lattice_form(read_cube(path))
        field = BakedField("grade", ends, {}, BASE_CHANNELS, origin=form)
        return Gdf(Path(path).stem, empty_region, field, ANY_SCENE, name)
    head, tensors = header.unpack_file(read_file(path), name)
    try:
        return _unpack(head, tensors)
    except (KeyError, TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise header.contradiction_error(name, error) from error


def _unpack(head: header.GdfHeader, tensors: Mapping[str, Tensor]) -> Gdf:
    broken = _find_non_finite(tensors)
    if broken:
        raise ValueError(f"{broken} has a number that is not finite")
    if not 0 <= head.scene.count <= header.MAX_GAUSSIANS or head.members > head.scene.count:
        raise ValueError(f"{head.members} members of a scene of {head.scene.count} Gaussians")
    field = header.unpack_field(head.field, tensors, head.members)
    check_reach(field)
    members = field.members if field.attributes else head.members + head.added
    if field.origin is not None:
        members = field.origin.members
        if head.added:
            raise ValueError(f"rows are added to a {field.kind} field, which has none")
    if head.members + head.added != members:
        raise ValueError(f"the header has {head.members + head.added} members, the field {members}")
    region = header.unpack_region(head.region, tensors, head.scene.count, head.members)
    if head.members != len(region):
        raise ValueError(f"the header has {head.members} members, the region {len(region)}")
    return Gdf(
        name=head.name,
        region=region,
        field=field,
        scene=head.scene,
        instruction=head.instruction,
        options=head.options,
        report=head.report,
        added=header.unpack_added(head, tensors),
        anchors=header.unpack_anchors(head, tensors),
        anchors_found=header.is_before_anchors(head) and bool(head.report),
        adds=head.adds,
        motions=header.unpack_motions(head, tensors),
    )


def _find_non_finite(tensors: Mapping[str, Tensor]) -> str:
    """Return the name of a tensor with a NaN or an infinity, or an empty text."""
    return next((name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())), "")


def check_reach(field: BakedField) -> None:
    """Raise ValueError if an offset can exceed the limit at any strength, as sums could overflow."""
    for name, bases in field.attributes.items():
        max_coefficients = bases.coefficients.abs().amax(0).double()
        reach = float(max_coefficients[0]) * float(bases.end.abs().max() if bases.end_offset.numel() else 0.0)
        if bases.residual_basis.numel():
            peaks = bases.residual_basis.abs().amax(1).double() * bases.scale[1:].abs().double()
            reach += float(max_coefficients[1:] @ peaks.amax(1))
        if not reach < _MAX_OFFSETS.get(name, _MAX_OFFSET):
            raise ValueError(f"{name} moves by up to {reach:.3g}, farther than any scene reaches")
