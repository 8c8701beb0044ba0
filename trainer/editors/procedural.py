"""Editors made of a color function: exact, the same in every view, at any strength.

They edit the region's own color, unmixed from what shares a pixel with it, and mix it back (see
`View.blend`): soft edges keep the right share of either side.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from progdf.color import edits as color
from progdf.color.oklab import ColorPath, bend_of, interpolate_colors, path_of
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from trainer.options import EditKind
from trainer.views.view import BACKGROUND, View, region_box, render_colors, render_view, seen_colors

from .base import EditorInput, ImageEditor

_COVER = 0.75  # of the old contrast is lost under a stripe
_STRIPES = 7  # across the longest side of the region


class ProceduralEditor(ABC):
    """An `ImageEditor` of colors, at any strength."""

    kind: EditKind = "color"
    stages: tuple[float, ...] = ()
    is_confined = True

    @abstractmethod
    def course(self, view: View) -> Callable[[float], Tensor]:
        """`edit` of one view at many strengths, which share most of the work."""

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        return self.course(view)(strength)


@dataclass(frozen=True)
class ColorEditor(ProceduralEditor):
    """A function of color and strength, applied to each pixel's share of the region."""

    change: Callable[[Tensor], color.Course]

    def course(self, view: View) -> Callable[[float], Tensor]:
        """See `ProceduralEditor`."""
        visible = view.mask > 0
        change = self.change(view.inside[visible])

        def edit(strength: float) -> Tensor:
            inside = view.inside.clone()
            inside[visible] = change(strength)
            return view.blend(inside)

        return edit


@dataclass(frozen=True)
class StripesEditor(ProceduralEditor):
    """A pattern painted on the Gaussians themselves and rendered: the same stripes from everywhere."""

    scene: Gaussians  # the original
    members: Tensor  # rows of the region. [M] int64
    pattern: Tensor  # how much of each member is stripe, 0..1. [M]
    target: Tensor  # color of the stripes, sRGB 0..1. [3]
    typical: Tensor  # color of the region, sRGB 0..1. [3]
    path: ColorPath = "bowed"  # see `bend_of`

    def paint(self, rgb: Tensor) -> color.Course:
        """The members' colors [M,3] under the paint, which takes most of the old texture's contrast away."""
        plainer = torch.lerp(rgb, self.typical.expand_as(rgb), (_COVER * self.pattern)[:, None])
        under = color.recolor_fully(plainer, self.target, self.typical)
        bend = bend_of(self.typical, self.target, self.path)
        return lambda strength: interpolate_colors(rgb, under, strength * self.pattern, bend)

    def course(self, view: View) -> Callable[[float], Tensor]:
        """See `ProceduralEditor`; rendered where the region shows."""
        scene = self.scene
        members = self.members
        camera = view.camera
        paint = self.paint(seen_colors(scene[members], camera))
        x0, y0, x1, y1 = box = region_box(view.mask, 0, 0.0)

        def edit(strength: float) -> Tensor:
            if strength == 0.0:
                return view.image
            colors = torch.zeros(len(scene), 3)
            inside = view.inside.clone()
            colors[members] = paint(strength)
            drawn = render_colors(scene, colors, camera, torch.zeros(3), box)
            share = view.mask[y0:y1, x0:x1, None].clamp_min(1e-4)
            inside[y0:y1, x0:x1] = (drawn / share).clamp(0.0, 1.0)
            return view.blend(inside)

        return edit


@dataclass(frozen=True)
class RemoveEditor(ProceduralEditor):
    """Opacity of the region falls to nothing, and what is behind appears; holes are not closed."""

    scene: Gaussians  # the original
    members: Tensor  # rows of the region. [M] int64
    background: Tensor  # rgb. [3]
    kind = "geometry"

    def course(self, view: View) -> Callable[[float], Tensor]:
        """See `ProceduralEditor`."""

        def edit(strength: float) -> Tensor:
            if strength == 0.0:
                return view.image
            opacities = self.scene.opacities
            opacities[self.members] *= 1.0 - strength
            faded = replace(self.scene, logit_opacities=opacities.logit())
            return render_view(faded, view.camera, self.background).clamp(0.0, 1.0)

        return edit


