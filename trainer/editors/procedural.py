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
from progdf.region import Region
from trainer.editors.base import EditKind, EditorSettings
from trainer.views import View, drawn, seen_colors

_GREY, _COLOURED = 0.5, 1.1  # of the chroma of what is coloured: up to here a grey, from here a colour
_PALE, _COLOURFUL = 0.03, 0.06  # chroma of what is coloured: up to here the whole region is a grey
_KIN, _OTHER = math.radians(50), math.radians(100)  # from the region's hue: its kin up to here; another
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
        palette: of the region
    """

    scene: Gaussians
    members: Tensor
    pattern: Tensor
    target: Tensor
    palette: Palette
    kind: EditKind = "colour"
    stages: tuple[float, ...] = ()
    confined: bool = True

    def painted(self, rgb: Tensor, strength: float) -> Tensor:
        """The members' colours [M,3] under the paint, which takes most of the old texture's contrast away."""
        covered = strength * self.pattern
        plainer = torch.lerp(rgb, self.palette.typical.expand_as(rgb), (_COVER * covered)[:, None])
        return recolored(plainer, self.target, covered, self.palette)

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        if strength == 0.0:
            return view.image
        scene, members, camera = self.scene, self.members, view.camera
        painted = self.painted(seen_colors(scene[members], camera), strength)
        colors = torch.zeros(len(scene), 3).index_copy(0, members, painted)
        premultiplied = drawn(scene, colors, camera, torch.zeros(3))
        return view.blended((premultiplied / view.mask.clamp_min(1e-4)[..., None]).clamp(0.0, 1.0))


def recolor(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> ColourEditor:
    """`recolor:#rrggbb`: another colour, the shading kept; hue, saturation and lightness move together."""
    target, palette = colour.parse_color(what), region_palette(views)
    return ColourEditor(lambda rgb, strength: recolored(rgb, target, strength, palette))


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
    stops = stops_of(what, "darken")
    return ColourEditor(lambda rgb, strength: colour.darken(rgb, strength, stops))


def night(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> ColourEditor:
    """`night` or `night:AMOUNT`: as `darken`, with colours fading to the blue of moonlight."""
    stops = stops_of(what, "night")
    return ColourEditor(lambda rgb, strength: colour.night(rgb, strength, stops))


def stripes(
    what: str, scene: Gaussians, region: Region, views: Sequence[View], settings: EditorSettings
) -> StripesEditor:
    """`stripes:#rrggbb`: seven stripes across the region's longest side, painted in 3D."""
    target = colour.parse_color(what)
    points = scene.means[region.members]
    axis, period, phase = stripe_frame(points)
    pattern = colour.stripe_pattern(points, axis, period, phase)
    return StripesEditor(scene, region.members, pattern, target, region_palette(views))


def stripe_frame(points: Tensor) -> tuple[Tensor, float, float]:
    """World axis along which points [M,3] spread most, [3]; period of seven stripes; phase."""
    low, high = (torch.quantile(points[:: max(1, len(points) // 100_000)], q, dim=0) for q in (0.01, 0.99))
    longest = int((high - low).argmax())
    axis = torch.zeros(3)
    axis[longest] = 1.0
    period = max(float(high[longest] - low[longest]) / _STRIPES, 1e-6)
    return axis, period, 0.5 - float(low[longest]) / period


@dataclass(frozen=True)
class Palette:
    """What a region's colours are like, the same for all views, so that each view's edit is one function.

    Args:
        typical: the mean colour, see `colour.typical_color`. [3]
        chroma: how colourful what is coloured is, OKLab; white and black beside it do not lower it
    """

    typical: Tensor
    chroma: float


def palette_of(rgb: Tensor, weights: Tensor) -> Palette:
    """Of sRGB colours [Q,3] that count by `weights` [Q]."""
    chroma = colour.srgb_to_oklab(rgb.clamp(0, 1))[:, 1:].norm(dim=1)
    by_colour = float((weights * chroma.square()).sum() / (weights * chroma).sum().clamp_min(1e-12))
    return Palette(colour.typical_color(rgb, weights), by_colour)


def region_palette(views: Sequence[View]) -> Palette:
    """The region's, over all views."""
    return palette_of(
        torch.cat([view.inside.reshape(-1, 3) for view in views]),
        torch.cat([view.mask.reshape(-1) for view in views]),
    )


def recolored(rgb: Tensor, target: Tensor, strength: float | Tensor, palette: Palette) -> Tensor:
    """`colour.recolor`, in which the hue turns only of what the region's colour is seen in.

    The rest goes straight to its end in OKLab. A grey's hue is noise, and turned it shines in every colour of
    the rainbow half way. A hue far from the region's own has its own way to go, short or long, and next to
    one that is opposite, neighbours would go round either side: the robot's eyes, cyan in an orange region,
    went once round the circle to become blue. And in a region that is pale all over, the hues of its greys
    would shine half way as green and pink where it was never green nor pink.

    Args:
        rgb: sRGB colours. [...,3]
        target: what the palette's typical colour becomes. [3]
        strength: 0..1, one number or [...]
        palette: of the region
    """
    s = torch.as_tensor(strength, dtype=rgb.dtype).expand(rgb.shape[:-1])
    turned = colour.recolor(rgb, target, s, palette.typical)
    lab = colour.srgb_to_oklab(rgb.clamp(0, 1))
    finished = colour.srgb_to_oklab(colour.recolor(rgb, target, 1.0, palette.typical))
    straight = colour.oklab_to_srgb(torch.lerp(lab, finished, s[..., None])).clamp(0, 1)
    own = colour.srgb_to_oklab(palette.typical)[1:]
    across, along = lab[..., 1] * own[1] - lab[..., 2] * own[0], lab[..., 1:] @ own
    coloured = lab[..., 1:].norm(dim=-1) / max(palette.chroma, 1e-3)
    pale = 1 - _rise(torch.tensor(palette.chroma), _PALE, _COLOURFUL)
    share = (
        (1 - pale)
        * _rise(coloured, _GREY, _COLOURED)
        * (1 - _rise(torch.atan2(across, along).abs(), _KIN, _OTHER))
    )
    share = torch.where((s == 0) | (s == 1), 1.0, share)
    return torch.lerp(straight, turned, share[..., None])


def _rise(values: Tensor, low: float, high: float) -> Tensor:
    """0 up to `low`, 1 from `high`, smooth between."""
    x = ((values - low) / (high - low)).clamp(0, 1)
    return x * x * (3 - 2 * x)


def stops_of(what: str, editor: str) -> float:
    """How many stops darker `what`, a share of the light, is; ProgdfError where it is none."""
    try:
        amount = float(what) if what else 0.875
    except ValueError:
        amount = math.nan
    if not 0.0 < amount < 1.0:
        raise ProgdfError(
            f"{editor}:{what} is no share of the light; write a number between 0 and 1, as {editor}:0.7"
        )
    return -math.log2(1.0 - amount)
