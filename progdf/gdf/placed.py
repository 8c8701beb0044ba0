"""Placement of a scene beside others in one view: its Gaussians and its edits under a similarity.

A field holds offsets of raw parameters. Under a similarity, they are linear: offsets of means and of
quaternions are rotated, those of means are also scaled, and those of the higher SH bands are rotated band by
band. All other offsets stay as they are. With the identity, all values keep their bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from msgspec import Meta
from torch import Tensor
from torch.nn.functional import pad

from progdf.errors import ProgdfError
from progdf.field.baked import AttributeBases, BakedField
from progdf.gaussians import BASE_CHANNELS, Gaussians, Origin
from progdf.quaternions import matrix_turns, multiply_quats, rotation_matrices, turn_quats
from progdf.region import Region
from progdf.sh import rotation_change
from progdf.similarity import AffineMotion

from .anchors import Anchors
from .file import Gdf
from .header import SceneFingerprint
from .motions import PartMotions

MAX_FACTOR = 1e6
"""Largest factor of a placed scene, and the inverse of the smallest one."""
MAX_SHIFT = 1e9
"""Largest coordinate of a shift, world units."""
MAX_TURN = 7.0
"""Largest coordinate of a rotation vector, radians."""
_SAME_TURN = 1e-12  # rotation that counts as none, radians
_UNEVEN_TOLERANCE = 1e-6  # relative difference of the factors of two axes that counts

Coordinate = Annotated[float, Meta(ge=-MAX_SHIFT, le=MAX_SHIFT)]
Angle = Annotated[float, Meta(ge=-MAX_TURN, le=MAX_TURN)]
Factor = Annotated[float, Meta(ge=1 / MAX_FACTOR, le=MAX_FACTOR)]


@dataclass(frozen=True)
class Placement:
    """Similarity of world coordinates: x' = shift + factor · R x."""

    shift: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)  # world units
    turn: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)  # rotation vector of R, radians
    factor: Factor = 1.0

    @property
    def is_turned(self) -> bool:
        """True if it rotates."""
        return any(self.turn)

    @property
    def rotation(self) -> Tensor:
        """Matrix R. [3,3] float64"""
        return rotation_matrices(self.quat[None])[0]

    @property
    def quat(self) -> Tensor:
        """Unit quaternion of R. [4] float64"""
        return turn_quats(torch.tensor([self.turn], dtype=torch.float64))[0]

    @property
    def offset(self) -> Tensor:
        """Shift as a tensor. [3] float64"""
        return torch.tensor(self.shift, dtype=torch.float64)

    @property
    def inverse(self) -> Placement:
        """Placement that undoes this one."""
        if self == Placement():
            return self
        back = self.rotation.T
        return _placement(back, 1.0 / self.factor, -(back @ self.offset) / self.factor)

    def then(self, motion: AffineMotion, origin: Origin) -> Placement:
        """Return this placement followed by a motion.

        Args:
            motion: a motion about its pivot, relative to `origin`
            origin: world position of the origin of the motion's coordinates

        Raises:
            ProgdfError: the motion mirrors, changes proportions, or leaves the range of placements.
        """
        logs = torch.linalg.eigvalsh(motion.stretch)
        if motion.mirror is not None or float(logs[-1] - logs[0]) > _UNEVEN_TOLERANCE:
            raise ProgdfError("a scene keeps its proportions; scale all axes alike, and do not mirror it")
        factor = math.exp(float(logs.mean()))
        turned = rotation_matrices(turn_quats(motion.turn[None].double()))[0]
        center = torch.zeros(3, dtype=torch.float64) if motion.pivot is None else motion.pivot.double()
        pivot = center + torch.tensor(origin, dtype=torch.float64)
        shift = pivot + motion.shift + factor * (turned @ (self.offset - pivot))
        return _placement(turned @ self.rotation, factor * self.factor, shift)


def placement_of(values: Sequence[float]) -> Placement:
    """Return the placement of a shift, degrees about the axes x, y and z in turn, and a scale.

    Args:
        values: 3, 6 or 7 numbers

    Raises:
        ProgdfError: a number is out of range.
    """
    factor = values[6] if len(values) > 6 else 1.0
    rotation = torch.eye(3, dtype=torch.float64)
    for axis, angle in enumerate(values[3:6]):
        turn = torch.zeros(1, 3, dtype=torch.float64)
        turn[0, axis] = math.radians(angle)
        rotation = rotation_matrices(turn_quats(turn))[0] @ rotation
    return _placement(rotation, factor, torch.tensor(values[:3], dtype=torch.float64))