def edit_course(editor: ImageEditor, view: View) -> Callable[[float], Tensor]:
    """`editor.edit` of one view at many strengths."""
    return editor.course(view) if isinstance(editor, ProceduralEditor) else partial(editor.edit, view)


def recolor(given: EditorInput) -> ColorEditor:
    """`recolor:#rrggbb[,path=hue]`: another color, the shading kept."""
    (target, path), typical = paint_of(given.what), region_color(given)
    return ColorEditor(lambda rgb: color.recolor_course(rgb, target, typical, path))


def tint(given: EditorInput) -> ColorEditor:
    """`tint:#rrggbb[,path=hue]`: a wash of color, lightness kept."""
    (target, path), typical = paint_of(given.what), region_color(given)
    return ColorEditor(lambda rgb: color.tint_course(rgb, target, typical, path))


def darken(given: EditorInput) -> ColorEditor:
    """`darken:AMOUNT`: that share of the light is taken away, 0..1, by default 0.875 (three stops)."""
    stops = stops_of(given.what, "darken")
    return ColorEditor(lambda rgb: partial(color.darken, rgb, stops=stops))


def night(given: EditorInput) -> ColorEditor:
    """`night` or `night:AMOUNT`: as `darken`, with colors fading to the blue of moonlight."""
    stops = stops_of(given.what, "night")
    return ColorEditor(lambda rgb: color.night_course(rgb, stops))


def grade(given: EditorInput) -> ColorEditor:
    """`grade:exposure=0.5,#8a5a2b=#2b5a8a,curve=0.3:0.2`: what a hand does to colors, see `parse_grade`."""
    asked = color.parse_grade(given.what)
    return ColorEditor(lambda rgb: color.grade_course(rgb, asked))


def stripes(given: EditorInput) -> StripesEditor:
    """`stripes:#rrggbb[,path=hue]`: seven stripes across the region's longest side, painted in 3D."""
    target, path = paint_of(given.what)
    members = given.region.members
    points = given.scene.means[members]
    axis, period, phase = stripe_frame(points)
    pattern = color.stripe_pattern(points, axis, period, phase)
    return StripesEditor(given.scene, members, pattern, target, region_color(given), path)


def remove(given: EditorInput) -> RemoveEditor:
    """`remove` or `remove:A.png`: the region is taken away."""
    return RemoveEditor(given.scene, given.region.members, torch.tensor(BACKGROUND))


def stripe_frame(points: Tensor) -> tuple[Tensor, float, float]:
    """World axis along which points [M,3] spread most, [3]; period of seven stripes; phase."""
    low, high = (torch.quantile(points[:: max(1, len(points) // 100_000)], q, dim=0) for q in (0.01, 0.99))
    longest = int((high - low).argmax())
    axis = torch.zeros(3)
    axis[longest] = 1.0
    period = max(float(high[longest] - low[longest]) / _STRIPES, 1e-6)
    return axis, period, 0.5 - float(low[longest]) / period


def region_color(given: EditorInput) -> Tensor:
    """The region's typical color: an edit is one function of color, whichever views it is asked in. [3]"""
    pairs = [(seen, seen.mask > 0.0) for seen in given.glances() or given.views]
    return color.typical_color(
        torch.cat([seen.inside[shown] for seen, shown in pairs]),
        torch.cat([seen.mask[shown] for seen, shown in pairs]),
    )


def paint_of(what: str) -> tuple[Tensor, ColorPath]:
    """The color [3] and the way to it that `#rrggbb` or `#rrggbb,path=hue` says; else a ProgdfError."""
    text, comma, option = what.partition(",")
    target = color.parse_color(text)
    if not comma:
        return target, "bowed"
    key, _, name = option.partition("=")
    if key.strip() != "path":
        raise ProgdfError(f"'{option}' is not an option of a color; write {text},path=hue or {text} alone")
    return target, path_of(name.strip())


def stops_of(what: str, editor: str) -> float:
    """How many stops darker `what`, a share of the light, is; ProgdfError where it is none."""
    amount = color.number_of(what) if what else 0.875
    if not 0.0 < amount < 1.0:
        raise ProgdfError(
            f"{editor}:{what} is not a number between 0 and 1; write, for example, {editor}:0.7"
        )
    return -math.log2(1.0 - amount)
