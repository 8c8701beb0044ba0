"""Fading of Gaussians so that pictures change linearly with the strength.

Opacities that change linearly do not fade a solid object evenly. Several Gaussians cover each pixel, so at
strength 0.5 they still hide nine tenths of the background. Two steps mend this:

1. A course per Gaussian. On one ray, let T be the transmittance of the fading Gaussians in front of one. The
   pixel is the linear mix of its two ends if the remaining share r of every opacity is

       r(s) = (1 − s) T_start / ((1 − s) T_start + s T_end)

   A Gaussian in front fades linearly. One that others hide is gone before these become transparent. One that
   appears behind a vanishing object is opaque from the beginning. T is measured in the view that shows the
   Gaussian best. Rays through the front and the back of an object remain uneven.
2. The visible change is measured in pictures along this path, and the strengths follow it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from scipy.interpolate import PchipInterpolator
from torch import Tensor

from progdf.camera import Camera, intrinsics, look_at
from progdf.field.baked import SliderRemap, identity_remap, interpolate_at
from progdf.field.separable import OPACITY_KNOTS
from progdf.gaussians import Gaussians
from progdf.rasterize.engines import ALPHA_MIN, alpha_weights, bare_weight, render
from progdf.scene.bounds import near_plane, scene_sphere
from progdf.threads import map_threads, stream_threads

_MIN_TRANSMITTANCE = 1e-3  # keeps the course of a hidden Gaussian finite
_PROBE_OPACITY = 1.5 * ALPHA_MIN  # opacity at which a Gaussian that appears is drawn, but hides little
_MEASURED_STEPS = 12  # steps along the path at which the visible change is measured
_PLACES = torch.linspace(0.0, 1.0, _MEASURED_STEPS + 1, dtype=torch.float64)
_PATH_KNOTS = torch.cat([OPACITY_KNOTS, _PLACES]).unique()  # type: ignore[no-untyped-call]
"""Knots of the path in its own time, from 0 to 1. [S] float64"""
_SAMPLES_PER_STEP = 4  # samples of the measured curve per step, for the piecewise linear remap
_MIN_PROGRESS = 0.02  # share of the path's own time in the new strengths, which keeps these ascending
_MEASURED_VIEWS = 6  # maximum number of views in which the visible change is measured
_MAX_GAUSSIANS = 5_000_000  # Gaussians drawn in all their pictures, if cameras are made: about a second
_AROUND_VIEWS = 12  # cameras around a group of Gaussians
_AROUND_PX = 128  # width and height of their pictures, pixels
_AROUND_DISTANCE = 3.0  # distance of these cameras from the center of the group, in its radii
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))  # angle between neighbors of a spiral over a sphere, radians


def fading_course(
    scene: Gaussians, rows: Tensor, end: Tensor, cameras: Sequence[Camera] = ()
) -> tuple[Tensor, Tensor]:
    """Return the logits of Gaussians that vanish or appear, so that pictures change linearly.

    Gaussians that appear are taken to be behind those that vanish, as where a hole is filled.

    Args:
        scene: all Gaussians at strength 0
        rows: the fading ones, distinct. [M] int64
        end: their logits at strength 1. [M]
        cameras: views that measure, with the whole scene in their pictures; without them, cameras on a sphere
            around the fading Gaussians see these alone

    Returns:
        Knots [S], strengths from 0 to 1, and the offset of each logit at them [S,M], exact at both ends.
    """
    group = scene[rows]
    start_logits = group.logit_opacities.double()
    end_logits = end.double()
    views = list(cameras) or cameras_around(
        replace(group, logit_opacities=group.logit_opacities.maximum(end))
    )
    at_start, at_end = _transmittances(group, end, views)
    before = (1.0 - _PATH_KNOTS[:, None]) * at_start.double()
    remaining = before / (before + _PATH_KNOTS[:, None] * at_end.double())
    opacities = torch.lerp(end_logits.sigmoid(), start_logits.sigmoid(), remaining)
    logits = opacities.logit().float()
    logits[0] = group.logit_opacities
    logits[-1] = end
    drawn = group
    drawn_rows = torch.arange(len(group))
    count = min(_MEASURED_VIEWS, max(2, _MAX_GAUSSIANS // (_MEASURED_STEPS * len(group))))
    if cameras:
        drawn = scene
        drawn_rows = rows
        count = _MEASURED_VIEWS
    measured = views[:: max(1, len(views) // count)][:count]

    def picture_at(place: float) -> Tensor:
        now = interpolate_at(_PATH_KNOTS, logits, place)
        opacity = drawn.logit_opacities.index_copy(0, drawn_rows, now)
        return _draw(replace(drawn, logit_opacities=opacity), measured)

    knots = linear_remap(picture_at)(_PATH_KNOTS).float()
    offsets = logits - group.logit_opacities
    offsets[0] = 0.0
    offsets[-1] = end.float() - group.logit_opacities
    return knots, offsets


def linear_remap(seen: Callable[[float], Tensor]) -> SliderRemap:
    """Return the remap under which the visible change is linear in the strength.

    The visible change is the mean absolute difference from the picture at 0, as a share of that at 1.

    Args:
        seen: position on the path, 0 to 1 -> pixels of any fixed shape
    """
    first = seen(0.0)
    distances = torch.tensor([float((seen(float(at)) - first).abs().mean()) for at in _PLACES[1:]])
    if not float(distances[-1]) > 0.0:
        return identity_remap()
    shares = (distances.double() / float(distances[-1])).clamp(0.0, 1.0)
    visible = torch.cat([shares.new_zeros(1), shares]).cummax(dim=0).values
    fine = torch.linspace(0.0, 1.0, _SAMPLES_PER_STEP * _MEASURED_STEPS + 1, dtype=torch.float64)
    curve = torch.from_numpy(PchipInterpolator(_PLACES.numpy(), visible.numpy())(fine.numpy()))
    curve[0] = 0.0
    curve[-1] = 1.0
    return SliderRemap(fine, torch.lerp(curve.clamp(0.0, 1.0), fine, _MIN_PROGRESS))


def cameras_around(group: Gaussians) -> list[Camera]:
    """Return cameras on a sphere around some Gaussians, above and below, at which they look."""
    center, radius = scene_sphere(group)
    radius += float(group.scales.amax(dim=1).median())
    K = intrinsics(2.0 * math.asin(1.0 / _AROUND_DISTANCE), _AROUND_PX, _AROUND_PX)
    near = near_plane(radius)
    cameras = []
    for i in range(_AROUND_VIEWS):
        height = (2 * i + 1) / _AROUND_VIEWS - 1.0
        level = math.sqrt(1.0 - height * height)
        angle = i * _GOLDEN_ANGLE
        direction = torch.tensor([level * math.cos(angle), height, level * math.sin(angle)])
        viewmat = look_at(
            center + _AROUND_DISTANCE * radius * direction, center, torch.tensor([0.0, 1.0, 0.0])
        )
        cameras.append(Camera(viewmat, K, _AROUND_PX, _AROUND_PX, near=near))
    return cameras


def front_transmittance(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """Return the mean transmittance in front of each Gaussian, in the view that shows it best. [N] 0 to 1

    It is 1 for a Gaussian that no view draws.
    """
    bare = bare_weight(gaussians.opacities)
    best = torch.full((len(gaussians),), -1.0)

    def look(camera: Camera) -> Tensor:
        weights = alpha_weights(gaussians, camera, torch.ones(camera.height, camera.width))
        mean = (weights[:, 2] / weights[:, 3].clamp_min(1.0)).float()
        return torch.where(weights[:, 3] > 0, mean / bare, -1.0)

    for transmittance in stream_threads(look, cameras):
        best = torch.maximum(best, transmittance)
    return torch.where(best < 0.0, 1.0, best).clamp(_MIN_TRANSMITTANCE, 1.0)


def _transmittances(group: Gaussians, end: Tensor, cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """Return the transmittance in front of each fading Gaussian at strength 0 and at strength 1. [M] each"""
    appears = end > group.logit_opacities
    vanishing = (~appears).nonzero()[:, 0]
    appearing = appears.nonzero()[:, 0]
    at_start = torch.ones(len(group))
    at_end = torch.ones(len(group))
    if len(vanishing):
        at_start[vanishing] = front_transmittance(group[vanishing], cameras)
    if len(appearing):
        shown = replace(group[appearing], logit_opacities=end[appearing])
        at_end[appearing] = front_transmittance(shown, cameras)
    if len(vanishing) and len(appearing):
        probe = math.log(_PROBE_OPACITY / (1.0 - _PROBE_OPACITY))
        probed = replace(
            group, logit_opacities=torch.where(appears, torch.tensor(probe), group.logit_opacities)
        )
        at_start[appearing] = front_transmittance(probed, cameras)[appearing]
    return at_start, at_end


def _draw(gaussians: Gaussians, cameras: Sequence[Camera]) -> Tensor:
    """Return the pixels of all views, on black and on white. [P]"""

    def draw(camera: Camera) -> Tensor:
        with torch.no_grad():
            drawn = render(gaussians, camera, (0.0, 0.0, 0.0))
        on_black = drawn.image.clamp(0.0, 1.0)
        on_white = (drawn.image + drawn.transmittance[..., None]).clamp(0.0, 1.0)
        return torch.cat([on_black.flatten(), on_white.flatten()])

    return torch.cat(map_threads(draw, cameras))
