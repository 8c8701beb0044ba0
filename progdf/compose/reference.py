"""Composition of several edits: Θ = Θ0 + blend over the enabled layers of m · gain · Δ(s) (docs/method.md 6).

`compose_layers` is the reference implementation. `progdf.compose.composer.Composer` computes the same numbers
in preallocated buffers while a slider is dragged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from progdf.color.oklab import smoothstep
from progdf.errors import check_first_argument
from progdf.field.baked import BakedField, GradeForm
from progdf.field.grade import adjust_colors, map_share
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from progdf.gdf.texture import ColorSplit, Split, color_split
from progdf.sh import C0
from progdf.system.equality import equal_fields

from .added import extend
from .follow import (
    anchor_turns,
    carries_others,
    carry_pushed,
    carry_rows,
    changes_shape,
    pack_shapes,
    turn_bands,
    unpack_shapes,
)
from .layers import (
    BLENDS,
    DEFAULT_BLEND,
    KINDS,
    ORDERED,
    Gains,
    Layer,
    check_layers,
    color_factors,
    disc_changes,
    is_averaged_alone,
    needs_split,
    rule_of,
)
from .overlap import ARRANGED, arrange, find_paint, paint_layers, tints_rim
from .parents.rows import carry, still

# changes that are clearly visible
_VISIBLE_COLOR = 0.1  # sRGB, 0 to 1
_VISIBLE_OPACITY = 0.2  # opacity, 0 to 1
_VISIBLE_MOVE = 0.05  # movement, in sizes of the region
_VISIBLE_GROWTH = 0.4  # log-scale
_VISIBLE_ROTATION = 0.4  # change of a quaternion, as a share of its length
_SHARE_OF_LARGEST = 0.5  # a change of this share of the edit's large changes hides all layers below
_MAX_SAMPLED_MEMBERS = 100_000  # members that are sampled to find an edit's large changes


def coverage(scene: Gaussians, gdf: Gdf) -> Mapping[str, Tensor]:
    """Return the share of lower edits that an edit at strength 1 hides, per member and kind of change.

    With z the visible size of a member's change at strength 1, c = smoothstep(z / max(floor, z₉₀ / 2)). z₉₀
    is the 90th percentile over the members. So an unchanged member hides nothing, and one with half of the
    edit's large changes hides everything below. z is, per kind:

    - "color": the largest channel of the sRGB change, as root mean square over all viewing directions
      (C0 · √Σ Δ² over the SH coefficients); floor 0.1
    - "opacity": the change of σ(logit); floor 0.2
    - "geometry": the largest of the movement / 0.05 of the region's size, the change of a log-scale / 0.4,
      and the rotation |Δq| / 0.4 |q|; floor 1

    Coverage is not stored. It follows from the offsets at strength 1, and so is defined for every .gdf. An
    edit that adds to lower ones (see `Gdf.adds`) hides nothing.

    Returns:
        Kind (see `layers.KINDS`) -> c, 0 to 1. A grade also has "map", see `map_share`. [M] float32
    """
    members = gdf.region.members
    field = gdf.field
    moved = {KINDS[name] for name in field.attributes}
    if gdf.adds:
        return {kind: torch.zeros(len(members)) for kind in moved}
    sizes = {
        "color": (_color_change(field), _VISIBLE_COLOR),
        "opacity": (_opacity_change(scene, members, field), _VISIBLE_OPACITY),
        "geometry": (_shape_change(scene, members, field), 1.0),
    }
    covered = {
        kind: _coverage_of_sizes(size, floor) for kind, (size, floor) in sizes.items() if kind in moved
    }
    return covered | {"map": map_share(field)} if isinstance(field.origin, GradeForm) else covered


def _coverage_of_sizes(size: Tensor, floor: float) -> Tensor:
    if not len(size):
        return size
    sample = size[:: 1 + len(size) // _MAX_SAMPLED_MEMBERS]
    largest = float(sample.kthvalue(1 + int(0.9 * (len(sample) - 1))).values)
    return smoothstep(size / max(floor, _SHARE_OF_LARGEST * largest)).float()


def color_coverage(change: Tensor) -> Tensor:
    """Return the coverage of colors for changes of SH coefficients, see `coverage`. [M,B,3] -> [M]"""
    return _coverage_of_sizes(C0 * change.norm(dim=1).amax(dim=1), _VISIBLE_COLOR)


def _color_change(field: BakedField) -> Tensor:
    changes = [field.attributes[name].end for name in _COLORS if name in field.attributes]
    if not changes:
        return torch.zeros(0)
    together = torch.cat([change.reshape(len(change), -1, 3) for change in changes], dim=1)
    change: Tensor = C0 * together.norm(dim=1).amax(dim=1)
    return change


def _opacity_change(scene: Gaussians, members: Tensor, field: BakedField) -> Tensor:
    if "logit_opacities" not in field.attributes:
        return torch.zeros(0)
    before = scene.logit_opacities[members].float()
    after = before + field.attributes["logit_opacities"].end.reshape(-1)
    return (after.sigmoid() - before.sigmoid()).abs()


def _shape_change(scene: Gaussians, members: Tensor, field: BakedField) -> Tensor:
    size = torch.zeros(len(members))
    if "means" in field.attributes and len(members):
        means = scene.means[members].float()
        extent = (means - means.mean(dim=0)).norm(dim=1).median().clamp_min(1e-12) * 2
        size = field.attributes["means"].end.norm(dim=1) / (_VISIBLE_MOVE * extent)
    if "log_scales" in field.attributes:
        size = size.maximum(field.attributes["log_scales"].end.abs().amax(dim=1) / _VISIBLE_GROWTH)
    if "quats" in field.attributes:
        length = scene.quats[members].float().norm(dim=1).clamp_min(1e-6)
        size = size.maximum(field.attributes["quats"].end.norm(dim=1) / (_VISIBLE_ROTATION * length))
    return size


__all__ = ["BLENDS", "Gains", "Layer", "compose_layers"]

NEGATIVE_ZERO = -0.0
"""Number that leaves every bit unchanged when added to any number, including −0.0."""
Coverage = Callable[[Gaussians, Gdf], Mapping[str, Tensor]]
"""Function with the signature of `coverage`."""

_ALL_ROWS = slice(None)
_COLORS = ("sh0", "shN")
_DRAWN_COEFFICIENTS = 16  # SH coefficients that are drawn (degree 3)


def edited_scene(scene: Gaussians, gdf: Gdf, strength: float = 1.0) -> Gaussians:
    """Return the scene under one edit, with the rows that the edit adds after the scene's own."""
    return compose_layers(scene, [Layer(gdf, strength)])


