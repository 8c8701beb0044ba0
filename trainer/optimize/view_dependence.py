"""Whether an edit needs the higher bands of spherical harmonics, decided before it is trained.

Bands beyond DC let a color change with the view. Where the original's hardly does, they have nothing to
follow, and what they learn is the noise of the training views: unseen views come out worse for it. Asking
afterwards (train them, take them out, compare) says the opposite, as DC has leaned on them by then.

Both are measured in docs/experiments.md, Higher bands of spherical harmonics.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from progdf.camera import Camera
from progdf.gaussians import Gaussians
from progdf.sh import basis
from trainer.views.choose import visible_area

NEEDED = 0.04
"""Color (0..1) by which a region's must change with the view for the bands to pay."""


def view_dependence(members: Gaussians, cameras: Sequence[Camera]) -> float:
    """How much the members' colors change between these cameras: the root mean square, in color 0..1.

    Each member counts as the area that it can cover.
    """
    bands = min(members.shN.shape[1], 15)
    if not bands or not len(members) or len(cameras) < 2:
        return 0.0
    degree = min(members.sh_degree, 3)
    seen = []
    for camera in cameras:
        directions = torch.nn.functional.normalize(members.means - camera.position, dim=1)
        seen.append((basis(degree, directions)[:, 1 : bands + 1, None] * members.shN[:, :bands]).sum(dim=1))
    colors = torch.stack(seen)
    change = (colors - colors.mean(dim=0)).square().mean(dim=(0, 2)).double()
    areas = visible_area(members)
    return float(((change * areas).sum() / areas.sum().clamp_min(1e-300)).sqrt())
