"""`--drop-invisible`: members that no view of a run shows are left out of its .gdf, and it is told.

The default keeps them: a .gdf without them ends at s = 1 where the recording ends for all others but not for
these, which keep their old looks for whoever looks where no view did. Measured, with the change of all views
together below half a level of 8 bits:

| edit                   | left out      |         bytes | worst PSNR, with / without, dB |
| ---------------------- | ------------: | ------------: | -----------------------------: |
| a robot of 2931, blue  |     0 of 2931 |             0 |                  40.54 / 40.54 |
| a robot of 15161, blue |   10 of 15161 | 1.8 kB (.1 %) |                  41.52 / 41.52 |
| a bear's scarf         |   222 of 3491 |  3.3 kB (6 %) |                  42.84 / 42.84 |
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.camera import Camera
from progdf.field import BakedField, Candidate, FieldJudge
from progdf.field.active import PIXEL, invisible_members, resting, without
from progdf.field.trajectory import Trajectory
from progdf.gaussians import Gaussians, pack
from progdf.rasterize import alpha_weights, render
from progdf.region import Region
from trainer.setup.training_setup import Stand

from .evaluate import Judge
from .fit import Fitted


@dataclass(frozen=True)
class Dropped:
    """A choice without the members that do not show.

    Args:
        fitted: the choice, its errors taken anew with these members at rest; all members are in its field
        kept: the region's members that remain, by their place in it. [M] bool
        largest: largest change of a colour in any view, of 1
        before: the choice's worst PSNR with them, dB
    """

    fitted: Fitted
    kept: Tensor
    largest: float
    before: float

    @property
    def count(self) -> int:
        """How many members were left out."""
        return int((~self.kept).sum())

    @property
    def bytes(self) -> int:
        """What they would have taken in the file."""
        return round(self.count * self.fitted.chosen.field.bytes_per_member)

    def field(self, field: BakedField) -> BakedField:
        """A field of all members, without these."""
        return without(field, ~self.kept)

    def region(self, region: Region) -> Region:
        """The region without them; the soft score stays as it is."""
        return replace(region, members=region.members[self.kept])

    def figures(self) -> dict[str, Any]:
        """As report.json has it."""
        return {
            "members": self.count,
            "of": len(self.kept),
            "bytes": self.bytes,
            "largest_change": float(f"{self.largest:.2g}"),
            "psnr_worst": {"with": round(self.before, 2), "without": round(self.fitted.chosen.worst, 2)},
        }

    def line(self) -> str:
        """What the log says."""
        after = self.fitted.chosen.worst
        return (
            f"dropped {self.count} of {len(self.kept)} members that no view shows: {self.bytes} bytes less, "
            f"no colour changes by more than {self.largest:.2g}, worst {after:.2f} dB instead of "
            f"{self.before:.2f}"
        )


def dropped_of(stand: Stand, trajectory: Trajectory, judge: Judge, fitted: Fitted) -> Dropped:
    """`drop_invisible` of a run's choice, in all its views, at the strengths of its stages."""
    cameras = [view.camera for view in (*stand.train, *stand.held_out)]
    offsets = torch.stack([trajectory.node(i) for i in range(len(trajectory))])
    errors = FieldJudge(trajectory.s, offsets, judge.counted)
    return drop_invisible(stand.scene, stand.region.members, cameras, fitted, errors, trajectory.strengths)


def drop_invisible(
    scene: Gaussians,
    members: Tensor,
    cameras: Sequence[Camera],
    fitted: Fitted,
    errors: FieldJudge,
    strengths: Sequence[float],
) -> Dropped:
    """Leave out what does not show.

    Args:
        scene: the original
        members: of the region. [M] int64
        cameras: every view of the run
        fitted: the choice, not a network's
        errors: judges it anew
        strengths: at which pictures are compared
    """
    chosen = fitted.chosen.field
    rows = pack(scene[members], with_shN=chosen.channels > 14)

    def edited(offsets: Tensor) -> Gaussians:
        return scene.replace_rows(members, rows + offsets)

    def pictures(offsets: Tensor) -> Iterator[Tensor]:
        now = edited(offsets)
        return (render(now, camera) for camera in cameras)

    effect = torch.zeros(len(members))
    if chosen.attributes:
        for s in (0.0, 1.0):
            look = edited(chosen.offsets(s))
            for camera in cameras:
                everywhere = torch.ones(camera.height, camera.width)
                effect = effect.maximum(alpha_weights(look, camera, everywhere)[members, 2].float())
        effect = effect * _largest_offsets(chosen, strengths)
    found = invisible_members(chosen, effect, pictures, strengths, PIXEL)
    if not bool(found.gone.any()):
        return Dropped(fitted, ~found.gone, 0.0, fitted.chosen.worst)
    at_rest: Candidate = errors.candidate(resting(chosen, found.gone), fitted.chosen.label)
    return Dropped(replace(fitted, chosen=at_rest), ~found.gone, found.largest, fitted.chosen.worst)


def _largest_offsets(field: BakedField, strengths: Sequence[float]) -> Tensor:
    """Each member's largest movement, every attribute in units of its own root mean square. [M]"""
    largest = torch.zeros(field.members)
    for name, bases in field.attributes.items():
        unit = bases.full.square().mean().sqrt().clamp(min=1e-12)
        for s in strengths:
            largest = largest.maximum(field.attribute_offsets(name, s).norm(dim=1) / unit)
    return largest
