"""Several edits on one scene: Θ = Θ0 + blend over the enabled layers of m · gain · Δ(s) (docs/method.md 6).

`compose_layers` is the plain form that states the rules. `progdf.compose.composer.Composer` gives the same
numbers while a slider is dragged, in buffers that are made once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from progdf.color.oklab import smoothstep
from progdf.errors import check_first_argument
from progdf.field.baked import BakedField, GradeForm
from progdf.field.grade import adjust_colors, map_share
from progdf.gaussians import ATTRIBUTES, Gaussians
from progdf.gdf.file import Gdf
from progdf.sh import C0

from .added import extend
from .layers import BLENDS, KINDS, ORDERED, Gains, Layer, check_layers

_COLOR = 0.1  # of sRGB's 0..1: a change that is plain to see
_OPACITY = 0.2  # of 0..1
_MOVE = 0.05  # of the region's size
_GROWTH = 0.4  # of a log-scale
_TURN = 0.4  # of a quaternion's length
_SHARE_OF_LARGEST = 0.5
_MOST = 100_000  # members by which the largest change is judged


def coverage(scene: Gaussians, gdf: Gdf) -> Mapping[str, Tensor]:
    """For each kind of change that an edit makes, how much of a lower edit's is hidden by it at strength 1.

    With z the size of a member's finished change, c = smoothstep(z / max(floor, z₉₀ / 2)), where z₉₀ is
    exceeded by a tenth of the members: what the edit leaves alone hides nothing, half of its own large
    changes hide all. z is what one sees:

    - "color": the largest channel of the change in sRGB, root mean square over all directions of view
      (C0 · √Σ Δ² over the SH coefficients); floor 0.1
    - "opacity": the change of σ(logit); floor 0.2
    - "geometry": the largest of the way / 0.05 of the region's size, the growth of a log-scale / 0.4, and the
      turn |Δq| / 0.4 |q|; floor 1

    Nothing of it is stored: it follows from the offsets at strength 1, and so holds for every .gdf.

    Returns:
        Kind, see `layers.KINDS` -> c, 0..1; of a grade also "map" -> see `map_share`. [M] float32
    """
    members = gdf.region.members
    field = gdf.field
    sizes = {
        "color": (_color_change(field), _COLOR),
        "opacity": (_opacity_change(scene, members, field), _OPACITY),
        "geometry": (_shape_change(scene, members, field), 1.0),
    }
    moved = {KINDS[name] for name in field.attributes}
    covered = {kind: _rise(size, floor) for kind, (size, floor) in sizes.items() if kind in moved}
    return covered | {"map": map_share(field)} if isinstance(field.origin, GradeForm) else covered


def _rise(size: Tensor, floor: float) -> Tensor:
    if not len(size):
        return size
    few = size[:: 1 + len(size) // _MOST]
    largest = float(few.kthvalue(1 + int(0.9 * (len(few) - 1))).values)
    return smoothstep(size / max(floor, _SHARE_OF_LARGEST * largest)).float()


def _color_change(field: BakedField) -> Tensor:
    changes = [field.attributes[name].end for name in ("sh0", "shN") if name in field.attributes]
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
        size = field.attributes["means"].end.norm(dim=1) / (_MOVE * extent)
    if "log_scales" in field.attributes:
        size = size.maximum(field.attributes["log_scales"].end.abs().amax(dim=1) / _GROWTH)
    if "quats" in field.attributes:
        length = scene.quats[members].float().norm(dim=1).clamp_min(1e-6)
        size = size.maximum(field.attributes["quats"].end.norm(dim=1) / (_TURN * length))
    return size


__all__ = ["BLENDS", "Gains", "Layer", "compose_layers"]

NEGATIVE_ZERO = -0.0
"""The number that added to any other, −0.0 included, leaves every bit as it was."""
Coverage = Callable[[Gaussians, Gdf], Mapping[str, Tensor]]
"""See `coverage`."""

_ALL = slice(None)
_COLORS = ("sh0", "shN")
_DRAWN = 16  # bands that are drawn


def edited_scene(scene: Gaussians, gdf: Gdf, strength: float = 1.0) -> Gaussians:
    """The scene under one edit, the rows that it adds after its own."""
    return compose_layers(scene, [Layer(gdf, strength)])


def compose_layers(scene: Gaussians, layers: Sequence[Layer], blend: str = "normalized") -> Gaussians:
    """The scene under a stack of edits.

    With m the layer's weights, g its gain for the kind of attribute, and Δ(s) its field at strength s:

    - "normalized": Σ m g Δ(s) / max(1, Σ m s), the lower sum over the layers that make this kind of change.
      One layer alone is untouched, order does not matter, and it is the plain sum while the strengths on a
      Gaussian add up to no more than 1.
    - "sum": Σ m g Δ(s).
    - "over": in the order given, Δ ← Δ · (1 − m s c min(1, |g|)) + m g Δ(s), where c is how much the layer
      itself changes of that kind, 0 to 1 (`coverage`); the last layer lies on top, and what it
      leaves alone shows the layers below.

    - "adjust": as "over", but a grade (see `progdf.field.grade`) hides nothing: it maps the colors that the
      layers below have left, Δ ← Δ + m g (grade(Θ0 + Δ, s) − Θ0 − Δ). Over what nobody changed it is the edit
      as trained; darkened stripes stay stripes. Where a member's change is more its residual's than the map's
      it lies over the others that far, see `map_share`: between stripes on what is dark it stays dark.

    In Σ m s and 1 − m s c, s is held to 0..1: an overshoot exaggerates its own edit and does not dim the
    others.

    Args:
        scene: the original
        layers: edits of this scene, the lowest first
        blend: one of `BLENDS`

    Returns:
        New Gaussians, with the rows that the edits add after the scene's own (see `progdf.compose.added`);
        attributes that no layer moves are the scene's own tensors. Rows outside all members,
        rows of weight 0, and everything at strength 0 keep their bytes. One layer at strength 1 gives Θ0 +
        full exactly.

    Raises:
        ProgdfError: an edit belongs to another scene, a strength is not a number, the blend rule is unknown.
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
    rows, changed = changed_rows(scene, active, blend)
    return replace(
        scene, **{name: getattr(scene, name).index_copy(0, rows, new) for name, new in changed.items()}
    )


