"""How far an edit hides those below it: as far as it changes a Gaussian itself (the blend rule "over")."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from progdf.field.baked import BakedField
from progdf.gaussians import Gaussians
from progdf.gdf.file import Gdf
from progdf.sh import C0

from .layers import KINDS

_COLOR = 0.1  # of sRGB's 0..1: a change that is plain to see
_OPACITY = 0.2  # of 0..1
_MOVE, _GROWTH, _TURN = 0.05, 0.4, 0.4  # of the region's size; of a log-scale; of a quaternion's length
_SHARE_OF_LARGEST = 0.5
_MOST = 100_000  # members by which the largest change is judged


def coverage(scene: Gaussians, gdf: Gdf) -> Mapping[str, Tensor]:
    """For each kind of change that an edit makes, how much of a lower edit's is hidden by it at strength 1.

    With z the size of a member's finished change, c = smoothstep(z / max(floor, z₉₀ / 2)), where z₉₀ is
    exceeded by a tenth of the members: what the edit leaves alone hides nothing, half of its own large
    changes hide all. z is what one sees:

    - "color": the largest channel of the change in sRGB, root mean square over all directions of view
      (C0 · √Σ Δ² over the SH coefficients); floor 0.1
    - "opacity": the change of σ(logit); floor 0.2
    - "geometry": the largest of the way / 0.05 of the region's size, the growth of a log-scale / 0.4, and the
      turn |Δq| / 0.4 |q|; floor 1

    Nothing of it is stored: it follows from the offsets at strength 1, and so holds for every .gdf.

    Returns:
        Kind, see `layers.KINDS` -> c, 0..1. [M] float32
    """
    members, field = gdf.region.members, gdf.field
    sizes = {
        "color": (_color_change(field), _COLOR),
        "opacity": (_opacity_change(scene, members, field), _OPACITY),
        "geometry": (_shape_change(scene, members, field), 1.0),
    }
    moved = {KINDS[name] for name in field.attributes}
    return {kind: _rise(size, floor) for kind, (size, floor) in sizes.items() if kind in moved}


def _rise(size: Tensor, floor: float) -> Tensor:
    if not len(size):
        return size
    few = size[:: 1 + len(size) // _MOST]
    largest = float(few.kthvalue(1 + int(0.9 * (len(few) - 1))).values)
    x = (size / max(floor, _SHARE_OF_LARGEST * largest)).clamp(0.0, 1.0)
    return (x * x * (3.0 - 2.0 * x)).float()


def _color_change(field: BakedField) -> Tensor:
    changes = [field.attributes[name].end_offset for name in ("sh0", "shN") if name in field.attributes]
    if not changes:
        return torch.zeros(0)
    together = torch.cat([change.float().reshape(len(change), -1, 3) for change in changes], dim=1)
    change: Tensor = C0 * together.norm(dim=1).amax(dim=1)
    return change


def _opacity_change(scene: Gaussians, members: Tensor, field: BakedField) -> Tensor:
    if "logit_opacities" not in field.attributes:
        return torch.zeros(0)
    before = scene.logit_opacities[members].float()
    after = before + field.attributes["logit_opacities"].end_offset.float().reshape(-1)
    return (after.sigmoid() - before.sigmoid()).abs()


def _shape_change(scene: Gaussians, members: Tensor, field: BakedField) -> Tensor:
    size = torch.zeros(len(members))
    if "means" in field.attributes and len(members):
        means = scene.means[members].float()
        extent = (means - means.mean(dim=0)).norm(dim=1).median().clamp_min(1e-12) * 2
        size = field.attributes["means"].end_offset.float().norm(dim=1) / (_MOVE * extent)
    if "log_scales" in field.attributes:
        size = size.maximum(field.attributes["log_scales"].end_offset.float().abs().amax(dim=1) / _GROWTH)
    if "quats" in field.attributes:
        length = scene.quats[members].float().norm(dim=1).clamp_min(1e-6)
        size = size.maximum(field.attributes["quats"].end_offset.float().norm(dim=1) / (_TURN * length))
    return size