def compose_layers(scene: Gaussians, layers: Sequence[Layer], blend: str = DEFAULT_BLEND) -> Gaussians:
    """Return the scene under a stack of edits.

    With m the layer's weights, g its gain for the kind of attribute, and Δ(s) its field at strength s:

    - "normalized": Σ m g Δ(s) / max(1, Σ m s). The lower sum is over the layers that make this kind of
      change. A single layer is unchanged, and the order does not matter. It equals "sum" while the strengths
      on a Gaussian add up to at most 1.
    - "sum": Σ m g Δ(s).
    - "over": in the given order, Δ ← Δ · (1 − m s c min(1, |g|)) + m g Δ(s). The last layer lies on top. Its
      `coverage` c, 0 to 1, is the size of its change of that kind. Lower layers are visible where it
      changes nothing.
    - "adjust": as "over", but a grade (see `progdf.field.grade`) hides nothing. It maps the colors that
      result from the layers below, Δ ← Δ + m g (grade(Θ0 + Δ, s) − Θ0 − Δ). On unchanged Gaussians it is the
      edit as trained, and darkened stripes stay stripes. A member whose change comes more from the residual
      than from the map lies over the lower layers to that extent, see `map_share`. So dark gaps between
      stripes stay dark.

    A color change has a gain for the map of the region's colors and one for the remainder, its texture, see
    `progdf.gdf.texture`. In "over" |g| is the gain of color: texture alone hides no lower layer.

    Paint makes way for its discs by changes of the scene's Gaussians (see `Anchors.pushes`). These take no
    part in the rule. The largest such change of a Gaussian is added to the result of the other layers. It
    fades in proportion to the strength of a layer that moves or removes the Gaussian without its paint.

    A layer of paint covers the layers of paint below it, see `progdf.compose.overlap`. Added rows follow the
    surface below them when other layers move, scale or fade it, see `progdf.compose.follow`.

    In Σ m s and 1 − m s c, s is clamped to 0 to 1. A strength above 1 exaggerates its own edit without
    dimming the others.

    Args:
        scene: the original
        layers: edits of this scene, lowest first
        blend: one of `BLENDS`, by default "adjust" as in the window and in `progdf render`

    Returns:
        New Gaussians, with the rows that the edits add after the scene's own (see `progdf.compose.added`).
        Attributes that no layer changes are the scene's own tensors. Rows outside all members, rows of weight
        0, and all rows at strength 0 keep their bytes. One layer at strength 1 gives exactly Θ0 + Δ(1).

    Raises:
        ProgdfError: an edit belongs to another scene, a strength is not a number, or the blend rule is
            unknown.
        ValueError: weights do not fit.
    """
    check_first_argument("compose_layers(scene, layers)", scene, Gaussians)
    edits = {id(layer.gdf): layer.gdf for layer in layers}
    scene, extended = extend(scene, list(edits.values()))
    edits = dict(zip(edits, extended, strict=True))
    layers = [replace(layer, gdf=edits[id(layer.gdf)]) for layer in layers]
    check_layers(layers, blend)
    active = [layer for layer in layers if layer.active]
    if not active or not len(scene):
        return scene
    quiet = {key: still(gdf) for key, gdf in ((id(layer.gdf), layer.gdf) for layer in active)}
    others = [replace(layer, gdf=quiet[id(layer.gdf)]) for layer in active]
    composed = _arrange(scene, _compose(scene, others, blend), others, blend)
    return carry(scene, _follow(scene, composed, others, blend), active)