def changed_rows(
    scene: Gaussians, layers: Sequence[Layer], blend: str, covers: Coverage = coverage
) -> tuple[Tensor, dict[str, Any]]:
    """What `compose_layers` changes, without a copy of the scene.

    Args:
        scene: the original
        layers: active ones, at least one, checked
        blend: one of `BLENDS`
        covers: `coverage`, or where that is kept

    Returns:
        Sorted rows [U] int64, and by attribute that a layer moves what they become [U,...]
    """
    rows, parts = _parts(scene, layers, blend, covers)
    weight_sums = {kind: torch.zeros(len(rows)) for kind in KINDS.values()}  # Σ m s
    for part in parts:
        for kind in part.layer.kinds:
            weight_sums[kind][part.rows] += part.weights * part.layer.clamped_strength

    adjusted = _adjusted_colors(scene, rows, parts) if blend == "adjust" else {}
    changed: dict[str, Any] = {}
    for name in ATTRIBUTES:
        movers = [part for part in parts if part.moves(name)]
        if not movers:
            continue
        old: Tensor = getattr(scene, name)
        total = adjusted.get(name, torch.full((len(rows), old[0].numel()), NEGATIVE_ZERO))
        for part in movers if name not in adjusted else ():
            part.add(total, name, hides=blend in ORDERED)
        if blend == "normalized":
            total = total / weight_sums[KINDS[name]].clamp(min=1.0)[:, None]
        changed[name] = old[rows] + total.reshape(-1, *old.shape[1:]).to(old.dtype)
    return rows, changed


