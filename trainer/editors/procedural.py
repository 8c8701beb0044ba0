"""Editors made of a colour function: exact, the same in every view, and with a dial of their own.

They edit the region's own colour, unmixed from what shares a pixel with it, and mix it back (see
`View.blended`): soft edges keep the right share of either side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from progdf import colour
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.rasterize import rasterize
from progdf.region import Region
from progdf.sh import shade
from trainer.editors.base import EditKind, EditorSettings
from trainer.views import View

_GREY, _COLOURED = 0.5, 1.3  # of the typical chroma: up to here a grey, from here a colour
_COVER = 0.75  # of the old contrast is lost under a stripe
_STRIPES = 7  # across the longest side of the region


@dataclass(frozen=True)
class ColourEditor:
    """A function of colour and strength, applied to each pixel's share of the region."""

    change: Callable[[Tensor, float], Tensor]
    kind: EditKind = "colour"
    stages: tuple[float, ...] = ()
    confined: bool = True

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        shown = view.mask > 0
        inside = view.inside.clone()
        inside[shown] = self.change(view.inside[shown], strength)
        return view.blended(inside)


@dataclass(frozen=True)
class StripesEditor:
    """A pattern painted on the Gaussians themselves and rendered: the same stripes from everywhere.

    Args:
        scene: the original
        members: rows of the region. [M] int64
        pattern: how much of each member is stripe, 0..1. [M]
        target: colour of the stripes, sRGB 0..1. [3]
        reference: typical colour of the region. [3]
    """

    scene: Gaussians
    members: Tensor
    pattern: Tensor
    target: Tensor
    reference: Tensor
    kind: EditKind = "colour"
    stages: tuple[float, ...] = ()
    confined: bool = True

    def painted(self, rgb: Tensor, strength: float) -> Tensor:
        """The members' colours [M,3] under the paint, which takes most of the old texture's contrast away."""
        covered = strength * self.pattern
        plainer = torch.lerp(rgb, self.reference.expand_as(rgb), (_COVER * covered)[:, None])
        return recolored(plainer, self.target, covered, self.reference)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        scene, members, camera = self.scene, self.members, view.camera
        directions = torch.nn.functional.normalize(scene.means[members] - camera.position, dim=1)
        before = shade(min(scene.sh_degree, 3), directions, scene.sh[members])
        painted = self.painted(before, strength)
        colors = torch.zeros(len(scene), 3).index_copy(0, members, painted)
        with torch.no_grad():
            premultiplied, _, _ = rasterize(
                scene.means,
                scene.quats,
                scene.scales,
                scene.opacities,
                colors,
                camera.viewmat,
                camera.K,
                camera.width,
                camera.height,
                background=torch.zeros(3),
            )
        return view.blended((premultiplied / view.mask.clamp_min(1e-4)[..., None]).clamp(0.0, 1.0))


def recolor(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> ColourEditor:
    """`recolor:#rrggbb`: another colour, the shading kept; hue, saturation and lightness move together."""
    target, reference = colour.parse_color(what), reference_color(views)
    return ColourEditor(lambda rgb, strength: recolored(rgb, target, strength, reference))


def tint(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> ColourEditor:
    """`tint:#rrggbb`: a wash of colour, lightness kept."""
    target = colour.parse_color(what)
    return ColourEditor(lambda rgb, strength: colour.tint(rgb, target, strength))


def darken(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> ColourEditor:
    """`darken:AMOUNT`: that share of the light is taken away, 0..1, by default 0.875 (three stops)."""
    stops = _stops(what, "darken")
    return ColourEditor(lambda rgb, strength: colour.darken(rgb, strength, stops))


def night(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> ColourEditor:
    """`night` or `night:AMOUNT`: as `darken`, with colours fading to the blue of moonlight."""
    stops = _stops(what, "night")
    return ColourEditor(lambda rgb, strength: colour.night(rgb, strength, stops))


def stripes(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> StripesEditor:
    """`stripes:#rrggbb`: seven stripes across the region's longest side, painted in 3D."""
    target = colour.parse_color(what)
    points = scene.means[region.members]
    axis, period, phase = stripe_frame(points)
    pattern = colour.stripe_pattern(points, axis, period, phase)
    return StripesEditor(scene, region.members, pattern, target, reference_color(views))


def stripe_frame(points: Tensor) -> tuple[Tensor, float, float]:
    """World axis along which points [M,3] spread most, [3]; period of seven stripes; phase."""
    low, high = (torch.quantile(points[:: max(1, len(points) // 100_000)], q, dim=0) for q in (0.01, 0.99))
    longest = int((high - low).argmax())
    axis = torch.zeros(3)
    axis[longest] = 1.0
    period = max(float(high[longest] - low[longest]) / _STRIPES, 1e-6)
    return axis, period, 0.5 - float(low[longest]) / period


def recolored(rgb: Tensor, target: Tensor, strength: float | Tensor, reference: Tensor) -> Tensor:
    """`colour.recolor` with calm greys on the way.

    The hue of what is coloured turns; but a grey's hue is noise, and turned it shines in every colour of the
    rainbow half way. So what has less chroma than the region's typical colour goes straight to its end.

    Args:
        rgb: sRGB colours. [...,3]
        target: what `reference` becomes. [3]
        strength: 0..1, one number or [...]
        reference: the region's typical colour. [3]
    """
    s = torch.as_tensor(strength, dtype=rgb.dtype).expand(rgb.shape[:-1])
    turned = colour.recolor(rgb, target, s, reference)
    lab = colour.srgb_to_oklab(rgb.clamp(0, 1))
    finished = colour.srgb_to_oklab(colour.recolor(rgb, target, 1.0, reference))
    straight = colour.oklab_to_srgb(torch.lerp(lab, finished, s[..., None])).clamp(0, 1)
    typical = float(colour.srgb_to_oklab(reference)[1:].norm())
    share = (lab[..., 1:].norm(dim=-1) / max(typical, 1e-3) - _GREY) / (_COLOURED - _GREY)
    share = torch.where((s == 0) | (s == 1), 1.0, share.clamp(0, 1))
    return torch.lerp(straight, turned, (share * share * (3 - 2 * share))[..., None])


def reference_color(views: Sequence[View]) -> Tensor:
    """The region's typical colour over all views, so that each view's edit is the same function. [3]"""
    inside = torch.cat([view.inside.reshape(-1, 3) for view in views])
    weights = torch.cat([view.mask.reshape(-1) for view in views])
    return colour.typical_color(inside, weights)


def _stops(what: str, editor: str) -> float:
    try:
        amount = float(what) if what else 0.875
    except ValueError:
        amount = math.nan
    if not 0.0 < amount < 1.0:
        raise ProgdfError(
            f"{editor}:{what} is no share of the light; write a number between 0 and 1, as {editor}:0.7"
        )
    return -math.log2(1.0 - amount)