def _compose(scene: Gaussians, layers: Sequence[Layer], blend: str) -> Gaussians:
    """Return the scene under active layers, in which no row follows another."""
    if not layers:
        return scene
    rows, changed = changed_rows(scene, layers, blend)
    return replace(
        scene, **{name: getattr(scene, name).index_copy(0, rows, new) for name, new in changed.items()}
    )


def _arrange(scene: Gaussians, composed: Gaussians, layers: Sequence[Layer], blend: str) -> Gaussians:
    """Return the composed scene with layers of paint in their order, see `progdf.compose.overlap`.

    Args:
        scene: the original with the rows that edits add
        composed: the scene under the layers, without the order of paint
        layers: active layers of converted edits
        blend: one of `BLENDS`
    """
    edits = list({id(layer.gdf): layer.gdf for layer in layers}.values())
    paint = find_paint(scene, edits)
    if paint is None:
        return composed
    index = {id(gdf): edit for edit, gdf in enumerate(edits)}
    tints = np.zeros((len(paint), 3))
    for edit in np.unique(paint.edits).tolist():
        anchors = edits[edit].anchors
        changing = [layer for layer in layers if tints_rim(layer.gdf) and layer.gdf is not edits[edit]]
        if anchors is None or not changing:
            continue
        after = _compose(scene, changing, blend)
        mine = paint.edits == edit
        at = torch.from_numpy(paint.members[mine]) - (len(edits[edit].region) - len(anchors))
        change = (after.sh0 - scene.sh0)[anchors.rows[at]].double().reshape(len(at), -1, 3)
        tints[mine] = (anchors.weights[at][..., None] * change).sum(dim=1).numpy()
    values = {name: getattr(composed, name).float().clone() for name in ARRANGED}
    arrange(
        paint,
        paint_layers([(index[id(layer.gdf)], layer) for layer in layers]),
        tints,
        {name: each.numpy() for name, each in values.items()},
    )
    changed: dict[str, Any] = {
        name: new.to(getattr(scene, name).dtype)
        for name, new in values.items()
        if not torch.equal(new, getattr(composed, name))
    }
    return replace(composed, **changed)