@dataclass(frozen=True)
class _LayerMembers:
    """A layer's members of weight ≠ 0, m in number."""

    layer: Layer  # the layer
    members: Tensor | slice  # which of its members these are, all of them as a slice. [m] int64
    rows: Tensor | slice  # where they are among the rows that change, all of them as a slice. [m] int64
    weights: Tensor  # theirs. [m] float32
    # how far it hides the layers below, by kind of attribute; empty but for "over". [M] float32
    coverage: Mapping[str, Tensor]

    def add(self, total: Tensor, name: str, hides: bool) -> None:
        """Add its offsets of one attribute to the sums. [U,c]"""
        weight = self.weights[:, None]
        gain = self.layer.gain(name)
        below = total[self.rows]
        if hides:
            hidden = torch.tensor(self.layer.clamped_strength) * torch.tensor(min(abs(gain), 1.0))
            below = below * (1 - weight * hidden * self.coverage[KINDS[name]][self.members, None])
        offsets = self.layer.gdf.field.attribute_offsets(name, self.layer.strength)[self.members]
        total[self.rows] = below + weight * gain * offsets

    def moves(self, attribute: str) -> bool:
        """Whether it changes an attribute at all."""
        return attribute in self.layer.gdf.field.attributes and self.layer.gain(attribute) != 0


def _adjusted_colors(scene: Gaussians, rows: Tensor, parts: Sequence[_LayerMembers]) -> dict[str, Tensor]:
    """The sums of the color attributes under "adjust". [U,c] each"""
    moved = {name for part in parts for name in _COLORS if part.moves(name)}
    old = {name: getattr(scene, name)[rows].float().flatten(1) for name in _COLORS if name in moved}
    total = {name: torch.full_like(values, NEGATIVE_ZERO) for name, values in old.items()}
    touched = torch.zeros(len(rows), dtype=torch.bool)
    for part in parts:
        form = part.layer.gdf.field.origin
        names = [name for name in old if part.moves(name)]
        before = {name: total[name][part.rows].clone() for name in names}
        for name in names:
            part.add(total[name], name, hides=True)
        here = touched[part.rows]
        if isinstance(form, GradeForm) and names and bool(here.any()):
            sh = [(old[n][part.rows] + before[n])[here].reshape(int(here.sum()), -1, 3) for n in names]
            members = torch.arange(len(part.layer.gdf.region))[part.members][here]
            change = adjust_colors(form, torch.cat(sh, dim=1)[:, :_DRAWN], members, part.layer.strength)
            factor = part.weights[here, None, None] * part.layer.gain("sh0")
            share = part.coverage["map"][members, None]
            for name, bands in zip(names, (change[:, :1], change[:, 1:]), strict=False):
                sums = total[name][part.rows]
                new = before[name][here]
                new[:, : 3 * bands.shape[1]] += (factor * bands).flatten(1)
                sums[here] = torch.lerp(sums[here], new, share)
                total[name][part.rows] = sums
        touched[part.rows] = True
    return total


def _parts(
    scene: Gaussians, layers: Sequence[Layer], blend: str, covers: Coverage
) -> tuple[Tensor, list[_LayerMembers]]:
    """The sorted rows of the scene that change, [U] int64, and each layer's part in them."""
    chosen: list[tuple[Tensor | slice, Tensor]] = []  # members and their weights
    for layer in layers:
        weights = torch.ones(len(layer.gdf.region)) if layer.weights is None else layer.weights.float()
        selected = weights.nonzero()[:, 0]
        chosen.append((_ALL, weights) if len(selected) == len(weights) else (selected, weights[selected]))
    reached = [layer.gdf.region.members[members] for layer, (members, _) in zip(layers, chosen, strict=True)]
    rows = reached[0] if len(reached) == 1 else torch.unique(torch.cat(reached))
    position = torch.empty(len(scene) if len(reached) > 1 else 0, dtype=torch.int64)
    if len(reached) > 1:
        position[rows] = torch.arange(len(rows))
    return rows, [
        _LayerMembers(
            layer,
            members,
            _ALL if len(layer_rows) == len(rows) else position[layer_rows],
            weights,
            covers(scene, layer.gdf) if blend in ORDERED else {},
        )
        for layer, layer_rows, (members, weights) in zip(layers, reached, chosen, strict=True)
    ]
