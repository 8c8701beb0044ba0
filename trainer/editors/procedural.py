"""Editors that apply a color function: exact, the same in every view, at any strength.

They separate the region's color from the rest of each pixel, edit it, and blend it back (see `View.blend`).
Soft edges therefore keep the right share of both sides.
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
from progdf.color.clarity import local_detail
from progdf.color.grade import ColorGrade, grade_course, measure_grade, parse_grade
from progdf.color.oklab import ColorPath, bend_of, interpolate_colors, oklab_to_srgb, path_of
from progdf.errors import ProgdfError
from progdf.gaussians import Gaussians
from progdf.system.equality import equal_fields
from trainer.options import EditKind
from trainer.views.view import BACKGROUND, View, region_box, render_colors, render_view, seen_colors

from .base import EditorInput, ImageEditor

_STRIPE_COVERAGE = 0.75  # share of the original contrast that is lost under a stripe
_STRIPE_COUNT = 7  # stripes across the longest side of the region


class ProceduralEditor(ABC):
    """Base of editors that work at any strength."""

    kind: EditKind = "color"
    stages: tuple[float, ...] = ()
    is_confined = True

    @abstractmethod
    def course(self, view: View) -> Callable[[float], Tensor]:
        """Return a function from strength to edited view. Most of the work is shared between strengths."""

    def edit(self, view: View, strength: float) -> Tensor:
        """See `ImageEditor.edit`."""
        return self.course(view)(strength)


@dataclass(frozen=True)
class ColorEditor(ProceduralEditor):
    """Editor that applies a function of color and strength to the region's share of each pixel."""

    # maps the region's colors [P,3] to a function from strength to edited colors [P,3]
    change: Callable[[Tensor], color.ColorFunction]

    def course(self, view: View) -> Callable[[float], Tensor]:
        """See `ProceduralEditor.course`."""
        visible = view.mask > 0
        change = self.change(view.inside[visible])

        def edit(strength: float) -> Tensor:
            inside = view.inside.clone()
            inside[visible] = change(strength)
            return view.blend(inside)

        return edit


@dataclass(frozen=True)
class MemberEditor(ProceduralEditor):
    """Editor that changes the Gaussians' colors and renders them, so that all views show the same change."""

    __eq__ = equal_fields

    scene: Gaussians  # the original
    members: Tensor  # rows of the region. [M] int64

    @abstractmethod
    def paint(self, rgb: Tensor) -> color.ColorFunction:
        """Return the members' colors [M,3] by strength, from those that a view shows. [M,3]"""

    def course(self, view: View) -> Callable[[float], Tensor]:
        """See `ProceduralEditor.course`. Only the region's box is rendered."""
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
class ClarityEditor(MemberEditor):
    """Editor of a grade with clarity, which depends on the surroundings of each Gaussian."""

    __eq__ = equal_fields

    grade: ColorGrade
    detail: Tensor  # see `local_detail`. [M]

    def paint(self, rgb: Tensor) -> color.ColorFunction:
        """See `MemberEditor.paint`."""
        return grade_course(rgb, self.grade, self.detail)


@dataclass(frozen=True)
class StripesEditor(MemberEditor):
    """Editor that paints a pattern on the Gaussians: the same stripes in every view."""

    __eq__ = equal_fields

    pattern: Tensor  # stripe coverage of each member, 0..1. [M]
    target: Tensor  # stripe color, sRGB 0..1. [3]
    source: color.RegionColor  # measured color of the region
    path: ColorPath = "bowed"  # see `bend_of`

    def paint(self, rgb: Tensor) -> color.ColorFunction:
        """Return the members' colors [M,3] by strength.

        The paint removes most of the original texture's contrast.
        """
        typical = self.source.color
        flattened = torch.lerp(rgb, typical.expand_as(rgb), (_STRIPE_COVERAGE * self.pattern)[:, None])
        painted = color.recolor_fully(flattened, self.target, self.source)
        bend = bend_of(typical, self.target, self.path)
        return lambda strength: interpolate_colors(rgb, painted, strength * self.pattern, bend)


@dataclass(frozen=True)
class RemoveEditor(ProceduralEditor):
    """Editor that fades the region's opacity to 0 and reveals the content behind it. Holes are not filled."""

    __eq__ = equal_fields

    scene: Gaussians  # the original
    members: Tensor  # rows of the region. [M] int64
    background: Tensor  # rgb. [3]
    kind = "geometry"

    def course(self, view: View) -> Callable[[float], Tensor]:
        """See `ProceduralEditor.course`."""

        def edit(strength: float) -> Tensor:
            if strength == 0.0:
                return view.image
            opacities = self.scene.opacities
            opacities[self.members] *= 1.0 - strength
            faded = replace(self.scene, logit_opacities=opacities.logit())
            return render_view(faded, view.camera, self.background).clamp(0.0, 1.0)

        return edit


def edit_course(editor: ImageEditor, view: View) -> Callable[[float], Tensor]:
    """Return a function from strength to `editor.edit` of one view."""
    return editor.course(view) if isinstance(editor, ProceduralEditor) else partial(editor.edit, view)