def _follow(scene: Gaussians, composed: Gaussians, layers: Sequence[Layer], blend: str) -> Gaussians:
    """Return the composed scene with added rows on the surface as other layers change it.

    See `progdf.compose.follow`.

    Args:
        scene: the original with the rows that edits add
        composed: the scene under the layers, in which no row follows another
        layers: active layers of converted edits
        blend: one of `BLENDS`
    """
    edits = {id(layer.gdf): layer.gdf for layer in layers}
    pushing = {key for key, gdf in edits.items() if not carries_others(gdf)}
    others = [layer for layer in layers if id(layer.gdf) not in pushing and changes_shape(layer.gdf)]
    if not others or all(gdf.anchors is None for gdf in edits.values()):
        return composed
    shapes = pack_shapes(composed)
    bands = composed.shN.float().clone()
    before = pack_shapes(scene)
    pushed = torch.zeros(len(scene), dtype=torch.bool)
    for key in pushing:
        anchors = edits[key].anchors
        members = edits[key].region.members
        pushed[members[: len(members) - (0 if anchors is None else len(anchors))]] = True
    rows = pushed.nonzero()[:, 0]
    surface = pack_shapes(_compose(scene, others, blend), rows)
    paint = pack_shapes(_compose(scene, [layer for layer in layers if id(layer.gdf) in pushing], blend), rows)
    shapes[rows] = carry_pushed(paint, before[rows], surface)
    for gdf in edits.values():
        anchors = gdf.anchors
        if anchors is None or not len(anchors):
            continue
        changing = [layer for layer in others if layer.gdf is not gdf]
        after = pack_shapes(_compose(scene, changing, blend))
        rows = gdf.region.members[-len(anchors) :]
        at = anchors.rows
        weights = anchors.weights.double()
        shapes[rows] = carry_rows(shapes[rows], before[at], after[at], weights)
        bands[rows] = turn_bands(bands[rows], *anchor_turns(before[at], after[at], weights))
    changed: dict[str, Any] = {
        name: new.to(getattr(scene, name).dtype)
        for name, new in {**unpack_shapes(shapes), "shN": bands}.items()
        if not torch.equal(new, getattr(composed, name))
    }
    return replace(composed, **changed)


def changed_rows(
    scene: Gaussians,
    layers: Sequence[Layer],
    blend: str,
    covers: Coverage = coverage,
    split: Split = color_split,
) -> tuple[Tensor, dict[str, Any]]:
    """Return the rows that `compose_layers` changes and their new values, without a copy of the scene.

    Args:
        scene: the original
        layers: active layers, at least one, checked
        blend: one of `BLENDS`
        covers: `coverage`, or a cached version of it
        split: `color_split`, or a cached version of it

    Returns:
        Sorted rows [U] int64, and the new values of each changed attribute [U,...].
    """
    rows, parts = _parts(scene, layers, blend, covers, split)
    weight_sums = {kind: torch.zeros(len(rows)) for kind in KINDS.values()}  # Σ m s
    for part in parts:
        for kind in part.layer.blended_kinds if part.rule == "normalized" else ():
            weight_sums[kind][part.rows] += part.weights * part.layer.clamped_strength
    averaged = all(part.rule == "normalized" for part in parts)
    if is_averaged_alone(layers, blend):
        divisors = {kind: sums.clamp(min=1.0) for kind, sums in weight_sums.items()}
        parts = [replace(part, divisors=divisors if part.rule == "normalized" else {}) for part in parts]

    blended = [part for part in parts if not part.pushes("sh0")]
    adjusted = _adjusted_colors(scene, rows, blended) if any(p.rule == "adjust" for p in parts) else {}
    changed: dict[str, Any] = {}
    for name in ATTRIBUTES:
        movers = [part for part in parts if part.moves(name)]
        discs = disc_changes(layers, [part.split for part in parts]) if name == "sh0" else []
        if not movers and not discs:
            continue
        old: Tensor = getattr(scene, name)
        total = adjusted.get(name, torch.full((len(rows), old[0].numel()), NEGATIVE_ZERO))
        for part in movers if name not in adjusted else ():
            if not part.pushes(name):
                part.add(total, name)
        if averaged:
            total = total / weight_sums[KINDS[name]].clamp(min=1.0)[:, None]
        pushing = [part for part in movers if part.pushes(name)]
        if pushing:
            total = total + _largest_push(pushing, name, total) * _kept_pushes(parts, len(rows))
        changed[name] = old[rows] + total.reshape(-1, *old.shape[1:]).to(old.dtype)
        for gdf, change in discs:
            painted = gdf.region.members[-len(change) :]
            at = torch.searchsorted(rows, painted).clamp(max=len(rows) - 1)
            found = rows[at] == painted  # rows of weight 0 are absent
            changed[name][at[found]] += change[found].reshape(-1, *old.shape[1:]).to(old.dtype)
    return rows, changed