def _placement(rotation: Tensor, factor: float, shift: Tensor) -> Placement:
    """Return the placement of a matrix, a factor and a shift.

    Raises:
        ProgdfError: a number is out of range.
    """
    turn = matrix_turns(rotation[None])[0]
    turn = torch.where(turn.abs() < _SAME_TURN, torch.zeros_like(turn), turn)
    if not 1 / MAX_FACTOR <= factor <= MAX_FACTOR or not bool((shift.abs() <= MAX_SHIFT).all()):
        raise ProgdfError(f"a scene can be moved by {MAX_SHIFT:g} and scaled by {MAX_FACTOR:g} at most")
    x, y, z = shift.tolist()
    a, b, c = turn.tolist()
    return Placement((x, y, z), (a, b, c), factor)


def place_scene(scene: Gaussians, placement: Placement, origin: Origin, bands: int) -> Gaussians:
    """Return a placed scene.

    Args:
        scene: N Gaussians
        placement: its placement
        origin: origin of the result, see `Gaussians.origin`
        bands: number of higher SH coefficients of the result, at least that of the scene

    Returns:
        Gaussians with the same bits if the placement is the identity and the origin is that of the scene.
    """
    missing = bands - scene.shN.shape[1]
    shN = scene.shN
    if placement.is_turned:
        shN = band_matrix(placement, shN.shape[1]).to(shN) @ shN
    if missing:
        shN = pad(shN, (0, 0, 0, missing))
    if placement == Placement() and origin == scene.origin:
        return replace(scene, shN=shN)
    world = scene.world_means
    quats = scene.quats
    if placement.is_turned:
        world = world @ placement.rotation.T
        quats = multiply_quats(placement.quat.to(quats)[None], quats)
    world = placement.factor * world + (placement.offset - torch.tensor(origin, dtype=torch.float64))
    return replace(
        scene,
        means=world.to(scene.means.dtype),
        quats=quats,
        log_scales=scene.log_scales + math.log(placement.factor),
        shN=shN,
        origin=origin,
    )


def check_rounding(scene: Gaussians, name: str) -> None:
    """Check that a placed scene is near enough to the origin for the precision of its positions.

    Positions are float32. With steps as large as the typical second axis of the Gaussians, a picture has
    about 50 dB against that of the same scene at the origin; with larger steps, Gaussians visibly jump.

    Args:
        scene: the placed scene
        name: its name, for the message

    Raises:
        ProgdfError: positions are rounded more coarsely than that.
    """
    if not len(scene):
        return
    reach = float(scene.means.abs().nan_to_num(0.0, 0.0).max())
    step = float(np.spacing(np.float32(reach)))
    size = float(scene.scales.median(dim=1).values.median())
    if step > size:
        raise ProgdfError(
            f"{name} would lie {reach:.3g} from the origin, where positions are rounded to {step:.2g}; "
            f"its Gaussians have a size of {size:.2g}, so place it nearer"
        )


def band_matrix(placement: Placement, bands: int) -> Tensor:
    """Return the matrix by which a placement rotates the higher SH bands. [K,K] float64"""
    still = torch.eye(bands, dtype=torch.float64)
    if not bands or not placement.is_turned:
        return still
    columns = still[:, :, None].expand(-1, -1, 3).contiguous()
    turned = columns + rotation_change(columns, placement.quat.expand(bands, 4))
    return turned[:, :, 0].T.contiguous()


@dataclass(frozen=True)
class Target:
    """Scene to which an edit is carried."""

    fingerprint: SceneFingerprint
    origin: Origin  # origin of its means
    bands: int  # number of its higher SH coefficients
    # maps rows of the edit's scene to its own; −1 for rows that it does not have. [M] -> [M]
    rows: Callable[[Tensor], Tensor]


