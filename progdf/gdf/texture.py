"""Color and texture of an edit: one map of the region's colors, and the remainder per Gaussian.

The gains `color` and `texture` of a layer weigh the two parts of its color change Δ. With the part M that the
map makes, the layer adds

    texture · Δ + (color − texture) · M  =  Δ − (1 − color) · M − (1 − texture) · (Δ − M).

- A grade has both parts. M is its map. If the map has a mask, M takes the mean of the mask for all
  members, because a pattern is texture. A grade without mask and residual has no texture.
- For all other edits, M is the polynomial of the members' own colors that fits Δ best at every strength, by
  weighted least squares. The fit is linear in Δ, so M has the coefficients of Δ over the strength. Higher SH
  bands follow the derivative of the map.
- The discs of a painted layer have a fixed color p. Their change is p − b, where b is the color of the
  surface below them, and their map is fitted separately. Recolored Gaussians of the scene that only make
  way for discs are texture.
- An edit of view-dependent colors alone has no texture.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from progdf.field.baked import AttributeBases, BakedField, GradeForm
from progdf.field.grade import MAX_COLOR, bake_grade, map_alone, monomials
from progdf.field.separable import quantize_bases
from progdf.gaussians import Gaussians, pack
from progdf.sh import C0, sh0_to_rgb
from progdf.system.equality import equal_fields

from .anchors import Anchors
from .file import Gdf

MAP_DEGREE = 2
"""Degree of a fitted map: ten monomials per channel."""
_RANK_TOLERANCE = 1e-9  # share of the largest eigenvalue below which monomials of the colors are dependent


@dataclass(frozen=True)
class DiscColors:
    """Changes that the B discs of a painted layer make to the color of the surface below them."""

    __eq__ = equal_fields

    change: Tensor  # SH band 0 of the discs minus that of the surface. [B,3]
    color: Tensor  # the part of it that the map makes. [B,3]


@dataclass(frozen=True)
class ColorSplit:
    """Color of an edit apart from its texture."""

    color: BakedField | None  # the map's part of the members' color change; None: all of it is texture
    map_share: float = 1.0  # share of a grade's map that is color, 0 to 1
    discs: DiscColors | None = None  # None if the edit paints none

    def take(self, members: Tensor) -> ColorSplit:
        """Return the split of some members without their discs. [m] int64"""
        if self.color is None:
            return replace(self, discs=None)
        attributes = {name: bases.take(members) for name, bases in self.color.attributes.items()}
        return replace(self, color=replace(self.color, attributes=attributes), discs=None)


Split = Callable[[Gaussians, Gdf], ColorSplit | None]
"""Function with the signature of `color_split`."""


def color_split(scene: Gaussians, gdf: Gdf) -> ColorSplit | None:
    """Return the color of an edit apart from its texture; None if the edit has no texture.

    Args:
        scene: the original, with the rows that edits add
        gdf: the edit, converted by `extend`
    """
    form = gdf.field.origin
    if isinstance(form, GradeForm):
        return _split_grade(scene, gdf, form)
    discs = _split_discs(scene, gdf.region.members, gdf.anchors) if gdf.paints else None
    if "sh0" not in gdf.field.attributes:
        return None if discs is None else ColorSplit(None, discs=discs)
    pushes = gdf.anchors is not None and "color" in gdf.anchors.pushes
    return ColorSplit(None if pushes else _fit_color(scene, gdf), discs=discs)


def has_texture(gdf: Gdf) -> bool:
    """Return whether an edit changes colors by more than a map of the region's colors."""
    form = gdf.field.origin
    if isinstance(form, GradeForm):
        return form.mask is not None or len(form.residual) > 0
    return "sh0" in gdf.field.attributes or gdf.paints


def _split_grade(scene: Gaussians, gdf: Gdf, form: GradeForm) -> ColorSplit | None:
    """Return the map of a grade with the same share for all members, and without residual."""
    if not has_texture(gdf):
        return None
    members = gdf.region.members
    mean = 1.0
    plain = map_alone(form, len(members))
    if form.mask is not None:
        weights = _visible_areas(scene, members)
        level = round(float((weights * form.mask).sum() / weights.sum().clamp_min(1e-30)))
        plain = replace(plain, mask=torch.full_like(form.mask, level))
        mean = level / 255.0
    rows = pack(scene[members], with_shN=scene.sh_degree > 0)
    return ColorSplit(bake_grade(plain, rows), mean)


