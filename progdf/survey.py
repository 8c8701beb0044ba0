"""What a scene is like: where it lies, how large its Gaussians are, which of them are odd."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from progdf.framing import guess_up, is_surrounding, scene_sphere
from progdf.gaussians import Gaussians
from progdf.load_report import counted

GIANT = 0.5
"""Of the scene's radius: a Gaussian with a longer axis (one standard deviation) covers most of a picture."""

NEEDLE = 30.0
LONG = 0.05
"""A needle's longest axis is 30 times its middle one and at least a twentieth of the scene's radius."""

INVISIBLE = 1 / 255


@dataclass(frozen=True)
class Survey:
    """A scene in numbers.

    Args:
        count: Gaussians N
        centre: median of the means, world units
        radius: distance from the centre within which 97 % of the means lie, world units
        farthest: distance of the farthest mean from the centre, world units
        up: the world axis that is probably up, e.g. "-y"
        surrounding: it looks like a scene to stand inside, which cameras around it cannot frame
        median_size: median of the longest axes, one standard deviation, world units
        largest_size: the longest axis of all
        invisible: Gaussians with an opacity under 1/255, which no rasteriser draws
        giants: see `GIANT`
        needles: see `NEEDLE`
    """

    count: int
    centre: tuple[float, float, float]
    radius: float
    farthest: float
    up: str
    surrounding: bool
    median_size: float
    largest_size: float
    invisible: int
    giants: int
    needles: int

    def lines(self) -> list[str]:
        """The survey for a person, a line per fact."""
        x, y, z = self.centre
        lines = [
            f"place: centre {x:.4g} {y:.4g} {z:.4g}, radius {self.radius:.4g} (97 % of the Gaussians), "
            f"farthest {self.farthest:.4g}, up is probably {self.up}",
            f"size: median {self.median_size:.3g}, largest {self.largest_size:.3g} "
            "(longest axis, one standard deviation)",
        ]
        odd = (
            (self.invisible, "Gaussian", "too transparent to be drawn (opacity under 1/255)"),
            (self.giants, "giant", f"(longer than {GIANT:g} of the scene's radius)"),
            (self.needles, "needle", f"({NEEDLE:g} times as long as wide, and long)"),
        )
        lines += [f"odd: {counted(rows, noun)} {what}" for rows, noun, what in odd if rows]
        if self.surrounding:
            lines.append(
                "cameras: a scene to stand inside, which cameras around it cannot frame; give its own"
            )
        return lines


def survey(scene: Gaussians) -> Survey:
    """Measure a scene of at least one Gaussian, every number in it finite, as `load_ply` makes them."""
    centre, radius = scene_sphere(scene)
    up = guess_up(scene)
    axis = int(up.abs().argmax())
    axes = scene.log_scales.sort(dim=1).values
    longest = axes[:, 2].exp()
    needles = (axes[:, 2] - axes[:, 1] > torch.tensor(NEEDLE).log()) & (longest > LONG * radius)
    x, y, z = centre.tolist()
    return Survey(
        count=len(scene),
        centre=(x, y, z),
        radius=radius,
        farthest=float((scene.means - centre).norm(dim=1).max()),
        up=("-" if float(up[axis]) < 0 else "+") + "xyz"[axis],
        surrounding=is_surrounding(scene, up),
        median_size=float(longest.median()),
        largest_size=float(longest.max()),
        invisible=int((scene.opacities < INVISIBLE).sum()),
        giants=int((longest > GIANT * radius).sum()),
        needles=int(needles.sum()),
    )