def carry_edit(gdf: Gdf, placement: Placement, target: Target) -> Gdf:
    """Return an edit of a scene as an edit of another one, in which the scene is placed.

    Args:
        gdf: an edit of the scene, not extended
        placement: placement of the scene
        target: the other scene

    Raises:
        ProgdfError: the edit mirrors a part, and the placement rotates.
    """
    score = torch.zeros(target.fingerprint.count)
    rows = torch.arange(len(gdf.region.score))
    moved = target.rows(rows)
    is_there = moved >= 0
    score[moved[is_there]] = gdf.region.score[is_there]
    added = gdf.added
    if added is not None:
        added = place_scene(added, placement, target.origin, max(added.shN.shape[1], target.bands))
        added = replace(added, shN=added.shN[:, : target.bands])
    return replace(
        gdf,
        region=Region(gdf.region.name, target.rows(gdf.region.members), score),
        field=_carry_field(gdf.field, placement, target.bands),
        scene=target.fingerprint,
        added=added,
        anchors=None if gdf.anchors is None else _carry_anchors(gdf.anchors, target),
        motions=_carry_motions(gdf, placement),
    )


def _carry_anchors(anchors: Anchors, target: Target) -> Anchors:
    """Return anchors among the rows of the target. Anchors that are not there lose their weight."""
    rows = target.rows(anchors.rows.flatten()).reshape(anchors.rows.shape)
    lost = (rows < 0) & (anchors.weights > 0.0)
    weights = anchors.weights
    if bool(lost.any()):
        weights = torch.where(lost, 0.0, weights)
        total = weights.sum(dim=1, keepdim=True)
        weights = torch.where(total > 0.0, weights / total.clamp_min(1e-9), 0.0)
    return replace(anchors, rows=rows.clamp_min(0), weights=weights)


def _carry_field(field: BakedField, placement: Placement, bands: int) -> BakedField:
    """Return a field with offsets in the placed frame, for members with so many higher SH coefficients."""
    attributes = dict(field.attributes)
    if "means" in attributes and placement != Placement():
        attributes["means"] = _transform(attributes["means"], placement.factor * placement.rotation)
    if placement.is_turned and "quats" in attributes:
        still = torch.eye(4, dtype=torch.float64)
        columns = multiply_quats(placement.quat.expand(4, 4), still)
        attributes["quats"] = _transform(attributes["quats"], columns.T)
    channels = field.channels
    if channels > BASE_CHANNELS:
        channels = BASE_CHANNELS + 3 * bands
    if "shN" in attributes:
        shN = attributes["shN"]
        if placement.is_turned:
            by_band = band_matrix(placement, shN.end_offset.shape[1] // 3)
            shN = _transform(shN, torch.kron(by_band, torch.eye(3, dtype=torch.float64)))
        attributes["shN"] = _fit_width(shN, 3 * bands)
    return replace(field, attributes=attributes, channels=channels)


def _transform(bases: AttributeBases, matrix: Tensor) -> AttributeBases:
    """Return bases whose offsets are multiplied by a matrix. [c,c]"""
    stored = torch.cat([bases.end_offset[None].float(), bases.residual_basis.float()])
    values = stored * bases.scale[:, None]
    moved = values @ matrix.T.float()
    return AttributeBases(
        moved[0].contiguous(), moved[1:].contiguous(), torch.ones_like(bases.scale), bases.coefficients
    )


def _fit_width(bases: AttributeBases, width: int) -> AttributeBases:
    """Return bases of higher SH bands with so many channels; new ones are 0, surplus ones are left out."""
    more = width - bases.end_offset.shape[1]
    if not more:
        return bases
    if more < 0:
        return AttributeBases(
            bases.end_offset[:, :width].contiguous(),
            bases.residual_basis[:, :, :width].contiguous(),
            bases.scale[:, :width].contiguous(),
            bases.coefficients,
        )
    return AttributeBases(
        pad(bases.end_offset, (0, more)),
        pad(bases.residual_basis, (0, more)),
        pad(bases.scale, (0, more)),
        bases.coefficients,
    )


def _carry_motions(gdf: Gdf, placement: Placement) -> PartMotions | None:
    """Return the motions of an edit's parts in the placed frame."""
    motions = gdf.motions
    if motions is None or not placement.is_turned:
        return motions
    if any(motion.mirror is not None for part in motions.motions for motion in part):
        raise ProgdfError(
            f"{gdf.name} mirrors a part, so its scene cannot be turned; move and scale it, or export it first"
        )
    rotation = placement.rotation

    def rotate(motion: AffineMotion) -> AffineMotion:
        stretch = rotation @ motion.stretch @ rotation.T
        return replace(motion, turn=rotation @ motion.turn, stretch=(stretch + stretch.T) / 2.0)

    return replace(motions, motions=tuple(tuple(map(rotate, part)) for part in motions.motions))