def _fit_color(scene: Gaussians, gdf: Gdf) -> BakedField:
    """Return the best map of the members' colors, in the form of the edit's own color field."""
    field = gdf.field
    members = gdf.region.members
    own = len(members) - (
        0 if gdf.anchors is None else len(gdf.anchors)
    )  # added rows have no color of their own
    weights = _visible_areas(scene, members)
    weights[own:] = 0.0
    moved = field.attributes["sh0"]
    colors = _drawn_colors(scene.sh0[members])
    inputs = monomials(colors, MAP_DEGREE) / C0
    stored = torch.cat([moved.end_offset[None].float(), moved.residual_basis.float()])
    offsets = stored * moved.scale[:, None]
    tables = [fit_map(inputs, target, weights) for target in offsets]
    mapped = torch.stack([inputs.T @ table for table in tables])
    mapped[:, own:] = 0.0
    levels, unit = quantize_bases(mapped[1:], torch.int8)
    scale = torch.cat([torch.ones(1, 3), unit])
    attributes = {"sh0": AttributeBases(mapped[0], levels, scale, moved.coefficients)}
    if "shN" in field.attributes:
        bands = scene.shN[members].float()
        higher = torch.stack([(bands @ slopes(colors, table)).flatten(1) for table in tables])
        higher[:, own:] = 0.0
        levels, unit = quantize_bases(higher, torch.int8)
        attributes["shN"] = AttributeBases(levels[0], levels[1:], unit, moved.coefficients)
    return BakedField("separable", field.knots, attributes, field.channels)


def _split_discs(scene: Gaussians, members: Tensor, anchors: Anchors | None) -> DiscColors | None:
    """Return the changes of a painted layer's discs against the surface below them. [M]"""
    if anchors is None:
        return None
    rows = members[-len(anchors) :]
    colors = scene.sh0.float().reshape(-1, 3)
    below = (anchors.weights[..., None] * colors[anchors.rows]).sum(dim=1)
    change = colors[rows] - below
    change[anchors.weights.sum(dim=1) == 0.0] = 0.0  # such discs lie on nothing
    inputs = monomials(_drawn_colors(below), MAP_DEGREE) / C0
    table = fit_map(inputs, change, _visible_areas(scene, rows))
    return DiscColors(change, inputs.T @ table)


def slopes(colors: Tensor, table: Tensor) -> Tensor:
    """Return the derivative of a fitted map: the change of each output channel by each input channel.

    Args:
        colors: drawn colors, see `_drawn_colors`. [3,M]
        table: coefficients of the map, see `fit_map`. [K,3]

    Returns:
        [M,3,3], input channel first. 0 where the color is beyond the limits of the map
    """
    red, green, blue = colors
    zero = torch.zeros_like(red)
    one = torch.ones_like(red)
    terms = [
        [zero, one, zero, zero, 2 * red, zero, zero, green, zero, blue],
        [zero, zero, one, zero, zero, 2 * green, zero, red, blue, zero],
        [zero, zero, zero, one, zero, zero, 2 * blue, zero, green, red],
    ]
    inside = ((colors > 0.0) & (colors < MAX_COLOR)).T[..., None]
    derivative = torch.stack([torch.stack(row, dim=1) @ table for row in terms], dim=1)
    return derivative * inside


def _drawn_colors(sh0: Tensor) -> Tensor:
    """Return the colors of SH band 0 within the limits of a map. [M,…] -> [3,M]"""
    return sh0_to_rgb(sh0.float().reshape(-1, 3)).T.clamp(0.0, MAX_COLOR)


def fit_map(inputs: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """Return the coefficients of the map that fits a color change best, by weighted least squares.

    Args:
        inputs: monomials of the members' drawn colors, in units of SH band 0. [K,M]
        change: change of SH band 0. [M,3]
        weights: visibility of an error in each member, ≥ 0. [M]

    Returns:
        [K,3]
    """
    weighted = inputs.double() * weights
    normal = weighted @ inputs.double().T
    inverse = torch.linalg.pinv(normal, rtol=_RANK_TOLERANCE, hermitian=True)
    coefficients: Tensor = inverse @ (weighted @ change.double())
    return coefficients.float()


def _visible_areas(scene: Gaussians, rows: Tensor) -> Tensor:
    """Return the area of each row times its opacity, as a share of the largest area. [m] float64"""
    scales = scene.log_scales[rows].float().sort(dim=1).values
    areas = (scales[:, 1] + scales[:, 2]).double()
    relative = (areas - areas.amax() if len(areas) else areas).exp()
    return (relative * scene.logit_opacities[rows].double().sigmoid()).reshape(-1)