def recolor(given: EditorInput) -> ColorEditor:
    """Return the editor of `recolor:#rrggbb[,path=hue]`: another color with the same shading."""
    target, path = paint_of(given.what)
    source = region_color(given)
    return ColorEditor(lambda rgb: color.recolor_course(rgb, target, source, path))


def tint(given: EditorInput) -> ColorEditor:
    """Return the editor of `tint:#rrggbb[,path=hue]`: a wash of color that keeps lightness where sRGB can."""
    target, path = paint_of(given.what)
    source = region_color(given)
    return ColorEditor(lambda rgb: color.tint_course(rgb, target, source, path))


def darken(given: EditorInput) -> ColorEditor:
    """Return the editor of `darken:AMOUNT`.

    AMOUNT is the share of light to remove, 0..1, by default 0.875 (three stops).
    """
    stops = stops_of(given.what, "darken")
    return ColorEditor(lambda rgb: partial(color.darken, rgb, stops=stops))


def night(given: EditorInput) -> ColorEditor:
    """Return the editor of `night` or `night:AMOUNT`: `darken` with a fade to the blue of moonlight."""
    stops = stops_of(given.what, "night")
    return ColorEditor(lambda rgb: color.night_course(rgb, stops))


def grade(given: EditorInput) -> ProceduralEditor:
    """Return the editor of `grade:exposure=0.5,#8a5a2b=#2b5a8a,curve=0.3:0.2` (see `parse_grade`)."""
    requested = parse_grade(given.what)
    if requested.palette:
        requested = measure_grade(requested, *region_samples(given))
        found = zip(requested.palette, requested.palette_shadings, requested.palette_shades, strict=True)
        for (source, _), shading, shades in found:
            line = f"{color.hex_color(source.tolist())} in the region: {shading.describe()}"
            if len(shades):
                names = [color.hex_color(shade.tolist()) for shade in oklab_to_srgb(shades)]
                line = f"{line}; shades of the same surface move with it: {', '.join(names)}"
            given.say(line)
    if requested.clarity:
        members = given.region.members
        return ClarityEditor(given.scene, members, requested, local_detail(given.scene, members))
    return ColorEditor(lambda rgb: grade_course(rgb, requested))


def stripes(given: EditorInput) -> StripesEditor:
    """Return the editor of `stripes:#rrggbb[,path=hue]`: seven stripes in 3D across the longest side."""
    target, path = paint_of(given.what)
    members = given.region.members
    points = given.scene.means[members]
    axis, period, phase = stripe_frame(points)
    pattern = color.stripe_pattern(points, axis, period, phase)
    return StripesEditor(given.scene, members, pattern, target, region_color(given), path)


def remove(given: EditorInput) -> RemoveEditor:
    """Return the editor of `remove` or `remove:A.png`, which removes the region."""
    return RemoveEditor(given.scene, given.region.members, torch.tensor(BACKGROUND))


def stripe_frame(points: Tensor) -> tuple[Tensor, float, float]:
    """Return the layout of seven stripes across points [M,3].

    Returns:
        unit vector of the world axis along which the points spread most [3]; length of one period, world
        units; phase, in periods
    """
    sample = points[:: max(1, len(points) // 100_000)]
    low = torch.quantile(sample, 0.01, dim=0)
    high = torch.quantile(sample, 0.99, dim=0)
    longest = int((high - low).argmax())
    axis = torch.zeros(3)
    axis[longest] = 1.0
    period = max(float(high[longest] - low[longest]) / _STRIPE_COUNT, 1e-6)
    return axis, period, 0.5 - float(low[longest]) / period


def region_color(given: EditorInput) -> color.RegionColor:
    """Return the region's measured color, and log it.

    It does not depend on the edited view, so that the edit is one function of color in all views.
    """
    measured = color.measure_color(*region_samples(given))
    given.say(f"region: {measured.describe()}")
    return measured


def region_samples(given: EditorInput) -> tuple[Tensor, Tensor]:
    """Return the colors of the region's pixels, and the region's share of each pixel, 0 to 1. [N,3], [N]"""
    pairs = [(sample, sample.mask > 0.0) for sample in given.glances() or given.views]
    return (
        torch.cat([sample.inside[visible] for sample, visible in pairs]),
        torch.cat([sample.mask[visible] for sample, visible in pairs]),
    )


def paint_of(what: str) -> tuple[Tensor, ColorPath]:
    """Parse `#rrggbb` or `#rrggbb,path=hue` to a color [3] and its color path.

    Raises:
        ProgdfError: the color or the path is invalid.
    """
    text, comma, option = what.partition(",")
    target = color.parse_color(text)
    if not comma:
        return target, "bowed"
    key, _, name = option.partition("=")
    if key.strip() != "path":
        raise ProgdfError(f"'{option}' is not an option of a color; write {text},path=hue or {text} alone")
    return target, path_of(name.strip())


def stops_of(what: str, editor: str) -> float:
    """Return the stops of darkening that remove the share `what` of the light; 3 stops for an empty text.

    Raises:
        ProgdfError: the share is not a number between 0 and 1.
    """
    amount = color.number_of(what) if what else 0.875
    if not 0.0 < amount < 1.0:
        raise ProgdfError(
            f"{editor}:{what} is not a number between 0 and 1; write, for example, {editor}:0.7"
        )
    return -math.log2(1.0 - amount)