@dataclass(frozen=True)
class _LayerMembers:
    """Members of a layer with nonzero weight, m in number."""

    __eq__ = equal_fields

    layer: Layer  # the layer
    members: Tensor | slice  # member indices; a slice if all members are included. [m] int64
    rows: Tensor | slice  # positions among the changed rows; a slice if these are all of them. [m] int64
    weights: Tensor  # weights of these members. [m] float32
    # share of lower layers that this layer hides, see `coverage`; empty for rules without an order. [M]
    # float32
    coverage: Mapping[str, Tensor]
    rule: str  # blend rule of the layer
    split: ColorSplit | None = None  # color and texture of the edit, if the layer's gains divide them
    # by kind, max(1, Σ m s) of a layer that is averaged among layers with other rules. [U]
    divisors: Mapping[str, Tensor] = field(default_factory=dict)

    def add(self, total: Tensor, name: str) -> None:
        """Add the layer's offsets of one attribute to the sums. [U,c]"""
        below = total[self.rows]
        if self.rule in ORDERED:
            gain = min(abs(self.layer.gain(name)), 1.0)
            hidden = torch.tensor(self.layer.clamped_strength) * torch.tensor(gain)
            below = below * (
                1 - self.weights[:, None] * hidden * self.coverage[KINDS[name]][self.members, None]
            )
        total[self.rows] = self.add_offsets(below, name)

    def add_offsets(self, below: Tensor, name: str) -> Tensor:
        """Return sums of these members plus the layer's offsets of one attribute times its gains. [m,c]"""
        weight = self.weights[:, None]
        if KINDS[name] in self.divisors:
            weight = weight / self.divisors[KINDS[name]][self.rows, None]
        strength = self.layer.strength
        factor, color_factor = color_factors(self.layer, name, self.split)
        offsets = self.layer.gdf.field.attribute_offsets(name, strength)[self.members]
        total = below + weight * factor * offsets
        if self.split is not None and self.split.color is not None and color_factor != 0.0:
            color = self.split.color
            if name in color.attributes:
                total = total + weight * color_factor * color.attribute_offsets(name, strength)[self.members]
        return total

    def grade_shares(self, form: GradeForm) -> tuple[Tensor, float]:
        """Return the shares of a grade's map for all members [M], and of its residual."""
        gain = self.layer.gains.color
        if self.split is None:
            return gain * form.share, gain
        texture = self.layer.gains.texture
        return texture * form.share + (gain - texture) * self.split.map_share, texture

    def pushes(self, attribute: str) -> bool:
        """Return whether the layer changes an attribute only to make way for its paint."""
        return KINDS[attribute] in self.layer.pushed_kinds

    def moves(self, attribute: str) -> bool:
        """Return whether the layer changes an attribute."""
        factors = color_factors(self.layer, attribute, self.split)
        return attribute in self.layer.gdf.field.attributes and factors != (0.0, 0.0)


def _largest_push(parts: Sequence[_LayerMembers], name: str, total: Tensor) -> Tensor:
    """Return the largest change by paint in each row; of equal ones, that of the upper layer. [U,c]

    Args:
        parts: members of layers that push them, lowest layer first
        name: attribute
        total: sums of the other layers. [U,c]
    """
    largest = torch.full_like(total, NEGATIVE_ZERO)
    for part in parts:
        zero = torch.full_like(total[part.rows], NEGATIVE_ZERO)
        push = part.add_offsets(zero, name)
        below = largest[part.rows]
        is_larger = push.square().sum(dim=1) >= below.square().sum(dim=1)
        largest[part.rows] = torch.where(is_larger[:, None], push, below)
    return largest


