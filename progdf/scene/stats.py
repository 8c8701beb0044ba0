"""What a scene is like: where it lies, how large its Gaussians are."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from progdf.gaussians import Gaussians
from progdf.terminal import format_place

from .bounds import is_surrounding, scene_sphere
from .up_axis import UpAxis, find_up


@dataclass(frozen=True)
class Survey:
    """A scene in numbers."""

    count: int  # Gaussians N
    center: tuple[float, float, float]  # median of the means, in the world
    radius: float  # distance from the center within which 97 % of the means lie, world units
    farthest: float  # distance of the farthest mean from the center, world units
    # box, bulk_box: the corners of all Gaussians, and of the middle 95 % along each axis, in the world
    box: tuple[float, ...]
    bulk_box: tuple[float, ...]
    up: UpAxis  # which way is up, and how that was decided
    surrounding: bool  # it looks like a scene to stand inside, which cameras around it cannot frame
    median_size: float  # median of the longest axes, one standard deviation, world units
    largest_size: float  # the longest axis of all

    def lines(self) -> list[str]:
        """The survey for a person, a line per fact."""
        center = " ".join(format_place(at, self.radius, 4) for at in self.center)
        lines = [
            f"place: center {center}, radius {self.radius:.4g} (97 % of the Gaussians), "
            f"farthest {self.farthest:.4g}",
            f"up: {self.up.name}, {self.up.reason}",
            f"bulk, 95 % along each axis: --region {_box(self.bulk_box)}",
            f"all: --region {_box(self.box)}",
            f"size: median {self.median_size:.3g}, largest {self.largest_size:.3g} "
            "(longest axis, one standard deviation)",
        ]
        if self.surrounding:
            lines.append(
                "cameras: a scene to stand inside, which cameras around it cannot frame; give its own, "
                "or keep views with F4 in progdf view"
            )
        return lines


def survey(scene: Gaussians, up: UpAxis | None = None) -> Survey:
    """Measure a scene of at least one Gaussian, every number in it finite, as `load_ply` makes them.

    Args:
        scene: N Gaussians
        up: which way is up; None finds it
    """
    center, radius = scene_sphere(scene)
    up = find_up(scene) if up is None else up
    longest = scene.log_scales.amax(dim=1).exp()
    x, y, z = (at + middle for at, middle in zip(scene.origin, center.tolist(), strict=True))
    return Survey(
        count=len(scene),
        center=(x, y, z),
        radius=radius,
        farthest=float((scene.means - center).norm(dim=1).max()),
        box=_corners(scene, 0.0),
        bulk_box=_corners(scene, 0.025),
        up=up,
        surrounding=is_surrounding(scene, up.direction),
        median_size=float(longest.median()),
        largest_size=float(longest.max()),
    )


def _corners(scene: Gaussians, left_out: float) -> tuple[float, ...]:
    """Least x, y, z and largest x, y, z of what is left without a share of the means on each side."""
    ordered = scene.means.sort(dim=0).values
    cut = int(left_out * len(ordered))
    ends = torch.cat([ordered[cut], ordered[len(ordered) - 1 - cut]]).tolist()
    return tuple(at + end for at, end in zip(2 * scene.origin, ends, strict=True))


def _box(corners: tuple[float, ...]) -> str:
    """The corners as a region, rounded outwards to a hundred-thousandth of the box."""
    step = 10.0 ** math.floor(math.log10(max(math.dist(corners[:3], corners[3:]), 1e-12)) - 4)
    places = max(0, -round(math.log10(step)))
    rounded = [(math.floor, math.ceil)[i // 3](corner / step) * step for i, corner in enumerate(corners)]
    return "box:" + ",".join(f"{corner:.{places}f}" for corner in rounded)
