"""Analytic edits: the exact value of every Gaussian at every strength, given by a formula."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from progdf.color import edits as color
from progdf.demo_scenes.assemble import DemoScene
from progdf.errors import ProgdfError
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.quaternions import multiply_quats, rotate_vectors, turn_quats
from progdf.sh import rgb_to_sh0, rotation_change, sh0_to_rgb

Change = Callable[[Gaussians, float], Gaussians]
"""Function from the original members and a strength in (0, 1] to the members at that strength."""

Warp = Callable[[Tensor, float], Tensor]
"""Function from points [M,3] float64 and a strength in (0, 1] to their positions at that strength. [M,3]"""


@dataclass(frozen=True)
class AnalyticEdit:
    """An edit given by a formula."""

    name: str  # name of the change
    change: Change  # the formula

    def apply(self, scene: Gaussians, members: Tensor, strength: float) -> Gaussians:
        """Return the scene with `members` ([M] int64) edited to `strength` (0 to 1); other rows are
        unchanged.

        Strength 0 gives the scene bit for bit.

        Raises:
            ProgdfError: the strength is not between 0 and 1.
        """
        if not 0 <= strength <= 1:
            raise ProgdfError(f"the strength must be between 0 and 1, got {strength:g}")
        if strength == 0:
            return scene
        edited = self.change(scene[members], strength)
        return replace(
            scene,
            **{
                name: getattr(scene, name).index_copy(0, members, getattr(edited, name))
                for name in ATTRIBUTES
            },
        )


def recolor_edit(target: Tensor) -> AnalyticEdit:
    """Make a recolor edit: `edits.recolor_course` per Gaussian, relative to the members' typical color.

    `target`: color at strength 1, sRGB. [3]
    """

    def change(part: Gaussians, strength: float) -> Gaussians:
        course = color.recolor_course(sh0_to_rgb(part.sh0), target, _own_color(part))
        return _with_color(part, course(strength), strength)

    return AnalyticEdit("recolor", change)


def stripes_edit(target: Tensor, axis: Tensor, period: float) -> AnalyticEdit:
    """Make an edit that paints stripes across `axis` [3], `period` world units apart.

    `target`: color at strength 1, sRGB. [3]
    """

    def change(part: Gaussians, strength: float) -> Gaussians:
        course = color.recolor_course(sh0_to_rgb(part.sh0), target, _own_color(part))
        shares = strength * color.stripe_pattern(part.means, axis, period)
        return _with_color(part, course(shares), shares[:, None, None])

    return AnalyticEdit("stripes", change)


def darken_edit(stops: float = 3.0) -> AnalyticEdit:
    """Make a night edit by `edits.night_course`; view-dependent light fades with the rest."""

    def change(part: Gaussians, strength: float) -> Gaussians:
        dark = color.night_course(sh0_to_rgb(part.sh0), stops)(strength)
        # sRGB values fall about as the light to the power of 1/2.2
        return replace(part, sh0=rgb_to_sh0(dark), shN=part.shN * 2 ** (-stops * strength / 2.2))

    return AnalyticEdit("night", change)


def fade_edit() -> AnalyticEdit:
    """Make an edit that removes: the opacity falls linearly to 0."""

    def change(part: Gaussians, strength: float) -> Gaussians:
        return replace(part, logit_opacities=(part.opacities * (1 - strength)).logit(eps=1e-6))

    return AnalyticEdit("fade", change)


def scale_edit(factor: float, pivots: Tensor, shift: Tensor | None = None) -> AnalyticEdit:
    """Make an edit that scales about the nearest pivot; centers move on straight lines.

    Args:
        factor: size at strength 1
        pivots: fixed points, apart from the shift. [P,3]
        shift: additional translation at strength 1, world units; None: none. [3]
    """

    def change(part: Gaussians, strength: float) -> Gaussians:
        size = 1 + strength * (factor - 1)
        center = _nearest(part.means, pivots)
        means = center + size * (part.means - center)
        if shift is not None:
            means = means + strength * shift.to(means)
        return replace(part, means=means, log_scales=part.log_scales + math.log(size))

    return AnalyticEdit("grow", change)


def swing_edit(degrees: float, axis: Tensor, pivots: Tensor) -> AnalyticEdit:
    """Make an edit that rotates by `degrees` about `axis` [3] through the nearest of `pivots` [P,3].

    Centers move on circles, and the view-dependent color of a member rotates with it.
    """

    def change(part: Gaussians, strength: float) -> Gaussians:
        turn = math.radians(degrees * strength) * axis.to(part.means) / axis.norm()
        quats = turn_quats(turn.expand_as(part.means))
        center = _nearest(part.means, pivots)
        return replace(
            part,
            means=center + rotate_vectors(part.means - center, quats),
            quats=multiply_quats(quats, part.quats),
            shN=part.shN + rotation_change(part.shN, quats),
        )

    return AnalyticEdit("swing", change)


def warp_edit(name: str, warp: Warp) -> AnalyticEdit:
    """Make an edit that warps space.

    Centers follow the warp, covariances its Jacobian, Σ' = J Σ Jᵀ, and view-dependent color the rotation of
    the Jacobian.
    """

    def change(part: Gaussians, strength: float) -> Gaussians:
        points = part.means.double()
        columns = [
            torch.func.jvp(lambda p: warp(p, strength), (points,), (axis.expand_as(points),))[1]
            for axis in torch.eye(3, dtype=torch.float64)
        ]
        axes = Rotation.from_quat(part.unit_quats.double().numpy(), scalar_first=True).as_matrix()
        jacobian = torch.stack(columns, dim=2)
        shape = jacobian @ (torch.from_numpy(axes) * part.scales.double()[:, None, :])
        # the covariance is shape · shapeᵀ, whose axes are the left singular vectors
        rotations, scales, _ = torch.linalg.svd(shape)
        rotations = rotations * torch.where(torch.linalg.det(rotations) < 0, -1.0, 1.0)[:, None, None]
        quats = Rotation.from_matrix(rotations.numpy()).as_quat(scalar_first=True)
        left, _, right = torch.linalg.svd(jacobian)
        polar = Rotation.from_matrix((left @ right).numpy())
        return replace(
            part,
            means=warp(points, strength).to(part.means),
            quats=torch.from_numpy(quats).to(part.quats),
            log_scales=scales.clamp_min(1e-12).log().to(part.log_scales),
            shN=part.shN + rotation_change(part.shN, torch.from_numpy(polar.as_quat(scalar_first=True))),
        )

    return AnalyticEdit(name, change)


def stretch_edit(factor: float, axis: Tensor, pivot: Tensor) -> AnalyticEdit:
    """Make an edit that stretches by `factor` along `axis` [3], away from the plane through `pivot` [3]."""
    unit = (axis / axis.norm()).double()
    root = pivot.double()

    def warp(points: Tensor, strength: float) -> Tensor:
        moved: Tensor = points + strength * (factor - 1) * ((points - root) @ unit)[:, None] * unit
        return moved

    return warp_edit("stretch", warp)


def bend_edit(degrees: float, axis: Tensor, along: Tensor, pivot: Tensor, length: float) -> AnalyticEdit:
    """Make an edit that bends about `axis` through `pivot`, by an angle that grows along `along`.

    Args:
        degrees: angle at strength 1 at the distance `length`
        axis: rotation axis. [3]
        along: direction in which the angle grows; points on the other side of the pivot stay fixed. [3]
        pivot: a point of the axis. [3]
        length: world units
    """
    turn = (axis / axis.norm()).double()
    out = (along / along.norm()).double()
    root = pivot.double()

    def warp(points: Tensor, strength: float) -> Tensor:
        arm = points - root
        angle = strength * math.radians(degrees) * ((arm @ out) / length).clamp_min(0)[:, None]
        across = torch.linalg.cross(turn.expand_as(arm), arm)
        axial = turn * (arm @ turn)[:, None] * (1 - angle.cos())
        moved: Tensor = root + arm * angle.cos() + across * angle.sin() + axial
        return moved

    return warp_edit("bend", warp)


def bear_edits(scene: DemoScene) -> dict[str, tuple[AnalyticEdit, Tensor]]:
    """Return one edit of each kind for `bear()`: name -> (edit, members)."""
    ears = scene.members("ears")
    roots = _ear_roots(scene.gaussians.means[ears])
    return {
        "gold": (
            recolor_edit(color.parse_color("#d89a12")),
            scene.members("body", "head", "ears", "arms", "legs"),
        ),
        "blue scarf": (recolor_edit(color.parse_color("#2356c7")), scene.members("scarf")),
        "stripes": (
            stripes_edit(color.parse_color("#2b62c9"), scene.up, 0.20),
            scene.members("body", "arms"),
        ),
        "big ears": (scale_edit(1.7, roots), ears),
        "tilted ears": (swing_edit(35.0, torch.tensor([1.0, 0.0, 0.0]), roots), ears),
        "long ears": (stretch_edit(1.8, scene.up, roots[0]), ears),
        "bent ears": (bend_edit(60.0, torch.tensor([1.0, 0.0, 0.0]), scene.up, roots[0], 0.3), ears),
        "night": (darken_edit(), torch.arange(len(scene.gaussians))),
    }


def robot_edits(scene: DemoScene) -> dict[str, tuple[AnalyticEdit, Tensor]]:
    """Return the edits of the capture `robot` by name: (edit, members)."""
    hand = scene.members("left hand")
    shoulder = scene.gaussians.means[scene.members("body")].mean(0, keepdim=True)
    return {
        "raised hand": (swing_edit(30.0, torch.tensor([0.0, 0.0, 1.0]), shoulder), hand),
        "fading hand": (fade_edit(), hand),
    }


def box_edits(scene: DemoScene) -> dict[str, tuple[AnalyticEdit, Tensor]]:
    """Return the edits of the capture `box` by name: (edit, members)."""
    letters = scene.members("letters")
    center = scene.gaussians.means[letters].mean(0, keepdim=True)
    return {"moved letters": (scale_edit(1.0, center, torch.tensor([0.0, -0.08, 0.0])), letters)}


FORMULAS: Mapping[str, Callable[[DemoScene], dict[str, tuple[AnalyticEdit, Tensor]]]] = {
    "bear": bear_edits,
    "robot": robot_edits,
    "box": box_edits,
}
"""Analytic edits by scene."""


def _ear_roots(means: Tensor) -> Tensor:
    """Return the points where the ears meet the head, below and inside each ear's center. [M,3] -> [2,3]"""
    roots = []
    for side in (1.0, -1.0):
        ear = means[means[:, 0] * side > 0]
        roots.append(ear.mean(0) - torch.tensor([0.09 * side, 0.11, 0.0]))
    return torch.stack(roots)


def _own_color(part: Gaussians) -> color.RegionColor:
    """Return the measured color, with Gaussians weighted by opacity and area."""
    _, middle, long = part.scales.sort(dim=1).values.unbind(1)
    return color.measure_color(sh0_to_rgb(part.sh0), part.opacities * middle * long)


def _nearest(means: Tensor, pivots: Tensor) -> Tensor:
    return pivots.to(means)[torch.cdist(means, pivots.to(means)).argmin(dim=1)]


def _with_color(part: Gaussians, rgb: Tensor, share: float | Tensor) -> Gaussians:
    """Set the color, and tint view-dependent light with its hue: the highlight on gold is golden."""
    hue = rgb.clamp_min(0) / rgb.clamp_min(0).mean(dim=1, keepdim=True).clamp_min(1e-3)
    highlight = part.shN.mean(dim=2, keepdim=True) * (0.35 + 0.65 * hue)[:, None, :]
    return replace(part, sh0=rgb_to_sh0(rgb), shN=part.shN + share * (highlight - part.shN))