def _kept_pushes(parts: Sequence[_LayerMembers], count: int) -> Tensor:
    """Return the share of the changes by paint that remains in each row. [U,1]

    Rows that a layer moves or removes without their paint return to their own state, in proportion to its
    strength.
    """
    kept = torch.ones(count)
    for part in parts:
        if part.layer.leaves_paint:
            kept[part.rows] *= 1 - part.weights * torch.tensor(part.layer.clamped_strength)
    return kept[:, None]


def _adjusted_colors(scene: Gaussians, rows: Tensor, parts: Sequence[_LayerMembers]) -> dict[str, Tensor]:
    """Return the sums of the color attributes with layers under "adjust". [U,c] each"""
    moved = {name for part in parts for name in _COLORS if part.moves(name)}
    old = {name: getattr(scene, name)[rows].float().flatten(1) for name in _COLORS if name in moved}
    total = {name: torch.full_like(values, NEGATIVE_ZERO) for name, values in old.items()}
    touched = torch.zeros(len(rows), dtype=torch.bool)
    for part in parts:
        form = part.layer.gdf.field.origin
        names = [name for name in old if part.moves(name)]
        before = {name: total[name][part.rows].clone() for name in names}
        for name in names:
            part.add(total[name], name)
        is_touched = touched[part.rows]
        if part.rule == "adjust" and isinstance(form, GradeForm) and names and bool(is_touched.any()):
            sh = [
                (old[n][part.rows] + before[n])[is_touched].reshape(int(is_touched.sum()), -1, 3)
                for n in names
            ]
            members = torch.arange(len(part.layer.gdf.region))[part.members][is_touched]
            drawn = torch.cat(sh, dim=1)[:, :_DRAWN_COEFFICIENTS]
            change = adjust_colors(form, drawn, members, part.layer.strength, part.grade_shares(form))
            factor = part.weights[is_touched, None, None]
            share = part.coverage["map"][members, None]
            for name, bands in zip(names, (change[:, :1], change[:, 1:]), strict=False):
                sums = total[name][part.rows]
                new = before[name][is_touched]
                new[:, : 3 * bands.shape[1]] += (factor * bands).flatten(1)
                sums[is_touched] = torch.lerp(sums[is_touched], new, share)
                total[name][part.rows] = sums
        touched[part.rows] = True
    return total


def _parts(
    scene: Gaussians, layers: Sequence[Layer], blend: str, covers: Coverage, split: Split
) -> tuple[Tensor, list[_LayerMembers]]:
    """Return the sorted rows of the scene that change, [U] int64, and each layer's members in them."""
    chosen: list[tuple[Tensor | slice, Tensor]] = []  # members and their weights
    for layer in layers:
        weights = torch.ones(len(layer.gdf.region)) if layer.weights is None else layer.weights.float()
        selected = weights.nonzero()[:, 0]
        chosen.append(
            (_ALL_ROWS, weights) if len(selected) == len(weights) else (selected, weights[selected])
        )
    reached = [layer.gdf.region.members[members] for layer, (members, _) in zip(layers, chosen, strict=True)]
    rows = reached[0] if len(reached) == 1 else torch.unique(torch.cat(reached))
    position = torch.empty(len(scene) if len(reached) > 1 else 0, dtype=torch.int64)
    if len(reached) > 1:
        position[rows] = torch.arange(len(rows))
    return rows, [
        _LayerMembers(
            layer,
            members,
            _ALL_ROWS if len(layer_rows) == len(rows) else position[layer_rows],
            weights,
            covers(scene, layer.gdf) if rule_of(layer, blend) in ORDERED else {},
            rule_of(layer, blend),
            split(scene, layer.gdf) if needs_split(layer) else None,
        )
        for layer, layer_rows, (members, weights) in zip(layers, reached, chosen, strict=True)
    ]
