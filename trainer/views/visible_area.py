"""How much of a picture each Gaussian can take up: what it counts where Gaussians are averaged or sampled."""

from __future__ import annotations

from torch import Tensor

from progdf.gaussians import Gaussians

_GIANT = 20.0
"""Times the mean area at which one Gaussian counts no more."""


def visible_area(gaussians: Gaussians) -> Tensor:
    """Opacity times the two longer axes, cut off so that no giant speaks for all. [N] float64"""
    _, middle, long = gaussians.scales.sort(dim=1).values.double().unbind(1)
    areas = gaussians.opacities.double() * middle * long
    return areas.clamp_max(_GIANT * float(areas.mean()))
